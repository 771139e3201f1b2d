"""`rfl_torch.grid` against the definition: nodes at most theta_d apart are joined."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rfl_torch.grid import build_grid

SHAPES = st.one_of(
    st.tuples(*[st.integers(1, 6)] * 2),
    st.tuples(*[st.integers(1, 4)] * 3),
)
RADII = st.sampled_from([1.0, math.sqrt(2), math.sqrt(3), 2.0, math.sqrt(5), 3.0])
METRICS = st.sampled_from(["euclidean", "chebyshev"])
BOUNDARIES = st.sampled_from(["open", "torus"])


def edges_of(grid):
    return [
        (i, int(j))
        for i, (row, mask) in enumerate(zip(grid.successor, grid.mask, strict=True))
        for j in row[mask]
    ]


def edges_by_distance(shape, radius, metric, boundary):
    """Every pair of nodes, measured one by one."""
    edges = set()
    nodes = list(itertools.product(*[range(size) for size in shape]))
    for (i, a), (j, b) in itertools.product(enumerate(nodes), repeat=2):
        gap = np.abs(np.subtract(a, b))
        if boundary == "torus":
            gap = np.minimum(gap, np.array(shape) - gap)
        length = gap.max() if metric == "chebyshev" else np.linalg.norm(gap)
        if length <= radius + 1e-9:
            edges.add((i, j))
    return edges


@given(shape=SHAPES, radius=RADII, metric=METRICS, boundary=BOUNDARIES)
def test_nodes_are_joined_exactly_when_they_lie_within_the_radius(shape, radius, metric, boundary):
    grid = build_grid(shape, radius, metric, boundary)
    edges = edges_of(grid)
    assert len(edges) == len(set(edges))
    assert set(edges) == edges_by_distance(shape, radius, metric, boundary)


@given(shape=SHAPES, radius=RADII, metric=METRICS, boundary=BOUNDARIES)
def test_a_node_leads_to_itself_first_and_padding_is_the_node(shape, radius, metric, boundary):
    grid = build_grid(shape, radius, metric, boundary)
    own = np.arange(math.prod(shape))
    assert grid.mask[:, 0].all()
    np.testing.assert_array_equal(grid.successor[:, 0], own)
    padding = np.broadcast_to(own[:, None], grid.successor.shape)[~grid.mask]
    np.testing.assert_array_equal(grid.successor[~grid.mask], padding)


@pytest.mark.parametrize(
    ("shape", "radius", "metric", "neighbors"),
    [
        ((9, 9), 1.0, "euclidean", 4),
        ((9, 9), math.sqrt(2), "euclidean", 8),
        ((9, 9), 2.0, "euclidean", 12),
        ((9, 9), 2.0, "chebyshev", 24),
        ((5, 5, 5), 1.0, "euclidean", 6),
        ((5, 5, 5), math.sqrt(2), "euclidean", 18),
        ((5, 5, 5), math.sqrt(3), "euclidean", 26),
    ],
)
def test_an_inner_node_has_the_neighbors_that_the_paper_names(shape, radius, metric, neighbors):
    grid = build_grid(shape, radius, metric)
    middle = math.prod(shape) // 2
    assert grid.mask[middle].sum() == neighbors + 1  # and itself
    assert (build_grid(shape, radius, metric, "torus").mask.sum(1) == neighbors + 1).all()


def test_the_papers_grid_has_4804_edges():
    assert build_grid((20, 20), 2.0).mask.sum() == 4804


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((20,), 2.0), "two or three sizes"),
        (((2, 2, 2, 2), 2.0), "two or three sizes"),
        (((0, 5), 2.0), "two or three sizes"),
        (((5, 5), 0.5), "radius is 0.5"),
        (((5, 5), math.inf), "radius is inf"),
        (((5, 5), math.nan), "radius is nan"),
        (((5, 5), 2.0, "manhattan"), "manhattan"),
        (((5, 5), 2.0, "euclidean", "klein"), "klein"),
    ],
)
def test_a_bad_argument_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        build_grid(*arguments)
