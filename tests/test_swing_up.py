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
    foreign.main(foreign.Config("pendulum", num_steps=600, tries=2, peer_steps=()))
    out = capsys.readouterr().out
    assert "Pendulum-v1 without velocity, 600 random steps, 1 logs" in out
    assert "/2 " in out


def pump(observation, memory):
    """Push where it swings to, which only the reading before tells."""
    angle = np.arctan2(observation[1], observation[0])
    swing = 0.0 if memory is None else (angle - memory + np.pi) % (2 * np.pi) - np.pi
    return np.array([2.0 if swing >= 0 else -2.0], np.float32), angle


@pytest.mark.parametrize(
    ("predict", "line"),
    [
        (pump, ["1/1", "0/1"]),
        (lambda observation, memory: (np.zeros(1, np.float32), memory), ["0/1", "0/1"]),
    ],
    ids=["pumps", "hangs"],
)
def test_a_peer_remembers_and_has_arrived_once_it_is_there(predict, line):
    world = foreign.WORLDS["pendulum"]
    row = foreign.Row("peer", "0")
    with foreign.WithoutVelocity(gym.make(world.env_id, max_episode_steps=-1), world.shown) as env:
        row.run(
            env,
            "pendulum",
            1,
            lambda seed: foreign.PeerExecutor(predict, env, "pendulum", seed),
            "",
        )
    arrived, held = (cell.split()[0] for cell in (row.cells()[2], row.cells()[4]))
    assert [arrived, held] == line


def test_the_peer_sees_no_velocity_but_the_reward():
    with foreign._with_reward(foreign.WORLDS["pendulum"]) as env:
        observation, _ = env.reset(seed=0)
        assert observation.shape == env.observation_space.shape == (2,)
        results = [env.step(np.zeros(1, np.float32)) for _ in range(200)]
    assert all(reward < 0 for _, reward, *_ in results)
    assert [truncated for *_, truncated, _ in results] == [False] * 199 + [True]


def test_the_peer_learns_and_is_given_at_each_number_of_steps():
    pytest.importorskip("sb3_contrib", reason="the extra `foreign` is not installed")
    world = dataclasses.replace(
        foreign.WORLDS["pendulum"], peer=foreign.PENDULUM_PEER | {"n_steps": 16}
    )
    given = []
    for steps, predict in foreign._train_peer(world, [50, 64, 100], seed=0):
        action, memory = predict(np.array([-1.0, 0.0], np.float32), None)
        assert action.shape == (1,)
        assert memory is not None
        given.append(steps)
    assert given == [64, 64, 128]
