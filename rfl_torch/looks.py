"""What looks the same: observations within a few actions of each other.

    radius   mean absolute difference of what is seen LOOK_STEPS actions apart, anywhere: by it a
             sight is familiar or strange
    look     what is seen within LOOK_REACH actions of a place, counted by how the readings change
             with an action there

Along a corridor few of a robot's rays change, across it all of them. By their mean difference alone
a look is as long as the corridor.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

LOOK_STEPS = 2.0
"""Full actions within which sights are familiar, about half the way between the paper's nodes."""

LONGEST_LAG = 8
"""Steps over which the change of the observations is measured."""

LEAST_RADIUS = 1e-9
"""Radius that is as good as none, yet can be divided by."""

LOOK_REACH = 2.5
"""Actions from its middle on which a look ends: about the paper's 44 mm from end to end."""

LOOK_RADII = 1.5
"""Radii by mean absolute difference beyond which no observation shows the look."""

LONGEST_JUMP = 3.0
"""Radii that a reading counts for at most: a ray that slips past a corner jumps, and squared, one
jump outweighs all others. By two, the one ray that shows how far along a hall a robot is counts for
four actions, and where an action counts for 1.6 or more a look goes on to the hall's end."""

AROUND = 300
"""Steps around a look that tell how readings change with an action there."""

FLAT = 0.01
"""Share of a reading's mean variance that is added in all directions. At 0.3 a corridor's looks are
as long as the corridor."""

NUM_UNITS = 300
"""Steps around which the distance of an action is measured."""

BATCH = 1024
"""Observations compared with all others at a time."""


def look_radius(observations: list[Array], unit_actions: list[NDArray[np.float32]]) -> float:
    """Mean absolute change of a normalised observation over LOOK_STEPS full actions.

    A line is fitted to the changes over 1 to LONGEST_LAG steps against the length of the summed
    actions: its slope is motion, its offset noise. A radius must hold both. A log that mostly held
    still, as a car at the end of its road does, is measured where it moved.

    Args:
        observations: (T+1, D) each, without missing readings.
        unit_actions: (T, A) each, in [0, 1].
    """
    change, length = [], []
    for seen, actions in zip(observations, unit_actions, strict=True):
        total = np.concatenate([np.zeros((1, actions.shape[1])), (2 * actions - 1).cumsum(0)])
        for lag in range(1, min(LONGEST_LAG, len(actions)) + 1):
            change.append(np.abs(seen[lag:] - seen[:-lag]).mean(1))
            length.append(np.abs(total[lag:] - total[:-lag]).max(1))
    x, y = np.concatenate(length), np.concatenate(change)
    is_near = (x > 0) & (x <= 2 * LOOK_STEPS)
    moves = is_near & (y > 0)
    if 0 < moves.sum() < is_near.sum() / 2:
        is_near = moves
    edges = np.quantile(x[is_near], np.linspace(0, 1, 11))
    part = np.digitize(x[is_near], edges[1:-1])
    middle = [np.median(x[is_near][part == k]) for k in range(10) if (part == k).any()]
    median = [np.median(y[is_near][part == k]) for k in range(10) if (part == k).any()]
    slope, offset = np.polyfit(middle, median, 1) if len(middle) > 1 else (0.0, float(median[0]))
    radius = max(0.0, offset) + LOOK_STEPS * max(0.0, slope)
    return float(max(radius, LEAST_RADIUS))  # readings that never move have 0


def find_looks(
    observations: list[Array], unit_actions: list[NDArray[np.float32]], radius: float
) -> list[Labels]:
    """Looks that the logs show, int64 (T+1,) for each.

    An observation that is farther from all looks so far than LOOK_REACH actions makes a new one;
    each belongs to the nearest.

    Args:
        observations: (T+1, D) each, without missing readings.
        unit_actions: (T, A) each, in [0, 1].
        radius: see `look_radius`.
    """
    sight = Sight(observations, unit_actions, radius)
    reach = LOOK_REACH * sight.unit()
    least, look, num_looks = np.full(len(sight.seen), np.inf), np.zeros(len(sight.seen), int), 0
    for step in range(len(sight.seen)):
        if least[step] <= reach:
            continue
        near, away = sight.look_around(step)
        is_nearest = away < least[near]
        least[near[is_nearest]] = away[is_nearest]
        look[near[is_nearest]] = num_looks
        num_looks += 1
    _, look = np.unique(look, return_inverse=True)
    return np.split(look.ravel(), np.cumsum([len(part) for part in observations])[:-1])


class Sight:
    """How far apart what is seen is, counted by how the readings change with actions around there.

    Args: as `find_looks`.
    """

    def __init__(
        self, observations: list[Array], unit_actions: list[NDArray[np.float32]], radius: float
    ) -> None:
        self.seen, self._radius = np.concatenate(observations), radius
        change = np.concatenate([np.diff(seen, axis=0, append=seen[-1:]) for seen in observations])
        self._change = change.clip(-radius, radius)
        asked = [2.0 * actions - 1.0 for actions in unit_actions]
        ended = np.zeros((1, asked[0].shape[1]))
        self._length = np.concatenate([np.append((a**2).mean(1), 0.0) for a in asked])
        self._sum = np.concatenate([np.concatenate([ended, a.cumsum(0)]) for a in asked])
        self._log = np.repeat(np.arange(len(observations)), [len(seen) for seen in observations])

    def look_around(self, step: int) -> tuple[Labels, Array]:
        """Steps (M,) that see something like what is seen at a step, and how far away they are."""
        away = distance(self.seen[step : step + 1], self.seen)[0]
        (near,) = np.nonzero(away <= LOOK_RADII * self._radius)
        return near, self._measure(step, near, away)

    def _measure(self, step: int, others: Labels, away: Array) -> Array:
        """Mahalanobis distances (M,) from a step to others by the changes at the steps around it.

        Those are the ones least `away` (T,) from it by mean absolute difference.
        """
        around = away.argpartition(min(AROUND, len(away)) - 1)[:AROUND]
        spread = self._change[around].T @ self._change[around]
        spread /= max(self._length[around].sum(), 1e-12)
        spread += max(FLAT * spread.trace() / len(spread), 1e-12) * np.eye(len(spread))
        jump = LONGEST_JUMP * self._radius
        offset = (self.seen[others] - self.seen[step]).clip(-jump, jump)
        return np.asarray(np.sqrt((offset * np.linalg.solve(spread, offset.T).T).sum(1)))

    def unit(self) -> float:
        """Median distance of an action, over sights half to twice LOOK_STEPS of them apart."""
        units = [np.empty(0)]
        for step in np.linspace(0, len(self.seen) - 1, NUM_UNITS).astype(np.int64):
            away = distance(self.seen[step : step + 1], self.seen)[0]
            later = np.arange(step + 1, min(step + 1 + LONGEST_LAG, len(self.seen)))
            later = later[self._log[later] == self._log[step]]
            length = np.linalg.norm(self._sum[later] - self._sum[step], axis=1)
            is_near = (length >= LOOK_STEPS / 2) & (length <= 2 * LOOK_STEPS)
            units.append(self._measure(step, later[is_near], away) / length[is_near])
        unit = np.concatenate(units)
        return float(np.median(unit)) if len(unit) else 1.0


def distance(a: Array, b: Array) -> Array:
    """Mean absolute differences between rows, (len(a), len(b))."""
    return cdist(a, b, "cityblock") / a.shape[1]
