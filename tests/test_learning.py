"""`rfl_torch.learning`: the schedule as section 2.2 has it, and that learning learns."""

import copy
import itertools
import math

import pytest
import torch

from rfl_torch import learning
from rfl_torch.hmm import GridHMM
from rfl_torch.learning import EARLIEST_STOP, PATIENCE, SMOOTHING, Stage

EXACT_ATOL = 1e-12  # float64 against float64


def ring_hmm(scale=0.05):
    """A known chain: eight nodes on a ring whose two readings are the angle's cosine and sine."""
    hmm = GridHMM((1, 8), 2, radius=1.0, boundary="torus")
    angle = torch.arange(8) * (2 * math.pi / 8)
    with torch.no_grad():
        hmm.emission_mean.copy_(0.5 + 0.4 * torch.stack([angle.cos(), angle.sin()], 1))
        hmm.emission_log_scale.fill_(math.log(scale))
        ahead = (hmm.successor - torch.arange(8)[:, None]) % 8
        hmm.transition_logits[ahead == 0] = math.log(0.2)
        hmm.transition_logits[ahead == 1] = math.log(0.7)
        hmm.transition_logits[ahead == 7] = math.log(0.1)
    return hmm


def draw(hmm, num_steps, seed=0):
    return hmm.sample(num_steps, torch.Generator().manual_seed(seed)).observations


def state(hmm):
    return {name: tensor.clone() for name, tensor in hmm.state_dict().items()}


def is_equal(a, b):
    return all(torch.equal(a[name], b[name]) for name in a)


def per_step(hmm, observations):
    return hmm.log_likelihood(observations).item() / len(observations)


class Recorder:
    """Collects what `learn` reports."""

    def __init__(self):
        self.progress, self.ended = [], []

    def on_iteration(self, hmm, statistics, progress):
        self.progress.append(progress)

    def on_stage_end(self, hmm, stage):
        self.ended.append(stage)


def test_the_trace_of_iteration_k_is_k_over_the_number_of_iterations(monkeypatch):
    seen = []
    m_step = GridHMM.m_step

    def spy(self, statistics, **options):
        seen.append(options["trace"])
        m_step(self, statistics, **options)

    monkeypatch.setattr(GridHMM, "m_step", spy)
    hmm, observations = ring_hmm(), draw(ring_hmm(), 50)
    stage = Stage(stride=1, iterations=4, trace=True, tolerance=-math.inf)
    list(learning.run_stage(hmm, [observations], stage))
    assert seen == [1 / 4, 2 / 4, 3 / 4, 1.0]
    seen.clear()
    list(learning.run_stage(hmm, [observations], Stage(stride=1, iterations=2)))
    assert seen == [0.0, 0.0]


def test_the_first_traced_iteration_is_equation_11():
    hmm, observations = ring_hmm(0.2), draw(ring_hmm(), 80)
    before, plain = copy.deepcopy(hmm), copy.deepcopy(hmm)
    plain.m_step(plain.e_step(observations), min_scale=0.01)
    next(learning.run_stage(hmm, [observations], Stage(stride=1, iterations=10, trace=True)))
    tau = 1 / 10
    expected = (1 - tau) * plain.emission_mean + tau * before.emission_mean
    torch.testing.assert_close(hmm.emission_mean, expected, atol=EXACT_ATOL, rtol=0.0)
    assert torch.equal(hmm.transition_logits, plain.transition_logits)


@pytest.mark.parametrize("stride", [1, 2, 3, 7, 10, 12])
def test_subsampling_keeps_every_stride_th_observation(stride):
    logs = [torch.arange(float(n))[:, None] for n in (10, 3, 1)]
    first = learning.subsample(logs, stride, all_phases=False)
    assert [log.flatten().tolist() for log in first] == [
        list(range(0, n, stride)) for n in (10, 3, 1)
    ]
    phases = learning.subsample(logs, stride, all_phases=True)
    assert [log.flatten().tolist() for log in phases] == [
        list(range(phase, n, stride)) for n in (10, 3, 1) for phase in range(min(stride, n))
    ]


def test_smoothing_adds_to_every_existing_edge_and_to_no_other():
    hmm = GridHMM((3, 4), 1)
    with torch.no_grad():
        hmm.transition_logits.copy_(
            20 * torch.randn(12, 13, generator=torch.Generator().manual_seed(0))
        )
    before = hmm.transition_matrix().detach()
    learning.smooth_transitions(hmm)
    edges = before > 0
    raised = torch.where(edges, before + SMOOTHING, 0.0)
    expected = raised / raised.sum(1, keepdim=True)
    after = hmm.transition_matrix().detach()
    torch.testing.assert_close(after, expected, atol=EXACT_ATOL, rtol=0.0)
    assert (after[~edges] == 0).all()
    assert after[edges].min() > 0.9 * SMOOTHING


def test_learning_smooths_between_stages_only(monkeypatch):
    calls = []
    monkeypatch.setattr(learning, "smooth_transitions", lambda hmm: calls.append(len(record.ended)))
    record = Recorder()
    stages = tuple(Stage(stride, 2) for stride in (4, 2, 1))
    learning.learn(ring_hmm(), [draw(ring_hmm(), 60)], stages, record)
    assert calls == [1, 2]
    assert record.ended == [0, 1, 2]
    assert [(p.stage, p.iteration) for p in record.progress] == [
        (s, k) for s in range(3) for k in range(2)
    ]


def test_the_record_holds_the_likelihood_before_each_m_step():
    hmm, observations = ring_hmm(0.2), draw(ring_hmm(), 60)
    expected = per_step(hmm, observations)
    record = learning.learn(hmm, [observations], (Stage(stride=1, iterations=3),))
    assert record[0].log_likelihood_per_step == pytest.approx(expected, abs=1e-6)
    assert record[2].log_likelihood_per_step > expected


def test_a_stage_stops_after_patience_iterations_without_gain():
    stage = Stage(stride=1, iterations=100, tolerance=math.inf)
    record = learning.learn(ring_hmm(), [draw(ring_hmm(), 60)], (stage,))
    # The first iteration has nothing to gain over, but `inf < inf` is False: it counts as a gain.
    assert len(record) == max(PATIENCE + 1, EARLIEST_STOP)


def test_a_converged_stage_stops_and_a_tempered_one_waits_for_its_last_temperature():
    observations = draw(ring_hmm(), 200)
    hmm = ring_hmm()
    plain = learning.learn(hmm, [observations], (Stage(1, 200, tolerance=1e-6),))
    assert EARLIEST_STOP <= len(plain) < 100
    tempered = Stage(1, 50, temperature=(0.1, 0.7), tolerance=1e-3)
    record = learning.learn(ring_hmm(), [observations], (tempered,))
    assert record[-1].temperature == 0.7
    assert len(record) >= math.ceil(0.8 * 49) + 1
    assert len(record) < 50


@pytest.mark.parametrize("first", [0.01, 0.02, 0.3, 1.0])
@pytest.mark.parametrize("last", [0.33, 0.7, 1.0])
@pytest.mark.parametrize("iterations", [2, 5, 50])
def test_the_temperature_runs_from_its_first_value_to_exactly_its_last(first, last, iterations):
    stage = Stage(stride=1, iterations=iterations, temperature=(first, last))
    course = [stage.temperature_at(k) for k in range(iterations)]
    assert course[0] == first
    assert course[-1] == last
    ordered = sorted(course, reverse=first > last)
    assert course == pytest.approx(ordered, rel=1e-12)
    if iterations == 50:  # the last fifth is untempered; halfway to it is the geometric mean
        assert course[40:] == [last] * 10
        middle = math.log(course[20] / first)
        assert middle == pytest.approx(20 / 39.2 * math.log(last / first), abs=1e-9)


@pytest.mark.parametrize("kind", ["equal", "data"])
def test_the_same_seed_gives_identical_tensors(kind):
    observations = draw(ring_hmm(), 200)
    results = []
    for seed in (3, 3, 4):
        hmm = GridHMM((3, 4), 2)
        learning.start(hmm, [observations], kind, seed)
        stages = (Stage(2, 6, temperature=(0.1, 1.0)), Stage(1, 4, trace=True))
        learning.learn(hmm, [observations], stages)
        results.append(state(hmm))
    assert is_equal(results[0], results[1])
    assert not is_equal(results[0], results[2])


def test_the_papers_start_has_equal_means_and_scales():
    hmm = ring_hmm()
    learning.start(hmm, [], "equal", seed=0)
    assert (hmm.emission_mean == 0.5).all()
    torch.testing.assert_close(
        hmm.emission_scale.detach(), torch.full((8, 2), 0.05).double(), rtol=1e-7, atol=0.0
    )
    assert (hmm.initial_logits == 0).all()
    prob = hmm.log_transition().exp()[hmm.successor_mask]
    torch.testing.assert_close(prob, torch.full_like(prob, 1 / 3), rtol=0.02, atol=0.0)
    assert prob.unique().numel() > 8  # else exact EM could never tell two mirrored nodes apart


def test_the_start_from_data_has_its_mean_and_scale_and_skips_missing_readings():
    hmm, observations = ring_hmm(), draw(ring_hmm(), 400)
    whole_mean, whole_scale = observations.mean(0), observations.std(0, correction=0)
    gap = torch.full((100, 2), torch.nan, dtype=torch.float64)
    learning.start(hmm, [observations, gap], "data", seed=0)
    mean, scale = hmm.emission_mean.detach(), hmm.emission_scale.detach()
    torch.testing.assert_close(mean, whole_mean.expand(8, 2), rtol=0.0, atol=0.05)
    torch.testing.assert_close(scale, whole_scale.expand(8, 2), rtol=EXACT_ATOL, atol=EXACT_ATOL)


@pytest.mark.parametrize("kind", ["equal", "data"])
def test_learning_approaches_the_likelihood_of_the_chain_that_made_the_data(kind):
    truth = ring_hmm()
    training, other = draw(truth, 600, seed=1), draw(truth, 600, seed=2)
    hmm = GridHMM((1, 8), 2, radius=1.0, boundary="torus")
    learning.start(hmm, [training], kind, seed=0)
    start = per_step(hmm, other)
    stages = (Stage(1, 60, temperature=(0.02, 1.0), pseudo_count=0.1), Stage(1, 40))
    learning.learn(hmm, [training], stages)
    assert per_step(hmm, training) > per_step(truth, training) - 0.5
    assert per_step(hmm, other) > max(start + 1, per_step(truth, other) - 0.8)


def test_pruning_drops_the_unvisited_nodes_and_only_those():
    hmm = ring_hmm(scale=0.01)
    nodes = torch.tensor([0, 1, 2, 3, 2, 1, 0, 7, 0])
    logs = [hmm.emission_mean[nodes].detach(), hmm.emission_mean[[4, 4]].detach()]
    means = hmm.emission_mean.detach().clone()
    learning.prune(hmm, logs)
    assert torch.equal(hmm.emission_mean, means[[0, 1, 2, 3, 4, 7]])
    paths = [hmm.most_likely_path(log).tolist() for log in logs]
    assert paths == [[0, 1, 2, 3, 2, 1, 0, 5, 0], [4, 4]]
    learning.prune(hmm, logs)
    assert hmm.num_nodes == 6


def test_the_papers_schedule_has_200_iterations_at_each_of_its_rates():
    stages = learning.paper_stages()
    assert [stage.stride for stage in stages] == [10, 5, 2, 1]
    for stage in stages:
        assert (stage.iterations, stage.trace, stage.temperature) == (200, True, (1.0, 1.0))
        assert (stage.pseudo_count, stage.min_scale) == (0.0, 0.01)


@pytest.mark.parametrize("cut_after", [1, 5, 9])
@pytest.mark.parametrize("tolerance", [0.0, 1e-3])
def test_a_stage_taken_up_midway_goes_on_as_if_it_had_never_stopped(cut_after, tolerance):
    observations = draw(ring_hmm(), 100)
    stage = Stage(1, 30, temperature=(0.5, 1.0), trace=tolerance == 0.0, tolerance=tolerance)
    whole, cut = ring_hmm(0.2), ring_hmm(0.2)
    record = [p for _, p in learning.run_stage(whole, [observations], stage)]
    history = []
    for _, progress in learning.run_stage(cut, [observations], stage):
        history.append(progress)
        if progress.iteration == cut_after:
            break
    rest = learning.run_stage(cut, [observations], stage, history=history)
    history += [progress for _, progress in rest]
    assert is_equal(state(whole), state(cut))
    assert [p.iteration for p in history] == [p.iteration for p in record]


@pytest.mark.parametrize("cut_after", [3, 6, 9])
def test_a_schedule_taken_up_midway_goes_on_as_if_it_had_never_stopped(cut_after):
    observations, stages = draw(ring_hmm(), 200), (Stage(2, 6, trace=True), Stage(1, 5))
    whole, cut = ring_hmm(0.2), ring_hmm(0.2)
    record = learning.learn(whole, [observations], stages)

    class Stop(Exception):  # noqa: N818
        pass

    class Crash(Recorder):
        def on_iteration(self, hmm, statistics, progress):
            super().on_iteration(hmm, statistics, progress)
            if len(self.progress) == cut_after:
                raise Stop

    crash = Crash()
    with pytest.raises(Stop):
        learning.learn(cut, [observations], stages, crash)
    resumed = learning.learn(cut, [observations], stages, record=crash.progress)
    assert is_equal(state(whole), state(cut))
    assert [(p.stage, p.iteration) for p in resumed] == [(p.stage, p.iteration) for p in record]


def test_a_falling_likelihood_is_an_error_where_only_em_is_at_work():
    def run(**options):
        hmm, observations = ring_hmm(), draw(ring_hmm(), 100)
        for _, progress in learning.run_stage(hmm, [observations], Stage(1, 6, **options)):
            if progress.iteration == 2:  # somebody spoils the model
                with torch.no_grad():
                    hmm.emission_mean += 0.2
        return progress

    with pytest.raises(RuntimeError, match=r"fell from .* iteration 3, which EM cannot do"):
        run()
    for explained in ({"trace": True}, {"pseudo_count": 1.0}, {"temperature": (0.5, 1.0)}):
        assert run(**explained).iteration == 5


@pytest.mark.parametrize("min_scale", [0.001, 0.01, 0.1])
@pytest.mark.parametrize("temperature", [0.2, 1.0])
def test_plain_em_never_lowers_the_likelihood_floor_or_not(min_scale, temperature):
    hmm, observations = ring_hmm(0.05), draw(ring_hmm(), 300)
    stage = Stage(1, 40, (temperature, temperature), min_scale=min_scale, tolerance=-math.inf)
    record = learning.learn(hmm, [observations], (stage,))
    course = [p.log_likelihood_per_step for p in record]
    first = 1 if min_scale > 0.05 else 0  # the start was under the floor
    assert all(b >= a - 1e-6 for a, b in itertools.pairwise(course[first:]))


def test_of_several_restarts_the_best_on_held_out_data_is_kept():
    truth = ring_hmm()
    training, held_out = draw(truth, 200, seed=1), draw(truth, 200, seed=2)
    hmm = GridHMM((1, 8), 2, radius=1.0, boundary="torus")
    stages = (Stage(1, 15, temperature=(0.05, 1.0), pseudo_count=0.1),)
    runs = learning.learn_restarts(hmm, [training], [held_out], stages, range(3))
    assert [run.seed for run in runs] == [0, 1, 2]
    best = max(run.held_out_per_step for run in runs)
    assert best > min(run.held_out_per_step for run in runs)
    assert per_step(hmm, held_out) == pytest.approx(best, abs=1e-12)
    with pytest.raises(ValueError, match="no seed"):
        learning.learn_restarts(hmm, [training], [held_out], stages, [])


def test_a_partial_fit_with_full_memory_is_em_on_the_pooled_statistics():
    hmm, logs = ring_hmm(), [draw(ring_hmm(), 60, seed) for seed in range(2)]
    pooled = copy.deepcopy(hmm)
    first = hmm.e_step(logs[0])
    memory = learning.partial_fit(hmm, logs[0], pseudo_count=0.1)
    second = hmm.e_step(logs[1])
    memory = learning.partial_fit(hmm, logs[1], memory, pseudo_count=0.1)
    pooled.m_step(first + second, pseudo_count=0.1)
    assert is_equal(state(hmm), state(pooled))
    assert memory.num_steps == 120


def test_a_partial_fit_that_forgets_follows_a_changed_world():
    hmm, moved = ring_hmm(), ring_hmm()
    with torch.no_grad():
        moved.emission_mean += 0.05
    memory = learning.partial_fit(hmm, draw(ring_hmm(), 400))
    for seed in range(12):
        memory = learning.partial_fit(hmm, draw(moved, 100, seed), memory, forgetting=0.5)
    assert memory.num_steps < 201
    torch.testing.assert_close(hmm.emission_mean, moved.emission_mean, rtol=0.0, atol=0.03)
    with pytest.raises(ValueError, match=r"forgetting is 1\.5"):
        learning.partial_fit(hmm, draw(moved, 10), memory, forgetting=1.5)
