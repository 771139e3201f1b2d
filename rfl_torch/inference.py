"""Inference in a sparse HMM: pure functions over a chain and its emissions, exact on any data.

The E-step meets in the middle: one thread runs alpha forward over the first half of a sequence, the
other b beta backward over the second; then each crosses the half that the other has stored and
forms gamma and the expected counts there. Long sequences keep one row a block and recompute the
block when it is crossed, so memory grows with T / BLOCK, not with T.

Symbols as in `kernels`; equation numbers are the paper's.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from rfl_torch import kernels

BLOCK = 8192
"""Steps whose messages are held at once by each of the two threads."""

_CACHE_BLOCK = 512

_UNREACHABLE = (
    "an observation lies more than 1.8e8 nats from every node that can be reached; check its "
    "units, or mark the reading as missing with NaN."
)


class Chain(NamedTuple):
    """Transitions by diagonal, and Gaussians, over the G cells of a lattice.

    shift_in, shift_out: int64 (O,), so that edge o enters cell c from (c + shift_in[o]) mod G and
        leaves cell c to (c + shift_out[o]) mod G.
    weight_in, weight_out: float32 mantissas (O, G), 0 where there is no edge; `*_exponent` int32.
    inverse_scale, scaled_mean, log_norm: float64 (D, G).
    initial_log: float64 (G,) [nat], -inf in cells without a node.
    cell: int64 (N,), the cell of each node. is_node: bool (G,).
    """

    shift_in: np.ndarray
    weight_in: np.ndarray
    weight_in_exponent: np.ndarray
    shift_out: np.ndarray
    weight_out: np.ndarray
    weight_out_exponent: np.ndarray
    inverse_scale: np.ndarray
    scaled_mean: np.ndarray
    log_norm: np.ndarray
    initial_log: np.ndarray
    cell: np.ndarray
    is_node: np.ndarray
    num_cells: int
    temperature: float


class Diagonals(NamedTuple):
    """Structure of a graph by diagonal, made once: edge (i, k) stands at [diagonal[i, k], cell]."""

    shift: np.ndarray
    """int64 (O,), the distinct (target cell - source cell) mod G."""
    edge: np.ndarray
    """int64 (E, 2), the (node, k) of every edge."""
    diagonal: np.ndarray
    """int64 (E,), which shift the edge has."""
    source: np.ndarray
    """int64 (E,), its source cell."""
    target: np.ndarray
    """int64 (E,), its target cell."""


def build_diagonals(
    successor: np.ndarray, mask: np.ndarray, cell: np.ndarray, num_cells: int
) -> Diagonals:
    """Sort the edges of a successor table (N, K) by the shift between their cells."""
    edge = np.argwhere(mask)
    source = cell[edge[:, 0]]
    target = cell[successor[edge[:, 0], edge[:, 1]]]
    shift, diagonal = np.unique((target - source) % num_cells, return_inverse=True)
    return Diagonals(shift, edge, diagonal, source, target)


def build_chain(
    diagonals: Diagonals,
    log_transition: np.ndarray,
    initial_log: np.ndarray,
    mean: np.ndarray,
    scale: np.ndarray,
    cell: np.ndarray,
    num_cells: int,
    temperature: float = 1.0,
) -> Chain:
    """Lay the parameters of N nodes out over the lattice; log_transition (N, K), mean (N, D)."""
    shape = (len(diagonals.shift), num_cells)
    log2_weight = log_transition[diagonals.edge[:, 0], diagonals.edge[:, 1]] / np.log(2.0)
    exponent = np.floor(log2_weight)
    mantissa = np.exp2(log2_weight - exponent).astype(np.float32)
    tables = []
    for column in (diagonals.target, diagonals.source):
        weight = np.zeros(shape, np.float32)
        weight_exponent = np.full(shape, kernels.ABSENT, np.int32)
        weight[diagonals.diagonal, column] = mantissa
        weight_exponent[diagonals.diagonal, column] = exponent
        tables += [weight, weight_exponent]
    inverse_scale, scaled_mean, log_norm = (np.zeros((mean.shape[1], num_cells)) for _ in range(3))
    inverse_scale[:, cell] = (1.0 / scale).T
    scaled_mean[:, cell] = (mean / scale).T
    log_norm[:, cell] = (-0.5 * np.log(2 * np.pi) - np.log(scale)).T
    initial = np.full(num_cells, -np.inf)
    initial[cell] = initial_log
    is_node = np.zeros(num_cells, bool)
    is_node[cell] = True
    return Chain(
        (num_cells - diagonals.shift) % num_cells, tables[0], tables[1],
        diagonals.shift, tables[2], tables[3],
        inverse_scale, scaled_mean, log_norm, initial, cell, is_node,
        num_cells, temperature,
    )  # fmt: skip


class Emission(NamedTuple):
    """b_j(o_t) over a block: mantissa and exponent (T, G), relative to `base` (T,) [nat]."""

    mantissa: np.ndarray
    exponent: np.ndarray
    base: np.ndarray


def log_emission(chain: Chain, observations: np.ndarray) -> np.ndarray:
    """Evaluate log b_j(o_t) * temperature over the lattice, float64 (T, G); -inf in empty cells."""
    out = np.empty((len(observations), chain.num_cells))
    kernels.emission_rows(
        observations, chain.inverse_scale, chain.scaled_mean, chain.log_norm,
        chain.temperature, out,
    )  # fmt: skip
    if len(chain.cell) < chain.num_cells:
        out[:, ~chain.is_node] = -np.inf
    return out


def emission(chain: Chain, observations: np.ndarray) -> Emission:
    """Evaluate the Gaussians (eq. 1) over a block of observations."""
    shape = (len(observations), chain.num_cells)
    result = Emission(np.empty(shape, np.float32), np.empty(shape, np.int32), np.empty(shape[0]))
    for block in _blocks(slice(0, len(observations)), _CACHE_BLOCK):
        log_rows = log_emission(chain, observations[block])
        kernels.split_rows(log_rows, *(field[block] for field in result))
    return result


class Rows(NamedTuple):
    """A message and the emissions over one block, in time order; `log_base` [nat] of both."""

    mantissa: np.ndarray
    exponent: np.ndarray
    emission: Emission
    log_base: float


class _Message:
    """alpha_t running forward, or b_t beta_t running backward, over any part of a sequence.

    Backward is the same recursion on reversed time with the edges turned round.
    """

    def __init__(self, chain: Chain, observations: np.ndarray, is_forward: bool) -> None:
        self.chain = chain
        self.observations = observations
        self.is_forward = is_forward
        self.order = slice(None) if is_forward else slice(None, None, -1)
        self.edges = (
            (chain.shift_in, chain.weight_in, chain.weight_in_exponent)
            if is_forward
            else (chain.shift_out, chain.weight_out, chain.weight_out_exponent)
        )
        self.last = (
            np.zeros(2 * chain.num_cells, np.float32),
            np.zeros(2 * chain.num_cells, np.int32),
        )

    def advance(self, block: slice) -> Rows:
        """Run the message through one block, from where it stands."""
        b = emission(self.chain, self.observations[block])
        mantissa, exponent = np.empty_like(b.mantissa), np.empty_like(b.exponent)
        base = np.zeros(len(mantissa))
        rows = [array[self.order] for array in (b.mantissa, b.exponent, mantissa, exponent, base)]
        edge_step = 0 if self.is_forward else len(self.observations) - 1
        log_start = 0.0
        if block.start <= edge_step < block.stop:
            log_start = self._begin(*(row[0] for row in rows[:4]))
            rows = [row[1:] for row in rows]
        done = kernels.message_rows(*self.last, *rows[:2], *self.edges, *rows[2:])
        if not done:
            raise ValueError(_UNREACHABLE)
        return Rows(mantissa, exponent, b, base.sum() * np.log(2.0) + b.base.sum() + log_start)

    def _begin(self, b: np.ndarray, b_exponent: np.ndarray, mantissa, exponent) -> float:  # type: ignore[no-untyped-def]
        """Write alpha_1 = pi b_1 (eq. 2), or b_T beta_T with beta_T = 1 (eq. 4); returns a base."""
        if self.is_forward:
            start = self.chain.initial_log
        else:
            start = np.where(self.chain.is_node, 0.0, -np.inf)
        with np.errstate(divide="ignore"):
            log_row = np.log(b, dtype=np.float64) + b_exponent * np.log(2.0) + start
        base = np.empty(1)
        kernels.split_rows(log_row[None], mantissa[None], exponent[None], base)
        self.last[0][:] = np.tile(mantissa, 2)
        self.last[1][:] = np.tile(exponent, 2)
        return float(base[0])

    def cross(
        self, other: Rows, smoothed: np.ndarray, counts: np.ndarray, counts_first_step: bool
    ) -> float:
        """Push the message across a block whose other message is known; see `crossing_rows`."""
        stored = (*other.emission[:2], other.mantissa, other.exponent, smoothed)
        *rows, smoothed = (row[self.order] for row in stored)
        return kernels.crossing_rows(
            *self.last, *rows, *self.edges, smoothed, counts, counts_first_step
        )


class _Half:
    """A message over its own half of the sequence, of which one block is held at a time."""

    def __init__(self, message: _Message, steps: slice) -> None:
        self.message = message
        self.starts: list[tuple[slice, list[np.ndarray]]] = []
        self.log_base = 0.0
        for block in _blocks(steps, BLOCK, from_end=not message.is_forward):
            self.starts.append((block, [array.copy() for array in message.last]))
            self.rows = message.advance(block)
            self.log_base += self.rows.log_base

    def from_middle(self) -> Iterator[tuple[slice, Rows]]:
        """Yield the blocks, the one nearest the middle first; earlier ones are run once more."""
        block, _ = self.starts.pop()
        yield block, self.rows
        again = _Message(self.message.chain, self.message.observations, self.message.is_forward)
        for block, last in reversed(self.starts):
            again.last = (last[0], last[1])
            yield block, again.advance(block)


class Expectations(NamedTuple):
    """What the E-step gathers (eqs. 7-10), by node; sums over the steps of one sequence.

    initial (N,): gamma_1. node (N,): sum of gamma_t. edge (E,): sum of xi_t, in the order of
    `Diagonals.edge`. weight, first, second (N, D): sums of gamma_t, gamma_t o_t and gamma_t o_t^2
    over the readings that are not NaN. log_likelihood [nat].
    """

    initial: np.ndarray
    node: np.ndarray
    edge: np.ndarray
    weight: np.ndarray
    first: np.ndarray
    second: np.ndarray
    log_likelihood: float


def expectations(chain: Chain, diagonals: Diagonals, observations: np.ndarray) -> Expectations:
    """Run the E-step over one sequence, float64 (T, D)."""
    known = ~np.isnan(observations)
    has_gaps = not known.all()
    center = np.where(known, observations, 0.0).sum(0) / np.maximum(known.sum(0), 1)

    def gather(block: slice, smoothed: np.ndarray) -> np.ndarray:
        """Sums of gamma times the features, about `center` for float32's sake."""
        x = observations[block] - center
        filled = np.nan_to_num(x) if has_gaps else x
        ones = np.ones((len(x), 1))
        features = [ones, filled, filled**2, *([~np.isnan(x)] if has_gaps else [])]
        sums = np.zeros((sum(f.shape[1] for f in features), chain.num_cells))
        kernels.add_outer(smoothed, np.concatenate(features, 1, dtype=np.float32), sums)
        return sums

    parts, edge, initial, log_likelihood = _meet_in_the_middle(chain, observations, gather)
    total = np.sum(parts, axis=0)[:, chain.cell].T
    node = total[:, 0]
    sums = np.split(total[:, 1:], 3 if has_gaps else 2, axis=1)
    weight = sums[2] if has_gaps else np.repeat(node[:, None], observations.shape[1], 1)
    return Expectations(
        initial[chain.cell],
        node,
        edge[0][diagonals.diagonal, diagonals.target]
        + edge[1][diagonals.diagonal, diagonals.source],
        weight,
        sums[0] + weight * center,
        sums[1] + 2 * center * sums[0] + weight * center**2,
        log_likelihood,
    )


def smooth(chain: Chain, observations: np.ndarray) -> np.ndarray:
    """p(node at t | all observations), float32 (T, N)."""
    out = np.empty((len(observations), len(chain.cell)), np.float32)

    def keep(block: slice, smoothed: np.ndarray) -> None:
        out[block] = smoothed[:, chain.cell]

    _meet_in_the_middle(chain, observations, keep)
    return out


def _meet_in_the_middle(  # type: ignore[no-untyped-def]
    chain: Chain, observations: np.ndarray, visit: Callable[[slice, np.ndarray], Any]
):
    """Form gamma over the whole sequence, block by block, on two threads.

    Returns what `visit(block, gamma)` gave, in order of time; expected counts by target and by
    source cell, (O, G) each; gamma_1; the log-likelihood.
    """
    num_steps, shape = len(observations), chain.weight_in.shape
    if num_steps == 1:
        gamma, log_likelihood = filter_rows(chain, observations)
        return [visit(slice(0, 1), gamma)], np.zeros((2, *shape)), gamma[0], log_likelihood
    middle = num_steps // 2
    forward, backward = (_Message(chain, observations, ahead) for ahead in (True, False))
    with ThreadPoolExecutor(2) as pool:
        halves = pool.map(_Half, (forward, backward), (slice(0, middle), slice(middle, num_steps)))
        past, future = halves
        crossings = pool.map(_cross_half, (forward, backward), (future, past), (visit, visit))
        (late, edge_in, _, log2_joint), (early, edge_out, initial, _) = crossings
    log_likelihood = log2_joint * np.log(2.0) + past.log_base + future.log_base
    return [*early[::-1], *late], np.stack([edge_in, edge_out]), initial, log_likelihood


def _cross_half(message: _Message, half: _Half, visit: Callable[[slice, np.ndarray], Any]):  # type: ignore[no-untyped-def]
    """Carry `message` across the half that the other thread has stored."""
    results: list[Any] = []
    counts = np.zeros(message.chain.weight_in.shape)
    log2_joint = None
    for block, rows in half.from_middle():
        smoothed = np.empty_like(rows.mantissa)
        # Both messages take the step over the middle; the forward one counts it.
        is_counted = message.is_forward or bool(results)
        first = message.cross(rows, smoothed, counts, is_counted)
        if first == -np.inf:  # the two halves share no live node
            raise ValueError(_UNREACHABLE)
        log2_joint = first if log2_joint is None else log2_joint
        results.append(visit(block, smoothed))
    return results, counts, smoothed[0].astype(np.float64), log2_joint


def filter_rows(chain: Chain, observations: np.ndarray) -> tuple[np.ndarray, float]:
    """p(node at t | observations to t) over cells, float32 (T, G), and the log-likelihood."""
    forward = _Message(chain, observations, is_forward=True)
    filtered = np.empty((len(observations), chain.num_cells), np.float32)
    ones = np.ones(filtered.shape[1], np.float32)
    zeros = np.zeros(filtered.shape[1], np.int32)
    log_likelihood = log2_last = 0.0
    for block in _blocks(slice(0, len(observations)), BLOCK):
        rows = forward.advance(block)
        log_likelihood += rows.log_base
        for t in range(block.start, block.stop):
            row = rows.mantissa[t - block.start], rows.exponent[t - block.start]
            log2_last = kernels.normalized_product(*row, ones, zeros, filtered[t])
    return filtered, log_likelihood + log2_last * np.log(2.0)


def most_likely_path(chain: Chain, observations: np.ndarray) -> np.ndarray:
    """Viterbi's path (section 2.3), int64 (T,) node indices; exact ties go to the lower shift."""
    log_weight = _log_weight_in(chain)
    score = np.tile(chain.initial_log + log_emission(chain, observations[:1])[0], 2)
    choice = np.empty((len(observations) - 1, chain.num_cells), np.uint16)
    for block in _blocks(slice(0, len(choice)), _CACHE_BLOCK):
        log_rows = log_emission(chain, observations[1:][block])
        kernels.best_rows(score, log_rows, chain.shift_in, log_weight, choice[block])
    path = np.empty(len(observations), np.int64)
    last = int(score[: chain.num_cells].argmax())
    kernels.backtrack(choice, chain.shift_in, last, path)
    node_of_cell = np.full(chain.num_cells, -1)
    node_of_cell[chain.cell] = np.arange(len(chain.cell))
    return node_of_cell[path]


def viterbi_scores(chain: Chain, observations: np.ndarray) -> np.ndarray:
    """Logs of delta_T (section 2.3) over nodes, (N,), relative to the best path of all."""
    score = np.tile(chain.initial_log + log_emission(chain, observations[:1])[0], 2)
    log_rows = log_emission(chain, observations[1:])
    choice = np.empty(log_rows.shape, np.uint16)
    kernels.best_rows(score, log_rows, chain.shift_in, _log_weight_in(chain), choice)
    return score[chain.cell] - score.max()


def _log_weight_in(chain: Chain) -> np.ndarray:
    with np.errstate(divide="ignore"):
        log_mantissa = np.log(chain.weight_in, dtype=np.float64)
    return log_mantissa + np.where(chain.weight_in > 0, chain.weight_in_exponent * np.log(2.0), 0.0)


def _blocks(steps: slice, size: int, from_end: bool = False) -> Iterator[slice]:
    """Cut `steps` into slices of at most `size`, in order or last first."""
    edges = range(steps.start, steps.stop, size)
    for first in reversed(edges) if from_end else edges:
        yield slice(first, min(first + size, steps.stop))
