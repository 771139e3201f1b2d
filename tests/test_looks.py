import gymnasium as gym
import numpy as np
import pytest

import sims  # noqa: F401
from rfl_torch import looks, record


def test_a_look_is_as_wide_as_its_steps_are_far():
    rng = np.random.default_rng(0)
    action = rng.random((4000, 1)).astype(np.float32)
    position = np.concatenate([[0.0], (2 * action[:, 0] - 1).cumsum()])
    seen = 0.01 * position[:, None] * np.ones((1, 6))
    radius = looks.look_radius([seen], [action])
    assert radius == pytest.approx(0.01 * looks.LOOK_STEPS, rel=0.02)
    noisy = seen + 0.02 * rng.standard_normal(seen.shape)
    apart = [np.abs(noisy[t + 4] - noisy[t]).mean() for t in range(3990)]
    moved = np.array([abs(position[t + 4] - position[t]) for t in range(3990)])
    typical = np.median(np.array(apart)[np.abs(moved - looks.LOOK_STEPS) < 0.2])
    assert looks.look_radius([noisy], [action]) == pytest.approx(typical, rel=0.1)


def corridor_walk(num_steps=8000):
    """Actions, places in a corridor of 100 by 10, and 20 readings: two tell how far along it."""
    rng = np.random.default_rng(2)
    action = rng.random((num_steps, 2)).astype(np.float32).repeat(4, 0)[:num_steps]
    place, places = np.array([50.0, 5.0]), []
    for step in np.concatenate([[[0.0, 0.0]], 2 * action - 1]):
        place = (place + step).clip(0, [100, 10])
        places.append(place)
    along, across = np.array(places).T
    readings = [along / 100, 1 - along / 100, *[across / 10, 1 - across / 10] * 9]
    return action, np.array(places), np.stack(readings, 1)


def test_a_look_is_as_long_as_it_is_wide_however_few_readings_tell_so():
    action, place, seen = corridor_walk()
    (look,) = looks.find_looks([seen], [action], looks.look_radius([seen], [action]))
    size = np.array([np.ptp(place[look == k], axis=0) for k in np.unique(look)])
    along, across = np.median(size, 0)
    assert across / 2 < along < 2 * across  # by the readings' mean difference it is nine times
    assert size.max() <= 2 * 1.5 * looks.LOOK_REACH


def test_distance_is_counted_in_actions_whichever_way_they_lead():
    action, place, seen = corridor_walk()
    sight = looks.Sight([seen], [action], looks.look_radius([seen], [action]))
    for step in (100, 4000, 7000):
        near, away = sight.look_around(step)
        far = np.linalg.norm(place[near] - place[step], axis=1)
        some = (far > 1) & (far < looks.LOOK_REACH)
        assert np.quantile(away[some] / far[some] / sight.unit(), [0.1, 0.9]) == pytest.approx(
            1, abs=0.4
        )


def test_logs_share_their_looks_and_each_look_is_seen():
    action, _, seen = corridor_walk(3000)
    radius = looks.look_radius([seen], [action])
    first, second = looks.find_looks([seen, seen[:1000]], [action, action[:999]], radius)
    assert np.array_equal(first[:1000], second)
    assert set(range(first.max() + 1)) == set(first.tolist())


def test_readings_that_hold_still_leave_a_radius_to_divide_by():
    still = np.zeros((100, 1))
    radius = looks.look_radius([still], [np.ones((99, 1), np.float32)])
    assert 0 < radius < 1e-6


def test_a_look_is_as_wide_where_the_robot_stands_still_for_most_of_the_log():
    rng = np.random.default_rng(0)
    action = rng.random((4000, 1)).astype(np.float32)
    move = (2 * action[:, 0] - 1) * (np.arange(4000) < 600)  # then it stands at the end of its road
    seen = 0.01 * np.concatenate([[0.0], move.cumsum()])[:, None] * np.ones((1, 6))
    radius = looks.look_radius([seen], [action])
    assert radius == pytest.approx(0.01 * looks.LOOK_STEPS, rel=0.15)


def test_few_looks_are_long_where_an_action_counts_for_much():
    """In `hall`, held 10, it is 1.8 and one ray tells how far along: a reach is 4.6 actions."""
    with gym.make("rfl/RangefinderMaze-v0", layout="hall") as env:
        log = record(env, 8000, hold=10, seed=2)
    seen = log.observations.astype(np.float64)
    action = (log.actions + 1) / 2
    (look,) = looks.find_looks([seen], [action], looks.look_radius([seen], [action]))
    length = np.zeros(len(look))
    for own in np.unique(look):
        (steps,) = np.nonzero(look == own)
        runs = np.split(steps, np.flatnonzero(np.diff(steps) > 1) + 1)
        length[steps] = max(np.ptp(log.ground_truth[run], axis=0).max() for run in runs)
    assert (length > 60).mean() < 0.1  # 0.15, if one ray counts for four actions at most
