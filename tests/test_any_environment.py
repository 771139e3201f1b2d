"""Environments that were not written here: from their id to goals, by the commands alone."""

import re
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from PIL import Image

from experiments import cli, environments, execute, record, scoring, train
from rfl_torch import Agent, AgentConfig, Stage, read_logs
from rfl_torch.innate import check_spaces

SHORT = (Stage(2, 60, (0.05, 1.0), min_scale=0.02, tolerance=0.0), Stage(1, 10, min_scale=0.02))


@pytest.fixture(autouse=True)
def short_training(monkeypatch):
    monkeypatch.setattr(train, "CONFIGS", {"default": lambda: AgentConfig(stages=SHORT)})


def go(tmp_path, env, num_steps=600, side=5, trials=3, limit=10, hold=1, keys=()):
    """Record, train, execute."""
    log, model = tmp_path / "log.npz", tmp_path / "model.safetensors"
    kind = {"env": env, "observation_keys": keys}
    record.main(record.Config(out=log, num_steps=num_steps, hold=hold, **kind))
    train.main(train.Config(log=(str(log),), out=model, side=side))
    execute.main(execute.Config(model=model, trials=trials, limit=limit, hold=hold, **kind))
    return read_logs(log), Agent.load(model)


def shares(text):
    """What the table says: successes of the agent, believed and true, and of the random walk."""
    believed, true = re.search(r"^nodes +(\d+)/\d+ .*? +(\d+)/\d+ ", text, re.M).groups()
    (walk,) = re.search(r"^random walk +- +(\d+)/\d+ ", text, re.M).groups()
    return int(believed), int(true), int(walk)


def test_pendulum_reaches_more_goals_than_a_random_walk(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(train, "CONFIGS", {"default": AgentConfig})
    go(tmp_path, "Pendulum-v1", num_steps=6000, side=14, trials=60, limit=60)
    believed, true, walk = shares(capsys.readouterr().out)
    assert believed >= true > walk


@pytest.mark.parametrize(
    ("env", "readings", "actions"),
    [("MountainCarContinuous-v0", 2, 1), ("Acrobot-v1", 6, 3)],
)
def test_environments_are_driven_by_their_id(tmp_path, capsys, env, readings, actions):
    logs, agent = go(tmp_path, env, hold=4)
    assert sum(log.num_steps for log in logs) == 600
    assert logs[0].observations.shape[1] == readings
    assert agent.actions.rest.shape == (actions,)
    shares(capsys.readouterr().out)


@pytest.mark.filterwarnings("ignore")  # of Gymnasium-Robotics, about its other environments
def test_a_point_in_a_maze_is_driven_by_module_and_key(tmp_path, capsys):
    pytest.importorskip("gymnasium_robotics", reason="the extra `robotics` is not installed")
    env = "gymnasium_robotics:PointMaze_UMaze-v3"
    logs, _ = go(tmp_path, env, hold=10, keys=("observation",))
    assert [log.observations.shape for log in logs] == [(601, 4)]
    shares(capsys.readouterr().out)
    with cli.make_env(env) as bare, pytest.raises(ValueError, match="FilterObservation"):
        check_spaces(bare)


class Wandering:
    """An executor that never arrives, and keeps what it sees."""

    status, node, path, reason = "running", 0, (), ""

    def __init__(self):
        self.seen = []

    def act(self, observation):
        self.seen.append(observation)
        return np.array([0.0, 1.0])


def test_an_environment_films_itself(tmp_path):
    pytest.importorskip("pygame", reason="no pygame, with which CartPole-v1 draws itself")
    agent = SimpleNamespace(executor=lambda goal, seed: Wandering())
    trial = scoring.Trial(0, None, None, None)
    with cli.with_action_rows(cli.make_env("CartPole-v1", render_mode="rgb_array")) as env:
        execute.film(tmp_path / "way.gif", env, agent, trial, limit=5)
        height, width = env.render().shape[:2]
    with Image.open(tmp_path / "way.gif") as film:
        assert 3 < film.n_frames <= 6  # alike ones become one
        assert film.size == (320, round(320 * height / width))


def test_a_task_goes_on_when_the_cart_pole_falls():
    with cli.with_action_rows(cli.make_env("CartPole-v1")) as env:
        executor = Wandering()
        observation, info = env.reset(seed=0)
        outcome = scoring.run_task(env, executor, observation, info, limit=60)
        assert env.observation_space.contains(observation)
    assert outcome.num_steps == len(outcome.nodes) - 1 == 60
    tilt = np.abs(np.array(executor.seen)[:, 2])
    assert (tilt > 0.2).sum() > 3  # it fell several times, and stood again
    assert (tilt < 0.05).sum() > 3


class Spaces:
    """Something with spaces."""

    def __init__(self, observation, action):
        self.observation_space, self.action_space = observation, action


VECTOR = spaces.Box(-np.inf, np.inf, (3,))


@pytest.mark.parametrize(
    ("observation", "action", "remedy"),
    [
        (spaces.Box(0, 255, (64, 64, 3), np.uint8), VECTOR, "GrayscaleObservation"),
        (spaces.Dict({"a": VECTOR}), VECTOR, "--observation-keys"),
        (spaces.Discrete(4), VECTOR, "TransformObservation"),
        (spaces.Text(4), VECTOR, "TransformObservation"),
        (VECTOR, VECTOR, "RescaleAction"),
        (VECTOR, spaces.MultiDiscrete([2, 2]), "TransformAction"),
        (VECTOR, spaces.Dict({"a": VECTOR}), "TransformAction"),
    ],
)
def test_spaces_that_do_not_fit_are_refused_with_a_wrapper_that_exists(observation, action, remedy):
    with pytest.raises(ValueError, match=remedy) as refusal:
        check_spaces(Spaces(observation, action))
    for name in re.findall(r"\b\w+(?:Observation|Action)\b", str(refusal.value)):
        assert hasattr(gym.wrappers, name), name


def test_the_observed_measure_is_the_rms_over_known_readings_in_their_ranges(tmp_path):
    _, agent = go(tmp_path, "Pendulum-v1")
    mean = agent.hmm.emission_mean[3].detach().numpy()
    at_node = agent.readings.low + mean * agent.readings.scale
    assert scoring.observed_distance(agent, at_node, 3) == pytest.approx(0.0, abs=1e-12)
    away = at_node + np.array([0.3, 0.0, 0.4]) * agent.readings.scale
    assert scoring.observed_distance(agent, away, 3) == pytest.approx(0.5 / 3**0.5)
    away[0] = np.nan
    assert scoring.observed_distance(agent, away, 3) == pytest.approx(0.4 / 2**0.5)


def test_near_is_within_the_nodes_width_for_the_agent_and_the_walk_alike(tmp_path):
    _, agent = go(tmp_path, "Pendulum-v1")
    with torch.no_grad():
        agent.hmm.emission_log_scale[3] = torch.tensor([0.3, 0.1, 0.2]).log()
        agent.hmm.emission_log_scale[4] = np.log(0.01)
    mean = agent.hmm.emission_mean.detach().numpy()
    width = ((0.3**2 + 0.1**2 + 0.2**2) / 3) ** 0.5

    def seen(node, away):
        return agent.readings.low + (mean[node] + away) * agent.readings.scale

    for node, limit in ((3, width), (4, scoring.OBSERVED_TOLERANCE)):
        assert scoring.observed_near(agent, seen(node, 0.99 * limit), node)
        assert not scoring.observed_near(agent, seen(node, 1.01 * limit), node)
    still = Still(seen(3, 0.99 * width))
    assert scoring.observed_walk_share(still, agent, [3, 4, 3], 5, 1, 0).share == 2 / 3
    (trial,) = scoring.run_tasks(
        still, Arrived(agent, 4), [scoring.Task(4, None)], None, None, 0, 5
    )
    assert trial.outcome.is_believed
    assert not trial.is_true
    (trial,) = scoring.run_tasks(
        still, Arrived(agent, 3), [scoring.Task(3, None)], None, None, 0, 5
    )
    assert trial.is_true


class Still:
    """A world in which nothing changes."""

    def __init__(self, observation):
        self.observation = observation

    def reset(self, **_):
        return self.observation, {}

    def step(self, _):
        return self.observation, 0.0, False, False, {}


class Arrived:
    """An agent that says at once that it is there."""

    def __init__(self, agent, node):
        self._agent, self._node = agent, node

    def __getattr__(self, name):
        return getattr(self._agent, name)

    def executor(self, goal, seed):
        own = SimpleNamespace(status="reached", goal=goal, node=self._node, path=[], reason="")
        own.act = lambda observation: self._agent.actions.rest
        return own


def test_one_command_prints_all_environments_against_the_random_walk(monkeypatch, capsys):
    monkeypatch.setattr(environments, "AgentConfig", lambda: AgentConfig((4, 4), stages=SHORT))
    few = [world for world in environments.WORLDS if ":" not in world.env_id][1:]
    monkeypatch.setattr(environments, "WORLDS", few)
    environments.main(environments.Config(seeds=1, num_steps=400, trials=3, limit=10))
    out = capsys.readouterr().out
    for world, kind in zip(few, ("Box", "Discrete"), strict=True):
        assert re.search(rf"^{world.env_id} +{kind} +\d/3 .* \d/3 ", out, re.M)


def test_the_worlds_of_the_table_babble_as_the_docs_say():
    docs = (Path(__file__).parents[1] / "docs" / "choosing.md").read_text()
    for world in environments.WORLDS:
        options = f"--hold {world.hold}"
        options += f" --levels {world.levels}" if world.levels else ""
        options += "".join(f" --observation-keys {key}" for key in world.observation_keys)
        assert f"| `{world.env_id}` | `{options}` |" in docs
