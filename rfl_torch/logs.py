"""Logs from files: npz, CSV and Minari data sets, one `Trajectory` an unbroken episode.

A CSV has a header and one row a control step: `obs_*` columns hold what was sensed, `act_*` what
was done then, `truth_*`, if there, the ground truth, and where `episode` changes a new one begins.
An empty cell or "nan" is a missing reading. The action in an episode's last row had no result in
the log, and is left out.
"""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfl_torch.trajectory import ARRAYS, EPISODES, Trajectory, read_arrays, write_arrays

MINARI = "minari:"
"""What the name of a Minari data set begins with, instead of a file's path."""


def read_logs(source: str | Path, observation_keys: Sequence[str] = ()) -> list[Trajectory]:
    """Read every episode of a file or data set.

    Args:
        source: path of an npz file (`save_logs`, `Trajectory.save`, or any with `observations`
            and `actions`) or of a CSV file; or "minari:" and the id of a local Minari data set.
        observation_keys: of a data set with dictionary observations, those to join.

    Raises:
        ValueError: naming the source, if it can't be read as logs.
    """
    try:
        if str(source).startswith(MINARI):
            return _read_minari(str(source).removeprefix(MINARI), observation_keys)
        if Path(source).suffix.lower() == ".csv":
            return _read_csv(Path(source))
        return _read_npz(Path(source))
    except ValueError as error:
        message = str(error)
        raise ValueError(message if str(source) in message else f"{source}: {message}") from None


def save_logs(logs: Sequence[Trajectory], path: str | Path) -> None:
    """Write logs of one robot into one npz file; a single log as `Trajectory.save` does.

    Raises:
        ValueError: if there are none, or they differ in width or in having a ground truth.
    """
    if len(logs) == 1:
        logs[0].save(path)
        return
    shapes = {
        (log.observations.shape[1], log.actions.shape[1], log.ground_truth is None) for log in logs
    }
    if len(shapes) != 1:
        raise ValueError(
            f"logs have (readings, actions, no ground truth) {sorted(shapes)}; needs one kind."
        )
    arrays: dict[str, NDArray[Any]] = {
        name: np.concatenate([getattr(log, name) for log in logs])
        for name in ("observations", "actions", "ground_truth")
        if getattr(logs[0], name) is not None
    }
    arrays["action_low"] = np.min([log.bounds[0] for log in logs], 0)
    arrays["action_high"] = np.max([log.bounds[1] for log in logs], 0)
    write_arrays(path, arrays | {EPISODES: np.array([log.num_steps for log in logs])})


def _read_npz(path: Path) -> list[Trajectory]:
    arrays = read_arrays(path)
    if EPISODES not in arrays:
        return [Trajectory.load(path)]
    steps = arrays[EPISODES]
    if (
        steps.ndim != 1
        or steps.dtype.kind not in "iu"
        or (steps < 1).any()
        or not {"observations", "actions"} <= set(arrays)
        or steps.sum() != len(arrays["actions"])
        or steps.sum() + len(steps) != len(arrays["observations"])
    ):
        raise ValueError(
            f"{EPISODES} doesn't fit; needs the actions of each episode, whole numbers that add "
            "up to the rows of `actions`, and one more row of `observations` an episode."
        )
    first_action = np.cumsum(steps)[:-1]
    first_row = np.cumsum(steps + 1)[:-1]
    parts = {
        name: np.split(arrays[name], first_action if name == "actions" else first_row)
        for name in ("observations", "actions", "ground_truth")
        if name in arrays
    }
    bounds = {
        name: arrays[name] for name in ARRAYS if name.startswith("action_") and name in arrays
    }
    if not bounds:  # one robot has one action space
        bounds = {"action_low": arrays["actions"].min(0), "action_high": arrays["actions"].max(0)}
    return [
        Trajectory(**{name: part[k] for name, part in parts.items()}, **bounds)
        for k in range(len(steps))
    ]


def _read_csv(path: Path) -> list[Trajectory]:
    with open(path, newline="", encoding="utf-8-sig") as file:
        try:
            header, *rows = [row for row in csv.reader(file) if row]
        except (ValueError, csv.Error, UnicodeDecodeError):
            raise ValueError("is no CSV with a header of obs_* and act_* columns.") from None
    header = [name.strip() for name in header]
    columns = {
        kind: [i for i, name in enumerate(header) if name.startswith(kind)]
        for kind in ("obs_", "act_", "truth_")
    }
    if not (columns["obs_"] and columns["act_"]):
        raise ValueError(
            f"has the columns {header}; needs obs_* for what was sensed, act_* for what was done, "
            "and may have truth_* and episode."
        )
    for line, row in enumerate(rows, 2):
        if len(row) != len(header):
            raise ValueError(f"line {line} has {len(row)} cells, the header {len(header)}.")
    used = [i for kind in columns.values() for i in kind]
    table = np.full((len(rows), len(header)), np.nan)
    for i in used:
        for k, row in enumerate(rows):
            try:
                table[k, i] = float(row[i].strip() or "nan")
            except ValueError:
                raise ValueError(
                    f"line {k + 2} has {row[i]!r} in {header[i]}; needs a number, or nothing "
                    "where the reading is missing."
                ) from None
    episode = [row[header.index("episode")] for row in rows] if "episode" in header else []
    breaks = [k for k in range(1, len(episode)) if episode[k] != episode[k - 1]]
    pieces = [piece for piece in np.split(table, breaks) if len(piece) > 1]
    if not pieces:
        raise ValueError("has no episode of two rows or more; an action needs a result.")
    actions = np.concatenate([piece[:-1, columns["act_"]] for piece in pieces])
    return [
        Trajectory(
            piece[:, columns["obs_"]],
            piece[:-1, columns["act_"]],
            np.nanmin(actions, 0) if np.isfinite(actions).all() else None,
            np.nanmax(actions, 0) if np.isfinite(actions).all() else None,
            piece[:, columns["truth_"]] if columns["truth_"] else None,
        )
        for piece in pieces
    ]


def _read_minari(name: str, keys: Sequence[str]) -> list[Trajectory]:
    try:
        import minari
    except ImportError:
        raise ValueError("needs the package minari; try pip install 'minari[hdf5]'.") from None
    try:
        dataset = minari.load_dataset(name)
    except (FileNotFoundError, ValueError, ImportError) as error:
        raise ValueError(
            f"can't be read ({error}); `minari list local` names what is here, `minari download` "
            "fetches more."
        ) from None
    space = dataset.action_space
    discrete = type(space).__name__ == "Discrete"
    logs: list[Trajectory] = []
    bounds: Any
    for episode in dataset.iterate_episodes():
        actions = np.asarray(episode.actions)
        if discrete:
            actions = np.eye(int(space.n))[actions.astype(np.int64).reshape(-1) - int(space.start)]
            bounds = np.zeros(int(space.n)), np.ones(int(space.n))
        else:
            bounds = space.low, space.high
        logs.append(Trajectory(_joined(episode.observations, keys), actions, *bounds))
    return logs


def _joined(observations: Any, keys: Sequence[str]) -> NDArray[np.float32]:
    """Vectors (T+1, D) of an episode; those of a dictionary beside each other."""
    if not isinstance(observations, dict):
        return np.asarray(observations)
    if unknown := [key for key in keys if key not in observations] or not keys:
        raise ValueError(
            f"its observations are dictionaries of {sorted(observations)}, "
            + (f"without {unknown}" if keys else "and none was chosen")
            + "; name those that the robot senses with --observation-keys."
        )
    return np.concatenate([np.asarray(observations[key]) for key in keys], 1)
