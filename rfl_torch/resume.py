"""Learning that goes on where it was killed, and ends as if it had not been.

EM is a function of its parameters: what it needs to go on is the model after the last iteration
and the record of those before, which the stop rule counts on. Both go into a file every so often.
Whatever follows EM is short, and done again.
"""

import hashlib
import json
import time
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rfl_torch.checkpoint import load_checkpoint, save_checkpoint
from rfl_torch.hmm import GridHMM, Statistics
from rfl_torch.learning import LearningMonitor, Progress
from rfl_torch.trajectory import Trajectory

WRITING_SHARE = 0.02
"""Share of the time that may go into writing: a file that takes 10 ms is written twice a second."""


def identity(choices: Any, logs: Iterable[Trajectory]) -> str:
    """Hash of what decides a result: plain-JSON choices, and what is seen and done in the logs."""
    digest = hashlib.sha256(json.dumps(choices, sort_keys=True).encode())
    for log in logs:
        for array in (log.observations, log.actions, *log.bounds):
            digest.update(repr(array.shape).encode())
            digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


class SavedLearning:
    """A monitor of learning that keeps what is needed to go on; passes all calls on to another.

    Args:
        path: file to keep it in; whoever saves the result removes it.
        own: `identity` of this learning: a file of another one is not taken up.
        monitor: told of everything too.
    """

    def __init__(self, path: Path, own: str, monitor: LearningMonitor | None = None) -> None:
        self._path, self._own, self._monitor = path, own, monitor
        self._record: list[Progress] = []
        self._due = 0.0

    def restore(self, hmm: GridHMM) -> list[Progress]:
        """Set `hmm` as it was kept; returns the record so far, [] if there is nothing to take up.

        A file that can't be taken up is told of in a warning, and is overwritten in time.
        """
        self._record = []
        if not self._path.exists():
            return []
        try:
            config, state = load_checkpoint(self._path)
            if config.get("learning") != self._own:
                raise ValueError(
                    f"{self._path} was left by learning from other logs, choices or seed"
                )
            # A stranger's record can't get here: it would need the logs for the identity.
            record = [Progress(*values) for values in config["record"]]
            hmm.load_state_dict(state)
        except (ValueError, KeyError, TypeError, RuntimeError) as error:
            warnings.warn(f"{error}; learning starts from the beginning.", stacklevel=3)
            return []
        self._record = record
        return list(record)

    def on_iteration(self, hmm: GridHMM, statistics: Statistics, progress: Progress) -> None:
        """Keep the model after this iteration, unless the last writing is too near."""
        self._record.append(progress)
        if time.perf_counter() >= self._due:
            self._keep(hmm)
        if self._monitor is not None:
            self._monitor.on_iteration(hmm, statistics, progress)

    def on_stage_end(self, hmm: GridHMM, stage: int) -> None:
        """Keep the model: what follows the last stage takes its time too."""
        self._keep(hmm)
        if self._monitor is not None:
            self._monitor.on_stage_end(hmm, stage)

    def _keep(self, hmm: GridHMM) -> None:
        """Write the file; a full disk costs no more than what could have been taken up."""
        begin = time.perf_counter()
        record = [
            [p.stage, p.iteration, p.temperature, p.log_likelihood_per_step, p.seconds]
            for p in self._record
        ]
        state: dict[str, torch.Tensor] = dict(hmm.state_dict())
        try:
            save_checkpoint(self._path, {"learning": self._own, "record": record}, state)
        except OSError as error:
            warnings.warn(
                f"unfinished learning can't be kept in {self._path} ({error}); killed now, it "
                "goes on from what was kept before.",
                stacklevel=2,
            )
        end = time.perf_counter()
        self._due = end + (end - begin) / WRITING_SHARE
