import itertools

import numpy as np
import pytest
from worlds import DotWorld, dot_config, dot_log

from rfl_torch import Agent, GridHMM, Trajectory, growth, repair


def tiny_map():
    path = np.array([0, 0, 1, 1, 2, 2, 1, 0, 1, 2, 2])
    counts = repair.Counts.of([path], [np.eye(3)[path]], 3)
    hmm = GridHMM((2, 2), 3)
    repair.rebuild(hmm, counts, False, 0.3, 0.01)
    return hmm


def test_recognition_finds_the_best_of_all_paths_with_jumps_and_unknown_steps():
    hmm = tiny_map()
    log_a = np.log(np.maximum(hmm.transition_matrix().detach().numpy(), 1e-300))
    rng = np.random.default_rng(0)
    jump, leave = growth.LOG_JUMP, growth.LOG_LEAVE
    for _ in range(20):
        rows, unknown = 12 * rng.standard_normal((5, 3)), 8 * rng.standard_normal(5)
        best, best_path = -np.inf, None
        for path in itertools.product(range(4), repeat=5):
            total = rows[0, path[0]] if path[0] < 3 else unknown[0]
            for t in range(1, 5):
                i, j = path[t - 1], path[t]
                if i < 3 and j < 3:
                    total += max(log_a[i, j], jump)
                elif i != j:
                    total += leave
                total += rows[t, j] if j < 3 else unknown[t]
            if total > best:
                best, best_path = total, path
        found = growth.recognize(hmm, rows, unknown)
        assert found.tolist() == [growth.UNKNOWN if node == 3 else node for node in best_path]


def test_unknown_steps_get_one_new_node_for_each_look():
    path = np.array([0, -1, -1, -1, 1, -1])
    seen = np.array([[9.0], [0.0], [0.01], [1.0], [9.0], [0.0]])
    found = growth.add_looks(path, seen, np.ones((5, 1), np.float32), 0.1, 2)
    assert found.tolist() == [0, 2, 2, 3, 1, 2]


def half_log(seed=0, num_steps=1500):
    """A walk in the left half of the square."""
    world = DotWorld()
    rng = np.random.default_rng(seed)
    observation, info = world.reset(options={"position": (0.25, 0.5)})
    seen, done, truth = [observation], [], [info["ground_truth"]]
    for _ in range(num_steps):
        action = rng.uniform(-1, 1, 2).astype(np.float32)
        if world.position[0] + 0.1 * action[0] > 0.5:
            action[0] = -abs(action[0])
        observation, *_, info = world.step(action)
        seen.append(observation)
        done.append(action)
        truth.append(info["ground_truth"])
    bounds = np.full(2, -1.0, np.float32), np.full(2, 1.0, np.float32)
    return Trajectory(np.stack(seen), np.stack(done), *bounds, np.stack(truth))


@pytest.fixture(scope="module")
def half_agent(tmp_path_factory):
    path = tmp_path_factory.mktemp("growth") / "half.safetensors"
    Agent(dot_config()).fit(half_log()).save(path)
    return path


def covered(agent, log):
    """Share of a grid over the square that some node of the recognised log lies near to."""
    nodes = agent.recognize(log.observations)
    mean = np.array([log.ground_truth[nodes == node].mean(0) for node in np.unique(nodes)])
    grid = np.stack(np.meshgrid(*[np.linspace(0.05, 0.95, 10)] * 2), -1).reshape(-1, 2)
    return (np.linalg.norm(grid[:, None] - mean, axis=-1).min(1) < 0.15).mean()


def test_more_data_adds_nodes_where_the_map_ended_and_keeps_those_it_had(half_agent):
    agent = Agent.load(half_agent)
    num_nodes, mean = agent.num_nodes, agent.hmm.emission_mean.detach().clone()
    steps = agent.edges.sum()
    log = dot_log(1500, seed=5)
    assert covered(agent, half_log(9)) == pytest.approx(0.55, abs=0.1)
    agent.partial_fit(log)
    assert agent.num_nodes > 1.25 * num_nodes
    assert agent.edges.sum() == steps + 1500
    moved = (agent.hmm.emission_mean.detach()[:num_nodes] - mean).abs().mean(1)
    assert (moved < agent.look_radius).all()
    assert covered(agent, log) > 0.9


def test_an_agent_that_was_saved_between_learns_the_same(half_agent, tmp_path):
    first, second = dot_log(400, seed=6), dot_log(400, seed=7)
    whole = Agent.load(half_agent).partial_fit(first)
    whole.save(tmp_path / "between.safetensors")
    again = Agent.load(tmp_path / "between.safetensors").partial_fit(second)
    whole.partial_fit(second)
    for name, value in whole.hmm.state_dict().items():
        assert (value == again.hmm.state_dict()[name]).all(), name
    assert (whole.edges != again.edges).nnz == 0
    assert (whole.tried == again.tried).all()
    for own, other in zip(whole.samples, again.samples, strict=True):
        assert (own == other).all()


def test_blame_outlives_saving_and_growing(half_agent, tmp_path):
    agent = Agent.load(half_agent)
    agent.graph.data[7] *= 9.0
    before = agent.blamed()
    assert [round(factor, 9) for *_, factor in before] == [9.0]
    agent.save(tmp_path / "blamed.safetensors")
    agent = Agent.load(tmp_path / "blamed.safetensors")
    agent.partial_fit(dot_log(300, seed=8))
    assert [x[:2] for x in agent.blamed()] == [x[:2] for x in before]


def test_a_grid_map_learns_more_by_accumulated_statistics():
    config = dot_config(repairs=False)
    agent = Agent(config).fit(dot_log(800, seed=1))
    num_nodes, num_steps = agent.num_nodes, agent.statistics.num_steps
    more = dot_log(700, seed=2)
    before = agent.hmm.log_likelihood(agent.readings.normalize(more.observations))
    agent.partial_fit(more)
    assert agent.num_nodes == num_nodes
    assert agent.statistics.num_steps == num_steps + 701
    assert agent.hmm.log_likelihood(agent.readings.normalize(more.observations)) > before


def test_a_log_of_another_robot_is_refused(half_agent):
    log = dot_log(50)
    with pytest.raises(ValueError, match=r"\(readings, actions\) \(3, 2\), needs \(4, 2\)"):
        Agent.load(half_agent).partial_fit(Trajectory(log.observations[:, :3], log.actions))


def test_every_node_of_a_repaired_map_is_on_its_logs_path_and_outlives_saving(tmp_path):
    log = dot_log(2500, seed=3)
    agent = Agent(dot_config(shape=(8, 8))).fit(log)
    assert (agent.visits[:-1] > 0).sum() >= agent.num_nodes - 2  # the last step leaves none
    assert agent.counts.num_nodes == agent.num_nodes
    agent.save(tmp_path / "agent.safetensors")
    again = Agent.load(tmp_path / "agent.safetensors")
    assert (again.recognize(log.observations) == agent.recognize(log.observations)).all()


def test_an_agent_learns_more_as_one_that_was_saved_and_loaded_before(tmp_path):
    kept = Agent(dot_config(shape=(8, 8))).fit(dot_log(2500, seed=3))
    kept.save(tmp_path / "agent.safetensors")
    loaded, more = Agent.load(tmp_path / "agent.safetensors"), dot_log(400, seed=6)
    kept.partial_fit(more)
    loaded.partial_fit(more)
    assert (kept.edges != loaded.edges).nnz == 0
    for name, value in kept.hmm.state_dict().items():
        assert (value == loaded.hmm.state_dict()[name]).all(), name


def test_fitting_again_forgets_what_was_learned_before():
    agent = Agent(dot_config()).fit(half_log())
    agent.executor(0).act(half_log().observations[0])
    again = agent.fit(dot_log(1500, seed=5))
    fresh = Agent(dot_config()).fit(dot_log(1500, seed=5))
    assert again.last_seen is None
    assert (again.statistics is None) == (fresh.statistics is None)
    for name, value in fresh.hmm.state_dict().items():
        assert (value == again.hmm.state_dict()[name]).all(), name


def test_a_map_of_fewer_nodes_forgets_what_was_blamed_on_those_that_are_gone(half_agent):
    agent = Agent.load(half_agent)
    last = agent.graph.indptr[-2]
    agent.graph.data[[0, last]] *= 9.0
    blamed = agent.blamed()
    agent._blame_again([*blamed, (agent.num_nodes, 0, 9.0)])
    assert agent.blamed() == blamed
