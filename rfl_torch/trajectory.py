"""A log: what was observed and done, step by step, and nothing about why."""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FILE_FORMAT = "rfl_torch/trajectory/1"

ARRAYS = ("observations", "actions", "action_low", "action_high", "ground_truth")
MOST_BYTES = 8 << 30
"""Largest log that is unpacked: a file of a few MB can claim any size."""

EPISODES = "episode_steps"
"""int (K,), in a file of K logs one after the other: the actions of each."""


@dataclass(frozen=True)
class Trajectory:
    """One unbroken run of T steps.

    observations: float32 (T+1, D), as the environment gave them; NaN is a missing reading.
    actions: float32 (T, A), in the environment's action space; actions[t] led from
        observations[t] to observations[t+1].
    action_low, action_high: float32 (A,), the action space's bounds; by default the log's own
        extremes.
    ground_truth: float64 (T+1, S) or None. For scoring only: no learning code reads it.

    Raises:
        ValueError: if the shapes don't fit, a value is not a number, or a reading never changes.
    """

    observations: NDArray[np.float32]
    actions: NDArray[np.float32]
    action_low: NDArray[np.float32] | None = None
    action_high: NDArray[np.float32] | None = None
    ground_truth: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        set_field = object.__setattr__
        set_field(self, "observations", _matrix("observations", self.observations))
        set_field(self, "actions", _matrix("actions", self.actions))
        if len(self.observations) != len(self.actions) + 1 or len(self.actions) == 0:
            raise ValueError(
                f"log has {len(self.observations)} observations and {len(self.actions)} actions; "
                "needs at least one action and one observation more than actions: the last "
                "action's result."
            )
        _refuse_infinite("observation", self.observations, allow_nan=True)
        _refuse_infinite("action", self.actions, allow_nan=False)
        low = self.actions.min(0) if self.action_low is None else self.action_low
        high = self.actions.max(0) if self.action_high is None else self.action_high
        set_field(self, "action_low", np.asarray(low, np.float32))
        set_field(self, "action_high", np.asarray(high, np.float32))
        self._check_bounds()
        if self.ground_truth is not None:
            truth = np.asarray(self.ground_truth, np.float64)
            set_field(self, "ground_truth", truth)
            if truth.ndim != 2 or len(truth) != len(self.observations):
                raise ValueError(
                    f"ground_truth has shape {truth.shape}, needs one row an observation: "
                    f"({len(self.observations)}, S)."
                )

    def _check_bounds(self) -> None:
        low, high = self.bounds
        if low.shape != self.actions.shape[1:] or high.shape != low.shape:
            raise ValueError(
                f"action_low and action_high have shapes {low.shape} and {high.shape}, need "
                f"({self.actions.shape[1]},)."
            )
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()):
            raise ValueError(
                f"action bounds are {low} and {high}; need finite values, low at most high."
            )
        outside = (self.actions < low - 1e-4) | (self.actions > high + 1e-4)
        if outside.any():
            t, a = np.argwhere(outside)[0]
            raise ValueError(
                f"action {t} has {self.actions[t, a]} in dimension {a}, outside "
                f"[{low[a]}, {high[a]}]; clip it, or correct the bounds."
            )

    @property
    def bounds(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The action space's lower and upper bounds, (A,) each."""
        assert self.action_low is not None
        assert self.action_high is not None
        return self.action_low, self.action_high

    @property
    def num_steps(self) -> int:
        """T, the number of actions."""
        return len(self.actions)

    def save(self, path: str | Path) -> None:
        """Write the log as a compressed npz file; `logs.save_logs` writes several into one."""
        arrays = {name: getattr(self, name) for name in ARRAYS if getattr(self, name) is not None}
        write_arrays(path, arrays)

    @classmethod
    def load(cls, path: str | Path) -> "Trajectory":
        """Read a log that `save` wrote, or any npz with `observations` and `actions`.

        Raises:
            ValueError: if the file is no such npz; it names the file. Nothing in it can run code.
        """
        arrays = read_arrays(path)
        if EPISODES in arrays:
            raise ValueError(
                f"{path} holds {len(arrays[EPISODES])} episodes, and a Trajectory is one; read it "
                "with rfl_torch.read_logs."
            )
        if missing := [name for name in ARRAYS[:2] if name not in arrays]:
            raise ValueError(
                f"{path} lacks {' and '.join(missing)}; a log needs observations (T+1, D) and "
                "actions (T, A)."
            )
        try:
            return cls(**arrays)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None


def write_arrays(path: str | Path, arrays: dict[str, Any]) -> None:
    """Write arrays as a compressed npz file of logs."""
    with open(path, "wb") as file:
        np.savez_compressed(file, format=np.array(FILE_FORMAT), **arrays)


def read_arrays(path: str | Path) -> dict[str, NDArray[Any]]:
    """Read the arrays of an npz file of logs; others in it are left alone.

    Raises:
        ValueError: if the file is no npz of plain numbers; it names the file.
    """
    try:
        # Opened here: numpy leaves a damaged file open.
        with open(path, "rb") as raw:
            with zipfile.ZipFile(raw) as packed:
                size = sum(member.file_size for member in packed.infolist())
            if size > MOST_BYTES:
                raise ValueError(f"{size} bytes when unpacked, at most {MOST_BYTES} are read")
            raw.seek(0)
            with np.load(raw, allow_pickle=False) as file:
                return {name: file[name] for name in (*ARRAYS, EPISODES) if name in file}
    except (OSError, ValueError, EOFError, KeyError, MemoryError, zipfile.BadZipFile) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise ValueError(
            f"{path} is no npz file of plain number arrays, or a damaged one "
            f"({type(error).__name__}); write it with Trajectory.save or numpy.savez."
        ) from None


def _matrix(name: str, value: NDArray[np.float32]) -> NDArray[np.float32]:
    array = np.asarray(value)
    if array.ndim != 2 or array.shape[1] == 0 or array.dtype.kind not in "fiub":
        raise ValueError(
            f"{name} have shape {array.shape} and type {array.dtype}, need numbers of shape "
            "(steps, dimensions); reshape a single reading to (steps, 1)."
        )
    return np.ascontiguousarray(array, np.float32)


def _refuse_infinite(name: str, array: NDArray[np.float32], allow_nan: bool) -> None:
    bad = np.isinf(array) if allow_nan else ~np.isfinite(array)
    if bad.any():
        t, d = np.argwhere(bad)[0]
        hint = "mark a missing reading with NaN" if allow_nan else "drop the steps around it"
        raise ValueError(
            f"{name} {t} has {array[t, d]} in dimension {d} ({bad.sum()} such values); needs "
            f"finite numbers, {hint}."
        )
