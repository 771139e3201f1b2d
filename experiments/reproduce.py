"""Do the whole experiment: record, train, execute, score, draw; with the paper's choices and ours.

python -m experiments.reproduce maze
python -m experiments.reproduce pendulum --seeds 5 --out runs/pendulum5

Writes into the folder: results.json with every number, the paper's figures by its numbers, an
animation, and for each seed the log, both agents and TensorBoard's events.
"""

import contextlib
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
import tyro
from tqdm import tqdm

from experiments import cli, execute, figures, record, scoring, train
from experiments.scoring import MAZE, PENDULUM, NodeTable, Score, Task, Trial, World
from rfl_torch import Agent, Trajectory
from rfl_torch import record as record_log
from rfl_torch.monitor import TensorBoardMonitor

AGENTS = {
    "maze": {"paper": "paper", "default": "default"},
    "pendulum": {"paper": "paper-pendulum", "default": "pendulum"},
}
"""For each experiment the agents, with the names that `experiments.train` has for their choices."""

ENVIRONMENTS = {"maze": "rfl/RangefinderMaze-v0", "pendulum": "rfl/TorquePendulum-v0"}
WORLDS = {"maze": MAZE, "pendulum": PENDULUM}

CHAINED_NODES, CHAINED_PLACES = "chained nodes", "chained places"
WALKED = (CHAINED_NODES, CHAINED_PLACES)
"""Tasks that random actions are tried on, too."""
SWING_UP = "swing-up"
SWING_UPS = 50
"""The start is always the same, so only the executors' seeds differ."""
HOLD = "upright for 5 s"
HOLD_STEPS = 250
UPRIGHT_SHARE = 2 / 3
"""Of the tolerance, within which a goal for swinging up lies."""

FRESH_SEED = 1000
"""Added to a seed for the log that the agent has not seen."""

ATTRACTOR_REACH = 60.0  # mm
ATTRACTOR_PITCH = 12.0  # mm


@dataclass(frozen=True)
class Config:
    """Options of a reproduction."""

    experiment: Annotated[Literal["maze", "pendulum"], tyro.conf.Positional]
    """The paper's section 3 or 4."""
    seeds: int = 1
    """How many times to do all of it, each with its own log."""
    out: Path | None = None
    """Folder to write to; left out, runs/maze or runs/pendulum."""
    trials: int = 118
    """Tasks of each kind, as many as in the paper."""
    num_steps: int = 10_000
    """Control steps of a log, as many as in the paper."""
    seed: int = 0
    """The first seed."""
    skip_paper: bool = False
    """Leave out the agent with the paper's choices, which takes half of the time."""


class Run(NamedTuple):
    """One agent, learned from one log, and what it did."""

    agent: Agent
    table: NodeTable
    seconds: float
    """Time to learn [s]."""
    map_scores: dict[str, float]
    trials: dict[str, list[Trial]]
    """By the kind of tasks."""
    scores: dict[str, Score]
    random_walk: dict[str, float]
    """Share of the same tasks that random actions do, for some kinds."""


def main(config: Config) -> None:
    """Run every seed, then pool the numbers and print them."""
    for name in ("seeds", "trials", "num_steps"):
        cli.check_count(f"--{name.replace('_', '-')}", getattr(config, name))
    out = config.out or Path("runs") / config.experiment
    cli.check_writable(out / "results.json")
    with contextlib.ExitStack() as stack:
        env, probe = (
            stack.enter_context(cli.make_env(ENVIRONMENTS[config.experiment])) for _ in range(2)
        )
        runs: dict[str, list[Run]] = {
            name: []
            for name in AGENTS[config.experiment]
            if not (config.skip_paper and name == "paper")
        }
        for seed in range(config.seed, config.seed + config.seeds):
            folder = out / f"seed-{seed}"
            log = _record(config, env, seed, folder / "log.npz")
            for name in runs:
                runs[name].append(_run(config, env, probe, log, name, seed, folder))
            if seed == config.seed:
                draw = draw_maze if config.experiment == "maze" else draw_pendulum
                draw(out, env, log, {name: own[0] for name, own in runs.items()})
            with cli.replacing(out / "results.json") as new:
                new.write_text(json.dumps(results(config, runs), indent=2) + "\n")
    print(report(runs))
    print(f"\nresults.json and the figures are in {out}")


# -- record, train, execute -------------------------------------------------------------------


def _record(config: Config, env: gym.Env, seed: int, path: Path) -> Trajectory:
    world = WORLDS[config.experiment]
    log = record_log(
        env,
        config.num_steps,
        hold=world.hold,
        levels=world.levels,
        seed=seed,
        progress=lambda steps: tqdm(steps, desc=f"seed {seed}: record", unit="step"),
    )
    record.save_log(log, path)
    return log


def _run(
    config: Config,
    env: gym.Env,
    probe: gym.Env,
    log: Trajectory,
    name: str,
    seed: int,
    folder: Path,
) -> Run:
    """Train one agent, let it do all its tasks, and score it."""
    label, world = f"seed {seed}: {name}", WORLDS[config.experiment]
    choices = train.CONFIGS[AGENTS[config.experiment][name]]()
    with TensorBoardMonitor(folder / "tensorboard" / name) as board:
        begin = time.perf_counter()
        agent = train.fit(choices, [log], seed, board, f"{label}, train")
        seconds = time.perf_counter() - begin
        agent.save(folder / f"{name}.safetensors")
        table, truth = scoring.node_table(agent, [log], world), scoring.ground_truth([log])
        kinds = task_sets(env, probe, agent, table, truth, config.trials, seed)
        trials = {
            kind: execute.run(
                env,
                agent,
                tasks,
                swing_up_world() if kind == SWING_UP else world,
                truth[-1],
                seed,
                f"{label}, {kind}",
                board if kind == CHAINED_NODES else None,
            )
            for kind, tasks in kinds.items()
        }
    if SWING_UP in kinds:
        trials[HOLD] = list(hold_trials(env, agent, kinds[SWING_UP], seed, f"{label}, {HOLD}"))
    walks = {}
    if name == "default":
        for kind in [kind for kind in kinds if kind in WALKED]:
            walk = tqdm(trials[kind], desc=f"{label}, random walk, {kind}", unit="task")
            walks[kind] = scoring.random_walk_share(env, walk, kinds[kind], world, seed)
    layout = scoring.maze_layout(env) if world is MAZE else None
    scores = {kind: scoring.score(own, layout) for kind, own in trials.items()}
    numbers = _map_scores(agent, table, world, log, env, seed)
    return Run(agent, table, seconds, numbers, trials, scores, walks)


def task_sets(
    env: gym.Env,
    probe: gym.Env,
    agent: Agent,
    table: NodeTable,
    truth: scoring.Array,
    num: int,
    seed: int,
) -> dict[str, list[Task]]:
    """Return every kind of tasks; places are the same for all agents of a seed.

    Args:
        env: environment that they are done in.
        probe: another one like it, to see what it looks like at a place.
        agent: whose nodes are the goals.
        table: where the nodes are.
        truth: ground truth of the log, (T+1, S).
        num: tasks of each kind.
        seed: of the draws.
    """
    streams = iter(np.random.default_rng(seed).spawn(8))
    every = np.arange(agent.num_nodes)
    connected = np.flatnonzero(scoring.largest_component(scoring.planning_graph(agent)))
    kinds = {
        CHAINED_NODES: scoring.node_tasks(every, table, num, next(streams)),
        "chained connected nodes": scoring.node_tasks(connected, table, num, next(streams)),
    }
    nodes, rng = scoring.node_tasks(every, table, num, next(streams)), next(streams)
    kinds["independent nodes"] = scoring.from_anywhere(nodes, env, truth, rng)
    if scoring.world_of(env) is MAZE:
        kinds[CHAINED_PLACES] = scoring.place_tasks(probe, num, next(streams))
        places, rng = scoring.place_tasks(probe, num, next(streams)), next(streams)
        kinds["independent places"] = scoring.from_anywhere(places, env, truth, rng)
    else:
        task = Task(upright_node(table), np.array(scoring.UPRIGHT), start=np.zeros(2))
        kinds[SWING_UP] = [task] * SWING_UPS
    return kinds


def upright_node(table: NodeTable) -> int:
    """Return the slowest of the nodes that stand so nearly upright that arriving there will do.

    A log is hardly ever slow at the top: the node nearest in angle and velocity at once may lie
    further off than the tolerance. If all do, that one is returned.
    """
    offset = np.abs(PENDULUM.offset(table.mean, scoring.UPRIGHT))
    is_up = offset[:, 0] < UPRIGHT_SHARE * scoring.UPRIGHT_TOLERANCE
    if not is_up.any():
        return int(np.nanargmin(PENDULUM.distance(table.mean, scoring.UPRIGHT)))
    return int(np.where(is_up, offset[:, 1], np.inf).argmin())


def hold_trials(
    env: gym.Env, agent: Agent, tasks: Sequence[Task], seed: int, description: str
) -> Iterator[Trial]:
    """Swing up, and go on: true if it is followed by HOLD_STEPS in a row near upright."""
    world = swing_up_world()
    for index, task in enumerate(tqdm(tasks, desc=description, unit="task")):
        assert task.start is not None
        observation, info = env.reset(options={world.reset_option: tuple(task.start)})
        executor = agent.executor(task.goal, seed=seed + index)
        outcome = scoring.run_task(env, executor, observation, info, world.limit)
        is_held = outcome.is_believed and (
            scoring.longest_stay(env, executor, outcome, task, world) >= HOLD_STEPS
        )
        yield Trial(executor.goal, task.target, outcome, is_held, seed + index)


def swing_up_world() -> World:
    """Return the pendulum's measure for the swing-up: any velocity will do."""
    return replace(PENDULUM, tolerance=(scoring.UPRIGHT_TOLERANCE, np.inf))


def _map_scores(
    agent: Agent, table: NodeTable, world: World, log: Trajectory, env: gym.Env, seed: int
) -> dict[str, float]:
    scores = scoring.map_scores(agent, table, world)
    if world is MAZE:
        truth = scoring.ground_truth([log])
        return scores | scoring.coverage(scoring.maze_layout(env), truth, table)
    fresh = record_log(
        env, log.num_steps, hold=world.hold, levels=world.levels, seed=seed + FRESH_SEED
    )
    for name, own in (("log", log), ("fresh_log", fresh)):
        nodes, truth = agent.recognize(own.observations), scoring.ground_truth([own])
        scores[f"velocity_r2_{name}"] = scoring.velocity_r2(table, nodes, truth)
    return scores


# -- numbers ----------------------------------------------------------------------------------


def results(config: Config, runs: dict[str, list[Run]]) -> dict[str, Any]:
    """Return all numbers as plain JSON values."""
    return {
        "experiment": config.experiment,
        "trials": config.trials,
        "num_steps": config.num_steps,
        "seeds": [config.seed + i for i in range(len(runs["default"]))],
        "pooled": {name: _pooled_json(own) for name, own in runs.items()},
        "per_seed": {
            name: [
                {
                    "train_seconds": run.seconds,
                    "iterations": len(run.agent.record),
                    "log_likelihood_per_step": run.agent.record[-1].log_likelihood_per_step,
                    "map": run.map_scores,
                    "tasks": {kind: score.to_json() for kind, score in run.scores.items()},
                    "random_walk": run.random_walk,
                    "trials": {
                        kind: [trial.to_json() for trial in trials]
                        for kind, trials in run.trials.items()
                    },
                }
                for run in own
            ]
            for name, own in runs.items()
        },
    }


def pooled(runs: Sequence[Run], kind: str) -> Score:
    """Return the score of one kind of tasks over all seeds; medians are those of the seeds'."""
    scores = [run.scores[kind] for run in runs]
    true = [score.true for score in scores if score.true is not None]
    return Score(
        _sum([score.believed for score in scores]),
        _sum(true) if true else None,
        _median(score.median_steps for score in scores),
        _median(score.median_detour for score in scores),
        sum(score.gave_up for score in scores),
    )


def _pooled_json(runs: Sequence[Run]) -> dict[str, Any]:
    tasks = {}
    for kind in runs[0].scores:
        known = [run.scores[kind].true for run in runs]
        shares = [true.share for true in known if true is not None]
        tasks[kind] = pooled(runs, kind).to_json() | {
            "believed_over_seeds": _spread([run.scores[kind].believed.share for run in runs]),
            "true_over_seeds": _spread(shares),
        }
    maps = {key: _spread([run.map_scores[key] for run in runs]) for key in runs[0].map_scores}
    walks = {key: _spread([run.random_walk[key] for run in runs]) for key in runs[0].random_walk}
    seconds = _spread([run.seconds for run in runs])
    return {"train_seconds": seconds, "map": maps, "tasks": tasks, "random_walk": walks}


def report(runs: dict[str, list[Run]]) -> str:
    """Return the tables that the command ends with."""
    tasks = [
        [name, *execute.row(kind, pooled(own, kind))]
        for name, own in runs.items()
        for kind in own[0].scores
    ]
    tasks += [
        [
            "random walk",
            kind,
            "-",
            f"{100 * np.mean([run.random_walk[kind] for run in own]):.1f} % within reach",
            *["-"] * 3,
        ]
        for own in runs.values()
        for kind in own[0].random_walk
    ]
    keys = list(runs["default"][0].map_scores)
    maps = [
        [key, *(f"{np.mean([run.map_scores[key] for run in own]):.3g}" for own in runs.values())]
        for key in keys
    ]
    maps.append(
        [
            "train_seconds",
            *(f"{np.mean([run.seconds for run in own]):.0f}" for own in runs.values()),
        ]
    )
    return "\n\n".join(
        [cli.table(["agent", *execute.HEADER], tasks), cli.table(["map", *runs], maps)]
    )


def _sum(shares: Sequence[scoring.Share]) -> scoring.Share:
    return scoring.wilson(sum(s.successes for s in shares), sum(s.trials for s in shares))


def _median(values: Iterator[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else np.nan


def _spread(values: Sequence[float]) -> dict[str, float | None]:
    """Return mean and standard deviation over the seeds; of one seed there is none."""
    deviation = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return {"mean": float(np.mean(values)), "std": deviation}


# -- figures ----------------------------------------------------------------------------------


def draw_maze(out: Path, env: gym.Env, log: Trajectory, runs: dict[str, Run]) -> None:
    """Draw figures 5 to 9 and the animation."""
    layout, truth = scoring.maze_layout(env), scoring.ground_truth([log])
    walls = layout.solid_walls
    with cli.replacing(out / "figure_5_trajectory.png") as new:
        figures.draw_trajectory(new, truth, walls)
    with cli.replacing(out / "figure_6_observations.png") as new:
        figures.draw_observations(new, log.observations.astype(np.float64))
    for name, run in runs.items():
        with cli.replacing(out / f"figure_7_map_{name}.png") as new:
            edges = np.stack(scoring.planning_graph(run.agent).nonzero(), 1)
            figures.draw_map(new, run.table.mean, edges, walls, run.table.spread, truth)
    run = runs["default"]
    with cli.replacing(out / "figure_8_attractors.png") as new:
        panels = [attractor(env, run, node) for node in attractor_nodes(layout, run.table)]
        figures.draw_attractors(new, panels, walls)
    trial = execute.best_trial(run.trials[CHAINED_NODES])
    _draw_execution(out / "figure_9_execution.png", run, trial, walls)
    draw_calibration(out / "calibration.png", run.agent, record_log(env, *FRESH_LOG))
    execute.animate(out / "execution.gif", env, run.agent, trial, run.table)


FRESH_LOG = (2000, 1, 1_000_000)
"""Steps, hold and seed of the log that forecasts are compared with."""


def draw_calibration(path: Path, agent: Agent, log: Trajectory) -> None:
    """Draw how often readings fall inside the intervals forecast for them."""
    rng, nominal = np.random.default_rng(0), np.linspace(0.0, 1.0, 21)
    ranks = scoring.forecast_ranks(agent, log, (1, 5, 20), 300, rng)
    held = {steps: scoring.held_shares(rows, nominal) for steps, rows in ranks.items()}
    with cli.replacing(path) as new:
        figures.draw_calibration(new, nominal, held)


def draw_pendulum(out: Path, env: gym.Env, log: Trajectory, runs: dict[str, Run]) -> None:
    """Draw figures 10b and 11 and the animation of a swing-up."""
    for name, run in runs.items():
        with cli.replacing(out / f"figure_10b_map_{name}.png") as new:
            edges = np.stack(scoring.planning_graph(run.agent).nonzero(), 1)
            truth = scoring.ground_truth([log])
            figures.draw_map(new, run.table.mean, edges, None, log=truth, **PLANE)
    run = runs["default"]
    trial = execute.best_trial(run.trials[SWING_UP])
    _draw_execution(out / "figure_11_execution.png", run, trial, None, **PLANE)
    execute.animate(out / "swing_up.gif", env, run.agent, trial, run.table)


PLANE: dict[str, Any] = {"labels": figures.PENDULUM_LABELS, "period": 2 * np.pi}


def attractor_nodes(layout: Any, table: NodeTable, num: int = 4) -> list[int]:
    """Return nodes that are often active in one place each, off the walls, far from each other."""
    is_active = table.num_steps > 0
    usual = np.median(table.num_steps[is_active])
    fit = (table.num_steps >= usual) & (table.spread < scoring.WORMHOLE_SPREAD)
    fit[is_active] &= layout.clearance(table.mean[is_active]) >= ATTRACTOR_REACH
    nodes = np.flatnonzero(fit if fit.any() else is_active)
    chosen = [int(nodes[table.num_steps[nodes].argmax()])]
    while len(chosen) < min(num, len(nodes)):
        away = table.mean[nodes][:, None] - table.mean[chosen]
        chosen.append(int(nodes[np.linalg.norm(away, axis=-1).min(1).argmax()]))
    return chosen


def attractor(env: gym.Env, run: Run, node: int) -> figures.Attractor:
    """Put the robot around the node, and see where the node's controller moves it from there."""
    steps = np.arange(-ATTRACTOR_REACH, ATTRACTOR_REACH + 1, ATTRACTOR_PITCH)
    centre = run.table.mean[node]
    around = centre + np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    layout = scoring.maze_layout(env)
    positions = [place for place in around if layout.is_free(place)]
    arrows = []
    for place in positions:
        observation, _ = env.reset(options={"position": tuple(place)})
        *_, info = env.step(run.agent.control(run.agent.readings.normalize(observation), node))
        arrows.append(info["ground_truth"] - place)
    return figures.Attractor(centre, np.array(positions), np.array(arrows))


def _draw_execution(path: Path, run: Run, trial: Trial, walls: Any, **plane: Any) -> None:
    assert trial.outcome.trace is not None
    with cli.replacing(path) as new:
        figures.draw_execution(
            new,
            run.table.mean,
            planned=trial.outcome.planned,
            recognized=trial.outcome.nodes,
            positions=trial.outcome.trace,
            goal=trial.goal,
            walls=walls,
            **plane,
        )


if __name__ == "__main__":
    cli.run(main, Config, __doc__)
