"""`experiments.export`: what other programs read is what the agent has."""

import json
import subprocess
import sys

import networkx as nx
import numpy as np
import pytest
import torch
from worlds import dot_config, dot_log

from experiments import cli, export, scoring
from rfl_torch import Agent, Trajectory
from rfl_torch.agent import make_bank


@pytest.fixture(scope="module")
def log():
    return dot_log(1200)


@pytest.fixture(scope="module")
def agents(log):
    """One of each kind of controllers; the first one's log has a reading that never changes."""
    wide = np.insert(log.observations, 1, 0.5, axis=1)
    with pytest.warns(UserWarning, match="never change"):
        first = Agent(dot_config(shape=(4, 4))).fit(Trajectory(wide, log.actions, *log.bounds))
    made = {"rbf": first}
    generator = torch.Generator().manual_seed(0)
    inputs, targets = torch.rand(200, 8, generator=generator), torch.rand(200, 2)
    for kind in ("svr", "mlp"):
        agent = Agent(dot_config(shape=(4, 4))).fit(log)
        torch.manual_seed(0)
        agent.bank = make_bank(kind, agent.num_nodes, 4, 2)  # trained a little: that is slow
        node = torch.arange(200) % agent.num_nodes
        agent.bank.fit(inputs, targets, node, **({"num_steps": 5} if kind == "mlp" else {}))
        agent.config = dot_config(shape=(4, 4), controller=kind)
        made[kind] = agent
    return made


def test_both_files_hold_the_planned_graph(agents, log, tmp_path):
    agents["svr"].save(tmp_path / "dot.safetensors")
    agent = Agent.load(tmp_path / "dot.safetensors")
    log.save(tmp_path / "log.npz")
    export.main(
        export.Config(
            tmp_path / "dot.safetensors",
            graphml=tmp_path / "dot.graphml",
            json=tmp_path / "dot.json",
            log=(str(tmp_path / "log.npz"),),
        )
    )
    one = nx.read_graphml(tmp_path / "dot.graphml", node_type=int)
    two = nx.node_link_graph(json.loads((tmp_path / "dot.json").read_text()), edges="edges")
    assert dict(one.nodes(data=True)) == dict(two.nodes(data=True))
    assert list(one.edges(data=True)) == list(two.edges(data=True))
    costs = scoring.planning_graph(agent)
    assert sorted(one.edges) == sorted(zip(*(c.tolist() for c in costs.nonzero()), strict=True))
    probability = agent.hmm.transition_matrix().detach()
    for source, target, edge in one.edges(data=True):
        assert edge["cost"] == costs[source, target]
        assert edge["probability"] == pytest.approx(float(probability[source, target]))
    table = scoring.node_table(agent, [log], scoring.World("", 0, (1.0, 1.0), 2))
    path, means = agent.recognize(log.observations), agent.hmm.emission_mean.detach().numpy()
    away = []
    for node, values in one.nodes(data=True):
        assert values["true_place"]
        np.testing.assert_allclose([values["x"], values["y"]], table.mean[node])
        reading = [values[f"reading_{k}"] for k in range(4)]
        np.testing.assert_allclose(reading, agent.readings.restore(means[node]), rtol=1e-6)
        away.append(np.abs(log.observations[path == node].mean(0) - reading).max())
    assert np.quantile(away, 0.9) < 0.1
    steps = list(zip(path[:-1].tolist(), path[1:].tolist(), strict=True))
    for source, target, edge in one.edges(data=True):
        assert edge["seen"] == steps.count((source, target))


def test_without_ground_truth_nodes_are_placed_by_the_graph(agents):
    graph = export.map_graph(agents["rbf"])
    assert not any(values["true_place"] for _, values in graph.nodes(data=True))
    assert {"reading_0", "reading_2"} <= set(graph.nodes[0])
    assert "reading_1" not in graph.nodes[0]  # it never changed, and was left out


@pytest.mark.filterwarnings("ignore")  # of torch.export, about its own insides
@pytest.mark.parametrize("kind", ["rbf", "mlp", "svr"])
def test_the_exported_controllers_answer_as_the_agent_does(agents, log, tmp_path, kind):
    agent = agents[kind]
    agent.save(tmp_path / "a.safetensors")
    path = tmp_path / "a.pt2"
    export.main(export.Config(tmp_path / "a.safetensors", controllers=path))
    control = torch.export.load(path).module()
    observations = log.observations.copy()
    if kind == "rbf":
        observations = np.insert(observations, 1, 0.5, axis=1)
    observations[5, 0] = np.nan
    for step, node in ((3, 0), (5, 1), (700, agent.num_nodes - 1)):
        expected = agent.control(agent.readings.normalize(observations[step]), node)
        answer = control(torch.from_numpy(observations[step]), torch.tensor(node))
        np.testing.assert_allclose(answer.numpy(), expected, atol=1e-5)


@pytest.mark.filterwarnings("ignore")
def test_the_exported_controllers_need_no_rfl_torch(agents, tmp_path):
    torch.export.save(export.export_controllers(agents["svr"]), tmp_path / "a.pt2")
    code = (
        "import sys, torch; control = torch.export.load('a.pt2').module();"
        "print(len(control(torch.zeros(4), torch.tensor(2))), 'rfl_torch' in sys.modules)"
    )
    printed = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert printed.stdout.split() == ["2", "False"]


def test_nothing_to_write_is_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["export", "--model", str(tmp_path / "a")])
    with pytest.raises(SystemExit) as end:
        cli.run(export.main, export.Config, export.__doc__)
    assert end.value.code == cli.BAD_INPUT
    assert "--graphml" in capsys.readouterr().err


def test_an_agent_that_looks_ahead_has_no_controllers_to_export(agents, monkeypatch):
    monkeypatch.setattr(type(agents["rbf"]), "motion", object())
    with pytest.raises(ValueError, match=r"^this agent chooses actions by looking ahead"):
        export.export_controllers(agents["rbf"])
