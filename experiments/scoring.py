"""How well it went, by ground truth; used nowhere in learning or acting.

    believed      the executor said "reached"
    true          it said so, and the robot was where the goal is
    node goal     a node of the map; it is where its mean ground truth in the training log lies
    place goal    the observation made at a free place drawn from the whole room
    chained       each task starts where the last one ended, the first where the log ended
    independent   each task starts at a random free place of its own

    observed      where the environment tells no ground truth: an observation is at a node that it
                  is as near to as what is seen there is on average, see `observed_near`

A task that starts at its goal counts like any other.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from scipy.stats import norm

from rfl_torch import Agent, InnateController, Trajectory, inference
from rfl_torch.monitor import map_layout
from rfl_torch.planner import largest_component, threshold_graph

Array = NDArray[np.float64]
Rng = np.random.Generator

NODE_SPACING = 44.0  # mm; the paper's, sqrt(1000 * 600 / 309)
WORMHOLE_SPREAD = 60.0  # mm
PLACE_TOLERANCE = 60.0  # mm
OBSERVED_TOLERANCE = 0.05
"""Rms over readings, each as a share of its range in the log: what counts as near in any case, a
node's width on a 20 x 20 map."""
UPRIGHT_TOLERANCE = 0.3  # rad
UPRIGHT = (math.pi, 0.0)


@dataclass(frozen=True)
class World:
    """How ground truth is measured in one environment."""

    reset_option: str
    """Name of the reset option that puts the robot somewhere."""
    limit: int
    """Control steps of a task at most."""
    tolerance: tuple[float, ...]
    """How far from a node each dimension of the ground truth may be."""
    order: float
    """Norm of offsets over tolerances: 2 for a disc, inf for a box."""
    is_angle: bool = False
    """The first dimension wraps at +-pi."""
    hold: int = 1
    """Steps that the innate controller holds an action for."""
    levels: int | None = None
    """Values that the innate controller chooses from."""

    def offset(self, truth: ArrayLike, reference: ArrayLike) -> Array:
        """Return truth - reference, (..., S), the angle taken the short way round."""
        offset = np.asarray(truth, np.float64) - np.asarray(reference, np.float64)
        if self.is_angle:
            offset[..., 0] = (offset[..., 0] + math.pi) % (2 * math.pi) - math.pi
        return offset

    def mean(self, truth: Array) -> Array:
        """Return the mean (S,) of (T, S), that of an angle on the circle."""
        mean = truth.mean(0)
        if self.is_angle:
            mean[0] = np.arctan2(np.sin(truth[:, 0]).mean(), np.cos(truth[:, 0]).mean())
        return mean

    def distance(self, truth: ArrayLike, reference: ArrayLike) -> Array:
        """Return the distance (...) in tolerances: 1 is just near enough, NaN if unknown."""
        offset = self.offset(truth, reference) / np.array(self.tolerance)
        return np.asarray(np.linalg.norm(offset, ord=self.order, axis=-1))


MAZE = World("position", 800, (NODE_SPACING, NODE_SPACING), 2)
PENDULUM = World("state", 1000, (0.3, 1.0), np.inf, is_angle=True, hold=30, levels=3)


def world_of(env: gym.Env) -> World | None:
    """Return the measure of one of our environments, None for others."""
    name = type(env.unwrapped).__name__
    return {"RangefinderMazeEnv": MAZE, "TorquePendulumEnv": PENDULUM}.get(name)


class NodeTable(NamedTuple):
    """Where each kept node was active in the training logs."""

    mean: Array
    """(N, S) mean ground truth; NaN where the node was never recognised."""
    deviation: Array
    """(N, S) standard deviation of each dimension."""
    num_steps: NDArray[np.int64]
    """(N,) steps of the logs."""

    @property
    def spread(self) -> Array:
        """(N,) rms distance from the mean."""
        return np.asarray(np.linalg.norm(self.deviation, axis=-1))


def node_table(agent: Agent, logs: Sequence[Trajectory], world: World) -> NodeTable:
    """Recognise the logs, and say where each node was active in them."""
    nodes = np.concatenate([agent.recognize(log.observations) for log in logs])
    return table_of(nodes, ground_truth(logs), agent.num_nodes, world)


def ground_truth(logs: Sequence[Trajectory]) -> Array:
    """Return the ground truth of all logs, (steps, S).

    Raises:
        ValueError: if one has none.
    """
    truths = [log.ground_truth for log in logs if log.ground_truth is not None]
    if len(truths) < len(logs):
        raise ValueError(
            "a log has no ground_truth, which scoring needs; record it anew with "
            "experiments.record, or leave --log out to count only what the agent believes."
        )
    return np.concatenate(truths)


def table_of(nodes: NDArray[np.int64], truth: Array, num_nodes: int, world: World) -> NodeTable:
    """Group the ground truth (T, S) by the node of each step (T,)."""
    mean = np.full((num_nodes, truth.shape[1]), np.nan)
    deviation = mean.copy()
    for node in np.unique(nodes):
        own = truth[nodes == node]
        mean[node] = world.mean(own)
        deviation[node] = np.sqrt((world.offset(own, mean[node]) ** 2).mean(0))
    return NodeTable(mean, deviation, np.bincount(nodes, minlength=num_nodes))


def node_places(
    agent: Agent, logs: Sequence[Trajectory], world: World | None
) -> tuple[Array, bool]:
    """Return a place (N, 2) for each node, NaN for none, and whether it is the true one.

    It is where all logs have a ground truth of two dimensions or more; else nodes are laid out
    from their graph.
    """
    truths = [log.ground_truth for log in logs if log.ground_truth is not None]
    if logs and len(truths) == len(logs) and truths[0].shape[1] >= 2:
        nodes = np.concatenate([agent.recognize(log.observations) for log in logs])
        measure = world or World("", 0, (1.0, 1.0), 2)
        truth = np.concatenate(truths)[:, :2]
        return table_of(nodes, truth, agent.num_nodes, measure).mean, True
    place = np.full((agent.num_nodes, 2), np.nan)
    known, plane = map_layout(agent.hmm)
    place[known] = plane
    return place, False


# -- the map ----------------------------------------------------------------------------------


def planning_graph(agent: Agent) -> csr_array:
    """Return the graph that the agent's executors plan over, (N, N)."""
    executor = agent.config.executor
    if executor.recognition == "path":
        transition = agent.hmm.transition_matrix().detach().numpy()
        return threshold_graph(transition, executor.epsilon)
    return agent.graph


def map_scores(agent: Agent, table: NodeTable, world: World) -> dict[str, float]:
    """Return what can be said of any map."""
    scores = {
        "kept_nodes": float(agent.num_nodes),
        "strongly_connected_share": float(largest_component(planning_graph(agent)).mean()),
    }
    if world is MAZE:
        scores |= {
            "wormhole_share": wormhole_share(table),
            "median_spread_mm": float(np.nanmedian(table.spread)),
            "rms_spread_mm": _rms(table.spread, table.num_steps),
        }
    else:
        for i, name in enumerate(("angle_rad", "velocity_rad_s")):
            scores[f"median_spread_{name}"] = float(np.nanmedian(table.deviation[:, i]))
            scores[f"rms_spread_{name}"] = _rms(table.deviation[:, i], table.num_steps)
        nearest = np.nanmin(world.distance(table.mean, UPRIGHT))
        scores["nearest_to_upright_tolerances"] = float(nearest)
    return scores


def wormhole_share(table: NodeTable) -> float:
    """Return the share of log steps in nodes that mix places over 60 mm apart (rms)."""
    return float(table.num_steps[table.spread > WORMHOLE_SPREAD].sum() / table.num_steps.sum())


def coverage(layout: Any, truth: Array, table: NodeTable) -> dict[str, float]:
    """Return the shares of the free cells that the log visits and that a node is near to."""
    cells = layout.free_cells(NODE_SPACING)
    visited = {tuple(cell) for cell in np.floor(truth / NODE_SPACING).astype(int).tolist()}
    index = np.floor(cells / NODE_SPACING).astype(int).tolist()
    known = table.mean[np.isfinite(table.mean).all(1)]
    distance = cKDTree(known).query(cells)[0]
    return {
        "coverage_log": float(np.mean([tuple(cell) in visited for cell in index])),
        "coverage_nodes": float(np.mean(distance <= NODE_SPACING)),
    }


def velocity_r2(table: NodeTable, nodes: NDArray[np.int64], truth: Array) -> float:
    """Return the share of the velocity's variance that the recognised node (T,) explains."""
    velocity = truth[:, 1]
    fallback = np.average(np.nan_to_num(table.mean[:, 1]), weights=table.num_steps)
    predicted = np.where(table.num_steps[nodes] > 0, table.mean[nodes, 1], fallback)
    return float(1 - ((velocity - predicted) ** 2).mean() / velocity.var())


def _rms(values: Array, count: NDArray[np.int64]) -> float:
    active = count > 0
    return float(np.sqrt(np.average(values[active] ** 2, weights=count[active])))


# -- prediction --------------------------------------------------------------------------------


def forecast_ranks(
    agent: Agent, log: Trajectory, ahead: Sequence[int], num: int, rng: Rng
) -> dict[int, Array]:
    """Where observations fall in their forecasts, {steps ahead: (num, D)}.

    A forecast is the mixture of the nodes' Gaussians under the belief so many steps on. The rank of
    a reading is its cumulative probability: uniform on [0, 1], if forecasts are as sure as right.

    Args:
        agent: whose map forecasts, from the filtered belief.
        log: fresh, at the rate of the agent's control steps.
        ahead: steps ahead.
        num: times that forecasts are made at.
        rng: draws them.
    """
    observations = agent.readings.normalize(log.observations)
    beliefs = inference.filter_rows(agent.chain, observations)[0][:, agent.chain.cell]
    times = rng.choice(len(observations) - max(ahead), num, replace=False)
    mean = agent.hmm.emission_mean.detach().numpy()
    scale = agent.hmm.emission_scale.detach().numpy()
    ranks: dict[int, list[Array]] = {steps: [] for steps in ahead}
    for t in times:
        forecast = agent.hmm.forecast(torch.from_numpy(beliefs[t]).double(), max(ahead))
        for steps in ahead:
            weight = forecast[steps - 1].detach().numpy()
            below = norm.cdf((observations[t + steps] - mean) / scale)
            ranks[steps].append(weight @ below)
    return {steps: np.stack(rows) for steps, rows in ranks.items()}


def held_shares(ranks: Array, nominal: Array) -> Array:
    """Share of ranks inside central intervals of the given probabilities."""
    away = 2 * np.abs(ranks[np.isfinite(ranks)] - 0.5)
    return np.array([(away <= share).mean() for share in nominal])


# -- tasks ------------------------------------------------------------------------------------


class Outcome(NamedTuple):
    """What came of one task."""

    status: str
    """"reached", "gave_up", or "running" if the steps ran out."""
    num_steps: int
    """Actions taken."""
    trace: Array | None
    """(num_steps + 1, S) ground truth; None if the environment tells none."""
    nodes: NDArray[np.int64]
    """(num_steps + 1,) the node that the executor believed to be in, at each decision."""
    planned: list[int]
    """The first plan that was not empty; [] if there was none."""
    observation: NDArray[np.float32]
    """The last one."""
    info: dict[str, Any]
    """The last one."""
    is_over: bool = False
    """The environment's episode ended with the last observation."""
    reason: str = ""
    """Why the executor gave up."""

    @property
    def is_believed(self) -> bool:
        """Whether the executor said "reached"."""
        return self.status == "reached"

    @property
    def path_length(self) -> float:
        """Length of the way gone, for a ground truth that is a position; NaN without."""
        if self.trace is None:
            return math.nan
        return float(np.linalg.norm(np.diff(self.trace, axis=0), axis=1).sum())


def run_task(
    env: gym.Env,
    executor: Any,
    observation: NDArray[np.float32],
    info: dict[str, Any],
    limit: int,
    on_step: Callable[[Any, dict[str, Any]], None] | None = None,
) -> Outcome:
    """Act until the executor ends, `limit` actions are done, or the episode is over.

    Args:
        env: environment, in the state that `observation` and `info` tell of.
        executor: made by `Agent.executor`.
        observation: last one.
        info: last one.
        limit: actions at most; what the last one led to is still judged by the executor.
        on_step: called with the executor and `info` after each decision.
    """
    truths: list[Any] = [info.get("ground_truth")]
    nodes: list[int] = []
    planned: list[int] = []
    is_over = False
    while True:
        action = executor.act(observation)
        nodes.append(executor.node)
        planned = planned or list(executor.path)
        if on_step is not None:
            on_step(executor, info)
        if executor.status != "running" or len(nodes) > limit:
            break
        if is_over:
            observation, info = env.reset()
            is_over = False
        else:
            observation, _, terminated, truncated, info = env.step(action)
            is_over = terminated or truncated
        truths.append(info.get("ground_truth"))
    trace = None if truths[0] is None else np.stack(truths)
    node_array = np.array(nodes, np.int64)
    return Outcome(
        executor.status,
        len(nodes) - 1,
        trace,
        node_array,
        planned,
        observation,
        info,
        is_over,
        executor.reason,
    )


class Trial(NamedTuple):
    """A task, and whether it was done."""

    goal: int
    """The node that the executor heads for."""
    target: Array | None
    """(S,) ground truth of the goal; None or NaN if unknown."""
    outcome: Outcome
    is_true: bool | None
    """Reached in truth; None if the ground truth is unknown."""
    seed: int = 0
    """Seed of the executor."""
    start_known: bool = True
    """Whether the first observation looked like a place of the log."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "goal": int(self.goal),
            "status": self.outcome.status,
            "reason": self.outcome.reason,
            "true": self.is_true,
            "num_steps": self.outcome.num_steps,
            "start_node": int(self.outcome.nodes[0]),
            "end_node": int(self.outcome.nodes[-1]),
            "start_known": self.start_known,
        }


class Task(NamedTuple):
    """A goal and where it is."""

    goal: Any
    """Whatever `Agent.executor` takes."""
    target: Array | None
    """(S,) its ground truth; None if unknown."""
    start: Array | None = None
    """(S,) where the robot is put before; None goes on from where it is."""
    tolerance: float = 1.0
    """Largest distance from the target, in the world's tolerances."""


def node_tasks(nodes: NDArray[np.int64], table: NodeTable | None, num: int, rng: Rng) -> list[Task]:
    """Draw `num` goals uniformly from `nodes`."""
    goals = rng.choice(nodes, num)
    return [Task(int(goal), None if table is None else table.mean[goal]) for goal in goals]


def place_tasks(env: gym.Env, num: int, rng: Rng) -> list[Task]:
    """Draw `num` free places of the whole room; a goal is the observation that `env` makes there.

    Args:
        env: a maze of its own: it is reset at every place.
        num: how many.
        rng: of the draws.
    """
    tasks = []
    for _ in range(num):
        place = np.array(maze_layout(env).random_free_position(rng))
        goal, _ = env.reset(options={MAZE.reset_option: tuple(place)})
        tasks.append(Task(goal, place, tolerance=PLACE_TOLERANCE / NODE_SPACING))
    return tasks


def from_anywhere(tasks: Iterable[Task], env: gym.Env, log: Array | None, rng: Rng) -> list[Task]:
    """Give each task a start of its own: a free place of the maze, or a state of the log."""
    starts = []
    for task in tasks:
        if world_of(env) is MAZE:
            start = np.array(maze_layout(env).random_free_position(rng))
        elif log is not None:
            start = log[rng.integers(len(log))]
        else:
            raise ValueError("independent starts are drawn from a log's ground truth; give --log.")
        starts.append(task._replace(start=start))
    return starts


def maze_layout(env: gym.Env) -> Any:
    """Return the layout of a maze."""
    return env.unwrapped.layout  # type: ignore[attr-defined]


def run_tasks(
    env: gym.Env,
    agent: Agent,
    tasks: Iterable[Task],
    world: World | None,
    start: Array | None,
    seed: int,
    limit: int | None = None,
) -> Iterator[Trial]:
    """Do one task after the other; those without a start of their own are chained.

    Args:
        env: environment to act in.
        agent: its executors act.
        tasks: what to do.
        world: how ground truth is measured; None counts only what the agent believes.
        start: where the first task starts; None leaves it to the environment.
        seed: of the environment and of the executors.
        limit: control steps of a task; None is the world's.
    """
    steps = limit or (MAZE.limit if world is None else world.limit)
    observation, info = _reset(env, world, start, seed)
    for index, task in enumerate(tasks):
        if task.start is not None:
            observation, info = _reset(env, world, task.start)
        start_density = agent.log_emission(agent.readings.normalize(observation)).max()
        executor = agent.executor(task.goal, seed=seed + index)
        outcome = run_task(env, executor, observation, info, steps)
        if world is None:
            is_near = observed_near(agent, outcome.observation, executor.goal)
            is_true: bool | None = outcome.is_believed and is_near
        else:
            is_true = _is_true(task, outcome, world)
        start_known = bool(start_density >= agent.least_familiar)
        yield Trial(executor.goal, task.target, outcome, is_true, seed + index, start_known)
        observation, info = outcome.observation, outcome.info
        if outcome.is_over:
            observation, info = env.reset()


def observed_distance(agent: Agent, observation: NDArray[np.float32], node: int) -> float:
    """Return the distance of an observation from a node's mean.

    The rms over the readings that there are, each as a share of its range in the log.
    """
    mean = agent.hmm.emission_mean[node].detach().numpy()
    return float(np.sqrt(np.nanmean((agent.readings.normalize(observation) - mean) ** 2)))


def observed_near(agent: Agent, observation: NDArray[np.float32], node: int) -> bool:
    """Say whether an observation is at a node: the one rule for the agent and the random walk.

    Its distance from the node's mean is at most the node's width, the rms distance of what is seen
    there, or OBSERVED_TOLERANCE if that is more.
    """
    width = float(agent.node_width(np.array([node]))[0])
    return observed_distance(agent, observation, node) <= max(width, OBSERVED_TOLERANCE)


def longest_stay(env: gym.Env, executor: Any, outcome: Outcome, task: Task, world: World) -> int:
    """Let the executor act on after a task, for as long as a task takes at most.

    Returns the most steps in a row that the robot is near the task's target.
    """
    assert task.target is not None
    observation, longest, stay = outcome.observation, 0, 0
    for _ in range(world.limit):
        observation, *_, info = env.step(executor.act(observation))
        is_near = world.distance(info["ground_truth"], task.target) <= task.tolerance
        stay = stay + 1 if is_near else 0
        longest = max(longest, stay)
    return longest


def _is_true(task: Task, outcome: Outcome, world: World) -> bool | None:
    if task.target is None or outcome.trace is None:
        return None
    is_near = bool(world.distance(outcome.trace[-1], task.target) <= task.tolerance)
    return outcome.is_believed and is_near


def _reset(
    env: gym.Env, world: World | None, start: Array | None, seed: int | None = None
) -> tuple[NDArray[np.float32], dict[str, Any]]:
    if world is None or start is None:
        return env.reset(seed=seed)
    return env.reset(seed=seed, options={world.reset_option: tuple(start)})


def random_walk_share(
    env: gym.Env, trials: Sequence[Trial], tasks: Sequence[Task], world: World, seed: int
) -> float:
    """Return the share of the trials' tasks in which random actions come near the goal at any time.

    Args:
        env: environment to act in.
        trials: what the agent did: its starts are the walks' starts.
        tasks: the same tasks.
        world: how ground truth is measured.
        seed: of the actions.
    """
    found = 0
    for index, (trial, task) in enumerate(zip(trials, tasks, strict=True)):
        assert trial.outcome.trace is not None
        assert task.target is not None
        space: Any = env.action_space
        innate = InnateController(space.low, space.high, world.hold, world.levels, seed + index)
        _, info = _reset(env, world, trial.outcome.trace[0])
        for _ in range(world.limit):
            if world.distance(info["ground_truth"], task.target) <= task.tolerance:
                found += 1
                break
            *_, info = env.step(innate.act())
    return found / len(trials)


def observed_walk_share(
    env: gym.Env,
    agent: Agent,
    goals: Sequence[int],
    limit: int,
    hold: int,
    seed: int,
    levels: int | None = None,
) -> "Share":
    """Return the share of goals that random actions come to, by `observed_near`, at any time.

    Like the agent's tasks the walk's follow on each other, with as many steps for each.

    Args:
        env: environment to act in.
        agent: whose nodes the goals are.
        goals: one node a task.
        limit: steps of a task at most.
        hold: steps that each random action is held for.
        seed: of the environment and of the actions.
        levels: see `InnateController`.
    """
    found = 0
    innate = InnateController(*agent.actions, hold, levels, seed)
    observation, _ = env.reset(seed=seed)
    is_over = False
    for goal in goals:
        for step in range(limit + 1):
            if observed_near(agent, observation, goal):
                found += 1
                break
            if step == limit:
                break
            if is_over:
                observation, _ = env.reset()
                is_over = False
            else:
                observation, _, terminated, truncated, _ = env.step(innate.act())
                is_over = terminated or truncated
    return wilson(found, len(goals))


# -- scores -----------------------------------------------------------------------------------


class Share(NamedTuple):
    """A number of successes with its Wilson 95 % interval."""

    successes: int
    trials: int
    share: float
    low: float
    high: float

    def __str__(self) -> str:
        """Return for example "108/118 91.5 % [85.1, 95.3]"."""
        percent = f"{100 * self.share:.1f} % [{100 * self.low:.1f}, {100 * self.high:.1f}]"
        return f"{self.successes}/{self.trials} {percent}"


def wilson(successes: int, trials: int, confidence: float = 0.95) -> Share:
    """Return the share of successes with Wilson's score interval."""
    if not 0 <= successes <= trials or trials == 0:
        raise ValueError(
            f"{successes} successes of {trials} trials; needs 0 <= successes <= trials."
        )
    z, p = float(norm.ppf((1 + confidence) / 2)), successes / trials
    centre = (p + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * math.sqrt(p * (1 - p) / trials + (z / (2 * trials)) ** 2)
    return Share(successes, trials, p, max(0.0, centre - half), min(1.0, centre + half))


class Score(NamedTuple):
    """What came of a set of tasks."""

    believed: Share
    true: Share | None
    """None if the ground truth is unknown."""
    median_steps: float
    """Of the tasks truly done, or believed done where the truth is unknown; NaN if none."""
    median_detour: float
    """Way gone over the shortest free way, in tasks of the maze truly done; NaN elsewhere."""
    gave_up: int
    """Tasks that the executor gave up."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; NaN becomes None."""
        return {
            "believed": self.believed._asdict(),
            "true": None if self.true is None else self.true._asdict(),
            "median_steps": _or_none(self.median_steps),
            "median_detour": _or_none(self.median_detour),
            "gave_up": self.gave_up,
        }


def score(trials: Sequence[Trial], layout: Any = None) -> Score:
    """Count the successes; `layout` is needed for the detour."""
    believed = wilson(sum(trial.outcome.is_believed for trial in trials), len(trials))
    is_known = all(trial.is_true is not None for trial in trials)
    true = wilson(sum(bool(trial.is_true) for trial in trials), len(trials)) if is_known else None
    done = [trial for trial in trials if (trial.is_true if is_known else trial.outcome.is_believed)]
    detours = [] if layout is None or not is_known else [detour(trial, layout) for trial in done]
    return Score(
        believed,
        true,
        _median([float(trial.outcome.num_steps) for trial in done]),
        _median([value for value in detours if math.isfinite(value)]),
        sum(trial.outcome.status == "gave_up" for trial in trials),
    )


def detour(trial: Trial, layout: Any) -> float:
    """Return the length of the way gone over that of the shortest free way to the target.

    NaN if the target can't be stood at (a node's mean may lie in a wall), or if the start is nearer
    to it than a node's spacing: the ratio then tells only where near the target the robot stops.
    """
    trace, target = trial.outcome.trace, trial.target
    if trace is None or target is None or not np.isfinite(target).all():
        return math.nan
    if not (layout.is_free(trace[0]) and layout.is_free(target)):
        return math.nan
    shortest = layout.shortest_path_length(trace[0], target)
    return trial.outcome.path_length / shortest if shortest > NODE_SPACING else math.nan


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else math.nan


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
