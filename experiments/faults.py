"""Sensors and worlds as they are: what goes wrong between a robot's world and its agent.

A fault changes what the agent senses, or where the robot is, and never what is true of it.
"""

import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from experiments import cli, scoring
from experiments.scoring import MAZE, Trial
from rfl_torch import Agent, Trajectory
from sims.layouts import load_layout

Seen = NDArray[np.float32]
Change = Callable[[Seen, Seen, np.random.Generator], Seen]
"""From what is sensed, what the agent was given last, and a generator, to what it is given."""

DEAD = (3, 14)
"""The two of 24 sensors that are dead."""

BLOCKED = (420.0, 0.0, 420.0, 170.0)
"""Closes the lower of the two ways between the paper maze's middle rooms [mm]."""

CUT_OFF = (560.0, 0.0, 560.0, 160.0)
"""Closes the only way to its right half."""

REMOVED = 4
"""Number of the wall between those two ways."""


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong."""

    change: Change | None = None
    """What becomes of an observation."""
    options: dict[str, float] = field(default_factory=dict)
    """Arguments of the maze."""
    walls: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    """What becomes of the walls after the log."""
    kidnap_after: int | None = None
    """Steps of a task after which the robot is put elsewhere."""


def _missing(share: float) -> Change:
    return lambda seen, _, rng: np.where(rng.random(seen.shape) < share, np.nan, seen)


def _dead_at(value: float) -> Change:
    def change(seen: Seen, _: Seen, __: np.random.Generator) -> Seen:
        seen = seen.copy()
        seen[list(DEAD)] = value
        return seen

    return change


def _frozen(seen: Seen, before: Seen, _: np.random.Generator) -> Seen:
    seen = seen.copy()
    seen[list(DEAD)] = before[list(DEAD)]
    return seen


def _outliers(share: float) -> Change:
    return lambda seen, _, rng: np.where(
        rng.random(seen.shape) < share, rng.random(seen.shape), seen
    )


def _dropped(share: float) -> Change:
    return lambda seen, _, rng: np.full_like(seen, np.nan) if rng.random() < share else seen


def _repeated(share: float) -> Change:
    return lambda seen, before, rng: before if rng.random() < share else seen


FAULTS: dict[str, Fault] = {
    "healthy": Fault(),
    "10 % of readings missing": Fault(_missing(0.1)),
    "2 sensors dead at 0": Fault(_dead_at(0.0)),
    "2 sensors dead at 1": Fault(_dead_at(1.0)),
    "2 sensors stuck at their last value": Fault(_frozen),
    "2 sensors missing": Fault(_dead_at(np.nan)),
    "2 % of readings outliers": Fault(_outliers(0.02)),
    "10 % sensor noise": Fault(options={"sensor_noise": 0.1}),
    "ring turned by 15 degrees": Fault(lambda seen, _, __: np.roll(seen, 1)),
    "10 % of frames dropped": Fault(_dropped(0.1)),
    "10 % of frames repeated": Fault(_repeated(0.1)),
    "20 % motion noise": Fault(options={"motion_noise": 0.2}),
    "kidnapped once a task": Fault(kidnap_after=15),
    "a corridor blocked": Fault(walls=lambda walls: np.concatenate([walls, [BLOCKED]])),
    "the only way cut off": Fault(walls=lambda walls: np.concatenate([walls, [CUT_OFF]])),
    "a wall removed": Fault(walls=lambda walls: np.delete(walls, REMOVED, 0)),
}


class Faulty(gym.Wrapper):
    """A maze with a fault."""

    def __init__(self, env: gym.Env, fault: Fault, seed: int) -> None:
        super().__init__(env)
        self._fault, self._rng = fault, np.random.default_rng(seed)
        self._places = np.zeros((0, 2))
        self._left = -1

    def begin_task(self, places: NDArray[np.float64]) -> None:
        """Begin a task; a kidnapped robot is put at one of the places (M, 2)."""
        self._places = places
        self._left = -1 if self._fault.kidnap_after is None else self._fault.kidnap_after

    def reset(self, **options: Any) -> tuple[Seen, dict[str, Any]]:
        """Put the robot somewhere."""
        seen, info = self.env.reset(**options)
        self._before = seen
        return self._changed(seen), info

    def step(self, action: Any) -> tuple[Seen, Any, bool, bool, dict[str, Any]]:
        """Take a step, or be carried off."""
        seen, reward, terminated, truncated, info = self.env.step(action)
        self._left -= 1
        if self._left == 0:
            place = self._places[self._rng.integers(len(self._places))]
            seen, info = self.env.reset(options={MAZE.reset_option: tuple(place)})
        return self._changed(seen), float(reward), terminated, truncated, info

    def _changed(self, seen: Seen) -> Seen:
        if self._fault.change is not None:
            seen = np.asarray(self._fault.change(seen, self._before, self._rng), np.float32)
        self._before = seen
        return seen


class Tally(NamedTuple):
    """What came of the tasks under a fault."""

    tasks: int
    true: int
    false: int
    """Believed done, but the robot was elsewhere."""
    gave_up: int
    never_lost: int
    """Neither done nor given up, without ever saying that it doesn't know where it is."""
    steps: float
    """Median of the tasks truly done."""
    reachable: int
    """Tasks whose goal a free way leads to."""


def make_faulty(fault: Fault, seed: int) -> Faulty:
    """Return the paper's maze with a fault."""
    plan = load_layout("paper")
    walls = plan.walls if fault.walls is None else fault.walls(plan.walls)
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "paper.json"
        path.write_text(
            json.dumps({"size": plan.size, "walls": walls.tolist(), "start": plan.start})
        )
        kwargs = json.dumps(fault.options)
        env = cli.make_env("rfl/RangefinderMaze-v0", str(path), kwargs)
    return Faulty(env, fault, seed)


class _Watch:
    """Takes note of whether an executor ever says that it doesn't know where it is."""

    was_lost = False

    def __call__(self, executor: Any, _: dict[str, Any]) -> None:
        self.was_lost |= executor.recovering


def go(agent: Agent, log: Trajectory, fault: Fault, num_tasks: int, seed: int) -> Tally:
    """Do tasks one after the other: node goals, from where the last one ended."""
    assert log.ground_truth is not None
    env = make_faulty(fault, seed)
    table = scoring.node_table(agent, [log], MAZE)
    rng = np.random.default_rng(seed)
    tasks = scoring.node_tasks(np.arange(agent.num_nodes), table, num_tasks, rng)
    layout = scoring.maze_layout(env)
    free = np.array([place for place in log.ground_truth[::20] if layout.is_free(place)])
    seen, info = env.reset(seed=seed, options={MAZE.reset_option: tuple(free[-1])})
    trials: list[Trial] = []
    never_lost = reachable = 0
    for index, task in enumerate(tasks):
        env.begin_task(free)
        start, target = info["ground_truth"], task.target
        assert target is not None
        way = layout.shortest_path_length(start, target) if layout.is_free(target) else 0.0
        reachable += bool(np.isfinite(way))
        executor = agent.executor(task.goal, seed=seed + index)
        watch = _Watch()
        outcome = scoring.run_task(env, executor, seen, info, MAZE.limit, watch)
        is_true = scoring._is_true(task, outcome, MAZE)
        trials.append(Trial(executor.goal, target, outcome, is_true))
        never_lost += outcome.status == "running" and not watch.was_lost
        seen, info = outcome.observation, outcome.info
    env.close()
    return tally(trials, never_lost, reachable)


def tally(trials: Sequence[Trial], never_lost: int, reachable: int) -> Tally:
    """Count what came of the trials."""
    done = [trial for trial in trials if trial.is_true]
    believed = sum(trial.outcome.is_believed for trial in trials)
    steps = float(np.median([trial.outcome.num_steps for trial in done])) if done else np.nan
    gave_up = sum(trial.outcome.status == "gave_up" for trial in trials)
    return Tally(
        len(trials), len(done), believed - len(done), gave_up, never_lost, steps, reachable
    )
