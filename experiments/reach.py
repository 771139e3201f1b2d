"""How much of a room an agent reaches: this method, the paper's, and peers, at equal steps.

Part of `python -m experiments.benchmark reach`. A contestant gets environment steps without reward,
and is then asked to go to places drawn from the whole room; those with a map also to its nodes.
All are scored by ground truth, from independent starts, on the same places.

The peer is Stable-Baselines3's SAC with hindsight experience replay: the same 24 ranges, the goal's
ranges, and the ranges reached instead as hindsight goals. It counts as there if it comes near the
goal at any time, since it has no word for "reached". Its episodes begin anywhere in the room, as
those of the contestant with 20 logs do; the others' only log begins where the layout says.
"""

import copy
import importlib.util
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree
from tqdm import tqdm

import sims
from experiments import cli, figures, scoring
from experiments.on_the_way import Learner, Watched
from experiments.scoring import MAZE, PLACE_TOLERANCE, Share, Task, wilson
from experiments.tour import Tour
from rfl_torch import (
    Agent,
    AgentConfig,
    InnateController,
    Trajectory,
    record,
    record_episodes,
)
from rfl_torch.innate import action_bounds
from rfl_torch.practice import Strategy
from sims.maze import STEP_LENGTH

PEER_HORIZON = 100
"""Steps of the peer's episodes."""

SAME_SIGHT, SIGHT_SPACING = 0.015, 5.0
"""Mean absolute difference of ranges, half a full step's, within which places look the same, and
millimetres between the places that are compared."""

PEER_NEAR = 0.03
"""Mean absolute difference of ranges within which the peer's goal counts as reached in training:
about a full step."""


Contestant = Literal[
    "random-walk",
    "best-by-sight",
    "paper",
    "held-1",
    "held-3",
    "knows-walls",
    "learning",
    "held-10",
    "practice",
    "strategies",
    "oracle",
    "logs-20",
    "sac",
]


@dataclass(frozen=True)
class Reach:
    """Going to places: the paper's configuration, the default, practice, and peers."""

    contestants: tuple[Contestant, ...] = get_args(Contestant)
    """Who takes part: the paper's configuration; the default on actions held 1, 3 and 10, that
    held 3 in 20 logs, or learning from its tasks; with practice by the default strategy, or by the
    others; nodes that are true places; peers."""
    layouts: tuple[str, ...] = tuple(sims.layouts.built_in_layouts())
    """Built-in names or JSON files."""
    seeds: int = 5
    """Logs of each layout."""
    trials: int = 118
    """Tasks of each kind."""
    num_steps: int = 10_000
    """Steps of a log; the one held 3 is twice as long."""
    practice: int = 20_000
    """Steps of practice."""
    peer_steps: tuple[int, ...] = (10_000, 30_000, 100_000)
    """Environment steps of the peer; it needs the extra `reach`."""
    sensor_noise: float = 0.0
    """Largest share by which a reading is off, in logs and in tasks."""
    motion_noise: float = 0.0
    """Largest share by which a move is off."""
    peer_seeds: int = 1
    """Seeds that the peer gets; 100,000 steps take it half an hour."""
    out: Path = Path("runs/reach")
    """Folder for results.json and the plot."""
    seed: int = 0
    """First seed."""


class Row(NamedTuple):
    """One contestant on one log."""

    name: str
    layout: str
    seed: int
    num_steps: int
    """Environment steps that it learned from."""
    seconds: float
    """Seconds of learning, steps included."""
    places: Share | None = None
    """True success on place goals."""
    nodes: Share | None = None
    """True success on node goals, one after the other; None without a map."""
    anywhere: Share | None = None
    """The same goals, each from a place of the whole room."""
    coverage: float = np.nan
    """Share of the free cells within a node's reach; NaN without a map."""
    wormholes: float = np.nan
    """Share of the steps in nodes that mix places."""
    connected: float = np.nan
    """Share of the nodes in the largest strongly connected component."""


def benchmark_reach(config: Reach) -> None:
    """Run all contestants, print the table, write results.json and the plot."""
    for name in ("seeds", "trials", "num_steps", "practice"):
        cli.check_count(name, getattr(config, name))
    names = set(config.contestants)
    if "sac" in names and importlib.util.find_spec("stable_baselines3") is None:
        print("SAC with HER left out: pip install 'rfl-torch[reach]'")
        names.remove("sac")
    rows: list[Row] = []
    runs = [(layout, config.seed + k) for layout in config.layouts for k in range(config.seeds)]
    for layout, seed in (bar := tqdm(runs, unit="log")):
        for row in _contest(config, layout, seed, names):
            rows.append(row)
            bar.set_postfix(layout=layout, seed=seed, done=row.name, refresh=True)
            _keep(config, rows)
    print(cli.table(*_table(rows)))
    print(f"{config.out / 'results.json'}, {config.out / 'reach.png'}")


def _make(config: Reach, layout: str) -> gym.Env:
    return gym.make(
        "rfl/RangefinderMaze-v0",
        layout=layout,
        sensor_noise=config.sensor_noise,
        motion_noise=config.motion_noise,
    )


def _contest(config: Reach, layout: str, seed: int, names: set[Contestant]) -> Iterator[Row]:
    """All of those contestants on one layout and seed."""
    with _make(config, layout) as env:
        judge = Judge(env, layout, seed, config.trials)
        if "random-walk" in names:
            yield judge.random_walk()
        if "best-by-sight" in names and not config.sensor_noise:
            yield judge.best_by_sight()
        if "paper" in names:
            log = record(env, config.num_steps, 1, seed)
            yield judge.score("paper", *_learn(AgentConfig.paper(), [log], seed))
        if "held-1" in names:
            log = record(env, config.num_steps, 1, seed)
            yield judge.score("default, independent actions", *_learn(AgentConfig(), [log], seed))
        if names & {"held-3", "knows-walls", "learning"}:
            log = record(env, 2 * config.num_steps, 3, seed)
            learned = agent, _, _ = _learn(AgentConfig(), [log], seed)
            if "held-3" in names:
                yield judge.score("default, held 3", *learned)
            if "knows-walls" in names:
                yield judge.who_knows_the_walls("knows the walls, not the log held 3", agent, log)
            if "learning" in names:
                yield from judge.score_on_the_way(
                    "default, held 3, learning from tasks", agent, log
                )
        if names & {"held-10", "practice", "strategies", "oracle"}:
            log = record(env, config.num_steps, 10, seed)
            learned = agent, _, _ = _learn(AgentConfig(), [log], seed)
            if "held-10" in names:
                yield judge.score("default, held 10", *learned)
            if "oracle" in names:
                yield judge.score("oracle map, held 10", know_places(agent, log, seed), [log], 0.0)
            for strategy in get_args(Strategy):
                if ("practice" if strategy == "frontier" else "strategies") in names:
                    yield from _practise(config, judge, env, agent, log, strategy, seed)
        if "logs-20" in names:
            scattered = gym.wrappers.TimeLimit(Anywhere(env, seed), config.num_steps // 10)
            logs = record_episodes(scattered, 2 * config.num_steps, 3, seed)
            yield judge.score("default, held 3, 20 logs", *_learn(AgentConfig(), logs, seed))
        if "sac" in names and seed < config.seed + config.peer_seeds:
            yield from _run_peer(config, judge, layout, seed)


def _learn(
    choices: AgentConfig, logs: list[Trajectory], seed: int
) -> tuple[Agent, list[Trajectory], float]:
    """Return an agent, its logs, and the seconds that learning took."""
    begin = time.perf_counter()
    agent = Agent(choices, seed).fit(logs)
    return agent, logs, time.perf_counter() - begin


class Anywhere(gym.Wrapper):
    """Every episode begins at a random place of the room."""

    def __init__(self, env: gym.Env, seed: int) -> None:
        super().__init__(env)
        self._rng = np.random.default_rng([seed, 3])

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Begin anew."""
        place = scoring.maze_layout(self.env).random_free_position(self._rng)
        return self.env.reset(**options | {"options": {MAZE.reset_option: place}})


def _practise(
    config: Reach,
    judge: "Judge",
    env: gym.Env,
    start: Agent,
    log: Trajectory,
    strategy: Strategy,
    seed: int,
) -> Iterator[Row]:
    """Practise by one strategy, and be scored four times on the way."""
    agent, logs, seconds = copy.deepcopy(start), [log], 0.0
    watched = Watched(env)
    for part in range(4):
        begin = time.perf_counter()
        agent.practice(watched, config.practice // 4, seed=4 * seed + part, strategy=strategy)
        seconds += time.perf_counter() - begin
        logs += watched.take()
        yield judge.score(f"practice: {strategy}", agent, logs, seconds)


def know_places(agent: Agent, log: Trajectory, seed: int) -> Agent:
    """An agent whose nodes are clusters of the log's true positions."""
    assert log.ground_truth is not None
    _, node = kmeans2(log.ground_truth, agent.num_nodes, minit="++", rng=seed)
    observations = agent.readings.normalize(log.observations)
    oracle = Agent(agent.config, agent.seed)
    oracle.__dict__ |= {name: value for name, value in agent.__dict__.items() if name != "hmm"}
    oracle.hmm = type(agent.hmm)((2, 2), observations.shape[1])
    return oracle.learn_from_labels(
        [log], [node.astype(np.int64)], [log.ground_truth / STEP_LENGTH]
    )


# -- judging ------------------------------------------------------------------------------------


class Judge:
    """Scores contestants on one log's room, all on the same tasks."""

    def __init__(self, env: gym.Env, layout: str, seed: int, trials: int) -> None:
        self._env, self._layout, self._seed, self._trials = env, layout, seed, trials
        rng = np.random.default_rng([seed, 1])
        places = scoring.place_tasks(env, trials, rng)
        self.places = scoring.from_anywhere(places, env, None, rng)

    def score(self, name: str, agent: Agent, logs: list[Trajectory], seconds: float) -> Row:
        """Let an agent do the tasks."""
        table = scoring.node_table(agent, logs, MAZE)
        nodes, starting_anywhere = self._node_tasks(agent, table)
        # Nodes first: what goes wrong on the way to a place that no log knows is remembered.
        chained = self._run(agent, nodes, logs[-1].ground_truth)
        anywhere = self._run(agent, starting_anywhere, None)
        return self._row(name, agent, logs, table, seconds, chained, anywhere)

    def score_on_the_way(self, name: str, start: Agent, log: Trajectory) -> Iterator[Row]:
        """Let an agent do the node tasks from anywhere, and learn from what it saw and did there.

        The goals are those of `score`: the nodes that truly lie where the map's nodes lay before,
        whatever their numbers are now. A row for each half.
        """
        agent, watched = copy.deepcopy(start), Watched(self._env)
        learner = Learner(agent, watched, [log], MAZE)
        _, tasks = self._node_tasks(agent, scoring.node_table(agent, [log], MAZE))
        half = len(tasks) // 2
        for begin, part in ((0, tasks[:half]), (half, tasks[half:])):
            if not part:  # of one task
                continue
            run = (watched, agent, learner.between(part), MAZE, None, self._seed + begin)
            share = _share([bool(trial.is_true) for trial in scoring.run_tasks(*run)])
            table = scoring.node_table(agent, learner.logs, MAZE)
            yield self._row(name, agent, learner.logs, table, learner.seconds, None, share)

    def _node_tasks(self, agent: Agent, table: scoring.NodeTable) -> tuple[list[Task], list[Task]]:
        """Nodes of a map to go to, and the same with a start anywhere in the room for each."""
        rng = np.random.default_rng([self._seed, 2])
        nodes = scoring.node_tasks(np.arange(agent.num_nodes), table, self._trials, rng)
        return nodes, scoring.from_anywhere(nodes, self._env, None, rng)

    def _row(
        self,
        name: str,
        agent: Agent,
        logs: list[Trajectory],
        table: scoring.NodeTable,
        seconds: float,
        nodes: Share | None,
        anywhere: Share,
    ) -> Row:
        """With the scores of the map, and of places."""
        layout = scoring.maze_layout(self._env)
        covered = scoring.coverage(layout, scoring.ground_truth(logs), table)
        scores = scoring.map_scores(agent, table, MAZE)
        return Row(
            name,
            self._layout,
            self._seed,
            sum(log.num_steps for log in logs),
            seconds,
            self._run(agent, self.places, None),
            nodes,
            anywhere,
            covered["coverage_nodes"],
            scores["wormhole_share"],
            scores["strongly_connected_share"],
        )

    def _run(self, agent: Agent, tasks: list[Task], truth: Any) -> Share:
        start = None if truth is None else truth[-1]
        trials = scoring.run_tasks(self._env, agent, tasks, MAZE, start, self._seed)
        return _share([bool(trial.is_true) for trial in trials])

    def peer(self, name: str, num_steps: int, seconds: float, act: Callable[..., Any]) -> Row:
        """Let `act(observation, goal) -> action` do the places; near at any time counts."""
        places = _share([self._comes_near(task, act) for task in self.places])
        return Row(name, self._layout, self._seed, num_steps, seconds, places)

    def who_knows_the_walls(self, name: str, agent: Agent, log: Trajectory) -> Row:
        """The agent's node goals from anywhere, by a search that needs to find out nothing."""
        assert log.ground_truth is not None
        _, tasks = self._node_tasks(agent, scoring.node_table(agent, [log], MAZE))
        tour = Tour(scoring.maze_layout(self._env), log.ground_truth)
        in_time = _share([tour.steps(task) <= MAZE.limit for task in tasks])
        return Row(name, self._layout, self._seed, log.num_steps, 0.0, anywhere=in_time)

    def best_by_sight(self) -> Row:
        """What nobody surpasses in the mean who knows the room and is told what a place looks like.

        Several bays that look the same, or all of a hall from whose middle nothing is in sight,
        fit the goal: the best is to stop where most of what fits is near.
        """
        cells = scoring.maze_layout(self._env).free_cells(SIGHT_SPACING)
        sights = np.stack(
            [self._env.reset(options={MAZE.reset_option: tuple(cell)})[0] for cell in cells]
        )
        best = 0.0
        for task in self.places:
            assert task.target is not None
            fits = np.abs(sights - task.goal).mean(1) <= SAME_SIGHT
            tree = cKDTree(np.concatenate([cells[fits], task.target[None]]))
            best += max(len(near) for near in tree.query_ball_tree(tree, PLACE_TOLERANCE)) / tree.n
        places = wilson(round(best), len(self.places))
        return Row("best by sight", self._layout, self._seed, 0, 0.0, places)

    def random_walk(self) -> Row:
        """Held random actions."""
        innate = InnateController(*action_bounds(self._env.action_space), 10, seed=self._seed)
        return self.peer("random walk (near at any time)", 0, 0.0, lambda *_: innate.act())

    def _comes_near(self, task: Task, act: Callable[..., Any]) -> bool:
        assert task.start is not None
        options = {MAZE.reset_option: tuple(task.start)}
        observation, info = self._env.reset(options=options)
        for _ in range(MAZE.limit):
            if np.linalg.norm(info["ground_truth"] - task.target) <= PLACE_TOLERANCE:
                return True
            observation, _, _, _, info = self._env.step(act(observation, task.goal))
        return False


def _share(outcomes: list[bool]) -> Share:
    return wilson(sum(outcomes), len(outcomes))


# -- the peer -----------------------------------------------------------------------------------


class GoalMaze(gym.Wrapper):
    """The maze with a goal's ranges beside the robot's own, as HER wants it."""

    def __init__(self, env: gym.Env, seed: int) -> None:
        super().__init__(env)
        space = env.observation_space
        self.observation_space = gym.spaces.Dict(
            {name: space for name in ("observation", "achieved_goal", "desired_goal")}
        )
        self._rng = np.random.default_rng(seed)
        self._seen: list[NDArray[np.float32]] = []
        self._left = 0

    def reset(self, **options: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin at a random place, with a sight that was seen before as the goal."""
        place = scoring.maze_layout(self.env).random_free_position(self._rng)
        observation, info = self.env.reset(options={MAZE.reset_option: place})
        self._seen.append(observation)
        self._goal = self._seen[self._rng.integers(len(self._seen))]
        self._left = PEER_HORIZON
        return self._dict(observation), info

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Go on; the reward is -1 until the goal is in sight."""
        observation, _, _, _, info = self.env.step(action)
        self._seen.append(observation)
        self._left -= 1
        reward = float(self.compute_reward(observation, self._goal, info))
        return self._dict(observation), reward, reward == 0.0, self._left == 0, info

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        """0 where the ranges differ by less than a full step, else -1."""
        return -(np.abs(achieved - desired).mean(-1) > PEER_NEAR).astype(np.float32)

    def _dict(self, observation: Any) -> dict[str, Any]:
        return {
            "observation": observation,
            "achieved_goal": observation,
            "desired_goal": self._goal,
        }


def _run_peer(config: Reach, judge: Judge, layout: str, seed: int) -> Iterator[Row]:
    """Train SAC with HER, and score it at each number of steps."""
    from stable_baselines3 import SAC, HerReplayBuffer

    with _make(config, layout) as env:
        model = SAC(
            "MultiInputPolicy",
            GoalMaze(env, seed),
            replay_buffer_class=HerReplayBuffer,
            replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
            learning_starts=1000,
            learning_rate=1e-3,
            gamma=0.98,
            seed=seed,
            device="cpu",
        )

        def act(observation: Any, goal: Any) -> Any:
            seen = {"observation": observation, "achieved_goal": observation, "desired_goal": goal}
            return model.predict(seen, deterministic=True)[0]

        begin, done = time.perf_counter(), 0
        for steps in sorted(config.peer_steps):
            model.learn(steps - done, reset_num_timesteps=done == 0)
            done = steps
            yield judge.peer(
                "SAC + HER (near at any time)", steps, time.perf_counter() - begin, act
            )


# -- results ------------------------------------------------------------------------------------


def _table(rows: list[Row]) -> tuple[list[str], list[list[str]]]:
    """Rows pooled over seeds, for each layout and contestant, and each time it was scored."""
    header = ["layout", "contestant", "steps", "logs", "node goals", "from anywhere", "place goals"]
    header += ["coverage", "wormholes", "connected", "seconds"]
    groups: dict[tuple[str, str, int], list[Row]] = {}
    seen: Counter[tuple[str, str, int]] = Counter()
    for row in rows:  # who is scored on the way has several rows of a seed
        seen[row.layout, row.name, row.seed] += 1
        number = seen[row.layout, row.name, row.seed]
        groups.setdefault((row.layout, row.name, number), []).append(row)
    lines = []
    for (layout, name, _), group in groups.items():
        nodes = [row.nodes for row in group if row.nodes is not None]
        anywhere = [row.anywhere for row in group if row.anywhere is not None]
        places = [row.places for row in group if row.places is not None]
        lines.append(
            [
                layout,
                name,
                f"{np.median([row.num_steps for row in group]):.0f}",
                str(len(group)),
                str(_pool(nodes)) if nodes else "-",
                str(_pool(anywhere)) if anywhere else "-",
                str(_pool(places)) if places else "-",
                _percent([row.coverage for row in group]),
                _percent([row.wormholes for row in group]),
                _percent([row.connected for row in group]),
                f"{np.median([row.seconds for row in group]):.0f}",
            ]
        )
    return header, lines


def _pool(shares: list[Share]) -> Share:
    return wilson(sum(x.successes for x in shares), sum(x.trials for x in shares))


def _percent(values: list[float]) -> str:
    return "-" if np.isnan(values).all() else f"{100 * np.nanmean(values):.1f} %"


def _keep(config: Reach, rows: list[Row]) -> None:
    """Write what there is so far."""
    config.out.mkdir(parents=True, exist_ok=True)
    plain = [
        row._asdict()
        | {
            name: None if (goals := getattr(row, name)) is None else goals._asdict()
            for name in ("nodes", "anywhere", "places")
        }
        | {name: _or_none(getattr(row, name)) for name in ("coverage", "wormholes", "connected")}
        for row in rows
    ]
    with cli.replacing(config.out / "results.json") as new:
        new.write_text(json.dumps(plain, indent=1) + "\n")
    curves: dict[str, dict[int, list[float]]] = {}
    for row in rows:
        if row.num_steps and row.places is not None:
            points = curves.setdefault(row.name, {})
            points.setdefault(row.num_steps, []).append(row.places.successes / row.places.trials)
    with cli.replacing(config.out / "reach.png") as new:
        figures.draw_success_curve(
            new,
            {name: _curve(points) for name, points in curves.items()},
            "environment steps without reward",
            "place goals truly reached",
        )


def _curve(points: dict[int, list[float]]) -> tuple[Any, Any, Any, Any]:
    x = sorted(points)
    ends = [(np.mean(points[k]), np.min(points[k]), np.max(points[k])) for k in x]
    mean, low, high = (np.array(part) for part in zip(*ends, strict=True))
    return np.array(x), mean, low, high


def _or_none(value: float) -> float | None:
    return None if np.isnan(value) else value
