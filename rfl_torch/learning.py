"""The learning procedure of section 2.2: EM in stages, from coarse time to fine.

    m        Stage.stride        every m-th observation (step 2); the paper's rate is 1/m
    K        Stage.iterations    EM iterations at that rate
    tau      trace               k / K in eq. 11
    eps      SMOOTHING           added to the transitions between rates (step 5)

Beyond the paper a stage may temper the emissions: their log-densities are multiplied by a
temperature that rises through the stage. 24 sharp Gaussians outweigh any transition, so untempered
EM freezes into its first assignment; tempered, the grid unfolds before the emissions decide.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from rfl_torch.hmm import GridHMM, Statistics

SMOOTHING = 1e-3
"""Step 5's addition to every existing edge; outside the grid's edges it would undo the sparsity."""

PATIENCE = 3
"""Iterations in a row without gain that end a stage: the likelihood dips under trace and floor."""

EARLIEST_STOP = 5
"""A stage's first iterations can stand on the plateau of equal starts."""


@dataclass(frozen=True)
class Stage:
    """EM at one sub-sampling rate."""

    stride: int
    """Every stride-th observation is kept (m of step 2)."""
    iterations: int
    """EM iterations at most (K)."""
    temperature: tuple[float, float] = (1.0, 1.0)
    """Power of the emission densities at the stage's start and, from 80 % of it on, at its end;
    geometric between. (1, 1) is ordinary EM."""
    pseudo_count: float = 0.0
    """Transitions that each edge is taken to have had: zeros absorb in EM, this keeps edges."""
    min_scale: float = 0.01
    """Floor of the emission standard deviations, in normalised units."""
    all_phases: bool = False
    """Learn from all `stride` shifted copies of the sub-sampled log instead of the first only."""
    trace: bool = False
    """Keep the share tau = k / K of the old means and variances (eq. 11, formula as printed)."""
    tolerance: float = 1e-5
    """End the stage when the log-likelihood per step gains less, relatively, PATIENCE times."""

    def tempered(self, power: float) -> "Stage":
        """The same stage with both temperatures multiplied."""
        first, last = self.temperature
        return replace(self, temperature=(power * first, power * last))

    def temperature_at(self, iteration: int) -> float:
        """Temperature of iteration 0, 1, ..."""
        first, last = self.temperature
        share = iteration / max(1.0, 0.8 * (self.iterations - 1))
        return last if share >= 1 else first * (last / first) ** share


@dataclass(frozen=True)
class Progress:
    """What an EM iteration did; the record of a run is a list of these."""

    stage: int
    iteration: int
    temperature: float
    log_likelihood_per_step: float
    seconds: float


class LearningMonitor(Protocol):
    """What `learn` calls as it goes; `monitor.TensorBoardMonitor` is one."""

    def on_iteration(self, hmm: GridHMM, statistics: Statistics, progress: Progress) -> None:
        """Called after every M-step."""

    def on_stage_end(self, hmm: GridHMM, stage: int) -> None:
        """Called when a sub-sampling rate is done."""


@torch.no_grad()
def start(hmm: GridHMM, sequences: list[Tensor], kind: Literal["equal", "data"], seed: int) -> None:
    """Set the parameters that learning begins with.

    "equal" is the paper's start: the same mean 0.5 and scale 0.05 for all nodes. Exact EM keeps
    the grid's mirror symmetry, and only rounding breaks it; 1 % of seeded jitter on the
    transitions breaks it the same way on every machine.
    "data" gives all nodes the data's mean, with 1 % of noise, and the data's scale.
    """
    generator = torch.Generator().manual_seed(seed)
    if kind == "equal":
        hmm.emission_mean.fill_(0.5)
        hmm.emission_log_scale.fill_(math.log(0.05))
        jitter = torch.rand(hmm.transition_logits.shape, generator=generator, dtype=torch.float64)
        hmm.transition_logits.copy_((1.0 + 0.01 * (2 * jitter - 1)).log())
    else:
        data = torch.cat([sequence.double() for sequence in sequences])
        mean = data.nanmean(0)
        scale = (data - mean).square().nanmean(0).sqrt().clamp(min=0.01)
        noise = torch.randn(hmm.emission_mean.shape, generator=generator, dtype=torch.float64)
        hmm.emission_mean.copy_(mean + 0.01 * scale * noise)
        hmm.emission_log_scale.copy_(scale.log().expand_as(hmm.emission_log_scale))
        hmm.transition_logits.zero_()
    hmm.initial_logits.zero_()


@torch.no_grad()
def smooth_transitions(hmm: GridHMM) -> None:
    """Add SMOOTHING to every existing edge and normalise (step 5)."""
    prob = hmm.log_transition().exp() + SMOOTHING
    hmm.transition_logits.copy_(torch.where(hmm.successor_mask, prob.log(), 0.0))


def subsample(sequences: list[Tensor], stride: int, all_phases: bool) -> list[Tensor]:
    """Every stride-th observation of each sequence (step 2), from the first or from each phase."""
    phases = range(stride if all_phases else 1)
    return [
        sequence[phase::stride]
        for sequence in sequences
        for phase in phases
        if len(sequence) > phase
    ]


def learn(
    hmm: GridHMM,
    sequences: list[Tensor],
    stages: tuple[Stage, ...],
    monitor: LearningMonitor | None = None,
) -> list[Progress]:
    """Train `hmm` in place through all stages; returns the record of every iteration."""
    record: list[Progress] = []
    for index, stage in enumerate(stages):
        if index > 0:
            smooth_transitions(hmm)
        for statistics, progress in run_stage(hmm, sequences, stage, index):
            record.append(progress)
            if monitor is not None:
                monitor.on_iteration(hmm, statistics, progress)
        if monitor is not None:
            monitor.on_stage_end(hmm, index)
    return record


def run_stage(
    hmm: GridHMM, sequences: list[Tensor], stage: Stage, index: int = 0, first: int = 0
) -> Iterator[tuple[Statistics, Progress]]:
    """EM at one rate, one iteration at a time, from iteration `first` on."""
    data = subsample(sequences, stage.stride, stage.all_phases)
    previous, without_gain = -math.inf, 0
    for iteration in range(first, stage.iterations):
        begin = time.perf_counter()
        temperature = stage.temperature_at(iteration)
        statistics = hmm.e_step(data, temperature)
        hmm.m_step(
            statistics,
            min_scale=stage.min_scale,
            pseudo_count=stage.pseudo_count,
            trace=(iteration + 1) / stage.iterations if stage.trace else 0.0,
        )
        per_step = statistics.log_likelihood.item() / statistics.num_steps
        yield (
            statistics,
            Progress(index, iteration, temperature, per_step, time.perf_counter() - begin),
        )
        gain = per_step - previous
        settled = temperature == stage.temperature[1]
        is_small = settled and gain < stage.tolerance * abs(per_step)
        without_gain = without_gain + 1 if is_small else 0
        previous = per_step
        if without_gain >= PATIENCE and iteration + 1 >= EARLIEST_STOP:
            return


@torch.no_grad()
def prune(hmm: GridHMM, sequences: list[Tensor], temperature: float = 1.0) -> None:
    """Drop the nodes that no full-rate most likely path visits (section 3.2)."""
    used = torch.zeros(hmm.num_nodes, dtype=torch.bool)
    for sequence in sequences:
        used[hmm.most_likely_path(sequence, temperature)] = True
    hmm.keep_nodes(used)


def paper_stages(strides: tuple[int, ...] = (10, 5, 2, 1)) -> tuple[Stage, ...]:
    """The paper's schedule: 200 iterations at each rate, trace rule, floor 0.01."""
    return tuple(Stage(stride, 200, trace=True) for stride in strides)


def to_sequences(logs: list[np.ndarray]) -> list[Tensor]:
    """Observation arrays as float64 tensors."""
    return [torch.from_numpy(np.asarray(log, np.float64)) for log in logs]
