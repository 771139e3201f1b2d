"""Compiled recursions of a sparse HMM that can neither underflow nor lose a path.

A sparse graph with sharp Gaussians makes the node that the next frame needs thousands of nats less
likely than its rivals, far below any float. Every message entry is therefore a mantissa (float32,
in [1, 2), or 0) and an exponent of its own (int32, base 2); no log or exp is taken per edge.

Transitions are stored by diagonal: node i sits in cell c of a lattice of G cells, an edge leads
from cell c to cell (c + shift[o]) mod G, and `weight[o, c]` is its probability, 0 where there is no
edge. A grid has few distinct shifts, so one step is a handful of contiguous multiply-adds, taken
`simd.LANES` cells at a time; G is a multiple of that.

    alpha_t(i), beta_t(i)   rows of (mantissa, exponent), each relative to `base[t]`
    a_ij                    weight[o, c], again as mantissa and exponent
    b_j(o_t)                emission rows, likewise
    gamma_t(i)              `smoothed`, float32, rows sum to one
    sum_t xi_t(i, j)        `counts[o, c]`

Sources: Rabiner and Juang (1993), eqs. (1)-(10) of the paper; the separate exponents are ours.
"""

import math

import numpy as np
from numba import njit

from rfl_torch.simd import (
    LANES,
    add_lanes,
    aligned_row,
    any_lane,
    as_bits,
    as_float,
    broadcast,
    get,
    greater,
    largest,
    load,
    load_one,
    maximum,
    narrow,
    prefetch,
    put,
    registers,
    round_down,
    store,
    to_int,
    where,
    widen,
)  # fmt: skip

ABSENT = -(1 << 28)
"""Exponent of a zero: below every real one, and sums of three of them still fit an int32."""

NEGLIGIBLE = 2.0**-100
"""Posterior below which a cell is left out of a step's sums: they lose at most T times this."""

EDGES = 13
"""Diagonals whose summands stay in registers: those of a square grid of the paper's radius, pruned
or not. Any other number of them takes longer for each."""

CACHED_CELLS = 32_768
"""Steps times cells that are worked on at once: 16 bytes each, which a core's own cache holds."""

MIN_CACHED_STEPS = 64
"""Steps that are worked on at once however wide they are, so that what is done once a part pays."""

_FLAGS = {"contract", "nsz", "arcp"}  # never nnan/ninf: infinities and NaN keep their meaning

_LN_2 = math.log(2.0)
_LOG2_E = 1.0 / _LN_2
_HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)
_ABSENT, _NOTHING = np.int32(ABSENT), np.int32(2 * ABSENT)  # int32: a Python int would widen
_ZERO, _ONE, _NEGLIGIBLE = np.float32(0.0), np.float32(1.0), np.float32(NEGLIGIBLE)
_SMALLEST, _BIAS, _SHIFT = np.int32(1), np.int32(127), np.int32(23)  # of a float32's exponent
_FAINT = np.int32(127 - 116)  # a gamma of this exponent is under NEGLIGIBLE and set to zero:
# denormal numbers would cost more than all the rest of the step
_FRACTION_64, _ONE_64 = np.int64((1 << 52) - 1), np.int64(1023 << 52)  # of a float64
_FRACTION, _EXPONENT = np.int32(0x7FFFFF), np.int32(0xFF)
_TAYLOR = tuple(np.float32(1.0 / math.factorial(n)) for n in range(7, 1, -1))


@njit(forceinline=True)
def _power_of_two(biased):  # type: ignore[no-untyped-def]
    """2**(biased - 127) for biased <= 127; what is under 2**-126 becomes 2**-126."""
    return as_float(maximum(biased, broadcast(_SMALLEST)) << _SHIFT)


@njit(forceinline=True)
def _exponential(x):  # type: ignore[no-untyped-def]
    """e**x for |x| <= ln(2) / 2, to a float32's last place."""
    p = x * _TAYLOR[0] + _TAYLOR[1]
    p = p * x + _TAYLOR[2]
    p = p * x + _TAYLOR[3]
    p = p * x + _TAYLOR[4]
    p = p * x + _TAYLOR[5]
    return (p * x + _ONE) * x + _ONE


@njit(nogil=True, cache=True)
def log_emission_rows(observations, inverse_scale, scaled_mean, log_norm, log_node, power, out):  # type: ignore[no-untyped-def]
    """Evaluate log b_j(o_t) * power (eq. 1) in float64 [nat]; NaN readings are marginalised.

    Sums squared differences, so neither a narrow Gaussian nor an outlier cancels.
    observations (T, D); inverse_scale, scaled_mean = mean * inverse_scale, log_norm (D, G);
    log_node (G,), -inf in empty cells; out (T, G).
    """
    norm = _whole_norm(log_norm, log_node)
    for start in range(0, len(observations), 4):
        _log_rows(
            observations, start, inverse_scale, scaled_mean, log_norm, log_node, norm, power,
            out, start,
        )  # fmt: skip


@njit(forceinline=True)
def _whole_norm(log_norm, log_node):  # type: ignore[no-untyped-def]
    """Logarithm of the densities' factor where no reading is missing."""
    norm = log_node.copy()
    for d in range(log_norm.shape[0]):
        norm += log_norm[d]
    return norm


@njit
def _log_rows(  # type: ignore[no-untyped-def]
    observations, start, inverse_scale, scaled_mean, log_norm, log_node, norm, power, out, first_row
):
    """Up to four rows from `start` on, into `out` from `first_row` on; complete ones together.

    A row's bits do not depend on the rows that it is evaluated with.
    """
    count = min(4, len(observations) - start)
    has_gap = False
    for t in range(start, start + count):
        has_gap = has_gap or _is_incomplete(observations, t)
    if not has_gap:
        _four_rows(
            observations, start, count - 1, inverse_scale, scaled_mean, norm, power, out, first_row
        )  # fmt: skip
        return
    for k in range(count):
        t = start + k
        if _is_incomplete(observations, t):
            _one_row(
                observations[t], inverse_scale, scaled_mean, log_norm, log_node, power,
                out, first_row + k,
            )  # fmt: skip
        else:
            _four_rows(
                observations, t, 0, inverse_scale, scaled_mean, norm, power, out, first_row + k
            )  # fmt: skip


@njit(forceinline=True)
def _is_incomplete(observations, t):  # type: ignore[no-untyped-def]
    found = False
    for d in range(observations.shape[1]):
        found |= math.isnan(observations[t, d])
    return found


@njit
def _four_rows(  # type: ignore[no-untyped-def]
    x, start, last, inverse_scale, scaled_mean, norm, power, out, first_row
):
    """Rows of complete observations start .. start + last; each read of the parameters serves all.

    Fewer than four repeat the last one.
    """
    obs_dim, num_cells = inverse_scale.shape
    k1, k2, k3 = min(1, last), min(2, last), min(3, last)
    t0, t1 = start * obs_dim, (start + k1) * obs_dim
    t2, t3 = (start + k2) * obs_dim, (start + k3) * obs_dim
    for c in range(0, num_cells, LANES):
        sum0 = broadcast(0.0)
        sum1, sum2, sum3 = sum0, sum0, sum0
        for d in range(obs_dim):
            factor = load(inverse_scale, d * num_cells + c)
            offset = load(scaled_mean, d * num_cells + c)
            z0 = factor * load_one(x, t0 + d) - offset
            z1 = factor * load_one(x, t1 + d) - offset
            z2 = factor * load_one(x, t2 + d) - offset
            z3 = factor * load_one(x, t3 + d) - offset
            sum0 += z0 * z0
            sum1 += z1 * z1
            sum2 += z2 * z2
            sum3 += z3 * z3
        whole = load(norm, c)
        store((whole - sum0 * 0.5) * power, out, first_row * num_cells + c)
        store((whole - sum1 * 0.5) * power, out, (first_row + k1) * num_cells + c)
        store((whole - sum2 * 0.5) * power, out, (first_row + k2) * num_cells + c)
        store((whole - sum3 * 0.5) * power, out, (first_row + k3) * num_cells + c)


@njit
def _one_row(x, inverse_scale, scaled_mean, log_norm, log_node, power, out, row):  # type: ignore[no-untyped-def]
    """Log-density of one observation over its readings that are not NaN."""
    obs_dim, num_cells = inverse_scale.shape
    for c in range(0, num_cells, LANES):
        total = load(log_node, c)
        for d in range(obs_dim):
            if not math.isnan(x[d]):
                i = d * num_cells + c
                z = load(inverse_scale, i) * x[d] - load(scaled_mean, i)
                total += load(log_norm, i) - z * z * 0.5
        store(total * power, out, row * num_cells + c)


@njit(nogil=True, cache=True)
def emission_rows(  # type: ignore[no-untyped-def]
    observations, inverse_scale, scaled_mean, log_norm, log_node, power, mantissa, exponent, base
):
    """Split b_j(o_t) ** power into mantissas and exponents (T, G) and `base` (T,) [nat].

    Exponents are relative to the row's largest value; what lies more than 1.8e8 nats under it
    becomes a zero.
    """
    norm = _whole_norm(log_norm, log_node)
    log_rows = aligned_row(4 * inverse_scale.shape[1], 0.0).reshape(4, -1)
    for start in range(0, len(observations), 4):
        _log_rows(
            observations, start, inverse_scale, scaled_mean, log_norm, log_node, norm, power,
            log_rows, 0,
        )  # fmt: skip
        for t in range(start, min(start + 4, len(observations))):
            base[t] = _split_row(log_rows, t - start, mantissa, exponent, t)


@njit(nogil=True, cache=True)
def split_row(log_row, mantissa, exponent):  # type: ignore[no-untyped-def]
    """One row (1, G) of logs [nat] as mantissas and exponents (1, G); returns its base [nat]."""
    return _split_row(log_row, 0, mantissa, exponent, 0)


@njit
def _split_row(log_rows, row, mantissa, exponent, t):  # type: ignore[no-untyped-def]
    """exp(log_rows[row]) as mantissas and exponents relative to the largest, which is returned."""
    num_cells = log_rows.shape[1]
    top = broadcast(-np.inf)
    for c in range(0, num_cells, LANES):
        top = maximum(load(log_rows, row * num_cells + c), top)
    base = largest(top)
    lowest = broadcast(float(ABSENT))
    for c in range(0, num_cells, LANES):
        value = maximum((load(log_rows, row * num_cells + c) - base) * _LOG2_E, lowest)
        whole = round_down(value + 0.5)
        p = _exponential(narrow((value - whole) * _LN_2))
        is_there = greater(value, lowest)
        store(where(is_there, p, broadcast(_ZERO)), mantissa, t * num_cells + c)
        store(to_int(whole), exponent, t * num_cells + c)
    return base


@njit(forceinline=True)
def _gather(  # type: ignore[no-untyped-def]
    mantissa, exponent, first, shift, weight, weight_exponent, c, arriving
):
    """Sum over the edges of a tile: sum_o weight[o, c] * message[c + shift[o]] = total * 2**top.

    mantissa, exponent: (2 G,), the message written twice so that a shifted read is contiguous; cell
        c stands at `first`.
    arriving: int32 (O * LANES,), scratch for the summands' exponents.
    """
    num_shifts, num_cells = weight.shape
    top, total = broadcast(_NOTHING), broadcast(_ZERO)
    for o in range(num_shifts):
        own = load(exponent, load_one(shift, o) + first) + load(weight_exponent, o * num_cells + c)
        store(own, arriving, o * LANES)
        top = maximum(own, top)
    bottom = top - _BIAS
    for o in range(num_shifts):
        product = load(mantissa, load_one(shift, o) + first) * load(weight, o * num_cells + c)
        total += product * _power_of_two(load(arriving, o * LANES) - bottom)
    return top, total


@njit(forceinline=True)
def _gather_edges(mantissa, exponent, first, shift, weight, weight_exponent, c, held):  # type: ignore[no-untyped-def]
    """Do as `_gather` for EDGES diagonals, with the exponents `held` in registers."""
    num_cells = weight.shape[1]
    top, total = broadcast(_NOTHING), broadcast(_ZERO)
    for o in range(EDGES):
        own = load(exponent, load_one(shift, o) + first) + load(weight_exponent, o * num_cells + c)
        put(held, o, own)
        top = maximum(own, top)
    bottom = top - _BIAS
    for o in range(EDGES):
        product = load(mantissa, load_one(shift, o) + first) * load(weight, o * num_cells + c)
        total += product * _power_of_two(get(held, o) - bottom)
    return top, total


@njit(forceinline=True)
def _normalize(product, exponent):  # type: ignore[no-untyped-def]
    """Bring product * 2**exponent to a mantissa in [1, 2)."""
    bits = as_bits(product)
    own = ((bits >> _SHIFT) & _EXPONENT) - _BIAS
    one_to_two = as_float((bits & _FRACTION) | as_bits(broadcast(_ONE)))
    is_there = greater(product, broadcast(_ZERO))
    return where(is_there, one_to_two, broadcast(_ZERO)), where(
        is_there, own + exponent, broadcast(_ABSENT)
    )


@njit(forceinline=True)
def _rebase(mantissa, exponent, base, row, row_exponent):  # type: ignore[no-untyped-def]
    """Bring a row's largest exponent to 0, and lay it out twice as the next step's message."""
    num_cells = len(mantissa) // 2
    for c in range(0, num_cells, LANES):
        own = maximum(load(row_exponent, c) - base, broadcast(_ABSENT))
        store(own, row_exponent, c)
        _store_twice(load(row, c), mantissa, c, num_cells)
        _store_twice(own, exponent, c, num_cells)


@njit(forceinline=True)
def _store_twice(value, message, i, num_cells):  # type: ignore[no-untyped-def]
    """Write a tile of a message to both of its copies."""
    store(value, message, i)
    store(value, message, i + num_cells)


@njit
def _leave_first(mantissa, exponent, now):  # type: ignore[no-untyped-def]
    """Move the message that stands at `now`, 0 or the middle, to the beginning."""
    for i in range(0, now, LANES):
        store(load(mantissa, now + i), mantissa, i)
        store(load(exponent, now + i), exponent, i)


@njit(nogil=True, cache=True)
def message_rows(  # type: ignore[no-untyped-def]
    mantissa, exponent, top, b, b_exponent, shift, weight, weight_exponent,
    row, row_exponent, base, backward, is_kept,
):  # fmt: skip
    """Run b_t(j) * sum_i a_ij * message over a block; store every base and, if `is_kept`, each row.

    Forward (eq. 3): `weight` by destination. Backward (eq. 5): `weight` by source, last row first,
    and the rows are b_t beta_t, the message that eq. 5 sums.
    mantissa, exponent (4 G,), top int32 (1,): the message before the block, in their first half,
        and its largest exponent, which becomes the base of the first step; on return, after it.
    Returns False if some step has no mass at all.
    """
    num_steps, num_cells = row.shape
    arriving, held = aligned_row(len(shift) * LANES, _ABSENT), registers(EDGES, _ABSENT)
    now, then = 0, 2 * num_cells  # a step reads one message and writes the other
    ahead = -num_cells if backward else num_cells
    for k in range(num_steps):
        t = num_steps - 1 - k if backward else k
        top_of_row, below = broadcast(_NOTHING), top[0]
        for c in range(0, num_cells, LANES):
            i = t * num_cells + c
            if is_kept:  # the machine does not expect a stream that runs backwards
                prefetch(row, i + ahead)
                prefetch(row_exponent, i + ahead)
            if len(shift) == EDGES:
                highest, total = _gather_edges(
                    mantissa, exponent, now + c, shift, weight, weight_exponent, c, held
                )
            else:
                highest, total = _gather(
                    mantissa, exponent, now + c, shift, weight, weight_exponent, c, arriving
                )
            value, own = _normalize(total * load(b, i), highest + load(b_exponent, i) - below)
            own = maximum(own, broadcast(_ABSENT))
            if is_kept:
                store(value, row, i)
                store(own, row_exponent, i)
            _store_twice(value, mantissa, then + c, num_cells)
            _store_twice(own, exponent, then + c, num_cells)
            top_of_row = maximum(own, top_of_row)
        base[t] = below
        top[0] = largest(top_of_row)
        if top[0] <= _ABSENT:
            return False
        now, then = then, now
    _leave_first(mantissa, exponent, now)
    return True


@njit(nogil=True, cache=True)
def advance_rows(  # type: ignore[no-untyped-def]
    observations, inverse_scale, scaled_mean, log_norm, log_node, power, mantissa, exponent, top,
    shift, weight, weight_exponent, row, row_exponent, b, b_exponent, base, backward,
):  # fmt: skip
    """Do `emission_rows` and `message_rows` over a block, some steps at a time in the cache.

    One call a block: threads that return to the interpreter in between wait for each other.
    With fewer rows than steps no row is kept, and the emissions are written over and over.
    Returns the log base [nat] of the message; NaN if some step has no mass at all.
    """
    num_steps, num_rows, log_base = len(observations), len(row), 0.0
    is_kept = num_rows >= num_steps
    part_steps = _cached_steps(row.shape[1]) if is_kept else num_rows
    emission_base = np.empty(part_steps)
    num_parts = -(-num_steps // part_steps)
    for k in range(num_parts):
        first = (num_parts - 1 - k if backward else k) * part_steps
        count = min(part_steps, num_steps - first)
        start = first if is_kept else 0
        stop = start + count
        emission_rows(
            observations[first : first + count], inverse_scale, scaled_mean, log_norm, log_node,
            power, b[start:stop], b_exponent[start:stop], emission_base,
        )  # fmt: skip
        done = message_rows(
            mantissa, exponent, top, b[start:stop], b_exponent[start:stop],
            shift, weight, weight_exponent, row[start:stop], row_exponent[start:stop],
            base[start:stop], backward, is_kept,
        )  # fmt: skip
        if not done:
            return np.nan
        for t in range(count):
            log_base += emission_base[t] + base[start + t] * _LN_2
    return log_base


def cached_steps(num_cells: int) -> int:
    """Steps whose rows fit in a core's own cache, a multiple of four."""
    return max(MIN_CACHED_STEPS, CACHED_CELLS // num_cells // 4 * 4)


_cached_steps = njit(cached_steps)


@njit(nogil=True, cache=True)
def normalized_rows(row, row_exponent, out):  # type: ignore[no-untyped-def]
    """Write rows (T, G) as probabilities that sum to one; returns the last row's log2 sum."""
    num_steps, num_cells = row.shape
    log2_sum = 0.0
    for t in range(num_steps):
        top = broadcast(_NOTHING)
        for c in range(0, num_cells, LANES):
            top = maximum(load(row_exponent, t * num_cells + c), top)
        log2_sum = _to_probabilities(row, row_exponent, t * num_cells, largest(top), out, t)
    return log2_sum


@njit(forceinline=True)
def _to_probabilities(product, exponent, first, top, out, t):  # type: ignore[no-untyped-def]
    """Write product * 2**(exponent - top) to out[t], divided by its sum; returns its log2."""
    num_cells = out.shape[1]
    sums, bottom = broadcast(0.0), np.int32(top - _BIAS)
    for c in range(0, num_cells, LANES):
        scale = _power_of_two(load(exponent, first + c) - bottom)
        value = load(product, first + c) * scale
        store(value, out, t * num_cells + c)
        sums += widen(value)
    total = add_lanes(sums)
    if total == 0.0:
        return -np.inf
    factor = np.float32(1.0 / total)
    for c in range(0, num_cells, LANES):
        store(load(out, t * num_cells + c) * factor, out, t * num_cells + c)
    return math.log2(total) + top


@njit(nogil=True, cache=True)
def crossing_rows(  # type: ignore[no-untyped-def]
    mantissa, exponent, top, b, b_exponent, other, other_exponent, other_base,
    shift, weight, weight_exponent, normalizer, smoothed, counts, counts_first_step, backward,
):  # fmt: skip
    """Carry one message across a block whose other message is stored: gamma and sum of xi.

    At each step the message is pushed through the edges, gamma_t = pushed * other, and an edge's
    share of gamma is its share of the push, so xi needs no normaliser of its own:
    xi_t(i, j) = gamma_t(c) * term[o, c] / total[c].
    The normaliser, sum of pushed * other, is the same likelihood at every step but for the powers
    of two that the rows were divided by, so a step takes the one before it and gamma is final
    tile by tile; rows sum to one but for a step's rounding.
    other (T, G), other_base (T,): the stored rows. Forward: `other` = b_t beta_t rows and the
    emission enters after gamma is formed; backward: `other` = alpha_t rows, last row first.
    smoothed (T, G): gamma; it may be `other` itself.
    normalizer: float64 (2,), from `joint_sum` before the first block, carried on from there.
    counts: float64 (O, G), added to, the block's first step only if `counts_first_step`.
    """
    num_steps, num_cells = smoothed.shape
    now, then = 0, 2 * num_cells
    part = aligned_row(weight.size, _ZERO)
    arriving = aligned_row(len(shift) * LANES, _ABSENT)
    term = aligned_row(len(shift) * LANES, _ZERO)
    held, held_term = registers(EDGES, _ABSENT), registers(EDGES, _ZERO)
    ahead = -num_cells if backward else num_cells
    joint, power = normalizer[0], np.int64(normalizer[1])
    for k in range(num_steps):
        t = num_steps - 1 - k if backward else k
        top_of_row, sums, below = broadcast(_NOTHING), broadcast(0.0), top[0]
        factor, bottom = np.float32(1.0 / joint), np.int32(power - _BIAS)
        for c in range(0, num_cells, LANES):
            i = t * num_cells + c
            prefetch(b, i + ahead)
            prefetch(b_exponent, i + ahead)
            prefetch(other, i + ahead)
            prefetch(other_exponent, i + ahead)
            if len(shift) == EDGES:
                highest, total = _gather_edge_terms(
                    mantissa, exponent, now + c, shift, weight, weight_exponent, c, held, held_term
                )
            else:
                highest, total = _gather_terms(
                    mantissa, exponent, now + c, shift, weight, weight_exponent, c, arriving, term
                )
            there = load(other, i)
            own = where(
                greater(there * total, broadcast(_ZERO)),
                highest + load(other_exponent, i) - bottom,
                broadcast(_SMALLEST),
            )
            share = there * _power_of_two(own) * factor
            share = where(greater(own, broadcast(_FAINT)), share, broadcast(_ZERO))
            gamma = share * total
            store(gamma, smoothed, i)
            sums += widen(gamma)
            if (k > 0 or counts_first_step) and any_lane(greater(gamma, broadcast(_NEGLIGIBLE))):
                if len(shift) == EDGES:
                    for o in range(EDGES):
                        j = o * num_cells + c
                        store(load(part, j) + share * get(held_term, o), part, j)
                else:
                    for o in range(len(shift)):
                        j = o * num_cells + c
                        store(load(part, j) + share * load(term, o * LANES), part, j)
            value, own = _normalize(total * load(b, i), highest + load(b_exponent, i) - below)
            own = maximum(own, broadcast(_ABSENT))
            _store_twice(value, mantissa, then + c, num_cells)
            _store_twice(own, exponent, then + c, num_cells)
            top_of_row = maximum(own, top_of_row)
        if k % 256 == 255 or k == num_steps - 1:  # float32 sums stay short
            _add_part(part, counts)
        joint *= add_lanes(sums)
        top[0] = largest(top_of_row)
        now, then = then, now
        if joint == 0.0:
            break
        power += other_base[t] - below
    _leave_first(mantissa, exponent, now)
    normalizer[0], normalizer[1] = joint, power


@njit(nogil=True, cache=True)
def crossing_sums(  # type: ignore[no-untyped-def]
    mantissa, exponent, top, b, b_exponent, other, other_exponent, other_base,
    shift, weight, weight_exponent, normalizer, counts, counts_first_step, backward,
    observations, center, with_gaps, sums,
):  # fmt: skip
    """Do `crossing_rows` and `add_moments` over a block, some steps at a time in the cache.

    gamma takes the place of `other`.
    """
    num_steps, part_steps = len(other), _cached_steps(other.shape[1])
    num_parts = -(-num_steps // part_steps)
    for k in range(num_parts):
        first = (num_parts - 1 - k if backward else k) * part_steps
        last = min(first + part_steps, num_steps)
        crossing_rows(
            mantissa, exponent, top, b[first:last], b_exponent[first:last], other[first:last],
            other_exponent[first:last], other_base[first:last], shift, weight, weight_exponent,
            normalizer, other[first:last], counts, counts_first_step or k > 0, backward,
        )  # fmt: skip
        if not 0.0 < normalizer[0] < np.inf:
            return
        add_moments(other[first:last], observations[first:last], center, with_gaps, sums)


@njit(nogil=True, cache=True)
def joint_sum(  # type: ignore[no-untyped-def]
    mantissa, exponent, other, other_exponent, shift, weight, weight_exponent, normalizer
):
    """Sum of the pushed message times a row (1, G) of `other`, as normalizer[0] * 2**normalizer[1].

    With the bases of both messages its log2 is the log-likelihood. 0 if no node is alive in both.
    """
    num_cells, lowest = other.shape[1], broadcast(np.int32(4 * ABSENT))
    row, row_exponent = aligned_row(num_cells, _ZERO), aligned_row(num_cells, _ABSENT)
    arriving = aligned_row(len(shift) * LANES, _ABSENT)
    highest, sums = lowest, broadcast(0.0)
    for c in range(0, num_cells, LANES):
        top, total = _gather(mantissa, exponent, c, shift, weight, weight_exponent, c, arriving)
        product = total * load(other, c)
        is_there = greater(product, broadcast(_ZERO))
        own = where(is_there, top + load(other_exponent, c), lowest)
        store(product, row, c)
        store(own, row_exponent, c)
        highest = maximum(own, highest)
    power = largest(highest)
    for c in range(0, num_cells, LANES):
        scale = _power_of_two(load(row_exponent, c) - np.int32(power - _BIAS))
        sums += widen(load(row, c) * scale)
    normalizer[0], normalizer[1] = add_lanes(sums), power


@njit(forceinline=True)
def _gather_terms(  # type: ignore[no-untyped-def]
    mantissa, exponent, first, shift, weight, weight_exponent, c, arriving, term
):
    """Do as `_gather`, and leave the summands, which add up to `total`, in `term`."""
    num_shifts, num_cells = weight.shape
    top, total = broadcast(_NOTHING), broadcast(_ZERO)
    for o in range(num_shifts):
        own = load(exponent, load_one(shift, o) + first) + load(weight_exponent, o * num_cells + c)
        store(own, arriving, o * LANES)
        top = maximum(own, top)
    bottom = top - _BIAS
    for o in range(num_shifts):
        product = load(mantissa, load_one(shift, o) + first) * load(weight, o * num_cells + c)
        product = product * _power_of_two(load(arriving, o * LANES) - bottom)
        store(product, term, o * LANES)
        total += product
    return top, total


@njit(forceinline=True)
def _gather_edge_terms(  # type: ignore[no-untyped-def]
    mantissa, exponent, first, shift, weight, weight_exponent, c, held, term
):
    """Do as `_gather_terms` for EDGES diagonals, in registers."""
    num_cells = weight.shape[1]
    top, total = broadcast(_NOTHING), broadcast(_ZERO)
    for o in range(EDGES):
        own = load(exponent, load_one(shift, o) + first) + load(weight_exponent, o * num_cells + c)
        put(held, o, own)
        top = maximum(own, top)
    bottom = top - _BIAS
    for o in range(EDGES):
        product = load(mantissa, load_one(shift, o) + first) * load(weight, o * num_cells + c)
        product = product * _power_of_two(get(held, o) - bottom)
        put(term, o, product)
        total += product
    return top, total


@njit(forceinline=True)
def _add_part(part, counts):  # type: ignore[no-untyped-def]
    """Do counts += part in float64, and empty so much of `part`."""
    for i in range(0, counts.size, LANES):
        store(load(counts, i) + widen(load(part, i)), counts, i)
        store(broadcast(_ZERO), part, i)


@njit(nogil=True, cache=True)
def add_moments(smoothed, observations, center, with_gaps, sums):  # type: ignore[no-untyped-def]
    """Do sums (F, G) float64 += features (T, F) transposed times smoothed (T, G) float32.

    The features are 1, x and x**2 with x = observations - center, 0 where missing, and, if
    `with_gaps`, whether each reading is missing. Cells whose gamma is negligible are left out.
    """
    num_steps, num_cells = smoothed.shape
    obs_dim, num_features = observations.shape[1], sums.shape[0]
    width = -(-num_features // 7) * 7
    features = np.zeros((min(256, num_steps), width), np.float32)
    part = aligned_row(width * num_cells, _ZERO).reshape(width, num_cells)
    for start in range(0, num_steps, 256):  # float32 sums stay short
        stop = min(start + 256, num_steps)
        for t in range(start, stop):
            features[t - start, 0] = _ONE
            for d in range(obs_dim):
                x = observations[t, d] - center[d]
                is_missing = math.isnan(x)
                x = 0.0 if is_missing else x
                features[t - start, 1 + d] = x
                features[t - start, 1 + obs_dim + d] = x * x
                if with_gaps:
                    features[t - start, 1 + 2 * obs_dim + d] = _ONE if is_missing else _ZERO
        for first in range(start, stop, 16):
            _add_outer(smoothed, first, min(first + 16, stop), features, start, part)
        _add_part(part, sums)


@njit
def _add_outer(smoothed, first, last, features, start, part):  # type: ignore[no-untyped-def]
    """Do part += features transposed times smoothed over some steps, seven features a time."""
    num_features, num_cells = part.shape
    for c in range(0, num_cells, LANES):
        top = broadcast(_ZERO)
        for t in range(first, last):
            top = maximum(load(smoothed, t * num_cells + c), top)
        if not any_lane(greater(top, broadcast(_NEGLIGIBLE))):
            continue
        for f in range(0, num_features, 7):
            i = f * num_cells + c
            sum0, sum1 = load(part, i), load(part, i + num_cells)
            sum2, sum3 = load(part, i + 2 * num_cells), load(part, i + 3 * num_cells)
            sum4, sum5 = load(part, i + 4 * num_cells), load(part, i + 5 * num_cells)
            sum6 = load(part, i + 6 * num_cells)
            for t in range(first, last):
                gamma = load(smoothed, t * num_cells + c)
                j = (t - start) * num_features + f
                sum0 += gamma * load_one(features, j)
                sum1 += gamma * load_one(features, j + 1)
                sum2 += gamma * load_one(features, j + 2)
                sum3 += gamma * load_one(features, j + 3)
                sum4 += gamma * load_one(features, j + 4)
                sum5 += gamma * load_one(features, j + 5)
                sum6 += gamma * load_one(features, j + 6)
            store(sum0, part, i)
            store(sum1, part, i + num_cells)
            store(sum2, part, i + 2 * num_cells)
            store(sum3, part, i + 3 * num_cells)
            store(sum4, part, i + 4 * num_cells)
            store(sum5, part, i + 5 * num_cells)
            store(sum6, part, i + 6 * num_cells)


@njit(nogil=True, cache=True)
def filter_row(  # type: ignore[no-untyped-def]
    mantissa, exponent, b, b_exponent, shift, weight, weight_exponent, jump, row, row_exponent, out
):
    """One step of eq. 3 in place, with a share of the belief spread evenly over all nodes.

    mantissa, exponent (2 G,): the belief; b, b_exponent (1, G); row, row_exponent, out (1, G).
    jump: what each node gets of the spread share, relative to the rest of the belief; with 0 the
    step is `message_rows`'. `out` becomes the belief as probabilities.
    Returns log2 of the step's sum and the belief's sum before it, whose ratio is the evidence.
    """
    num_cells = out.shape[1]
    arriving = aligned_row(len(shift) * LANES, _ABSENT)
    sums = broadcast(0.0)
    for c in range(0, num_cells, LANES):
        sums += widen(load(mantissa, c) * _power_of_two(load(exponent, c) + _BIAS))
    before = add_lanes(sums)
    jump_mantissa, jump_exponent = np.float32(0.0), _ABSENT
    if jump > 0.0:
        fraction, power = math.frexp(jump * before)
        jump_mantissa, jump_exponent = np.float32(fraction), np.int32(power)
    top_of_row = broadcast(_NOTHING)
    for c in range(0, num_cells, LANES):
        top, total = _gather(mantissa, exponent, c, shift, weight, weight_exponent, c, arriving)
        if jump > 0.0:
            higher = maximum(top, broadcast(jump_exponent))
            total = total * _power_of_two(top - higher + _BIAS)
            total += _power_of_two(broadcast(jump_exponent) - higher + _BIAS) * jump_mantissa
            top = higher
        value, own = _normalize(total * load(b, c), top + load(b_exponent, c))
        store(value, row, c)
        store(own, row_exponent, c)
        top_of_row = maximum(own, top_of_row)
    highest = largest(top_of_row)
    if highest <= _ABSENT:
        return -np.inf, before
    _rebase(mantissa, exponent, highest, row, row_exponent)
    return _to_probabilities(row, row_exponent, 0, np.int32(0), out, 0) + highest, before


@njit(nogil=True, cache=True)
def best_rows(score, log_emission, shift, log_weight, choice):  # type: ignore[no-untyped-def]
    """Viterbi's max-product recursion over a block, in float64 logs.

    score (2 G,): the log-scores before the block, written twice; on return, after it.
    log_emission (T, G); log_weight (O, G) by destination; choice (T, G) uint16: the best diagonal.
    """
    num_steps, num_cells = log_emission.shape
    best = np.empty(num_cells, np.float64)
    for t in range(num_steps):
        best[:] = -np.inf
        choice[t, :] = 0
        for o in range(shift.shape[0]):
            first = shift[o]
            for c in range(num_cells):
                candidate = score[first + c] + log_weight[o, c]
                is_better = candidate > best[c]
                best[c] = candidate if is_better else best[c]
                choice[t, c] = o if is_better else choice[t, c]
        largest = -np.inf
        for c in range(num_cells):
            best[c] += log_emission[t, c]
            largest = max(largest, best[c])
        for c in range(num_cells):
            score[c] = best[c] - largest
        score[num_cells:] = score[:num_cells]


@njit(nogil=True, cache=True)
def backtrack(choice, shift, last, path):  # type: ignore[no-untyped-def]
    """Follow `choice` back from cell `last`; path (T+1,), path[0] is the cell before the block."""
    num_cells = choice.shape[1]
    path[-1] = last
    for t in range(choice.shape[0] - 1, -1, -1):
        last = (last + shift[choice[t, last]]) % num_cells
        path[t] = last


@njit(nogil=True, cache=True)
def lay_out_edges(  # type: ignore[no-untyped-def]
    logits, odds, lowest, slot, entering, leaving, weight_in, weight_in_exponent, weight_out,
    weight_out_exponent, log_weight_in,
):  # fmt: skip
    """Write a_ij, the shares of each node's odds, to the tables (O, G) of a chain, laid out flat.

    logits (N, K): -inf where there is no edge; odds = exp(logits), taken outside, where it is done
    eight at a time. lowest: floor of log a_ij [nat]. slot, entering, leaving (E,): `Diagonals`.
    """
    log_total = np.empty(logits.shape[0])
    total = np.empty(logits.shape[0])
    for n in range(logits.shape[0]):
        total[n] = 0.0
        for k in range(logits.shape[1]):
            total[n] += odds[n, k]
        log_total[n] = math.log(total[n])
    share, one_to_two = np.empty(1), np.empty(1)
    bits, own_bits = share.view(np.int64), one_to_two.view(np.int64)
    smallest, width = math.exp(lowest), logits.shape[1]
    for e in range(len(slot)):
        n = slot[e] // width
        k = slot[e] - n * width
        share[0] = max(odds[n, k] / total[n], smallest)
        own_bits[0] = (bits[0] & _FRACTION_64) | _ONE_64
        mantissa, power = np.float32(one_to_two[0]), np.int32((bits[0] >> 52) - 1023)
        into, out_of = entering[e], leaving[e]
        log_weight_in[into] = max(logits[n, k] - log_total[n], lowest)
        weight_in[into], weight_in_exponent[into] = mantissa, power
        weight_out[out_of], weight_out_exponent[out_of] = mantissa, power


@njit(nogil=True, cache=True)
def lay_out_gaussians(mean, log_scale, factor, cell, inverse_scale, scaled_mean, log_norm):  # type: ignore[no-untyped-def]
    """Write (N, D) parameters to the tables (D, G) of a chain; factor = exp(-log_scale)."""
    for n in range(mean.shape[0]):
        c = cell[n]
        for d in range(mean.shape[1]):
            inverse_scale[d, c] = factor[n, d]
            scaled_mean[d, c] = mean[n, d] * factor[n, d]
            log_norm[d, c] = -_HALF_LOG_2_PI - log_scale[n, d]


@njit(nogil=True, cache=True)
def expected_moments(sums, cell, center, with_gaps, node, weight, first, second):  # type: ignore[no-untyped-def]
    """Turn `add_moments`' sums of two halves (2, F, G) into moments about zero, by node (N, D)."""
    obs_dim = len(center)
    for n in range(len(cell)):
        c = cell[n]
        node[n] = sums[0, 0, c] + sums[1, 0, c]
        for d in range(obs_dim):
            known = node[n]
            if with_gaps:
                known -= sums[0, 1 + 2 * obs_dim + d, c] + sums[1, 1 + 2 * obs_dim + d, c]
            total = sums[0, 1 + d, c] + sums[1, 1 + d, c]
            squares = sums[0, 1 + obs_dim + d, c] + sums[1, 1 + obs_dim + d, c]
            weight[n, d] = known
            first[n, d] = total + known * center[d]
            second[n, d] = squares + 2 * center[d] * total + known * center[d] ** 2


@njit(nogil=True, cache=True)
def best_edges(counts, mask, pseudo_count, least, lowest, logits):  # type: ignore[no-untyped-def]
    """M-step of the transitions (N, K) (eq. 8), in place: log shares, not under `lowest`.

    A node with no more than `least` transitions keeps its own.
    """
    for n in range(counts.shape[0]):
        total = 0.0
        for k in range(counts.shape[1]):
            total += counts[n, k] + pseudo_count if mask[n, k] else 0.0
        if total > least:
            for k in range(counts.shape[1]):
                if mask[n, k]:
                    share = (counts[n, k] + pseudo_count) / total
                    logits[n, k] = max(math.log(share), lowest) if share > 0.0 else lowest


@njit(nogil=True, cache=True)
def best_gaussians(  # type: ignore[no-untyped-def]
    weight, first, second, trace, min_variance, least, mean, log_scale, variance
):
    """M-step of the Gaussians (N, D) (eqs. 9-11): `mean` in place, and the new variances.

    A reading of a node that was had no more than `least` times keeps its own mean; its variance is
    1, to be overlooked.
    """
    for n in range(mean.shape[0]):
        for d in range(mean.shape[1]):
            variance[n, d] = 1.0
            if weight[n, d] > least:
                new = first[n, d] / weight[n, d]
                spread = max(second[n, d] / weight[n, d] - new**2, min_variance)
                if trace > 0.0:
                    new = (1 - trace) * new + trace * mean[n, d]
                    spread = (1 - trace) * spread + trace * math.exp(2 * log_scale[n, d])
                mean[n, d] = new
                variance[n, d] = max(spread, min_variance)
