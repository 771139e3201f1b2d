"""Readings that wrap, as an angle does: laid on a circle, they lose the jump that isn't there.

The paper keeps the pendulum's angle raw in [0, 1], where upright is torn into 0 and 1. Laid out as
(cos, sin), what is close looks close. Whether a reading wraps shows in the log: it jumps, but never
without leaving one end of its range for the other at the pace that it had.
"""

import numpy as np
from numpy.typing import NDArray

MIN_JUMPS = 10
"""Fewer jumps don't show that a reading wraps: a ray that flickers may do as much."""

PACE_ERROR = 0.01
"""Share of the range that the pace may change by over a jump."""

GAP = 0.05
"""Share of the period that the log may leave out."""


def find_periods(logs: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Period of each reading in the readings' unit, (D,); 0 where it doesn't wrap.

    A jump is a change by over half of the range; at every one, the change after taking a period off
    must be between that before and that after it. The period is the one that makes it their mean.

    Args:
        logs: raw readings, (T, D) each; NaN is a missing one.
    """
    low, high = (f(np.concatenate(logs), 0) for f in (np.nanmin, np.nanmax))
    return np.array(
        [_period([log[:, d] for log in logs], high[d] - low[d]) for d in range(len(low))]
    )


def _period(logs: list[NDArray[np.float64]], extent: float) -> float:
    periods = []
    for reading in logs:
        step = np.diff(reading)
        is_jump = np.abs(step) > extent / 2
        within = step - np.sign(step) * extent * is_jump
        jump = np.flatnonzero(is_jump[1:-1]) + 1
        pace = (within[jump - 1] + within[jump + 1]) / 2
        periods.append(np.sign(step[jump]) * (step[jump] - pace))
    period = np.concatenate(periods)
    period = period[np.isfinite(period)]
    if len(period) < MIN_JUMPS:
        return 0.0
    usual = float(np.median(period))
    is_smooth = bool((np.abs(period - usual) < PACE_ERROR * extent).all())
    return usual if is_smooth and abs(usual - extent) < GAP * extent else 0.0


def unwrap_to_circles(
    readings: NDArray[np.float64], period: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Replace each reading that wraps by (1 + cos) / 2 and (1 + sin) / 2, at the end of the row.

    Args:
        readings: (..., D).
        period: (D,), 0 where a reading doesn't wrap.
    """
    wraps = period > 0
    angle = 2 * np.pi * readings[..., wraps] / period[wraps]
    circle = [0.5 + 0.5 * np.cos(angle), 0.5 + 0.5 * np.sin(angle)]
    return np.concatenate([readings[..., ~wraps], *circle], -1)


def wrap_again(laid_out: NDArray[np.float64], period: NDArray[np.float64]) -> NDArray[np.float64]:
    """Undo `unwrap_to_circles`: (..., E) to readings (..., D), those that wrap in [0, period)."""
    wraps = period > 0
    num_plain, num = int((~wraps).sum()), int(wraps.sum())
    cos, sin = laid_out[..., num_plain : num_plain + num], laid_out[..., num_plain + num :]
    readings = np.empty((*laid_out.shape[:-1], len(period)))
    readings[..., ~wraps] = laid_out[..., :num_plain]
    turn = np.arctan2(sin - 0.5, cos - 0.5) / (2 * np.pi) % 1.0
    readings[..., wraps] = turn * period[wraps]
    return readings
