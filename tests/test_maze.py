"""`sims.maze` and `sims.layouts` against an analytic ray caster and plane geometry."""

import itertools
import json
import math
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from reference_physics import cast_rays

import sims
from sims.layouts import ROBOT_RADIUS, WALL_THICKNESS, built_in_layouts, load_layout
from sims.maze import RangefinderMazeEnv

gym.register_envs(sims)

RAY_ANGLES = np.deg2rad(15.0 * np.arange(24))
EXACT = 1e-6  # mm
PLAN = {"size": [400, 300], "walls": [[200, 0, 200, 150]], "start": [100, 100]}


@pytest.fixture
def make():
    """Make environments that are closed after the test."""
    envs = []

    def make(**options):
        envs.append(gym.make("rfl/RangefinderMaze-v0", **options))
        return envs[-1]

    yield make
    for env in envs:
        env.close()


@pytest.fixture
def write(tmp_path):
    """Write a plan, or raw text or bytes, as a layout file and return its path."""

    def write(plan, name="plan.json"):
        content = plan if isinstance(plan, str | bytes) else json.dumps(plan)
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


def positions_along(env, actions):
    return np.array([env.step(action)[4]["ground_truth"] for action in actions])


def corner_pushes(rng, num_steps):
    """Full-speed pushes held for long: the robot ends in corners, at tips and between walls."""
    directions = rng.choice([-1.0, -0.6, 0.0, 0.3, 1.0], (num_steps // 40 + 1, 2))
    return np.repeat(directions, 40, axis=0)[:num_steps].astype(np.float32)


# The environment


def test_maze_passes_gymnasiums_checker(make):
    check_env(make(render_mode="rgb_array").unwrapped)


def test_spaces_and_info_are_as_documented(make):
    env = make()
    assert env.observation_space == gym.spaces.Box(0.0, 1.0, (24,), np.float32)
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    observation, info = env.reset(seed=0)
    assert observation.dtype == np.float32
    assert info["ground_truth"].dtype == np.float64
    np.testing.assert_array_equal(info["ground_truth"], env.unwrapped.layout.start)
    observation, reward, terminated, truncated, info = env.step(np.array([1, 0], np.float32))
    assert observation.shape == (24,)
    assert (reward, terminated, truncated) == (0.0, False, False)
    assert info["ground_truth"].shape == (2,)


def test_episodes_do_not_end(make):
    env = make(layout="loop")
    env.reset(seed=0)
    action = np.zeros(2, np.float32)
    assert not any(any(env.step(action)[2:4]) for _ in range(2500))


def test_sims_needs_neither_torch_nor_the_library():
    code = "import sims, sims.maze, sims.pendulum, sys; print('torch' in sys.modules)"
    code += "; print('rfl_torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]


def test_same_seed_same_run(make):
    def run(seed):
        env = make(layout="twins", sensor_noise=0.05, motion_noise=0.1)
        first, _ = env.reset(seed=seed)
        actions = np.random.default_rng(0).uniform(-1, 1, (200, 2))
        return np.array([first] + [env.step(action)[0] for action in actions])

    np.testing.assert_array_equal(run(3), run(3))
    assert not np.array_equal(run(3), run(4))


def test_close_may_be_called_twice():
    env = RangefinderMazeEnv()
    env.close()
    env.close()


def test_two_mazes_do_not_disturb_each_other(make):
    one, other = make(layout="paper"), make(layout="hall")
    alone, _ = one.reset(seed=0)
    other.reset(seed=0)
    positions_along(other, np.ones((30, 2)))
    np.testing.assert_array_equal(one.step(np.zeros(2))[0], alone)


# Rays


@pytest.mark.parametrize("layout", ["paper", "hall", "slanted"])
def test_rays_agree_with_an_analytic_caster(make, write, layout):
    if layout == "slanted":
        walls = [
            [150, 100, 400, 190],
            [400, 190, 380, 480],
            [500, 600, 700, 90],
            [880, 77, 930, 99],
        ]
        layout = write({"size": [1000, 600], "walls": walls, "start": None})
    env, rng = make(layout=layout), np.random.default_rng(0)
    plan, errors = env.unwrapped.layout, []
    for _ in range(500):
        position = plan.random_free_position(rng)
        observation, _ = env.reset(options={"position": position})
        reach = cast_rays(
            position, plan.solid_walls, RAY_ANGLES, thickness=WALL_THICKNESS, reach=527.5
        )
        errors.append(np.abs(observation * 500.0 - (reach - ROBOT_RADIUS)))
    errors = np.array(errors)
    # Bullet errs by more than a millimetre on a few rays in 100 000, so no maximum is asserted.
    assert np.quantile(errors, 0.998) < 1e-4  # mm; float32 keeps 500 mm to 3e-5 mm
    assert (errors > 1.0).mean() < 1e-3


def test_ray_0_looks_along_x_and_ray_6_along_y(make, write):
    env = make(layout=write({"size": [400, 300], "walls": [], "start": None}))
    observation, _ = env.reset(options={"position": (150.0, 100.0)})
    expected = np.array([250.0, 200.0, 150.0, 100.0]) - ROBOT_RADIUS
    np.testing.assert_allclose(observation[[0, 6, 12, 18]] * 500, expected, atol=1e-4)


def test_readings_beyond_the_range_are_one(make, write):
    env = make(layout=write({"size": [3000, 3000], "walls": [], "start": [1500, 1500]}))
    np.testing.assert_array_equal(env.reset()[0], np.ones(24, np.float32))


# Motion


def test_free_motion_is_exactly_the_command(make):
    env = make()
    here = env.reset(options={"position": (630.0, 500.0)})[1]["ground_truth"]
    for action in np.random.default_rng(0).uniform(-1, 1, (30, 2)).astype(np.float32):
        *_, info = env.step(action)
        assert not info["bumped"]
        expected = here + 10.0 * action.astype(np.float64)
        np.testing.assert_allclose(info["ground_truth"], expected, rtol=0, atol=EXACT)
        here = info["ground_truth"]


def test_actions_out_of_range_are_clipped(make):
    env = make()
    start = env.reset()[1]["ground_truth"]
    *_, info = env.step(np.array([7.0, -0.5]))
    np.testing.assert_allclose(info["ground_truth"] - start, [10.0, -5.0], rtol=0, atol=EXACT)


@pytest.mark.parametrize("layout", built_in_layouts())
def test_robot_is_never_inside_a_wall(make, layout):
    env, rng = make(layout=layout, motion_noise=0.2), np.random.default_rng(1)
    env.reset(seed=1)
    held = np.repeat(rng.uniform(-1, 1, (100, 2)), 15, axis=0)
    visited = positions_along(env, np.concatenate([held, corner_pushes(rng, 1500)]))
    assert env.unwrapped.layout.clearance(visited).min() >= ROBOT_RADIUS - EXACT
    assert np.ptp(visited, axis=0).min() > 100  # it did move about


def test_robot_is_never_inside_a_wall_of_sharp_corners(make, write):
    walls = [[200, 0, 260, 300], [320, 0, 260, 300], [420, 150, 580, 170], [420, 150, 580, 260]]
    env = make(
        layout=write({"size": [700, 500], "walls": walls, "start": [100, 400]}), motion_noise=0.9
    )
    plan, rng = env.unwrapped.layout, np.random.default_rng(2)
    for seed in range(40):
        env.reset(seed=seed, options={"position": plan.random_free_position(rng)})
        visited = positions_along(env, corner_pushes(rng, 120))
        assert plan.clearance(visited).min() >= ROBOT_RADIUS - EXACT
        steps = np.hypot(*np.diff(visited, axis=0).T)
        assert steps.max() < 40  # pushed out on the side that it came from


def test_robot_slides_along_a_wall(make):
    env = make()
    env.reset(options={"position": (300.0, 600 - ROBOT_RADIUS - 1)})
    *_, info = env.step(np.array([1.0, 1.0]))
    assert info["bumped"]
    expected = [310.0, 600 - ROBOT_RADIUS]
    np.testing.assert_allclose(info["ground_truth"], expected, rtol=0, atol=EXACT)
    *_, info = env.step(np.array([1.0, 1.0]))
    np.testing.assert_allclose(info["ground_truth"], [320.0, expected[1]], rtol=0, atol=EXACT)


def test_robot_slides_along_a_slanted_wall(make, write):
    env = make(layout=write({"size": [600, 600], "walls": [[100, 0, 600, 500]], "start": None}))
    normal, along = np.array([-1.0, 1.0]) / math.sqrt(2), np.array([1.0, 1.0]) / math.sqrt(2)
    touching = np.array([300.0, 200.0]) + normal * (ROBOT_RADIUS + WALL_THICKNESS / 2)
    env.reset(options={"position": touching})
    *_, info = env.step(np.array([1.0, 0.0]))
    expected = touching + along * (10.0 / math.sqrt(2))
    np.testing.assert_allclose(info["ground_truth"], expected, rtol=0, atol=EXACT)


def test_robot_stops_in_a_corner_and_comes_out_again(make):
    env = make()
    env.reset(options={"position": (60.0, 60.0)})
    *_, corner = positions_along(env, -np.ones((10, 2)))
    np.testing.assert_allclose(corner, [ROBOT_RADIUS, ROBOT_RADIUS], rtol=0, atol=EXACT)
    *_, info = env.step(np.array([0.5, 0.25]))
    assert not info["bumped"]
    np.testing.assert_allclose(info["ground_truth"] - corner, [5.0, 2.5], rtol=0, atol=EXACT)


# Noise


def test_sensor_noise_scales_each_reading(make):
    quiet, noisy = make().reset(seed=0)[0], make(sensor_noise=0.1)
    ratios = np.array([noisy.reset(seed=s)[0] / quiet for s in range(200)])[:, quiet < 0.8]
    assert ratios.max() <= 1.1 + 1e-5
    assert ratios.min() >= 0.9 - 1e-5
    np.testing.assert_allclose(ratios.mean(), 1.0, atol=0.005)
    np.testing.assert_allclose(ratios.std(), 0.1 / math.sqrt(3), rtol=0.05)


def test_motion_noise_scales_each_axis(make):
    env, moves = make(layout="hall", motion_noise=0.2), []
    for seed in range(300):
        start = env.reset(seed=seed)[1]["ground_truth"]
        moves.append(env.step(np.array([1.0, -0.5]))[4]["ground_truth"] - start)
    ratios = np.array(moves) / [10.0, -5.0]
    assert np.abs(ratios - 1).max() <= 0.2 + 1e-9
    np.testing.assert_allclose(ratios.std(0), 0.2 / math.sqrt(3), rtol=0.1)
    assert abs(np.corrcoef(ratios.T)[0, 1]) < 0.2


# Bad use


@pytest.mark.parametrize(
    "action", [[0.0], [0.0, 0.0, 0.0], 0.5, [math.nan, 0.0], [math.inf, 0.0], "up", None]
)
def test_bad_actions_are_refused(make, action):
    env = make().unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match="two finite numbers"):
        env.step(action)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"position": (250.0, 100.0)}, "is_free"),
        ({"position": (-50.0, 100.0)}, "is_free"),
        ({"position": (10.0, 300.0)}, "is_free"),
        ({"position": (math.nan, 300.0)}, "two finite numbers"),
        ({"position": (1.0, 2.0, 3.0)}, "two finite numbers"),
        ({"position": None}, "two finite numbers"),
        ({"position": "here"}, "two finite numbers"),
        ({"place": (300.0, 500.0)}, "unknown"),
    ],
)
def test_bad_reset_options_are_refused(make, options, message):
    with pytest.raises(ValueError, match=message):
        make().reset(options=options)


@pytest.mark.parametrize("noise", [-0.1, 1.5, math.nan])
@pytest.mark.parametrize("which", ["sensor_noise", "motion_noise"])
def test_bad_noise_is_refused(make, which, noise):
    with pytest.raises(ValueError, match=which):
        make(**{which: noise})


def test_picture_shows_the_robot_where_it_is(make):
    env = make(render_mode="rgb_array")
    env.reset(options={"position": (100.0, 500.0)})
    picture = env.render()
    assert picture.shape == (300, 500, 3)
    assert picture.dtype == np.uint8
    red, _, blue = picture[50, 50].astype(int)  # y points up: 500 mm is near the top
    assert red - blue > 100


# Layouts


@pytest.mark.parametrize("name", built_in_layouts())
def test_built_in_layouts_are_connected_and_passable(name):
    plan, rng = load_layout(name), np.random.default_rng(0)
    assert plan.name == name
    cells = plan.free_cells(40.0)
    free = [plan.is_free(cell) for cell in grid_centres(plan.size, 40.0)]
    assert len(cells) == sum(free) > 40  # each free cell can be reached
    places = [plan.random_free_position(rng) for _ in range(12)]
    assert all(math.isfinite(plan.shortest_path_length(places[0], place)) for place in places)


def test_the_documented_layouts_are_built_in():
    assert {"hall", "loop", "paper", "twins"} <= set(built_in_layouts())
    assert load_layout("paper").size == (1000.0, 600.0)
    assert load_layout("hall").size == (2000.0, 1200.0)


def grid_centres(size, cell):
    axes = [np.arange(cell / 2, length, cell) for length in size]
    return np.array(list(itertools.product(*axes)))


def test_rooms_of_twins_look_the_same(make):
    env = make(layout="twins")
    views = [env.reset(options={"position": (100.0 + 300 * k, 420.0)})[0] for k in range(4)]
    for view in views[1:]:
        # the walls between rooms are as thick as their half; the outer ones stand outside
        assert np.abs(view - views[0]).max() < 10 / 500


def test_clearance_is_the_distance_to_the_walls_face(write):
    plan = load_layout(write(PLAN))
    points = [(150.0, 100.0), (200.0, 200.0), (230.0, 192.0), (200.0, 100.0), (390.0, 200.0)]
    tip = math.hypot(230 - 202, 192 - 152)
    np.testing.assert_allclose(plan.clearance(points), [48.0, 48.0, tip, 0.0, 10.0], atol=1e-12)
    assert plan.is_free((ROBOT_RADIUS, 100.0))
    assert not plan.is_free((ROBOT_RADIUS - 0.01, 100.0))
    assert plan.is_free((ROBOT_RADIUS - 0.01, 100.0), radius=20.0)


def test_free_cells_leave_out_what_cannot_be_reached(write):
    cage = [[200, 0, 200, 300]]
    plan = load_layout(write({"size": [400, 300], "walls": cage, "start": [100, 100]}))
    cells = plan.free_cells(50.0)
    assert sorted(set(cells[:, 0])) == [75.0, 125.0]
    assert math.isinf(plan.shortest_path_length((100, 100), (300, 100)))


def test_random_places_are_free_spread_and_reachable(write):
    cage = [[200, 0, 200, 300]]
    plan = load_layout(write({"size": [400, 300], "walls": cage, "start": [100, 100]}))
    rng = np.random.default_rng(0)
    places = np.array([plan.random_free_position(rng) for _ in range(2000)])
    assert plan.clearance(places).min() >= ROBOT_RADIUS - EXACT
    assert places[:, 0].max() < 200
    low, high = np.array([27.5, 27.5]), np.array([198 - 27.5, 300 - 27.5])
    np.testing.assert_allclose(places.mean(0), (low + high) / 2, atol=5.0)
    np.testing.assert_allclose(places.std(0), (high - low) / math.sqrt(12), rtol=0.07)


def test_path_round_a_wall_has_the_length_of_the_taut_string(write):
    plan = load_layout(write({"size": [600, 600], "walls": [[300, 0, 300, 300]], "start": None}))
    a, b = np.array([100.0, 100.0]), np.array([500.0, 100.0])
    # Taut string from a over the tip, a disc of the robot's radius round the wall's two corners.
    tip = np.array([298.0, 302.0])
    offset = tip - a
    straight = math.sqrt(offset @ offset - ROBOT_RADIUS**2)
    tangent = math.atan2(offset[1], offset[0]) + math.asin(ROBOT_RADIUS / np.hypot(*offset))
    expected = 2 * (straight + ROBOT_RADIUS * tangent) + WALL_THICKNESS
    assert plan.shortest_path_length(a, b) == pytest.approx(expected, rel=0.02)
    assert plan.shortest_path_length(b, a) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("lean", [0, 70])
def test_paths_go_through_gaps_wider_than_the_robot_only(write, lean):
    def way(gap):
        low, high = [200, 0, 200 + lean, 150 - gap / 2], [200 + lean, 150 + gap / 2, 200, 300]
        plan = load_layout(write({"size": [400, 300], "walls": [low, high], "start": None}))
        return plan.shortest_path_length((100, 60), (340, 60))

    assert math.isinf(way(50))
    assert 240 < way(80) < 400


def test_path_is_the_straight_line_where_that_is_free(write):
    plan = load_layout(write(PLAN))
    assert plan.shortest_path_length((50, 250), (350, 220)) == pytest.approx(math.hypot(300, 30))
    with pytest.raises(ValueError, match="cannot stand"):
        plan.shortest_path_length((200, 100), (50, 250))


BAD_PLANS = {
    "no json": "walls everywhere",
    "empty": "",
    "not utf-8": b"\xff\xfe\x00{}",
    "deeply nested": "[" * 100_000,
    "a list": [1, 2],
    "null": None,
    "no size": {"walls": []},
    "no walls": {"size": [400, 300]},
    "size of one": {**PLAN, "size": [400]},
    "size of text": {**PLAN, "size": ["400", "300"]},
    "size of booleans": {**PLAN, "size": [True, True]},
    "size zero": {**PLAN, "size": [0, 300]},
    "size negative": {**PLAN, "size": [400, -300]},
    "size absurd": {**PLAN, "size": [100_001, 300]},
    "size infinite": '{"size": [Infinity, 300], "walls": []}',
    "size overflowing": '{"size": [1e999, 300], "walls": []}',
    "size of 4000 digits": '{"size": [' + "9" * 4000 + ', 300], "walls": []}',
    "size of 9000 digits": '{"size": [' + "9" * 9000 + ', 300], "walls": []}',
    "walls null": {**PLAN, "walls": None},
    "walls an object": {**PLAN, "walls": {"a": 1}},
    "wall of three": {**PLAN, "walls": [[1, 2, 3]]},
    "wall of booleans": {**PLAN, "walls": [[True, True, 50, 50]]},
    "wall of text": {**PLAN, "walls": ["abcd"]},
    "wall of null": {**PLAN, "walls": [[0, 0, None, 10]]},
    "wall not a number": '{"size": [400, 300], "walls": [[NaN, 0, 10, 10]]}',
    "wall outside": {**PLAN, "walls": [[0, 0, 401, 0]]},
    "wall below": {**PLAN, "walls": [[0, -1, 100, 0]]},
    "wall without length": {**PLAN, "walls": [[50, 50, 50, 50]]},
    "too many walls": {**PLAN, "walls": [[0, 0, 9, 9]] * 10_001},
    "too large": json.dumps(PLAN) + " " * 1_000_001,
    "start in a wall": {**PLAN, "start": [200, 100]},
    "start outside": {**PLAN, "start": [500, 100]},
    "start of three": {**PLAN, "start": [1, 2, 3]},
    "start infinite": '{"size": [400, 300], "walls": [], "start": [Infinity, 1]}',
    "no free place": {"size": [50, 50], "walls": [], "start": None},
}


@pytest.mark.parametrize("fault", BAD_PLANS)
def test_bad_layouts_are_refused_by_name(write, fault):
    path = write(BAD_PLANS[fault], "suspect.json")
    with pytest.raises(ValueError, match=r"suspect\.json is not a layout: ."):
        load_layout(path)


def test_missing_layout_names_the_built_in_ones(make, tmp_path):
    with pytest.raises(ValueError, match="hall, loop, paper, twins"):
        make(layout="papre")
    with pytest.raises(ValueError, match="nor a file"):
        load_layout(tmp_path)


def test_layout_without_start_key_starts_anywhere(make, write):
    env = make(layout=write({"size": [400, 300], "walls": []}))
    places = {tuple(env.reset(seed=seed)[1]["ground_truth"]) for seed in range(5)}
    assert len(places) == 5


def test_largest_allowed_layout_is_read(make, write):
    rng = np.random.default_rng(0)
    tips = rng.integers(0, 19_900, (10_000, 2))
    walls = np.concatenate([tips, tips + rng.integers(1, 100, (10_000, 2))], 1).tolist()
    env = make(layout=write({"size": [20_000, 20_000], "walls": walls, "start": None}))
    observation, _ = env.reset(seed=0)
    assert (observation < 1).any()
