"""What was seen on the way speaks against beliefs that only the last sights speak for."""

import json

import gymnasium as gym
import numpy as np
import pytest
from scipy.sparse import csr_array
from test_places import SMALL, trials

from rfl_torch import Agent, record
from rfl_torch.explorer import Explorer
from rfl_torch.trail import AROUND, MOST_SIGHTS, SPACING, Trail

RADIUS = 0.1


def sight(position):
    """What a made-up world shows (..., 6) at positions (..., 2): elsewhere, something else."""
    x, y = np.moveaxis(np.asarray(position, float), -1, 0)
    waves = [x / 9, x / 17, y / 8, y / 15, (x + y) / 12, (x - y) / 10]
    return 0.5 + 0.5 * np.sin(np.stack(waves, -1))


@pytest.fixture
def world():
    """Nodes 3 full actions apart in a square of 60, and one way through all of them."""
    nodes = 3.0 * np.stack(np.meshgrid(np.arange(20), np.arange(20)), -1).reshape(-1, 2)
    order = np.arange(len(nodes))
    edges = csr_array((np.ones(len(nodes) - 1), (order[:-1], order[1:])), shape=(len(nodes),) * 2)
    return nodes, edges


def walked(nodes, edges, way, start):
    """The trail of a robot that goes a way (T, 2), counted from where it starts."""
    trail = Trail(nodes, sight(nodes), edges, RADIUS)
    for position in way:
        see(trail, position - start, sight(position))
    return trail


def see(trail, position, seen):
    """What is seen at a position, counted from where the robot was put."""
    trail.note(position - trail.position, seen)


WAY = np.stack([np.linspace(10, 45, 60), np.linspace(20, 40, 60)], 1)


def test_only_the_true_place_agrees_with_the_way(world):
    nodes, edges = world
    trail = walked(nodes, edges, WAY, WAY[0])
    for offset in ([0.0, 0.0], [2.0, -2.0]):
        assert not trail.speaks_against(0, -WAY[0] + offset)
    for offset in ([15.0, 0.0], [0.0, -12.0], [10.0, 10.0]):
        assert trail.speaks_against(0, -WAY[0] + offset)


def test_what_drifted_by_less_than_what_is_around_agrees(world):
    nodes, edges = world
    drift = np.linspace(0.0, AROUND - 1.0, len(WAY))[:, None] * [1.0, 0.0]
    trail = Trail(nodes, sight(nodes), edges, 0.6 * RADIUS)  # seen alike up to 4 actions off
    for position, off in zip(WAY, drift, strict=True):
        see(trail, position - WAY[0] + off, sight(position))
    assert not trail.speaks_against(0, drift[-1] - WAY[0])


def test_going_to_and_fro_adds_nothing(world):
    """Sights of one place that look right a hundred times don't outvote those that look wrong."""
    nodes, edges = world
    trail = walked(nodes, edges, WAY, WAY[0])
    wrong = -WAY[0] + [15.0, 0.0]
    for position in np.tile(WAY[:2], (100, 1)):
        see(trail, position - WAY[0], sight(position + np.array([15.0, 0.0])))
    assert trail.speaks_against(0, wrong)


def test_where_the_map_has_nothing_no_sight_speaks_against_it(world):
    nodes, edges = world
    trail = walked(nodes, edges, WAY, WAY[0])
    assert not trail.speaks_against(0, -WAY[0] + [200.0, 0.0])


def test_parts_of_a_map_without_a_way_between_them_say_nothing_of_each_other(world):
    nodes, _ = world
    is_left = nodes[:, 0] < 30
    order = np.flatnonzero(is_left), np.flatnonzero(~is_left)
    pairs = np.concatenate([np.stack([part[:-1], part[1:]]) for part in order], 1)
    edges = csr_array((np.ones(pairs.shape[1]), tuple(pairs)), shape=(len(nodes),) * 2)
    right = WAY[WAY[:, 0] > 35]
    trail = walked(nodes, edges, right, right[0])
    wrong = -right[0] + [0.0, -12.0]
    assert trail.speaks_against(int(order[1][0]), wrong)
    assert not trail.speaks_against(int(order[0][0]), wrong)


def test_a_robot_that_is_carried_away_begins_anew(world):
    nodes, edges = world
    trail = Trail(nodes, np.where(nodes[:, :1] < 30, 0.0, 1.0) * np.ones(6), edges, RADIUS)
    for position in np.arange(0.0, 24.0):
        see(trail, np.array([position, 30.0]), np.zeros(6))
    carried = np.array([24.0, 0.0])  # so far to the right, which its own count doesn't know
    for position in np.arange(24.0, 30.0):
        see(trail, np.array([position, 30.0]), np.ones(6))
    assert not trail.speaks_against(0, -carried)


def test_a_sensor_that_is_found_to_be_broken_was_broken_before(world):
    nodes, edges = world
    trail = Trail(nodes, sight(nodes), edges, RADIUS)
    for position in WAY:
        seen = sight(position)
        seen[2] = 3.0
        see(trail, position - WAY[0], seen)
    assert trail.speaks_against(0, -WAY[0])
    seen[2] = np.nan
    see(trail, WAY[-1] - WAY[0], seen)
    assert not trail.speaks_against(0, -WAY[0])


def test_a_long_way_keeps_its_last_sights(world):
    """All that is remembered is what was seen on the map, of which the way before shows nothing."""
    nodes, edges = world
    far = np.stack([np.arange(-2 * SPACING * MOST_SIGHTS, 0, SPACING), np.full(400, 30.0)], 1)
    trail = Trail(nodes, sight(nodes), edges, RADIUS)
    for position in far:
        see(trail, position, np.full(6, 0.5))
    for position in WAY:
        see(trail, position, sight(position))
    assert not trail.speaks_against(0, np.zeros(2))
    assert trail.speaks_against(0, np.array([15.0, 0.0]))


@pytest.fixture(scope="module")
def lanes(tmp_path_factory):
    """Five lanes to and fro; of the outer two, which look like the others, the log knows little."""
    walls = [[0, 200, 850, 200], [150, 400, 1000, 400], [0, 600, 850, 600], [150, 800, 1000, 800]]
    layout = tmp_path_factory.mktemp("trail") / "lanes.json"
    layout.write_text(json.dumps({"size": [1000, 1000], "walls": walls, "start": [500, 500]}))
    with gym.make("rfl/RangefinderMaze-v0", layout=str(layout)) as env:
        log = record(env, 20_000, hold=3, seed=0)
    return str(layout), log, Agent(SMALL).fit(log)


def test_a_robot_in_an_unknown_lane_that_looks_like_a_known_one_finds_back(lanes):
    """By what it sees alone it believes the known one again and again: none of eight come back."""
    layout, log, agent = lanes
    assert log.ground_truth[:, 1].max() < 800
    starts = [(x, 900.0) for x in (250.0, 350.0, 450.0, 550.0, 650.0, 750.0, 850.0, 950.0)]
    ends = [(300.0, 320.0), (700.0, 320.0), (300.0, 480.0), (700.0, 720.0)] * 2
    done = trials(agent, [log], layout, starts, ends)
    assert sum(trial.is_true for trial in done) >= 6


def test_a_robot_that_follows_the_map_is_where_the_map_says_however_it_counts(lanes, monkeypatch):
    """Where it slides along a wall it counts wrongly. Counted for 1.25, all four tasks fail."""
    layout, log, agent = lanes
    watch = Explorer.watch
    monkeypatch.setattr(Explorer, "watch", lambda own, seen, did: watch(own, seen, 1.25 * did))
    starts = [(250.0, 480.0), (600.0, 700.0), (700.0, 500.0), (400.0, 700.0)]
    ends = [(800.0, 320.0), (300.0, 300.0), (200.0, 320.0), (500.0, 480.0)]
    assert all(trial.is_true for trial in trials(agent, [log], layout, starts, ends))
