"""Let an agent choose its own goals, act, and learn from it (the paper's step 4).

python -m experiments.practice --model maze.safetensors --out practised.safetensors
python -m experiments.practice --model maze.safetensors --strategy random --out random.safetensors
"""

import contextlib
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from experiments import cli, execute, train
from rfl_torch import Agent
from rfl_torch.monitor import TensorBoardMonitor
from rfl_torch.practice import Attempt, Strategy


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
    """Practise, save the agent and say how it went."""
    cli.check_count("--num-steps", config.num_steps)
    cli.check_writable(config.out)
    agent = Agent.load(config.model)
    before = agent.num_nodes
    with contextlib.ExitStack() as stack:
        made = cli.make_env(
            config.env,
            config.layout,
            config.env_kwargs,
            config.observation_keys,
            max_episode_steps=-1,
        )
        env = stack.enter_context(cli.with_action_rows(made))
        execute.check_fit(agent, env)
        board = None
        if config.logdir is not None:
            config.logdir.mkdir(parents=True, exist_ok=True)
            board = stack.enter_context(TensorBoardMonitor(config.logdir))
            board.config(asdict(config))
        history = agent.practice(
            env,
            config.num_steps,
            config.seed,
            config.strategy,
            board,
            lambda steps: tqdm(steps, desc="practice", unit="step"),
        )
    train.save_agent(agent, config.out)
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


if __name__ == "__main__":
    cli.run(main, Config, __doc__)
