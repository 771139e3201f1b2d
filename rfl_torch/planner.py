"""Paths over the learned graph (section 2.5).

Two planners with one result: `reachability_path` is the paper's, which propagates "can be reached"
over transitions above epsilon and takes the first path; `Navigator` holds the cheapest cost from
every node to a goal, so that each control step can look its next node up.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra
from scipy.spatial import cKDTree

ALIKE = 1.0
"""Nats of separation under which two nodes look alike."""

MOST_PAIRS = 100_000_000
"""Pairs of nodes that may look alike: 16 bytes each."""

PAIRS_AT_ONCE = 100_000
"""Pairs of nodes compared in one go: their readings take tens of megabytes."""

UNTRIED, REVERSED = 2.5, 10.0
"""Factors of an edge only ever taken the other way, in a reversible world and in another."""


def threshold_graph(transition: NDArray[np.float64], epsilon: float) -> csr_array:
    """Edges whose probability is above `epsilon`, at cost 1, without self loops; (N, N)."""
    adjacency = (transition > epsilon).astype(np.float64)
    np.fill_diagonal(adjacency, 0.0)
    return csr_array(adjacency)


def seen_edges(count: csr_array, is_reversible: bool) -> csr_array:
    """Cost factors of the edges that were taken, or taken the other way round; (N, N) from counts.

    An edge counts 1 and the more the rarer it was taken. One that was taken in the other direction
    only may be passable too: in a world found reversible it counts UNTRIED, else REVERSED, and is
    tried where nothing else leads on.
    """
    taken = count.astype(np.float64).tocoo()
    is_edge = (taken.data > 0) & (taken.row != taken.col)
    row, column = taken.row[is_edge], taken.col[is_edge]
    cost = csr_array((1.0 + 1.0 / taken.data[is_edge], (row, column)), shape=count.shape)
    backward = csr_array((np.ones(len(row)), (column, row)), shape=count.shape)
    untried = backward - backward.multiply(cost > 0)
    return csr_array(cost + (UNTRIED if is_reversible else REVERSED) * untried)


def look_alikes(
    mean: NDArray[np.float64], scale: NDArray[np.float64], power: float, most: float = ALIKE
) -> csr_array:
    """Pairs of nodes that their emissions can't tell apart, bool (N, N) without the diagonal.

    Not by more than `most` nats, that is.

    A log laid out on a grid can run over one place on two sheets. The sheets' nodes look alike,
    and a robot that is at one is at the other. So are truly different places that look the same:
    which it is shows when the plan over such a pair works out, or doesn't.
    """
    # No scale is above its reading's widest: pairs outside of this ball are told apart for sure.
    widest = np.sqrt(2.0) * scale.max(0)
    radius = np.sqrt(most / (0.5 * power)) * (1 + 1e-9)
    tree = cKDTree(mean / widest)
    count = int(tree.count_neighbors(tree, radius))
    if count > MOST_PAIRS:
        raise ValueError(
            f"{count} pairs of the {len(mean)} nodes look alike, needs at most {MOST_PAIRS}; the "
            "readings tell almost no places apart: try other ones, or fewer nodes."
        )
    pairs = tree.query_pairs(radius, output_type="ndarray")
    is_alike = np.zeros(len(pairs), bool)
    for start in range(0, len(pairs), PAIRS_AT_ONCE):
        i, j = pairs[start : start + PAIRS_AT_ONCE].T
        distance = (mean[i] - mean[j]) ** 2 / (scale[i] ** 2 + scale[j] ** 2)
        is_alike[start : start + PAIRS_AT_ONCE] = 0.5 * power * distance.sum(1) < most
    i, j = pairs[is_alike].T
    both = (np.concatenate([i, j]), np.concatenate([j, i]))
    return csr_array((np.ones(len(both[0]), bool), both), shape=(len(mean), len(mean)))


def reachability_path(graph: csr_array, start: int, goal: int) -> list[int]:
    """The paper's plan: nodes from start to goal over the fewest edges, [] if there is no way.

    Propagating ones and backtracking, as steps 2-5 do, is a breadth-first search.
    """
    if start == goal:
        return [start]
    _, before = breadth_first_order(graph, start, return_predecessors=True)
    if before[goal] < 0:
        return []
    path = [goal]
    while path[-1] != start:
        path.append(int(before[path[-1]]))
    return path[::-1]


def cost_to_go(graph: csr_array, goals: NDArray[np.int64]) -> NDArray[np.float64]:
    """Cheapest cost from every node to the nearest of `goals`, (N,); inf where there is no way."""
    return np.asarray(dijkstra(graph.T.tocsr(), indices=goals, min_only=True))


def largest_component(graph: csr_array) -> NDArray[np.bool_]:
    """The nodes of the largest strongly connected component, bool (N,)."""
    _, label = connected_components(graph, connection="strong")
    return label == np.bincount(label).argmax()
