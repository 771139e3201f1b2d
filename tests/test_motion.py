"""What choices lead to, readings that wrap, and acting by both, on worlds that hide velocity."""

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from worlds import dot_config, dot_log

from rfl_torch import Agent, AgentConfig, Stage, Trajectory
from rfl_torch.circle import find_periods, unwrap_to_circles, wrap_again
from rfl_torch.memory import Memory
from rfl_torch.motion import (
    HORIZON,
    Motion,
    apart,
    choices,
    held_steps,
    left_open,
    remember,
    remember_more,
    spread_out,
)
from rfl_torch.steering import Goal, time_to_goal

STEP = 0.05  # s
PUSH = 1.0  # acceleration of the full action
DRAG = 0.3  # 1/s


class Cart:
    """A cart on a line, held by a spring: it shows where it is, never how fast it goes."""

    def __init__(self, position=0.0, velocity=0.0):
        self.state = np.array([position, velocity])

    def step(self, action):
        position, velocity = self.state
        velocity += STEP * (PUSH * float(action[0]) - position - DRAG * velocity)
        self.state = np.array([position + STEP * velocity, velocity])
        return self.see()

    def see(self):
        return self.state[:1].astype(np.float32)


class OpenCart(Cart):
    """The same, but it shows how fast it goes, too."""

    def see(self):
        return self.state.astype(np.float32)


class Swing:
    """A pendulum that shows its angle in turns, from 0 to 1; its motor can't hold it level."""

    def __init__(self, angle=0.0, velocity=0.0):
        self.state = np.array([angle, velocity])

    def step(self, action):
        angle, velocity = self.state
        velocity += STEP * (5 * float(action[0]) - 9.8 * np.sin(angle) - 0.3 * velocity)
        self.state = np.array([angle + STEP * velocity, velocity])
        return self.see()

    def see(self):
        return np.array([self.state[0] / (2 * np.pi) + 0.5], np.float32) % 1


def record(world, num_steps=4000, seed=0, hold=30):
    rng, cart = np.random.default_rng(seed), world()
    observations, actions, truth = [cart.see()], [], [cart.state]
    for step in range(num_steps):
        if step % hold == 0:
            action = rng.integers(-1, 2, 1).astype(np.float32)
        actions.append(action)
        observations.append(cart.step(action))
        truth.append(cart.state)
    bounds = np.full(1, -1, np.float32), np.full(1, 1, np.float32)
    return Trajectory(np.stack(observations), np.stack(actions), *bounds, np.stack(truth))


def memory_of(log):
    """The log as the agent would keep it: all readings in [0, 1], here at one node."""
    observation = log.observations
    low, high = observation.min(0), observation.max(0)
    action = (np.concatenate([log.actions, log.actions[-1:]]) + 1) / 2
    node = np.zeros(len(observation), np.int64)
    return Memory((observation - low) / (high - low), action, node, np.zeros(1, np.int64))


@pytest.fixture(scope="module")
def log():
    return record(Cart)


@pytest.fixture(scope="module")
def swings():
    return record(Swing, 5000)


@pytest.fixture(scope="module")
def motion(log):
    return Motion(memory_of(log))


@pytest.fixture(scope="module")
def agent(swings):
    config = dataclasses.replace(
        AgentConfig.smooth(),
        shape=(14, 14),
        stages=(Stage(1, 60, (0.02, 1.0), pseudo_count=0.01, min_scale=0.04, tolerance=0.0),),
    )
    return Agent(config).fit(swings)


def scale_of(log):
    return float(np.ptp(log.observations))


# -- what choices lead to ---------------------------------------------------------------------


def test_what_a_choice_leads_to_is_what_the_world_does(log, motion):
    rows = np.arange(200, 3800, 40)
    now = memory_of(log).observation.astype(np.float64)
    situation = np.concatenate([now[rows], now[rows] - now[rows - 1]], 1)
    prospect = motion.look_ahead(situation)
    error = []
    for i, row in enumerate(rows):
        for k, choice in enumerate(motion.choices):
            cart = Cart(*log.ground_truth[row])
            seen = [cart.step(2 * choice - 1) for _ in range(HORIZON)]
            trace = prospect.trace[i, k, :, 0] * scale_of(log) + log.observations.min()
            held = prospect.num_steps[i, k]
            error.append(np.abs(trace - np.concatenate(seen))[:held].max())
    # A full push held for HORIZON steps moves the cart by 0.14.
    assert np.quantile(error, 0.99) < 0.01


def test_what_short_holds_teach_is_strung_together_to_long_ones():
    log = record(OpenCart, hold=4)
    motion, rng = Motion(memory_of(log)), np.random.default_rng(0)
    low, high = log.observations.min(0), log.observations.max(0)
    error = []
    for row in rng.integers(200, 3800, 60):
        now = (log.observations[[row - 1, row]] - low) / (high - low)
        prospect = motion.look_ahead(np.concatenate([now[1], now[1] - now[0]])[None])
        for k, choice in enumerate(motion.choices):
            cart = OpenCart(*log.ground_truth[row])
            seen = np.stack([cart.step(2 * choice - 1) for _ in range(HORIZON)])
            trace = prospect.trace[0, k, :, :2] * (high - low) + low
            held = prospect.num_steps[0, k]
            error.append(np.abs(trace - seen)[:held].max())
    # A full push held for HORIZON steps changes the speed by 0.6, and moves the cart by 0.14.
    assert prospect.trace.shape[2] == HORIZON
    assert np.quantile(error, 0.95) < 0.02


@pytest.mark.parametrize("hold", [1, 2, 4, 5, 30])
def test_models_reach_as_far_as_half_of_the_actions_are_held(hold):
    memory = memory_of(record(Cart, 900, hold=hold))
    memory = memory._replace(start=np.array([0, 100, 107]))
    ends, left = [100, 107, 901], []
    for row, action in enumerate(memory.action):
        end = next(end for end in ends if row < end)
        same = (memory.action[row:end] == action).all(1)
        left.append(int(np.argmin(same)) if not same.all() else end - row)
    longest = max(k for k in range(1, HORIZON + 1) if np.mean(np.array(left) >= k) >= 0.5)
    assert held_steps(memory) == longest


def test_what_alike_situations_leave_open_is_that_of_the_nearest_at_another_time():
    rng = np.random.default_rng(0)
    time = np.concatenate([np.arange(200), np.arange(300, 420)])
    situation, change = rng.random((320, 3)), rng.normal(size=(320, 2))
    action = rng.integers(2, size=(320, 1)).astype(np.float32)
    difference = []
    for i in range(320):
        away = np.linalg.norm(situation - situation[i], axis=1)
        away[(action != action[i]).any(1)] = np.inf
        nearest = np.argsort(away)[:HORIZON]  # it looks no further
        others = nearest[np.abs(time[nearest] - time[i]) > 2 * HORIZON]
        difference += [np.abs(change[others[0]] - change[i])] if len(others) else []
    expected = (np.mean(difference, 0) / np.abs(change).mean(0)).mean()
    assert left_open(situation, change, action, time) == pytest.approx(expected, rel=1e-12)
    assert np.isnan(left_open(situation[:20], change[:20], action[:20], time[:20]))


def test_motion_is_taken_from_changes_unless_observations_show_it(motion):
    shown = Motion(memory_of(record(OpenCart)))
    assert shown.is_shown
    assert not motion.is_shown
    situation = shown.landmark[:1].copy()
    situation[0, shown.obs_dim :] += 0.5  # of the range: never seen
    assert shown.stray(situation) == 0
    near, weight = shown.interpolate(situation)
    assert near[0, 0] == 0
    assert weight[0, 0] > 0.5


def test_a_goal_whose_motion_shows_is_near_within_its_nodes_width():
    motion = Motion(memory_of(record(OpenCart)))
    center = np.array([[0.5, 0.5, 0.0, 0.0]])
    goal = Goal(motion, center, np.array([0.1]))  # rms of two readings: 0.1 sqrt(2) away
    for offset, is_near in (([0.1, 0.099], True), ([0.14, 0.0], True), ([0.1, 0.101], False)):
        situation = center[0] + [*offset, 0.3, 0.0]
        assert (goal.distance(situation) <= 1) == is_near


def test_the_choices_are_the_distinct_actions_of_the_log():
    held = np.array([[0.0], [1.0], [0.5], [1.0]], np.float32)
    np.testing.assert_array_equal(choices(held), [[0.0], [0.5], [1.0]])
    one_hot = np.eye(3, dtype=np.float32)[[0, 2, 1, 1]]
    assert {tuple(row) for row in choices(one_hot).tolist()} == {(0, 0, 1), (0, 1, 0), (1, 0, 0)}


def test_a_log_of_ever_new_actions_teaches_no_motion_nor_spoils_what_is_known():
    rng = np.random.default_rng(0)
    node, seen = torch.zeros(301, dtype=torch.int64), torch.from_numpy(rng.random((301, 2))).float()
    few = torch.from_numpy(rng.integers(3, size=(300, 1)) / 2).float()
    new = torch.from_numpy(rng.random((300, 1))).float()
    assert remember([(node, seen, new)]) is None
    memory = remember([(node, seen, few)])
    assert remember_more(memory, node, seen, new) is memory
    longer = remember_more(memory, node, seen, few)
    both = remember([(node, seen, few)] * 2)
    for own, other in zip(longer, both, strict=True):
        np.testing.assert_array_equal(own, other)


def test_landmarks_lie_in_the_log_or_near_it_and_no_two_at_one_place(motion):
    scaled = motion.landmark / motion.scale
    assert cKDTree(scaled).query(scaled, 2)[0][:, 1].min() > 0
    assert motion.stray(motion.landmark).max() == 0


def test_weights_of_the_landmarks_around_a_situation_sum_to_one_and_favour_the_nearest(motion):
    near, weight = motion.interpolate(motion.landmark[:50])
    np.testing.assert_allclose(weight.sum(1), 1.0)
    assert (near[:, 0] == np.arange(50)).all()
    assert (weight[:, 0] > 0.5).all()


def test_points_are_spread_out_and_kept_apart():
    points = np.array([[0.0], [0.1], [1.0], [0.9], [0.5]])
    assert spread_out(points, 3).tolist() == [0, 2, 4]
    np.testing.assert_array_equal(apart(points, 0.2), [[0.0], [1.0], [0.5]])


# -- acting -----------------------------------------------------------------------------------


def drive(agent, goal, start, limit=500, seed=0):
    swing = Swing(*start)
    executor, observation = agent.executor(goal, seed), swing.see()
    for _ in range(limit):
        action = executor.act(observation)
        if executor.status != "running":
            break
        observation = swing.step(action)
    return executor, swing


def centers(agent, log):
    """Mean state of each node's steps, the angle on the circle; NaN for a node without steps."""
    path, mean = agent.recognize(log.observations), np.full((agent.num_nodes, 2), np.nan)
    for node in np.unique(path):
        angle, velocity = log.ground_truth[path == node].T
        mean[node] = np.angle(np.exp(1j * angle).mean()), velocity.mean()
    return mean


def offset(state, reference):
    """Angle the short way round, and velocity."""
    away = np.asarray(state) - reference
    return np.stack([(away[..., 0] + np.pi) % (2 * np.pi) - np.pi, away[..., 1]], -1)


def test_a_pendulum_is_found_irreversible_and_steered_to_every_node(agent, swings):
    assert not agent.is_reversible
    center, rng = centers(agent, swings), np.random.default_rng(0)
    done = []
    for goal in range(0, agent.num_nodes, 12):
        executor, swing = drive(agent, goal, swings.ground_truth[rng.integers(5000)])
        near = np.abs(offset(swing.state, center[goal])) < [0.4, 1.0]
        done.append(executor.status == "reached" and near.all())
    assert np.mean(done) >= 0.9


def test_the_time_that_a_plan_expects_is_the_time_that_it_takes(agent):
    """The plan's time is that to the goal's border; arriving at its middle takes a little more."""
    ratio = []
    for goal in range(4, agent.num_nodes, 32):
        swing, executor = Swing(), agent.executor(goal)
        executor.act(swing.see())
        action = executor.act(swing.step(np.zeros(1)))
        near, weight = agent.motion.interpolate(np.append(executor._before, np.zeros(2))[None])
        expected = weight[0] @ time_to_goal(agent.motion, executor._target)[near[0]]
        steps = 0
        while executor.status == "running" and steps < 500:
            steps += 1
            action = executor.act(swing.step(action))
        ratio.append(steps / expected)
    assert 0.7 < np.median(ratio) < 1.4


def test_after_arriving_upright_it_stays_upright(agent, swings):
    away = offset(centers(agent, swings), [np.pi, 0.0])
    is_up = np.abs(away[:, 0]) < 0.3
    goal = int(np.where(is_up, np.abs(away[:, 1]), np.inf).argmin())
    executor, swing = drive(agent, goal, (0.0, 0.0))
    assert executor.status == "reached"
    lean = []
    for _ in range(200):
        swing.step(executor.act(swing.see()))
        lean.append(abs(offset(swing.state, [np.pi, 0.0])[0]))
    assert executor.status == "reached"
    assert max(lean[100:]) < 0.5


def test_a_plan_leads_from_the_present_node_to_the_goal(agent):
    swing, goal = Swing(0.2, 0.3), agent.num_nodes - 1
    executor = agent.executor(goal)
    assert executor.path == []
    for _ in range(3):
        swing.step(executor.act(swing.see()))
    path = executor.path
    assert path[0] == executor.node
    assert path[-1] == goal
    assert all(a != b for a, b in itertools.pairwise(path))


def test_missing_readings_are_filled_in_and_actions_stay_in_bounds(agent):
    swing, executor = Swing(0.5, 0.0), agent.executor(0)
    for step in range(60):
        observation = np.full(1, np.nan, np.float32) if step % 7 == 3 else swing.see()
        action = executor.act(observation)
        assert np.abs(action).max() <= 1.0
        swing.step(action)


def test_a_steered_agent_saved_and_loaded_does_the_same(agent, tmp_path):
    agent.save(tmp_path / "swing.safetensors")
    loaded = Agent.load(tmp_path / "swing.safetensors")
    np.testing.assert_array_equal(loaded.motion.landmark, agent.motion.landmark)
    traces = []
    for own in (agent, loaded):
        swing, executor, trace = Swing(0.2, 0.0), own.executor(3), []
        for _ in range(40):
            swing.step(executor.act(swing.see()))
            trace.append(swing.state)
        traces.append(trace)
    np.testing.assert_array_equal(*traces)


def test_a_goal_that_nothing_brings_nearer_is_given_up_with_a_reason(agent):
    executor = agent.executor(0)
    executor._target.center += 100.0
    executor._time[:] = 50.0
    for _ in range(5000):
        executor.act(np.full(1, 0.5, np.float32))  # nothing that it does shows
        if executor.status != "running":
            break
    assert executor.status == "gave_up"
    assert "kicks" in executor.reason
    np.testing.assert_array_equal(executor.act(np.full(1, 0.5, np.float32)), agent.actions.rest)


def test_several_nodes_are_one_goal_and_the_first_to_come_by_will_do(agent, swings):
    away = offset(centers(agent, swings), [np.pi / 2, 0.0])
    executor, swing = drive(agent, lambda node: abs(away[node, 0]) < 0.5, (0.0, 0.0))
    assert executor.status == "reached"
    assert abs(offset(swing.state, [np.pi / 2, 0.0])[0]) < 0.9


def test_a_world_that_is_reversible_or_an_agent_told_so_is_not_steered(swings):
    assert Agent(dot_config()).fit(dot_log(600)).motion is None
    config = dataclasses.replace(
        AgentConfig.smooth(), shape=(4, 4), stages=(Stage(1, 5),), steers=False
    )
    assert Agent(config).fit(swings).motion is None


# -- readings that wrap -----------------------------------------------------------------------


def turning(num_steps=2000, period=1.0):
    """An angle that goes round both ways, over one that only rocks."""
    t = np.arange(num_steps)
    angle = 0.07 * np.sin(t / 90).cumsum()
    return np.stack([angle % 1.0 * period, np.sin(t / 9)], 1)


@pytest.mark.parametrize("period", [1.0, 2 * np.pi, 360.0])
def test_a_reading_that_wraps_is_found_with_its_period(period):
    np.testing.assert_allclose(find_periods([turning(period=period)]), [period, 0.0], rtol=1e-3)


def test_jumps_that_are_no_turns_are_not_taken_for_them():
    rng = np.random.default_rng(0)
    square = np.sign(np.sin(np.arange(2000) / 50)) + 0.1 * np.sin(np.arange(2000) / 7)
    noise = rng.random(2000)
    assert not find_periods([np.stack([square, noise], 1)]).any()


def test_on_the_circle_the_ends_of_the_range_meet():
    reading = np.array([[0.0, 0.3], [1.0, 0.3], [0.5, 0.3]])
    circle = unwrap_to_circles(reading, np.array([1.0, 0.0]))
    back = wrap_again(circle, np.array([1.0, 0.0]))
    away = np.abs(back - reading)
    assert np.minimum(away, 1.0 - away).max() < 1e-12
    np.testing.assert_allclose(circle, [[0.3, 1, 0.5], [0.3, 1, 0.5], [0.3, 0, 0.5]], atol=1e-12)


def test_a_ray_that_flickers_from_one_end_of_its_range_to_the_other_does_not_wrap():
    rng = np.random.default_rng(0)
    ray = np.where(rng.random(4000) < 0.05, 0.0, 1.0) - 0.1 * rng.random(4000)
    assert not find_periods([ray[:, None]]).any()
