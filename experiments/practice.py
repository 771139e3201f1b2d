"""Let an agent choose its own goals, act, and learn from it (the paper's step 4).

python -m experiments.practice --model maze.safetensors --out practised.safetensors
python -m experiments.practice --model maze.safetensors --strategy random --out random.safetensors

Killed and started again with the same options it goes on from the last piece that it finished,
which it keeps in a folder OUT.unfinished meanwhile, and ends with the agent of a run never killed:
the environment is brought back to where it was by doing the same actions again. That takes an
environment that does the same after the same seed; any other goes on from where it is.
"""

import contextlib
import hashlib
import json
import shutil
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from experiments import cli
from experiments.execute import check_fit
from rfl_torch import Agent
from rfl_torch.checkpoint import load_checkpoint, save_checkpoint
from rfl_torch.monitor import TensorBoardMonitor
from rfl_torch.practice import Attempt, Strategy

PIECE = 2_000
"""Steps between two states that are kept, about six seconds in the maze. At a piece's end the
agent is read back from its file, and what was noted of goals begins anew."""


@dataclass(frozen=True)
class Config:
    """Options of a practice."""

    model: Path
    """Agent that `experiments.train` or an earlier practice wrote."""
    out: Path
    """File to write what became of it to."""
    env: str = "rfl/RangefinderMaze-v0"
    """Environment to practise in: an id or module:id."""
    num_steps: int = 20_000
    """Control steps."""
    strategy: Strategy = "frontier"
    """How goals are chosen."""
    logdir: Path | None = None
    """Folder for TensorBoard's events: success, surprise and nodes, by strategy."""
    layout: str | None = None
    """The maze's layout: a built-in name, or the path of a JSON file."""
    env_kwargs: str = "{}"
    """More arguments of the environment, a JSON object such as '{"sensor_noise": 0.02}'."""
    observation_keys: tuple[str, ...] = ()
    """Where observations are a dictionary: the keys that the robot senses."""
    seed: int = 0
    """Seed of the environment and of all choices."""


def main(config: Config) -> None:
    """Practise piece by piece, save the agent and say how it went."""
    cli.check_writable(config.out)
    cli.check_count("--num-steps", config.num_steps)
    with contextlib.ExitStack() as stack:
        arguments = (config.env, config.layout, config.env_kwargs, config.observation_keys)
        made = cli.make_env(*arguments)
        env = Continued(stack.enter_context(made), config.seed)
        agent = Agent.load(config.model)
        check_fit(agent, env)
        before = agent.num_nodes
        kept = Kept(cli.unfinished(config.out), _identity(config))
        history: list[Attempt] = []
        if (found := kept.latest()) is not None:
            agent, actions, history = found
            print(f"goes on from step {len(actions)}", file=sys.stderr)
            env.repeat(actions)
        board = None
        if config.logdir is not None:
            config.logdir.mkdir(parents=True, exist_ok=True)
            board = stack.enter_context(TensorBoardMonitor(config.logdir))
            board.config(asdict(config))
        bar = stack.enter_context(tqdm(total=config.num_steps, desc="practice", unit="step"))
        bar.update(len(env.actions))
        while (done := len(env.actions)) < config.num_steps:
            piece = min(PIECE, config.num_steps - done)
            attempts = agent.practice(
                env,
                piece,
                seed=config.seed + done,
                strategy=config.strategy,
                monitor=None if board is None else _Later(board, done),
                progress=lambda steps: _moving(steps, bar),
            )
            history += [attempt._replace(step=done + attempt.step) for attempt in attempts]
            agent = kept.through(agent, np.stack(env.actions), history)
    agent.save(config.out)
    kept.remove()
    print(cli.table(["steps", "goals", "reached", "surprise", "nodes"], quarters(history)))
    print(f"{config.out}: {before} nodes before, {agent.num_nodes} now")


def quarters(history: list[Attempt]) -> list[list[str]]:
    """Return a line of the table for each quarter of the attempts."""
    rows = []
    for part in np.array_split(np.arange(len(history)), min(4, len(history))):
        own = [history[i] for i in part]
        rows.append(
            [
                f"{own[0].step} to {own[-1].step + own[-1].num_steps}",
                str(len(own)),
                f"{100 * np.mean([attempt.reached for attempt in own]):.0f} %",
                f"{np.mean([attempt.surprise for attempt in own]):.2f}",
                str(own[-1].num_nodes),
            ]
        )
    return rows


class Continued(gym.Wrapper):
    """An environment in which a practice goes on where the last one ended, and that can be redone.

    Args:
        env: environment to continue.
        seed: of the first reset; later resets with a seed are left out.
    """

    def __init__(self, env: gym.Env, seed: int) -> None:
        super().__init__(env)
        self.actions: list[NDArray[Any]] = []
        self._observation, _ = env.reset(seed=seed)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; with a seed, go on with the one that there is."""
        if seed is None:
            self._observation, _ = self.env.reset(options=options)
        return self._observation, {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step, and note it."""
        self.actions.append(np.array(action))
        result = self.env.step(action)
        self._observation = result[0]
        return result

    def repeat(self, actions: NDArray[Any]) -> None:
        """Do all of an earlier run's actions, from the same first reset."""
        for action in tqdm(actions, desc="doing again", unit="step"):
            _, _, terminated, truncated, _ = self.step(action)
            if terminated or truncated:
                self.reset()


class Kept:
    """The folder with the agent after the last finished piece, and the actions so far.

    The actions are written last: a piece counts once they are there.
    """

    def __init__(self, folder: Path, identity: str) -> None:
        self._folder, self._identity = folder, identity

    def latest(self) -> tuple[Agent, NDArray[Any], list[Attempt]] | None:
        """Return the agent, the actions and the attempts so far; None for nothing usable."""
        for path in sorted(self._folder.glob("actions-*.safetensors"), reverse=True):
            try:
                note, state = load_checkpoint(path)
                if note.get("practice") != self._identity:
                    raise ValueError(f"{path} was left by a practice with other options")
                agent = Agent.load(self._agent_path(len(state["actions"])))
                history = [Attempt(*values) for values in note["history"]]
                return agent, state["actions"].numpy(), history
            except (ValueError, KeyError, TypeError, FileNotFoundError) as error:
                print(f"note: {error}; it is not taken up", file=sys.stderr)
        return None

    def through(self, agent: Agent, actions: NDArray[Any], history: list[Attempt]) -> Agent:
        """Keep the state, drop older ones; returns the agent as the file has it."""
        self._folder.mkdir(exist_ok=True)
        num_steps = len(actions)
        agent.save(self._agent_path(num_steps))
        note = {"practice": self._identity, "history": history}
        new = self._folder / f"actions-{num_steps:09d}.safetensors"
        save_checkpoint(new, note, {"actions": torch.from_numpy(actions)})
        current = {new, self._agent_path(num_steps)}
        for path in [*self._folder.glob("a*-*.safetensors*")]:
            if path not in current:
                path.unlink()
        return Agent.load(self._agent_path(num_steps))

    def remove(self) -> None:
        """Drop the folder."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _agent_path(self, num_steps: int) -> Path:
        return self._folder / f"agent-{num_steps:09d}.safetensors"


def _identity(config: Config) -> str:
    """Hash of the agent's file and of the options that decide what happens."""
    options = {k: v for k, v in asdict(config).items() if k not in ("out", "logdir", "model")}
    digest = hashlib.sha256(json.dumps(options, sort_keys=True).encode())
    digest.update(config.model.read_bytes())
    if config.layout is not None and Path(config.layout).is_file():
        digest.update(Path(config.layout).read_bytes())
    return digest.hexdigest()


def _moving(steps: Iterable[int], bar: tqdm) -> Iterator[int]:
    for step in steps:
        yield step
        bar.update()


class _Later:
    """Passes numbers on to TensorBoard, whose steps count from the first piece's beginning."""

    def __init__(self, board: TensorBoardMonitor, done: int) -> None:
        self._board, self._done = board, done

    def scalar(self, tag: str, value: float, step: int) -> None:
        """Pass a number on."""
        self._board.scalar(tag, value, self._done + step)


if __name__ == "__main__":
    cli.run(main, Config, __doc__)
