"""Swing up in environments that others wrote, with the velocities taken out of what they show.

python -m experiments.foreign pendulum
python -m experiments.foreign mountain-car --seeds 5

Gymnasium's Pendulum-v1 and MountainCarContinuous-v0, their rewards not looked at, learned from
random actions by the same code and configuration as our own pendulum. A try starts hanging at rest,
or where the car's reset puts it, and is done when the executor says so and the environment's own
state agrees: within 0.3 rad of upright, or at the flag. Minutes a seed.

The pendulum's peer is sb3-contrib's RecurrentPPO, given the reward and the environment's own
resets, which begin at any angle. It tries from the same starts, in the same time, and counts as
there as soon as it is within the same 0.3 rad.
"""

import functools
import importlib.util
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import gymnasium as gym
import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

from experiments import cli, scoring, train
from rfl_torch import Agent, AgentConfig, record

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
    peer: dict[str, Any] | None = None
    """RecurrentPPO's settings; None runs no peer."""


# What the peer's authors found for this environment without velocity: PendulumNoVel-v1 in RL
# Baselines3 Zoo, four environments at once, their readings and rewards normalized.
PEER_ENVS = 4
PENDULUM_PEER: dict[str, Any] = {
    "n_steps": 1024,
    "gamma": 0.9,
    "learning_rate": 1e-3,
    "use_sde": True,
    "sde_sample_freq": 4,
    "policy_kwargs": {
        "ortho_init": False,
        "activation_fn": torch.nn.ReLU,
        "lstm_hidden_size": 64,
        "net_arch": {"pi": [64], "vf": [64]},
    },
}

WORLDS = {
    "pendulum": World("Pendulum-v1", (0, 1), (1.0, 0.0), 200, 0.05, PENDULUM_PEER),
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
    peer_steps: tuple[int, ...] = (20_000, 100_000)
    """Environment steps of the pendulum's peer; it needs the extra `foreign`."""
    peer_seeds: int = 1
    """Policies of the peer, each tried once, since its tries would all be the same."""


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


class Row:
    """The tries of one learner, over all seeds."""

    def __init__(self, learner: str, learned_from: str) -> None:
        self._names = [learner, learned_from]
        self._done: list[bool] = []
        self._held: list[bool] = []
        self._steps: list[int] = []

    def run(
        self, env: gym.Env, name: str, tries: int, start: Callable[[int], Any], label: str
    ) -> None:
        """Try from the starts that all learners get, each with an executor of its own."""
        world = WORLDS[name]
        for index in tqdm(range(tries), desc=f"{label}: tries", unit="try"):
            executor = start(index)
            observation = _start(env, name, index)
            outcome = scoring.run_task(env, executor, observation, {}, world.limit)
            self._done.append(outcome.is_believed and _is_there(env, name))
            if self._done[-1]:
                self._steps.append(outcome.num_steps)
            if world.step_seconds is not None:
                needed = round(HOLD_SECONDS / world.step_seconds)
                stay = _longest_stay(env, name, executor, outcome.observation, 2 * needed)
                self._held.append(self._done[-1] and stay >= needed)

    def cells(self) -> list[str]:
        """The line of the table."""
        steps = f"{np.median(self._steps):.0f}" if self._steps else "-"
        held = str(scoring.wilson(sum(self._held), len(self._held))) if self._held else "-"
        return [*self._names, str(scoring.wilson(sum(self._done), len(self._done))), steps, held]


def main(config: Config) -> None:
    """Record, learn and try, seed by seed; print the shares over all."""
    for name in ("seeds", "num_steps", "tries", "hold", "peer_seeds"):
        cli.check_count(f"--{name.replace('_', '-')}", getattr(config, name))
    for steps in config.peer_steps:
        cli.check_count("--peer-steps", steps)
    world = WORLDS[config.world]
    own = Row("this, no reward", f"{config.num_steps}")
    with WithoutVelocity(gym.make(world.env_id, max_episode_steps=-1), world.shown) as env:
        for seed in range(config.seeds):
            log = record(env, config.num_steps, hold=config.hold, levels=3, seed=seed)
            agent = train.fit(AgentConfig.smooth(), [log], seed, None, f"seed {seed}: train")
            start = functools.partial(_executor, agent, np.array(world.goal, np.float32))
            own.run(env, config.world, config.tries, start, f"seed {seed}")
        rows = [own, *_peers(env, config)]
    print(f"{world.env_id} without velocity, {config.num_steps} random steps, {config.seeds} logs")
    header = ["learner", "steps", "arrived", "in steps (median)"]
    header.append(f"then held {HOLD_SECONDS:.0f} s")
    print(cli.table(header, [row.cells() for row in rows]))


def _executor(agent: Agent, goal: NDArray[np.float32], seed: int) -> Any:
    return agent.executor(goal, seed=seed)


def _peers(env: gym.Env, config: Config) -> Iterable[Row]:
    """Score the peer at each number of steps."""
    world, steps = WORLDS[config.world], sorted(config.peer_steps)
    if world.peer is None or not steps:
        return []
    if importlib.util.find_spec("sb3_contrib") is None:
        print("RecurrentPPO left out: pip install 'rfl-torch[foreign]'")
        return []
    rows: dict[int, Row] = {}
    for seed in range(config.peer_seeds):
        for taken, predict in _train_peer(world, steps, seed):
            row = rows.setdefault(taken, Row("RecurrentPPO, reward", f"{taken}"))
            start = functools.partial(PeerExecutor, predict, env, config.world)
            # Neither the start nor the policy's mean action has chance in it: one try says all.
            row.run(env, config.world, 1, start, f"seed {seed}, RecurrentPPO at {taken}")
            print(*row.cells(), sep=", ", file=sys.stderr)
    return rows.values()


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


# -- the peer -----------------------------------------------------------------------------------


Predict = Callable[[NDArray[np.float32], Any], tuple[NDArray[np.float32], Any]]
"""From an observation and a memory, None at the start, to an action and the next memory."""


class PeerExecutor:
    """Lets a recurrent policy act as our executors do; it has arrived once it truly is there.

    The policy has no word for "reached", so the truth says it instead, at the first chance.
    """

    node = -1
    path: tuple[int, ...] = ()
    reason = None

    def __init__(self, predict: Predict, env: gym.Env, world: str, seed: int) -> None:
        del seed  # the policy's mean action has no chance in it
        self._predict, self._env, self._world = predict, env, world
        self._memory: Any = None
        self.status = "running"

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Choose the policy's mean action."""
        if self.status == "running" and _is_there(self._env, self._world):
            # The loop ends here and shows the same observation again: not to be remembered twice.
            self.status = "reached"
            return np.zeros(self._env.action_space.shape, np.float32)  # type: ignore[arg-type]
        action, self._memory = self._predict(observation, self._memory)
        return action


def _train_peer(world: World, num_steps: list[int], seed: int) -> Iterator[tuple[int, Predict]]:
    """Train one policy on rewards; give it at each number of steps, rounded up to rollouts."""
    if not num_steps:
        return
    from sb3_contrib import RecurrentPPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    settings = world.peer or {}
    envs = make_vec_env(lambda: _with_reward(world), PEER_ENVS, seed=seed)
    envs = VecNormalize(envs, gamma=settings["gamma"])
    model = RecurrentPPO("MlpLstmPolicy", envs, **settings, seed=seed, device="cpu")

    def predict(observation: NDArray[np.float32], memory: Any) -> Any:
        return model.predict(envs.normalize_obs(observation), memory, deterministic=True)

    for steps in num_steps:
        print(f"seed {seed}: RecurrentPPO learns to step {steps}", file=sys.stderr)
        if steps > model.num_timesteps:
            model.learn(steps - model.num_timesteps, reset_num_timesteps=False)
        yield model.num_timesteps, predict
    envs.close()


def _with_reward(world: World) -> gym.Env:
    """Make the environment as it is, its reward, resets and ends too, but for the velocity."""
    env = gym.make(world.env_id)
    shown, space = list(world.shown), env.observation_space
    assert isinstance(space, gym.spaces.Box)
    left = gym.spaces.Box(space.low[shown], space.high[shown])
    return gym.wrappers.TransformObservation(env, lambda observation: observation[shown], left)


if __name__ == "__main__":
    cli.run(main, Config, __doc__)
