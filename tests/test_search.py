import numpy as np

from rfl_torch.innate import directions, nearest_direction
from rfl_torch.search import HOLD, LookSearch


def test_directions_are_all_full_actions_and_each_is_nearest_to_itself():
    for dim, count in ((1, 2), (2, 8), (3, 26), (5, 10)):
        rows = directions(dim)
        assert rows.shape == (count, dim)
        choice, is_full = nearest_direction(rows)
        assert choice.tolist() == list(range(count))
        assert is_full.all()
    assert not nearest_direction(np.full((1, 2), 0.6))[1].any()


def test_a_search_tries_every_direction_at_a_look_before_any_twice():
    search = LookSearch(np.full(2, -1.0, np.float32), np.ones(2, np.float32), 0.1, 0)
    actions = [search.act(np.array([0.5, 0.5])) for _ in range(8 * HOLD)]
    assert len({tuple(action) for action in actions}) == 8


def test_a_search_goes_straight_on_while_looks_are_new_and_turns_where_they_are_not():
    search = LookSearch(np.full(1, -1.0, np.float32), np.ones(1, np.float32), 0.1, 0)
    first = search.act(np.array([0.0]))
    assert all(search.act(np.array([0.3 * k])) == first for k in range(1, 6))
    assert search.act(np.array([0.3 * 3])) == -first


def test_a_missing_reading_does_not_stop_a_search():
    search = LookSearch(np.zeros(2, np.float32), np.ones(2, np.float32), 0.1, 0)
    assert np.isfinite(search.act(np.array([np.nan, 0.3]))).all()
