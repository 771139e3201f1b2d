"""Every function of `experiments.figures` writes a readable picture that is not blank."""

import math

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("matplotlib")

from experiments import figures
from sims.layouts import ROBOT_RADIUS, load_layout

WALLS = load_layout("paper").solid_walls
NODES = np.array([[300.0, 500.0], [350.0, 450.0], [450.0, 420.0], [np.nan, np.nan], [500.0, 300.0]])
EDGES = np.array([[0, 1], [1, 0], [1, 2], [2, 4], [2, 2], [2, 3]])
STATES = np.stack([np.linspace(2.5, 3.8, 12), np.linspace(1.0, 3.0, 12)], -1)
STATES[:, 0] = (STATES[:, 0] + math.pi) % (2 * math.pi) - math.pi  # wraps half way
PLANE = {"labels": figures.PENDULUM_LABELS, "period": 2 * math.pi}


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def pixels(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def assert_is_picture(path, width=910):
    shown = pixels(path)
    assert shown.shape[1] == width
    assert 200 < shown.shape[0] < 2000
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 20
    assert (shown > 250).all(-1).mean() > 0.05


def hex_colour(colour):
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])


def has_colour(path, colour):
    return bool((np.abs(pixels(path) - hex_colour(colour)).max(-1) <= 2).any())


def test_trajectories_in_both_worlds(tmp_path, rng):
    positions = 300 + rng.normal(size=(50, 2)).cumsum(0)
    figures.draw_trajectory(tmp_path / "maze.png", positions, WALLS)
    figures.draw_trajectory(tmp_path / "pendulum.png", STATES, None, **PLANE)
    assert_is_picture(tmp_path / "maze.png")
    assert_is_picture(tmp_path / "pendulum.png")


@pytest.mark.parametrize("obs_dim", [1, 24])
def test_observations(tmp_path, rng, obs_dim):
    observations = rng.random((40, obs_dim)).astype(np.float32)
    figures.draw_observations(tmp_path / "seen.png", observations, num_steps=30)
    assert_is_picture(tmp_path / "seen.png")


def test_map_colours_only_wide_nodes_red(tmp_path, rng):
    spread, log = np.array([10.0, 61.0, 20.0, np.nan, 5.0]), rng.uniform(100, 500, (30, 2))
    figures.draw_map(tmp_path / "wide.png", NODES, EDGES, WALLS, spread, log)
    figures.draw_map(tmp_path / "plain.png", NODES, EDGES, WALLS)
    for name, is_red in (("wide.png", True), ("plain.png", False)):
        assert_is_picture(tmp_path / name)
        assert has_colour(tmp_path / name, figures.RED) is is_red


def test_map_of_a_plane_leaves_out_edges_that_wrap(tmp_path):
    node_position = np.array([[-3.0, 1.0], [3.0, 1.2], [2.0, 0.0]])
    edges = np.array([[0, 1], [1, 2]])
    figures.draw_map(tmp_path / "map.png", node_position, edges, None, **PLANE)
    assert_is_picture(tmp_path / "map.png")
    lines = figures._edge_lines(node_position, edges, 2 * math.pi)
    np.testing.assert_array_equal(lines, node_position[[[1, 2]]])


def test_edges_are_drawn_once_and_only_between_known_nodes():
    lines = figures._edge_lines(NODES, EDGES, None)
    np.testing.assert_array_equal(lines, NODES[[[0, 1], [1, 2], [2, 4]]])


@pytest.mark.parametrize("num_panels", [1, 2, 4])
def test_attractors(tmp_path, num_panels):
    offsets = np.stack(np.meshgrid([-20.0, 0.0, 20.0], [-20.0, 0.0, 20.0]), -1).reshape(-1, 2)
    panels = [
        figures.Attractor(place, place + offsets, -0.4 * offsets)
        for place in NODES[[0, 1, 2, 4]][:num_panels]
    ]
    figures.draw_attractors(tmp_path / "attractors.png", panels, WALLS)
    assert_is_picture(tmp_path / "attractors.png")


def test_attractors_need_one_to_four_panels(tmp_path):
    with pytest.raises(ValueError, match="0 attractors were given"):
        figures.draw_attractors(tmp_path / "attractors.png", [], WALLS)


def test_executions_in_both_worlds(tmp_path):
    figures.draw_execution(
        tmp_path / "maze.png",
        NODES,
        planned=[0, 1, 2, 4],
        recognized=np.array([0, 0, 1]),
        positions=NODES[:3] + 4,
        goal=4,
        walls=WALLS,
    )
    figures.draw_execution(
        tmp_path / "pendulum.png",
        STATES,
        planned=list(range(12)),
        recognized=[0, 1],
        positions=STATES,
        goal=11,
        walls=None,
        **PLANE,
    )
    for name in ("maze.png", "pendulum.png"):
        assert_is_picture(tmp_path / name)
        assert has_colour(tmp_path / name, figures.ORANGE)


def test_success_curves(tmp_path):
    x = np.array([1000.0, 2000.0, 5000.0])
    mean = np.array([0.5, 0.7, 0.9])
    curves = {"ours": (x, mean, mean - 0.1, mean + 0.1), "theirs": (x, mean / 2, mean / 3, mean)}
    figures.draw_success_curve(tmp_path / "curve.png", curves, "steps", "success rate")
    assert_is_picture(tmp_path / "curve.png")


@pytest.mark.parametrize("num_frames", [1, 450])
def test_maze_animation_is_thinned_and_timed(tmp_path, num_frames):
    x = np.linspace(300, 350, num_frames)
    frames = [figures.Frame(np.array([place, 500.0]), 0, [0, 1, 3, 2], 2) for place in x]
    path = tmp_path / "execution.gif"
    figures.write_execution_gif(path, NODES, frames, WALLS, frame_ms=70)
    assert_is_picture(path, figures.GIF_WIDTH)
    with Image.open(path) as image:
        assert image.n_frames <= figures.GIF_FRAMES
        assert image.n_frames == 1 or image.info["duration"] == 70
    assert path.stat().st_size < 3_000_000


def test_robot_is_drawn_to_scale(tmp_path):
    path = tmp_path / "execution.gif"
    frame = figures.Frame(np.array([320.0, 500.0]), 4, [], 4)
    figures.write_execution_gif(path, NODES, [frame], WALLS)
    shown = pixels(path).astype(int)
    is_sky = np.abs(shown - hex_colour(figures.SKY)).max(-1) <= 12
    is_wall = (shown < 90).all(-1)[: -len(shown) // 5]  # without the status line
    room = np.ptp(np.flatnonzero(is_wall.any(0))) / 1004  # pixels per mm
    width = np.ptp(np.flatnonzero(is_sky.any(0))) / room
    assert width == pytest.approx(2 * ROBOT_RADIUS, abs=8)  # the outline takes two pixels


def test_pendulum_animation(tmp_path):
    path = tmp_path / "pendulum.gif"
    figures.write_pendulum_gif(path, STATES, STATES + 0.1, [0, 5, 11], frame_ms=50)
    assert_is_picture(path, figures.GIF_WIDTH)
    with Image.open(path) as image:
        assert image.n_frames == len(STATES)
        assert image.info["duration"] == 50


def test_an_animation_needs_a_frame(tmp_path):
    with pytest.raises(ValueError, match="no frames were given"):
        figures.write_execution_gif(tmp_path / "a.gif", NODES, [], WALLS)
