"""Learn environments that others wrote from random actions, and go to the nodes of their maps.

python -m experiments.environments --seeds 3

For each of four environments of Gymnasium and Gymnasium-Robotics the same as record, train and
execute do, with the options that docs/choosing.md names: nothing in the code or the configuration
is of one of them. Rewards and goals of their own are not looked at. The random walk babbles as the
log did, on the same goals, by the same rule of what is near; it may pass by at any time.
"""

import importlib.util
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from experiments import cli, execute, scoring, train
from rfl_torch import AgentConfig, record_episodes


@dataclass(frozen=True)
class World:
    """An environment, and how to babble in it."""

    env_id: str
    hold: int
    """Steps that a random action is held for."""
    levels: int | None
    """Values that a random action is drawn from."""
    observation_keys: tuple[str, ...] = ()
    """Of dictionary observations, those that the robot senses."""


WORLDS = (
    World("Pendulum-v1", 3, 3),
    World("MountainCarContinuous-v0", 10, 3),
    World("Acrobot-v1", 4, None),
    World("gymnasium_robotics:PointMaze_UMaze-v3", 10, 3, ("observation",)),
)


@dataclass(frozen=True)
class Config:
    """Options of a run."""

    seeds: int = 1
    """Logs of each environment, each with an agent of its own."""
    num_steps: int = 10_000
    """Random steps to learn from."""
    trials: int = 118
    """Tasks of each agent."""
    limit: int = execute.FOREIGN_LIMIT
    """Control steps of a task."""


def main(config: Config) -> None:
    """Record, learn and go, world by world; print the shares over all seeds."""
    for name in ("seeds", "num_steps", "trials", "limit"):
        cli.check_count(f"--{name.replace('_', '-')}", getattr(config, name))
    rows = [cells(world, config) for world in WORLDS if _is_installed(world)]
    print(
        f"{config.seeds} logs of {config.num_steps} random steps, {config.trials} nodes each, "
        f"{config.limit} steps a task"
    )
    header = ["environment", "actions", "truly reached", "steps", "random walk"]
    print(cli.table(header, rows))


def cells(world: World, config: Config) -> list[str]:
    """Return the line of the table."""
    name = world.env_id.rpartition(":")[2]
    done, found, total, steps = 0, 0, 0, []
    with cli.make_env(world.env_id, observation_keys=world.observation_keys) as env:
        space = type(env.action_space).__name__
        rows = cli.with_action_rows(env)
        for seed in range(config.seeds):
            label = f"{name}, seed {seed}"
            logs = record_episodes(
                env, config.num_steps, hold=world.hold, levels=world.levels, seed=seed
            )
            agent = train.fit(AgentConfig(), logs, seed, None, f"{label}: train")
            goals = np.random.default_rng(seed).choice(agent.num_nodes, config.trials)
            tasks = [scoring.Task(int(goal), None) for goal in goals]
            trials = execute.run(
                rows, agent, tasks, None, None, seed, f"{label}: nodes", limit=config.limit
            )
            done += sum(bool(trial.is_true) for trial in trials)
            steps += [trial.outcome.num_steps for trial in trials if trial.is_true]
            walk = scoring.observed_walk_share(
                rows,
                agent,
                tqdm(goals.tolist(), desc=f"{label}: random walk", unit="task"),
                config.limit,
                world.hold,
                seed,
                world.levels,
            )
            found, total = found + walk.successes, total + config.trials
    median = f"{np.median(steps):.0f}" if steps else "-"
    reached, passed = scoring.wilson(done, total), scoring.wilson(found, total)
    return [name, space, str(reached), median, str(passed)]


def _is_installed(world: World) -> bool:
    module, _, name = world.env_id.rpartition(":")
    is_there = not module or importlib.util.find_spec(module) is not None
    if not is_there:
        print(f"{name} left out: pip install 'rfl-torch[robotics]'")
    return is_there


if __name__ == "__main__":
    cli.run(main, Config, __doc__)
