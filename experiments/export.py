"""Write a learned map for other programs, and the controllers for robots without this library.

python -m experiments.export --model maze.safetensors --graphml maze.graphml --json maze.json
python -m experiments.export --model maze.safetensors --controllers maze.pt2

GraphML opens in Gephi and NetworkX, the JSON is NetworkX's node-link form. The controllers become
one program of `torch.export`, which runs wherever PyTorch does, `rfl_torch` or not:

    control = torch.export.load("maze.pt2").module()
    action = control(observation, torch.tensor(next_node))    # (D,) as the robot senses, int64 ()

The recognition and the plan are no networks and are not in it: it answers which action heads for a
node, not which node is next.
"""

import copy
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import torch
from torch import Tensor, nn

from experiments import cli, scoring
from rfl_torch import Agent


@dataclass(frozen=True)
class Config:
    """Options of an export."""

    model: Path
    """Agent that `experiments.train` wrote."""
    graphml: Path | None = None
    """File for the map as GraphML."""
    json: Path | None = None
    """File for the map as JSON."""
    controllers: Path | None = None
    """File for the controllers as a program of torch.export (.pt2)."""
    log: tuple[str, ...] = ()
    """The training logs: with a ground truth, nodes are placed by it; without, from the graph."""
    observation_keys: tuple[str, ...] = ()
    """Where a data set's observations are a dictionary: the keys that the robot senses."""


def main(config: Config) -> None:
    """Write the files."""
    wanted = [path for path in (config.graphml, config.json, config.controllers) if path]
    if not wanted:
        raise ValueError("nothing to write; give --graphml, --json or --controllers.")
    for path in wanted:
        cli.check_writable(path)
    agent = Agent.load(config.model)
    graph = map_graph(agent, cli.read_all_logs(config.log, config.observation_keys))
    if config.graphml is not None:
        with cli.replacing(config.graphml) as new:
            nx.write_graphml(graph, new)
    if config.json is not None:
        with cli.replacing(config.json) as new:
            new.write_text(json.dumps(nx.node_link_data(graph, edges="edges")) + "\n")
    if config.controllers is not None:
        program = export_controllers(agent)
        with cli.replacing(config.controllers) as new:
            # Its name must end so, or torch refuses it.
            beside = new.with_name(new.name + ".pt2")
            torch.export.save(program, beside)
            beside.replace(new)
    print(
        f"{', '.join(map(str, wanted))}: {graph.number_of_nodes()} nodes, "
        f"{graph.number_of_edges()} edges"
    )


def map_graph(agent: Agent, logs: Any = ()) -> nx.DiGraph:
    """Return the map as a graph whose nodes and edges carry plain numbers.

    Nodes have `x` and `y`, `true_place` (whether these are ground truth), and `reading_k`, the mean
    readings in the log's units. Edges that are planned over have `cost`, `probability` of the
    transition a step, and `seen`, how often the log took them.
    """
    place, is_true = scoring.node_places(agent, list(logs), None)
    used = agent.readings.used
    mean = agent.readings.restore(agent.hmm.emission_mean.detach().numpy())
    graph = nx.DiGraph()
    for node in range(agent.num_nodes):
        readings = {f"reading_{k}": float(v) for k, v in zip(used, mean[node], strict=True)}
        known = np.isfinite(place[node]).all()
        spot = {"x": float(place[node, 0]), "y": float(place[node, 1])} if known else {}
        graph.add_node(node, **spot, true_place=is_true, **readings)
    probability = agent.hmm.transition_matrix().detach().numpy()
    seen = _seen(agent)
    edges = scoring.planning_graph(agent).tocoo()
    for source, target, cost in zip(*edges.coords, edges.data, strict=True):
        graph.add_edge(
            int(source),
            int(target),
            cost=float(cost),
            probability=float(probability[source, target]),
            seen=seen.get((int(source), int(target)), 0),
        )
    return graph


def _seen(agent: Agent) -> dict[tuple[int, int], int]:
    """How often the logs took each edge."""
    edges = agent.edges.tocoo()
    pairs = zip(edges.row.tolist(), edges.col.tolist(), strict=True)
    return dict(zip(pairs, edges.data.astype(int).tolist(), strict=True))


class Control(nn.Module):
    """f_j(o, mu_j) from what the robot senses to what it is told, as `Agent.control` computes it.

    Args:
        agent: whose controllers these are.
    """

    used: Tensor
    observation_low: Tensor
    observation_scale: Tensor
    mean: Tensor
    action_low: Tensor
    action_high: Tensor

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        used = agent.readings.used
        low, high = agent.actions
        buffers = {
            "used": used,
            "observation_low": agent.readings.low[used],
            "observation_scale": agent.readings.scale[used],
            "mean": agent.hmm.emission_mean.detach().numpy(),
            "action_low": low,
            "action_high": high,
        }
        for name, values in buffers.items():
            self.register_buffer(name, torch.as_tensor(np.array(values)))
        self.bank = copy.deepcopy(agent.bank).requires_grad_(False)

    def forward(self, observation: Tensor, node: Tensor) -> Tensor:
        """Action (A,) by which node () int64 is headed for from an observation (D,)."""
        normal = (observation.double()[self.used] - self.observation_low) / self.observation_scale
        mean = self.mean[node]
        normal = torch.where(normal.isnan(), mean, normal)
        inputs = torch.cat([normal, mean]).float()[None]
        offset = self.bank(inputs, node[None])[0] - 0.5
        offset = offset / (2 * offset.abs().max()).clamp(min=1.0)
        action = self.action_low + (offset + 0.5) * (self.action_high - self.action_low)
        return torch.clamp(action, self.action_low, self.action_high)


def export_controllers(agent: Agent) -> torch.export.ExportedProgram:
    """Return the controllers as a program.

    Raises:
        ValueError: if the agent doesn't act by controllers, or torch can't export this kind.
    """
    if agent.readings.period.any() or agent.motion is not None:
        raise ValueError(
            "this agent chooses actions by looking ahead; there is no network that answers for "
            "it. Leave --controllers out, and let the robot's loop call the agent's executor."
        )
    observation = torch.zeros(len(agent.readings.low))
    try:
        with torch.no_grad():
            return torch.export.export(Control(agent), (observation, torch.tensor(0)))
    except Exception as error:  # torch.export raises whatever it stumbles over
        first = str(error).strip().splitlines()[:1]
        raise ValueError(
            f"torch.export can't export controllers of the kind {agent.config.controller!r} "
            f"({' '.join(first)}); train with another kind, or run them with rfl_torch."
        ) from None


if __name__ == "__main__":
    cli.run(main, Config, __doc__)
