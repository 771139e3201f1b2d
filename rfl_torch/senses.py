"""Which readings of an observation to believe, where no node explains all of them.

A sensor that is dead, stuck or hit by an outlier disagrees with every place; the others still agree
with one. Readings that don't fit the place that most of them agree on are taken as missing. Where a
wall was moved, up to half of them don't fit: then only places that the robot may be at are asked.
A sensor that is wrong at one familiar place after the other is broken, and goes missing.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FEW = 0.09
"""Share of the readings that may be wrong wherever the robot is: two of 24. With 0.15 a robot off
its map finds a place that agrees too often: 88 % of independent starts arrive instead of 98 %."""

HALF = 0.5
"""Share that may be wrong where the robot is already thought to be."""

AGREE = 0.5
"""Radii of a look within which the readings that are believed must be, on average."""

DOUBTED = 2.0
"""Radii of a look beyond which a reading does not fit."""

LIKELY = 1e-3
"""Probability of a node from which on the robot may be at it."""

OFTEN, RATE = 0.5, 0.1
"""Share of the familiar sights in which a sensor is wrong that is broken, and how fast the share is
learned."""

FARTHEST = 1e6
"""Ranges of a reading in the log beyond which a number is no reading."""


def sensible(normal: Array) -> Array:
    """Take infinite and absurd numbers for missing readings."""
    return np.where(np.abs(normal) <= FARTHEST, normal, np.nan)


def apart(a: Array, b: Array) -> Array:
    """Mean absolute difference (...) of observations (..., D), over the readings that both have.

    NaN where there is none.
    """
    difference = np.abs(a - b)
    is_there = ~np.isnan(difference)
    num = is_there.sum(-1)
    total = np.where(is_there, difference, 0.0).sum(-1)
    return np.where(num > 0, total / np.maximum(num, 1), np.nan)


def believed(normal: Array, mean: Array, predicted: Array, radius: float) -> tuple[Array, float]:
    """Leave out the readings that don't fit.

    Args:
        normal: normalised observation (D,).
        mean: of the nodes, (N, D).
        predicted: probability of each node before the observation, (N,).
        radius: of a look.

    Returns:
        The observation with NaN for what is not believed, and the share that isn't; the
        observation as it was and 1.0 if it fits no node even so.
    """
    num_readings = int((~np.isnan(normal)).sum())
    difference = np.abs(mean - normal)
    for share, candidates in ((FEW, None), (HALF, np.flatnonzero(predicted > LIKELY))):
        kept = num_readings - int(share * num_readings)
        of = difference if candidates is None else difference[candidates]
        if not (kept and len(of)):
            break
        away = np.partition(of, kept - 1, 1)[:, :kept].mean(1)  # what is missing comes last
        best = int(away.argmin())
        if away[best] <= AGREE * radius:
            node = best if candidates is None else candidates[best]
            is_wrong = difference[node] > DOUBTED * radius
            return np.where(is_wrong, np.nan, normal), float(is_wrong.sum() / num_readings)
    return normal, 1.0


class Sensors:
    """Follows which sensors are wrong wherever the robot is: those are broken, and go missing.

    At most a share FEW of them: a robot that is elsewhere than it believes finds many wrong.

    Args:
        num_readings: D.
    """

    def __init__(self, num_readings: int) -> None:
        self._wrong = np.zeros(num_readings)
        self._most = int(FEW * num_readings)

    def working(self, normal: Array) -> Array:
        """The observation (D,) with NaN for what broken sensors say."""
        if not self._most or self._wrong.max() <= OFTEN:
            return normal
        least = max(OFTEN, np.partition(self._wrong, -self._most - 1)[-self._most - 1])
        return np.where(self._wrong > least, np.nan, normal)

    def note(self, normal: Array, mean: Array, radius: float) -> None:
        """Compare a familiar observation (D,) with the mean of its node, (D,)."""
        difference = np.abs(normal - mean)
        change = RATE * ((difference > DOUBTED * radius) - self._wrong)
        self._wrong += np.where(np.isnan(difference), 0.0, change)
