"""A robot that is driven by hand: given goals, stopped, carried off, sent to practise.

The loop behind `experiments.live`, one control step a `tick`, without anything of its page.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from experiments import scoring
from experiments.scoring import MAZE
from rfl_torch import Trajectory

UNSURE = 0.3
"""A robot whose likeliest node is less probable does not know where it is."""

TRAIL = 150
"""Steps of the way gone that are kept."""


class Event(NamedTuple):
    """Something that happened."""

    step: int
    text: str


class Drive:
    """An agent in an environment, one control step a tick.

    Args:
        env: environment to act in, taking action rows.
        agent: whose executors act; practice changes it.
        logs: where nodes are is known from their ground truth, if they have one.
        seed: of the starts and of the executors.
    """

    def __init__(self, env: gym.Env, agent: Any, logs: Sequence[Trajectory], seed: int = 0) -> None:
        self.env, self.agent, self.logs, self._seed = env, agent, list(logs), seed
        self.world = scoring.world_of(env)
        self._rng = np.random.default_rng(seed)
        self.events: deque[Event] = deque(maxlen=200)
        self.num_events = 0
        self.trail: deque[NDArray[np.float64]] = deque(maxlen=TRAIL)
        self.num_steps = self.num_plans = 0
        self.goal: int | None = None
        self.path: list[int] = []
        """The planned nodes, from where it thinks it is to its goal; [] without a goal."""
        self._plan: list[int] = []
        self.is_paused = False
        self.practice_share: float | None = None
        self.map_version = 0
        self._is_over = self._was_lost = False
        observation, info = env.reset(seed=seed)
        self._sense(observation, info)
        self._wait()
        self.place_nodes()

    # -- what it is asked to do -----------------------------------------------------------------

    def go_to(self, node: int) -> None:
        """Head for a node from now on."""
        self._seed += 1
        self.executor = self.agent.executor(node, seed=self._seed)
        self.goal, self.num_plans = node, 0
        self.path = self._plan = []
        self._status = "running"
        self._tell(f"going to node {node}")

    def toggle_pause(self) -> None:
        """Stop the world, or let it go on."""
        self.is_paused = not self.is_paused
        self._tell("paused" if self.is_paused else "going on")

    def kidnap(self) -> None:
        """Carry the robot to another place of the log, or to where the environment starts."""
        truths = [log.ground_truth for log in self.logs if log.ground_truth is not None]
        options = None
        if self.world is not None and truths:
            truth = np.concatenate(truths)
            place = truth[self._rng.integers(len(truth))]
            options = {self.world.reset_option: tuple(place)}
        elif self.world is MAZE:
            place = scoring.maze_layout(self.env).random_free_position(self._rng)
            options = {MAZE.reset_option: tuple(place)}
        self._sense(*self.env.reset(options=options))
        self.trail.clear()
        self._is_over = False
        self._tell("kidnapped")

    def practise(self, num_steps: int) -> None:
        """Let the agent choose goals and learn from going there; blocks until it is done."""
        before = self.agent.num_nodes
        self._tell(f"practising for {num_steps} steps")
        self._wait()
        self.practice_share = 0.0
        watched = Watched(self.env, self)
        try:
            self._seed += 1
            self.agent.practice(watched, num_steps, seed=self._seed, progress=self._count)
        finally:
            log = watched.log()
            if log is not None:
                self.logs.append(log)
            self.place_nodes()
            self._is_over = False
            self._wait()
            self.practice_share = None  # last: now the loop goes on
        self._tell(f"practised: {before} nodes before, {self.agent.num_nodes} now")

    # -- what it does -----------------------------------------------------------------------------

    def tick(self) -> None:
        """Take one control step, unless it is paused or practises."""
        if self.is_paused or self.practice_share is not None:
            return
        action = self._act()
        self._report()
        if self._is_over:
            self._sense(*self.env.reset())
            self._is_over = False
            self._tell("the episode ended: back at the start")
            return
        observation, _, terminated, truncated, info = self.env.step(action)
        self._is_over = bool(terminated or truncated)
        self.num_steps += 1
        self._sense(observation, info)

    @property
    def status(self) -> str:
        """What it does, in a word or two."""
        if self.practice_share is not None:
            return "practising"
        if self.is_paused:
            return "paused"
        if self.goal is None:
            return "waiting"
        if self.executor.status == "gave_up":
            return "gave up"
        if self.executor.status == "reached":
            return "reached"
        return "lost" if self.is_lost else "on its way"

    @property
    def is_lost(self) -> bool:
        """Whether it does not know where it is."""
        normal = self.agent.readings.normalize(self.observation)
        is_strange = self.agent.log_emission(normal).max() < self.agent.least_familiar
        return bool(self.executor.recovering or is_strange or self.executor.belief.max() < UNSURE)

    def place_nodes(self) -> None:
        """Lay the map out: by ground truth where the logs have one, else from the graph."""
        self.place, self.is_true_place = scoring.node_places(self.agent, self.logs, self.world)
        self.map_version += 1

    def _count(self, steps: range) -> Iterator[int]:
        for step in steps:
            self.practice_share = step / len(steps)
            yield step

    def _wait(self) -> None:
        """Go nowhere, and keep recognising."""
        self.executor = self.agent.executor(0, seed=self._seed)  # it only watches
        self.goal, self._status = None, "reached"
        self.path = self._plan = []

    def _act(self) -> NDArray[np.float32]:
        """Decide what to do now; without a goal, nothing."""
        if self.goal is None:
            action: NDArray[np.float32] = self.agent.actions.rest
            self.executor.watch(self.observation, action)
        else:
            action = self.executor.act(self.observation)
        is_under_way = self.goal is not None and self.executor.status == "running"
        # Asked for once a step: where plans are made by looking ahead, it takes a while.
        self.path = list(self.executor.path) if is_under_way else []
        return action

    def _sense(self, observation: NDArray[np.float32], info: dict[str, Any]) -> None:
        self.observation = observation
        truth = info.get("ground_truth")
        self.truth = None if truth is None else np.asarray(truth, np.float64)[:2]
        if self.truth is not None:
            self.trail.append(self.truth)

    def _report(self) -> None:
        """Tell of what the last decision changed."""
        if self.goal is None:
            return
        if self.path:
            if self._plan and self.path != self._plan[-len(self.path) :]:
                self.num_plans += 1
                left = len(self.path) - 1
                self._tell(f"re-planned: {left} node{'s' * (left != 1)} to go")
            self._plan = self.path
        if self.is_lost and not self._was_lost and self.executor.status == "running":
            self._tell("lost")
        self._was_lost = self.is_lost
        if self.executor.status != self._status:
            self._status = self.executor.status
            reason = f": {self.executor.reason}" if self._status == "gave_up" else ""
            self._tell(f"{self.status} node {self.goal}{reason}")

    def fail(self, error: Exception) -> None:
        """Tell of an error, and stop until told to go on."""
        self.is_paused = True
        self._tell(f"stopped: {error}")

    def _tell(self, text: str) -> None:
        self.events.append(Event(self.num_steps, text))
        self.num_events += 1


class Watched(gym.Wrapper):
    """Shows a drive what the agent does in practice, and keeps it as a log."""

    def __init__(self, env: gym.Env, drive: Drive) -> None:
        super().__init__(env)
        self._drive = drive
        self._observations: list[Any] = []
        self._actions: list[Any] = []
        self._truths: list[Any] = []

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Reset, and begin a new log."""
        observation, info = self.env.reset(**options)
        self._observations, self._actions, self._truths = [observation], [], []
        self._truths.append(info.get("ground_truth"))
        self._drive._sense(observation, info)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step, and keep it."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._observations.append(observation)
        self._actions.append(action)
        self._truths.append(info.get("ground_truth"))
        self._drive.num_steps += 1
        drive = self._drive
        drive._sense(observation, info)
        if len(drive.executor.belief) != drive.agent.num_nodes:
            drive._wait()  # the map has grown
        drive.executor.watch(observation)
        return observation, float(reward), terminated, truncated, info

    def log(self) -> Trajectory | None:
        """What was seen since the last reset, for where the nodes are; None without a truth."""
        if not self._actions or self._truths[0] is None:
            return None
        low, high = self._drive.agent.actions
        return Trajectory(
            np.stack(self._observations),
            np.clip(np.stack(self._actions), low, high),
            low,
            high,
            np.stack(self._truths),
        )
