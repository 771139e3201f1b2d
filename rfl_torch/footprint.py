"""How much of the machine's memory learning takes, foretold: what is too much is refused at once.

Numbers are bounds for the default controllers. A step of D readings takes 110 D bytes or so while
the controllers are learned, the recursions take at most 0.6 GB however long a log is.
"""

from pathlib import Path

from rfl_torch.inference import block_steps

MEMINFO = Path("/proc/meminfo")
"""Where Linux says how much memory can be had."""

PROGRAM = 200_000_000
"""Bytes of the compiled code, and of much that is small."""

ROWS, SAMPLES = 1_000, 16_000
"""Steps and samples that are worked on at once, whatever the log's length."""


def to_fit(num_steps: int, obs_dim: int, action_dim: int, num_cells: int, horizon: int) -> int:
    """Bytes that learning from logs takes at most, beyond the logs themselves.

    Args:
        num_steps: T, of all logs.
        obs_dim: D, readings.
        action_dim: A.
        num_cells: of the lattice.
        horizon: furthest target of the controllers' triplets, steps.
    """
    messages = 16 * num_cells * (min(num_steps, 2 * block_steps(num_cells)) + ROWS)
    pieces = 8 * 6 * obs_dim * SAMPLES  # inputs, features, their products and errors
    # Float64: normalised, with gaps filled, and the two that a comparison makes.
    observations = 4 * 8 * obs_dim
    # Forward and backward, each alone, joined, and lent to the poor; then as inputs.
    triplet = 4 * (2 * obs_dim + action_dim) + 8
    triplets = 2 * horizon * (3 * triplet + 2 * 4 * obs_dim)
    changes = 8 * (16 + 2 * action_dim)  # over up to eight steps, for the look's radius
    return PROGRAM + messages + pieces + num_steps * (observations + triplets + changes)


def to_extend(num_steps: int, obs_dim: int, num_nodes: int) -> int:
    """Bytes that taking a log into a map of so many nodes takes at most, beyond the log."""
    return num_steps * 8 * (2 * num_nodes + 4 * obs_dim)


def available() -> int | None:
    """Bytes that can be had; None where the system doesn't say."""
    try:
        lines = MEMINFO.read_text().splitlines()
        (line,) = (line for line in lines if line.startswith("MemAvailable:"))
        return 1024 * int(line.split()[1])
    except (OSError, ValueError):
        return None


def check(num_bytes: int, work: str) -> None:
    """Refuse work that takes more than there is.

    Raises:
        ValueError: saying what takes how much, and what can be had.
    """
    there = available()
    if there is not None and num_bytes > there:
        raise ValueError(
            f"{work} takes up to {num_bytes / 1e9:.3g} GB, and {there / 1e9:.3g} GB can be had; "
            "learn from a part of the steps, and hand the others to partial_fit in pieces."
        )
