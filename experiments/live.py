"""Watch an agent on a local page, and send it to places by a click.

python -m experiments.live --model maze.safetensors --log log.npz
python -m experiments.live --model acrobot.safetensors --env Acrobot-v1

The page is at http://127.0.0.1:8080, and answers this machine alone. It is made with NiceGUI: a
click, a timer and a chart are a few lines of Python there, with no scripts to keep, and all that
the page needs comes with the package, so that it works without a network.
"""

import asyncio
import base64
import io
import socket
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from experiments import cli, execute, scoring
from experiments.drive import Drive
from experiments.figures import BLUE, GREEN, INK, ORANGE, PALE, RED
from rfl_torch import Agent

HOST = "127.0.0.1"
REFRESH = 0.1
"""Seconds between two pictures of the page."""

MARGIN = 0.04
"""Free part of the chart around the map."""

INSET = {"left": 8, "right": 8, "top": 36, "bottom": 8}
"""Pixels of the chart beside its axes; the legend is at the top."""

USUAL_WIDTH = 880
"""Pixels of the chart in a usual window, for which its height is right."""

LEAST_BELIEF = 0.02
"""Less probable nodes are not marked."""

COLOURS = {
    "waiting": "grey-6",
    "on its way": "primary",
    "reached": "positive",
    "lost": "negative",
    "gave up": "warning",
    "paused": "grey-8",
    "practising": "purple",
}


@dataclass(frozen=True)
class Config:
    """Options of the live page."""

    model: Path
    """Agent that `experiments.train` wrote."""
    env: str = "rfl/RangefinderMaze-v0"
    """Environment to act in: an id or module:id."""
    log: tuple[str, ...] = ()
    """The training logs: with a ground truth they tell where the nodes are. Without, the map is
    laid out from its graph."""
    rate: float = 20.0
    """Control steps a second."""
    port: int = 8080
    """Port of the page."""
    practice_steps: int = 2000
    """Control steps of a practice."""
    out: Path | None = None
    """File to write the agent to after each practice; left out, what it learned is lost."""
    layout: str | None = None
    """The maze's layout: a built-in name, or the path of a JSON file."""
    env_kwargs: str = "{}"
    """More arguments of the environment, a JSON object such as '{"sensor_noise": 0.02}'."""
    observation_keys: tuple[str, ...] = ()
    """Where observations are a dictionary: the keys that the robot senses."""
    seed: int = 0
    """Seed of the start and of the executors."""


def main(config: Config) -> None:
    """Serve the page until interrupted."""
    try:
        from nicegui import app, ui
    except ImportError:
        raise ImportError(
            "the live page needs NiceGUI; try pip install 'rfl-torch[live]' (or nicegui)."
        ) from None
    if not config.rate > 0:
        raise ValueError(f"--rate is {config.rate}; needs more than 0 steps a second.")
    cli.check_count("--practice-steps", config.practice_steps)
    _check_port(config.port)
    if config.out is not None:
        cli.check_writable(config.out)
    agent = Agent.load(config.model)
    logs = cli.read_all_logs(config.log, config.observation_keys)
    with _make_env(config) as env:
        execute.check_fit(agent, env)
        drive = Drive(env, agent, logs, config.seed)

        async def keep_ticking() -> None:
            while True:
                try:
                    drive.tick()
                except Exception as error:  # told on the page, which goes on
                    traceback.print_exc()
                    drive.fail(error)
                await asyncio.sleep(1 / config.rate)

        app.on_startup(keep_ticking)
        print(f"http://{HOST}:{config.port}  (end with Ctrl+C)", flush=True)
        ui.run(
            lambda: build_page(drive, config),
            host=HOST,
            port=config.port,
            title="rfl_torch",
            reload=False,
            show=False,
            show_welcome_message=False,
        )


def _make_env(config: Config) -> Any:
    """The environment, drawing itself if it can and its map has no true places."""
    arguments = (config.env, config.layout, config.env_kwargs, config.observation_keys)
    env = cli.make_env(*arguments)
    if scoring.world_of(env) is None and "rgb_array" in env.metadata.get("render_modes", ()):
        try:
            drawing = cli.make_env(*arguments, render_mode="rgb_array")
            drawing.reset()
            drawing.render()
        except Exception as error:  # any failure of a renderer leaves the page without a picture
            print(f"note: no picture of the environment: {error}")
        else:
            env.close()
            env = drawing
    return cli.with_action_rows(env)


def _check_port(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError) as error:
            raise ValueError(f"port {port} can't be used ({error}); try another --port.") from None


# -- the page ---------------------------------------------------------------------------------


def build_page(drive: Drive, config: Config) -> None:
    """Lay the page out; called once for each browser that opens it."""
    from nicegui import run, ui

    ui.query("body").style("background: #f4f5f7")
    shown = {"map": drive.map_version, "event": 0}
    with ui.row().classes("w-full no-wrap items-start gap-4"):
        with ui.card().classes("grow"):
            chart = ui.echart(
                chart_options(drive),
                on_point_click=lambda click: _clicked(drive, click.series_name, click.data_index),
            ).classes("w-full")
            chart.style(f"height: auto; aspect-ratio: {_aspect(drive):.3f}; max-height: 80vh")
            chart.props('id="map"')
            ui.label("Click on a node to send the robot there.").classes("text-grey-7")
        with ui.column().classes("w-80 shrink-0"):
            with ui.card().classes("w-full"):
                badge = ui.badge().classes("text-lg q-pa-sm").mark("status")
                badge.props('id="status"')
                where = ui.label().classes("text-body1").props('id="where"')
                going = ui.label().classes("text-body1").props('id="going"')
                practised = ui.linear_progress(show_value=False)
            with ui.row():
                pause = ui.button("Pause", icon="pause", on_click=drive.toggle_pause)
                kidnap = ui.button("Kidnap", icon="back_hand", on_click=drive.kidnap)
                practise = ui.button("Practice", icon="fitness_center")

            async def start_practice() -> None:
                try:
                    await run.io_bound(drive.practise, config.practice_steps)
                    if config.out is not None:
                        drive.agent.save(config.out)
                except Exception as error:  # told on the page, which goes on
                    traceback.print_exc()
                    drive.fail(error)

            practise.on_click(start_practice)
            picture = ui.interactive_image().classes("w-full rounded").props('id="picture"')
            picture.set_visibility(drive.env.render_mode == "rgb_array")
            ui.label("What happened").classes("text-grey-7")
            events = ui.log(max_lines=200).classes("w-full h-64 bg-white").props('id="events"')

    def refresh() -> None:
        if shown["map"] != drive.map_version:
            shown["map"] = drive.map_version
            chart.options.clear()
            chart.options.update(chart_options(drive))
            chart.update()
        chart.run_chart_method("setOption", {"series": moving_series(drive)})
        badge.set_text(drive.status)
        badge.props(f"color={COLOURS[drive.status]}")
        where.set_text(describe_place(drive))
        going.set_text(describe_way(drive))
        pause.set_text("Go on" if drive.is_paused else "Pause")
        is_free = drive.practice_share is None
        practised.set_visibility(not is_free)
        practised.set_value(drive.practice_share or 0.0)
        for button in (pause, kidnap, practise):
            button.set_enabled(is_free)
        new = min(drive.num_events - shown["event"], len(drive.events))
        for event in list(drive.events)[len(drive.events) - new :]:
            events.push(f"{event.step:6d}  {event.text}")
        shown["event"] = drive.num_events
        if picture.visible and is_free:
            picture.set_source(_picture(drive))

    ui.timer(REFRESH, refresh)


def _clicked(drive: Drive, series: str, index: int) -> None:
    if series == NODES and drive.practice_share is None:
        drive.go_to(int(_known(drive)[index]))


def describe_place(drive: Drive) -> str:
    """Say where the robot thinks it is."""
    executor = drive.executor
    if executor.node < 0:
        return "It has not looked yet."
    chance = 100 * executor.belief[executor.node]
    return f"It thinks it is at node {executor.node} ({chance:.0f} % sure)."


def describe_way(drive: Drive) -> str:
    """Say where the robot is going."""
    if drive.goal is None:
        return "It has no goal."
    if drive.executor.status == "reached":
        return f"It has reached node {drive.goal}."
    if drive.executor.status == "gave_up":
        return f"It gave up on node {drive.goal}: {drive.executor.reason}."
    left = len(drive.path) - 1
    way = f"{left} node{'s' * (left != 1)} to go" if drive.path else "no way known yet"
    return f"It goes to node {drive.goal}: {way}, re-planned {drive.num_plans} times."


# -- the chart --------------------------------------------------------------------------------

NODES, TRUE, BELIEVED = "nodes", "where it is", "where it thinks it is"
PLAN, GOAL, TRAIL, BELIEF = "its plan", "where it is going", "where it has been", "belief"


def chart_options(drive: Drive) -> dict[str, Any]:
    """The chart with all that stands still: walls, transitions and nodes."""
    known = _known(drive)
    low, high = chart_limits(drive)
    edges = np.stack(scoring.planning_graph(drive.agent).nonzero(), 1)
    lines = drive.place[edges[(edges < len(drive.place)).all(1)]]  # practice adds nodes
    lines = lines[np.isfinite(lines).all((1, 2))]
    walls = np.zeros((0, 2, 2))
    if drive.world is scoring.MAZE and drive.is_true_place:
        walls = scoring.maze_layout(drive.env).solid_walls.reshape(-1, 2, 2)
    still = [
        _lines("transitions", lines, PALE, 1, z=1),
        _lines("walls", walls, INK, 3, z=1),
        {
            "name": NODES,
            "id": NODES,
            "type": "scatter",
            "data": drive.place[known].round(3).tolist(),
            "symbolSize": 8,
            "itemStyle": {"color": "#8a8f98"},
            "emphasis": {"scale": 2, "itemStyle": {"color": RED}},
            "cursor": "pointer",
            "z": 10,
        },
    ]
    shown = [name for name in (TRUE, BELIEVED, PLAN, GOAL) if name != TRUE or _is_placed(drive)]
    axis = {"show": False, "type": "value"}
    return {
        "animation": False,
        "grid": INSET,
        "legend": {"data": shown, "top": 2, "textStyle": {"fontSize": 14}, "selectedMode": False},
        "xAxis": axis | {"min": low[0], "max": high[0]},
        "yAxis": axis | {"min": low[1], "max": high[1]},
        "series": still + moving_series(drive),
    }


def moving_series(drive: Drive) -> list[dict[str, Any]]:
    """What moves: belief, plan, goal and the robot itself."""
    place, belief = drive.place, drive.executor.belief[: len(drive.place)]
    likely = np.flatnonzero(belief > LEAST_BELIEF)
    likely = likely[np.isfinite(place[likely]).all(1)]
    node = drive.executor.node
    here = place[node : node + 1] if 0 <= node < len(place) else place[:0]
    goal = place[:0] if drive.goal is None else place[[drive.goal]]
    path = [n for n in drive.path if n < len(place)]
    is_placed = _is_placed(drive)
    # Near the goal the names would cover each other and the marks.
    is_above = len(goal) == 0 or len(here) == 0 or goal[0][1] > here[0][1]
    goal_side, here_side = ("top", "bottom") if is_above else ("bottom", "top")
    return [
        {
            "name": BELIEF,
            "id": BELIEF,
            "type": "scatter",
            "silent": True,
            "data": [
                {
                    "value": _pair(place[n]),
                    "symbolSize": round(10 + 26 * float(belief[n]) ** 0.5, 1),
                }
                for n in likely
            ],
            "itemStyle": {"color": BLUE, "opacity": 0.25},
            "z": 4,
        },
        _line(TRAIL, np.array(drive.trail) if is_placed else [], GREEN, 2, "solid", 3),
        _line(PLAN, place[path], ORANGE, 4, "solid", 5),
        _mark(GOAL, goal, 26, "transparent", RED, 4, "goal", goal_side, 12),
        _mark(BELIEVED, here, 15, BLUE, "#ffffff", 2, "thinks it is here", here_side, 13),
        _mark(
            TRUE,
            [drive.truth] if is_placed else [],
            22,
            GREEN,
            INK,
            2,
            "robot",
            "right",
            11,
        ),
    ]


def _is_placed(drive: Drive) -> bool:
    return drive.is_true_place and drive.truth is not None


def _known(drive: Drive) -> Any:
    """The nodes that have a place."""
    return np.flatnonzero(np.isfinite(drive.place).all(1))


def chart_limits(drive: Drive) -> tuple[list[float], list[float]]:
    """The least and largest (x, y) that the chart shows."""
    points = drive.place[_known(drive)]
    if drive.world is scoring.MAZE and drive.is_true_place:
        points = scoring.maze_layout(drive.env).solid_walls.reshape(-1, 2)
    low, high = points.min(0), points.max(0)
    margin = MARGIN * np.maximum(high - low, 1e-6)
    return (low - margin).tolist(), (high + margin).tolist()


def _aspect(drive: Drive) -> float:
    """Width over height of the chart, such that a maze is not bent."""
    if drive.world is not scoring.MAZE:
        return 1.4
    low, high = chart_limits(drive)
    ratio = np.clip((high[0] - low[0]) / (high[1] - low[1]), 0.6, 2.2)
    width = USUAL_WIDTH - INSET["left"] - INSET["right"]
    return float(USUAL_WIDTH / (width / ratio + INSET["top"] + INSET["bottom"]))


def _lines(name: str, segments: Any, colour: str, width: int, z: int) -> dict[str, Any]:
    return {
        "name": name,
        "id": name,
        "type": "lines",
        "coordinateSystem": "cartesian2d",
        "silent": True,
        "data": [{"coords": segment} for segment in segments.round(3).tolist()],
        "lineStyle": {"color": colour, "width": width, "opacity": 1},
        "z": z,
    }


def _line(name: str, points: Any, colour: str, width: int, kind: str, z: int) -> dict[str, Any]:
    return {
        "name": name,
        "id": name,
        "type": "line",
        "silent": True,
        "showSymbol": False,
        "data": [_pair(point) for point in points if np.isfinite(point).all()],
        "lineStyle": {"color": colour, "width": width, "type": kind},
        "itemStyle": {"color": colour},
        "z": z,
    }


def _mark(
    name: str,
    points: Any,
    size: int,
    colour: str,
    border: str,
    width: int,
    label: str,
    side: str,
    z: int,
) -> dict[str, Any]:
    return {
        "name": name,
        "id": name,
        "type": "scatter",
        "silent": True,
        "data": [_pair(point) for point in points if np.isfinite(point).all()],
        "symbolSize": size,
        "itemStyle": {"color": colour, "borderColor": border, "borderWidth": width},
        "label": {
            "show": True,
            "formatter": label,
            "position": side,
            "distance": 18 - size // 2,  # beyond the largest mark, which may be around this one
            "fontSize": 13,
            "fontWeight": "bold",
            "color": border if colour == "transparent" else colour,
            "textBorderColor": "#ffffff",
            "textBorderWidth": 3,
        },
        "z": z,
    }


def _pair(point: Any) -> list[float]:
    return [round(float(value), 3) for value in point]


def _picture(drive: Drive) -> str:
    """What the environment draws of itself, as a data URI."""
    buffer = io.BytesIO()
    Image.fromarray(np.asarray(drive.env.render())).save(buffer, "JPEG")
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode()}"


if __name__ in {"__main__", "__mp_main__"}:
    cli.run(main, Config, __doc__)
