"""Say what is wrong or odd in logs before anything is learned from them.

python -m experiments.describe --log log.npz
python -m experiments.describe --log drive.csv --side 20

Lines that begin with "!" ask for a look before training. Counts are of all logs together.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments import cli
from rfl_torch import Trajectory

STEPS_PER_NODE = 25
"""The maze of the paper has 10,000 steps for 400 nodes; its maps are sound with so many."""

SMALLEST_SIDE, LARGEST_SIDE = 4, 40
"""Sides of grids worth suggesting: beyond, anneal the learning slower than the defaults do."""

JUMP_FACTOR = 5.0
"""A step this many times the median one, and JUMP_SHARE of the log's width, is a jump."""
JUMP_SHARE = 0.3

SATURATED_SHARE = 0.2
"""More actions than this at one end of the action space are reported."""

SCALE_FACTOR = 1000.0
"""Ranges of readings that differ more are reported; they are normalised all the same."""

NARROW_SHARE = 0.01
"""A reading that keeps 98 % of its values within this share of its range is ruled by outliers."""


@dataclass(frozen=True)
class Config:
    """Options of a description."""

    log: tuple[str, ...]
    """Logs: npz or CSV files, or minari:ID of a local data set."""
    side: int | None = None
    """Nodes along each side of the grid that you have in mind; left out, one is suggested."""
    observation_keys: tuple[str, ...] = ()
    """Where a data set's observations are a dictionary: the keys that the robot senses."""


def main(config: Config) -> None:
    """Print the description."""
    if not config.log:
        raise ValueError("--log names no file; give one log or several.")
    if config.side is not None:
        cli.check_count("--side", config.side)
    logs = cli.read_all_logs(config.log, config.observation_keys)
    print("\n".join(describe(logs, config.side)))


def describe(logs: Sequence[Trajectory], side: int | None = None) -> list[str]:
    """Return the lines of the description.

    Raises:
        ValueError: if the logs are of different widths.
    """
    widths = sorted({(log.observations.shape[1], log.actions.shape[1]) for log in logs})
    if len(widths) != 1:
        raise ValueError(f"logs have (readings, actions) {widths}; needs the same robot in all.")
    observations = np.concatenate([log.observations for log in logs]).astype(np.float64)
    num_steps = sum(log.num_steps for log in logs)
    lines = [
        f"{num_steps} steps in {len(logs)} episode{'s' if len(logs) > 1 else ''}, "
        f"{widths[0][0]} readings, {widths[0][1]} actions"
        + ("" if any(log.ground_truth is None for log in logs) else ", ground truth for scoring")
    ]
    low, high, num_known = _ranges(observations)
    lines += _constant(low, high, num_known)
    lines += _gaps(observations, num_known)
    lines += _jumps(logs, low, high)
    lines += _scales(observations, low, high)
    lines += _saturation(logs)
    lines += _grid(num_steps, side)
    return lines


def suggested_side(num_steps: int) -> int:
    """Return the side of the square grid that so many steps can fill."""
    side = int((num_steps / STEPS_PER_NODE) ** 0.5)
    return min(max(side, SMALLEST_SIDE), LARGEST_SIDE)


def _ranges(
    observations: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Least and largest value and number of values of each reading; inf and -inf without any."""
    is_known = ~np.isnan(observations)
    low = np.where(is_known, observations, np.inf).min(0)
    high = np.where(is_known, observations, -np.inf).max(0)
    return low, high, is_known.sum(0)


def _constant(low: Any, high: Any, num_known: Any) -> list[str]:
    lines = []
    if empty := np.flatnonzero(num_known == 0).tolist():
        lines.append(f"! readings {empty} are always missing; training leaves them out.")
    if constant := np.flatnonzero((num_known > 0) & (low == high)).tolist():
        values = ", ".join(f"{low[i]:g}" for i in constant)
        lines.append(
            f"! readings {constant} never change (constant at {values}); training leaves them out."
        )
    return lines


def _gaps(observations: NDArray[np.float64], num_known: Any) -> list[str]:
    lines = []
    for i in np.flatnonzero((num_known > 0) & (num_known < len(observations))):
        missing = np.isnan(observations[:, i])
        edges = np.diff(np.concatenate([[0], missing.astype(int), [0]]))
        longest = int((np.flatnonzero(edges < 0) - np.flatnonzero(edges > 0)).max())
        lines.append(
            f"! reading {i} has gaps: {100 * missing.mean():.1f} % missing, at most {longest} "
            "steps in a row; learning goes by the other readings there."
        )
    return lines


def _jumps(logs: Sequence[Trajectory], low: Any, high: Any) -> list[str]:
    """Steps far longer than others, inside episodes, and how far episodes are apart."""
    lines = []
    used = high > low
    scale = (high - low)[used]
    lengths, at = [], []
    for k, log in enumerate(logs):
        step = np.abs(np.diff(log.observations[:, used].astype(np.float64), axis=0)) / scale
        lengths.append(np.nan_to_num(step).max(1, initial=0.0))
        at += [(k, t) for t in range(log.num_steps)]
    length = np.concatenate(lengths)
    limit = max(JUMP_SHARE, JUMP_FACTOR * float(np.median(length)))
    if (jumps := np.flatnonzero(length > limit)).size:
        k, t = at[jumps[0]]
        where = f"step {t}" if len(logs) == 1 else f"step {t} of episode {k}"
        lines.append(
            f"! {len(jumps)} steps jump by over {100 * limit:.0f} % of a reading's range, the "
            f"first after {where} (the median step is {100 * np.median(length):.1f} %). An angle "
            "that wraps? Log its cosine and sine. Two runs in one? Add an `episode` column. A "
            "collision? Leave it."
        )
    if len(logs) > 1:
        breaks = np.stack(
            [
                np.abs(b.observations[0, used] - a.observations[-1, used]) / scale
                for a, b in itertools.pairwise(logs)
            ]
        )
        num_steps = np.array([log.num_steps for log in logs])
        lines.append(
            f"! {len(logs) - 1} episode break{'s' if len(logs) > 2 else ''}, readings jump there "
            f"by up to {100 * np.nan_to_num(breaks).max():.0f} % of their range; nothing is "
            f"learned across. Episodes have {num_steps.min()} to {num_steps.max()} steps."
        )
    return lines


def _scales(observations: NDArray[np.float64], low: Any, high: Any) -> list[str]:
    used = np.flatnonzero(high > low)
    if not used.size:
        return ["! no reading changes: there is nothing to learn from."]
    scale = (high - low)[used]
    lines = [
        f"  ranges of the readings: {scale.min():.3g} to {scale.max():.3g}; each is brought to 0..1"
    ]
    if scale.max() > SCALE_FACTOR * scale.min():
        lines[0] = (
            f"! reading {used[scale.argmin()]} has a range of {scale.min():.3g} and reading "
            f"{used[scale.argmax()]} one of {scale.max():.3g}; each is brought to 0..1, so make "
            "sure that the small one is more than noise."
        )
    inner_low, inner_high = np.nanquantile(observations[:, used], [0.01, 0.99], axis=0)
    if (narrow := used[(inner_high - inner_low) < NARROW_SHARE * scale]).size:
        lines.append(
            f"! readings {narrow.tolist()} keep 98 % of their values in 1 % of their range: a few "
            "outliers set the scale. Clip them, or mark them as missing (NaN)."
        )
    return lines


def _saturation(logs: Sequence[Trajectory]) -> list[str]:
    actions = np.concatenate([log.actions for log in logs])
    low = np.min([log.bounds[0] for log in logs], 0)
    high = np.max([log.bounds[1] for log in logs], 0)
    one_hot = bool(((actions == 0) | (actions == 1)).all() and (actions.sum(1) == 1).all())
    if one_hot and actions.shape[1] > 1:
        counts = np.round(100 * actions.mean(0)).astype(int).tolist()
        return [f"  actions are a choice among {actions.shape[1]}, taken {counts} % of the time"]
    values = [len(np.unique(column)) for column in actions.T]
    lines = [f"  actions lie in {_vector(low)} to {_vector(high)}"]
    for i, column in enumerate(actions.T):
        share = np.array([(column <= low[i]).mean(), (column >= high[i]).mean()])
        if low[i] == high[i]:
            lines.append(f"! action {i} never changes: no controller can learn what it does.")
        elif values[i] <= 5:
            lines.append(f"  action {i} takes {values[i]} values only")
        elif share.max() > SATURATED_SHARE:
            lines.append(
                f"! action {i} is saturated: {100 * share[0]:.0f} % of the steps at {low[i]:g}, "
                f"{100 * share[1]:.0f} % at {high[i]:g}; stronger ones are not in the log."
            )
    return lines


def _grid(num_steps: int, side: int | None) -> list[str]:
    best = suggested_side(num_steps)
    suggestion = f"  suggested grid: {best} x {best} nodes (--side {best})"
    if side is None:
        side = best
        if num_steps >= STEPS_PER_NODE * side**2:
            return [suggestion]
    per_node = num_steps / side**2
    if per_node < STEPS_PER_NODE:
        return [
            f"! too little data for {side} x {side} nodes: {per_node:.1f} steps a node, needs "
            f"about {STEPS_PER_NODE}; record {STEPS_PER_NODE * side**2} steps or take fewer nodes.",
            suggestion,
        ]
    return [f"  {per_node:.0f} steps a node for {side} x {side} nodes", suggestion]


def _vector(values: NDArray[np.float32]) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values) + "]"


if __name__ == "__main__":
    cli.run(main, Config, __doc__)
