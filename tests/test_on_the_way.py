"""Learning from tasks, between them."""

import gymnasium as gym
import numpy as np
import pytest

import sims  # noqa: F401  registers the maze
from experiments import scoring
from experiments.on_the_way import Learner, Watched
from experiments.scoring import MAZE, Task
from rfl_torch import Agent, AgentConfig, Stage, record
from rfl_torch.practice import LEARN_EVERY

STAGES = (Stage(3, 60, (0.01, 1.0), pseudo_count=0.01, min_scale=0.05, tolerance=0.0),)


@pytest.fixture(scope="module")
def log():
    with gym.make("rfl/RangefinderMaze-v0", layout="paper") as env:
        return record(env, 2000, hold=3, seed=0)


@pytest.fixture
def agent(log):
    return Agent(AgentConfig(shape=(8, 8), stages=STAGES)).fit(log)


def test_what_was_done_in_tasks_is_kept_without_gaps_and_without_what_a_reset_leaves_out():
    env = Watched(gym.make("rfl/RangefinderMaze-v0", layout="paper"))
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.array([1.0, 0.0], np.float32))
    (first,) = env.take()
    env.step(np.array([0.0, 1.0], np.float32))
    env.reset(options={"position": (480, 540)})
    env.step(np.array([0.0, -1.0], np.float32))
    env.reset()
    second, third = env.take()
    assert [log.num_steps for log in (first, second, third)] == [3, 1, 1]
    np.testing.assert_array_equal(second.observations[0], first.observations[-1])
    np.testing.assert_allclose(third.ground_truth, [[480, 540], [480, 530]])
    np.testing.assert_array_equal(second.actions, [[0.0, 1.0]])
    assert env.take() == []


def test_a_choice_among_actions_is_kept_as_logs_have_it():
    env = Watched(gym.make("CartPole-v1"))
    env.reset(seed=0)
    env.step(1)
    (log,) = env.take()
    np.testing.assert_array_equal(log.actions, [[0.0, 1.0]])
    assert log.ground_truth is None


@pytest.mark.parametrize("is_truth_known", [True, False])
def test_a_goal_stays_where_it_was_when_the_map_is_laid_out_anew(agent, log, is_truth_known):
    """From anywhere in the room, most of which the log does not know."""
    table = scoring.node_table(agent, [log], MAZE)
    rng, before, num_steps = np.random.default_rng(0), agent.positions, len(agent.memory.node)
    tasks = scoring.node_tasks(np.arange(agent.num_nodes), table, 8, rng)
    with gym.make("rfl/RangefinderMaze-v0", layout="paper") as env:
        tasks = scoring.from_anywhere(tasks, env, None, rng)
        watched, calls = Watched(env), []
        known = ([log], MAZE) if is_truth_known else ([], None)
        learner = Learner(agent, watched, *known, lambda: calls.append(agent.num_nodes))
        trials = list(scoring.run_tasks(watched, agent, learner.between(tasks), MAZE, None, 0))
    assert len(trials) == 8
    done = sum(trial.outcome.num_steps for trial in trials)
    assert sum(part.num_steps for part in learner.logs[len(known[0]) :]) == done
    assert len(agent.memory.node) == num_steps + done + len(learner.logs[len(known[0]) :])
    assert calls[-1] == agent.num_nodes > len(before) + 20
    assert done / LEARN_EVERY >= len(calls) - 1 > 0  # between tasks, and once at the end
    assert learner.seconds > 0
    (again,) = learner.between(tasks[:1])
    if is_truth_known:
        now = scoring.node_table(agent, [log], MAZE).mean[again.goal]
        assert np.linalg.norm(now - tasks[0].target) < 22  # millimetres: half of what is allowed
    else:
        away = agent.positions[again.goal] - before[tasks[0].goal]
        assert np.linalg.norm(away) < 2.2  # full actions of 10 mm
    (unknown,) = learner.between([tasks[0]._replace(target=np.full(2, np.nan))])
    away = agent.positions[unknown.goal] - before[tasks[0].goal]
    assert np.linalg.norm(away) < 2.2  # where no log was, by the map
    sight = log.observations[0]
    (place,) = learner.between([Task(sight, None)])
    assert place.goal is sight
