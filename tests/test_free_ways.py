import numpy as np
import pytest

from rfl_torch.free_ways import (
    FEWEST_MOVES,
    LONGEST,
    WALL_GUESSED,
    WALL_TOLD,
    FreeWays,
    learn_free_ways,
    readings_ahead,
    ways,
)

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


def learn(*walked, low=0.0, scale=1.0):
    """With readings whose 0 and 1 stand for `low` and `low + scale` in their own unit."""
    of_each = np.ones(walked[1].shape[1])
    return learn_free_ways(*([part] for part in walked), low * of_each, scale * of_each)


def way_along(*direction):
    (way,) = np.flatnonzero(np.isclose(ways(2) @ direction, np.linalg.norm(direction)))
    return way


def rays(track, num=8, size=SIZE):
    """Distances to the walls of a room from places (T, 2), in `num` directions, (T, num)."""
    angle = 2 * np.pi * np.arange(num) / num
    ray = np.stack([np.cos(angle), np.sin(angle)], 1)
    ray[np.abs(ray) < 1e-9] = 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.where(ray > 0, size - track[:, None], -track[:, None]) / ray
    return np.where(ray == 0, np.inf, away).min(2)


def test_ways_along_the_axes_are_free_up_to_the_walls():
    track, seen, shift, actions = walk()
    learned = learn(track, seen, shift, actions)
    free = np.stack([learned.at(each) for each in seen[:500]])
    for axis in range(2):
        for sign in (-1, 1):
            (way,) = np.flatnonzero(ways(2)[:, axis] == sign)
            wall = SIZE[axis] - track[:500, axis] if sign > 0 else track[:500, axis]
            np.testing.assert_allclose(free[:, way], wall, atol=1e-6)


def test_free_ways_are_known_where_the_log_did_not_go():
    learned = learn(*walk(end=25.0))
    _, seen, _, _ = walk()
    (up,) = np.flatnonzero(ways(2)[:, 1] == 1)
    beyond = seen[seen[:, 0] * LONGEST > 30]
    free = np.array([learned.at(each)[up] for each in beyond])
    assert np.median(np.abs(free - beyond[:, 3] * LONGEST)) < 3


@pytest.mark.parametrize("num_rays", [8, 24])
def test_the_ray_along_each_way_tells_how_far_it_goes_on(num_rays):
    track, _, shift, actions = walk()
    seen = rays(track, num_rays)
    scale = seen.max(0)
    learned = learn(track, seen / scale, shift, actions, scale=scale)
    assert learned.carries_over.all()
    other = np.array([[100.0, 300.0], [7.0, 45.0]])  # in a room that is much larger
    size = np.array([400.0, 500.0])
    for way, along in enumerate(ways(2)):
        ahead = int(np.round(np.arctan2(along[1], along[0]) / (2 * np.pi) * num_rays)) % num_rays
        # A tenth: by how much the falls in moves up to 0.1 off the way are spread.
        truth = np.minimum(rays(other, num_rays, size)[:, ahead], LONGEST)
        got = learned.at(rays(other, num_rays, size) / scale)[:, way]
        np.testing.assert_allclose(got, truth, rtol=0.1)


def test_in_a_corridor_the_ray_ahead_is_told_from_those_that_fall_as_evenly():
    """All rays to one wall fall by the same share of what they read at most."""
    track, _, _, _ = walk(end=3.0)
    size = np.array([3.0, 2000.0])
    seen = rays(track, 24, size)
    towards = [way_along(1, 0), way_along(-1, 0)]
    reading, fall = readings_ahead([track], [seen / seen.max(0)], seen.max(0))
    assert reading[towards].tolist() == [0, 12]
    np.testing.assert_allclose(fall[towards] * seen.max(0)[[0, 12]], 1.0, rtol=1e-6)


@pytest.mark.parametrize("length", [60.0, 2000.0])
def test_a_way_whose_end_the_log_hardly_saw_or_never_is_told_by_the_ray_along_it(length):
    """And slanted ways, along which rays to both ends of a wall fall, by one ray each."""
    track, _, shift, actions = walk()
    size, sight = np.array([length, SIZE[1]]), 30.0
    seen = rays(track, 24, size).clip(max=sight) / sight
    assert (seen[:, 0] == 1.0).mean() > 0.7  # where falls that don't show count, it is told by none
    learned = learn(track, seen, shift, actions, scale=sight)
    for way, along in enumerate(ways(2)):
        ahead = int(np.round(np.arctan2(along[1], along[0]) / (2 * np.pi) * 24)) % 24
        assert np.flatnonzero(learned.weight[:-1, way]).tolist() == [ahead]
        np.testing.assert_allclose(learned.weight[ahead, way], sight, rtol=0.1)


def test_of_a_corridor_of_which_no_end_was_seen_no_reading_is_left_for_one_way_alone():
    track, _, shift, actions = walk()
    middle = track + np.array([1000.0, 0.0])
    seen = rays(middle, 8, np.array([2000.0, SIZE[1]])).clip(max=30.0) / 30.0
    assert (seen[:, [0, 4]] == 1.0).all()
    learned = learn(middle, seen, shift, actions, scale=30.0)
    told = learned.carries_over
    assert told[[way_along(0, 1), way_along(0, -1)]].all()
    assert not told[[way_along(1, 0), way_along(-1, 0)]].any()


def test_a_way_that_no_reading_points_along_is_told_by_all():
    learned = learn(*walk())  # it reads along the axes only
    is_axis = (ways(2) == 0).any(1)
    assert learned.carries_over[is_axis].all()
    assert not learned.carries_over[~is_axis].any()
    track, seen, shift, actions = walk(num_steps=FEWEST_MOVES)
    assert not learn(track, seen, shift, actions).carries_over.any()


def test_where_no_reading_falls_evenly_all_together_tell_how_far_ways_go_on():
    track, seen, shift, actions = walk()
    seen = seen**2  # differences of two of them are even again
    learned = learn(track, seen, shift, actions)
    for axis in range(2):
        for sign in (-1, 1):
            (way,) = np.flatnonzero(ways(2)[:, axis] == sign)
            assert not learned.carries_over[way]
            free = learned.at(seen[:500])[:, way]
            wall = SIZE[axis] - track[:500, axis] if sign > 0 else track[:500, axis]
            # WIDTH beyond the track counts as gone over, and its edges were not gone along.
            assert np.median(np.abs(free - wall)) < 3
            assert np.corrcoef(free, wall)[0, 1] > 0.95


def test_a_wall_that_was_not_touched_is_where_another_touched():
    """The log never went to the end of the room; there the reading's 0 stands for more than 0."""
    track, seen, shift, actions = walk(end=25.0)
    low = seen.min(0)
    learned = learn(track, seen - low, shift, actions, low=low)
    free = learned.at(seen[:500] - low)[:, way_along(1, 0)]
    np.testing.assert_allclose(free, SIZE[0] - track[:500, 0], atol=1e-6)


def test_the_end_of_a_way_is_no_wall_where_a_sensor_sees_no_farther():
    def within(weight):
        return FreeWays(np.concatenate([weight, np.zeros((1, 2))]), 0.0).wall_within

    np.testing.assert_allclose(within(np.diag([12.0, 48.0])), [11.0, WALL_TOLD])
    np.testing.assert_allclose(within(np.full((2, 2), 48.0)), WALL_GUESSED)


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
    units = (np.zeros(4), np.ones(4))
    moves = (list(shift[free, None]), list(actions[free, None]))
    learned = learn_free_ways(tracks, pairs, *moves, *units)
    assert learned.still == pytest.approx(mean_change(noise), rel=0.3, abs=2e-3)
