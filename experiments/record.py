r"""Drive an environment with random actions and save what it showed.

python -m experiments.record --env rfl/RangefinderMaze-v0 --num-steps 10000 --out log.npz
python -m experiments.record --env rfl/TorquePendulum-v0 --hold 30 --levels 3 --out swings.npz
python -m experiments.record --env Acrobot-v1 --hold 4 --out acrobot.npz
python -m experiments.record --env gymnasium_robotics:PointMaze_UMaze-v3 \
    --observation-keys observation --hold 10 --levels 3 --out point.npz
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from experiments import cli
from rfl_torch import Trajectory, record_episodes, save_logs


@dataclass(frozen=True)
class Config:
    """Options of a recording."""

    out: Path
    """File to write: observations (T+1, D), actions (T, A), and ground truth if there is one."""
    env: str = "rfl/RangefinderMaze-v0"
    """Any Gymnasium environment with vectors as observations and Box or Discrete actions, by its
    id or module:id."""
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
    observation_keys: tuple[str, ...] = ()
    """Where observations are a dictionary: the keys that the robot senses."""
    seed: int = 0
    """Seed of the environment and of the actions."""


def main(config: Config) -> None:
    """Record one run, or several where the environment ends its episodes."""
    cli.check_writable(config.out)
    arguments = (config.env, config.layout, config.env_kwargs, config.observation_keys)
    with cli.make_env(*arguments) as env:
        logs = record_episodes(
            env,
            config.num_steps,
            hold=config.hold,
            levels=config.levels,
            seed=config.seed,
            progress=lambda steps: tqdm(steps, desc="record", unit="step"),
        )
    write_logs(logs, config.out)
    episodes = f" in {len(logs)} episodes" if len(logs) > 1 else ""
    print(
        f"{config.out}: {sum(log.num_steps for log in logs)} steps{episodes}, "
        f"{logs[0].observations.shape[1]} readings, {logs[0].actions.shape[1]} actions"
    )


def save_log(log: Trajectory, path: Path) -> None:
    """Write the log in one go, so that a crash leaves an older file whole."""
    write_logs([log], path)


def write_logs(logs: Sequence[Trajectory], path: Path) -> None:
    """Write the logs in one go, so that a crash leaves an older file whole."""
    with cli.replacing(path) as new:
        save_logs(logs, new)


if __name__ == "__main__":
    cli.run(main, Config, __doc__)
