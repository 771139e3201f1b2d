"""Where the nodes of the sparse HMM lie and which of them are joined (section 2.2).

Nodes stand on a square grid or a cubic lattice with spacing 1 and are joined when their distance is
at most `radius`, the paper's theta_d. A node is at distance 0 from itself, so it may stay.
"""

import itertools
import math
from typing import Literal, NamedTuple

import numpy as np

Metric = Literal["euclidean", "chebyshev"]
Boundary = Literal["open", "torus"]


MOST_BYTES = 4_000_000_000
"""Memory that laying out a grid may take; 10,000 nodes with radius 2 take 6 MB."""


class Grid(NamedTuple):
    """The edges of a lattice, nodes numbered in row-major order.

    successor: int64 (N, K), the nodes that an edge leads to, itself first; padded with the node.
    mask: bool (N, K), False where `successor` is padding.
    """

    successor: np.ndarray
    mask: np.ndarray


def build_grid(
    shape: tuple[int, ...], radius: float, metric: Metric = "euclidean", boundary: Boundary = "open"
) -> Grid:
    """Join every node of a lattice with the nodes within `radius`, itself included.

    Args:
        shape: two sizes for a square grid, three for a cubic lattice.
        radius: theta_d; 1 joins 4 neighbours of a square grid, sqrt(2) joins 8, 2 joins 12.
        metric: "chebyshev" counts a diagonal step as 1 (radius 2 joins 24 neighbours).
        boundary: "torus" joins opposite borders, so that a trajectory laid out has no edge to
            fold at.

    Raises:
        ValueError: if the shape is not two or three positive sizes, or the radius is under 1.
    """
    if len(shape) not in (2, 3) or any(size < 1 for size in shape):
        raise ValueError(
            f"grid shape is {shape}, needs two or three sizes of at least 1; try (20, 20)."
        )
    if not 1.0 <= radius < math.inf:
        raise ValueError(
            f"radius is {radius}, needs a finite distance of at least 1, else no node has a "
            "neighbour; try 2.0."
        )
    if metric not in ("euclidean", "chebyshev") or boundary not in ("open", "torus"):
        raise ValueError(
            f"metric is {metric!r} and boundary {boundary!r}; needs 'euclidean' or 'chebyshev', "
            "and 'open' or 'torus'."
        )
    reach = (2 * math.floor(radius) + 1) ** len(shape)
    needed = 8 * math.prod(shape) * reach * (len(shape) + 1)
    if needed > MOST_BYTES:
        raise ValueError(
            f"a grid of shape {shape} with radius {radius:g} takes {needed / 1e9:.3g} GB to lay "
            f"out, needs at most {MOST_BYTES / 1e9:.3g}; try fewer nodes or a smaller radius."
        )
    steps = _steps_within(radius, metric, len(shape))
    coordinates = np.indices(shape).reshape(len(shape), -1).T  # (N, dim)
    target = coordinates[:, None, :] + steps[None]  # (N, K, dim)
    sizes = np.array(shape)
    if boundary == "torus":
        target %= sizes
        mask = np.ones(target.shape[:2], bool)
    else:
        mask = ((target >= 0) & (target < sizes)).all(-1)
    successor = np.ravel_multi_index(tuple(np.moveaxis(target, -1, 0)), shape, mode="clip")
    own = np.arange(len(coordinates))[:, None]
    # On a small torus two steps may lead to one node: an edge must stand once.
    mask &= ~_seen_before(np.where(mask, successor, -1))
    return Grid(np.where(mask, successor, own), mask)


def _steps_within(radius: float, metric: Metric, dim: int) -> np.ndarray:
    """Lattice displacements of length at most `radius`, the zero step first."""
    reach = range(-math.floor(radius), math.floor(radius) + 1)
    order = math.inf if metric == "chebyshev" else 2
    steps = np.array(list(itertools.product(reach, repeat=dim)))
    length = np.linalg.norm(steps, ord=order, axis=1)
    steps, length = steps[length <= radius + 1e-9], length[length <= radius + 1e-9]
    return steps[np.argsort(length, kind="stable")]


def _seen_before(table: np.ndarray) -> np.ndarray:
    """True where an entry stands further left in its row too."""
    seen = np.zeros(table.shape, bool)
    for k in range(1, table.shape[1]):
        seen[:, k] = (table[:, :k] == table[:, k : k + 1]).any(1)
    return seen
