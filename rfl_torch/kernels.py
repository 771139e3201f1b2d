"""Compiled recursions of a sparse HMM that can neither underflow nor lose a path.

A sparse graph with sharp Gaussians makes the node that the next frame needs thousands of nats less
likely than its rivals, far below any float. Every message entry is therefore a mantissa (float32,
in [1, 2), or 0) and an exponent of its own (int32, base 2); no log or exp is taken per edge.

Transitions are stored by diagonal: node i sits in cell c of a lattice of G cells, an edge leads
from cell c to cell (c + shift[o]) mod G, and `weight[o, c]` is its probability, 0 where there is no
edge. A grid has few distinct shifts, so one step is a handful of contiguous multiply-adds.

    alpha_t(i), beta_t(i)   rows of (mantissa, exponent), each relative to `base[t]`
    a_ij                    weight[o, c], again as mantissa and exponent
    b_j(o_t)                emission rows, likewise
    gamma_t(i)              `smoothed`, float32, rows sum to one
    sum_t xi_t(i, j)        `counts[o, c]`

Sources: Rabiner and Juang (1993), eqs. (1)-(10) of the paper; the separate exponents are ours.
"""

import math

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

ABSENT = -(1 << 28)
"""Exponent of a zero: below every real one, and sums of three of them still fit an int32."""

_LN_2 = math.log(2.0)
_LOG2_E = 1.0 / _LN_2
_FLAGS = {"contract", "nsz", "arcp"}  # never nnan/ninf: infinities and NaN keep their meaning


@intrinsic
def _as_float(typing_context, bits):  # type: ignore[no-untyped-def]
    """Reinterpret an int32 as the float32 with the same bits."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), generate


@intrinsic
def _as_bits(typing_context, value):  # type: ignore[no-untyped-def]
    """Reinterpret a float32 as the int32 with the same bits."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return builder.bitcast(args[0], ir.IntType(32))

    return types.int32(types.float32), generate


@njit(inline="always")
def _power_of_two(exponent):  # type: ignore[no-untyped-def]
    """2**exponent for an int32 exponent <= 0; what is under 2**-126 becomes 2**-126."""
    clipped = max(exponent, np.int32(-126))
    return _as_float(np.int32((clipped + np.int32(127)) << np.int32(23)))


@njit(nogil=True, cache=True, fastmath=_FLAGS)
def emission_rows(observations, inverse_scale, scaled_mean, log_norm, temperature, out):  # type: ignore[no-untyped-def]
    """Evaluate log b_j(o_t) * temperature (eq. 1) in float64 [nat]; NaN readings are marginalised.

    Sums squared differences, so neither a narrow Gaussian nor an outlier cancels. Four steps share
    each read of the parameters.
    observations (T, D); inverse_scale, scaled_mean = mean * inverse_scale, log_norm (D, G);
    out (T, G).
    """
    num_steps, obs_dim = observations.shape
    num_cells = out.shape[1]
    norm = np.zeros(num_cells)
    for d in range(obs_dim):
        norm += log_norm[d]
    start = 0
    while start < num_steps:
        stop = min(start + 4, num_steps)
        has_gap = False
        for t in range(start, stop):
            for d in range(obs_dim):
                has_gap = has_gap or math.isnan(observations[t, d])
        if stop - start == 4 and not has_gap:
            _four_rows(observations[start:stop], inverse_scale, scaled_mean, out[start:stop])
            for t in range(start, stop):
                for j in range(num_cells):
                    out[t, j] = temperature * (norm[j] - 0.5 * out[t, j])
        else:
            for t in range(start, stop):
                _one_row(observations[t], inverse_scale, scaled_mean, log_norm, out[t])
                out[t] *= temperature
        start = stop


@njit(nogil=True, cache=True, fastmath=_FLAGS)
def _four_rows(x, inverse_scale, scaled_mean, out):  # type: ignore[no-untyped-def]
    """Squared scaled distances of four complete observations."""
    out[:] = 0.0
    row0, row1, row2, row3 = out[0], out[1], out[2], out[3]
    for d in range(x.shape[1]):
        x0, x1, x2, x3 = x[0, d], x[1, d], x[2, d], x[3, d]
        factor, offset = inverse_scale[d], scaled_mean[d]
        for j in range(row0.shape[0]):
            z0 = x0 * factor[j] - offset[j]
            z1 = x1 * factor[j] - offset[j]
            z2 = x2 * factor[j] - offset[j]
            z3 = x3 * factor[j] - offset[j]
            row0[j] += z0 * z0
            row1[j] += z1 * z1
            row2[j] += z2 * z2
            row3[j] += z3 * z3


@njit(nogil=True, cache=True, fastmath=_FLAGS)
def _one_row(x, inverse_scale, scaled_mean, log_norm, out):  # type: ignore[no-untyped-def]
    """Log-density of one observation over its readings that are not NaN."""
    out[:] = 0.0
    for d in range(x.shape[0]):
        if math.isnan(x[d]):
            continue
        for j in range(out.shape[0]):
            z = x[d] * inverse_scale[d, j] - scaled_mean[d, j]
            out[j] += log_norm[d, j] - 0.5 * z * z


@njit(nogil=True, cache=True, fastmath=_FLAGS)
def split_rows(log_rows, mantissa, exponent, base):  # type: ignore[no-untyped-def]
    """exp(log_rows) as mantissas and exponents relative to each row's largest, `base` [nat].

    What lies more than 1.8e8 nats under its row's largest value becomes a zero.
    """
    for t in range(log_rows.shape[0]):
        largest = -np.inf
        for j in range(log_rows.shape[1]):
            largest = max(largest, log_rows[t, j])
        base[t] = largest
        for j in range(log_rows.shape[1]):
            value = max((log_rows[t, j] - largest) * _LOG2_E, float(ABSENT))
            whole = math.floor(value + 0.5)
            x = np.float32((value - whole) * _LN_2)
            p = np.float32(1.0 / 5040.0)
            p = p * x + np.float32(1.0 / 720.0)
            p = p * x + np.float32(1.0 / 120.0)
            p = p * x + np.float32(1.0 / 24.0)
            p = p * x + np.float32(1.0 / 6.0)
            p = p * x + np.float32(0.5)
            p = p * x + np.float32(1.0)
            p = p * x + np.float32(1.0)
            mantissa[t, j] = p if value > ABSENT else np.float32(0.0)
            exponent[t, j] = np.int32(whole)


@njit(nogil=True, cache=True, fastmath=_FLAGS)
def _gather(mantissa, exponent, shift, weight, weight_exponent, top, total, term):  # type: ignore[no-untyped-def]
    """Sum over edges: total[c] * 2**top[c] = sum_o weight[o, c] * message[(c + shift[o]) mod G].

    mantissa, exponent: (2 G,), the message written twice so that a shifted read is contiguous.
    term: (O, G), the summands at the scale 2**top[c], kept for the expected counts.
    """
    num_cells = top.shape[0]
    top[:] = np.int32(2 * ABSENT)
    total[:] = np.float32(0.0)
    for o in range(shift.shape[0]):
        _raise_top(top, exponent[shift[o] : shift[o] + num_cells], weight_exponent[o])
    for o in range(shift.shape[0]):
        window = slice(shift[o], shift[o] + num_cells)
        _add_scaled(
            total, term[o], mantissa[window], weight[o], exponent[window], weight_exponent[o], top
        )


@njit(nogil=True, cache=True, fastmath=_FLAGS)
def _raise_top(top, exponent, weight_exponent):  # type: ignore[no-untyped-def]
    """Set top = max(top, exponent + weight_exponent); alone in a function, it vectorises."""
    for c in range(top.shape[0]):
        top[c] = max(top[c], np.int32(exponent[c] + weight_exponent[c]))


@njit(nogil=True, cache=True, fastmath=_FLAGS)
def _add_scaled(total, term, mantissa, weight, exponent, weight_exponent, top):  # type: ignore[no-untyped-def]
    """Do total += mantissa * weight * 2**(exponents - top), keeping the summand in `term`."""
    for c in range(total.shape[0]):
        scale = _power_of_two(np.int32(exponent[c] + weight_exponent[c] - top[c]))
        product = weight[c] * mantissa[c] * scale
        term[c] = product
        total[c] += product


@njit(nogil=True, cache=True, fastmath=_FLAGS)
def _scaled_product(a, a_exponent, b, b_exponent, mantissa, exponent):  # type: ignore[no-untyped-def]
    """(a 2**ea)(b 2**eb), normalised; returns the largest exponent."""
    largest = np.int32(2 * ABSENT)
    for c in range(mantissa.shape[0]):
        product = a[c] * b[c]
        bits = _as_bits(product)
        is_zero = product == np.float32(0.0)
        own = ((bits >> np.int32(23)) & np.int32(255)) - np.int32(127)
        one_to_two = _as_float((bits & np.int32(0x7FFFFF)) | np.int32(0x3F800000))
        mantissa[c] = np.float32(0.0) if is_zero else one_to_two
        exponent[c] = np.int32(ABSENT) if is_zero else own + a_exponent[c] + b_exponent[c]
        largest = max(largest, exponent[c])
    return largest


@njit(nogil=True, cache=True)
def _write_twice(mantissa, exponent, base, twice_mantissa, twice_exponent):  # type: ignore[no-untyped-def]
    """Lay a row out twice and bring its largest exponent to 0, in both copies."""
    num_cells = mantissa.shape[0]
    for c in range(num_cells):
        exponent[c] = max(exponent[c] - base, np.int32(ABSENT))
        twice_mantissa[c] = mantissa[c]
        twice_exponent[c] = exponent[c]
    twice_mantissa[num_cells:] = mantissa
    twice_exponent[num_cells:] = exponent


@njit(nogil=True, cache=True)
def message_rows(  # type: ignore[no-untyped-def]
    mantissa, exponent, b, b_exponent, shift, weight, weight_exponent, row, row_exponent, base
):
    """Run b_t(j) * sum_i a_ij * message over a block, storing every row and its base.

    Forward (eq. 3): `weight` by destination, rows in time order. Backward (eq. 5): `weight` by
    source, rows in reversed time order, and the rows are b_t beta_t, the message that eq. 5 sums.
    mantissa, exponent (2 G,): the message before the block; on return, after it.
    Returns False if some step has no mass at all.
    """
    num_cells = row.shape[1]
    top = np.empty(num_cells, np.int32)
    total = np.empty(num_cells, np.float32)
    term = np.empty((shift.shape[0], num_cells), np.float32)
    for t in range(row.shape[0]):
        _gather(mantissa, exponent, shift, weight, weight_exponent, top, total, term)
        largest = _scaled_product(total, top, b[t], b_exponent[t], row[t], row_exponent[t])
        if largest <= ABSENT:
            return False
        _write_twice(row[t], row_exponent[t], largest, mantissa, exponent)
        base[t] = largest
    return True


@njit(nogil=True, cache=True, fastmath=_FLAGS)
def normalized_product(a, a_exponent, b, b_exponent, out):  # type: ignore[no-untyped-def]
    """Write a*b as probabilities that sum to one; returns (log2 of the sum) or -inf."""
    top = np.int32(4 * ABSENT)
    for c in range(out.shape[0]):
        alive = a[c] * b[c] > np.float32(0.0)
        top = max(top, a_exponent[c] + b_exponent[c] if alive else np.int32(4 * ABSENT))
    total = np.float64(0.0)
    for c in range(out.shape[0]):
        out[c] = a[c] * b[c] * _power_of_two(min(a_exponent[c] + b_exponent[c] - top, np.int32(0)))
        total += out[c]
    if total == 0.0:
        return -np.inf
    scale = np.float32(1.0 / total)
    for c in range(out.shape[0]):
        out[c] *= scale
    return math.log2(total) + top


@njit(nogil=True, cache=True, fastmath=_FLAGS)
def crossing_rows(  # type: ignore[no-untyped-def]
    mantissa, exponent, b, b_exponent, other, other_exponent,
    shift, weight, weight_exponent, smoothed, counts, counts_first_step,
):  # fmt: skip
    """Carry one message across a block whose other message is stored: gamma and sum of xi.

    At each step the message is pushed through the edges, gamma_t = pushed * other, and the edge's
    share of gamma is its share of the push, so xi needs no product of its own:
    xi_t(i, j) = gamma_t(c) * term[o, c] / total[c].
    other (T, G): the stored rows. Forward: `other` = b_t beta_t rows and the emission enters after
    gamma is formed; backward: `other` = alpha_t rows. `counts` (O, G) float64 is added to, the
    block's first step only if `counts_first_step`.
    Returns log2 of the first step's normaliser, sum of pushed * other: with the bases of both
    messages it is the log-likelihood.
    """
    num_cells = smoothed.shape[1]
    num_shifts = shift.shape[0]
    top = np.empty(num_cells, np.int32)
    total = np.empty(num_cells, np.float32)
    ratio = np.empty(num_cells, np.float32)
    term = np.empty((num_shifts, num_cells), np.float32)
    part = np.zeros((num_shifts, num_cells), np.float32)
    row = np.empty(num_cells, np.float32)
    row_exponent = np.empty(num_cells, np.int32)
    first_log2_sum = 0.0
    for t in range(smoothed.shape[0]):
        _gather(mantissa, exponent, shift, weight, weight_exponent, top, total, term)
        log2_sum = normalized_product(total, top, other[t], other_exponent[t], smoothed[t])
        if t == 0:
            first_log2_sum = log2_sum
        for c in range(num_cells):
            ratio[c] = smoothed[t, c] / max(total[c], np.float32(1e-30))
        for o in range(num_shifts):
            _add_product(part[o], ratio, term[o])
        if t == 0 and not counts_first_step:
            part[:] = 0.0
        if t % 256 == 255 or t == smoothed.shape[0] - 1:  # float32 sums stay short
            for o in range(num_shifts):
                for c in range(num_cells):
                    counts[o, c] += part[o, c]
                    part[o, c] = np.float32(0.0)
        largest = _scaled_product(total, top, b[t], b_exponent[t], row, row_exponent)
        _write_twice(row, row_exponent, largest, mantissa, exponent)
    return first_log2_sum


@njit(nogil=True, cache=True, fastmath=_FLAGS)
def _add_product(total, a, b):  # type: ignore[no-untyped-def]
    """Do total += a * b."""
    for c in range(total.shape[0]):
        total[c] += a[c] * b[c]


@njit(nogil=True, cache=True)
def add_outer(smoothed, features, sums):  # type: ignore[no-untyped-def]
    """Do sums (F, G) float64 += features (T, F) transposed times smoothed (T, G), both float32.

    A BLAS would spend longer waking its threads for blocks that fit the cache.
    """
    num_steps, num_cells = smoothed.shape
    part = np.zeros((features.shape[1], num_cells), np.float32)
    for start in range(0, num_steps, 256):  # float32 sums stay short
        stop = min(start + 256, num_steps)
        for t in range(start, stop - 7, 8):
            for f in range(features.shape[1]):
                _add_eight(part[f], smoothed[t : t + 8], features[t : t + 8, f])
        for t in range(stop - (stop - start) % 8, stop):
            for f in range(features.shape[1]):
                part[f] += smoothed[t] * features[t, f]
        sums += part
        part[:] = np.float32(0.0)


@njit(nogil=True, cache=True, fastmath=_FLAGS)
def _add_eight(total, rows, factor):  # type: ignore[no-untyped-def]
    """Do total += sum of eight rows, each times its factor."""
    r0, r1, r2, r3, r4, r5, r6, r7 = (
        rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6], rows[7]
    )  # fmt: skip
    f0, f1, f2, f3 = factor[0], factor[1], factor[2], factor[3]
    f4, f5, f6, f7 = factor[4], factor[5], factor[6], factor[7]
    for c in range(total.shape[0]):
        low = f0 * r0[c] + f1 * r1[c] + f2 * r2[c] + f3 * r3[c]
        total[c] += low + (f4 * r4[c] + f5 * r5[c] + f6 * r6[c] + f7 * r7[c])


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
