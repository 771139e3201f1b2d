"""Swing up in environments that others wrote, with the velocities taken out of what they show.

python -m experiments.foreign pendulum
python -m experiments.foreign mountain-car --seeds 5

Gymnasium's Pendulum-v1 and MountainCarContinuous-v0, their rewards not looked at, learned from
random actions by the same code and configuration as our own pendulum. A try starts hanging at rest,
or where the car's reset puts it, and is done when the executor says so and the environment's own
state agrees: within 0.3 rad of upright, or at the flag. Minutes a seed.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import gymnasium as gym
import numpy as np
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

from experiments import cli, scoring, train
from rfl_torch import AgentConfig, record

UPRIGHT_TOLERANCE = 0.3  # rad
HOLD_SECONDS = 5.0


@dataclass(frozen=True)
class World:
    """An environment, what is left of its observations, and where to go."""

    env_id: str
    shown: tuple[int, ...]
    """Readings that are left."""
    goal: tuple[float, ...]
    """What is seen at the goal."""
    limit: int
    """Steps of a try: the environment's own."""
    step_seconds: float | None
    """Length of a step, if the goal can be stayed at."""


WORLDS = {
    "pendulum": World("Pendulum-v1", (0, 1), (1.0, 0.0), 200, 0.05),
    "mountain-car": World("MountainCarContinuous-v0", (0,), (0.5,), 999, None),
}


@dataclass(frozen=True)
class Config:
    """Options of a run."""

    world: Annotated[Literal["pendulum", "mountain-car"], tyro.conf.Positional]
    """Pendulum-v1 or MountainCarContinuous-v0."""
    seeds: int = 1
    """Logs, each with an agent of its own."""
    num_steps: int = 20_000
    """Random steps to learn from."""
    tries: int = 50
    """Of each agent."""
    hold: int = 30
    """Steps that a random action is held for."""


class WithoutVelocity(gym.Wrapper):
    """Shows some of the readings, and goes on where the environment would end."""

    def __init__(self, env: gym.Env, shown: tuple[int, ...]) -> None:
        super().__init__(env)
        self._shown = list(shown)
        space: Any = env.observation_space
        self.observation_space = gym.spaces.Box(space.low[self._shown], space.high[self._shown])

    def reset(self, **options: Any) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start anew."""
        observation, info = self.env.reset(**options)
        return observation[self._shown], info

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Act, whatever the environment says of an end or a reward."""
        observation, *_, info = self.env.step(action)
        return observation[self._shown], 0.0, False, False, info


def main(config: Config) -> None:
    """Record, learn and try, seed by seed; print the shares over all."""
    for name in ("seeds", "num_steps", "tries", "hold"):
        cli.check_count(f"--{name.replace('_', '-')}", getattr(config, name))
    world = WORLDS[config.world]
    done, held, steps = [], [], []
    with WithoutVelocity(gym.make(world.env_id, max_episode_steps=-1), world.shown) as env:
        for seed in range(config.seeds):
            log = record(env, config.num_steps, hold=config.hold, levels=3, seed=seed)
            agent = train.fit(AgentConfig.smooth(), [log], seed, None, f"seed {seed}: train")
            for index in tqdm(range(config.tries), desc=f"seed {seed}: tries", unit="try"):
                executor = agent.executor(np.array(world.goal, np.float32), seed=index)
                observation = _start(env, config.world, index)
                outcome = scoring.run_task(env, executor, observation, {}, world.limit)
                done.append(outcome.is_believed and _is_there(env, config.world))
                if done[-1]:
                    steps.append(outcome.num_steps)
                if world.step_seconds is not None:
                    needed = round(HOLD_SECONDS / world.step_seconds)
                    stay = _longest_stay(
                        env, config.world, executor, outcome.observation, 2 * needed
                    )
                    held.append(done[-1] and stay >= needed)
    print(f"{world.env_id} without velocity, {config.num_steps} random steps, {config.seeds} logs")
    print(f"arrived   {scoring.wilson(sum(done), len(done))}")
    if steps:
        print(f"steps     {np.median(steps):.0f} (median)")
    if held:
        print(f"then held {scoring.wilson(sum(held), len(held))} for {HOLD_SECONDS:.0f} s")


def _start(env: gym.Env, world: str, seed: int) -> NDArray[np.float32]:
    observation, _ = env.reset(seed=seed)
    if world == "pendulum":
        env.unwrapped.state = np.array([np.pi, 0.0])  # type: ignore[attr-defined]
        return np.array([-1.0, 0.0], np.float32)
    return np.asarray(observation, np.float32)


def _is_there(env: gym.Env, world: str) -> bool:
    state = env.unwrapped.state  # type: ignore[attr-defined]
    if world == "pendulum":
        return bool(abs((state[0] + np.pi) % (2 * np.pi) - np.pi) < UPRIGHT_TOLERANCE)
    return bool(state[0] >= env.unwrapped.goal_position)  # type: ignore[attr-defined]


def _longest_stay(
    env: gym.Env, world: str, executor: Any, observation: NDArray[np.float32], num_steps: int
) -> int:
    longest = stay = 0
    for _ in range(num_steps):
        observation, *_ = env.step(executor.act(observation))
        stay = stay + 1 if _is_there(env, world) else 0
        longest = max(longest, stay)
    return longest


if __name__ == "__main__":
    cli.run(main, Config, __doc__)
