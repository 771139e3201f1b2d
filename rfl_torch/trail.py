"""What a robot saw where since it was put down, and whether that agrees with a place on the map.

A sight that looks right proves little where corridors look alike. But a belief says where the map
begins in the robot's own count of its steps, and so what each sight on the way here should have
looked like. A belief that many of them speak against isn't taken up because the next sight fits.

It holds where actions add up to positions.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from rfl_torch.senses import apart

Array = NDArray[np.float64]

SPACING = 3.0
"""Full actions between two sights that are kept."""

MOST_SIGHTS = 200
"""That are kept."""

KNOWN, AROUND = 2.0, 6.0
"""Full actions from a node within which the map knows what is to be seen; and within which a node
must look like it, for the robot's count of its steps drifts."""

MOST_NEAR = 12
"""Nodes that are asked what it looks like there at most."""

FEWEST, MOST_AGAINST = 1, 0.1
"""Sights that may speak against a belief in any case, and share of all that the map knows."""

MOVED = 5.0
"""Radii of a look by which what is seen changes if the robot is carried away."""


class Trail:
    """The sights of a robot's way.

    Args:
        positions: of the nodes, in full actions, (N, A).
        means: what they look like, normalised, (N, D).
        edges: between them, (N, N). Where no way is known from one part of a map to another, it
            isn't known how they lie to each other either.
        radius: of a look.
    """

    def __init__(self, positions: Array, means: Array, edges: csr_array, radius: float) -> None:
        self._positions, self._means, self._radius = positions, means, radius
        _, self._part = connected_components(edges, directed=False)
        self._nodes, self._tree = np.empty(0, np.int64), cKDTree(positions[:0])
        self._in_part = -1
        self._place = np.empty((MOST_SIGHTS, positions.shape[1]))
        self._sight = np.empty((MOST_SIGHTS, means.shape[1]))
        self.position = np.zeros(positions.shape[1])
        """Where the robot is, counted from where it was put, in full actions, (A,)."""
        self._last: Array | None = None
        self._is_there = np.ones(means.shape[1], bool)
        self._asked: tuple[Array, bool] | None = None
        self.clear()

    def clear(self) -> None:
        """Forget all sights."""
        self._num = 0
        self._asked = None

    def note(self, moved: Array, normal: Array) -> None:
        """After a move (A,), keep what is seen (D,), if it wasn't seen from there before.

        A robot that suddenly sees something else was moved, so what came before says nothing.
        """
        self.position = self.position + moved
        is_there = ~np.isnan(normal)
        if not is_there.any():
            return
        if (is_there != self._is_there).any():  # a sensor that is found to be broken was before
            self._is_there, self._asked = is_there, None
        if self._last is not None and apart(self._last, normal) > MOVED * self._radius:
            self.clear()
        self._last = normal
        kept = self._place[: min(self._num, MOST_SIGHTS)]
        if len(kept) and np.abs(kept - self.position).max(1).min() < SPACING:
            return
        at = self._num % MOST_SIGHTS
        self._place[at], self._sight[at] = self.position, normal
        self._num, self._asked = self._num + 1, None

    def speaks_against(self, node: int, origin: Array) -> bool:
        """Whether the robot isn't at a node, if the map begins at a position (A,) of its count."""
        if self._part[node] != self._in_part:
            self._in_part, self._asked = self._part[node], None
            self._nodes = np.flatnonzero(self._part == self._in_part)
            self._tree = cKDTree(self._positions[self._nodes])
        if self._asked is None or np.abs(self._asked[0] - origin).max() > 1.0:
            self._asked = origin, self._ask(origin)
        return self._asked[1]

    def _ask(self, origin: Array) -> bool:
        num = min(self._num, MOST_SIGHTS)
        most = min(MOST_NEAR, len(self._nodes))
        away, near = self._tree.query(
            self._place[:num] - origin, np.arange(1, most + 1), distance_upper_bound=AROUND
        )
        is_near = np.isfinite(away)
        looks = self._means[self._nodes[np.where(is_near, near, 0)]]
        sight = np.where(self._is_there, self._sight[:num], np.nan)
        unlike = np.where(is_near, apart(looks, sight[:, None]), np.inf).min(1) / self._radius
        against = int(((away[:, 0] <= KNOWN) & (unlike > 1.0)).sum())
        return against > FEWEST and against > MOST_AGAINST * (against + int((unlike <= 1.0).sum()))
