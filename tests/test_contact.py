import numpy as np
import pytest

from rfl_torch.contact import FEWEST, Contact, _best_threshold, learn_contact
from rfl_torch.explorer import Explorer
from rfl_torch.free_ways import LONGEST, FreeWays, ways

BOUNDS = (np.full(2, -1.0, np.float32), np.ones(2, np.float32))

IN_SIGHT = 8.0


class Hall:
    """A room in which a robot sees the distances of four walls, up to IN_SIGHT full actions."""

    def __init__(self, size, start):
        self._size, self.position = np.array(size), np.array(start, np.float64)

    def see(self):
        far = np.concatenate([self.position, self._size - self.position])
        return np.minimum(far, IN_SIGHT) / IN_SIGHT

    def do(self, action):
        self.position = np.clip(self.position + action, 0.0, self._size)


def walk(size, num_steps=6000):
    """A walk in a hall of that size: observations, shifts and actions in [0, 1]."""
    rng = np.random.default_rng(0)
    hall = Hall(size, np.array(size) / 2)
    actions = np.repeat(rng.uniform(-1, 1, (num_steps // 10, 2)), 10, 0)
    seen, places = [hall.see()], [hall.position]
    for action in actions:
        hall.do(action)
        seen.append(hall.see())
        places.append(hall.position)
    shifts = np.diff(places, axis=0)
    return [np.array(seen)], [shifts], [((actions + 1) / 2).astype(np.float32)]


def says_at(contact, position, size):
    seen = Hall(size, position).see()
    return [contact.is_blocked(direction, seen) for direction in range(4)]


def test_walls_are_felt_in_a_room_that_no_log_saw():
    contact = learn_contact(*walk((12.0, 20.0)))
    large = (60.0, 60.0)
    for position in np.random.default_rng(1).uniform(1.0, 59.0, (200, 2)):
        assert not any(says_at(contact, position, large))
    for wall in (0.0, 60.0):
        for along in (1.0, 20.0, 40.0):
            low, high = says_at(contact, (wall, along), large)[:2]
            assert (low, high) == ((True, False) if wall == 0.0 else (False, True))
            low, high = says_at(contact, (along, wall), large)[2:]
            assert (low, high) == ((True, False) if wall == 0.0 else (False, True))


def test_a_wall_that_no_log_came_up_to_is_felt_by_the_reading_that_points_there():
    """Here the high end of the second dimension; a reading's whole range is IN_SIGHT."""
    weight = np.zeros((5, 8))
    known = FreeWays(weight.copy(), 0.0)
    (up,) = np.flatnonzero((ways(2) == (0.0, 1.0)).all(1))
    weight[3, up] = IN_SIGHT
    felt = learn_contact(*walk((12.0, 20.0)))
    felt.side[3] = 0.0
    assert says_at(felt, (30.0, 60.0), (60.0, 60.0))[3] is None
    assert (
        says_at(felt.completed(known), (30.0, 60.0), (60.0, 60.0))[3] is None
    )  # none points there
    completed = felt.completed(FreeWays(weight, 0.0))
    for away, is_blocked in ((0.0, True), (0.9, True), (1.1, False), (30.0, False)):
        says = says_at(completed, (30.0, 60.0 - away), (60.0, 60.0))
        assert says == [False, False, False, is_blocked]
    np.testing.assert_array_equal(completed.side[:3], felt.side[:3])  # what was felt is as it was


def test_what_tells_in_a_corridor_alone_leaves_it_unclear_elsewhere():
    """A wall at one hand is there as surely felt by the other's distance."""
    width = 5.0
    contact = learn_contact(*walk((width, 40.0)))
    assert (contact.side[0] != 0).tolist() == [True, False, True, False]
    assert says_at(contact, (0.0, 20.0), (width, 40.0))[:2] == [True, False]
    assert says_at(contact, (0.0, 20.0), (30.0, 40.0))[0] is True
    assert says_at(contact, (15.0, 20.0), (30.0, 40.0))[0] is None


def test_nothing_is_said_of_directions_in_which_nothing_was_in_the_way():
    observations, shifts, actions = walk((12.0, 20.0))
    (steps,) = np.nonzero(shifts[0][:, 1] > 0.9 * (2 * actions[0][:, 1] - 1))
    parts = [observations[0][[k, k + 1]] for k in steps]
    contact = learn_contact(parts, list(shifts[0][steps, None]), list(actions[0][steps, None]))
    assert contact.side[0].any()
    assert not contact.side[3].any()
    assert contact.is_blocked(3, parts[0][0]) is None
    assert Contact.unknown(2, 4).is_blocked(0, parts[0][0]) is None


def test_few_stops_say_nothing():
    observations, shifts, actions = walk((12.0, 20.0))
    asked, before = 2 * actions[0] - 1, observations[0][:-1]
    is_at_wall = (asked[:, 0] > 0.5) & (before[:, 2] == 0.0)
    is_free = before[:, 2] * IN_SIGHT > 1.0
    for num, tells in ((FEWEST - 1, False), (FEWEST, True)):
        kept = np.append(np.flatnonzero(is_free), np.flatnonzero(is_at_wall)[:num])
        parts = [observations[0][[k, k + 1]] for k in kept]
        contact = learn_contact(parts, list(shifts[0][kept, None]), list(actions[0][kept, None]))
        assert contact.side[1].any() == tells


def test_a_reading_that_is_as_often_wrong_tells_nothing():
    observations, shifts, actions = walk((12.0, 20.0))
    noise = np.random.default_rng(0).uniform(size=observations[0].shape)
    assert not learn_contact([noise], shifts, actions).side.any()


def test_the_threshold_is_the_best_of_all():
    rng = np.random.default_rng(0)
    for _ in range(50):
        values, is_stopped = rng.uniform(size=12), rng.uniform(size=12) < 0.4
        threshold, wrong = _best_threshold(values, is_stopped)
        assert wrong == ((values <= threshold) != is_stopped).sum()
        every = [((values <= value) != is_stopped).sum() for value in np.sort(values)[:-1]]
        assert wrong == min(every)


@pytest.mark.parametrize(("is_felt", "most"), [(True, 3.0), (False, np.inf)])
def test_a_robot_that_feels_walls_counts_the_steps_that_do_not_show(is_felt, most):
    """Halfway along this hall nothing changes: who takes that for a wall is soon far off."""
    size = (60.0, 60.0)
    felt = learn_contact(*walk((12.0, 20.0))) if is_felt else Contact.unknown(2, 4)
    blind = FreeWays(np.concatenate([np.zeros((4, 8)), np.full((1, 8), LONGEST)]), 0.0)
    hall, search = Hall(size, (30.0, 30.0)), Explorer(*BOUNDS, 0.1, blind, felt, 0)
    for _ in range(400):
        hall.do(search.act(hall.see()))
    search.act(hall.see())
    away = np.abs(search.position + 30.0 - hall.position).max()
    assert away < most
    if not is_felt:
        assert away > 10
