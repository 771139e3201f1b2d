"""Drive an environment with random actions and save what it showed.

python -m experiments.record --env rfl/RangefinderMaze-v0 --num-steps 10000 --out log.npz
python -m experiments.record --env rfl/TorquePendulum-v0 --hold 30 --levels 3 --out swings.npz
"""

from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from experiments import cli
from rfl_torch import Trajectory, record


@dataclass(frozen=True)
class Config:
    """Options of a recording."""

    out: Path
    """File to write: observations (T+1, D), actions (T, A), and ground truth if there is one."""
    env: str = "rfl/RangefinderMaze-v0"
    """Any registered Gymnasium environment with one-dimensional Box spaces."""
    num_steps: int = 10_000
    """Control steps to record."""
    hold: int = 1
    """Steps that each random action is held for."""
    levels: int | None = None
    """Draw each action from that many equally spaced values instead of uniformly."""
    layout: str | None = None
    """The maze's layout: a built-in name, or the path of a JSON file."""
    env_kwargs: str = "{}"
    """More arguments of the environment, a JSON object such as '{"sensor_noise": 0.02}'."""
    seed: int = 0
    """Seed of the environment and of the actions."""


def main(config: Config) -> None:
    """Record one unbroken run."""
    cli.check_writable(config.out)
    more = {"max_episode_steps": config.num_steps} if config.num_steps > 0 else {}
    with cli.make_env(config.env, config.layout, config.env_kwargs, **more) as env:
        log = record(
            env,
            config.num_steps,
            hold=config.hold,
            levels=config.levels,
            seed=config.seed,
            progress=lambda steps: tqdm(steps, desc="record", unit="step"),
        )
    save_log(log, config.out)
    print(
        f"{config.out}: {log.num_steps} steps, {log.observations.shape[1]} readings, "
        f"{log.actions.shape[1]} actions"
    )


def save_log(log: Trajectory, path: Path) -> None:
    """Write the log in one go, so that a crash leaves an older file whole."""
    with cli.replacing(path) as new:
        log.save(new)


if __name__ == "__main__":
    cli.run(main, Config, __doc__)
