"""One small controller per node, all evaluated and trained as one batch (section 2.4).

    u_t = f_j(o_t, o_t+1)        eq. 12, learned from the triplets that lead into node j
    u_t = f_j(o_t, mu_j)         the same function asked to reach the node's mean

A bank maps rows (o, o') of width 2 D to actions in [0, 1], 0.5 being the middle of the action
space. Banks share a signature, not a parent: `forward(inputs, node)`, `at(row, node)`, which is
the same for one row without PyTorch's overhead, half of a control step, and
`fit(inputs, targets, node)`; `SVRBank` in `online_svr` is the third.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

LEAST_SAMPLES = 8
"""A node with fewer samples borrows its neighbours' (see `pool_sparse_nodes`)."""

MOST_AT_ONCE = 1 << 14
"""Samples, with the padding, that are worked on at once: memory must not grow with the log."""


class Triplets(NamedTuple):
    """Samples (o_t, o_t+1, u_t) and the node whose controller each one trains.

    observation, target: (M, D) normalised; action: (M, A) in [0, 1]; node: int64 (M,).
    """

    observation: Tensor
    target: Tensor
    action: Tensor
    node: Tensor

    @property
    def inputs(self) -> Tensor:
        """Rows (o_t, o_t+1), (M, 2 D)."""
        return torch.cat([self.observation, self.target], 1)


def next_node_entered(path: Tensor) -> Tensor:
    """For each step of a most likely path, the next other node that it turns into; -1 if none."""
    turn = (path[1:] != path[:-1]).nonzero()[:, 0]
    entered = torch.cat([path[turn + 1], path.new_full((1,), -1)])
    return entered[torch.searchsorted(turn, torch.arange(len(path)))]


def assign_triplets(path: Tensor, observations: Tensor, actions: Tensor, horizon: int) -> Triplets:
    """Buffer triplets while a node wins and give them to the node that wins next.

    With `horizon` 1 this is the paper's assignment: (o_t, o_t+1, u_t). A longer horizon adds, as
    far as the buffer reaches, (o_t, o_t+k, sum of the k actions' offsets from the middle): at
    execution the goal mean is several steps away, and this is where such goals are learned.

    Args:
        path: most likely nodes, int64 (T+1,).
        observations: normalised, (T+1, D).
        actions: in [0, 1], (T, A).
        horizon: furthest target in steps.
    """
    entered = next_node_entered(path)
    num_steps = len(actions)
    total = torch.cat([torch.zeros_like(actions[:1]), (actions - 0.5).cumsum(0)])
    parts = []
    for k in range(1, horizon + 1):
        t = torch.arange(num_steps - k + 1)
        # The k steps stay inside the buffer: the node entered is the same until the last.
        is_inside = (entered[t] >= 0) & (entered[t] == entered[t + k - 1])
        t = t[is_inside]
        parts.append(
            (observations[t], observations[t + k], total[t + k] - total[t] + 0.5, entered[t])
        )
    return concatenate([Triplets(*part) for part in parts])


def assign_reversed(path: Tensor, observations: Tensor, actions: Tensor, horizon: int) -> Triplets:
    """The triplets of the log run backwards, with opposite actions: (o_t+1, o_t, 1 - u_t)."""
    return assign_triplets(path.flip(0), observations.flip(0), 1.0 - actions.flip(0), horizon)


def explained(bank: nn.Module, triplets: Triplets) -> float:
    """Share of the actions' variance that a bank predicts (R2), of medians instead of means.

    A robot that bumps into things moves as it was told most of the time, not all of it.
    """
    parts = [triplets.inputs, triplets.node, triplets.action]
    with torch.no_grad():
        error = torch.cat(
            [
                (bank(inputs, node) - action).square().sum(1)
                for inputs, node, action in zip(
                    *(x.split(MOST_AT_ONCE) for x in parts), strict=True
                )
            ]
        )
    return float(1 - error.median() / (triplets.action - 0.5).square().sum(1).median())


def concatenate(parts: list[Triplets]) -> Triplets:
    """All samples of several sets."""
    observation, target, action, node = zip(*parts, strict=True)
    return Triplets(torch.cat(observation), torch.cat(target), torch.cat(action), torch.cat(node))


def latest(triplets: Triplets, most: int) -> Triplets:
    """The last `most` triplets of each node, in their order."""
    order = triplets.node.argsort(stable=True)
    count = torch.bincount(triplets.node)
    from_end = count.cumsum(0)[triplets.node[order]] - torch.arange(len(order))
    kept = order[from_end <= most].sort().values
    return Triplets(*(field[kept] for field in triplets))


def pool_sparse_nodes(triplets: Triplets, neighbor: Tensor, neighbor_mask: Tensor) -> Triplets:
    """Lend a node with under LEAST_SAMPLES samples those of its graph neighbours.

    neighbor, neighbor_mask: (N, K), a successor table.
    """
    num_nodes = len(neighbor)
    count = torch.bincount(triplets.node, minlength=num_nodes)
    order = triplets.node.argsort(stable=True)
    first = torch.cat([torch.zeros(1, dtype=torch.int64), count.cumsum(0)])
    sample, node = [torch.arange(len(triplets.node))], [triplets.node]
    for poor in (count < LEAST_SAMPLES).nonzero()[:, 0].tolist():
        for rich in neighbor[poor][neighbor_mask[poor]].tolist():
            if rich != poor:
                borrowed = order[first[rich] : first[rich + 1]]
                sample.append(borrowed)
                node.append(torch.full_like(borrowed, poor))
    index = torch.cat(sample)
    observation, target, action = (field[index] for field in triplets[:3])
    return Triplets(observation, target, action, torch.cat(node))


class Padded(NamedTuple):
    """Samples grouped by node: inputs (N, M, I), targets (N, M, A), mask (N, M)."""

    inputs: Tensor
    targets: Tensor
    mask: Tensor


def group_by_node(inputs: Tensor, targets: Tensor, node: Tensor, num_nodes: int) -> Padded:
    """Lay samples out by node, padded to the fullest one."""
    count = torch.bincount(node, minlength=num_nodes)
    order = node.argsort(stable=True)
    first = count.cumsum(0) - count
    place = torch.arange(len(node)) - first[node[order]]
    width = int(count.max())
    padded_inputs = inputs.new_zeros(num_nodes, width, inputs.shape[1])
    padded_targets = targets.new_zeros(num_nodes, width, targets.shape[1])
    mask = torch.zeros(num_nodes, width, dtype=torch.bool)
    padded_inputs[node[order], place] = inputs[order]
    padded_targets[node[order], place] = targets[order]
    mask[node[order], place] = True
    return Padded(padded_inputs, padded_targets, mask)


def _array(parameter: Tensor, node: int) -> NDArray[np.float32]:
    """One node's part of a bank's parameter, not copied."""
    return parameter.detach().numpy()[node]


def nodes_of_a_size(node: Tensor, num_nodes: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Nodes (K,) with about as many samples each, and all their samples (M,), part by part.

    A few nodes have many more samples than most: padded to the fullest one of all, the samples of
    a practised map would be four times as many. Nodes without samples are left out.
    """
    count = torch.bincount(node, minlength=num_nodes)
    first, order = count.cumsum(0) - count, node.argsort(stable=True)
    by_size = count.argsort(stable=True)
    begin, sizes = int((count == 0).sum()), count[by_size].tolist()
    for end in range(begin + 1, num_nodes + 1):
        if end == num_nodes or sizes[end] * (end + 1 - begin) > MOST_AT_ONCE:
            part = by_size[begin:end].sort().values
            samples = [order[first[k] : first[k] + count[k]] for k in part.tolist()]
            yield part, torch.cat(samples)
            begin = end


class MLPBank(nn.Module):
    """N two-layer perceptrons with a linear path from (o' - o), one for each node.

    Weights carry the node as their first dimension, so a batch over many nodes is one product a
    layer and the optimiser sees five parameters whatever N is. A node without samples answers with
    the middle of the action space.
    """

    def __init__(self, num_nodes: int, obs_dim: int, action_dim: int, hidden_dim: int = 16) -> None:
        super().__init__()
        self.obs_dim = obs_dim
        self.hidden_weight = nn.Parameter(torch.randn(num_nodes, 2 * obs_dim, hidden_dim))
        self.hidden_bias = nn.Parameter(torch.zeros(num_nodes, hidden_dim))
        self.linear_weight = nn.Parameter(torch.zeros(num_nodes, obs_dim, action_dim))
        self.action_weight = nn.Parameter(torch.zeros(num_nodes, hidden_dim, action_dim))
        self.action_bias = nn.Parameter(torch.full((num_nodes, action_dim), 0.5))
        with torch.no_grad():
            self.hidden_weight.mul_((2 * obs_dim) ** -0.5)

    def forward(self, inputs: Tensor, node: Tensor) -> Tensor:
        """Actions (B, A) that the nodes (B,) ask for at rows (o, o') (B, 2 D)."""
        hidden = torch.einsum("bi,bih->bh", inputs, self.hidden_weight[node])
        hidden = torch.tanh(hidden + self.hidden_bias[node])
        difference = inputs[:, self.obs_dim :] - inputs[:, : self.obs_dim]
        linear = torch.einsum("bd,bda->ba", difference, self.linear_weight[node])
        action = torch.einsum("bh,bha->ba", hidden, self.action_weight[node])
        return action + linear + self.action_bias[node]

    def at(self, row: NDArray[np.float32], node: int) -> NDArray[np.float32]:
        """Action (A,) that a node asks for at a row (o, o') (2 D,)."""
        hidden = row @ _array(self.hidden_weight, node) + _array(self.hidden_bias, node)
        action = np.tanh(hidden) @ _array(self.action_weight, node)
        difference = row[self.obs_dim :] - row[: self.obs_dim]
        linear = difference @ _array(self.linear_weight, node)
        return action + linear + _array(self.action_bias, node)

    def fit(
        self,
        inputs: Tensor,
        targets: Tensor,
        node: Tensor,
        num_steps: int = 300,
        decay: float = 1e-3,
    ) -> float:
        """Train every node on its own samples by Adam; returns the mean squared error."""
        data = group_by_node(inputs, targets, node, len(self.hidden_weight))
        # Decayed biases would pull a node without samples away from rest.
        weights = [self.hidden_weight, self.linear_weight, self.action_weight]
        biases = [self.hidden_bias, self.action_bias]
        groups: list[dict[str, Any]] = [
            {"params": weights, "weight_decay": decay},
            {"params": biases},
        ]
        optimizer = torch.optim.AdamW(groups, lr=0.01, weight_decay=0.0)
        difference = data.inputs[..., self.obs_dim :] - data.inputs[..., : self.obs_dim]
        weight = data.mask[..., None] / data.mask.sum(1).clamp(min=1)[:, None, None]
        for _ in range(num_steps):
            hidden = torch.tanh(data.inputs @ self.hidden_weight + self.hidden_bias[:, None])
            action = hidden @ self.action_weight + difference @ self.linear_weight
            error = action + self.action_bias[:, None] - data.targets
            loss = (error.square() * weight).sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        total = (error.detach().square() * data.mask[..., None]).sum()
        return float(total / (data.mask.sum() * targets.shape[1]))


class RBFBank(nn.Module):
    """N networks of radial basis functions around the node's own samples, with a linear part.

    The centres are up to `num_centers` of the node's samples; the weights are the ridge solution,
    so training is one batched linear solve. Ridge on the linear part is weaker than on the bumps:
    what lies beyond the samples is extrapolated linearly.
    """

    def __init__(
        self, num_nodes: int, obs_dim: int, action_dim: int, num_centers: int = 16
    ) -> None:
        super().__init__()
        self.obs_dim = obs_dim
        self.center = nn.Parameter(torch.zeros(num_nodes, num_centers, 2 * obs_dim))
        self.bandwidth = nn.Parameter(torch.ones(num_nodes))
        self.weight = nn.Parameter(torch.zeros(num_nodes, num_centers + obs_dim, action_dim))
        self.bias = nn.Parameter(torch.full((num_nodes, action_dim), 0.5))

    def _features(self, inputs: Tensor, center: Tensor, bandwidth: Tensor) -> Tensor:
        """Bumps (eq. 14) and (o' - o), (N, M, C + D), for inputs (N, M, 2 D)."""
        bumps = torch.exp(-0.5 * (torch.cdist(inputs, center) / bandwidth[:, None, None]) ** 2)
        return torch.cat([bumps, inputs[..., self.obs_dim :] - inputs[..., : self.obs_dim]], -1)

    def forward(self, inputs: Tensor, node: Tensor) -> Tensor:
        """Actions (B, A) that the nodes (B,) ask for at rows (o, o') (B, 2 D)."""
        features = self._features(inputs[:, None], self.center[node], self.bandwidth[node])
        return (features @ self.weight[node])[:, 0] + self.bias[node]

    def at(self, row: NDArray[np.float32], node: int) -> NDArray[np.float32]:
        """Action (A,) that a node asks for at a row (o, o') (2 D,)."""
        away = row - _array(self.center, node)
        bandwidth, weight = _array(self.bandwidth, node), _array(self.weight, node)
        bumps = np.exp(-0.5 * np.einsum("ci,ci->c", away, away) / bandwidth**2)
        difference = row[self.obs_dim :] - row[: self.obs_dim]
        linear = difference @ weight[len(bumps) :]
        return bumps @ weight[: len(bumps)] + linear + _array(self.bias, node)

    @torch.no_grad()
    def fit(self, inputs: Tensor, targets: Tensor, node: Tensor, ridge: float = 0.1) -> float:
        """Solve every node's ridge regression; returns the mean squared error.

        Nodes without samples stay as they are.
        """
        square_error = 0.0
        for own, samples in nodes_of_a_size(node, len(self.center)):
            number = torch.searchsorted(own, node[samples])
            data = group_by_node(inputs[samples], targets[samples], number, len(own))
            square_error += self._solve(own, data, ridge)
        return square_error / targets.numel()

    def _solve(self, node: Tensor, data: Padded, ridge: float) -> float:
        """Solve the regressions of some nodes (K,) on their samples; the sum of squared errors."""
        count = data.mask.sum(1)
        num_centers = self.center.shape[1]
        # Evenly spread over the node's samples, which stand in the order of time.
        place = torch.arange(num_centers) * count[:, None] // num_centers
        center = data.inputs[torch.arange(len(count))[:, None], place]
        spread = center.std(1).square().sum(-1).sqrt()
        bandwidth = spread.nan_to_num(1.0).clamp(min=1e-3)
        mask = data.mask[..., None]
        features = self._features(data.inputs, center, bandwidth) * mask
        bias = (data.targets * mask).sum(1) / count[:, None]
        residual = (data.targets - bias[:, None]) * mask
        penalty = torch.ones(features.shape[-1])
        penalty[num_centers:] = 0.1
        wide = features.double()  # summed in float32, 10,000 samples drown the ridge
        gram = wide.mT @ wide + ridge * torch.diag(penalty)
        # By Cholesky: batched LU of matrices this large fails in some builds on several threads.
        factor = torch.linalg.cholesky(gram)
        weight = torch.cholesky_solve(wide.mT @ residual.double(), factor).float()
        self.center[node], self.bandwidth[node] = center, bandwidth
        self.weight[node], self.bias[node] = weight, bias
        error = (features @ weight + bias[:, None] - data.targets) * mask
        return float(error.square().sum())
