"""How far each way is free, by what is seen: learned from where the logs went.

A robot that is off its map knows nothing of the room but what it sees. Its logs tell what a free
way looks like: from each place on the track (`places`) the track itself went so far. A linear
function of the readings carries over to places that no log saw; a small network, more right where
the logs were, is less so elsewhere.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rfl_torch.innate import directions

Array = NDArray[np.float64]

LONGEST = 50
"""Full actions that a way is followed for at most."""

WIDTH = 1.6
"""Full actions from the track within which a place was gone over."""

NUM_SIGHTS = 5000
"""Sights of the logs that are learned from at most."""

RIDGE = 1e-4
"""Of the fit, a sight."""

FEWEST = 10
"""Steps against a wall that tell how much readings change at one."""


class FreeWays(NamedTuple):
    """What the logs say of free ways.

    weight: (D + 1, W), of the readings and 1, for the free full actions along `ways`.
    still: mean absolute change of the readings in a step that was stopped.
    """

    weight: Array
    still: float

    def at(self, normal: Array) -> Array:
        """Full actions along each of the `ways` that are free, (..., W), where (..., D) is seen."""
        return np.clip(normal @ self.weight[:-1] + self.weight[-1], 0.0, LONGEST)


def ways(action_dim: int) -> Array:
    """Directions of unit length, (W, A)."""
    rows = directions(action_dim) - 0.5
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def learn_free_ways(
    tracks: list[Array],
    observations: list[Array],
    shifts: list[Array],
    unit_actions: list[NDArray[np.float32]],
) -> FreeWays:
    """Fit free ways to what was seen.

    Args:
        tracks: where each step was, in full actions, (T+1, A) for each log.
        observations: (T+1, D) each, without missing readings.
        shifts: how far each step went, in full actions, (T, A) each.
        unit_actions: (T, A) each, in [0, 1].
    """
    position, seen = np.concatenate(tracks), np.concatenate(observations)
    chosen = np.linspace(0, len(seen) - 1, min(NUM_SIGHTS, len(seen))).astype(np.int64)
    free = _gone_over(position, chosen)
    inputs = np.concatenate([seen[chosen], np.ones((len(chosen), 1))], 1)
    penalty = RIDGE * len(chosen) * np.eye(inputs.shape[1])
    penalty[-1, -1] = 0.0
    weight = np.linalg.solve(inputs.T @ inputs + penalty, inputs.T @ free)
    return FreeWays(weight, _change_when_stopped(observations, shifts, unit_actions))


def _gone_over(position: Array, chosen: NDArray[np.int64]) -> Array:
    """Full actions along each way from the chosen steps (C,) that the track covers, (C, W)."""
    tree, along = cKDTree(position), ways(position.shape[1])
    free = np.full((len(chosen), len(along)), float(LONGEST))
    start, way = (own.ravel() for own in np.indices(free.shape))
    for reach in range(1, LONGEST + 1):
        point = position[chosen[start]] + reach * along[way]
        is_off = np.isinf(tree.query(point, distance_upper_bound=WIDTH)[0])
        free[start[is_off], way[is_off]] = reach - 1
        start, way = start[~is_off], way[~is_off]
    return free


def _change_when_stopped(
    observations: list[Array], shifts: list[Array], unit_actions: list[NDArray[np.float32]]
) -> float:
    """Median change of the readings where half an action or more was asked for in vain.

    Where that was hardly ever so, as in an open room, in the hundredth of the steps that went least
    far: what noise changes, and what so little motion does.
    """
    change = np.concatenate([np.abs(np.diff(seen, axis=0)).mean(1) for seen in observations])
    moved = np.abs(np.concatenate(shifts)).max(1)
    asked = np.abs(2.0 * np.concatenate(unit_actions) - 1.0).max(1)
    is_stopped = (asked >= 0.5) & (moved < 0.2 * asked)
    if is_stopped.sum() < FEWEST:
        return float(np.median(change[moved.argsort()[: max(FEWEST, len(moved) // 100)]]))
    return float(np.median(change[is_stopped]))
