"""Sensors and worlds that go wrong after learning: the robot arrives, or says that it can't."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest

import sims  # noqa: F401
from experiments import faults
from experiments.faults import FAULTS
from rfl_torch import Agent, AgentConfig, record
from rfl_torch.executor import CONFIRMED
from rfl_torch.senses import Sensors, believed

TASKS = 12


@pytest.fixture(scope="module")
def log():
    env = gym.make("rfl/RangefinderMaze-v0", layout="paper", max_episode_steps=-1)
    yield record(env, 3000, hold=3, seed=1)
    env.close()


@pytest.fixture(scope="module")
def agent(log):
    config = AgentConfig()
    stages = tuple(dataclasses.replace(stage, iterations=15) for stage in config.stages)
    return Agent(dataclasses.replace(config, shape=(10, 10), stages=stages)).fit(log)


@pytest.mark.parametrize(
    "name",
    ["healthy", "2 sensors dead at 1", "2 % of readings outliers", "10 % of frames dropped"],
)
def test_a_few_wrong_readings_keep_no_robot_from_its_goals(agent, log, name):
    tally = faults.go(agent, log, FAULTS[name], TASKS, 0)
    assert tally.true >= 0.85 * TASKS
    assert tally.false == 0


def test_a_turned_ring_is_reported_and_not_believed(agent, log, monkeypatch):
    monkeypatch.setattr(faults, "MAZE", dataclasses.replace(faults.MAZE, limit=200))
    tally = faults.go(agent, log, FAULTS["ring turned by 15 degrees"], 4, 0)
    assert tally.false == tally.never_lost == 0


def test_a_familiar_sight_after_many_strange_ones_is_no_arrival_yet(agent):
    """Its own sight must be a fifth of the last 60: twelve, after 60 strange ones."""
    rng = np.random.default_rng(0)
    goal = agent.raw_readings(agent.hmm.emission_mean[7].detach().numpy()).astype(np.float32)
    executor = agent.executor(7)
    executor.act(goal)
    assert executor.status == "reached"  # nothing strange was seen before
    executor = agent.executor(7)
    for _ in range(60):
        executor.act(rng.random(24).astype(np.float32) * agent.observation_scale.max())
    assert not executor.is_familiar
    said = []
    for _ in range(12):
        executor.act(goal)
        assert executor.is_familiar
        said.append(executor.status)
    assert said == ["running"] * 11 + ["reached"]
    assert executor.node == 7


def test_a_belief_that_jumped_says_it_arrived_only_once_it_has_stayed_for_some_steps(agent):
    sights = agent.raw_readings(agent.hmm.emission_mean.detach().numpy()).astype(np.float32)
    far = int(np.flatnonzero(agent.near[[7]].toarray()[0] == 0)[0])
    executor = agent.executor(7)
    for _ in range(5):
        executor.act(sights[far])
    assert executor.node == far
    said = []
    while not said or said[-1] == "running":
        executor.act(sights[7])
        said += [executor.status] if executor.node == 7 else []
    assert said == ["running"] * CONFIRMED + ["reached"]


def test_readings_that_do_not_fit_where_the_others_agree_are_left_out():
    rng = np.random.default_rng(0)
    mean = rng.random((50, 24))
    nowhere = np.full(50, 0.02)
    for node in range(50):
        seen = mean[node] + 0.005 * rng.standard_normal(24)
        wrong = rng.choice(24, 3, replace=False)
        seen[wrong] += 0.5
        seen[(wrong[0] + 1) % 24] = np.nan
        left, share = believed(seen, mean, nowhere, 0.03)
        assert set(wrong) <= set(np.flatnonzero(np.isnan(left)))
        np.testing.assert_array_equal(left[~np.isnan(left)], seen[~np.isnan(left)])
        assert share == pytest.approx(np.isnan(left[~np.isnan(seen)]).mean())


def test_half_of_the_readings_may_be_wrong_only_where_the_robot_may_be():
    rng = np.random.default_rng(1)
    mean = rng.random((50, 24))
    seen = mean[7].copy()
    seen[:10] += 0.5
    here, elsewhere = np.zeros(50), np.zeros(50)
    here[7] = elsewhere[8] = 1.0
    assert np.isnan(believed(seen, mean, here, 0.03)[0]).sum() == 10
    left, share = believed(seen, mean, elsewhere, 0.03)
    assert share == 1.0
    np.testing.assert_array_equal(left, seen)


def test_a_sensor_that_is_wrong_wherever_the_robot_is_goes_missing_until_it_works_again():
    rng = np.random.default_rng(0)
    mean = 0.2 + 0.6 * rng.random((200, 24))
    sensors = Sensors(24)

    def drive(broken, slips=0):
        for node in rng.integers(200, size=30):
            seen = mean[node] + 0.005 * rng.standard_normal(24)
            seen[rng.choice(24, slips, replace=False)] += 0.5
            seen[broken] = 1.0
            sensors.note(seen, mean[node], 0.03)
        return np.flatnonzero(np.isnan(sensors.working(seen)))

    assert drive([], slips=4).size == 0  # each now and then
    assert drive([3, 14], slips=1).tolist() == [3, 14]
    assert drive([14]).tolist() == [14]
    assert drive([]).size == 0
    assert drive([0, 1, 2, 3, 4, 5]).size <= 2  # no sensor's fault: the robot is elsewhere


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30, 0.0])
def test_no_observation_whatever_makes_an_action_outside_of_the_space(agent, value):
    executor = agent.executor(0)
    rng = np.random.default_rng(0)
    for step in range(30):
        seen = np.full(24, value, np.float32)
        if step % 3:
            seen[rng.random(24) < 0.5] = rng.random()
        action = executor.act(seen)
        assert action.shape == (2,)
        assert (np.abs(action) <= 1).all()
        np.testing.assert_allclose(executor.belief.sum(), 1.0, atol=1e-9)
