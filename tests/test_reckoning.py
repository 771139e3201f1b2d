"""Where a robot is by what it did: against the definition, and in a hall where nothing shows."""

import json

import gymnasium as gym
import numpy as np
import pytest
from scipy.sparse import csr_array

import sims  # noqa: F401
from experiments import scoring
from rfl_torch import Agent, record
from rfl_torch.places import NODE_STEPS, within
from rfl_torch.reckoning import SLIP, WIDTH, Reckoning, mend

HALL = {
    "size": [200, 1400],
    "walls": [[60, 0, 60, 60], [140, 1340, 140, 1400]],
    "start": [100, 100],
}
"""Its ends, 500 mm of each, are in sight of one who stands there: 400 mm between see none."""


def line(num_nodes, spacing=3.0):
    """Nodes in a row, each with edges to its neighbours, that mostly stays where it is."""
    positions = np.zeros((num_nodes, 2))
    positions[:, 0] = spacing * np.arange(num_nodes)
    beside = np.arange(num_nodes - 1)
    pair = (np.append(beside, beside + 1), np.append(beside + 1, beside))
    edges = csr_array((np.ones(2 * num_nodes - 2), pair), shape=(num_nodes,) * 2)
    slipping = csr_array(0.9 * np.eye(num_nodes) + 0.05 * edges.toarray())
    return Reckoning(positions, edges, slipping), positions, edges, slipping


def test_a_push_is_what_the_definition_says():
    """To 1e-9, positions to 1e-6: the sums over all pairs of nodes, written out."""
    reckoning, positions, edges, slipping = line(7)
    rng = np.random.default_rng(0)
    belief = rng.dirichlet(np.ones(7))
    where, move = positions + rng.uniform(-1, 1, (7, 2)), np.array([0.7, -0.2])
    near = within(edges, 2).toarray()
    weight = np.exp(-((positions - (where + move)[:, None]) ** 2).sum(-1) / (2 * WIDTH**2)) * near
    share = (1 - SLIP) * belief[:, None] * weight / weight.sum(1, keepdims=True)
    slipped = SLIP * (slipping @ belief)
    expected = share.sum(0) + slipped
    at = (share.T @ (where + move) + slipped[:, None] * positions) / expected[:, None]
    half = NODE_STEPS / 2
    pushed, came = reckoning.push(belief, where, move)
    np.testing.assert_allclose(pushed, expected, atol=1e-9)
    np.testing.assert_allclose(came, np.clip(at, positions - half, positions + half), atol=1e-6)


def test_many_small_moves_add_up():
    """40 moves of 0.3 lead over four nodes of 3."""
    reckoning, positions, *_ = line(12)
    belief, where = np.eye(12)[2], positions.copy()
    for _ in range(40):
        belief, where = reckoning.push(belief, where, np.array([0.3, 0.0]))
    assert belief.sum() == pytest.approx(1.0, abs=1e-4)  # what is next to nothing is left out
    assert belief.argmax() == 6
    assert belief @ where[:, 0] == pytest.approx(18.0, abs=0.1)


def test_a_robot_that_was_put_elsewhere_is_in_the_middle_of_a_node():
    reckoning, positions, *_ = line(30)
    _, where = reckoning.push(np.eye(30)[2], positions, np.array([0.5, 0.0]))
    np.testing.assert_allclose(where[20], positions[20])


def test_a_robot_against_a_wall_moves_in_vain():
    reckoning, positions, *_ = line(5)
    belief, where = np.eye(5)[4], positions.copy()
    for _ in range(50):
        belief, where = reckoning.push(belief, where, np.array([1.0, 0.0]))
    assert belief.argmax() == 4
    assert where[4, 0] == positions[4, 0] + NODE_STEPS / 2


@pytest.mark.parametrize(
    ("asked", "done"),
    [
        ([0.1, 2.9], [0.2, 0.9]),  # the controller does both: as it says
        ([0.0, 0.1], [0.2, 3.0]),  # it leaves out the second: by dead reckoning
        ([0.1, -2.0], [0.2, 3.0]),  # or has it the wrong way round
    ],
)
def test_what_a_controller_leaves_out_of_the_way_is_mended(asked, done):
    action, way = np.array([0.2, 0.9]), np.array([0.1, 3.0])
    np.testing.assert_array_equal(mend(action, np.array(asked), way), done)


def test_halfway_along_a_hall_a_robot_knows_where_it_is(tmp_path):
    """From an end it truly reaches two thirds of the nodes there, and by what it sees alone few."""
    (tmp_path / "hall.json").write_text(json.dumps(HALL))
    with gym.make("rfl/RangefinderMaze-v0", layout=str(tmp_path / "hall.json")) as env:
        log = record(env, 10_000, hold=3, seed=0)
        agent = Agent().fit(log)
        table = scoring.node_table(agent, [log], scoring.MAZE)
        halfway = np.flatnonzero(np.abs(table.mean[:, 1] - 700) < 150)
        assert len(halfway) > 20
        rng = np.random.default_rng(0)
        reached = {}
        for reckoning in (agent.reckoning, None):
            agent.reckoning = reckoning
            tasks = scoring.node_tasks(halfway, table, 30, rng)
            tasks = [task._replace(start=np.array([100.0, 100.0])) for task in tasks]
            trials = scoring.run_tasks(env, agent, tasks, scoring.MAZE, log.ground_truth[-1], 0)
            reached[reckoning is not None] = sum(bool(trial.is_true) for trial in trials)
    assert reached[True] >= 20
    assert reached[False] <= 10
