"""Goals that are sights: against definitions, and by ground truth in the maze."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from scipy.sparse import eye_array

import sims  # noqa: F401
from rfl_torch import Agent, AgentConfig, record
from rfl_torch.homing import (
    APPROACH,
    KICK,
    PLACES,
    SAME_SIGHT,
    STUCK,
    Homing,
    Place,
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


def test_places_are_apart_and_the_likeliest_comes_first():
    rng = np.random.default_rng(0)
    positions = rng.uniform(0, 60, (40, 2))
    node = rng.integers(0, 40, 500)
    sight, radius = rng.uniform(0, 1, 6), 0.1
    seen = sight + rng.uniform(-1, 1, (500, 6)) * rng.uniform(0.0, 0.5, (500, 1))
    away = np.abs(seen - sight).mean(1) / radius
    places = places_like(seen, node, positions, sight, radius)
    assert len(places) == PLACES
    least = [away[node == place.nodes[0]].min() for place in places]
    assert [place.away for place in places] == least
    assert least[0] == away.min()
    assert least == sorted(least)
    for place, best in zip(places, least, strict=True):
        assert all(away[node == own].min() <= best + SAME_SIGHT for own in place.nodes)
    for k, place in enumerate(places[1:], 1):
        before = positions[np.concatenate([other.nodes for other in places[:k]])]
        assert np.linalg.norm(positions[place.nodes][:, None] - before, axis=2).min() >= PLACE_STEPS


def homing(*aways):
    """Of an agent that only looks at what is seen at its nodes, a place each."""
    agent = SimpleNamespace(
        action_bounds=(np.full(2, -1.0, np.float32), np.ones(2, np.float32)),
        look_radius=1.0,
        free_ways=None,
        near=eye_array(5, format="csr") > 0,
        control_to_sight=lambda normal, node, sight: np.zeros(2, np.float32),
    )
    return Homing(
        agent, np.zeros(6), [Place(np.array([k]), away) for k, away in enumerate(aways)], 0
    )


def stay(goes, away):
    """Stand where all that is seen is so far from the goal, until something changes."""
    for step in range(APPROACH + 2):
        if goes.act(np.full(6, away), int(goes.nodes[0])) is None:
            return step
    raise AssertionError("the approach never ends")


def test_a_place_that_is_not_like_the_goal_is_left_for_the_next():
    goes = homing(0.4, 0.5)
    assert not goes.is_near(np.eye(5)[0])  # not come to yet
    assert stay(goes, 0.5) == APPROACH
    assert not goes.is_there
    assert goes.nodes.tolist() == [1]
    assert stay(goes, 0.01) == 0
    assert goes.is_there


def test_where_it_comes_no_closer_what_is_like_the_goal_will_do():
    goes = homing(0.4, 0.5)
    assert stay(goes, 0.3) == STUCK
    assert goes.is_there


def test_what_is_like_the_goal_will_do_from_when_it_came_no_closer_on():
    goes = homing(0.4, 0.5)
    for _ in range(STUCK + 1):
        assert goes.act(np.full(6, 0.5), 0) is not None
    assert goes.act(np.full(6, 0.3), 0) is None
    assert goes.is_there


@pytest.mark.parametrize("best", [0, 1, 2])
def test_if_none_is_like_it_the_one_most_like_it_is_gone_back_to(best):
    goes = homing(0.5, 0.5, 0.5)
    for k in range(3):
        stay(goes, 0.4 if k == best else 0.8)
    assert goes.nodes.tolist() == [best]
    assert stay(goes, 0.4) == 0
    assert goes.is_there


def test_a_place_that_the_logs_saw_to_be_less_like_the_goal_is_not_tried():
    goes = homing(0.4, 1.1)
    stay(goes, 0.5)
    assert goes.nodes.tolist() == [0]
    assert stay(goes, 0.6) == APPROACH
    assert goes.is_there


def test_a_goal_that_nothing_looks_like_is_given_up():
    goes = homing(1.5, 1.6)
    for _ in range(2):
        stay(goes, 1.5)
    assert not goes.is_there
    assert not len(goes.nodes)


def test_a_robot_that_comes_no_closer_tries_other_steps_for_a_while():
    goes = homing(0.4)
    actions = [goes.act(np.full(6, 0.5), 0) for _ in range(STUCK + KICK + 1)]
    is_still = [not action.any() for action in actions]
    assert is_still == [True] * STUCK + [False] * KICK + [True]


def test_a_robot_that_is_nearly_there_goes_on_though_what_it_sees_is_strange(learned):
    """Between two sights of the log there is one that no node explains."""
    log, agent = learned
    executor, seen = agent.executor(log.observations[3000]), []
    executor.act(log.observations[2990])
    executor._homing.is_near = lambda belief: True
    executor._homing.act = lambda normal, node: seen.append(normal) or np.zeros(2, np.float32)
    executor.act(1.0 - log.observations[3000])
    assert not executor.is_familiar
    assert len(seen) == 1


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
                np.full(24, np.nan), executor.node, agent.normalize(sight)
            )
            assert np.isfinite(blind).all()
            off.append(np.linalg.norm(info["ground_truth"] - place))
    print(np.round(off, 1))
    assert np.median(off) < 8
    assert np.mean(np.array(off) < 20) >= 0.9
