"""Learn a map and controllers from recorded logs.

Killed and started again with the same options it goes on where it was, from a file OUT.unfinished
that it keeps meanwhile, and ends with the agent of a run never killed.

python -m experiments.train --log log.npz --out maze.safetensors --logdir runs/maze
tensorboard --logdir runs
"""

import contextlib
import math
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tqdm import tqdm

from experiments import cli
from rfl_torch import Agent, AgentConfig, GridHMM, Statistics, Trajectory, footprint
from rfl_torch.learning import Progress
from rfl_torch.monitor import TensorBoardMonitor

MUCH = 2e9
"""Bytes of memory from which on it is said beforehand how much learning takes."""

CONFIGS: dict[str, Callable[[], AgentConfig]] = {
    "default": AgentConfig,
    "paper": AgentConfig.paper,
    "pendulum": AgentConfig.smooth,
    "paper-pendulum": AgentConfig.paper_pendulum,
}


@dataclass(frozen=True)
class Config:
    """Options of a training."""

    log: tuple[str, ...]
    """Logs: npz files of `experiments.record` or with `observations` and `actions`, CSV files, or
    minari:ID of a local data set."""
    out: Path
    """File to write the agent to."""
    logdir: Path | None = None
    """Folder for TensorBoard's events; left out, none are written."""
    config: Literal["default", "paper", "pendulum", "paper-pendulum"] = "default"
    """Choices of the method: the best that we know or the paper's, for the maze or the pendulum."""
    side: int | None = None
    """Nodes along each side of the square grid, as `experiments.describe` suggests; left out, as
    `--config` has it."""
    observation_keys: tuple[str, ...] = ()
    """Where a data set's observations are a dictionary: the keys that the robot senses."""
    seed: int = 0
    """Seed of the start of learning."""


def main(config: Config) -> None:
    """Learn, save the agent and say how it went."""
    cli.check_writable(config.out)
    if not config.log:
        raise ValueError("--log names no file; give one log or several.")
    logs = cli.read_all_logs(config.log, config.observation_keys)
    choices = CONFIGS[config.config]()
    if config.side is not None:
        cli.check_count("--side", config.side)
        choices = replace(choices, shape=(config.side, config.side))
    foretell(choices, logs)
    begin = time.perf_counter()
    with contextlib.ExitStack() as stack:
        board = None
        if config.logdir is not None:
            config.logdir.mkdir(parents=True, exist_ok=True)
            board = stack.enter_context(TensorBoardMonitor(config.logdir))
        unfinished = cli.unfinished(config.out)
        agent = fit(choices, logs, config.seed, board, resume=unfinished)
    agent.save(config.out)  # in one go: a crash leaves an older file whole
    unfinished.unlink(missing_ok=True)
    print(
        f"{config.out}: {agent.num_nodes} nodes, log-likelihood per step "
        f"{agent.record[-1].log_likelihood_per_step:.3f}, {len(agent.record)} iterations in "
        f"{time.perf_counter() - begin:.0f} s"
    )


def foretell(choices: AgentConfig, logs: list[Trajectory]) -> None:
    """Say how much memory learning takes, if that is much."""
    num_steps = sum(log.num_steps for log in logs)
    obs_dim, action_dim = logs[0].observations.shape[1], logs[0].actions.shape[1]
    cells = math.prod(choices.shape)
    needed = footprint.to_fit(num_steps, obs_dim, action_dim, cells, choices.horizon)
    if needed > MUCH:
        print(f"note: {num_steps} steps take up to {needed / 1e9:.1f} GB to learn", file=sys.stderr)


def fit(
    config: AgentConfig,
    logs: list[Trajectory],
    seed: int,
    board: TensorBoardMonitor | None = None,
    description: str = "train",
    resume: Path | None = None,
) -> Agent:
    """Return an agent that learned from the logs, with a progress bar over EM iterations.

    `resume` is the file in which unfinished learning is kept.
    """
    if board is not None:
        board.config({"seed": seed, "agent": asdict(config)})
    total = sum(stage.iterations for stage in config.stages)
    with tqdm(total=total, desc=description, unit="it") as bar:
        monitor = BarMonitor(bar, [stage.iterations for stage in config.stages], board)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            agent = Agent(config, seed).fit(logs, monitor=monitor, resume=resume)
    if board is not None:
        path = np.concatenate([agent.recognize(log.observations) for log in logs])
        board.nodes(agent.hmm, np.bincount(path, minlength=agent.num_nodes))
    for warning in caught:
        print(f"note: {warning.message}", file=sys.stderr)
    return agent


class BarMonitor:
    """Moves a progress bar, and passes everything on to TensorBoard if there is one.

    Args:
        bar: a tqdm bar over the iterations of all stages.
        iterations: most iterations of each stage.
        board: monitor to pass everything on to.
    """

    def __init__(self, bar: Any, iterations: list[int], board: TensorBoardMonitor | None) -> None:
        self._bar, self._iterations, self._board = bar, iterations, board

    def on_iteration(self, hmm: GridHMM, statistics: Statistics, progress: Progress) -> None:
        """Move on by one."""
        before = sum(self._iterations[: progress.stage])
        self._bar.set_postfix(
            stage=progress.stage, loglik=f"{progress.log_likelihood_per_step:.2f}", refresh=False
        )
        self._bar.update(before + progress.iteration + 1 - self._bar.n)
        if self._board is not None:
            self._board.on_iteration(hmm, statistics, progress)

    def on_stage_end(self, hmm: GridHMM, stage: int) -> None:
        """Move on to the stage's end, which it may have reached before its last iteration."""
        self._bar.update(sum(self._iterations[: stage + 1]) - self._bar.n)
        if stage + 1 == len(self._iterations):
            self._bar.set_postfix_str("controllers", refresh=False)
        self._bar.refresh()
        if self._board is not None:
            self._board.on_stage_end(hmm, stage)

    def scalar(self, tag: str, value: float, step: int) -> None:
        """Pass a number on."""
        if self._board is not None:
            self._board.scalar(tag, value, step)


if __name__ == "__main__":
    cli.run(main, Config, __doc__)
