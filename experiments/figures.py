"""Pictures and animations of what was learned, drawn from arrays alone.

A world is the maze or the pendulum's plane, and every function takes it the same way:

    walls    (W, 4) x0, y0, x1, y1 [mm], `Layout.solid_walls`; None where there are none
    labels   names of the two axes, MAZE_LABELS or PENDULUM_LABELS
    period   period of the first axis, 2 pi for an angle [rad]; None if it does not wrap

Figure numbers are the paper's. Colours are Okabe and Ito's, told apart by colour-blind readers.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import cKDTree

from sims.layouts import ROBOT_RADIUS

Array = NDArray[np.float64]

MAZE_LABELS = ("x [mm]", "y [mm]")
PENDULUM_LABELS = ("angle [rad]", "velocity [rad/s]")

BLUE, SKY, GREEN, ORANGE, RED = "#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00"
PURPLE, INK, GREY, PALE = "#CC79A7", "#333333", "#9A9A9A", "#D0D0D0"

DPI = 130
WIDTH = 7.0  # inches
WORMHOLE_SPREAD = 60.0  # mm; a node that is active in places so far apart mixes two of them

GIF_WIDTH = 640  # pixels
GIF_FRAMES = 200  # at most
GIF_COLOURS = 64
OVERSAMPLING = 2  # pictures are painted larger and shrunk, which smooths their edges
TAIL = 60  # steps of the trajectory that an animation shows


class Attractor(NamedTuple):
    """What one node's controllers make the robot do around that node."""

    node_position: Array
    """(2,) mean true position of the node [mm]."""
    positions: Array
    """(M, 2) where the robot was put [mm]."""
    arrows: Array
    """(M, 2) how it moved from there in one step [mm]."""


class Frame(NamedTuple):
    """One control step of an execution."""

    position: Array
    """(2,) true position [mm]."""
    node: int
    """The node that the robot believes to be in."""
    planned: Sequence[int]
    """Nodes of the path that is being followed; may be empty."""
    goal: int
    """The node to reach."""


def draw_trajectory(
    path: Path,
    positions: Array,
    walls: Array | None,
    *,
    labels: tuple[str, str] = MAZE_LABELS,
    period: float | None = None,
) -> None:
    """Draw the way through the world, positions (T + 1, 2) (figure 5)."""
    figure, axes = _world(walls, labels, period)
    _draw_lines(axes, _pieces(positions, period), BLUE, 0.7, f"{len(positions) - 1} steps")
    for point, colour, label in ((positions[0], ORANGE, "start"), (positions[-1], RED, "end")):
        axes.plot(*point, "o", color=colour, mec="white", ms=8, label=label, zorder=5)
    _finish(figure, path)


def draw_observations(path: Path, observations: Array, num_steps: int = 1000) -> None:
    """Draw the first readings (T, D) over time: an image, or a line if D is 1 (figure 6)."""
    shown = np.asarray(observations, np.float64)[:num_steps]
    figure = Figure(figsize=(WIDTH, 2.6), layout="constrained")
    axes = figure.add_subplot(xlabel="step")
    if shown.shape[1] == 1:
        steps = np.column_stack([np.arange(len(shown)), shown[:, 0]])
        jumps = np.flatnonzero(np.abs(np.diff(shown[:, 0])) > 0.5) + 1  # an angle that wraps
        _draw_lines(axes, np.split(steps, jumps), BLUE, 1.2)
        axes.set(ylabel="reading", ylim=(-0.02, 1.02), xlim=(0, max(1, len(shown) - 1)))
        axes.spines[["top", "right"]].set_visible(False)
    else:
        image = axes.imshow(
            shown.T, aspect="auto", vmin=0, vmax=1, cmap="cividis", interpolation="nearest"
        )
        axes.set(ylabel="sensor")
        figure.colorbar(image, label="reading", pad=0.01)
    _finish(figure, path)


def draw_map(
    path: Path,
    node_position: Array,
    edges: NDArray[np.int64],
    walls: Array | None,
    spread: Array | None = None,
    log: Array | None = None,
    *,
    labels: tuple[str, str] = MAZE_LABELS,
    period: float | None = None,
) -> None:
    """Draw the nodes where they are active, and their transitions (figures 7 and 10b).

    Args:
        path: file to write.
        node_position: (N, 2) mean true position of each node; NaN for a node to leave out.
        edges: (E, 2) pairs of nodes; those that wrap are left out.
        walls: see the module.
        spread: (N,) standard deviation of the true position [mm]; wide nodes are drawn red.
        log: (L, 2) true positions, a faint background.
        labels: see the module.
        period: see the module.
    """
    figure, axes = _world(walls, labels, period)
    if log is not None:
        axes.plot(*log.T, "o", color=SKY, alpha=0.5, ms=1.2, mew=0, zorder=0)
        axes.plot([], [], "o", color=SKY, alpha=0.5, ms=4, mew=0, label="log")
    lines = _edge_lines(node_position, edges, period)
    _draw_lines(axes, lines, GREY, 0.7, "transition", zorder=1)
    known = np.isfinite(node_position).all(1)
    is_wide = np.zeros_like(known) if spread is None else known & (spread > WORMHOLE_SPREAD)
    normal = known & ~is_wide
    groups = [(normal, BLUE, f"{normal.sum()} nodes")]
    if is_wide.any():
        wide_label = f"{is_wide.sum()} spread over more than {WORMHOLE_SPREAD:g} mm"
        groups.append((is_wide, RED, wide_label))
    for members, colour, label in groups:
        axes.plot(
            *node_position[members].T, "o", color=colour, mec="white", mew=0.4, ms=4, label=label
        )
    _finish(figure, path)


def draw_attractors(path: Path, panels: Sequence[Attractor], walls: Array | None) -> None:
    """Draw where the controllers of one to four nodes drive the robot (figure 8)."""
    if not 1 <= len(panels) <= 4:
        raise ValueError(f"{len(panels)} attractors were given; a figure has room for 1 to 4.")
    rows = [panels[i : i + 2] for i in range(0, len(panels), 2)]
    heights = [_height(walls, WIDTH), *([WIDTH / 2] * len(rows))]
    figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
    parts = figure.subfigures(1 + len(rows), 1, squeeze=False, height_ratios=heights)[:, 0]
    overview = parts[0].add_subplot()
    _draw_world(overview, walls, MAZE_LABELS, None)
    letters = iter("abcd")
    for part, row in zip(parts[1:], rows, strict=True):
        for axes, panel in zip(part.subplots(1, len(row), squeeze=False)[0], row, strict=True):
            letter = next(letters)
            _draw_attractor(axes, panel, walls, letter)
            _mark_panel(overview, axes, letter)
    figure.savefig(path, dpi=DPI)


def draw_execution(
    path: Path,
    node_position: Array,
    *,
    planned: Sequence[int],
    recognized: NDArray[np.int64] | Sequence[int],
    positions: Array,
    goal: int,
    walls: Array | None,
    labels: tuple[str, str] = MAZE_LABELS,
    period: float | None = None,
) -> None:
    """Draw a plan and what came of it (figures 9 and 11).

    Args:
        path: file to write.
        node_position: (N, 2) mean true position of each node.
        planned: nodes of the planned path.
        recognized: (T,) nodes that the agent believed to be in.
        positions: (T, 2) true trajectory.
        goal: the node to reach.
        walls: see the module.
        labels: see the module.
        period: see the module.
    """
    figure, axes = _world(walls, labels, period)
    axes.plot(*node_position.T, "o", color=PALE, ms=4, mew=0, zorder=1)
    _draw_lines(axes, _pieces(positions, period), GREEN, 2.2, "true trajectory", zorder=2)
    way = node_position[list(planned)].reshape(-1, 2)
    _draw_lines(axes, _pieces(way, period), ORANGE, 1.6, "planned path", zorder=3)
    axes.plot(*way.T, "o", mfc="white", mec=ORANGE, mew=1.4, ms=7, zorder=3)
    visited = node_position[np.unique(np.asarray(recognized, np.int64))]
    axes.plot(*visited.T, "o", color=BLUE, ms=4.5, mew=0, label="recognized node", zorder=4)
    axes.plot(*positions[0], "s", color=INK, mec="white", ms=7, label="start", zorder=5)
    end = node_position[goal]
    axes.plot(*end, "o", mfc="none", mec=RED, mew=2.2, ms=14, label="goal", zorder=5)
    _finish(figure, path)


def draw_calibration(path: Path, nominal: Array, held: dict[int, Array]) -> None:
    """Draw how many readings central forecast intervals hold, by steps ahead."""
    figure = Figure(figsize=(WIDTH / 2, WIDTH / 2), layout="constrained")
    axes = figure.add_subplot(
        xlabel="probability of the interval", ylabel="readings inside", aspect="equal"
    )
    axes.plot([0, 1], [0, 1], color=INK, lw=0.8, ls=":")
    for colour, (steps, share) in zip((BLUE, RED, GREEN, PURPLE), held.items(), strict=False):
        axes.plot(nominal, share, color=colour, label=f"{steps} step{'s' * (steps > 1)} ahead")
    axes.spines[["top", "right"]].set_visible(False)
    _finish(figure, path)


def draw_success_curve(
    path: Path,
    curves: dict[str, tuple[Array, Array, Array, Array]],
    xlabel: str,
    ylabel: str,
) -> None:
    """Draw lines with bands; each curve is x, mean, low, high, all (P,)."""
    figure = Figure(figsize=(WIDTH, 4.0), layout="constrained")
    axes = figure.add_subplot(xlabel=xlabel, ylabel=ylabel)
    colours, markers = (BLUE, RED, GREEN, PURPLE, ORANGE, SKY, INK), "osD^vPX*"
    for index, (label, (x, mean, low, high)) in enumerate(curves.items()):
        colour, marker = colours[index % 7], markers[index % 8]  # no two pairs alike
        axes.fill_between(x, low, high, color=colour, alpha=0.18, lw=0)
        axes.plot(
            x,
            mean,
            color=colour,
            marker=marker if len(x) <= 30 else None,
            ms=5,
            mec="white",
            label=label,
        )
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color=PALE, lw=0.5)
    _finish(figure, path)


def write_execution_gif(
    path: Path,
    node_position: Array,
    frames: Sequence[Frame],
    walls: Array | None,
    *,
    frame_ms: int = 60,
) -> None:
    """Animate the robot on its way through the maze.

    Args:
        path: file to write.
        node_position: (N, 2) mean true position of each node [mm].
        frames: one a control step; of more than GIF_FRAMES every n-th is shown, and the last.
        walls: see the module.
        frame_ms: how long each picture stands [ms].
    """
    shown = _thinned(len(frames))
    figure = Figure(figsize=(GIF_WIDTH / 100, _height(walls, GIF_WIDTH / 100) + 0.2))
    axes = figure.add_axes((0.01, 0.08, 0.98, 0.91))
    _draw_world(axes, walls, ("", ""), None)
    axes.set_axis_off()
    axes.plot(*node_position.T, "o", color=PALE, ms=3.5, mew=0, zorder=1)
    canvas, positions = _Canvas(figure, axes), np.array([frame.position for frame in frames])
    pictures = []
    for step in shown:
        frame = Frame(*frames[step])
        canvas.clear()
        canvas.lines([positions[max(0, step - TAIL) : step + 1]], GREEN, 2)
        canvas.lines([node_position[list(frame.planned)].reshape(-1, 2)], ORANGE, 2)
        canvas.disc(frame.position, canvas.pixels_per_unit * ROBOT_RADIUS, SKY, INK)
        canvas.disc(node_position[frame.node], 5, BLUE, "#FFFFFF")
        canvas.disc(node_position[frame.goal], 9, None, RED, 3)
        canvas.text(f"step {step}    node {frame.node}    goal {frame.goal}")
        pictures.append(canvas.picture())
    _write_gif(path, pictures, frame_ms)


def write_pendulum_gif(
    path: Path,
    states: Array,
    node_position: Array,
    planned: Sequence[int],
    *,
    frame_ms: int = 60,
) -> None:
    """Animate the pendulum beside its way through the plane of angle and velocity.

    Args:
        path: file to write.
        states: (T, 2) angle from hanging [rad] and velocity [rad/s], one row a control step; of
            more than GIF_FRAMES every n-th is shown, and the last.
        node_position: (N, 2) mean true state of each node.
        planned: nodes of the planned path, the goal last.
        frame_ms: how long each picture stands [ms].
    """
    shown = _thinned(len(states))
    canvas = _pendulum_canvas(node_position, states)
    way = node_position[list(planned)].reshape(-1, 2)
    pictures = []
    for step in shown:
        canvas.clear()
        canvas.rod(states[step, 0])
        canvas.lines(_pieces(way, 2 * math.pi), ORANGE, 2)
        canvas.lines(_pieces(states[max(0, step - TAIL) : step + 1], 2 * math.pi), GREEN, 2)
        canvas.disc(states[step], 6, GREEN, "#FFFFFF")
        if len(way):
            canvas.disc(way[-1], 9, None, RED, 3)
        canvas.text(f"step {step}    angle {states[step, 0]:+.2f} rad")
        pictures.append(canvas.picture())
    _write_gif(path, pictures, frame_ms)


def write_film(
    path: Path, frames: Sequence[NDArray[np.uint8]], *, frame_ms: int = 60, width: int = 320
) -> None:
    """Animate pictures (height, width, 3) uint8 that an environment rendered.

    Args:
        path: file to write.
        frames: one a control step; of more than GIF_FRAMES every n-th is shown, and the last.
        frame_ms: how long each picture stands [ms].
        width: pixels of the animation.
    """
    shown = [Image.fromarray(frames[step]) for step in _thinned(len(frames))]
    size = (width, round(width * shown[0].height / shown[0].width))
    _write_gif(path, [picture.resize(size) for picture in shown], frame_ms)


class _Canvas:
    """A finished drawing to paint on, in the coordinates of one of its axes; sizes in pixels."""

    def __init__(self, figure: Figure, axes: Axes) -> None:
        figure.set_dpi(100 * OVERSAMPLING)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        self._background = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
        self._to_pixels = axes.transData
        self._font = ImageFont.load_default(15 * OVERSAMPLING)
        unit = self._to_pixels.transform([(0.0, 0.0), (1.0, 0.0)])
        self.pixels_per_unit = float(unit[1, 0] - unit[0, 0]) / OVERSAMPLING
        self.clear()

    def clear(self) -> None:
        """Go back to the drawing."""
        self._image = self._background.copy()
        self._draw = ImageDraw.Draw(self._image)

    def lines(self, pieces: list[Array], colour: str, width: int) -> None:
        for piece in pieces:
            known = piece[np.isfinite(piece).all(1)]
            if len(known) > 1:
                points = [tuple(point) for point in self._pixels(known).tolist()]
                self._draw.line(points, colour, width * OVERSAMPLING, joint="curve")

    def disc(
        self, centre: Array, radius: float, fill: str | None, outline: str, width: int = 1
    ) -> None:
        x, y = self._pixels(np.asarray(centre)[None])[0].tolist()
        if math.isfinite(x + y):
            self._disc_at(x, y, radius, fill, outline, width)

    def rod(self, angle: float) -> None:
        """Draw a pendulum in the left 40 % of the picture, hanging at angle 0 [rad]."""
        size = self._image.width * 0.4
        x, y, length = size / 2, self._image.height * 0.45, size * 0.42
        end = (x + length * math.sin(angle), y + length * math.cos(angle))
        self._draw.line([(x, y), end], INK, 5 * OVERSAMPLING)
        self._disc_at(x, y, 5, INK, INK)
        self._disc_at(*end, 14, BLUE, "#FFFFFF")

    def text(self, line: str) -> None:
        """Write one line at the lower left."""
        position = (10 * OVERSAMPLING, self._image.height - 8 * OVERSAMPLING)
        self._draw.text(position, line, INK, self._font, anchor="ls")

    def picture(self) -> Image.Image:
        return self._image.reduce(OVERSAMPLING)

    def _disc_at(
        self, x: float, y: float, radius: float, fill: str | None, outline: str, width: int = 1
    ) -> None:
        r = radius * OVERSAMPLING
        self._draw.ellipse([x - r, y - r, x + r, y + r], fill, outline, width * OVERSAMPLING)

    def _pixels(self, points: Array) -> Array:
        pixels = self._to_pixels.transform(points)
        return np.column_stack([pixels[:, 0], self._background.height - pixels[:, 1]])


def _pendulum_canvas(node_position: Array, states: Array) -> _Canvas:
    figure = Figure(figsize=(GIF_WIDTH / 100, 3.4))
    axes = figure.add_axes((0.50, 0.16, 0.48, 0.81))
    _draw_world(axes, None, PENDULUM_LABELS, 2 * math.pi)
    axes.plot(*node_position.T, "o", color=PALE, ms=4, mew=0)
    limit = 1.05 * max(np.nanmax(np.abs(node_position[:, 1])), np.abs(states[:, 1]).max())
    axes.set_ylim(-limit, limit)
    return _Canvas(figure, axes)


def _thinned(num_frames: int) -> list[int]:
    if num_frames == 0:
        raise ValueError("no frames were given; give at least one control step.")
    stride = math.ceil(num_frames / (GIF_FRAMES - 1))
    return sorted({*range(0, num_frames, stride), num_frames - 1})


def _write_gif(path: Path, pictures: list[Image.Image], frame_ms: int) -> None:
    """Write the pictures with one palette, so that only what moves is stored again."""
    sample = pictures[:: max(1, len(pictures) // 4)]
    montage = Image.fromarray(np.concatenate([np.asarray(picture) for picture in sample]))
    palette = montage.quantize(GIF_COLOURS, Image.Quantize.FASTOCTREE)
    first, *rest = [
        picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures
    ]
    first.save(
        path, "GIF", save_all=True, append_images=rest, duration=frame_ms, loop=0, optimize=True
    )


def _world(
    walls: Array | None, labels: tuple[str, str], period: float | None
) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDTH, _height(walls, WIDTH) + 0.6), layout="constrained")
    axes = figure.add_subplot()
    _draw_world(axes, walls, labels, period)
    return figure, axes


def _draw_world(
    axes: Axes, walls: Array | None, labels: tuple[str, str], period: float | None
) -> None:
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.margins(0.04 if walls is None else 0.015)
    if walls is None:
        axes.spines[["top", "right"]].set_visible(False)
    else:
        segments = np.asarray(walls, np.float64).reshape(-1, 2, 2)
        axes.add_collection(
            LineCollection(list(segments), colors=INK, linewidths=2, capstyle="projecting")
        )
        axes.set_aspect("equal")
        axes.spines[:].set_visible(False)
        axes.autoscale_view()
    if period is not None:
        axes.set_xlim(-period / 2, period / 2)
        axes.set_xticks(np.linspace(-period / 2, period / 2, 5))
        if math.isclose(period, 2 * math.pi):
            axes.set_xticklabels(["−π", "−π/2", "0", "π/2", "π"])  # noqa: RUF001


def _height(walls: Array | None, width: float) -> float:
    """Return the height that suits a picture of the world of that width."""
    if walls is None or not len(walls):
        return 0.7 * width
    corners = np.asarray(walls, np.float64).reshape(-1, 2)
    size = corners.max(0) - corners.min(0)
    return width * float(np.clip(size[1] / max(size[0], 1e-9), 0.2, 2.0))


def _draw_attractor(axes: Axes, panel: Attractor, walls: Array | None, letter: str) -> None:
    _draw_world(axes, walls, MAZE_LABELS, None)
    spacing = float(np.median(cKDTree(panel.positions).query(panel.positions, k=2)[0][:, 1]))
    longest = max(float(np.hypot(*panel.arrows.T).max()), 1e-9)
    axes.plot(*panel.positions.T, "o", color=SKY, ms=3, mew=0)
    shrinkage = max(1.0, longest / spacing)  # true length, unless arrows would overlap
    axes.quiver(
        *panel.positions.T,
        *panel.arrows.T,
        angles="xy",
        scale_units="xy",
        scale=shrinkage,
        color=BLUE,
        units="inches",
        width=0.016,
    )
    axes.plot(*panel.node_position, "o", mfc="none", mec=RED, mew=2.2, ms=14)
    half = float(np.abs(panel.positions - panel.node_position).max()) + spacing
    (left, bottom), (right, top) = panel.node_position - half, panel.node_position + half
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.spines[:].set(visible=True, color=RED)
    note = "" if shrinkage == 1 else f"   arrows {1 / shrinkage:.2f} of the motion"
    axes.set_title(letter + note, loc="left", fontsize=10)


def _mark_panel(overview: Axes, axes: Axes, letter: str) -> None:
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    frame = Rectangle((left, bottom), right - left, top - bottom, fc="none", ec=RED, lw=1.5)
    overview.add_patch(frame)
    overview.autoscale_view()
    overview.text(
        (left + right) / 2, (bottom + top) / 2, letter, ha="center", va="center", fontweight="bold"
    )


def _draw_lines(
    axes: Axes,
    lines: Sequence[Array] | Array,
    colour: str,
    width: float,
    label: str | None = None,
    zorder: float = 2,
) -> None:
    collection = LineCollection(list(lines), colors=colour, linewidths=width, label=label)
    collection.set_zorder(zorder)
    axes.add_collection(collection)
    axes.autoscale_view()


def _edge_lines(node_position: Array, edges: NDArray[np.int64], period: float | None) -> Array:
    """Return (L, 2, 2) ends of the edges, each pair of nodes once and no node with itself."""
    pairs = np.unique(np.sort(np.asarray(edges, np.int64).reshape(-1, 2), 1), axis=0)
    lines = node_position[pairs[pairs[:, 0] != pairs[:, 1]]]
    drawn = np.isfinite(lines).all((1, 2))
    if period is not None:
        drawn &= np.abs(lines[:, 1, 0] - lines[:, 0, 0]) <= period / 2
    return lines[drawn]


def _pieces(points: Array, period: float | None) -> list[Array]:
    """Cut a line (T, 2) where its first coordinate wraps."""
    if period is None:
        return [points]
    return np.split(points, np.flatnonzero(np.abs(np.diff(points[:, 0])) > period / 2) + 1)


def _columns(labels: list[str], inches: float) -> int:
    """Columns of a legend that is no wider than its figure."""
    widest = 0.6 + 0.075 * max(map(len, labels))  # a handle, and a letter of 9 points each
    return max(1, min(5, len(labels), int(inches / widest)))


def _finish(figure: Figure, path: Path) -> None:
    """Put the legend below the axes and write the file."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    if handles:
        figure.legend(
            handles,
            labels,
            loc="outside lower center",
            ncols=_columns(labels, figure.get_figwidth()),
            frameon=False,
            fontsize=9,
        )
    figure.savefig(path, dpi=DPI)
