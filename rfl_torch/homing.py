"""Going on to a goal that is a sight: to where it looks just like it, or else to the next place.

A node is as large as what looks alike, and what the logs saw near a goal can be less like it than
what they saw elsewhere, as where a ray just misses a corner. So the robot goes from the middle of a
node on to the sight itself, and tries another place where that can't be seen.

    o_i + (y - p_i) G_i    what is seen at y around node i: G_i regressed on the nodes around it

That leads to within some steps of the goal, not always there: where a ray slips past a corner what
is seen jumps. How unlike the goal it is falls towards it all the same, so the last steps are tried
one dimension and one way at a time (a pattern search, Hooke and Jeeves 1961).
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rfl_torch.explorer import LEAST_CHANGE, NOISE_MARGIN
from rfl_torch.looks import LOOK_STEPS
from rfl_torch.places import PLACE_STEPS
from rfl_torch.senses import apart

if TYPE_CHECKING:
    from rfl_torch.agent import Agent

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

SAME_SIGHT = 0.1
"""Radii of a look by which what was seen at other places may differ more from a goal than what is
most like it. A corridor and its twin, 0.2 to 1 apart, are told apart so; identical bays are not."""

PLACES = 3
"""That are tried. The first is right for 90 to 92 % of the places of a large hall, three for 96."""

APPROACH = 60
"""Steps at a place until it is left for the next."""

HOPE = 2.5
"""Radii of a look that what the logs saw elsewhere may be from the goal, to be tried."""

STUCK, CLOSER = 6, 0.02
"""Steps in a row that lead no closer, by so many radii of a look, after which steps are tried."""

SIZES = (1.0, 0.5)
"""Full actions of the steps that are tried, one size after the other."""

JUST_LIKE = 0.5 / LOOK_STEPS
"""Radii of a look from the goal within which the robot is there: half a full action."""

BACK = 0.1
"""Full actions from where it was best up to which it is back there."""

TWIN = 0.35
"""Radii of a look from the goal up to which places that are about as like it are tried as one, the
nearest first. What is less like it is like it by chance."""

AROUND = 6.0
"""Full actions from a node to those that tell most of what is seen around it."""

RIDGE = 1e-4
"""Of a move, against changes of the readings by a share of their range each."""


class Place(NamedTuple):
    """Where the logs saw something like a goal.

    nodes: there and wherever it is as like, that most like it first.
    away: radii of a look from the goal.
    """

    nodes: Labels
    away: float


class Homing:
    """Goes to what looks just like a goal, place by place.

    Args:
        agent: whose map it is.
        sight: normalised readings of the goal, (D,).
        places: that most like it first.
    """

    def __init__(self, agent: "Agent", sight: Array, places: list[Place]) -> None:
        self._agent, self._sight, self._places = agent, sight, places
        still = 0.0 if agent.free_ways is None else agent.free_ways.still
        self._noise = NOISE_MARGIN * still
        self._enough = max(JUST_LIKE, self._noise / agent.look_radius)
        self._closest: list[float] = []
        self._is_last = False
        self.is_there = False
        self._go_to(0)

    def _go_to(self, place: int) -> None:
        self.nodes: Labels = self._places[place].nodes
        self._left, self._least, self._since = APPROACH, np.inf, 0
        self._probes: Probes | None = None
        self._seen, self._did = self._sight, np.zeros(len(self._agent.actions.rest))
        self._off = self._did
        """From where it was most like the goal, in full actions, by dead reckoning, (A,)."""

    @property
    def has_begun(self) -> bool:
        """Whether the robot came to the place; its belief counts no more then.

        Between sights of the logs there are some that no node explains, or another node does.
        """
        return bool(np.isfinite(self._least))

    def act(self, normal: Array, node: int) -> NDArray[np.float32] | None:
        """Return the action of this step, (A,); None if it `is_there`, or `nodes` are others now.

        They are none if no place is left.

        Args:
            normal: what is seen, (D,).
            node: where the robot is.
        """
        away = float(apart(normal, self._sight)) / self._agent.look_radius
        is_closer = away < self._least - CLOSER
        self._off = np.zeros_like(self._off) if is_closer else self._off + self._moved(normal)
        self._since = 0 if is_closer else self._since + 1
        self._least = away if is_closer else self._least
        if self._probes is None and self._since >= STUCK:
            self._probes = Probes(len(self._off))
        step = None if self._probes is None else self._probes.next(self._off, is_closer)
        is_over = self._left == 0 or (self._probes is not None and step is None)
        self.is_there = away <= self._enough or (is_over and self._is_last)
        if self.is_there:
            return None
        if is_over:
            self._leave()
            return None
        self._left -= 1
        if step is None:
            action = self._agent.control_to_sight(normal, node, self._sight)
        else:
            action = self._agent.actions.of_move(step)
        self._seen = normal
        self._did = self._agent.actions.to_move(action)
        return action

    def _moved(self, normal: Array) -> Array:
        """How far the last step went, in full actions, (A,): not at all if nothing changed."""
        usual = float(np.abs(self._did).max()) * self._agent.look_radius / LOOK_STEPS
        is_still = apart(normal, self._seen) < self._noise + LEAST_CHANGE * usual
        return np.zeros_like(self._did) if is_still else self._did

    def _leave(self) -> None:
        """Take the next place that may be more like the goal than those that were tried.

        If there is none, that which was most like it, if it was at all.
        """
        self._closest.append(self._least)
        num, best = len(self._closest), int(np.argmin(self._closest))
        least = self._closest[best]
        if num < len(self._places) and self._places[num].away <= HOPE:
            self._go_to(num)
        elif least <= 1.0:
            self._is_last = True
            self._enough = max(self._enough, least)
            self._go_to(best)
        else:
            self.nodes = np.empty(0, np.int64)


class Probes:
    """Tries steps from where it was best: on where one leads closer, else back and another way.

    Args:
        dim: A.
    """

    def __init__(self, dim: int) -> None:
        self._ways = np.concatenate([np.eye(dim), -np.eye(dim)])
        self._sizes = list(SIZES)
        self._way, self._num_failed = -1, -1

    def next(self, off: Array, is_closer: bool) -> Array | None:
        """Return the next step, in full actions, (A,); None once none leads closer.

        Args:
            off: from where it was best, in full actions, (A,).
            is_closer: whether it is better here than ever before.
        """
        if is_closer:
            self._num_failed = 0
        elif np.abs(off).max() > BACK:
            return -off.clip(-1.0, 1.0)
        else:
            self._way = (self._way + 1) % len(self._ways)
            self._num_failed += 1
        if self._num_failed == len(self._ways):
            self._num_failed = 0
            self._sizes.pop(0)
        return self._sizes[0] * self._ways[self._way] if self._sizes else None


def places_like(
    seen: NDArray[np.floating], node: Labels, positions: Array, sight: Array, radius: float
) -> list[Place]:
    """The places where the logs saw what is most like a sight, the likeliest first.

    Args:
        seen: what the logs saw, (M, D).
        node: at which of the nodes, (M,).
        positions: of the nodes, in full actions, (N, A).
        sight: (D,), NaN for what is missing.
        radius: of a look.
    """
    away = np.nanmean(np.abs(seen - sight), 1) / radius
    places: list[Place] = []
    while len(places) < PLACES and np.isfinite(away.min()):
        first = node[away.argmin()]
        same = min(SAME_SIGHT, TWIN - away.min())
        alike = np.setdiff1d(node[away <= away.min() + same], first)
        nodes = np.append(first, alike)
        places.append(Place(nodes, float(away.min())))
        apart_from = np.linalg.norm(positions[:, None] - positions[nodes], axis=2).min(1)
        away[apart_from[node] < PLACE_STEPS] = np.inf
    return places


def move_to_sight(miss: Array, means: Array, positions: Array) -> Array:
    """The move, in full actions, (A,), after which what is missing is seen, as far as there is one.

    Args:
        miss: of the readings, (D,); NaN where a reading is missing.
        means: of the nodes around, less that of the robot's node, (K, D).
        positions: of the nodes around from the robot's node, in full actions, (K, A).
    """
    weight = np.exp(-0.5 * (positions**2).sum(1, keepdims=True) / AROUND**2)
    dim = positions.shape[1]
    gain = np.linalg.solve(
        positions.T @ (weight * positions) + np.eye(dim), positions.T @ (weight * means)
    )
    there = ~np.isnan(miss)
    gain = gain[:, there]
    return np.asarray(np.linalg.solve(gain @ gain.T + RIDGE * np.eye(dim), gain @ miss[there]))
