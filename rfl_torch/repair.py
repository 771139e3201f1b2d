"""Rebuild a learned map where its nodes mix places: one node for each look at each place.

EM on a grid finds what belongs together in time: two corridors that look the same come to lie on
different nodes. Yet a grid with too few nodes, or a fold in it, makes one node stand for two places
that look different. Both are repaired from the log alone:

    look     what is seen within a few actions (`looks`)
    place    where the log's track is (`places`); where actions don't add up to positions, a set of
             nodes that the log goes to and fro between
    node     one look at one place

The new nodes lie on no lattice: they are joined where the log went.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array, eye_array
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee

from rfl_torch import places
from rfl_torch.hmm import GridHMM
from rfl_torch.innate import directions, nearest_direction

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

LEAST_VISITS = 4
"""A place of fewer steps is taken for a slip of recognition: it joins the place that the log had
the look at last, or has next."""

MIN_SCALE = 0.02
"""Floor of the rebuilt nodes' standard deviations, in normalised units."""


def split_by_place(looks: list[Labels], paths: list[Labels]) -> list[Labels]:
    """New nodes, one for each look and each set of old nodes that hang together, int64 (T,) each.

    Args:
        looks: of every step of each log.
        paths: most likely nodes of every step.
    """
    near = _near_nodes(paths)
    look, path = np.concatenate(looks), np.concatenate(paths)
    node = np.empty(len(look), np.int64)
    num_nodes = 0
    order = look.argsort(kind="stable")
    for steps in np.split(order, np.unique(look[order], return_index=True)[1][1:]):
        old, inverse = np.unique(path[steps], return_inverse=True)
        num, place = connected_components(near[old][:, old], directed=False)
        place = place[inverse]
        is_slip = np.bincount(place, minlength=num)[place] < LEAST_VISITS
        if not is_slip.all():
            place[is_slip] = place[~is_slip][_nearest_in_time(steps[is_slip], steps[~is_slip])]
        used, place = np.unique(place, return_inverse=True)
        node[steps] = num_nodes + place
        num_nodes += len(used)
    return np.split(node, np.cumsum([len(part) for part in looks])[:-1])


def _nearest_in_time(steps: Labels, others: Labels) -> Labels:
    """Index of the nearest of the sorted `others` for each step."""
    after = np.searchsorted(others, steps).clip(1, max(1, len(others) - 1))
    before = after - 1
    after = after.clip(max=len(others) - 1)
    return np.where(steps - others[before] <= others[after] - steps, before, after)


def _near_nodes(paths: list[Labels]) -> csr_array:
    """Nodes joined by an edge that the paths took twice, either way, (N, N).

    Two edges apart would be near enough too, were it not for the nodes that mix two places: over
    one of those, all that lies around either place would hang together.
    """
    num_nodes = max(int(path.max()) for path in paths) + 1
    count = places.sum_edges(paths, num_nodes)
    return csr_array(((count + count.T) >= 2).astype(np.float64) + eye_array(num_nodes))


def number_anew(nodes: list[Labels]) -> tuple[list[Labels], int]:
    """Leave out the numbers that no step has; returns the labels and how many there are."""
    used, flat = np.unique(np.concatenate(nodes), return_inverse=True)
    return np.split(flat, np.cumsum([len(path) for path in nodes])[:-1]), len(used)


def keep_numbers(nodes: Labels, before: Labels) -> Labels:
    """Number nodes (M,) such that each has the number of the old node it shares most steps with.

    Numbers stay without gaps: those of old nodes that are gone go to new ones.

    Args:
        nodes: of all steps, numbered without gaps.
        before: old nodes of the first of these steps.
    """
    num_nodes = int(nodes.max()) + 1
    shared = csr_array((np.ones(len(before)), (nodes[: len(before)], before))).tocoo()
    number, taken = np.full(num_nodes, -1), np.zeros(num_nodes, bool)
    for k in np.argsort(-shared.data, kind="stable"):
        node, old = shared.row[k], shared.col[k]
        if old < num_nodes and number[node] < 0 and not taken[old]:
            number[node], taken[old] = old, True
    number[number < 0] = np.flatnonzero(~taken)
    return np.asarray(number[nodes])


def count_directions(
    paths: list[Labels], unit_actions: list[NDArray[np.float32]], num_nodes: int
) -> Array:
    """Steps at each node along each of the `innate.directions`, (N, K)."""
    action = np.concatenate(unit_actions)
    choice, is_full = nearest_direction(action)
    begin = np.concatenate([path[:-1] for path in paths])
    tried = np.zeros((num_nodes, len(directions(action.shape[1]))))
    np.add.at(tried, (begin[is_full], choice[is_full]), 1.0)
    return tried


@dataclass(frozen=True)
class Counts:
    """What a labelled log says of its nodes; the counts of several logs add.

    edges (N, N): steps from one node to another. weight, first, second (N, D): number, sum and sum
    of squares of the readings that are not missing.
    """

    edges: csr_array
    weight: Array
    first: Array
    second: Array

    @classmethod
    def of(cls, nodes: list[Labels], observations: list[Array], num_nodes: int) -> "Counts":
        """Count logs whose steps have the nodes (T,) and normalised observations (T, D)."""
        seen, node = np.concatenate(observations), np.concatenate(nodes)
        is_there = ~np.isnan(seen)
        values = np.where(is_there, seen, 0.0)
        member = csr_array(
            (np.ones(len(node)), (node, np.arange(len(node)))), shape=(num_nodes, len(node))
        )
        return cls(
            places.sum_edges(nodes, num_nodes),
            member @ is_there.astype(np.float64),
            member @ values,
            member @ values**2,
        )

    @property
    def num_nodes(self) -> int:
        """Nodes that are counted."""
        return len(self.weight)

    def padded(self, num_nodes: int) -> "Counts":
        """The same counts with room for more nodes."""
        edges = self.edges.copy()
        edges.resize((num_nodes, num_nodes))
        more = ((0, num_nodes - self.num_nodes), (0, 0))
        return Counts(
            edges,
            *(np.pad(x, more) for x in (self.weight, self.first, self.second)),
        )

    def __add__(self, other: "Counts") -> "Counts":
        """Pool the counts of two logs with the same nodes."""
        return Counts(
            csr_array(self.edges + other.edges),
            self.weight + other.weight,
            self.first + other.first,
            self.second + other.second,
        )


def tie(counts: Counts, power: float, min_scale: float) -> Counts:
    """Give places that look exactly the same one and the same emission, and the same ways on.

    They differ by where in the place the robot happened to be. Seen again and again, that would
    make it ever surer of one of them.
    """
    weight = np.maximum(counts.weight, 1.0)
    mean = counts.first / weight
    scale = np.sqrt(np.maximum(counts.second / weight - mean**2, min_scale**2))
    near = places.within(counts.edges, places.NEAR)
    twins = places.find_twins(mean, scale, power, near)
    twins = places.match_twins(twins, mean, scale, counts.edges)
    pool = csr_array(twins + eye_array(counts.num_nodes))
    edges = (pool @ counts.edges @ pool).multiply(near)
    return Counts(
        csr_array(edges), *(pool @ x for x in (counts.weight, counts.first, counts.second))
    )


def rebuild(
    hmm: GridHMM, counts: Counts, is_reversible: bool, min_scale: float, pseudo_count: float
) -> None:
    """Give `hmm` the nodes and edges of the counts, in place of those that it has.

    An edge stands where the log went, and in a reversible world the other way too. A reading that
    a node never had counts as the log's mean with the log's spread.
    """
    num_nodes = counts.num_nodes
    edges = csr_array(counts.edges + 0.0 * eye_array(num_nodes))
    joined = csr_array(edges + pseudo_count * (edges.astype(bool) + eye_array(num_nodes)))
    if is_reversible:
        joined = csr_array(joined + pseudo_count * edges.T.astype(bool))
    ends = np.asarray(joined.sum(1) == 0).ravel()  # come to by the last step of all, and once
    if ends.any():
        joined = csr_array(
            joined
            + csr_array((ends.astype(np.float64), np.arange(num_nodes), np.arange(num_nodes + 1)))
        )
    # The recursions lay the graph out by diagonals: few, if neighbours have near numbers.
    order = reverse_cuthill_mckee(csr_array(joined), symmetric_mode=is_reversible)
    cell = np.empty(num_nodes, np.int64)
    cell[order] = np.arange(num_nodes)
    width = int(np.diff(joined.indptr).max())
    row = np.repeat(np.arange(num_nodes), np.diff(joined.indptr))
    column = np.arange(len(joined.data)) - joined.indptr[row]
    successor = np.repeat(np.arange(num_nodes)[:, None], width, 1)
    successor[row, column] = joined.indices
    mask = np.zeros((num_nodes, width), bool)
    mask[row, column] = True
    logits = np.zeros((num_nodes, width))
    logits[row, column] = np.log(joined.data)
    total = np.maximum(counts.weight.sum(0), 1.0)
    common = counts.first.sum(0) / total
    spread = np.sqrt(np.maximum(counts.second.sum(0) / total - common**2, min_scale**2))
    weight = np.maximum(counts.weight, 1.0)
    mean = np.where(counts.weight > 0, counts.first / weight, common)
    variance = np.maximum(counts.second / weight - mean**2, min_scale**2)
    scale = np.where(counts.weight > 0, np.sqrt(variance), spread)
    hmm.replace_graph(
        *(torch.from_numpy(x) for x in (successor, mask, cell, logits, mean, np.log(scale)))
    )
