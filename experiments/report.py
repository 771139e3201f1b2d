"""Write one HTML page about a run: what was learned, how well it acts, and where it fails.

python -m experiments.report runs/maze
python -m experiments.report runs/mine --model runs/mine/agent.safetensors

A run is a folder: all that `experiments.reproduce` leaves, or logs, an agent, TensorBoard's events
and the results.json and animations of `experiments.execute --results --gif`. What is missing is
left out. The page holds its pictures itself: it can be mailed.
"""

import base64
import io
import json
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jinja2
import numpy as np
import tyro
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments import cli, scoring
from experiments.figures import BLUE, DPI, GREEN, INK, ORANGE, PALE, RED, WIDTH
from rfl_torch import Agent, Trajectory, read_logs
from rfl_torch.planner import largest_component

TEMPLATE = Path(__file__).with_name("report.html")

CURVES = {
    "hmm/log_likelihood_per_step": "log-likelihood per step [nat]",
    "hmm/active_nodes": "nodes in use",
    "hmm/transition_entropy": "entropy of a transition [nat]",
    "hmm/temperature": "temperature",
}
"""What is drawn of TensorBoard's scalars, one panel each."""

HARDEST = 8
"""Goals that are listed."""

FEW_STEPS = 5
"""A node that the log visits less is known badly."""

LARGEST_PICTURE = 8_000_000
"""Bytes; larger files are named instead of shown."""


@dataclass(frozen=True)
class Config:
    """Options of a report."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of the run."""
    out: Path | None = None
    """Page to write; left out, report.html in the folder."""
    model: Path | None = None
    """The agent that the page is about; left out, the folder's `default`, or else its first."""
    log: tuple[str, ...] = ()
    """Its logs; left out, those beside the agent."""


class Goal(NamedTuple):
    """A node that was to be reached."""

    node: int
    tries: int
    done: int
    why: str


def main(config: Config) -> None:
    """Write the page."""
    if not config.run.is_dir():
        raise ValueError(f"{config.run} is no folder; give the folder of a run.")
    out = config.out or config.run / "report.html"
    cli.check_writable(out)
    page = render(config)
    with cli.replacing(out) as new:
        new.write_text(page, encoding="utf-8")
    print(f"{out}: {len(page) / 1e6:.1f} MB")


def render(config: Config) -> str:
    """Return the page.

    Raises:
        ValueError: if the run has no agent.
    """
    model = config.model or _find_model(config.run)
    agent = Agent.load(model)
    logs = [log for source in config.log or _find_logs(model) for log in read_logs(source)]
    logs = [log for log in logs if log.observations.shape[1] == len(agent.readings.low)]
    results = _read_results(config.run)
    walls, world = _surroundings(results)
    nodes = _recognized(agent, logs)
    place, is_true_place = scoring.node_places(agent, logs, world)
    trials = list(_trials(results, model))
    goals = hardest_goals(agent, trials, nodes)
    pictures, left_out = _pictures(config.run)
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(TEMPLATE.read_text()).render(
        run=config.run.resolve().name,
        model=str(model),
        written=datetime.now().astimezone().strftime("%d %B %Y, %H:%M"),
        facts=_facts(agent, logs),
        map=_uri(_draw_goals(agent, place, trials, walls)),
        is_true_place=is_true_place,
        has_trials=bool(trials),
        tables=_tables(results),
        curves=_draw_curves(config.run),
        goals=goals[:HARDEST],
        num_failed=len(goals),
        num_goals=len({trial["goal"] for trial in trials}),
        animations=[picture for picture in pictures if picture[0].endswith(".gif")],
        figures=[picture for picture in pictures if picture[0].endswith(".png")],
        left_out=left_out,
        configuration=_flat(asdict(agent.config) | {"seed": agent.seed}),
        options=_flat(results.get("options", {})),
    )


# -- what there is ----------------------------------------------------------------------------


def _find_model(run: Path) -> Path:
    models = sorted(run.rglob("*.safetensors"))
    if not models:
        raise ValueError(f"{run} holds no agent; train one into it, or name it with --model.")
    return next((path for path in models if path.stem == "default"), models[0])


def _find_logs(model: Path) -> list[Path]:
    return sorted(path for path in model.parent.iterdir() if path.suffix in {".npz", ".csv"})


def _read_results(run: Path) -> dict[str, Any]:
    path = run / "results.json"
    if not path.exists():
        return {}
    try:
        results = json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is no JSON ({error}); write it anew.") from None
    return results if isinstance(results, dict) else {}


def _surroundings(results: dict[str, Any]) -> tuple[Any, scoring.World | None]:
    """The walls and the measure of the run's environment, where it is one of ours."""
    options = results.get("options", {})
    name = {"maze": "rfl/RangefinderMaze-v0", "pendulum": "rfl/TorquePendulum-v0"}.get(
        results.get("experiment", ""), options.get("env", "")
    )
    if not name.startswith("rfl/"):
        return None, None
    with cli.make_env(name, options.get("layout"), options.get("env_kwargs", "{}")) as env:
        world = scoring.world_of(env)
        walls = scoring.maze_layout(env).solid_walls if world is scoring.MAZE else None
    return walls, world


def _trials(results: dict[str, Any], model: Path) -> Iterable[dict[str, Any]]:
    """Every task whose goal is a node, of this agent, from either command."""
    kinds = results.get("trials", {})
    if "per_seed" in results:
        seed = model.parent.name.removeprefix("seed-")
        seeds = [str(value) for value in results.get("seeds", [])]
        runs = results["per_seed"].get(model.stem, [])
        kinds = runs[seeds.index(seed)].get("trials", {}) if seed in seeds and runs else {}
    for kind, trials in kinds.items():
        if "node" in kind:
            yield from trials


def _recognized(agent: Agent, logs: list[Trajectory]) -> NDArray[np.int64]:
    """The node at each step of the logs."""
    paths = [agent.recognize(log.observations) for log in logs]
    return np.concatenate([np.zeros(0, np.int64), *paths])


# -- what it says -----------------------------------------------------------------------------


def _facts(agent: Agent, logs: list[Trajectory]) -> list[tuple[str, str]]:
    graph = scoring.planning_graph(agent)
    connected = largest_component(graph).mean()
    facts = [
        ("nodes", f"{agent.num_nodes} of {int(np.prod(agent.config.shape))}"),
        ("edges that are planned over", str(graph.nnz)),
        ("can go from each to each", f"{100 * connected:.1f} % of the nodes"),
        ("readings", str(len(agent.readings.low))),
        ("actions", str(len(agent.actions.rest))),
        ("runs backwards as it runs forwards", "yes" if agent.is_reversible else "no"),
    ]
    if logs:
        steps = sum(log.num_steps for log in logs)
        episodes = f" in {len(logs)} episodes" if len(logs) > 1 else ""
        facts.insert(0, ("learned from", f"{steps} steps{episodes}"))
    return facts


def hardest_goals(
    agent: Agent, trials: Iterable[dict[str, Any]], nodes: NDArray[np.int64]
) -> list[Goal]:
    """Return the goals that were missed, most often first, and what is known of why.

    Args:
        agent: whose nodes they are.
        trials: `scoring.Trial.to_json` of each task.
        nodes: the node at each step of the logs, (T,); empty if they are unknown.
    """
    own: dict[int, list[dict[str, Any]]] = defaultdict(list)
    for trial in trials:
        own[trial["goal"]].append(trial)
    graph = scoring.planning_graph(agent)
    is_connected = largest_component(graph)
    visits = np.bincount(nodes, minlength=agent.num_nodes) if len(nodes) else None
    goals = []
    for node, tries in own.items():
        missed = [trial for trial in tries if not _is_done(trial)]
        if not missed:
            continue
        ways = Counter(_ending(trial) for trial in missed)
        why = [f"{ending} ({count})" for ending, count in ways.most_common()]
        if strange := sum(not trial["start_known"] for trial in missed):
            why.append(f"started where the log has not been ({strange})")
        if not graph[:, [node]].nnz:
            why.append("no known edge leads to it")
        elif not is_connected[node]:
            why.append("outside the part of the map where all nodes reach each other")
        if visits is not None and visits[node] < FEW_STEPS:
            why.append(f"the log was there for {visits[node]} of {visits.sum()} steps")
        starts = {trial["start_node"] for trial in missed}
        if len(missed) < len(tries):
            why.append(f"missed from node {', '.join(map(str, sorted(starts)[:4]))}")
        goals.append(Goal(node, len(tries), len(tries) - len(missed), "; ".join(why)))
    return sorted(goals, key=lambda goal: (goal.done / goal.tries, -goal.tries, goal.node))


def _is_done(trial: dict[str, Any]) -> bool:
    return trial["status"] == "reached" if trial["true"] is None else bool(trial["true"])


def _ending(trial: dict[str, Any]) -> str:
    if trial["status"] == "reached":
        return "believed to be there, and was elsewhere"
    if trial["status"] == "gave_up":
        return "gave up: " + (trial["reason"] or "no reason given")
    return f"still on its way after {trial['num_steps']} steps"


def _tables(results: dict[str, Any]) -> list[dict[str, Any]]:
    """The success tables: of one agent, or of each of a reproduction, pooled over its seeds."""
    agents = results.get("pooled") or {"": results} if results else {}
    tables = []
    for name, own in agents.items():
        rows = [
            {
                "kind": kind,
                "believed": _share(score["believed"]),
                "true": _share(score["true"]),
                "steps": _number(score["median_steps"], ".0f"),
                "detour": _number(score["median_detour"], ".2f"),
                "gave_up": score["gave_up"],
                "walk": _walk(own.get("random_walk", {}).get(kind)),
            }
            for kind, score in own.get("tasks", {}).items()
        ]
        if rows:
            tables.append({"name": name, "rows": rows})
    return tables


def _share(share: dict[str, Any] | None) -> dict[str, Any] | None:
    """Percentages of a `scoring.Share`."""
    if share is None:
        return None
    percent = {key: 100 * share[key] for key in ("share", "low", "high")}
    return percent | {"successes": share["successes"], "trials": share["trials"]}


def _walk(share: dict[str, Any] | float | None) -> str:
    if share is None:
        return ""
    if isinstance(share, dict):
        share = share.get("share", share.get("mean"))
    return _number(None if share is None else 100 * share, ".1f") + " %"


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)  # noqa: RUF001


def _flat(options: dict[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    rows = []
    for name, value in options.items():
        if isinstance(value, dict):
            rows += _flat(value, f"{prefix}{name}.")
        elif isinstance(value, list | tuple) and value and isinstance(value[0], dict):
            for index, part in enumerate(value):
                rows += _flat(part, f"{prefix}{name}[{index}].")
        else:
            rows.append((prefix + name, str(value)))
    return rows


# -- pictures ---------------------------------------------------------------------------------


def _draw_goals(
    agent: Agent, place: NDArray[np.float64], trials: list[dict[str, Any]], walls: Any
) -> bytes:
    """Draw the map, its nodes coloured by how often they were reached."""
    figure = Figure(figsize=(1.3 * WIDTH, 0.9 * WIDTH), layout="constrained")
    axes = figure.add_subplot()
    source, target = scoring.planning_graph(agent).nonzero()
    lines = place[np.stack([source, target], 1)]
    lines = lines[np.isfinite(lines).all((1, 2))]
    axes.add_collection(LineCollection(list(lines), colors=PALE, linewidths=0.7))
    if walls is not None:
        segments = np.asarray(walls, np.float64).reshape(-1, 2, 2)
        axes.add_collection(LineCollection(list(segments), colors=INK, linewidths=2))
    tries = np.bincount([trial["goal"] for trial in trials], minlength=agent.num_nodes)
    done = np.bincount(
        [trial["goal"] for trial in trials if _is_done(trial)], minlength=agent.num_nodes
    )
    groups = (
        (tries == 0, BLUE, 10, "o", "node" if not trials else "not tried"),
        ((tries > 0) & (done == tries), GREEN, 22, "o", "reached each time"),
        ((tries > 0) & (done < tries) & (done > 0), ORANGE, 34, "s", "missed sometimes"),
        ((tries > 0) & (done == 0), RED, 46, "X", "missed each time"),
    )
    for members, colour, size, marker, label in groups:
        if members.any():
            axes.scatter(
                place[members, 0],
                place[members, 1],
                s=size,
                c=colour,
                marker=marker,
                edgecolors="white",
                linewidths=0.4,
                label=f"{label} ({members.sum()})",
                zorder=3,
            )
    axes.autoscale_view()
    axes.set_aspect("equal" if walls is not None else "auto")
    axes.set_axis_off()
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return _png(figure)


def _draw_curves(run: Path) -> str | None:
    """Draw the curves of every event file as one picture; None without any."""
    try:
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    except ImportError:
        return None
    curves: dict[str, dict[str, Any]] = defaultdict(dict)
    for folder in sorted({path.parent for path in run.rglob("events.out.tfevents*")}):
        events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
        events.Reload()
        for tag in set(events.Tags()["scalars"]) & set(CURVES):
            points = events.Scalars(tag)
            curves[tag][str(folder.relative_to(run))] = (
                [point.step for point in points],
                [point.value for point in points],
            )
    if not curves:
        return None
    figure = Figure(figsize=(1.5 * WIDTH, 0.75 * WIDTH), layout="constrained")
    for axes, (tag, label) in zip(figure.subplots(2, 2).flat, CURVES.items(), strict=True):
        for name, (steps, values) in curves[tag].items():
            axes.plot(steps, values, lw=1.3, label=name)
        axes.set(xlabel="EM iteration", ylabel=label)
        if tag == "hmm/temperature":
            axes.set_yscale("log")
        axes.spines[["top", "right"]].set_visible(False)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    return _uri(_png(figure))


def _pictures(run: Path) -> tuple[list[tuple[str, str]], list[str]]:
    """The run's animations and figures, by name and data URI, and those too large to hold."""
    pictures, left_out = [], []
    for path in sorted([*run.rglob("*.gif"), *run.rglob("*.png")]):
        name = str(path.relative_to(run))
        if path.stat().st_size > LARGEST_PICTURE:
            left_out.append(name)
        else:
            pictures.append((name, _uri(path.read_bytes(), path.suffix[1:])))
    return pictures, left_out


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def _uri(content: bytes, kind: str = "png") -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


if __name__ == "__main__":
    cli.run(main, Config, __doc__)
