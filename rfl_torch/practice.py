"""Acting to learn: choose a goal, go there, look around, learn from what happened (Fig. 1, step 4).

The paper names four ways to be motivated from within and tests none. Here a goal is chosen by a
strategy, pursued by the executor, and where the robot then stands it does what was never done
there. All that it saw and did goes into the map, the controllers and the costs of the edges.

    random          any node
    least_visited   the node that was seen least
    frontier        the node from which most of what is unknown is in sight, for the way there
    progress        the node whose success rate, or lack of one, changes most
"""

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from rfl_torch.executor import CONFIRMED
from rfl_torch.explorer import Explorer
from rfl_torch.frontier import promise, untried
from rfl_torch.innate import directions, done_row, env_action
from rfl_torch.planner import cost_to_go
from rfl_torch.search import HOLD, LookSearch
from rfl_torch.trajectory import Trajectory

if TYPE_CHECKING:
    from rfl_torch.agent import Agent

Strategy = Literal["random", "least_visited", "frontier", "progress"]

LEARN_EVERY = 500
"""Steps between two updates of what is known."""

LEARN_SHARE = 0.05
"""Where the logs are laid out anew, which takes the longer the more is kept of them: steps between
two updates at least, as a share of those laid out last."""

LONGEST_WAY = 400
"""Steps after which a goal is let go."""

LOOK_AROUND = 30
"""Steps spent at a goal on what was tried least."""

STAY = 8
"""Cells on the way to the nearest one of which nothing is known, up to which a walk in unknown land
goes on although it has come back to the map."""

OFF_MAP = 200
"""Steps that a walk in unknown land may take on top before it is learned from."""

FAST, SLOW = 0.5, 0.1
"""Rates of the two running means of success whose difference is progress."""


class Attempt(NamedTuple):
    """One goal of a practice."""

    step: int
    """Control steps before it."""
    goal: int
    num_steps: int
    """Steps on the way, without those spent at the goal."""
    reached: bool
    """Whether the agent believes that it got there."""
    num_nodes: int
    """Nodes of the map then."""
    surprise: float
    """Share of the steps that no node explained."""


class PracticeMonitor(Protocol):
    """What `practice` reports to; `monitor.TensorBoardMonitor` is one."""

    def scalar(self, tag: str, value: float, step: int) -> None:
        """Called with `practice/...` after every attempt."""


class Goals:
    """Chooses goals, and remembers how they went."""

    def __init__(self, agent: "Agent", strategy: Strategy, rng: np.random.Generator) -> None:
        self._agent, self._strategy, self._rng = agent, strategy, rng
        self.fast = np.full(agent.num_nodes, 0.5)
        self.slow = np.full(agent.num_nodes, 0.5)
        self.failures = np.zeros(agent.num_nodes)
        self.update()

    def update(self) -> None:
        """Take note of what the agent learned since."""
        num_nodes, kept = self._agent.num_nodes, slice(self._agent.num_nodes)
        more = max(0, num_nodes - len(self.fast))
        self.fast = np.append(self.fast[kept], np.full(more, 0.5))
        self.slow = np.append(self.slow[kept], np.full(more, 0.0))  # new nodes promise progress
        self.failures = np.append(self.failures[kept], np.zeros(more))
        self.untried = untried(self._agent)
        self.promise = promise(self._agent, self.untried)

    def choose(self, node: int) -> int:
        """The next goal, from where the robot is."""
        agent, rng = self._agent, self._rng
        if self._strategy == "random":
            return int(rng.integers(agent.num_nodes))
        if self._strategy == "least_visited":
            return _smallest(agent.visits, rng)
        if self._strategy == "progress":
            return _smallest(-np.abs(self.fast - self.slow), rng)
        is_open = self.untried.any(1)
        if not is_open.any():
            return _smallest(agent.visits, rng)
        away = cost_to_go(agent.graph.T.tocsr(), np.array([node]))
        worth = np.maximum(1, self.promise) / 2.0**self.failures
        away = np.where(is_open, (away + LOOK_AROUND) / worth, np.inf)
        return _smallest(away, rng) if np.isfinite(away).any() else _smallest(agent.visits, rng)

    def note(self, goal: int, reached: bool) -> None:
        """Remember how a goal went."""
        self.fast[goal] += FAST * (reached - self.fast[goal])
        self.slow[goal] += SLOW * (reached - self.slow[goal])
        self.failures[goal] += 1  # the nearest goal is not taken again and again

    def try_out(self, node: int) -> int | None:
        """An action never tried at a node, now taken as tried; None if there is none."""
        if node >= len(self.untried) or not self.untried[node].any():
            return None
        choice = int(self._rng.choice(np.flatnonzero(self.untried[node])))
        self.untried[node, choice] = False
        return choice


def _smallest(values: NDArray[np.float64], rng: np.random.Generator) -> int:
    return int(rng.choice(np.flatnonzero(values == values.min())))


class _Run:
    """The environment as a stream, logged for learning."""

    def __init__(self, env: Any, num_steps: int, seed: int) -> None:
        self.env, self.left, self.done = env, num_steps, 0
        self.observation, _ = env.reset(seed=seed)
        self._begin()

    def _begin(self) -> None:
        self._observations = [np.asarray(self.observation, np.float32)]
        self._actions: list[NDArray[np.float32]] = []
        self.finished: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []

    def step(self, action: NDArray[np.float32]) -> None:
        space = self.env.action_space
        self.observation, _, terminated, truncated, _ = self.env.step(env_action(space, action))
        self._observations.append(np.asarray(self.observation, np.float32))
        self._actions.append(done_row(space, action))
        self.left -= 1
        self.done += 1
        if terminated or truncated:
            self._cut()
            self.observation, _ = self.env.reset()
            self._observations = [np.asarray(self.observation, np.float32)]
            self._actions = []

    def _cut(self) -> None:
        if self._actions:
            self.finished.append((np.stack(self._observations), np.stack(self._actions)))

    @property
    def pending(self) -> int:
        """Steps since the last log was taken."""
        return len(self._actions) + sum(len(actions) for _, actions in self.finished)

    def take_logs(self, low: NDArray[np.float32], high: NDArray[np.float32]) -> list[Trajectory]:
        """What was logged since the last call."""
        self._cut()
        logs = [Trajectory(seen, done, low, high) for seen, done in self.finished]
        self._begin()
        return logs


def practice(
    agent: "Agent",
    env: Any,
    num_steps: int,
    seed: int = 0,
    strategy: Strategy = "frontier",
    monitor: PracticeMonitor | None = None,
    progress: Callable[[range], Iterable[int]] = iter,
) -> list[Attempt]:
    """Let the agent practise in a Gymnasium environment; see `Agent.practice`."""
    rng = np.random.default_rng(seed)
    run = _Run(env, num_steps, seed)
    goals = Goals(agent, strategy, rng)
    search = LookSearch(*agent.actions, agent.look_radius, seed)
    history: list[Attempt] = []
    node = 0
    bar = iter(progress(range(num_steps)))
    while run.left > 0:
        begin, goal = run.done, goals.choose(node)
        executor = agent.executor(goal, seed=int(rng.integers(2**31)))
        unknown = 0
        while run.left > 0 and run.done - begin < LONGEST_WAY:
            action = executor.act(run.observation)
            if executor.status != "running":
                break
            unknown += not executor.is_familiar
            run.step(action)
        reached = executor.status == "reached"
        on_way = run.done - begin
        node = executor.node
        goals.note(goal, reached)
        _look_around(agent, run, goals, search, executor, rng)
        node = executor.node
        attempt = Attempt(begin, goal, on_way, reached, agent.num_nodes, unknown / max(1, on_way))
        history.append(attempt)
        _report(monitor, strategy, history, run.done)
        if run.pending >= pace(agent) or run.left == 0:
            agent.partial_fit(run.take_logs(*agent.actions))
            goals.update()
            assert agent.last_seen is not None
            node = int(agent.last_seen[1].argmax())  # it may have another number now
        for _ in range(run.done - begin):
            next(bar, None)
    return history


def pace(agent: "Agent") -> float:
    """Steps that are worth learning from at once, with `Agent.partial_fit`."""
    num_known = 0 if not agent.has_track else agent.edges.sum()
    return max(LEARN_EVERY, LEARN_SHARE * float(num_known))


def _look_around(
    agent: "Agent",
    run: _Run,
    goals: Goals,
    search: LookSearch,
    executor: Any,
    rng: np.random.Generator,
) -> None:
    """Do at this place what was not done there, and follow where it leads off the map."""
    low, high = agent.actions
    unit = directions(len(low))
    left, most = LOOK_AROUND, LOOK_AROUND + OFF_MAP
    node = executor.node
    while run.left > 0 and left > 0 and most > 0:
        choice = goals.try_out(executor.node)
        held = HOLD if choice is not None else 1
        for _ in range(held):
            if run.left == 0:
                return
            if executor.is_familiar:
                node = executor.node
            elif agent.free_ways is not None:
                explorer = agent.explorer(int(rng.integers(2**31)), node)
                most -= _explore(agent, run, executor, explorer, min(most, run.left))
                break
            if choice is None or not executor.is_familiar:
                action = search.act(agent.readings.normalize(run.observation))
            else:
                action = (low + unit[choice] * (high - low)).astype(np.float32).clip(low, high)
            run.step(action)
            executor.watch(run.observation, action)
            most -= 1
            left -= executor.is_familiar


def _explore(agent: "Agent", run: _Run, executor: Any, explorer: Explorer, most: int) -> int:
    """Walk in unknown land until all that is near is known; returns the steps taken."""
    known = 0
    for step in range(most):
        action = explorer.act(agent.readings.normalize(run.observation))
        run.step(action)
        executor.watch(run.observation, action)
        known = known + 1 if executor.is_familiar else 0
        if known >= CONFIRMED and not 0 < explorer.cells_to_new <= STAY:
            return step + 1
    return most


def _report(
    monitor: PracticeMonitor | None, strategy: Strategy, history: list[Attempt], step: int
) -> None:
    if monitor is None:
        return
    recent = history[-20:]
    values = {
        "success_rate": float(np.mean([x.reached for x in recent])),
        "surprise": float(np.mean([x.surprise for x in recent])),
        "nodes": recent[-1].num_nodes,
    }
    for name, value in values.items():
        monitor.scalar(f"practice/{name}/{strategy}", value, step)
