"""Learning from tasks: what an agent sees and does on its way is given to it between two tasks.

A robot that is put down where no log has been knows that place the next time. Maps are laid out
anew as they grow, so a node that is a goal may get another number; its place stays.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from experiments import scoring
from experiments.scoring import NodeTable, Task, World
from rfl_torch import Agent, Trajectory
from rfl_torch.innate import action_bounds
from rfl_torch.practice import pace


class Watched(gym.Wrapper):
    """Keeps what was seen and done, with the ground truth if there is one."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self._seen: list[tuple[Any, Any]] = []
        self._done: list[Any] = []
        self._finished: list[Trajectory] = []

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Begin a new log."""
        self._finish()
        observation, info = self.env.reset(**options)
        self._seen, self._done = [(observation, info.get("ground_truth"))], []
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Go on, and keep what is seen."""
        result = self.env.step(action)
        self._seen.append((result[0], result[4].get("ground_truth")))
        space = self.action_space
        if isinstance(space, gym.spaces.Discrete):
            action = np.eye(int(space.n))[action - space.start]
        self._done.append(action)
        return result

    def _finish(self) -> None:
        """Make a log of what was seen and done; what comes next goes on from its end."""
        if self._done:
            bounds = action_bounds(self.action_space)
            seen, truth = zip(*self._seen, strict=True)
            known = None if truth[0] is None else np.stack(truth)
            done = np.stack(self._done).astype(np.float32)
            self._finished.append(Trajectory(np.stack(seen), done, *bounds, known))
        self._seen, self._done = self._seen[-1:], []

    def take(self) -> list[Trajectory]:
        """What was seen and done since the last call."""
        self._finish()
        logs, self._finished = self._finished, []
        return logs


class Learner:
    """Lets an agent learn between its tasks, after as many steps as practice does.

    Args:
        agent: learns, and changes.
        env: in which it does the tasks.
        logs: that it learned from, for where its nodes truly lie; none if that isn't known.
        world: how ground truth is measured; None if there is none.
        learned: called each time that it has learned.
    """

    def __init__(
        self,
        agent: Agent,
        env: Watched,
        logs: Sequence[Trajectory],
        world: World | None,
        learned: Callable[[], None] | None = None,
    ) -> None:
        self._agent, self._env, self._world, self._learned = agent, env, world, learned
        self._known, self._spots = logs, agent.positions
        self._table: NodeTable | None = None
        self._fresh: list[Trajectory] = []
        self.logs = list(logs)
        """All that it has learned from."""
        self.seconds = 0.0
        """Spent on learning."""

    def between(self, tasks: Sequence[Task]) -> Iterator[Task]:
        """The tasks, one after the other, with the goals' numbers as they are then.

        What was done in one is learned from when the next is asked for; after the last, the rest.
        """
        for task in tasks:
            yield self._as_known(task)
            self._fresh += self._env.take()
            if sum(log.num_steps for log in self._fresh) >= pace(self._agent):
                self._learn()
        self._learn()

    def _learn(self) -> None:
        if not self._fresh:
            return
        begin = time.perf_counter()
        self._agent.partial_fit(self._fresh)
        self.seconds += time.perf_counter() - begin
        self.logs += self._fresh
        self._fresh = []
        if self._known and self._world is not None:
            self._table = scoring.node_table(self._agent, self._known, self._world)
        if self._learned is not None:
            self._learned()

    def _as_known(self, task: Task) -> Task:
        """A node's task, with the node that lies there now.

        By the truth if that is known, else by where it lay on the map that was learned at first.
        """
        if not isinstance(task.goal, int):
            return task
        if self._table is not None and task.target is not None and self._world is not None:
            away = self._world.distance(self._table.mean, task.target)
            if not np.isnan(away).all():  # else no log was at the goal
                return task._replace(goal=int(np.nanargmin(away)))
        if self._spots is not None and self._agent.positions is not None:
            away = np.linalg.norm(self._agent.positions - self._spots[task.goal], axis=1)
            return task._replace(goal=int(away.argmin()))
        return task
