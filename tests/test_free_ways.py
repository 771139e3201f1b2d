import numpy as np
import pytest

from rfl_torch.free_ways import LONGEST, learn_free_ways, ways

SIZE = np.array([40.0, 20.0])


def walk(num_steps=20000, noise=0.0, end=SIZE[0]):
    """A walk up to x = `end` in a room of 40 x 20 full actions; it reads the walls' distances."""
    rng = np.random.default_rng(0)
    actions = np.repeat(rng.uniform(-1, 1, (num_steps // 10, 2)), 10, 0)
    track = np.empty((num_steps + 1, 2))
    track[0] = SIZE / 2
    for step, action in enumerate(actions):
        track[step + 1] = np.clip(track[step] + action, 0, (end, SIZE[1]))
    seen = np.concatenate([track, SIZE - track], 1) / LONGEST
    seen = seen + noise * rng.standard_normal(seen.shape)
    return track, seen, np.diff(track, axis=0), ((actions + 1) / 2).astype(np.float32)


def learn(*walked):
    return learn_free_ways(*([part] for part in walked))


def test_ways_along_the_axes_are_free_up_to_the_walls():
    track, seen, shift, actions = walk()
    learned = learn(track, seen, shift, actions)
    free = np.stack([learned.at(each) for each in seen[:500]])
    for axis in range(2):
        for sign in (-1, 1):
            (way,) = np.flatnonzero(ways(2)[:, axis] == sign)
            wall = SIZE[axis] - track[:500, axis] if sign > 0 else track[:500, axis]
            # WIDTH beyond the track counts as gone over, and its edges were not gone along.
            assert np.median(np.abs(free[:, way] - wall)) < 3
            assert np.corrcoef(free[:, way], wall)[0, 1] > 0.95


def test_free_ways_are_known_where_the_log_did_not_go():
    learned = learn(*walk(end=25.0))
    _, seen, _, _ = walk()
    (up,) = np.flatnonzero(ways(2)[:, 1] == 1)
    beyond = seen[seen[:, 0] * LONGEST > 30]
    free = np.array([learned.at(each)[up] for each in beyond])
    assert np.median(np.abs(free - beyond[:, 3] * LONGEST)) < 3


def mean_change(noise):
    """Of a difference of two normal numbers, the mean is 2 / sqrt(pi) times their deviation."""
    return 2 / np.sqrt(np.pi) * noise


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_the_change_of_readings_at_a_wall_is_their_noise(noise):
    still = learn(*walk(noise=noise)).still
    assert still == pytest.approx(mean_change(noise), rel=0.3, abs=2e-3)


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_in_an_open_room_the_change_of_readings_in_short_steps_is_their_noise(noise):
    """Who took noise for motion would go on against the first wall forever."""
    track, seen, shift, actions = walk(noise=noise)
    asked = 2 * actions.astype(np.float64) - 1
    is_free = np.abs(shift - asked).max(1) < 1e-6  # as if nothing had ever stood in the way
    free = np.flatnonzero(is_free)
    seen_before, seen_after = seen[:-1][free], seen[1:][free]
    pairs = [np.stack(both) for both in zip(seen_before, seen_after, strict=True)]
    tracks = [track[[k, k + 1]] for k in free]
    learned = learn_free_ways(tracks, pairs, list(shift[free, None]), list(actions[free, None]))
    assert learned.still == pytest.approx(mean_change(noise), rel=0.3, abs=2e-3)
