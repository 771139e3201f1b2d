"""Let a trained agent go to one goal after the other, and count how often it arrives.

python -m experiments.execute --model maze.safetensors --env rfl/RangefinderMaze-v0 --trials 118
python -m experiments.execute --model maze.safetensors --log log.npz --gif way.gif
python -m experiments.execute --model acrobot.safetensors --env Acrobot-v1 --hold 4
python -m experiments.execute --model maze.safetensors --log log.npz --learn better.safetensors

"believed" counts the tasks that the agent says it has done. "true" needs to know where the goals
are: a maze's places are known, its nodes only by the training log (--log). In an environment
without a ground truth of ours it asks that the last observation is as near to the goal node's
mean as what is seen at that node is on average, and random actions are tried on the same goals:
what they pass by at any time the agent must exceed by where it says that it has arrived.
"""

import contextlib
import copy
import functools
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from tqdm import tqdm

from experiments import cli, figures, scoring
from experiments.on_the_way import Learner, Watched
from experiments.scoring import MAZE, NodeTable, Task, Trial, World
from rfl_torch import Agent
from rfl_torch.innate import action_bounds
from rfl_torch.monitor import TensorBoardMonitor


@dataclass(frozen=True)
class Config:
    """Options of an execution."""

    model: Path
    """Agent that `experiments.train` wrote."""
    env: str = "rfl/RangefinderMaze-v0"
    """Environment to act in: an id or module:id."""
    trials: int = 118
    """Tasks of each kind."""
    limit: int | None = None
    """Control steps of a task; left out, 800 in the maze, 1000 for the pendulum, 200 elsewhere."""
    log: tuple[str, ...] = ()
    """The training logs, for where the nodes are: without them no node's goal is checked."""
    goal: int | None = None
    """Go to this node every time, instead of to random ones."""
    gif: Path | None = None
    """Animation of a task to write. In our environments it needs --log; elsewhere the environment
    draws itself."""
    learn: Path | None = None
    """Learn between the tasks from what was seen and done in them, and write the agent here. Goals
    are the nodes of the map as it was; --log tells where they truly are."""
    results: Path | None = None
    """JSON file to write every number and task to; `experiments.report` reads a results.json."""
    logdir: Path | None = None
    """Folder for TensorBoard's events: the success rate after each task. A training's own folder
    is better left alone: give one beside it."""
    layout: str | None = None
    """The maze's layout: a built-in name, or the path of a JSON file."""
    env_kwargs: str = "{}"
    """More arguments of the environment, a JSON object such as '{"sensor_noise": 0.02}'."""
    observation_keys: tuple[str, ...] = ()
    """Where observations are a dictionary: the keys that the robot senses."""
    hold: int = 1
    """Steps that the random walk holds each action for, in environments that are not ours; give
    the log's."""
    levels: int | None = None
    """Values that the random walk draws each action from; give the log's."""
    seed: int = 0
    """Seed of the goals, the starts and the executors."""


def main(config: Config) -> None:
    """Run the tasks and print what came of them."""
    _check(config)
    agent = Agent.load(config.model)
    logs = cli.read_all_logs(config.log, config.observation_keys)
    with contextlib.ExitStack() as stack:
        made = _make_env(config)
        watched = Watched(made) if config.learn is not None else None
        env, probe = (
            stack.enter_context(cli.with_action_rows(each))
            for each in (made if watched is None else watched, _make_env(config))
        )
        check_fit(agent, env)
        world = scoring.world_of(env)
        camera = None
        if config.gif is not None and world is None:
            made = _make_env(config, render_mode="rgb_array")
            camera = stack.enter_context(cli.with_action_rows(made))
            camera.reset()
            camera.render()  # what it lacks it says now, not after all the tasks
        elif config.gif is not None and not logs:
            raise ValueError("--gif draws where the nodes are; give the training log with --log.")
        truth = scoring.ground_truth(logs) if logs and world is not None else None
        if world is None and logs:
            raise ValueError(
                f"--log tells where the nodes are, but {config.env!r} has no measure of what is "
                "near enough; leave it out."
            )
        is_scored = world is not None and truth is not None
        table = scoring.node_table(agent, logs, world) if is_scored and world else None
        board = None
        if config.logdir is not None:
            config.logdir.mkdir(parents=True, exist_ok=True)
            board = stack.enter_context(TensorBoardMonitor(config.logdir))
            board.config(asdict(config))
        kinds = _tasks(config, agent, env, probe, table, truth)
        known, learner = agent, None
        if watched is not None and config.learn is not None:
            known, save = copy.deepcopy(agent), functools.partial(agent.save, config.learn)
            learner = Learner(agent, watched, logs, world, save)
        rows, note = [], ""
        tasks_json: dict[str, Any] = {}
        trials_json: dict[str, Any] = {}
        walks_json: dict[str, Any] = {}
        limit = config.limit or (FOREIGN_LIMIT if world is None else world.limit)
        for name, tasks in kinds.items():
            start = None if truth is None else truth[-1]
            trials = run(env, agent, tasks, world, start, config.seed, name, board, limit, learner)
            score = scoring.score(trials, _layout(env))
            rows.append(row(name, score))
            tasks_json[name] = score.to_json()
            trials_json[name] = [trial.to_json() for trial in trials]
            if config.gif is not None and name.startswith("node"):
                if camera is not None:
                    film(config.gif, camera, agent, best_trial(trials), limit)
                elif table is not None:
                    animate(config.gif, env, agent, best_trial(trials), table)
            if world is None:
                goals = tqdm([task.goal for task in tasks], desc="random walk", unit="task")
                walk = scoring.observed_walk_share(
                    env, known, goals, limit, config.hold, config.seed, config.levels
                )
                walks_json[name] = walk._asdict()
                rows.append(["random walk", "-", str(walk), "-", "-", "-"])
                note = (
                    "\ntrue: the agent says so, and its last observation is within the goal node's "
                    f"width, or {scoring.OBSERVED_TOLERANCE:g} if that is more, of the node's mean "
                    "(rms over the readings, each as a share of its range in the log; the width is "
                    "the rms distance of what is seen there). The random walk's: any observation "
                    f"of {limit} steps is."
                )
    if config.results is not None:
        results = {
            "options": json.loads(json.dumps(asdict(config), default=str)),
            "limit": limit,
            "tasks": tasks_json,
            "random_walk": walks_json,
            "trials": trials_json,
        }
        with cli.replacing(config.results) as new:
            new.write_text(json.dumps(results, indent=2) + "\n")
    print(cli.table(HEADER, rows) + note)
    if config.learn is not None:
        agent.save(config.learn)  # which it was not yet if there was nothing to learn from
        print(f"{config.learn}: {known.num_nodes} nodes before, {agent.num_nodes} now")


FOREIGN_LIMIT = 200
"""Steps of a task in an environment that is not ours. Random actions find most goals in time."""

HEADER = ["goals", "believed", "true", "median steps", "median detour", "gave up"]


def row(name: str, score: scoring.Score) -> list[str]:
    """Return a line of the table of results."""
    return [
        name,
        str(score.believed),
        "unknown" if score.true is None else str(score.true),
        _number(score.median_steps, ".0f"),
        _number(score.median_detour, ".2f"),
        str(score.gave_up),
    ]


def run(
    env: gym.Env,
    agent: Agent,
    tasks: Sequence[Task],
    world: World | None,
    start: scoring.Array | None,
    seed: int,
    description: str,
    board: TensorBoardMonitor | None = None,
    limit: int | None = None,
    learner: Learner | None = None,
) -> list[Trial]:
    """Run the tasks with a progress bar, and write the running success rate to TensorBoard."""
    trials: list[Trial] = []
    shown = tasks if learner is None else learner.between(tasks)
    running = scoring.run_tasks(env, agent, shown, world, start, seed, limit)
    done = 0
    for trial in (bar := tqdm(running, total=len(tasks), desc=description, unit="task")):
        trials.append(trial)
        done += trial.outcome.is_believed if trial.is_true is None else trial.is_true
        bar.set_postfix(success=f"{done / len(trials):.2f}", refresh=False)
        if board is not None:
            kind = description.rpartition(", ")[2].replace(" ", "_")
            board.scalar(f"execute/success_rate/{kind}", done / len(trials), len(trials))
    return trials


def best_trial(trials: Sequence[Trial]) -> Trial:
    """Return the most telling trial: the longest way that led truly, or by belief, to the goal."""
    return max(
        trials,
        key=lambda trial: (
            bool(trial.is_true),
            trial.outcome.is_believed,
            len(trial.outcome.planned),
        ),
    )


def animate(path: Path, env: gym.Env, agent: Agent, trial: Trial, table: NodeTable) -> None:
    """Do the task of the trial again, from the same start, and write an animation of it.

    It may take another way: what later tasks found out counts by now.
    """
    frames: list[figures.Frame] = []
    world, trace = scoring.world_of(env), trial.outcome.trace
    assert world is not None
    assert trace is not None
    observation, info = env.reset(options={world.reset_option: tuple(trace[0])})
    executor = agent.executor(trial.goal, seed=trial.seed)
    scoring.run_task(
        env,
        executor,
        observation,
        info,
        world.limit,
        lambda executor, info: frames.append(
            figures.Frame(info["ground_truth"], executor.node, list(executor.path), executor.goal)
        ),
    )
    with cli.replacing(path) as new:
        if world is MAZE:
            walls = scoring.maze_layout(env).solid_walls
            figures.write_execution_gif(new, table.mean, frames, walls)
        else:
            states = np.stack([frame.position for frame in frames])
            planned = trial.outcome.planned or [trial.goal]
            figures.write_pendulum_gif(new, states, table.mean, planned)


def film(path: Path, env: gym.Env, agent: Agent, trial: Trial, limit: int) -> None:
    """Go to the trial's goal from the environment's own start, and write what `env` renders."""
    frames: list[Any] = []
    observation, info = env.reset(seed=trial.seed)
    executor = agent.executor(trial.goal, seed=trial.seed)
    scoring.run_task(
        env, executor, observation, info, limit, lambda *_: frames.append(env.render())
    )
    with cli.replacing(path) as new:
        figures.write_film(new, frames)


def _make_env(config: Config, **more: Any) -> gym.Env:
    arguments = (config.env, config.layout, config.env_kwargs, config.observation_keys)
    return cli.make_env(*arguments, **more)


def _tasks(
    config: Config,
    agent: Agent,
    env: gym.Env,
    probe: gym.Env,
    table: NodeTable | None,
    truth: scoring.Array | None,
) -> dict[str, list[Task]]:
    rng = np.random.default_rng(config.seed)
    world = scoring.world_of(env)
    if config.goal is not None:
        if not 0 <= config.goal < agent.num_nodes:
            raise ValueError(
                f"--goal is {config.goal}; the agent has the nodes 0 to {agent.num_nodes - 1}."
            )
        tasks = scoring.node_tasks(np.array([config.goal]), table, config.trials, rng)
        if world is MAZE or truth is not None:
            tasks = scoring.from_anywhere(tasks, env, truth, rng)
        return {f"node {config.goal}": tasks}
    kinds = {"nodes": scoring.node_tasks(np.arange(agent.num_nodes), table, config.trials, rng)}
    if world is MAZE:
        kinds["places"] = scoring.place_tasks(probe, config.trials, rng)
    return kinds


def _check(config: Config) -> None:
    """Refuse what can be refused before any work."""
    cli.check_count("--trials", config.trials)
    if config.limit is not None:
        cli.check_count("--limit", config.limit)
    if config.results is not None:
        cli.check_writable(config.results)
    if config.gif is not None:
        cli.check_writable(config.gif)
    if config.learn is not None:
        cli.check_writable(config.learn)
        if config.gif is not None:
            raise ValueError(
                "--gif shows a task that is done again, by a map that --learn has changed; leave "
                "one of them out, or film the agent that --learn wrote."
            )


def check_fit(agent: Agent, env: gym.Env) -> None:
    """Refuse an environment that the agent has not learned from."""
    shapes = (env.observation_space.shape, action_bounds(env.action_space)[0].shape)
    needed = (agent.readings.low.shape, agent.actions.rest.shape)
    if shapes != needed:
        raise ValueError(
            f"the environment has observations and actions of shapes {shapes}, the agent learned "
            f"with {needed}; give the --env of its log."
        )


def _layout(env: gym.Env) -> object:
    return scoring.maze_layout(env) if scoring.world_of(env) is MAZE else None


def _number(value: float, form: str) -> str:
    return "-" if np.isnan(value) else format(value, form)


if __name__ == "__main__":
    cli.run(main, Config, __doc__)
