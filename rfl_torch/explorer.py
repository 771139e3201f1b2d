"""Go to where nothing was seen yet, by ways that look free: for a robot that is off its map.

It holds where actions add up to positions. The robot counts its steps, notes on a lattice of cells
what looks free and what doesn't, and goes to the nearest cell of which it knows nothing.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from rfl_torch.contact import Contact
from rfl_torch.free_ways import FreeWays, ways
from rfl_torch.looks import LOOK_STEPS

Array = NDArray[np.float64]

CELL = 4.0
"""Full actions from end to end of a cell."""

BEYOND, BLIND = 5.0, 2.0
"""Radii of a look by which the readings, on average, may be beyond all that the logs read, and full
actions that each way that no one reading tells is taken to be free if they are: of a hall, a log
from a corridor's end can't tell how far its ways go."""

BLOCKED_COST = 20.0
"""Cells that a detour may take rather than through one that is surely blocked. At 6 a robot probes
walls for most of its time."""

UNSEEN = 0.3
"""Sights that what is known of a cell beforehand counts as, each for free and for blocked."""

BUMP = 3.0
"""And a wall that was run into."""

WIDE, FINE = 3, 1
"""Cells from all that were entered for a cell to be new: to a robot that is lost, and to one that
completes its map. To comb rooms whose every corner can be seen finds no map."""

PLAN_STEPS, CELL_STEPS = 12, 12
"""Steps between two plans, and until the next cell counts as out of reach."""

LEAST_CHANGE = 0.12
"""Share of a full action's usual change of the readings by which the robot has moved: along a
corridor few of them change."""

NOISE_SHARE, NOISE_MARGIN = 0.25, 1.2
"""Share of that change, a step, that noise may be for motion to be told from rest, and factor on
the noise."""

MOST_LAG = 8
"""Steps over which the change is measured at most."""

MARGIN = 16
"""Cells of which nothing is known that the lattice has on each side."""

KNOWN_REACH = 200.0
"""Full actions from the robot within which known places are taken note of, for memory's sake."""

MOST_CELLS = 1_000_000
"""Of the lattice. A robot that has come farther begins anew."""


class _Run(NamedTuple):
    """Steps in one direction, until it is known whether they moved the robot."""

    towards: tuple[int, bool]
    seen: Array
    """Before the first one, (D,)."""
    position: Array
    num_steps: int


class Explorer:
    """Goes to the nearest cell of which nothing is known yet, by ways that look free.

    It counts its steps: where it is, is the sum of the actions that moved it. It takes one
    dimension of the actions at a time, for along a wall a slanted one moves in part, which is hard
    to see.

    Args:
        low, high: bounds of the action space, (A,).
        radius: of a look, see `looks.look_radius`.
        free_ways: what the logs say of free ways.
        contact: what they say of blocked ones.
        seed: decides where no cell is left.
        gap: cells from all that were entered for a cell to be new, WIDE or FINE.
    """

    def __init__(
        self,
        low: NDArray[np.float32],
        high: NDArray[np.float32],
        radius: float,
        free_ways: FreeWays,
        contact: Contact,
        seed: int,
        gap: int = WIDE,
    ) -> None:
        self._low, self._high = low, high
        self._free_ways, self._contact = free_ways, contact
        self._rng = np.random.default_rng(seed)
        self._ways, self._wall_within = ways(len(low)), free_ways.wall_within
        self._most_beyond = BEYOND * radius
        unit = radius / LOOK_STEPS
        self._lag = int(np.clip(np.ceil(free_ways.still / (NOISE_SHARE * unit)), 1, MOST_LAG))
        self._least = NOISE_MARGIN * free_ways.still + LEAST_CHANGE * unit * self._lag
        self.position = np.zeros(len(low))
        """By dead reckoning from the first step, in full actions, (A,)."""
        self._cells = Cells(len(low), gap)
        self._path: list[NDArray[np.int64]] = []
        self._plan_left = self._cell_left = 0
        self._did: Array | None = None
        self._jammed = -1
        self._seen = np.empty(0)
        self._run: _Run | None = None

    @property
    def cells_to_new(self) -> int:
        """Cells on the way to the nearest one of which nothing is known; 0 if there is none."""
        return len(self._path)

    def know(self, positions: Array) -> None:
        """Take places (N, A), counted in full actions from here, for known: none is new."""
        near = positions[np.abs(positions).max(1) <= KNOWN_REACH]
        for cell in np.unique(_cell(self.position + near), axis=0):
            self._cells.enter(cell)

    def act(self, normal: Array) -> NDArray[np.float32]:
        """Return the action of this step, (A,), at a normalised observation (D,)."""
        self._follow(normal)
        here = _cell(self.position)
        while self._path and (self._path[0] == here).all():
            self._path.pop(0)
            self._cell_left = CELL_STEPS
        if self._path and self._cell_left == 0:
            self._bump(here)
        if not self._path or self._plan_left == 0:
            self._path = self._cells.way_to_new(here)
            self._plan_left, self._cell_left = PLAN_STEPS, CELL_STEPS
        self._plan_left -= 1
        self._cell_left -= 1
        self._did = self._step_to(self._path[0]) if self._path else self._any_step()
        share = (self._did + 1) / 2
        return (self._low + share * (self._high - self._low)).astype(np.float32)

    def watch(self, normal: Array, did: Array) -> None:
        """Count a step that is not its own.

        Args:
            normal: what is seen before it, (D,).
            did: in full actions, (A,).
        """
        self._follow(normal)
        self._did, self._path = did, []

    def _follow(self, normal: Array) -> None:
        """Count the last step, if it moved the robot, and look around in a new cell."""
        last = np.full_like(normal, 0.5) if self._did is None else self._seen
        normal = np.where(np.isnan(normal), last, normal)
        if self._did is not None:
            self._count(normal, self._did)
        self._seen = normal
        if self._cells.enter(_cell(self.position)) or self._did is None:
            self._look_around(normal)

    def _count(self, normal: Array, did: Array) -> None:
        """Add a step to the position, if what was seen before it says so; else if it shows.

        Where that takes several steps, the last ones are taken back if nothing changed by them.
        """
        axis = int(np.abs(did).argmax())
        towards = (axis, bool(did[axis] > 0))
        is_blocked = self._contact.is_blocked(2 * axis + towards[1], self._seen)
        if is_blocked is not None:
            self._run = None
            self._take_note(axis, is_blocked)
            if not is_blocked:
                self.position = self.position + did
            return
        if self._run is None or self._run.towards != towards:
            self._run = _Run(towards, self._seen, self.position, 0)
        run = self._run._replace(num_steps=self._run.num_steps + 1)
        self.position, self._run = self.position + did, run
        if run.num_steps < self._lag:
            return
        self._run = None
        share = min(1.0, float(np.abs(self.position - run.position).max()) / self._lag)
        is_blocked = bool(np.abs(normal - run.seen).mean() <= self._least * share)
        if is_blocked:
            self.position = run.position
        self._take_note(axis, is_blocked)

    def _take_note(self, axis: int, is_blocked: bool) -> None:
        """A step along a dimension was stopped, or not; twice in a row the next cell is closed."""
        if not is_blocked:
            self._jammed = -1 if self._jammed == axis else self._jammed
            return
        if self._jammed == axis and self._path:
            self._bump(_cell(self.position))
        self._jammed = axis

    def _look_around(self, normal: Array) -> None:
        """Take note of the cells that look free, and of those behind."""
        lengths = self._free_ways.at(normal)
        if np.abs(normal - normal.clip(0.0, 1.0)).mean() > self._most_beyond:
            lengths = np.where(self._free_ways.carries_over, lengths, BLIND)
        free, blocked = [], []
        for way, length, most in zip(self._ways, lengths, self._wall_within, strict=True):
            free.append(self._along(way, 1.0, max(length - 1.0, 1.01)))
            if length < most:
                blocked.append(self._along(way, length + 1.0, length + 1.0 + CELL))
        self._cells.see(np.concatenate(free), np.concatenate(blocked or [free[0][:0]]))

    def _along(self, way: Array, begin: float, end: float) -> NDArray[np.int64]:
        """Cells along a way from here, from one distance to another, (C, A)."""
        return _cell(self.position + way * np.arange(begin, end, CELL / 2)[:, None])

    def _bump(self, here: NDArray[np.int64]) -> None:
        """The next cell can't be entered from this one."""
        self._cells.close(here, self._path[0])
        self._path = []

    def _step_to(self, cell: NDArray[np.int64]) -> Array:
        """Towards the middle of a cell in one dimension, the farthest that isn't jammed, (A,)."""
        away = cell * CELL - self.position
        order = np.abs(away)
        if self._jammed >= 0 and (np.delete(order, self._jammed) > 0.3).any():
            order[self._jammed] = 0.0
        axis = int(order.argmax())
        step = np.zeros_like(away)
        step[axis] = np.clip(away[axis], -1.0, 1.0)
        return step

    def _any_step(self) -> Array:
        step = np.zeros(len(self._low))
        step[self._rng.integers(len(step))] = self._rng.choice([-1.0, 1.0])
        return step


def _cell(position: Array) -> NDArray[np.int64]:
    """Cells (..., A) that positions (..., A) are in."""
    return np.round(position / CELL).astype(np.int64)


class Cells:
    """What is known of the cells around: a lattice that grows as the robot goes.

    Args:
        dim: A.
        gap: cells from all that were entered for a cell to be new.
    """

    def __init__(self, dim: int, gap: int) -> None:
        self._gap = gap
        self._begin(np.zeros(dim, np.int64))

    def _begin(self, here: NDArray[np.int64]) -> None:
        """Know nothing but a lattice around a cell (A,)."""
        dim = len(here)
        self._corner = here - MARGIN
        shape = (2 * MARGIN + 1,) * dim
        self._free, self._blocked = np.zeros(shape), np.zeros(shape)
        self._entered, self._old = np.zeros(shape, bool), np.zeros(shape, bool)
        self._closed = np.zeros((2 * dim, *shape), bool)
        """Whether a cell can't be left towards either end of each dimension."""

    def enter(self, cell: NDArray[np.int64]) -> bool:
        """Take note that the robot is in a cell (A,); returns whether it never was before."""
        if self._free.size > MOST_CELLS:
            self._begin(cell)
        self._hold(cell)
        at = tuple(cell - self._corner)
        if self._entered[at]:
            return False
        self._entered[at] = True
        self._old[tuple(slice(k - self._gap, k + self._gap + 1) for k in at)] = True
        return True

    def see(self, free: NDArray[np.int64], blocked: NDArray[np.int64]) -> None:
        """Count one sight of cells (C, A) that look free, and of others; who is both is free."""
        for cells in (free, blocked):
            if len(cells):
                self._hold(cells.min(0))
                self._hold(cells.max(0))
        is_free = self._mask(free)
        self._free += is_free
        self._blocked += self._mask(blocked) & ~is_free

    def close(self, here: NDArray[np.int64], ahead: NDArray[np.int64]) -> None:
        """A cell (A,) can't be entered from its neighbour."""
        axis = int(np.abs(ahead - here).argmax())
        self._hold(ahead)
        self._closed[(2 * axis + int(ahead[axis] > here[axis]), *(here - self._corner))] = True
        self._blocked[tuple(ahead - self._corner)] += BUMP

    def way_to_new(self, here: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Cells on the cheapest way to one of which nothing is known; else to any not entered.

        [] if there is none, and closed ways are open again.
        """
        cost, before = self._costs(here)
        is_known = (self._free > 0) | (self._blocked > 0)
        beside = np.ones((3,) * len(here), bool)
        is_border = binary_dilation(~is_known, beside, border_value=1)
        for is_goal in (is_border & ~self._old, ~self._entered):
            reached = np.where(is_goal.ravel(), cost, np.inf)
            cell = int(reached.argmin())
            if np.isfinite(reached[cell]):
                break
        else:
            self._closed[:] = False
            return []
        path = []
        while before[cell] >= 0:
            path.append(np.array(np.unravel_index(cell, self._free.shape)) + self._corner)
            cell = before[cell]
        return path[::-1]

    def _costs(self, here: NDArray[np.int64]) -> tuple[Array, NDArray[np.int32]]:
        """Of the cheapest way to every cell, and the cell before it, flat."""
        share = (self._blocked + UNSEEN) / (self._free + self._blocked + 2 * UNSEEN)
        through = np.where(self._entered, 1.0, 1.0 + BLOCKED_COST * share**2).ravel()
        number = np.arange(through.size).reshape(self._free.shape)
        source, target = [], []
        for axis in range(number.ndim):
            low, high = (np.delete(number, end, axis).ravel() for end in (-1, 0))
            down, up = (self._closed[2 * axis + end].ravel() for end in (0, 1))
            source += [high[~down[high]], low[~up[low]]]
            target += [low[~down[high]], high[~up[low]]]
        pair = (np.concatenate(source), np.concatenate(target))
        graph = csr_array((through[pair[1]], pair), shape=(through.size,) * 2)
        start = int(number[tuple(here - self._corner)])
        cost, before = dijkstra(graph, indices=start, return_predecessors=True)
        return cost, before

    def _mask(self, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
        mask = np.zeros(self._free.shape, bool)
        mask[tuple((cells - self._corner).T)] = True
        return mask

    def _hold(self, cell: NDArray[np.int64]) -> None:
        """Grow until a cell (A,) has a margin around it."""
        at, shape = cell - self._corner, np.array(self._free.shape)
        before = np.where(at < self._gap, MARGIN - at, 0).clip(0)
        after = np.where(at >= shape - self._gap, at + MARGIN + 1 - shape, 0).clip(0)
        if not (before.any() or after.any()):
            return
        sides = list(zip(before.tolist(), after.tolist(), strict=True))
        self._corner = self._corner - before
        self._free, self._blocked = np.pad(self._free, sides), np.pad(self._blocked, sides)
        self._entered, self._old = np.pad(self._entered, sides), np.pad(self._old, sides)
        self._closed = np.pad(self._closed, [(0, 0), *sides])
