"""Where a map ends: what a visit promises, against the definition."""

import itertools
from types import SimpleNamespace

import numpy as np
import torch

from rfl_torch.explorer import CELL
from rfl_torch.free_ways import FreeWays, ways
from rfl_torch.frontier import AHEAD, IN_SIGHT, PROMISED, promise
from rfl_torch.places import NODE_STEPS


def mapped(positions, free):
    """An agent whose nodes see how far each of the eight ways is free."""
    return SimpleNamespace(
        positions=positions,
        free_ways=FreeWays(np.concatenate([np.eye(8), np.zeros((1, 8))]), 0.0),
        hmm=SimpleNamespace(emission_mean=torch.from_numpy(free)),
    )


def test_a_visit_promises_the_cells_in_sight_that_have_no_node():
    rng = np.random.default_rng(0)
    positions = rng.uniform(0, 40, (25, 2))
    free, is_open = rng.uniform(0, 40, (25, 8)), rng.uniform(size=(25, 8)) < 0.2
    unknown = set()
    for node, way in itertools.product(range(25), range(8)):
        for reach in np.arange(AHEAD, IN_SIGHT, CELL):
            point = positions[node] + reach * ways(2)[way]
            is_new = np.linalg.norm(positions - point, axis=1).min() > NODE_STEPS
            if free[node, way] > reach + 1 and is_new:
                unknown.add(tuple(np.round(point / CELL) * CELL))
    cells, expected = np.array(list(unknown)), np.zeros(25)
    for node, way in np.argwhere(is_open):
        end = positions[node] + AHEAD * ways(2)[way]
        count = (np.linalg.norm(cells - end, axis=1) <= PROMISED).sum()
        expected[node] = max(expected[node], count)
    assert len(set(expected)) > 5
    np.testing.assert_array_equal(promise(mapped(positions, free), is_open), expected)


def test_a_map_without_positions_promises_its_open_directions():
    is_open = np.random.default_rng(0).uniform(size=(7, 8)) < 0.5
    agent = SimpleNamespace(positions=None, free_ways=None)
    np.testing.assert_array_equal(promise(agent, is_open), is_open.sum(1))
