"""Where a map ends: directions that lead off it, and how much could be seen to lie there.

Where actions add up to positions, a direction is open at a node if the way looks free and leads to
where no node is. What the nodes see beyond is cut into cells, and those without a node are what a
walk from there promises.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rfl_torch.explorer import CELL
from rfl_torch.free_ways import ways
from rfl_torch.innate import nearest_direction
from rfl_torch.places import NODE_STEPS
from rfl_torch.search import HOLD

if TYPE_CHECKING:
    from rfl_torch.agent import Agent

AHEAD = 8.0
"""Full actions ahead of a node, along a way that looks free, where no node is: a frontier."""

IN_SIGHT = 30.0
"""Full actions along a way up to which it is trusted to be free."""

PROMISED = 15.0
"""Full actions around the end of an open way within which unknown cells count for it."""


def untried(agent: "Agent") -> NDArray[np.bool_]:
    """Actions at each node that lead to no node that is known, (N, K).

    Where actions add up to positions, those that look free, lead to where no node is, and were not
    done there for long. Else, or if there are none, those never done that lead to no neighbour.
    """
    if agent.positions is not None and agent.free_ways is not None:
        ahead = agent.positions[:, None] + AHEAD * ways(agent.positions.shape[1])
        away, _ = cKDTree(agent.positions).query(ahead)
        is_open = (away > NODE_STEPS) & (_free(agent) > AHEAD) & (agent.tried < HOLD)
        if is_open.any():
            return np.asarray(is_open)
    graph = agent.graph.tocoo()
    way, _ = nearest_direction(agent.ask(graph.row, graph.col))
    known = agent.tried > 0
    known[graph.row, way] = True
    return ~known


def promise(agent: "Agent", is_open: NDArray[np.bool_]) -> NDArray[np.float64]:
    """What a visit promises at each node: cells that are in sight and have no node, (N,).

    Where actions don't add up to positions, the number of its open directions.

    Args:
        agent: whose map it is.
        is_open: directions at each node, (N, K).
    """
    if agent.positions is None or agent.free_ways is None:
        return is_open.sum(1).astype(np.float64)
    position, along = agent.positions, ways(agent.positions.shape[1])
    free, nodes = _free(agent), cKDTree(agent.positions)
    reach = np.arange(AHEAD, IN_SIGHT, CELL)
    node, way, step = np.nonzero(free[:, :, None] > reach + 1.0)
    point = position[node] + reach[step, None] * along[way]
    away, _ = nodes.query(point, distance_upper_bound=NODE_STEPS)
    unknown = np.unique(np.round(point[np.isinf(away)] / CELL), axis=0) * CELL
    node, way = np.nonzero(is_open)
    promised = np.zeros(len(position))
    if len(node) and len(unknown):
        ends = position[node] + AHEAD * along[way]
        around = cKDTree(unknown).query_ball_point(ends, PROMISED, return_length=True)
        np.maximum.at(promised, node, around)
    return promised


def _free(agent: "Agent") -> NDArray[np.float64]:
    """Full actions that look free along each of the ways at each node, (N, W)."""
    assert agent.free_ways is not None
    return agent.free_ways.at(agent.hmm.emission_mean.detach().numpy())
