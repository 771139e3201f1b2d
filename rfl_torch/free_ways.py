"""How far each way is free, by what is seen: learned from where the logs went.

A robot that is off its map knows nothing of the room but what it sees. Its logs tell what a free
way looks like. A reading that falls by the same amount with every move along a way, wherever the
robot is, points there, as one of a rangefinder's rays does; from its lowest value on it counts how
far the way goes on, in places as well that no log saw. In a log of one corridor several readings
fall so. Those that look past the way fall by more, in their own unit, than the one along it. If no
log came near the end of one way, the reading that is left over and never shows less than its most
is the one that points there.

Where no reading does, free ways are a linear function of all, fitted to how far the track
(`places`) itself went on from each place; a small network, more right where the logs were, is less
so elsewhere.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
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

COURSE = 0.995
"""Cosine from which on a move goes along a way."""

MOST_STEPS, LEAST_MOVE, MOST_MOVE = 8, 2.0, 8.0
"""Steps that a move takes at most, and full actions that it goes."""

FEWEST_MOVES = 50
"""That tell by how much a reading falls."""

ALIKE, LEAST_ALIKE, NEARLY = 0.1, 0.3, 0.9
"""Share of the usual fall that a move's may be off for being alike; moves that must be alike for a
reading to tell how far a way goes on; and share of the most alike that is as good."""

NEVER = 10.0
"""Cost of a reading that doesn't point along a way: above all others."""

HIGHEST = 0.9
"""Share of the sights in which what points along a way whose end is out of sight shows its most."""

SLANT = 0.2
"""Logarithm of a fall by which it may be off what it should be along a way."""

WALL_TOLD, WALL_GUESSED = 30.0, 15.0
"""Full actions within which the end of a way is a wall, by a reading that points there, and by all:
the farther, the less it is told which cell it is in; and what all say of long ways is vague."""

FEWEST = 10
"""Steps against a wall that tell how much readings change at one."""


class FreeWays(NamedTuple):
    """What the logs say of free ways.

    weight: (D + 1, W), of the readings and 1, for the free full actions along `ways`.
    still: mean absolute change of the readings in a step that was stopped.
    """

    weight: Array
    still: float

    @property
    def carries_over(self) -> NDArray[np.bool_]:
        """Whether a way is told by a reading that points along it, (W,)."""
        return np.asarray(np.count_nonzero(self.weight[:-1], axis=0) == 1)

    @property
    def wall_within(self) -> Array:
        """Full actions within which the end of a way is a wall, (W,).

        The highest that a reading came to in the logs may be all that it can show.
        """
        most = self.at(np.ones(len(self.weight) - 1))
        return np.where(self.carries_over, np.minimum(most - 1.0, WALL_TOLD), WALL_GUESSED)

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
    low: Array,
    scale: Array,
) -> FreeWays:
    """Fit free ways to what was seen.

    Args:
        tracks: where each step was, in full actions, (T+1, A) for each log.
        observations: (T+1, D) each, without missing readings.
        shifts: how far each step went, in full actions, (T, A) each.
        unit_actions: (T, A) each, in [0, 1].
        low: what each reading's 0 stands for, in its own unit, (D,).
        scale: by how much its 1 is more, (D,).
    """
    reading, fall = readings_ahead(tracks, observations, scale)
    weight = np.zeros((len(scale) + 1, len(reading)))
    (told,) = np.nonzero(reading >= 0)
    ahead = reading[told]
    weight[ahead, told] = 1.0 / fall[told]
    # What touches a wall reads the same on all sides; a log may not have touched one on each.
    weight[-1, told] = (low[ahead] - low[ahead].min(initial=np.inf)) / (scale[ahead] * fall[told])
    (guessed,) = np.nonzero(reading < 0)
    if guessed.size:
        weight[:, guessed] = _fit(np.concatenate(tracks), np.concatenate(observations), guessed)
    return FreeWays(weight, _change_when_stopped(observations, shifts, unit_actions))


def _fit(position: Array, seen: Array, chosen_ways: NDArray[np.int64]) -> Array:
    """The linear function of all readings for some of the ways (C,), (D + 1, C)."""
    chosen = np.linspace(0, len(seen) - 1, min(NUM_SIGHTS, len(seen))).astype(np.int64)
    free = _gone_over(position, chosen, ways(position.shape[1])[chosen_ways])
    inputs = np.concatenate([seen[chosen], np.ones((len(chosen), 1))], 1)
    penalty = RIDGE * len(chosen) * np.eye(inputs.shape[1])
    penalty[-1, -1] = 0.0
    return np.linalg.solve(inputs.T @ inputs + penalty, inputs.T @ free)


def readings_ahead(
    tracks: list[Array], observations: list[Array], scale: Array
) -> tuple[NDArray[np.int64], Array]:
    """Find the reading that tells how far each way goes on.

    Args:
        tracks: where each step was, in full actions, (T+1, A) for each log.
        observations: (T+1, D) each, without missing readings.
        scale: of each reading's unit, in its own, (D,).

    Returns:
        Its index, (W,), -1 if there is none; and by how much it falls in a full action along the
        way, (W,).
    """
    moved, changed = _moves(tracks, observations)
    along = ways(moved.shape[1])
    fall = np.stack([_fall(moved, changed, way) for way in along])
    # Along its own way a reading falls by what a full action is in its unit; one that points past
    # it, by more. A slanted way's full action is made of those along the axes.
    own = np.where(fall > 0, fall * scale, np.inf)
    is_axis = np.count_nonzero(along, axis=1) == 1
    unit = np.array([own[is_axis & (along[:, a] != 0)].min() for a in range(along.shape[1])])
    made_of = np.multiply(along, unit, where=along != 0, out=np.zeros_like(along))
    expected = np.linalg.norm(made_of, axis=1, keepdims=True)
    is_known = np.isfinite(own) & np.isfinite(expected)
    share = np.divide(own, expected, where=is_known, out=np.full(own.shape, np.inf))
    off = np.abs(np.log(share))
    # Along a corridor rays to both ends of a wall fall as they should along one slanted way, but
    # only one of them does so along the other: each tells one, and all together are told best.
    cost = np.where(off <= SLANT, off, NEVER)
    reading = np.full(len(along), -1)
    way, best = linear_sum_assignment(cost)
    is_told = cost[way, best] < NEVER
    reading[way[is_told]] = best[is_told]
    fall = fall[np.arange(len(along)), reading]
    # No log came near the end of the one way left: what points there stayed at its highest.
    (left,) = np.nonzero(reading < 0)
    spare = np.setdiff1d(_at_their_highest(observations), reading)
    if len(left) == len(spare) == 1 and np.isfinite(expected[left[0]]).all():
        reading[left], fall[left] = spare, expected[left, 0] / scale[spare]
    return reading, fall


def _at_their_highest(observations: list[Array]) -> NDArray[np.int64]:
    """Readings that hardly ever showed less than the most that they can."""
    seen = np.concatenate(observations)
    (always,) = np.nonzero((seen == seen.max(0)).mean(0) >= HIGHEST)
    return always


def _moves(tracks: list[Array], observations: list[Array]) -> tuple[Array, Array]:
    """Moves of some steps (M, A), and by how much they changed the readings, (M, D)."""
    moved, changed = [], []
    for track, seen in zip(tracks, observations, strict=True):
        for steps in range(1, MOST_STEPS + 1):
            move = track[steps:] - track[:-steps]
            length = np.linalg.norm(move, axis=1)
            is_long = (length >= LEAST_MOVE) & (length <= MOST_MOVE)
            moved.append(move[is_long])
            changed.append((seen[steps:] - seen[:-steps])[is_long])
    return np.concatenate(moved), np.concatenate(changed)


def _fall(moved: Array, changed: Array, way: Array) -> Array:
    """By how much each reading falls in a full action along a way, (D,); 0 if it doesn't tell.

    Asked where it changes at all: at its highest it says that nothing is near.
    """
    length = np.linalg.norm(moved, axis=1)
    is_along = moved @ way >= COURSE * length
    each = -changed[is_along] / length[is_along, None]
    usual, alike = np.zeros(changed.shape[1]), np.zeros(changed.shape[1])
    for reading, fall in enumerate(each.T):
        fall = fall[fall != 0]
        if len(fall) >= FEWEST_MOVES and (median := float(np.median(fall))) > 0:
            usual[reading] = median
            alike[reading] = (np.abs(fall - median) <= ALIKE * median).mean()
    tells = alike >= max(LEAST_ALIKE, NEARLY * alike.max())
    return np.where(tells, usual, 0.0)


def _gone_over(position: Array, chosen: NDArray[np.int64], along: Array) -> Array:
    """Full actions along ways (W, A) from the chosen steps (C,) that the track covers, (C, W)."""
    tree = cKDTree(position)
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
