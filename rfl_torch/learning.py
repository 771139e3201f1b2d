"""The learning procedure of section 2.2: EM in stages, from coarse time to fine.

    m        Stage.stride        every m-th observation (step 2); the paper's rate is 1/m
    K        Stage.iterations    EM iterations at that rate
    tau      trace               k / K in eq. 11
    eps      SMOOTHING           added to the transitions between rates (step 5)

Beyond the paper a stage may temper the emissions: their log-densities are multiplied by a
temperature that rises through the stage. 24 sharp Gaussians outweigh any transition, so untempered
EM freezes into its first assignment; tempered, the grid unfolds before the emissions decide.
"""

import copy
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, Protocol

import torch
from torch import Tensor

from rfl_torch.hmm import GridHMM, Sequences, Statistics

SMOOTHING = 1e-3
"""Step 5's addition to every existing edge; outside the grid's edges it would undo the sparsity."""

PATIENCE = 3
"""Iterations in a row without gain that end a stage: the likelihood dips under trace and floor."""

FALL_RTOL = 1e-6
"""Relative fall of the likelihood that no rounding explains: sums of 256 steps are float32's."""

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


AddUp = Callable[[Tensor], Tensor]
"""Sums a tensor over the processes that learn one model together; see `distributed`."""


class LearningMonitor(Protocol):
    """What `learn` calls as it goes; `monitor.TensorBoardMonitor` is one."""

    def on_iteration(self, hmm: GridHMM, statistics: Statistics, progress: Progress) -> None:
        """Called after every M-step."""

    def on_stage_end(self, hmm: GridHMM, stage: int) -> None:
        """Called when a sub-sampling rate is done."""


@torch.no_grad()
def start(
    hmm: GridHMM,
    sequences: list[Tensor],
    kind: Literal["equal", "data"],
    seed: int,
    add_up: AddUp = torch.Tensor.clone,
) -> None:
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
        count = add_up((~data.isnan()).double().sum(0))
        mean = add_up(data.nansum(0)) / count
        scale = (add_up((data - mean).square().nansum(0)) / count).sqrt().clamp(min=0.01)
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
    record: list[Progress] | None = None,
    add_up: AddUp | None = None,
) -> list[Progress]:
    """Train `hmm` in place through all stages; returns the record of every iteration.

    Args:
        hmm: at the start of learning, or as it was after the last iteration in `record`.
        sequences: observations, (T, D) each.
        stages: the schedule.
        monitor: told of every iteration.
        record: of a run that stopped; the run goes on as if it had not.
        add_up: if given, `sequences` are one process's share of the logs.
    """
    record = list(record or [])
    reached = record[-1].stage if record else 0
    for index, stage in enumerate(stages):
        history = [progress for progress in record if progress.stage == index]
        if index < reached:
            continue
        if index > 0 and not history:
            smooth_transitions(hmm)
        steps = run_stage(hmm, sequences, stage, index, history=history, add_up=add_up)
        for statistics, progress in steps:
            record.append(progress)
            if monitor is not None:
                monitor.on_iteration(hmm, statistics, progress)
        if monitor is not None:
            monitor.on_stage_end(hmm, index)
    return record


def run_stage(
    hmm: GridHMM,
    sequences: list[Tensor],
    stage: Stage,
    index: int = 0,
    first: int = 0,
    history: Sequence[Progress] = (),
    add_up: AddUp | None = None,
) -> Iterator[tuple[Statistics, Progress]]:
    """EM at one rate, one iteration at a time.

    Args:
        hmm: trained in place.
        sequences: observations at the full rate.
        stage: what to do.
        index: number of the stage, for the record.
        first: iteration to begin with; by default the one after `history`.
        history: the stage's earlier iterations, which the stop rule counts on.
        add_up: sums the statistics over processes.

    Raises:
        RuntimeError: if the likelihood falls where nothing in the stage explains it.
    """
    data = subsample(sequences, stage.stride, stage.all_phases)
    watch = _Watch(stage)
    for progress in history:
        if watch.is_done(progress):
            return
    may_fall = True
    for iteration in range(first or len(history), stage.iterations):
        begin = time.perf_counter()
        temperature = stage.temperature_at(iteration)
        statistics = hmm.e_step(data, temperature)
        if add_up is not None:
            statistics = statistics.from_vector(add_up(statistics.to_vector()))
        per_step = statistics.log_likelihood.item() / statistics.num_steps
        if not may_fall:
            watch.refuse_fall(iteration, temperature, per_step)
        lowest = math.exp(hmm.emission_log_scale.detach().min().item())
        may_fall = lowest < stage.min_scale * (1 - 1e-9)
        hmm.m_step(
            statistics,
            min_scale=stage.min_scale,
            pseudo_count=stage.pseudo_count,
            trace=(iteration + 1) / stage.iterations if stage.trace else 0.0,
        )
        seconds = time.perf_counter() - begin
        progress = Progress(index, iteration, temperature, per_step, seconds)
        yield statistics, progress
        if watch.is_done(progress):
            return


class _Watch:
    """Follows a stage's likelihood: when it has settled, and whether it falls."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._previous, self._temperature = -math.inf, math.nan
        self._without_gain = 0

    def is_done(self, progress: Progress) -> bool:
        """Take note of an iteration; whether the stage ends with it."""
        per_step = progress.log_likelihood_per_step
        gain = per_step - self._previous
        settled = progress.temperature == self._stage.temperature[1]
        is_small = settled and gain < self._stage.tolerance * abs(per_step)
        self._without_gain = self._without_gain + 1 if is_small else 0
        self._previous, self._temperature = per_step, progress.temperature
        return self._without_gain >= PATIENCE and progress.iteration + 1 >= EARLIEST_STOP

    def refuse_fall(self, iteration: int, temperature: float, per_step: float) -> None:
        """Plain EM cannot lower the likelihood; trace, prior and a changing temperature can.

        The floor of the scales cannot either, once all scales are above it.
        """
        stage = self._stage
        is_plain = not stage.trace and stage.pseudo_count == 0 and temperature == self._temperature
        fall = self._previous - per_step
        if is_plain and not fall <= FALL_RTOL * max(1.0, abs(per_step)):  # also true for NaN
            raise RuntimeError(
                f"log-likelihood per step fell from {self._previous:.9g} to {per_step:.9g} at "
                f"iteration {iteration}, which EM cannot do; were the parameters or the "
                "observations changed in between, or is `min_scale` far below their rounding?"
            )


class Restart(NamedTuple):
    """One of several runs: its seed, held-out log-likelihood per step [nat], and record."""

    seed: int
    held_out_per_step: float
    record: list[Progress]


def learn_restarts(
    hmm: GridHMM,
    sequences: list[Tensor],
    held_out: list[Tensor],
    stages: tuple[Stage, ...],
    seeds: Iterable[int],
    kind: Literal["equal", "data"] = "data",
) -> list[Restart]:
    """Learn once from each seed and leave in `hmm` the model that explains `held_out` best.

    Returns the runs in the order of the seeds.
    """
    best, runs = -math.inf, []
    for seed in seeds:
        model = copy.deepcopy(hmm)
        start(model, sequences, kind, seed)
        record = learn(model, sequences, stages)
        num_steps = sum(len(sequence) for sequence in held_out)
        per_step = model.log_likelihood(held_out).item() / num_steps
        runs.append(Restart(seed, per_step, record))
        if per_step > best:
            best, chosen = per_step, model.state_dict()
    if best == -math.inf:
        raise ValueError("no seed was given, or none gave a finite held-out likelihood.")
    hmm.load_state_dict(chosen)
    return runs


def partial_fit(
    hmm: GridHMM,
    observations: Sequences,
    memory: Statistics | None = None,
    forgetting: float = 1.0,
    temperature: float = 1.0,
    **options: Any,
) -> Statistics:
    """Take one EM step on new observations and all that is remembered of earlier ones.

    Args:
        hmm: trained in place.
        observations: as for `GridHMM.e_step`.
        memory: what the call before returned.
        forgetting: weight of `memory`, 0 to 1; the memory's length is 1 / (1 - forgetting) calls.
        temperature: power of the emission densities.
        options: for `GridHMM.m_step`.

    Returns:
        The statistics to hand to the next call.
    """
    if not 0 <= forgetting <= 1:
        raise ValueError(f"forgetting is {forgetting}, needs 0 to 1.")
    statistics = hmm.e_step(observations, temperature)
    if memory is not None:
        statistics = memory.scaled(forgetting) + statistics
    hmm.m_step(statistics, **options)
    return statistics


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
