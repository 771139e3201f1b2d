"""What is counted as moved, against where the robot was."""

import json

import gymnasium as gym
import numpy as np
import pytest

import sims  # noqa: F401
from rfl_torch import record
from rfl_torch.looks import find_looks, look_radius
from rfl_torch.shifts import find_shifts

STEP = 10.0
"""Millimetres of a full action."""


def walk_in(layout, num_steps, hold, **noise):
    """Shifts of a log, (T, 2), its actions and true moves in full ones, and what was seen."""
    with gym.make("rfl/RangefinderMaze-v0", layout=layout, **noise) as env:
        log = record(env, num_steps, hold=hold, seed=0)
    low = log.observations.min(0)
    span = np.maximum(np.ptp(log.observations, axis=0), 1e-9)
    seen = [((log.observations - low) / span).astype(np.float64)]
    unit = [(log.actions + 1) / 2]
    radius = look_radius(seen, unit)
    (shift,), (misfit,), share, _ = find_shifts(find_looks(seen, unit, radius), seen, unit, radius)
    return shift, log.actions, np.diff(log.ground_truth, axis=0) / STEP, share, misfit


@pytest.mark.parametrize(("layout", "hold"), [("twins", 1), ("hall", 1), ("paper", 10)])
def test_shifts_are_what_was_moved_and_not_what_was_asked_for(layout, hold):
    """Within 0.01 of a full action a step; asked for was 0.01 to 0.1 more or less than moved."""
    shift, asked, moved, *_ = walk_in(layout, 6000, hold)
    error = np.abs(shift - moved).mean()
    assert error < 0.01
    assert error < 0.3 * np.abs(asked - moved).mean()
    assert np.linalg.norm((shift - moved).sum(0)) < 10


def test_what_slides_along_a_slanted_wall_is_what_was_moved(tmp_path):
    """Two walls at 30 and 60 degrees: by shares of each dimension alone it is 0.34 off (median)."""
    walls = [[150, 200, 500, 402], [550, 100, 750, 446]]
    plan = tmp_path / "slanted.json"
    plan.write_text(json.dumps({"size": [900, 600], "walls": walls, "start": [100, 100]}))
    shift, asked, moved, *_ = walk_in(str(plan), 6000, 10)
    slid = (np.abs(moved - asked) > 0.2).all(1) & (np.abs(moved) > 0.1).all(1)
    assert slid.sum() > 100
    error = np.linalg.norm(shift - moved, axis=1)
    assert np.median(error[slid]) < 0.1
    assert np.quantile(error[slid], 0.8) < 0.2


def test_moves_along_a_hall_without_an_end_in_sight_are_counted(tmp_path):
    """Of 400 mm in its middle nothing is in sight: 1.2 % of all moves are wrong by a single turn or
    if a slide need not show in both dimensions, 2.8 % with twice the evidence."""
    walls = [[60, 0, 60, 60], [140, 1340, 140, 1400]]
    plan = tmp_path / "hall.json"
    plan.write_text(json.dumps({"size": [200, 1400], "walls": walls, "start": [100, 100]}))
    shift, _, moved, *_ = walk_in(str(plan), 10_000, 3)
    assert (np.linalg.norm(shift - moved, axis=1) > 0.1).mean() < 0.01


def test_a_shift_is_wrong_where_the_readings_do_not_fit_it():
    shift, _, moved, _, misfit = walk_in("paper", 6000, 10)
    error = np.linalg.norm(shift - moved, axis=1)
    assert np.median(misfit) == pytest.approx(1.0)
    assert np.square(error[misfit < 1.0]).mean() < 0.01**2
    assert np.square(error[misfit > np.quantile(misfit, 0.99)]).mean() > 0.1**2


def test_noise_is_told_from_walls():
    shift, asked, moved, *_ = walk_in("twins", 6000, 3, sensor_noise=0.05, motion_noise=0.1)
    # A tenth of motion noise leaves 0.02 to 0.03 a step, which adds up to nothing.
    assert np.abs(shift - moved).mean() < 0.05
    was_stopped = (np.abs(moved - asked) > 0.4).any(1)
    assert was_stopped.sum() > 200
    error = np.linalg.norm(shift - moved, axis=1)[was_stopped]
    assert np.median(error) < 0.3 * np.median(np.linalg.norm(asked - moved, axis=1)[was_stopped])


def test_what_no_reading_shows_counts_as_done():
    """One reading, of x alone, in a strip with walls in x: moves in y are never in sight."""
    rng = np.random.default_rng(0)
    action = rng.uniform(-1, 1, (4000, 2))
    place = np.zeros((4001, 2))
    for t in range(4000):
        place[t + 1] = place[t] + action[t]
        place[t + 1, 0] = place[t + 1, 0].clip(-20, 20)
    seen = [(place[:, :1] + 20) / 40]
    unit = [((action + 1) / 2).astype(np.float32)]
    looks = [(seen[0][:, 0] * 19).round().astype(np.int64)]
    (shift,), _, share, grip = find_shifts(looks, seen, unit, 0.05)
    moved = np.diff(place, axis=0)
    assert np.abs(shift[:, 1] - action[:, 1]).max() < 1e-6
    # Shares are tenths, and a tenth of the steps end at a wall.
    assert np.abs(shift[:, 0] - moved[:, 0]).mean() < 0.01
    # Half of the actions' variance is in y, and shows nowhere.
    assert 0.4 < share < 0.6
    assert grip[:, 0].min() > 0.7
    assert grip[:, 1].max() < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_what_shows_at_other_looks_alone_counts_as_done(seed):
    """Its end is in sight from the first half of a corridor, and from the other nothing is."""
    rng = np.random.default_rng(seed)
    action = rng.uniform(-1, 1, (6000, 2)).repeat(3, 0)[:6000]
    place = np.tile([5.0, 15.0], (6001, 1))
    for t in range(6000):
        place[t + 1] = (place[t] + action[t]).clip(0, [10, 60])
    across, along = place[:, 0] / 10, np.minimum(place[:, 1], 30) / 30
    seen = [np.stack([*[across] * 6, along, along], 1)]
    looks = [(place[:, 1] >= 30).astype(np.int64)]
    (shift,), *_ = find_shifts(looks, seen, [((action + 1) / 2).astype(np.float32)], 0.1)
    is_out_of_sight = (place[:-1, 1] > 32) & (place[:-1, 1] < 58)
    error = np.abs(shift - np.diff(place, axis=0))[is_out_of_sight, 1]
    assert error.mean() < 0.01  # 0.09 to 0.18, if all looks count the same
