"""Take more data into a learned map: recognise what is known, add nodes for what is not.

Once the map is rebuilt by looks and places (`repair`), a new log needs no EM: each step is either
at a known node, or at a place that no node explains. Viterbi decides with two additions to the
model: a jump from anywhere to anywhere, by which new edges are found, and a state "unknown".
"""

import numpy as np
from numpy.typing import NDArray

from rfl_torch.hmm import GridHMM
from rfl_torch.looks import BATCH, distance, find_looks

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

UNKNOWN = -1
"""Label of a step that no node explains."""

LOG_JUMP = np.log(1e-4)
"""Log-probability of going on at any node whatever: a new edge must be worth nine nats."""

LOG_LEAVE = np.log(1e-3)
"""Log-probability of going off the map, and of coming back on it."""


STRANGE, FAMILIAR = 15.0, -50.0
"""Nats by which "unknown" explains better than the best node what looks like no node, and worse
what does look like one: to leave the map for one strange step and come back costs 14."""


def log_unknown(log_emission: Array, observations: Array, mean: Array, radius: float) -> Array:
    """Log-density of each step (T,) under the state UNKNOWN.

    Densities cannot tell: a node that was seen a few times is so sharp that all but these look
    strange. A sight is strange if it is farther than a look's radius from all nodes' means.

    Args:
        log_emission: of each step under each node, (T, N).
        observations: normalised, without missing readings, (T, D).
        mean: of the nodes, (N, D).
        radius: of a look.
    """
    away = np.concatenate(
        [
            distance(observations[begin : begin + BATCH], mean).min(1)
            for begin in range(0, len(observations), BATCH)
        ]
    )
    return log_emission.max(1) + np.where(away > radius, STRANGE, FAMILIAR)


def recognize(hmm: GridHMM, log_emission: Array, log_unknown: Array) -> Labels:
    """Most likely nodes (T,) with jumps and the state UNKNOWN.

    Args:
        hmm: the map.
        log_emission: of each step under each node, (T, N).
        log_unknown: of each step under UNKNOWN, (T,).
    """
    num_steps, num_nodes = log_emission.shape
    source, log_prob = _predecessors(hmm)
    back = np.empty((num_steps, num_nodes + 1), np.int64)
    score = np.append(log_emission[0], log_unknown[0])
    rows = np.arange(num_nodes)
    for t in range(1, num_steps):
        known = score[:-1]
        best = int(known.argmax())
        arrive = known[source] + log_prob
        edge = arrive.argmax(1)
        value = arrive[rows, edge]
        before = source[rows, edge]
        jump = max((known[best] + LOG_JUMP, best), (score[-1] + LOG_LEAVE, num_nodes))
        is_jump = value < jump[0]
        value = np.where(is_jump, jump[0], value)
        back[t, :-1] = np.where(is_jump, jump[1], before)
        leave = known[best] + LOG_LEAVE
        back[t, -1] = best if leave > score[-1] else num_nodes
        score = np.append(value + log_emission[t], max(leave, score[-1]) + log_unknown[t])
        score -= score.max()
    path = np.empty(num_steps, np.int64)
    path[-1] = score.argmax()
    for t in range(num_steps - 1, 0, -1):
        path[t - 1] = back[t, path[t]]
    return np.where(path == num_nodes, UNKNOWN, path)


def _predecessors(hmm: GridHMM) -> tuple[NDArray[np.int64], Array]:
    """Table of the nodes that lead to each node, (N, K), and the edges' log-probabilities."""
    mask = hmm.successor_mask.numpy()
    source, _ = np.nonzero(mask)
    target = hmm.successor.numpy()[mask]
    log_prob = hmm.log_transition().detach().numpy()[mask]
    order = target.argsort(kind="stable")
    count = np.bincount(target, minlength=hmm.num_nodes)
    column = np.arange(len(target)) - (count.cumsum() - count)[target[order]]
    table = np.zeros((hmm.num_nodes, int(count.max())), np.int64)
    value = np.full(table.shape, -np.inf)
    table[target[order], column] = source[order]
    value[target[order], column] = log_prob[order]
    return table, value


def add_looks(
    path: Labels,
    observations: Array,
    unit_actions: NDArray[np.float32],
    radius: float,
    num_nodes: int,
) -> Labels:
    """Give the unknown steps of a path new nodes, from `num_nodes` on; one for each look.

    Args:
        path: from `recognize`.
        observations: normalised, without missing readings, (T, D).
        unit_actions: between them, in [0, 1], (T-1, A).
        radius: see `looks.look_radius`.
        num_nodes: nodes that exist.
    """
    steps = np.flatnonzero(path == UNKNOWN)
    (look,) = find_looks([observations], [unit_actions], radius)
    path = path.copy()
    path[steps] = num_nodes + np.unique(look[steps], return_inverse=True)[1].ravel()
    return path
