"""Goals that are sights: against definitions, and by ground truth in the maze."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

import sims  # noqa: F401
from rfl_torch import Agent, AgentConfig, record
from rfl_torch.homing import (
    APPROACH,
    HOPE,
    PLACES,
    SAME_SIGHT,
    STUCK,
    TWIN,
    Homing,
    Place,
    Probes,
    move_to_sight,
    places_like,
)
from rfl_torch.places import PLACE_STEPS


@pytest.fixture(scope="module")
def learned():
    """A log of 6,000 steps in the paper's maze, and what was learned from it."""
    with gym.make("rfl/RangefinderMaze-v0", layout="paper") as env:
        log = record(env, 6000, hold=3, seed=0)
    return log, Agent(AgentConfig(), 0).fit(log)


@pytest.mark.parametrize("is_missing", [False, True])
def test_the_move_to_a_sight_is_the_one_after_which_it_is_seen(is_missing):
    """To 0.03 of a full action, what the two ridges take from a field that is linear."""
    rng = np.random.default_rng(0)
    gain, move = rng.normal(0, 0.1, (2, 24)), np.array([1.5, -0.7])
    positions = rng.uniform(-10, 10, (30, 2))
    miss = move @ gain
    if is_missing:
        miss[::3] = np.nan
    found = move_to_sight(miss, positions @ gain, positions)
    np.testing.assert_allclose(found, move, atol=0.03)


@pytest.mark.parametrize("off", [0.0, 0.1])
def test_places_are_apart_and_the_likeliest_comes_first(off):
    rng = np.random.default_rng(0)
    positions = rng.uniform(0, 60, (40, 2))
    node = rng.integers(0, 40, 500)
    sight, radius = rng.uniform(0, 1, 6), 0.1
    seen = sight + rng.uniform(-1, 1, (500, 6)) * rng.uniform(off, off + 0.5, (500, 1))
    away = np.abs(seen - sight).mean(1) / radius
    places = places_like(seen, node, positions, sight, radius)
    assert len(places) == PLACES
    least = [away[node == place.nodes[0]].min() for place in places]
    assert [place.away for place in places] == least
    assert least[0] == away.min()
    assert least == sorted(least)
    for place, best in zip(places, least, strict=True):
        assert all(away[node == own].min() <= best + SAME_SIGHT for own in place.nodes)
        assert best <= TWIN or len(place.nodes) == 1  # what is unlike the goal is no twin of it
    for k, place in enumerate(places[1:], 1):
        before = positions[np.concatenate([other.nodes for other in places[:k]])]
        assert np.linalg.norm(positions[place.nodes][:, None] - before, axis=2).min() >= PLACE_STEPS


def homing(*aways):
    """Of an agent whose regression knows no way; looks have radius 1, and a place each."""
    agent = SimpleNamespace(
        actions=SimpleNamespace(
            rest=np.zeros(2, np.float32), to_move=np.float64, of_move=np.float32
        ),
        look_radius=1.0,
        free_ways=None,
        control_to_sight=lambda normal, node, sight: np.zeros(2, np.float32),
    )
    return Homing(agent, np.zeros(6), [Place(np.array([k]), away) for k, away in enumerate(aways)])


def stay(goes, away):
    """Stand where all that is seen is so far from the goal, until something changes."""
    for step in range(APPROACH + 2):
        if goes.act(np.full(6, away), int(goes.nodes[0])) is None:
            return step
    raise AssertionError("the approach never ends")


def see(offset, unit):
    """Six readings, 0 at the goal, which all change by `unit` in a full action along either way;
    one of them jumps, as a ray does that slips past a corner."""
    readings = unit * np.array([1, 1, 1, -1, 1, -1]) * np.resize(offset, 6)
    readings[2] += 6 * unit * (offset[0] > 1.2)
    return readings


@pytest.mark.parametrize("wall", [-np.inf, -0.2])
@pytest.mark.parametrize("start", [(3.3, 2.4), (-0.1, -4.2), (2.2, -3.1), (0.4, 0.3)])
def test_steps_that_are_tried_lead_to_the_goal_where_the_regression_knows_no_way(start, wall):
    """To half a full action, past a jump and along a wall: 60 steps, of which 6 are lost before."""
    goes, offset = homing(1.0), np.array(start)
    for _ in range(APPROACH + 1):
        action = goes.act(see(offset, 0.5), 0)
        if action is None:
            break
        there = offset + action
        offset = there if there[0] >= wall else np.array([offset[0], there[1]])
    assert goes.is_there
    assert np.abs(offset).max() <= 0.5


def test_from_a_step_that_led_no_closer_the_robot_goes_back():
    probes = Probes(2)
    assert probes.next(np.zeros(2), False).tolist() == [1, 0]
    assert probes.next(np.array([1.0, 0]), False).tolist() == [-1, 0]
    assert probes.next(np.zeros(2), False).tolist() == [0, 1]
    assert probes.next(np.zeros(2), True).tolist() == [0, 1]


def test_where_no_step_leads_closer_each_was_tried_in_either_size():
    probes, tried = Probes(2), []
    while (step := probes.next(np.zeros(2), False)) is not None:
        tried.append(tuple(step))
    ways = [(1, 0), (0, 1), (-1, 0), (0, -1)]
    assert tried[:4] == ways
    assert sorted(tried[4:]) == sorted((x / 2, y / 2) for x, y in ways)


def test_a_place_that_is_not_like_the_goal_is_left_for_the_next():
    goes = homing(0.4, 0.5)
    assert not goes.has_begun
    assert STUCK < stay(goes, 0.3) < APPROACH  # no step led closer
    assert not goes.is_there
    assert goes.nodes.tolist() == [1]
    assert not goes.has_begun
    assert stay(goes, 0.01) == 0
    assert goes.is_there


@pytest.mark.parametrize("best", [0, 1, 2])
def test_if_none_is_like_it_the_one_most_like_it_is_gone_back_to(best):
    goes = homing(0.5, 0.5, 0.5)
    for k in range(3):
        stay(goes, 0.4 if k == best else 0.8)
    assert goes.nodes.tolist() == [best]
    assert stay(goes, 0.4) == 0
    assert goes.is_there


def test_a_place_that_the_logs_saw_to_be_unlike_the_goal_is_not_tried():
    goes = homing(0.4, HOPE + 0.1)
    stay(goes, 0.5)
    assert goes.nodes.tolist() == [0]
    stay(goes, 0.6)
    assert goes.is_there


def test_a_goal_that_nothing_looks_like_is_given_up():
    goes = homing(1.5, 1.6)
    for _ in range(2):
        stay(goes, 1.5)
    assert not goes.is_there
    assert not len(goes.nodes)


def test_a_robot_that_is_nearly_there_goes_on_though_what_it_sees_is_strange(learned):
    """Between two sights of the log there is one that no node explains, or another node does. No
    reading is left out for that: how far the goal is, is asked of the same ones each time."""
    log, agent = learned
    executor, seen = agent.executor(log.observations[3000]), []
    executor.act(log.observations[2990])
    executor._homing._least = 1.0
    assert executor._homing.has_begun
    executor._homing.act = lambda normal, node: seen.append(normal) or np.zeros(2, np.float32)
    executor.act(1.0 - log.observations[3000])
    assert not executor.is_familiar
    assert len(seen) == 1
    np.testing.assert_array_equal(seen[0], agent.readings.normalize(1.0 - log.observations[3000]))


def test_a_robot_goes_on_from_the_node_to_where_it_sees_just_what_it_was_shown(learned):
    """Goals up to 25 mm off the track of the log; nodes are 44 mm apart."""
    log, agent = learned
    with gym.make("rfl/RangefinderMaze-v0", layout="paper", max_episode_steps=-1) as env:
        room, rng, off = env.unwrapped.layout, np.random.default_rng(1), []
        while len(off) < 20:
            place = log.ground_truth[rng.integers(6000)] + rng.uniform(-25, 25, 2)
            if not room.is_free(place):
                continue
            sight, _ = env.reset(options={"position": tuple(place)})
            start = log.ground_truth[rng.integers(6000)]
            observation, info = env.reset(options={"position": tuple(start)})
            executor = agent.executor(sight)
            for _ in range(800):
                action = executor.act(observation)
                if executor.status != "running":
                    break
                observation, _, _, _, info = env.step(action)
            assert executor.status == "reached"
            blind = agent.control_to_sight(
                np.full(24, np.nan), executor.node, agent.readings.normalize(sight)
            )
            assert np.isfinite(blind).all()
            off.append(np.linalg.norm(info["ground_truth"] - place))
    print(np.round(off, 1))
    assert np.median(off) < 8
    assert np.mean(np.array(off) < 20) >= 0.9
