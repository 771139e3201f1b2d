"""The agent end to end on a world of a dot, and what it says to bad input."""

import dataclasses
import itertools
import json
import struct

import numpy as np
import pytest
import torch
from worlds import DotWorld, dot_config, dot_log

from rfl_torch import Agent, AgentConfig, ExecutorConfig, Trajectory

TOLERANCE = 0.17
"""Half of DotWorld's side over the side of its 6 x 6 grid, doubled: one node's width."""


@pytest.fixture(scope="module")
def log():
    return dot_log(3000)


@pytest.fixture(scope="module")
def agent(log):
    return Agent(dot_config()).fit(log)


def node_positions(agent, log):
    path = agent.recognize(log.observations)
    count = np.bincount(path, minlength=agent.num_nodes)[:, None]
    sums = np.zeros((agent.num_nodes, 2))
    np.add.at(sums, path, log.ground_truth)
    return sums / np.maximum(count, 1)


def drive(agent, goal, start, limit=300, executor=None):
    world = DotWorld()
    observation, info = world.reset(options={"position": start})
    executor = agent.executor(goal) if executor is None else executor
    actions = []
    for _ in range(limit):
        actions.append(executor.act(observation))
        if executor.status != "running":
            break
        observation, *_, info = world.step(actions[-1])
    return executor, info["ground_truth"], np.stack(actions)


def test_every_node_is_reached_in_truth(agent, log):
    position = node_positions(agent, log)
    rng = np.random.default_rng(0)
    outcomes = []
    for goal in range(agent.num_nodes):
        executor, end, _ = drive(agent, goal, rng.random(2))
        is_near = np.linalg.norm(end - position[goal]) < TOLERANCE
        outcomes.append(executor.status == "reached" and is_near)
    assert np.mean(outcomes) >= 0.95


@pytest.mark.parametrize("controller", ["mlp", "svr"])
def test_the_papers_procedure_reaches_nodes_with_every_bank(log, controller):
    config = dot_config(controller=controller, executor=ExecutorConfig(recognition="path"))
    agent = Agent(config).fit(log)
    position = node_positions(agent, log)
    outcomes = []
    for goal in range(0, agent.num_nodes, 3):
        executor, end, _ = drive(agent, goal, (0.5, 0.5))
        outcomes.append(
            executor.status == "reached" and np.linalg.norm(end - position[goal]) < 2 * TOLERANCE
        )
    assert np.mean(outcomes) >= 0.7


def test_an_observation_is_a_goal(agent):
    target = np.array([0.8, 0.3])
    observation, _ = DotWorld().reset(options={"position": target})
    executor, end, _ = drive(agent, observation, (0.1, 0.9))
    assert executor.status == "reached"
    assert np.linalg.norm(end - target) < TOLERANCE


def test_a_goal_that_looks_like_no_known_place_is_given_up_at_once(agent):
    executor, _, actions = drive(agent, np.full(4, 3.0, np.float32), (0.5, 0.5))
    assert executor.status == "gave_up"
    assert "no node looks like the goal" in executor.reason
    np.testing.assert_array_equal(actions, [agent.actions.rest])


def test_a_log_that_stays_at_one_node_leaves_a_robot_at_rest(log):
    short = Trajectory(log.observations[:41], log.actions[:40])
    config = dot_config(shape=(1, 1))
    agent = Agent(config).fit(short)
    executor = agent.executor(0)
    assert agent.num_nodes == 1
    np.testing.assert_array_equal(executor.act(log.observations[0]), agent.actions.rest)
    assert executor.status == "reached"


def test_a_predicate_is_a_goal_and_the_nearest_node_will_do(agent, log):
    position = node_positions(agent, log)
    executor, end, _ = drive(agent, lambda node: position[node, 0] > 0.75, (0.2, 0.2))
    assert executor.status == "reached"
    assert end[0] > 0.75 - TOLERANCE
    assert abs(end[1] - 0.2) < 0.4


def test_actions_stay_inside_the_action_space(agent):
    _, _, actions = drive(agent, 0, (0.9, 0.9))
    assert actions.dtype == np.float32
    assert (np.abs(actions) <= 1.0).all()


def test_a_robot_moved_in_mid_task_finds_itself_and_arrives(agent, log):
    position = node_positions(agent, log)
    goal = int(np.linalg.norm(position - [0.9, 0.9], axis=1).argmin())
    executor = agent.executor(goal)
    drive(agent, goal, (0.1, 0.1), limit=4, executor=executor)
    executor, end, _ = drive(agent, goal, (0.1, 0.9), executor=executor)
    assert executor.status == "reached"
    assert np.linalg.norm(end - position[goal]) < TOLERANCE


def test_a_goal_without_a_way_is_given_up_with_a_reason(agent):
    goal = 0
    blocked = dataclasses.replace(
        agent.config, executor=dataclasses.replace(agent.config.executor, max_plans=3)
    )
    cut = Agent(blocked)
    cut.__dict__ |= {k: v for k, v in agent.__dict__.items() if k != "config"}
    cut.graph = agent.graph.copy()
    cut.graph.data[cut.graph.indices == goal] = np.inf
    start = node_positions(agent, dot_log(3000))[agent.num_nodes - 1]
    executor, _, _ = drive(cut, goal, start, limit=2000)
    assert executor.status in ("gave_up", "reached")
    if executor.status == "gave_up":
        assert executor.reason


def test_belief_is_a_distribution_and_path_leads_to_the_goal(agent):
    executor, _, _ = drive(agent, 0, (0.9, 0.9), limit=5)
    np.testing.assert_allclose(executor.belief.sum(), 1.0, atol=1e-12)
    assert executor.path[0] == executor.node
    assert executor.path[-1] == 0
    successor, mask = agent.hmm.successor.numpy(), agent.hmm.successor_mask.numpy()
    for i, j in itertools.pairwise(executor.path):
        assert j in successor[i][mask[i]]


def test_a_saved_agent_acts_the_same(agent, tmp_path):
    agent.save(tmp_path / "dot.safetensors")
    back = Agent.load(tmp_path / "dot.safetensors")
    assert back.config == agent.config
    for goal in (0, 7):
        first, again = (drive(a, goal, (0.9, 0.1))[2] for a in (agent, back))
        np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize("controller", ["mlp", "svr"])
def test_every_bank_survives_a_checkpoint(log, tmp_path, controller):
    short = Trajectory(log.observations[:401], log.actions[:400])
    agent = Agent(dot_config(controller=controller)).fit(short)
    agent.save(tmp_path / "a.safetensors")
    back = Agent.load(tmp_path / "a.safetensors")
    for name, tensor in agent.bank.state_dict().items():
        torch.testing.assert_close(back.bank.state_dict()[name], tensor, atol=0, rtol=0)


def test_a_failed_save_leaves_the_old_file_whole(agent, tmp_path, monkeypatch):
    path = tmp_path / "dot.safetensors"
    agent.save(path)
    before = path.read_bytes()
    monkeypatch.setattr("rfl_torch.checkpoint.os.replace", _no_space)
    with pytest.raises(OSError, match="no space"):
        agent.save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def _no_space(*_):
    raise OSError("no space")


def test_damaged_checkpoints_are_refused_by_name(agent, tmp_path):
    path = tmp_path / "dot.safetensors"
    agent.save(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for case in range(60):
        cut = whole[: rng.integers(len(whole))] if case % 2 else bytearray(whole)
        if not case % 2:
            place = int(rng.integers(min(len(whole), 4000)))
            cut[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(cut))
        message = refusal(path)
        assert message is None or "dot.safetensors" in message
        assert message or not case % 2, "a file cut short was read"


def refusal(path):
    """Why a checkpoint is refused, or None: a changed number can leave a whole model."""
    try:
        Agent.load(path)
    except ValueError as error:
        return str(error)
    return None


def test_a_foreign_format_is_refused(tmp_path):
    header = json.dumps({"__metadata__": {"format": "other/9"}}).encode()
    path = tmp_path / "x.safetensors"
    path.write_bytes(struct.pack("<Q", len(header)) + header)
    with pytest.raises(ValueError, match="other/9"):
        Agent.load(path)


def test_configurations_survive_json():
    for config in (
        AgentConfig(),
        AgentConfig.smooth(),
        AgentConfig.paper(),
        AgentConfig.paper_pendulum(),
    ):
        assert AgentConfig.from_json(json.loads(json.dumps(config.to_json()))) == config
    with pytest.raises(ValueError, match="doesn't fit"):
        AgentConfig.from_json({"shape": [3, 3], "unknown": 1})


def test_the_paper_configuration_is_the_papers():
    config = AgentConfig.paper()
    assert config.shape == (20, 20)
    assert config.radius == 2.0
    assert config.start == "equal"
    assert [stage.stride for stage in config.stages] == [10, 5, 2, 1]
    assert all(s.iterations == 200 and s.trace and s.min_scale == 0.01 for s in config.stages)
    assert all(s.temperature == (1.0, 1.0) and s.pseudo_count == 0 for s in config.stages)
    assert config.horizon == 1
    assert config.executor.epsilon == 0.01


def test_same_seed_learns_the_same_tensors(log):
    short = Trajectory(log.observations[:501], log.actions[:500])
    first, again = (Agent(dot_config(), seed=3).fit(short) for _ in range(2))
    for name, tensor in first.hmm.state_dict().items():
        torch.testing.assert_close(again.hmm.state_dict()[name], tensor, atol=0, rtol=0)
    np.testing.assert_array_equal(first.bank.weight.detach(), again.bank.weight.detach())


def test_several_logs_are_learned_together(log):
    parts = [
        Trajectory(log.observations[a : b + 1], log.actions[a:b])
        for a, b in ((0, 1000), (1200, 1900), (2000, 2700))
    ]
    agent = Agent(dot_config()).fit(parts)
    assert agent.edges.sum() == 2400


@pytest.mark.parametrize("goal", [-1, 10_000])
def test_a_goal_that_is_no_node_is_refused(agent, goal):
    with pytest.raises(ValueError, match=f"goal {goal} is no kept node"):
        agent.executor(goal)


def test_goals_of_the_wrong_kind_are_refused(agent):
    with pytest.raises(ValueError, match="needs"):
        agent.executor(np.zeros(3, np.float32))
    with pytest.raises(ValueError, match="predicate"):
        agent.executor(lambda node: False)


def test_an_observation_of_the_wrong_shape_is_refused(agent):
    with pytest.raises(ValueError, match=r"needs \(\.\.\., 4\)"):
        agent.executor(0).act(np.zeros(5, np.float32))


def test_logs_that_cannot_be_learned_from_are_refused(log):
    constant = np.full_like(log.observations, 0.7)
    with pytest.raises(ValueError, match="no reading changes"):
        Agent(dot_config()).fit(Trajectory(constant, log.actions))
    with pytest.raises(ValueError, match="too few"):
        Agent(dot_config()).fit(Trajectory(log.observations[:6], log.actions[:5]))
    with pytest.raises(ValueError, match="same robot"):
        Agent(dot_config()).fit([log, Trajectory(log.observations[:, :3], log.actions)])
    with pytest.raises(ValueError, match="no log"):
        Agent(dot_config()).fit([])


def test_readings_that_never_change_are_left_out(agent, log, tmp_path):
    """The agent is then the one that never had them, but for the width that it takes in."""
    num = len(log.observations)
    columns = [np.full(num, 0.7), *log.observations.T, np.full(num, np.nan)]
    wide = Trajectory(np.stack(columns, 1), log.actions, *log.bounds)
    with pytest.warns(UserWarning, match=r"readings \[0, 5\] never change"):
        widened = Agent(dot_config()).fit(wide)
    torch.testing.assert_close(widened.hmm.emission_mean, agent.hmm.emission_mean, rtol=0, atol=0)
    widened.save(tmp_path / "wide.safetensors")
    again = Agent.load(tmp_path / "wide.safetensors")
    observation = wide.observations[7].copy()
    observation[[0, 5]] = -3.0  # a broken sensor that wakes up says nothing either
    action = again.executor(0).act(observation)
    np.testing.assert_array_equal(action, agent.executor(0).act(log.observations[7]))


def test_a_log_with_gaps_gives_controllers_that_answer(log):
    observations = log.observations.copy()
    observations[np.random.default_rng(0).random(len(observations)) < 0.1, 1] = np.nan
    gappy = Agent(dot_config()).fit(Trajectory(observations, log.actions, *log.bounds))
    assert all(torch.isfinite(value).all() for value in gappy.bank.state_dict().values())
    assert np.isfinite(gappy.executor(0).act(observations[0])).all()


def test_blame_is_bounded_and_success_takes_it_back(agent, log):
    blamed = Agent(agent.config)
    blamed.__dict__ |= {key: value for key, value in agent.__dict__.items() if key != "config"}
    blamed.graph = agent.graph.copy()
    blamed.map_cost = agent.graph.data.copy()
    mean = agent.hmm.emission_mean.detach().numpy()[-1]
    still = (mean * agent.readings.scale + agent.readings.low).astype(np.float32)
    for _ in range(40):  # the robot doesn't move, whatever it is told
        executor = blamed.executor(0)
        for _ in range(400):
            executor.act(still)
    ratio = blamed.graph.data / blamed.map_cost
    assert 1.0 < ratio.max() <= 100.0 + 1e-9
    raised = blamed.graph.data.copy()
    there = agent.recognize(log.observations) == agent.num_nodes - 1
    for goal in range(blamed.num_nodes):
        drive(blamed, goal, log.ground_truth[there].mean(0))
    was_blamed = raised > blamed.map_cost
    assert blamed.graph.data[was_blamed].sum() < raised[was_blamed].sum()
    assert (blamed.graph.data >= blamed.map_cost).all()
