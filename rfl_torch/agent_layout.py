"""What a file of an agent must hold before an agent is built from it.

A file is a stranger's word: every size, index and sign that the agent relies on is looked at here.
"""

import math

import torch
from torch import Tensor

from rfl_torch.checkpoint import Layout, check_index, check_layout
from rfl_torch.config import AgentConfig
from rfl_torch.executor import BLAME_LIMIT
from rfl_torch.hmm import MAX_READING
from rfl_torch.innate import directions

MOST_ACTIONS = 1024
"""Numbers in an action at most, of an agent from a file."""

MOST_CELLS, MOST_CELLS_A_NODE = 10_000, 100
"""A file's lattice may have so many cells, or so many for each node that is left: all take memory,
whether a node is left in them or not."""

MEMORY_LAYOUT: Layout = {
    "memory.observation": (torch.float32, "QD"),
    "memory.action": (torch.float32, "QA"),
    "memory.node": (torch.int64, "Q"),
    "memory.start": (torch.int64, "L"),
    "memory.settled": (torch.int64, ""),
}

FREE_WAYS_LAYOUT: Layout = {
    "free_ways.weight": (torch.float64, "JW"),
    "free_ways.still": (torch.float64, ""),
    "positions": (torch.float64, "NA"),
}

CONTACT_LAYOUT: Layout = {
    "contact.threshold": (torch.float64, "BD"),
    "contact.side": (torch.float64, "BD"),
}
"""Not in files of versions that didn't learn it."""

LAYOUT: Layout = {
    "hmm.successor": (torch.int64, "NK"),
    "hmm.successor_mask": (torch.bool, "NK"),
    "hmm.cell": (torch.int64, "N"),
    "hmm.transition_logits": (torch.float64, "NK"),
    "hmm.initial_logits": (torch.float64, "N"),
    "hmm.emission_mean": (torch.float64, "ND"),
    "hmm.emission_log_scale": (torch.float64, "ND"),
    "edges.pair": (torch.int64, "E2"),
    "edges.count": (torch.float64, "E"),
    "blame.pair": (torch.int64, "F2"),
    "blame.factor": (torch.float64, "F"),
    "tried": (torch.float64, "NW"),
    "look_radius": (torch.float64, ""),
    "least_familiar": (torch.float64, ""),
    "is_reversible": (torch.bool, ""),
    "observation_low": (torch.float64, "R"),
    "observation_scale": (torch.float64, "R"),
    "observation_period": (torch.float64, "R"),
    "action_low": (torch.float32, "A"),
    "action_high": (torch.float32, "A"),
    "samples.observation": (torch.float32, "MD"),
    "samples.target": (torch.float32, "MD"),
    "samples.action": (torch.float32, "MA"),
    "samples.node": (torch.int64, "M"),
}
"""What a file holds of every agent: N nodes, D readings in use of R, A actions."""

BANK_LAYOUTS: dict[str, Layout] = {
    "rbf": {
        "bank.center": (torch.float32, "NCI"),
        "bank.bandwidth": (torch.float32, "N"),
        "bank.weight": (torch.float32, "NPA"),
        "bank.bias": (torch.float32, "NA"),
    },
    "mlp": {
        "bank.hidden_weight": (torch.float32, "NIH"),
        "bank.hidden_bias": (torch.float32, "NH"),
        "bank.linear_weight": (torch.float32, "NDA"),
        "bank.action_weight": (torch.float32, "NHA"),
        "bank.action_bias": (torch.float32, "NA"),
    },
    "svr": {
        "bank.support_input": (torch.float64, "NSI"),
        "bank.target": (torch.float64, "NSA"),
        "bank.dual_coef": (torch.float64, "NSA"),
        "bank.bias": (torch.float64, "NA"),
        "bank.num_samples": (torch.int64, "N"),
    },
}
"""And of its bank."""


def check_state(state: dict[str, Tensor], config: AgentConfig) -> dict[str, int]:
    """Make sure that a file's tensors fit together; returns the sizes of `LAYOUT`.

    Raises:
        ValueError: saying which tensor doesn't fit and why.
    """
    layout = dict(LAYOUT)
    if "statistics" in state:
        layout["statistics"] = (torch.float64, "x")
    if "counts.weight" in state:
        layout |= {f"counts.{x}": (torch.float64, "ND") for x in ("weight", "first", "second")}
    if "memory.node" in state:
        layout |= MEMORY_LAYOUT
    if "free_ways.weight" in state:
        layout |= FREE_WAYS_LAYOUT
        if "contact.side" in state:
            layout |= CONTACT_LAYOUT
    layout |= BANK_LAYOUTS[config.controller]
    sizes = check_layout(state, layout)
    num_nodes, obs_dim, action_dim = (sizes[letter] for letter in "NDA")
    if min(num_nodes, obs_dim, action_dim) < 1 or action_dim > MOST_ACTIONS:
        raise ValueError(
            f"has {num_nodes} nodes, {obs_dim} readings and {action_dim} actions; needs at "
            f"least one of each and at most {MOST_ACTIONS} actions"
        )
    if sizes["I"] != 2 * obs_dim or sizes.get("P", 0) not in (0, sizes.get("C", 0) + obs_dim):
        raise ValueError(f"the bank's inputs don't fit {obs_dim} readings")
    for name in ("edges.pair", "blame.pair", "samples.node"):
        check_index(name, state[name], num_nodes)
    if "memory.node" in state:
        check_index("memory.node", state["memory.node"], num_nodes)
        check_index("memory.start", state["memory.start"], sizes["Q"])
        check_index("memory.settled", state["memory.settled"], sizes["Q"] + 1)
        begin = state["memory.start"].tolist()
        if begin[:1] != [0] or begin != sorted(set(begin)):
            raise ValueError("memory.start doesn't ascend from 0")
    if "bank.num_samples" in state:
        check_index("bank.num_samples", state["bank.num_samples"], sizes["S"] + 1)
    if sizes["2"] != 2:
        raise ValueError(f"edges.pair has {sizes['2']} columns, needs 2")
    if sizes["W"] != len(directions(action_dim)):
        raise ValueError(f"tried has {sizes['W']} columns, needs one a direction")
    for name in (
        "edges.count",
        "tried",
        "observation_scale",
        "observation_period",
        "counts.weight",
        "look_radius",
        "free_ways.still",
    ):
        if name in state and (state[name] < 0).any():
            raise ValueError(f"{name} has a number below zero")
    if "free_ways.weight" in state and sizes["J"] != obs_dim + 1:
        raise ValueError(f"free_ways.weight has {sizes['J']} rows, needs {obs_dim + 1}")
    if "contact.side" in state and sizes["B"] != 2 * action_dim:
        raise ValueError(f"contact.side has {sizes['B']} rows, needs {2 * action_dim}")
    if state["look_radius"] == 0:
        raise ValueError("look_radius is 0")
    factor = state["blame.factor"]
    if ((factor < 0.99) | (factor > 1.01 * BLAME_LIMIT)).any():
        raise ValueError(f"blame.factor has numbers outside 1 to {BLAME_LIMIT:g}")
    if state["hmm.emission_log_scale"].abs().max() > 100:
        raise ValueError("hmm.emission_log_scale has numbers beyond 100")
    for name in ("hmm.emission_mean", "free_ways.weight", "contact.threshold", "positions"):
        if name in state and state[name].abs().max() > MAX_READING:
            raise ValueError(f"{name} has numbers beyond {MAX_READING:g}")
    if (state["action_low"] > state["action_high"]).any():
        raise ValueError("action_low is above action_high")
    num_used = int((state["observation_scale"] > 0).sum())
    if num_used + int((state["observation_period"] > 0).sum()) != obs_dim:
        raise ValueError(f"observation_scale doesn't have {obs_dim} readings in use")
    cells = math.prod(config.shape)
    if cells > MOST_CELLS and cells > MOST_CELLS_A_NODE * num_nodes:
        raise ValueError(f"its lattice of {config.shape} has {cells} cells for {num_nodes} nodes")
    return sizes
