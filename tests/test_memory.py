import numpy as np

from rfl_torch.memory import join


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
