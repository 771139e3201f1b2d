"""`sims.pendulum` against a fourth-order Runge-Kutta integration of the same equation."""

import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from reference_physics import rk4_pendulum

import sims
from sims.pendulum import TorquePendulumEnv

gym.register_envs(sims)

# Largest errors against RK4, of (angle [rad], velocity [rad/s]), in the first second and in ten.
SWING_1S, SWING_10S = (2e-5, 2e-4), (5e-4, 1e-3)
SPIN_1S, SPIN_10S = (2e-4, 5e-4), (2e-2, 4e-2)  # passing near the top multiplies any error


@pytest.fixture
def make():
    """Make environments that are closed after the test."""
    envs = []

    def make(**options):
        envs.append(gym.make("rfl/TorquePendulum-v0", **options))
        return envs[-1]

    yield make
    for env in envs:
        env.close()


def run(env, state, fractions):
    """Return (T + 1, 2) ground truth and (T + 1, 1) observations."""
    observation, info = env.reset(seed=0, options={"state": state})
    truths, observations = [info["ground_truth"]], [observation]
    for fraction in fractions:
        observation, *_, info = env.step(np.array([fraction], np.float32))
        truths.append(info["ground_truth"])
        observations.append(observation)
    return np.array(truths), np.array(observations)


def square_wave(num_steps, seed=0):
    levels = np.random.default_rng(seed).choice([-1.0, 0.0, 1.0], num_steps // 25)
    return np.repeat(levels, 25)


def turn_apart(a, b):
    return np.abs((a - b + np.pi) % (2 * np.pi) - np.pi)


def test_pendulum_passes_gymnasiums_checker(make):
    check_env(make(render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize("friction", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("is_driven", [False, True], ids=["free", "driven"])
@pytest.mark.parametrize(
    ("state", "atol_1s", "atol_10s"),
    [
        ((1.0, 0.0), SWING_1S, SWING_10S),
        ((-2.5, 3.0), SPIN_1S, SPIN_10S),
        ((0.3, 9.0), SPIN_1S, SPIN_10S),
    ],
)
def test_motion_is_that_of_runge_kutta(make, friction, is_driven, state, atol_1s, atol_10s):
    fractions = square_wave(500) if is_driven else np.zeros(500)
    truth, _ = run(make(friction=friction), state, fractions)
    expected = rk4_pendulum(*state, 5.0 * fractions, dt=0.02, friction=friction)
    error = np.stack(
        [turn_apart(truth[:, 0], expected[:, 0]), np.abs(truth[:, 1] - expected[:, 1])], -1
    )
    assert (error[:51].max(0) < atol_1s).all()
    assert (error.max(0) < atol_10s).all()


def test_frictionless_swing_keeps_its_energy(make):
    truth, _ = run(make(friction=0.0), (2.0, 0.0), np.zeros(3000))
    energy = truth[:, 1] ** 2 / 2 + 9.8 * (1 - np.cos(truth[:, 0]))
    np.testing.assert_allclose(energy, energy[0], atol=5e-3)  # of 13.9 J, over a minute


def test_small_swings_last_two_seconds(make):
    truth, _ = run(make(friction=0.0), (0.02, 0.0), np.zeros(500))
    returns = np.flatnonzero((truth[:-1, 1] > 0) & (truth[1:, 1] <= 0)) * 0.02
    np.testing.assert_allclose(np.diff(returns).mean(), 2 * math.pi / math.sqrt(9.8), atol=0.01)


def test_motor_cannot_hold_the_rod_level_but_swings_it_up(make):
    env = make()
    steady, _ = run(env, (0.0, 0.0), np.ones(400))
    assert np.abs(steady[:, 0]).max() < math.pi / 2
    _, info = env.reset(seed=0, options={"state": (0.01, 0.0)})
    highest = 0.0
    for _ in range(1000):  # push along the velocity
        *_, info = env.step(np.array([np.sign(info["ground_truth"][1])]))
        highest = max(highest, abs(info["ground_truth"][0]))
    assert highest > 3.0


def test_observation_is_the_angle_from_hanging_alone(make):
    env = make()
    for angle, expected in [(0.0, 0.5), (math.pi / 2, 0.75), (-math.pi / 2, 0.25), (3.1, 0.9934)]:
        observation, info = env.reset(options={"state": (angle, 7.0)})
        assert observation.shape == (1,)
        assert observation.dtype == np.float32
        np.testing.assert_allclose(observation, [expected], atol=1e-4)
        np.testing.assert_allclose(info["ground_truth"], [angle, 7.0], atol=1e-9)
    truth, observations = run(env, (3.0, 6.0), np.ones(500))
    np.testing.assert_allclose(observations[:, 0], (truth[:, 0] + np.pi) / (2 * np.pi), atol=1e-6)
    assert truth.dtype == np.float64
    assert (np.abs(np.diff(observations[:, 0])) > 0.5).any()  # it went over the top
    assert truth[:, 0].min() >= -math.pi
    assert truth[:, 0].max() < math.pi


def test_angles_of_several_turns_are_wrapped(make):
    _, info = make().reset(options={"state": (0.5 + 6 * math.pi, 0.0)})
    np.testing.assert_allclose(info["ground_truth"], [0.5, 0.0], atol=1e-9)


def test_spin_is_not_clamped_at_bullets_default(make):
    truth, _ = run(make(friction=0.0, max_torque=100.0), (0.0, 150.0), np.ones(10))
    assert truth[-1, 1] > 160


def test_it_starts_hanging_at_rest_and_episodes_do_not_end(make):
    env = make()
    observation, info = env.reset(seed=0)
    assert observation == np.float32(0.5)
    np.testing.assert_array_equal(info["ground_truth"], [0.0, 0.0])
    for _ in range(1500):
        _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        assert (reward, terminated, truncated) == (0.0, False, False)


def test_max_torque_scales_the_action_which_is_clipped(make):
    weak, _ = run(make(max_torque=2.0), (0.0, 0.0), np.ones(20))
    strong, _ = run(make(max_torque=4.0), (0.0, 0.0), np.full(20, 0.5))
    np.testing.assert_array_equal(weak, strong)
    beyond, _ = run(make(max_torque=2.0), (0.0, 0.0), np.full(20, 3.0))
    np.testing.assert_array_equal(weak, beyond)


def test_same_state_same_run_in_two_worlds(make):
    one, _ = run(make(), (1.0, 0.0), square_wave(200))
    make().reset(seed=5)
    other, _ = run(make(), (1.0, 0.0), square_wave(200))
    np.testing.assert_array_equal(one, other)


def test_close_may_be_called_twice():
    env = TorquePendulumEnv()
    env.close()
    env.close()


def test_picture_shows_the_bob_where_it_is(make):
    env = make(render_mode="rgb_array")
    env.reset(options={"state": (math.pi / 2, 0.0)})
    picture = env.render()
    assert picture.shape == (240, 240, 3)
    assert picture.dtype == np.uint8
    red, _, blue = picture[120, 216].astype(int)  # level, to the right
    assert red - blue > 100


@pytest.mark.parametrize("action", [[], [0.0, 0.0], 0.5, [math.nan], [math.inf], ["up"], None])
def test_bad_actions_are_refused(make, action):
    env = make().unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match="one finite number"):
        env.step(action)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"state": (1.0,)}, "two finite numbers"),
        ({"state": (1.0, math.nan)}, "two finite numbers"),
        ({"state": "up"}, "two finite numbers"),
        ({"state": (1.0, 2000.0)}, "at most 1000"),
        ({"position": (1.0, 2.0)}, "unknown"),
    ],
)
def test_bad_reset_options_are_refused(make, options, message):
    with pytest.raises(ValueError, match=message):
        make().reset(options=options)


@pytest.mark.parametrize(
    "options", [{"friction": -0.1}, {"friction": math.nan}, {"max_torque": 0.0}]
)
def test_bad_arguments_are_refused(make, options):
    with pytest.raises(ValueError, match=next(iter(options))):
        make(**options)
