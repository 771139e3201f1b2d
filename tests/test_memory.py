import numpy as np
import pytest

from rfl_torch import memory as memory_module
from rfl_torch.memory import ENOUGH, PIECE, STEPS_A_NODE, join


def log(rng, num_steps, first=None):
    seen = rng.random((num_steps + 1, 3))
    if first is not None:
        seen[0] = first
    actions = rng.random((num_steps, 2)).astype(np.float32)
    return rng.integers(9, size=num_steps + 1), seen, actions


def test_logs_come_out_as_they_went_in():
    logs = [log(np.random.default_rng(k), 3 + k) for k in range(3)]
    memory = join(logs[:1]).plus(join(logs[1:]))
    seen, actions = memory.logs()
    for k, (node, own, done) in enumerate(logs):
        np.testing.assert_array_equal(seen[k], own.astype(np.float32))
        np.testing.assert_array_equal(actions[k], done)
        np.testing.assert_array_equal(memory.paths()[k], node)


def test_a_log_that_goes_on_becomes_one_with_the_last():
    """As if it had never been cut, with the second part's nodes from the cut on."""
    rng = np.random.default_rng(0)
    first, whole = log(rng, 4), log(rng, 9)
    cut = 5
    parts = [tuple(x[: cut + k] for x, k in zip(whole, (1, 1, 0), strict=True))]
    parts += [tuple(x[cut:] for x in whole)]
    memory = join([first, parts[0]])
    assert memory.ends_with(whole[1][cut])
    assert not memory.ends_with(whole[1][cut] + 1e-3)
    gap = np.where([True, False, False], np.nan, whole[1][cut])
    assert memory.ends_with(gap)
    assert not memory.ends_with(np.full(3, np.nan))
    found, expected = memory.plus(join(parts[1:]), goes_on=True), join([first, whole])
    for own, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(own, other)


@pytest.fixture
def crowded(monkeypatch):
    """Three logs that show each of ten nodes 200 times, and two more a few times, long ago."""
    monkeypatch.setattr(memory_module, "LEAST_STEPS", 100)
    rng = np.random.default_rng(0)
    memory = join([log(rng, length - 1) for length in (1_000, 400, 600)])
    node = rng.permutation(np.arange(2_000) % 10)
    node[:8] = np.arange(8) % 2 + 10
    return memory._replace(node=node)


def test_thinned_memory_has_what_the_map_needs_and_its_latest(crowded):
    thin = crowded.thinned()
    most = STEPS_A_NODE * 12
    assert most - 2 * PIECE < len(thin.node) <= most
    assert (np.bincount(thin.node)[:10] >= ENOUGH).all()
    np.testing.assert_array_equal(thin.node[:PIECE], crowded.node[:PIECE])
    late = len(thin.node) - 75
    np.testing.assert_array_equal(thin.observation[late:], crowded.observation[-75:])
    assert thin.ends_with(crowded.observation[-1].astype(np.float64))
    again = thin.thinned()
    for own, other in zip(again, thin, strict=True):
        np.testing.assert_array_equal(own, other)


def test_what_is_left_of_a_log_is_as_it_was(crowded):
    """Each log of the thinned memory is a stretch of one that there was, with its actions."""
    thin = crowded.thinned()
    row = {seen.tobytes(): k for k, seen in enumerate(crowded.observation)}
    whole_seen, whole_done = crowded.logs()
    for seen, actions, path in zip(*thin.logs(), thin.paths(), strict=True):
        begin = row[seen[0].astype(np.float32).tobytes()]
        whole = int(np.searchsorted(crowded.start, begin, "right")) - 1
        own = slice(begin - crowded.start[whole], begin - crowded.start[whole] + len(seen))
        np.testing.assert_array_equal(seen, whole_seen[whole][own])
        np.testing.assert_array_equal(actions, whole_done[whole][own][: len(seen) - 1])
        np.testing.assert_array_equal(path, crowded.node[begin : begin + len(seen)])


def test_a_memory_that_the_map_needs_stays_whole():
    """Few steps; and many nodes that were each seen a few times."""
    rng = np.random.default_rng(0)
    few, many = join([log(rng, 5_000)]), join([log(rng, 20_000)])
    node = rng.permutation(np.arange(20_001) // (ENOUGH - 1))
    for memory in (few, many._replace(node=node)):
        for own, other in zip(memory.thinned(), memory, strict=True):
            np.testing.assert_array_equal(own, other)


def test_what_is_remembered_goes_on_from_what_was_seen_last():
    seen = np.array([[0.1], [0.2], [0.1], [0.3]])
    action = np.zeros((3, 1), np.float32)
    memory = join([(np.array([0, 1, 2, 3]), seen, action)])
    path = memory.remember(np.array([[0.2], [0.1], [0.9], [0.1]]))
    assert path.tolist() == [1, 2, -1, 0]


def test_what_is_remembered_may_have_been_rounded_again():
    """As where ranges were widened; what was never seen is still never remembered."""
    node, seen, actions = log(np.random.default_rng(0), 50)
    memory, rounded = join([(node, seen, actions)]), (seen * 1.7 - 0.3).astype(np.float32)
    wider = memory._replace(observation=(memory.observation * 1.7 - 0.3).astype(np.float32))
    assert (wider.observation != rounded).any()
    sought = np.where(np.arange(51)[:, None] % 2, rounded, rounded + 1e-3)
    sought[4] = np.nan
    path = wider.remember(sought)
    np.testing.assert_array_equal(path, np.where(np.arange(51) % 2, node, -1))
    assert wider.ends_with(rounded[-1])


def test_of_what_differs_by_rounding_alone_what_goes_on_is_remembered():
    """Along a hall, all that is seen is the same but for the last bits."""
    hall = 0.5 + 1e-7 * np.array([0.0, 3.0, 1.0, 2.0])[:, None]
    memory = join([(np.arange(5), np.concatenate([[[0.1]], hall]), np.zeros((4, 1), np.float32))])
    path = memory.remember(np.array([[0.1], [0.5], [0.5], [0.5], [0.5]]))
    assert path.tolist() == [0, 1, 2, 3, 4]
