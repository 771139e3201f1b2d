"""What readings and actions are measured in: each to [0, 1], by the log that was learned from.

All of the library counts in these units but what talks to the robot.
"""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rfl_torch.circle import find_periods, unwrap_to_circles, wrap_again
from rfl_torch.trajectory import Trajectory


class Readings(NamedTuple):
    """The range that each reading had in the logs."""

    low: NDArray[np.float64]
    """What counts as 0, (D,)."""
    scale: NDArray[np.float64]
    """And how much more counts as 1, (D,); 0 for those that are left out."""
    period: NDArray[np.float64]
    """Of those found to wrap, counted in that scale; 0 for the others, (D,)."""

    @classmethod
    def of_logs(cls, logs: Sequence[Trajectory], unwraps: bool) -> "Readings":
        """Of logs of the same robot; readings that never change are left out, with a warning.

        Args:
            logs: what was sensed; NaN is a missing reading.
            unwraps: lay readings that wrap on a circle.

        Raises:
            ValueError: if no reading changes.
        """
        observations = np.concatenate([log.observations for log in logs])
        is_missing = np.isnan(observations)
        low = np.where(is_missing, np.inf, observations).min(0)
        high = np.where(is_missing, -np.inf, observations).max(0)
        is_constant = ~(high > low)
        if is_constant.all():
            raise ValueError("no reading changes in the log; check the sensors.")
        if is_constant.any():
            constant = np.flatnonzero(is_constant).tolist()
            warnings.warn(
                f"readings {constant} never change in the log; they say nothing and are left out. "
                "Check the sensor, if they should.",
                stacklevel=3,
            )
            low, high = np.where(is_constant, [[0.0], [0.0]], [low, high])
        scale, period = (high - low).astype(np.float64), np.zeros(len(low))
        if unwraps:
            used = ~is_constant
            raw = [log.observations[:, used].astype(np.float64) for log in logs]
            period[used] = find_periods(raw) / scale[used]
        return cls(low.astype(np.float64), scale, period)

    @property
    def used(self) -> NDArray[np.int64]:
        """Those that are not left out."""
        return np.flatnonzero(self.scale > 0)

    def normalize(self, observations: NDArray[np.float32]) -> NDArray[np.float64]:
        """Bring raw readings (..., D) to the range [0, 1] that the log had, (..., E).

        Readings that never changed in the log are left out; one found to wrap becomes two.
        """
        values = np.asarray(observations, np.float64)
        if values.shape[-1:] != self.low.shape:
            raise ValueError(
                f"observation has shape {values.shape}, needs (..., {len(self.low)}) "
                "as in the log that the agent learned from."
            )
        used = self.used
        kept = (np.take(values, used, axis=-1) - self.low[used]) / self.scale[used]
        period = self.period[used]
        return unwrap_to_circles(kept, period) if period.any() else kept

    def restore(self, normal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Undo `normalize`: the readings that are in use, in the robot's units."""
        used = self.used
        return wrap_again(normal, self.period[used]) * self.scale[used] + self.low[used]

    def own_units(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What 0 and 1 of each normalised reading stand for: the lowest, and the range, (E,) each.

        A reading laid on a circle has no unit but its own.
        """
        used = self.used
        plain = used[self.period[used] == 0]
        num_laid = 2 * (len(used) - len(plain))
        low, scale = self.low[plain], self.scale[plain]
        return np.append(low, np.zeros(num_laid)), np.append(scale, np.ones(num_laid))

    def widened(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> "Readings":
        """With what now counts as `low` and `high`, (E,) each, as 0 and 1; none wraps."""
        used = self.used
        begin, scale = self.low.copy(), self.scale.copy()
        begin[used] += low * scale[used]
        scale[used] *= high - low
        return self._replace(low=begin, scale=scale)


class Actions(NamedTuple):
    """The action space that the logs were made in: bounds, (A,) each."""

    low: NDArray[np.float32]
    high: NDArray[np.float32]

    @classmethod
    def of_logs(cls, logs: Sequence[Trajectory]) -> "Actions":
        """The widest bounds of any."""
        low, high = zip(*(log.bounds for log in logs), strict=True)
        return cls(np.min(low, 0), np.max(high, 0))

    @property
    def rest(self) -> NDArray[np.float32]:
        """The middle of the action space, (A,)."""
        return ((self.low + self.high) / 2).astype(np.float32)

    def to_unit(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Actions (..., A) in the share of the action space that they are, [0, 1]."""
        low, high = self
        return ((actions - low) / np.where(high > low, high - low, 1.0)).astype(np.float32)

    def of_unit(self, unit: NDArray[np.floating]) -> NDArray[np.float32]:
        """From [0, 1] to the action space; what lies outside is shortened, not bent.

        A controller that overflows, far from all that it learned from, says nothing: rest.
        """
        if not np.isfinite(unit).all():
            return self.rest
        offset = unit.astype(np.float64) - 0.5
        offset = offset / max(1.0, 2 * float(np.abs(offset).max()))
        low, high = self
        return np.clip(low + (offset + 0.5) * (high - low), low, high).astype(np.float32)

    def to_move(self, action: NDArray[np.float32]) -> NDArray[np.float64]:
        """An action (A,) in full ones, in [-1, 1], (A,)."""
        return 2.0 * self.to_unit(action).astype(np.float64) - 1.0

    def of_move(self, move: NDArray[np.float64]) -> NDArray[np.float32]:
        """The action (A,) of a move (A,) in full actions; what is longer is shortened, not bent."""
        return self.of_unit((move + 1.0) / 2.0)
