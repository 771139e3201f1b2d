"""Where on the map a robot is, by what it did: dead reckoning from node to node.

What is seen tells most. But halfway along a hall nothing that is seen changes with a move, and many
nodes look the same. There the robot's own actions tell how far it has come, and which way to go on:

    b_i     belief      probability that the robot is at node i
    x_i     where       its position then, in full actions
    p_i     positions   where node i is on the track of the logs

A move u takes the robot from i to what lies around: b'_j = sum_i b_i w_ij, with w_ij falling as
|x_i + u - p_j| grows. Where the robot then is, is kept along, so many small moves add up.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import csr_array

from rfl_torch.places import NODE_STEPS, within

Array = NDArray[np.float64]

WIDTH = 1.0
"""Full actions by which a robot is off the middle of its node (standard deviation)."""

SLIP = 0.0005
"""Chance a step that the robot did not do what it was told, and went as robots go on this map."""

LEAST_BELIEF = 1e-6
"""Of a node, for its share to be pushed on."""

ANYWHERE = 1e-9
"""Belief up to which a node is taken to be at its middle: a robot that was put there can be."""

STEPS_ON = 2
"""Edges that one move takes a robot over at most."""


class Reckoning:
    """Pushes a belief along with the robot's moves.

    Args:
        positions: of the nodes, in full actions, (N, A).
        edges: how often the logs took each, (N, N).
        slipping: transitions of the map, transposed, (N, N).
    """

    def __init__(self, positions: Array, edges: csr_array, slipping: csr_array) -> None:
        self.positions, self._slipping = positions, slipping
        near = within(edges, STEPS_ON)
        self._first, self._around = near.indptr.astype(np.int64), near.indices.astype(np.int64)

    def push(self, belief: Array, where: Array, move: Array) -> tuple[Array, Array]:
        """The belief (N,) and where the robot is at each node, (N, A), after a move (A,)."""
        slipped = SLIP * (self._slipping @ belief)
        pushed, came = _push(belief, where + move, self.positions, self._first, self._around)
        pushed, came = (1 - SLIP) * pushed + slipped, (1 - SLIP) * came
        came += (slipped[:, None] + ANYWHERE) * self.positions
        came /= pushed[:, None] + ANYWHERE
        # One against a wall moves in vain: it stays within its node.
        half = NODE_STEPS / 2
        return pushed, np.clip(came, self.positions - half, self.positions + half)


@njit(cache=True)
def _push(  # type: ignore[no-untyped-def]
    belief: Array,
    came: Array,
    positions: Array,
    first: NDArray[np.int64],
    around: NDArray[np.int64],
):
    """Shares of the belief that each node gets, (N,), and the sums of where they are, (N, A)."""
    num_nodes, dim = positions.shape
    pushed, total = np.zeros(num_nodes), np.zeros((num_nodes, dim))
    share = np.empty(num_nodes)
    for source in range(num_nodes):
        if belief[source] <= LEAST_BELIEF:
            continue
        begin, end = first[source], first[source + 1]
        least = np.inf
        for k in range(begin, end):
            away = 0.0
            for axis in range(dim):
                away += (positions[around[k], axis] - came[source, axis]) ** 2
            share[k - begin] = away
            least = min(least, away)
        whole = 0.0
        for k in range(end - begin):
            share[k] = math.exp((least - share[k]) / (2 * WIDTH**2))
            whole += share[k]
        for k in range(begin, end):
            part = belief[source] * share[k - begin] / whole
            pushed[around[k]] += part
            for axis in range(dim):
                total[around[k], axis] += part * came[source, axis]
    return pushed, total


def mend(action: Array, asked: Array, way: Array) -> Array:
    """What to do (A,), in full actions, where a controller leaves out part of the way.

    Args:
        action: what the controller asks for, in full actions.
        asked: and from the middle of the node where the robot is.
        way: to the next node, by dead reckoning.
    """
    is_left_out = (np.abs(way) > 1.0) & (asked * np.sign(way) < 0.5 * np.abs(way))
    return np.where(is_left_out, way, action)
