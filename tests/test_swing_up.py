"""Others' environments without their velocities: what is shown, where a try starts and ends."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest

from experiments import foreign
from rfl_torch import AgentConfig, Stage


@pytest.mark.parametrize("name", ["pendulum", "mountain-car"])
def test_velocity_is_hidden_and_nothing_ends(name):
    world = foreign.WORLDS[name]
    with foreign.WithoutVelocity(gym.make(world.env_id, max_episode_steps=-1), world.shown) as env:
        observation, _ = env.reset(seed=0)
        assert observation.shape == env.observation_space.shape == (len(world.shown),)
        assert len(env.unwrapped.observation_space.low) == len(world.shown) + 1
        for _ in range(300):
            observation, reward, *ends, _ = env.step(env.action_space.high)
            assert reward == 0.0
            assert ends == [False, False]
            assert observation in env.observation_space


def test_a_try_starts_hanging_and_is_done_upright():
    world = foreign.WORLDS["pendulum"]
    with foreign.WithoutVelocity(gym.make(world.env_id, max_episode_steps=-1), world.shown) as env:
        np.testing.assert_allclose(foreign._start(env, "pendulum", 0), [-1, 0])
        assert not foreign._is_there(env, "pendulum")
        env.unwrapped.state = np.array([2 * np.pi - 0.29, 5.0])
        assert foreign._is_there(env, "pendulum")
        observation, *_ = env.step(np.zeros(1, np.float32))
        assert observation[0] > 0.8


def test_the_command_learns_tries_and_prints_shares(monkeypatch, capsys):
    def tiny():
        stage = Stage(1, 5, (0.1, 1.0), min_scale=0.1, pseudo_count=0.01)
        return dataclasses.replace(smooth(), shape=(5, 5), stages=(stage,))

    smooth = AgentConfig.smooth
    monkeypatch.setattr(AgentConfig, "smooth", tiny)
    foreign.main(foreign.Config("pendulum", num_steps=600, tries=2))
    out = capsys.readouterr().out
    assert "Pendulum-v1 without velocity, 600 random steps, 1 logs" in out
    assert "/2 " in out
