"""`rfl_torch.controllers`: triplets go where section 2.4 says, banks learn them, all at once."""

import numpy as np
import pytest
import torch

from rfl_torch import controllers
from rfl_torch.agent import make_bank
from rfl_torch.controllers import (
    LEAST_SAMPLES,
    Triplets,
    assign_triplets,
    group_by_node,
    next_node_entered,
    pool_sparse_nodes,
)

BANKS = ("mlp", "rbf", "svr")


def linear_samples(num_nodes=3, per_node=80, obs_dim=4, seed=0):
    """Every node has its own linear law from o' - o to the action."""
    generator = torch.Generator().manual_seed(seed)
    law = 0.5 * torch.randn(num_nodes, obs_dim, 2, generator=generator)
    node = torch.arange(num_nodes).repeat_interleave(per_node)
    observation = torch.rand(len(node), obs_dim, generator=generator)
    step = 0.3 * torch.rand(len(node), obs_dim, generator=generator) - 0.15
    action = 0.5 + torch.einsum("bd,bda->ba", step, law[node])
    return Triplets(observation, observation + step, action, node)


def test_a_buffer_of_triplets_trains_the_node_that_wins_next():
    path = torch.tensor([4, 4, 4, 7, 7, 2, 2])
    assert next_node_entered(path).tolist() == [7, 7, 7, 2, 2, -1, -1]
    observations = torch.arange(7.0)[:, None]
    actions = torch.arange(6.0)[:, None] / 10
    triplets = assign_triplets(path, observations, actions, horizon=1)
    assert triplets.node.tolist() == [7, 7, 7, 2, 2]
    assert triplets.observation[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert triplets.target[:, 0].tolist() == [1, 2, 3, 4, 5]
    torch.testing.assert_close(triplets.action[:, 0], torch.arange(5.0) / 10)


def test_a_longer_horizon_sums_action_offsets_inside_the_buffer():
    path = torch.tensor([4, 4, 4, 7])
    observations = torch.arange(4.0)[:, None]
    actions = torch.tensor([[0.6], [0.7], [0.4]])
    triplets = assign_triplets(path, observations, actions, horizon=2)
    assert triplets.observation[:, 0].tolist() == [0, 1, 2, 0, 1]
    assert triplets.target[:, 0].tolist() == [1, 2, 3, 2, 3]
    torch.testing.assert_close(triplets.action[:, 0], torch.tensor([0.6, 0.7, 0.4, 0.8, 0.6]))


def test_a_node_with_few_samples_borrows_its_neighbours():
    node = torch.tensor([0] * 20 + [1] * 2 + [2] * 20)
    samples = torch.arange(42.0)[:, None]
    triplets = Triplets(samples, samples, samples, node)
    neighbor = torch.tensor([[0, 1], [1, 0], [2, 1]])
    pooled = pool_sparse_nodes(triplets, neighbor, torch.ones(3, 2, dtype=torch.bool))
    assert 2 < LEAST_SAMPLES <= 20
    counts = torch.bincount(pooled.node).tolist()
    assert counts == [20, 22, 20]
    assert set(pooled.action[pooled.node == 1, 0].tolist()) == {*map(float, range(22))}


def test_grouping_keeps_every_sample_with_its_node():
    triplets = linear_samples()
    shuffle = torch.randperm(len(triplets.node), generator=torch.Generator().manual_seed(1))
    inputs, targets, node = (t[shuffle] for t in (triplets.inputs, triplets.action, triplets.node))
    data = group_by_node(inputs, targets, node, 4)
    assert data.mask.sum(1).tolist() == [80, 80, 80, 0]
    for k in range(3):
        torch.testing.assert_close(data.inputs[k][data.mask[k]], inputs[node == k])
        torch.testing.assert_close(data.targets[k][data.mask[k]], targets[node == k])


@pytest.mark.parametrize(("kind", "share"), [("mlp", 0.4), ("rbf", 0.1), ("svr", 0.8)])
def test_each_node_learns_its_own_law(kind, share):
    triplets, fresh = linear_samples(seed=0), linear_samples(seed=0, per_node=90)
    torch.manual_seed(0)
    bank = make_bank(kind, 3, 4, 2)
    bank.fit(triplets.inputs, triplets.action, triplets.node)
    with torch.no_grad():
        error = bank(fresh.inputs, fresh.node) - fresh.action
        wrong = bank(fresh.inputs, (fresh.node + 1) % 3) - fresh.action
    spread = fresh.action.std()
    assert error.square().mean().sqrt() < share * spread
    assert wrong.square().mean().sqrt() > 1.2 * error.square().mean().sqrt()


@pytest.mark.parametrize("kind", BANKS)
def test_one_call_for_all_rows_equals_a_call_for_each(kind):
    triplets = linear_samples(per_node=20)
    torch.manual_seed(0)
    bank = make_bank(kind, 3, 4, 2)
    bank.fit(triplets.inputs, triplets.action, triplets.node)
    with torch.no_grad():
        together = bank(triplets.inputs, triplets.node)
        rows = zip(triplets.inputs, triplets.node, strict=True)
        alone = np.stack([bank.at(row.numpy(), int(node)) for row, node in rows])
    assert alone.dtype == np.float32
    np.testing.assert_allclose(together, alone, atol=1e-5, rtol=1e-5)


def test_nodes_with_few_and_many_samples_are_learned_as_each_alone(monkeypatch):
    """Part by part, a few nodes at a time; tolerance: float32 sums of other lengths."""
    monkeypatch.setattr(controllers, "MOST_AT_ONCE", 40)
    triplets = linear_samples(num_nodes=6, per_node=60)
    kept = torch.cat([(triplets.node == k).nonzero()[: 3 + 11 * k, 0] for k in (4, 0, 5, 2, 1)])
    triplets = Triplets(*(field[kept] for field in triplets))
    bank = make_bank("rbf", 6, 4, 2)
    bank.fit(triplets.inputs, triplets.action, triplets.node)
    for k in (0, 1, 2, 4, 5):
        own = triplets.node == k
        alone = make_bank("rbf", 1, 4, 2)
        alone.fit(triplets.inputs[own], triplets.action[own], triplets.node[own] * 0)
        for name, value in alone.state_dict().items():
            torch.testing.assert_close(bank.state_dict()[name][k : k + 1], value, atol=1e-4, rtol=0)
    parts = [own for own, _ in controllers.nodes_of_a_size(triplets.node, 6)]
    assert sorted(torch.cat(parts).tolist()) == [0, 1, 2, 4, 5]
    assert len(parts) > 2


def test_a_node_with_many_samples_is_learned_where_readings_say_the_same():
    """Four readings are one: the ridge alone tells them apart, and float32 would lose it."""
    generator = torch.Generator().manual_seed(0)
    once = 10 * torch.rand(20_000, 2, generator=generator)
    inputs = once.repeat_interleave(4, 1)
    action = 0.5 + 0.03 * (once[:, 1:] - once[:, :1])
    bank = make_bank("rbf", 1, 4, 1)
    assert bank.fit(inputs, action, torch.zeros(20_000, dtype=torch.int64)) < 1e-6


@pytest.mark.parametrize("kind", BANKS)
def test_a_node_without_samples_rests(kind):
    triplets = linear_samples(per_node=20)
    bank = make_bank(kind, 5, 4, 2)
    bank.fit(triplets.inputs, triplets.action, triplets.node)
    with torch.no_grad():
        action = bank(triplets.inputs[:1].repeat(2, 1) * 0, torch.tensor([3, 4]))
    torch.testing.assert_close(action, torch.full_like(action, 0.5), atol=1e-6, rtol=0)


@pytest.mark.parametrize("kind", BANKS)
def test_a_bank_comes_back_from_its_state(kind):
    triplets = linear_samples(per_node=20)
    bank, back = make_bank(kind, 3, 4, 2), make_bank(kind, 3, 4, 2)
    bank.fit(triplets.inputs, triplets.action, triplets.node)
    back.load_state_dict(bank.state_dict())
    with torch.no_grad():
        np.testing.assert_array_equal(
            bank(triplets.inputs, triplets.node), back(triplets.inputs, triplets.node)
        )
