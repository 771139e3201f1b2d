"""`rfl_torch.planner` against networkx-free definitions: propagation of ones, and Bellman's."""

import itertools

import numpy as np
import pytest
from scipy.sparse import csr_array

from rfl_torch.planner import (
    ALIKE,
    cost_to_go,
    largest_component,
    look_alikes,
    reachability_path,
    threshold_graph,
)


def propagate(adjacency, start, goal):
    """Steps 2-4 of the planning procedure: ones spread until the goal has one; -1 if never."""
    reached = np.zeros(len(adjacency), bool)
    reached[start] = True
    for count in range(len(adjacency) + 1):
        if reached[goal]:
            return count
        reached = reached | (adjacency[reached].any(0))
    return -1


@pytest.mark.parametrize("seed", range(20))
def test_the_plan_is_the_propagation_of_ones(seed):
    rng = np.random.default_rng(seed)
    transition = rng.random((12, 12)) * (rng.random((12, 12)) < 0.15)
    graph = threshold_graph(transition, 0.01)
    adjacency = (transition > 0.01) & ~np.eye(12, dtype=bool)
    for goal in range(12):
        path = reachability_path(graph, 0, goal)
        length = propagate(adjacency, 0, goal)
        assert len(path) - 1 == length if path else length == -1
        assert all(adjacency[i, j] for i, j in itertools.pairwise(path))
        if path:
            assert path[0] == 0
            assert path[-1] == goal


def test_transitions_up_to_epsilon_are_closed():
    transition = np.array([[0.0, 0.01, 0.99], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    graph = threshold_graph(transition, 0.01)
    assert reachability_path(graph, 0, 1) == []
    assert reachability_path(graph, 0, 2) == [0, 2]
    assert reachability_path(graph, 2, 2) == [2]


@pytest.mark.parametrize("seed", range(5))
def test_cost_to_go_fulfils_bellmans_equation(seed):
    rng = np.random.default_rng(seed)
    cost = rng.random((15, 15)) * (rng.random((15, 15)) < 0.25)
    goals = np.array([3, 8])
    remaining = cost_to_go(csr_array(cost), goals)
    step = np.where(cost > 0, cost, np.inf) + remaining[None]
    expected = step.min(1)
    expected[goals] = 0.0
    np.testing.assert_allclose(remaining, expected, rtol=1e-12)
    assert np.isinf(cost_to_go(csr_array((4, 4)), np.array([0]))[1:]).all()


def test_the_largest_component_needs_a_way_there_and_back():
    adjacency = np.zeros((5, 5))
    adjacency[0, 1] = adjacency[1, 2] = adjacency[2, 0] = adjacency[2, 3] = adjacency[3, 4] = 1
    assert largest_component(csr_array(adjacency)).tolist() == [True] * 3 + [False] * 2


@pytest.mark.parametrize("decades", [(0.0, 0.0), (-0.3, 0.3), (-2.0, 1.0)])
@pytest.mark.parametrize("seed", range(3))
def test_look_alikes_are_the_pairs_of_the_definition(decades, seed, monkeypatch):
    """By every pair in a loop; scales equal or not, means about as far apart as they are."""
    monkeypatch.setattr("rfl_torch.planner.PAIRS_AT_ONCE", 70)  # several chunks
    rng = np.random.default_rng(seed)
    scale = 10 ** rng.uniform(*decades, (60, 3))
    mean = 3 * rng.standard_normal((60, 3)) * 10 ** rng.uniform(-1, 0, (60, 1))
    power = 0.3
    expected = np.zeros((60, 60), bool)
    for i, j in itertools.permutations(range(60), 2):
        distance = (mean[i] - mean[j]) ** 2 / (scale[i] ** 2 + scale[j] ** 2)
        expected[i, j] = 0.5 * power * distance.sum() < ALIKE
    found = look_alikes(mean, scale, power)
    assert found.dtype == bool
    assert 100 < expected.sum() < 60 * 59
    np.testing.assert_array_equal(found.toarray(), expected)
    assert look_alikes(100.0 * np.eye(3), np.full((3, 3), 0.1), power).nnz == 0
