"""Which ways are blocked where the robot stands, by what is seen: learned from the logs' stops.

Halfway along a hall a step doesn't show, and one against a wall doesn't either. But who stands
before a wall reads what it never reads elsewhere, as one of a rangefinder's rays does at its
shortest. A threshold on one reading carries over to places that no log saw; a function of them all
is less right there.

Where a log never came up to a wall in a direction, the reading that points there says how far the
way goes on.

A direction is one end of a dimension of the actions: 2 a the low one, 2 a + 1 the high one.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rfl_torch.free_ways import FreeWays, ways

Array = NDArray[np.float64]

ASKED = 0.5
"""Full actions in a direction from which on a step tells whether the way was free."""

STOPPED = 0.3
"""Share of what was asked for up to which a step was stopped."""

FEWEST = 10
"""Stopped steps that tell what it looks like."""

MOST_WRONG = 0.05
"""Steps that a threshold may tell wrongly, as a share of those that were stopped."""

LEAST_FREE = 1.0
"""Full actions that a way must be free for where no log came up to a wall: what the reading says of
so little is not right to a half, and who takes a wall for a free way counts on into it."""


class Contact(NamedTuple):
    """What the logs say of blocked ways.

    threshold: of each reading for each direction, (2 A, D).
    side: -1 where the way is blocked at or below it, 1 where it is at or above, 0 where the reading
        doesn't tell, (2 A, D).
    """

    threshold: Array
    side: Array

    @classmethod
    def unknown(cls, action_dim: int, obs_dim: int) -> "Contact":
        """What logs say in which nothing was ever in the way."""
        return cls(*np.zeros((2, 2 * action_dim, obs_dim)))

    def is_blocked(self, direction: int, normal: Array) -> bool | None:
        """Whether the way is blocked where `normal` (D,) is seen; None if that isn't clear."""
        tells = self.side[direction] != 0
        beyond = self.side[direction] * (normal - self.threshold[direction]) >= 0
        says = beyond[tells]
        if not len(says) or (says.any() and not says.all()):
            return None
        return bool(says[0])

    def completed(self, free_ways: FreeWays) -> "Contact":
        """With directions of which nothing is known by the readings that point along them."""
        threshold, side = self.threshold.copy(), self.side.copy()
        along = ways(len(side) // 2)
        for direction in np.flatnonzero(~side.any(1)):
            (way,) = np.flatnonzero(along[:, direction // 2] == 2.0 * (direction % 2) - 1.0)
            if free_ways.carries_over[way]:
                reading = free_ways.weight[:-1, way].argmax()
                over = LEAST_FREE - free_ways.weight[-1, way]
                threshold[direction, reading] = over / free_ways.weight[reading, way]
                side[direction, reading] = -1.0
        return Contact(threshold, side)


def learn_contact(
    observations: list[Array], shifts: list[Array], unit_actions: list[NDArray[np.float32]]
) -> Contact:
    """Find the readings that tell stopped steps from free ones.

    Args:
        observations: (T+1, D) for each log, without missing readings.
        shifts: how far each step went, in full actions, (T, A) each.
        unit_actions: (T, A) each, in [0, 1].
    """
    seen = np.concatenate([part[:-1] for part in observations])
    moved = np.concatenate(shifts)
    asked = 2.0 * np.concatenate(unit_actions).astype(np.float64) - 1.0
    contact = Contact.unknown(moved.shape[1], seen.shape[1])
    for direction in range(len(contact.side)):
        axis, sign = direction // 2, 2.0 * (direction % 2) - 1.0
        (steps,) = np.nonzero(sign * asked[:, axis] >= ASKED)
        is_stopped = moved[steps, axis] / asked[steps, axis] < STOPPED
        if is_stopped.sum() < FEWEST or is_stopped.all():
            continue
        for reading, values in enumerate(seen[steps].T):
            for side in (-1.0, 1.0):
                threshold, wrong = _best_threshold(-side * values, is_stopped)
                if wrong <= MOST_WRONG * is_stopped.sum():
                    contact.threshold[direction, reading] = -side * threshold
                    contact.side[direction, reading] = side
    return contact


def _best_threshold(values: Array, is_stopped: NDArray[np.bool_]) -> tuple[float, int]:
    """Value up to which steps (T,) are best taken as stopped, and how many of them aren't so."""
    order = values.argsort(kind="stable")
    stopped = is_stopped[order].cumsum()
    wrong = np.arange(1, len(order) + 1) - 2 * stopped + stopped[-1]
    last = int(wrong[:-1].argmin())
    return float(values[order[last : last + 2]].mean()), int(wrong[last])
