"""Inference in a sparse HMM: pure functions over a chain and its emissions, exact on any data.

The E-step meets in the middle: one thread runs alpha forward over the first half of a sequence, the
other b beta backward over the second; then each crosses the half that the other has stored and
forms gamma and the expected counts there. Long sequences keep one row a block and recompute the
block when it is crossed, so memory grows with T / BLOCK, not with T.

Symbols as in `kernels`; equation numbers are the paper's.
"""

import functools
import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

import numpy as np

from rfl_torch import kernels
from rfl_torch.simd import LANES, aligned_empty, aligned_full

BLOCK = 50_000
"""Steps whose messages are held at once by each of the two threads, 16 bytes a node; of longer
halves the steps before these are run twice, which takes half as long again."""

_CACHE_BLOCK = 512
"""Steps that are worked on at once where nothing is kept of them."""

_MAX_ENTRIES = 20_000_000
"""Steps times cells that a block holds at most, whatever BLOCK says; an entry takes 16 bytes."""

_SEGMENT_CELLS = 1 << 19
"""Steps times cells that are run twice at once, few enough to stay in a cache."""

_SHORT = 200_000
"""Steps times cells of a sequence that one thread does sooner than two: starting one has a price,
which a log of many short episodes pays for each."""

_MAX_SPARE = 1 << 29
"""Bytes of one working buffer that are kept for the next call: fresh pages cost a tenth of it."""

_UNREACHABLE = (
    "an observation lies more than 1.8e8 nats from every node that can be reached; check its "
    "units, or mark the reading as missing with NaN."
)

_spare: list[np.ndarray] = []


class Chain(NamedTuple):
    """Transitions by diagonal, and Gaussians, over the G cells of a lattice.

    shift_in, shift_out: int64 (O,), so that edge o enters cell c from (c + shift_in[o]) mod G and
        leaves cell c to (c + shift_out[o]) mod G.
    weight_in, weight_out: float32 mantissas (O, G), 0 where there is no edge; `*_exponent` int32.
    inverse_scale, scaled_mean, log_norm: float64 (D, G).
    initial_log, log_node: float64 (G,) [nat], -inf in cells without a node; log_node else 0.
    log_weight_in: float64 (O, G) [nat], -inf where there is no edge.
    cell: int64 (N,), the cell of each node. is_node: bool (G,).
    num_cells: G, the lattice's cells and some empty ones to fill the last tile of the kernels.
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
    log_node: np.ndarray
    log_weight_in: np.ndarray
    cell: np.ndarray
    is_node: np.ndarray
    num_cells: int
    temperature: float


class Diagonals(NamedTuple):
    """Structure of a graph by diagonal, made once: where every edge stands in the tables."""

    shift: np.ndarray
    """int64 (O,), the distinct (target cell - source cell) mod G."""
    slot: np.ndarray
    """int64 (E,), node * K + k, in a successor table (N, K) laid out flat."""
    entering: np.ndarray
    """int64 (E,), diagonal * G + target cell, in a table (O, G) laid out flat."""
    leaving: np.ndarray
    """int64 (E,), diagonal * G + source cell."""


def build_diagonals(
    successor: np.ndarray, mask: np.ndarray, cell: np.ndarray, num_cells: int
) -> Diagonals:
    """Sort the edges of a successor table (N, K) by the shift between their cells."""
    num_cells = _whole_tiles(num_cells)
    slot = np.flatnonzero(mask)
    source, target = cell[slot // mask.shape[1]], cell[successor.ravel()[slot]]
    shift, diagonal = np.unique((target - source) % num_cells, return_inverse=True)
    return Diagonals(shift, slot, diagonal * num_cells + target, diagonal * num_cells + source)


def _whole_tiles(num_cells: int) -> int:
    return -(-num_cells // LANES) * LANES


def build_chain(
    diagonals: Diagonals,
    transition_logits: np.ndarray,
    initial_log: np.ndarray,
    mean: np.ndarray,
    log_scale: np.ndarray,
    cell: np.ndarray,
    num_cells: int,
    lowest: float,
    temperature: float = 1.0,
) -> Chain:
    """Lay the parameters of N nodes out over the lattice, all float64.

    transition_logits (N, K), -inf where there is no edge; initial_log (N,) [nat]; mean, log_scale
    (N, D); lowest: floor of the edges' log-probabilities [nat].
    """
    num_cells = _whole_tiles(num_cells)
    shape = (len(diagonals.shift), num_cells)
    weight_in, weight_out = (aligned_full(shape, 0.0, np.float32) for _ in range(2))
    in_exponent, out_exponent = (aligned_full(shape, kernels.ABSENT, np.int32) for _ in range(2))
    log_weight_in = aligned_full(shape, -np.inf, np.float64)
    logits = transition_logits - transition_logits.max(1, keepdims=True)
    tables = (weight_in, in_exponent, weight_out, out_exponent, log_weight_in)
    kernels.lay_out_edges(
        logits, np.exp(logits), lowest, diagonals.slot, diagonals.entering, diagonals.leaving,
        *(table.ravel() for table in tables),
    )  # fmt: skip
    inverse_scale, scaled_mean, log_norm = (
        aligned_full((mean.shape[1], num_cells), 0.0, np.float64) for _ in range(3)
    )
    kernels.lay_out_gaussians(
        mean, log_scale, np.exp(-log_scale), cell, inverse_scale, scaled_mean, log_norm
    )
    initial = np.full(num_cells, -np.inf)
    initial[cell] = initial_log
    is_node = np.zeros(num_cells, bool)
    is_node[cell] = True
    return Chain(
        (num_cells - diagonals.shift) % num_cells, weight_in, in_exponent,
        diagonals.shift, weight_out, out_exponent,
        inverse_scale, scaled_mean, log_norm,
        initial, np.where(is_node, 0.0, -np.inf), log_weight_in, cell, is_node,
        num_cells, temperature,
    )  # fmt: skip


def log_emission(chain: Chain, observations: np.ndarray) -> np.ndarray:
    """Evaluate log b_j(o_t) * temperature over the lattice, float64 (T, G); -inf in empty cells."""
    out = np.empty((len(observations), chain.num_cells))
    kernels.log_emission_rows(observations, *_gaussians(chain), out)
    return out


def _gaussians(chain: Chain) -> tuple[Any, ...]:
    """What the emission kernels ask of a chain."""
    return (
        chain.inverse_scale, chain.scaled_mean, chain.log_norm, chain.log_node, chain.temperature
    )  # fmt: skip


class Rows(NamedTuple):
    """A message and the emissions b_j(o_t) over some steps, in time order, all (T, G).

    base: int64 (T,), the power of two that each step's message was divided by.
    """

    mantissa: np.ndarray
    exponent: np.ndarray
    b: np.ndarray
    b_exponent: np.ndarray
    base: np.ndarray

    def part(self, steps: slice) -> "Rows":
        """The rows of some of the steps."""
        return Rows(*(array[steps] for array in self))


@contextmanager
def _borrow_rows(num_steps: int, num_cells: int) -> Iterator[Rows]:
    """Uninitialised rows, in a buffer left over from an earlier call if there is one."""
    size = num_steps * num_cells
    buffer = np.empty(0, np.int32)
    with suppress(IndexError):
        buffer = _spare.pop()
    if buffer.size < 4 * size:
        buffer = aligned_empty((4 * size,), np.int32)
    arrays = (buffer[k * size : (k + 1) * size].reshape(num_steps, num_cells) for k in range(4))
    mantissa, exponent, b, b_exponent = arrays
    try:
        base = np.empty(num_steps, np.int64)
        yield Rows(mantissa.view(np.float32), exponent, b.view(np.float32), b_exponent, base)
    finally:
        if len(_spare) < 2 and buffer.nbytes <= _MAX_SPARE:
            _spare.append(buffer)


class _Message:
    """alpha_t running forward, or b_t beta_t running backward, over any part of a sequence.

    Backward is the same recursion on reversed time with the edges turned round.
    """

    def __init__(self, chain: Chain, observations: np.ndarray, is_forward: bool) -> None:
        self.chain = chain
        self.observations = observations
        self.is_forward = is_forward
        self.edges = (
            (chain.shift_in, chain.weight_in, chain.weight_in_exponent)
            if is_forward
            else (chain.shift_out, chain.weight_out, chain.weight_out_exponent)
        )
        room = aligned_empty((8 * chain.num_cells,), np.int32)
        mantissa, exponent = room[: 4 * chain.num_cells], room[4 * chain.num_cells :]
        self.last = mantissa.view(np.float32), exponent, np.zeros(1, np.int32)
        self.normalizer = np.zeros(2)

    def advance(self, block: slice, rows: Rows) -> float:
        """Run the message through one block, from where it stands; returns the log base [nat].

        With fewer rows than steps, none is kept.
        """
        observations, log_base = self.observations[block], 0.0
        if self.is_forward and block.start == 0:
            log_base = self._begin(observations[:1], rows.part(slice(0, 1)))
            observations, rows = observations[1:], rows.part(slice(1, None))
        elif not self.is_forward and block.stop == len(self.observations):
            log_base = self._begin(observations[-1:], rows.part(slice(-1, None)))
            observations, rows = observations[:-1], rows.part(slice(0, -1))
        log_base += kernels.advance_rows(
            observations, *_gaussians(self.chain), *self.last, *self.edges, *rows,
            not self.is_forward,
        )  # fmt: skip
        if np.isnan(log_base):
            raise ValueError(_UNREACHABLE)
        return log_base

    def _begin(self, observation: np.ndarray, row: Rows) -> float:
        """Write alpha_1 = pi b_1 (eq. 2), or b_T beta_T with beta_T = 1 (eq. 4); returns a base."""
        log_row = log_emission(self.chain, observation)
        kernels.split_row(log_row, row.b, row.b_exponent)
        log_row += self.chain.initial_log if self.is_forward else self.chain.log_node
        log_base = kernels.split_row(log_row, row.mantissa, row.exponent)
        self.set_state((row.mantissa[0], row.exponent[0], np.zeros(1, np.int32)))
        return log_base

    def state(self) -> tuple[np.ndarray, ...]:
        """A copy of where the message stands, for `set_state`."""
        num_cells = self.chain.num_cells
        return self.last[0][:num_cells].copy(), self.last[1][:num_cells].copy(), self.last[2].copy()

    def set_state(self, state: tuple[np.ndarray, ...]) -> None:
        """Go on from a `state`."""
        num_cells = self.chain.num_cells
        for message, row in zip(self.last[:2], state[:2], strict=True):
            message[:num_cells] = message[num_cells : 2 * num_cells] = row
        self.last[2][:] = state[2]

    def meet(self, other: Rows) -> float:
        """Begin to cross, at a row (1, G) of the other message; log2 of the two's joint sum."""
        kernels.joint_sum(
            *self.last[:2], other.mantissa, other.exponent, *self.edges, self.normalizer
        )  # fmt: skip
        if self.normalizer[0] == 0.0:  # the two halves share no live node
            raise ValueError(_UNREACHABLE)
        return float(np.log2(self.normalizer[0]) + self.normalizer[1])

    def cross(
        self, other: Rows, counts: np.ndarray, counts_first_step: bool, moments: "_Moments | None"
    ) -> None:
        """Push the message across steps whose other message is known; see `crossing_rows`.

        gamma (T, G) takes the place of the other message's mantissas, and is added to `moments`.
        """
        stored = (other.b, other.b_exponent, other.mantissa, other.exponent, other.base)
        state = (*self.last, *stored, *self.edges, self.normalizer)
        if moments is None:
            kernels.crossing_rows(
                *state, other.mantissa, counts, counts_first_step, not self.is_forward
            )
        else:
            kernels.crossing_sums(*state, counts, counts_first_step, not self.is_forward, *moments)
        if not 0.0 < self.normalizer[0] < np.inf:  # the messages part within the steps
            raise ValueError(_UNREACHABLE)


class _Moments(NamedTuple):
    """What `kernels.add_moments` asks for besides gamma: some steps, and where to add them."""

    observations: np.ndarray
    center: np.ndarray
    with_gaps: bool
    sums: np.ndarray


class _Half:
    """A message over its own half of the sequence, of which the steps nearest the middle are held.

    The others are run in segments of which only the start is kept, and run once more when crossed.
    """

    def __init__(self, message: _Message, steps: slice, rows: Rows, num_held: int) -> None:
        self.message = message
        self.rows, self.segment_rows = rows.part(slice(num_held)), rows.part(slice(num_held, None))
        self.starts: list[tuple[slice, tuple[np.ndarray, ...]]] = []
        self.log_base = 0.0
        num_far = max(0, steps.stop - steps.start - num_held)
        if message.is_forward:
            far = slice(steps.start, steps.start + num_far)
            self.held = slice(far.stop, steps.stop)
        else:
            far = slice(steps.stop - num_far, steps.stop)
            self.held = slice(steps.start, far.start)
        size = max(1, len(self.segment_rows.b))
        overwritten = self.segment_rows.part(slice(kernels.cached_steps(message.chain.num_cells)))
        for segment in _blocks(far, size, from_end=not message.is_forward):
            self.starts.append((segment, message.state()))
            self.log_base += message.advance(segment, _first(overwritten, segment))
        self.log_base += message.advance(self.held, _first(self.rows, self.held))

    def from_middle(self) -> Iterator[tuple[slice, Rows]]:
        """Yield the held steps and then the segments, each with its rows, away from the middle."""
        yield self.held, _first(self.rows, self.held)
        again = _Message(self.message.chain, self.message.observations, self.message.is_forward)
        for segment, state in reversed(self.starts):
            again.set_state(state)
            rows = _first(self.segment_rows, segment)
            again.advance(segment, rows)
            yield segment, rows


def _first(rows: Rows, steps: slice) -> Rows:
    """As many of the rows as there are steps."""
    return rows.part(slice(0, steps.stop - steps.start))


class Expectations(NamedTuple):
    """What the E-step gathers (eqs. 7-10), by node; sums over the steps of one sequence.

    initial (N,): gamma_1. node (N,): sum of gamma_t. edge (E,): sum of xi_t, in the order of
    `Diagonals.slot`. weight, first, second (N, D): sums of gamma_t, gamma_t o_t and gamma_t o_t^2
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
    obs_dim = observations.shape[1]
    center, has_gaps = _center(observations)
    num_features = 1 + (3 if has_gaps else 2) * obs_dim
    sums = np.zeros((2, num_features, chain.num_cells))  # of either half, so by its own thread
    if len(observations) == 1:
        gamma, log_likelihood = filter_rows(chain, observations)
        kernels.add_moments(gamma, observations, center, has_gaps, sums[0])
        edge, initial = np.zeros((2, *chain.weight_in.shape)), gamma[0]
    else:

        def cross(message, steps, rows, counts, is_counted):  # type: ignore[no-untyped-def]
            own = sums[int(message.is_forward)]
            moments = _Moments(observations[steps], center, has_gaps, own)
            message.cross(rows, counts, is_counted, moments)

        edge, initial, log_likelihood = _meet_in_the_middle(chain, observations, cross)
    node = np.empty(len(chain.cell))
    weight, first, second = (np.empty((len(node), obs_dim)) for _ in range(3))
    kernels.expected_moments(sums, chain.cell, center, has_gaps, node, weight, first, second)
    return Expectations(
        initial[chain.cell],
        node,
        edge[0].ravel()[diagonals.entering] + edge[1].ravel()[diagonals.leaving],
        weight,
        first,
        second,
        log_likelihood,
    )


def _center(observations: np.ndarray) -> tuple[np.ndarray, bool]:
    """Means of the readings, about which float32 sums lose least, and if any is missing."""
    total = observations.sum(0)
    if not np.isnan(total).any():
        return total / len(observations), False
    known = (~np.isnan(observations)).sum(0)
    return np.nansum(observations, 0) / np.maximum(known, 1), True


def smooth(chain: Chain, observations: np.ndarray) -> np.ndarray:
    """p(node at t | all observations), float32 (T, N)."""
    if len(observations) == 1:
        return filter_rows(chain, observations)[0][:, chain.cell]
    out = np.empty((len(observations), len(chain.cell)), np.float32)

    def cross(message, steps, rows, counts, is_counted):  # type: ignore[no-untyped-def]
        message.cross(rows, counts, is_counted, None)
        out[steps] = rows.mantissa[:, chain.cell]

    _meet_in_the_middle(chain, observations, cross)
    return out


Cross = Callable[[_Message, slice, Rows, np.ndarray, bool], None]
"""Carries a message across some steps, whose rows and expected counts it is given, and whether the
first of them counts: `_Message.cross`. Each half is crossed on its own thread."""


def _meet_in_the_middle(  # type: ignore[no-untyped-def]
    chain: Chain, observations: np.ndarray, cross: Cross
):
    """Form gamma over a sequence of two steps at least, some steps at a time, on two threads.

    Returns expected counts by target and by source cell, (2, O, G); gamma_1; the log-likelihood.
    """
    num_steps, num_cells = len(observations), chain.num_cells
    is_alone = num_steps * num_cells < _SHORT or _num_cores() == 1
    middle = num_steps // 2
    num_held = min(block_steps(num_cells), num_steps - middle)
    num_twice = num_steps - middle - num_held
    num_rows = num_held + min(segment_steps(num_twice, num_cells), num_twice)
    forward, backward = (_Message(chain, observations, ahead) for ahead in (True, False))
    with (
        _borrow_rows(num_rows, num_cells) as past_rows,
        _borrow_rows(num_rows, num_cells) as future_rows,
    ):
        past, future = _both(
            is_alone,
            _Half,
            (forward, slice(0, middle), past_rows, num_held),
            (backward, slice(middle, num_steps), future_rows, num_held),
        )
        (edge_in, _, log2_joint), (edge_out, initial, _) = _both(
            is_alone, _cross_half, (forward, future, cross), (backward, past, cross)
        )
    log_likelihood = log2_joint * np.log(2.0) + past.log_base + future.log_base
    return (edge_in, edge_out), initial, log_likelihood


def _both(  # type: ignore[no-untyped-def]
    is_alone: bool, work: Callable[..., Any], first: tuple[Any, ...], second: tuple[Any, ...]
):
    """Do two pieces of work, at once unless `is_alone`; returns both results."""
    if is_alone:
        return work(*first), work(*second)
    other = _helper().submit(work, *second)
    try:
        own = work(*first)
    finally:
        wait([other])  # it writes to what the caller is about to give back
    return own, other.result()


@functools.cache
def _helper() -> ThreadPoolExecutor:
    """The second thread, kept: starting one takes as long as a hundred steps."""
    return ThreadPoolExecutor(1, "rfl_torch")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helper.cache_clear)  # threads do not outlive a fork


def _num_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _cross_half(message: _Message, half: _Half, cross: Cross):  # type: ignore[no-untyped-def]
    """Carry `message` across the half that the other thread has run over."""
    counts = np.zeros(message.chain.weight_in.shape)
    log2_joint = None
    for steps, rows in half.from_middle():
        # Both messages take the step over the middle; the forward one counts it.
        is_counted = message.is_forward or log2_joint is not None
        if log2_joint is None:
            nearest = slice(0, 1) if message.is_forward else slice(-1, None)
            log2_joint = message.meet(rows.part(nearest))
        cross(message, steps, rows, counts, is_counted)
    return counts, rows.mantissa[0].astype(np.float64), log2_joint


def filter_rows(chain: Chain, observations: np.ndarray) -> tuple[np.ndarray, float]:
    """p(node at t | observations to t) over cells, float32 (T, G), and the log-likelihood."""
    filtered = np.empty((len(observations), chain.num_cells), np.float32)

    def keep(steps: slice, rows: Rows) -> None:
        kernels.normalized_rows(rows.mantissa, rows.exponent, filtered[steps])

    return filtered, _run_forward(chain, observations, keep)


def log_likelihood(chain: Chain, observations: np.ndarray) -> float:
    """Natural log of the observations' density [nat]; keeps nothing that grows with T."""
    return _run_forward(chain, observations, lambda steps, rows: None)


def _run_forward(
    chain: Chain, observations: np.ndarray, visit: Callable[[slice, Rows], None]
) -> float:
    """Run alpha over the sequence, showing the rows to `visit`; returns the log-likelihood."""
    forward = _Message(chain, observations, is_forward=True)
    out, log_base = np.empty((1, chain.num_cells), np.float32), 0.0
    with _borrow_rows(_CACHE_BLOCK, chain.num_cells) as rows:
        for steps in _blocks(slice(0, len(observations)), _CACHE_BLOCK):
            part = rows.part(slice(0, steps.stop - steps.start))
            log_base += forward.advance(steps, part)
            visit(steps, part)
        last = part.part(slice(-1, None))
        log2_sum = kernels.normalized_rows(last.mantissa, last.exponent, out)
    return log_base + log2_sum * float(np.log(2.0))


class FilterState(NamedTuple):
    """A belief over nodes between two control steps; `filter_step` advances it in place.

    mantissa, exponent: (2 G,), the belief as `kernels` keeps it, so that no node is ever lost.
    The rest is scratch, so that a step allocates nothing that grows.
    """

    mantissa: np.ndarray
    exponent: np.ndarray
    rows: Rows
    out: np.ndarray


def start_filter(chain: Chain, belief: np.ndarray | None = None) -> FilterState:
    """The state before the first step: a belief (N,) about the node before it, or uniform.

    What float64 has flushed to zero in `belief` stays possible: a teleport may need it.
    """
    num_cells = chain.num_cells
    log_row = chain.log_node.copy()
    if belief is not None:
        log_row[chain.cell] = np.log(np.maximum(belief, 1e-300))
    floats = [aligned_full((1, num_cells), 0.0, np.float32) for _ in range(2)]
    integers = [aligned_full((1, num_cells), 0, np.int32) for _ in range(2)]
    rows = Rows(floats[0], integers[0], floats[1], integers[1], np.zeros(1, np.int64))
    kernels.split_row(log_row[None], rows.mantissa, rows.exponent)
    mantissa, exponent = (
        aligned_full((2 * num_cells,), 0, dtype) for dtype in (np.float32, np.int32)
    )
    mantissa[:], exponent[:] = np.tile(rows.mantissa[0], 2), np.tile(rows.exponent[0], 2)
    return FilterState(mantissa, exponent, rows, aligned_full((1, num_cells), 0, np.float32))


def filter_step(
    chain: Chain, state: FilterState, observation: np.ndarray, teleport: float = 0.0
) -> tuple[np.ndarray, float]:
    """Push the belief over the edges and weigh it by an observation, float64 (D,).

    Args:
        chain: the model; another one of the same lattice may follow at any step.
        state: advanced in place.
        observation: NaN is a missing reading.
        teleport: share of the belief that is spread over all nodes before the observation counts.

    Returns:
        p(node | observations so far), float32 (N,), and log p(observation | those before) [nat].
    """
    rows, base = state.rows, np.empty(1)
    kernels.emission_rows(observation[None], *_gaussians(chain), rows.b, rows.b_exponent, base)
    jump = teleport / (len(chain.cell) * (1 - teleport))
    log2_sum, before = kernels.filter_row(
        state.mantissa, state.exponent, rows.b, rows.b_exponent,
        chain.shift_in, chain.weight_in, chain.weight_in_exponent,
        jump, rows.mantissa, rows.exponent, state.out,
    )  # fmt: skip
    if log2_sum == -np.inf:
        raise ValueError(_UNREACHABLE)
    log_sum = log2_sum * np.log(2.0) - np.log(before) + np.log1p(-teleport)
    return state.out[0, chain.cell], float(log_sum + base[0])


def most_likely_path(chain: Chain, observations: np.ndarray) -> np.ndarray:
    """Viterbi's path (section 2.3), int64 (T,) node indices; exact ties go to the lower shift.

    The choices of one block are held; those before it are made again from the scores at its start.
    """
    observations = np.ascontiguousarray(observations, np.float64)  # the kernels index rows
    score = _first_score(chain, observations)
    block_size = block_steps(chain.num_cells)
    blocks = list(_blocks(slice(0, len(observations) - 1), block_size))
    choice = np.empty((min(len(observations) - 1, block_size), chain.num_cells), np.uint16)
    starts = []
    for block in blocks:
        starts.append(score.copy())
        _choose(chain, observations, block, score, choice)
    path = np.empty(len(observations), np.int64)
    path[-1] = score[: chain.num_cells].argmax()
    for block, start in reversed(list(zip(blocks, starts, strict=True))):
        if block is not blocks[-1]:
            _choose(chain, observations, block, start, choice)
        steps = slice(block.start, block.stop + 1)
        own = choice[: block.stop - block.start]
        kernels.backtrack(own, chain.shift_in, path[block.stop], path[steps])
    node_of_cell = np.full(chain.num_cells, -1)
    node_of_cell[chain.cell] = np.arange(len(chain.cell))
    return node_of_cell[path]


def block_steps(num_cells: int) -> int:
    """Steps whose messages or choices are held at once."""
    return max(1, min(BLOCK, _MAX_ENTRIES // num_cells))


def segment_steps(num_steps: int, num_cells: int) -> int:
    """Steps that are run twice at once: so many that neither their rows nor the starts are many."""
    return max(math.isqrt(num_steps), _SEGMENT_CELLS // num_cells)


def _first_score(chain: Chain, observations: np.ndarray) -> np.ndarray:
    return np.tile(chain.initial_log + log_emission(chain, observations[:1])[0], 2)


def _choose(
    chain: Chain, observations: np.ndarray, block: slice, score: np.ndarray, choice: np.ndarray
) -> None:
    """Run Viterbi's recursion over the steps after each of `block`, from `score`, in place."""
    for steps in _blocks(block, _CACHE_BLOCK):
        log_rows = log_emission(chain, observations[1:][steps])
        own = choice[steps.start - block.start : steps.stop - block.start]
        kernels.best_rows(score, log_rows, chain.shift_in, chain.log_weight_in, own)


def viterbi_scores(chain: Chain, observations: np.ndarray) -> np.ndarray:
    """Logs of delta_T (section 2.3) over nodes, (N,), relative to the best path of all."""
    return window_scores(chain, log_emission(chain, observations))


def window_scores(chain: Chain, log_rows: np.ndarray) -> np.ndarray:
    """`viterbi_scores` from rows of `log_emission` (T, G), which a caller may keep."""
    score = np.tile(chain.initial_log + log_rows[0], 2)
    choice = np.empty((len(log_rows) - 1, chain.num_cells), np.uint16)
    kernels.best_rows(score, log_rows[1:], chain.shift_in, chain.log_weight_in, choice)
    return score[chain.cell] - score.max()


def _blocks(steps: slice, size: int, from_end: bool = False) -> Iterator[slice]:
    """Cut `steps` into slices of at most `size`, in order or last first."""
    edges = range(steps.start, steps.stop, size)
    for first in reversed(edges) if from_end else edges:
        yield slice(first, min(first + size, steps.stop))
