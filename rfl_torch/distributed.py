"""EM over the logs of a fleet: one process a share of the logs, one model for all.

The E-step's statistics add, so an iteration is each rank's own E-step, one sum over the ranks of
`bytes_reduced`, and the same M-step everywhere. What it costs: docs/fleet.md. Started by torchrun:

    with distributed.job() as rank:
        own = distributed.share(lengths, rank)          # indices of the logs to load
        sequences = [load(paths[index]) for index in own]
        distributed.start(hmm, sequences, "data", seed=0)
        distributed.learn(hmm, sequences, stages, monitor if rank.index == 0 else None)

A log is never cut, so the longest one bounds the speed-up.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Literal

import torch
import torch.distributed as dist
from torch import Tensor

from rfl_torch import learning
from rfl_torch.hmm import GridHMM
from rfl_torch.learning import LearningMonitor, Progress, Stage


@dataclass(frozen=True)
class Rank:
    """One of `count` processes that learn together."""

    index: int
    count: int


@contextmanager
def job(timeout: timedelta = timedelta(minutes=10)) -> Iterator[Rank]:
    """Join the processes that torchrun started; without torchrun, a job of one.

    Args:
        timeout: how long a rank waits for the slowest one before it gives up.
    """
    if "RANK" not in os.environ:
        yield Rank(0, 1)
        return
    dist.init_process_group("gloo", timeout=timeout)
    try:
        yield Rank(dist.get_rank(), dist.get_world_size())
    finally:
        dist.destroy_process_group()


def share(lengths: Sequence[int], rank: Rank) -> list[int]:
    """Indices of a rank's logs: longest first, each to the rank with the fewest steps so far."""
    if len(lengths) < rank.count:
        raise ValueError(
            f"{len(lengths)} logs cannot be shared among {rank.count} ranks, which need one each; "
            "start fewer, or cut the logs where the robot stood still."
        )
    load, owner = [0] * rank.count, [0] * len(lengths)
    for index in sorted(range(len(lengths)), key=lambda index: (-lengths[index], index)):
        owner[index] = min(range(rank.count), key=load.__getitem__)
        load[owner[index]] += max(1, lengths[index])
    return [index for index, own in enumerate(owner) if own == rank.index]


def bytes_reduced(num_nodes: int, num_edges: int, obs_dim: int) -> int:
    """Bytes of statistics that an iteration sums over the ranks: N nodes of K edges, D readings."""
    return 8 * (num_nodes * (2 + num_edges + 3 * obs_dim) + 2)


def add_up(tensor: Tensor) -> Tensor:
    """The sum of every rank's tensor, with the same bits on all of them.

    Raises:
        RuntimeError: if another rank has ended or hangs.
    """
    total = tensor.clone()
    if not dist.is_initialized():
        return total
    try:
        dist.all_reduce(total)
    except RuntimeError as error:
        raise RuntimeError(
            f"rank {dist.get_rank()} of {dist.get_world_size()} lost another rank, whose own error "
            "stands above or in its log; go on from the last checkpoint."
        ) from error
    return total


def start(hmm: GridHMM, sequences: list[Tensor], kind: Literal["equal", "data"], seed: int) -> None:
    """`learning.start` as one process with all logs would do it."""
    learning.start(hmm, sequences, kind, seed, add_up)


def learn(
    hmm: GridHMM,
    sequences: list[Tensor],
    stages: tuple[Stage, ...],
    monitor: LearningMonitor | None = None,
    record: list[Progress] | None = None,
) -> list[Progress]:
    """`learning.learn` over all ranks' logs, from rank 0's parameters; every rank calls it.

    Every rank ends with the same model and record. `monitor`, of one rank, may save checkpoints
    from which that `record` goes on.
    """
    if dist.is_initialized():
        for parameter in hmm.parameters():
            dist.broadcast(parameter.detach(), src=0)
    with torch.no_grad():
        return learning.learn(hmm, sequences, stages, monitor, record, add_up)
