"""`rfl_torch.hmm`: the surface that users rely on, and the M-step against closed forms."""

import copy
import itertools
import math
import pickle
from dataclasses import fields

import numpy as np
import pytest
import torch

from rfl_torch import inference
from rfl_torch.hmm import MIN_LOG_PROB, GridHMM, Statistics

EXACT_ATOL = 1e-12  # float64 against float64
POSTERIOR_ATOL = 1e-6  # float32 probabilities
LIKELIHOOD_FALL_RTOL = 1e-9  # what rounding may take from EM's guarantee


def random_hmm(shape=(3, 4), obs_dim=2, seed=0, scale=0.1, **graph):
    generator = torch.Generator().manual_seed(seed)
    hmm = GridHMM(shape, obs_dim, **graph)
    with torch.no_grad():
        for logits in (hmm.transition_logits, hmm.initial_logits):
            logits.copy_(torch.randn(logits.shape, generator=generator))
        hmm.emission_mean.copy_(torch.rand(hmm.emission_mean.shape, generator=generator))
        hmm.emission_log_scale.fill_(math.log(scale))
    return hmm


def draw(hmm, num_steps, seed=0):
    return hmm.sample(num_steps, torch.Generator().manual_seed(seed)).observations


def known_statistics(hmm, seed=0):
    """Counts as an E-step could give, with nothing equal; node 3 was never visited."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    num_nodes, obs_dim = hmm.emission_mean.shape
    weight = 5 + rand(num_nodes, obs_dim)
    mean, variance = rand(num_nodes, obs_dim), 0.01 + rand(num_nodes, obs_dim)
    edge = (1 + rand(*hmm.successor.shape)) * hmm.successor_mask
    statistics = Statistics(
        initial=rand(num_nodes),
        node=weight[:, 0],
        edge=edge,
        weight=weight,
        first=weight * mean,
        second=weight * (variance + mean**2),
        log_likelihood=torch.tensor(-1.0, dtype=torch.float64),
        num_steps=50,
    )
    for field in ("initial", "node", "edge", "weight", "first", "second"):
        getattr(statistics, field)[3] = 0
    return statistics, mean, variance


def close(actual, expected, **tolerances):
    actual, expected = torch.as_tensor(actual).detach(), torch.as_tensor(expected).detach()
    torch.testing.assert_close(
        actual.double(), expected.double(), **{"rtol": 0.0, "atol": 0.0} | tolerances
    )


def test_names_and_shapes_are_the_contracts():
    hmm = GridHMM(shape=(20, 20), obs_dim=24, radius=2.0)
    shapes = {name: tuple(parameter.shape) for name, parameter in hmm.named_parameters()}
    assert shapes == {
        "transition_logits": (400, 13),
        "emission_mean": (400, 24),
        "emission_log_scale": (400, 24),
        "initial_logits": (400,),
    }
    assert {"successor", "successor_mask"} <= dict(hmm.named_buffers()).keys()
    assert hmm.successor.shape == hmm.successor_mask.shape == (400, 13)
    assert (hmm.successor.dtype, hmm.successor_mask.dtype) == (torch.int64, torch.bool)
    assert hmm.transition_matrix().shape == (400, 400)
    observations = torch.rand(30, 24, generator=torch.Generator().manual_seed(0))
    assert hmm.log_likelihood(observations).shape == ()
    assert hmm.filter(observations).shape == hmm.smooth(observations).shape == (30, 400)
    path = hmm.most_likely_path(observations)
    assert (path.shape, path.dtype) == ((30,), torch.int64)
    belief = hmm.filter(observations)[-1]
    assert hmm.forecast(belief, 3).shape == (3, 400)
    assert hmm.forecast(belief, 0).shape == (0, 400)
    assert hmm.update(belief, observations[0]).shape == (400,)
    assert [tensor.shape for tensor in hmm.forecast_observation(belief)] == [(24,), (24,)]
    assert GridHMM((2, 3, 4), obs_dim=1).num_nodes == 24


def test_the_start_is_the_papers():
    hmm = GridHMM((4, 5), 3)
    neighbors = hmm.successor_mask.sum(1, keepdim=True)
    expected = torch.where(hmm.successor_mask, 1 / neighbors, 0.0)
    close(hmm.log_transition().exp(), expected, atol=1e-7)
    close(hmm.initial_logits.softmax(0), torch.full((20,), 1 / 20), atol=1e-7)
    assert (hmm.emission_mean == 0.5).all()
    close(hmm.emission_scale, torch.full((20, 3), 0.05), atol=1e-7)


@pytest.mark.parametrize(
    "graph",
    [{}, {"boundary": "torus"}, {"metric": "chebyshev"}, {"radius": 1.0}, {"shape": (2, 3, 3)}],
)
def test_transition_rows_sum_to_one_and_vanish_off_the_graph(graph):
    hmm = random_hmm(**graph)
    matrix = hmm.transition_matrix().detach()
    close(matrix.sum(1), torch.ones(hmm.num_nodes), atol=EXACT_ATOL)
    joined = torch.zeros(matrix.shape, dtype=torch.bool)
    for i, k in hmm.successor_mask.nonzero().tolist():
        joined[i, hmm.successor[i, k]] = True
    assert torch.equal(matrix > 0, joined)


def test_the_m_step_is_the_closed_form_of_equations_7_to_10():
    hmm = random_hmm()
    statistics, mean, variance = known_statistics(hmm)
    hmm.m_step(statistics)
    seen = torch.arange(hmm.num_nodes) != 3
    close(hmm.emission_mean[seen], mean[seen], atol=EXACT_ATOL)
    close(hmm.emission_scale[seen] ** 2, variance[seen], atol=EXACT_ATOL)
    edge = statistics.edge / statistics.edge.sum(1, keepdim=True)
    close(hmm.log_transition().exp()[seen], edge[seen], atol=EXACT_ATOL)
    initial = statistics.initial / statistics.initial.sum()
    close(hmm.initial_logits.softmax(0), initial, atol=EXACT_ATOL)


def test_nodes_without_data_keep_their_parameters():
    hmm = random_hmm()
    before = copy.deepcopy(hmm)
    hmm.m_step(known_statistics(hmm)[0])
    for name in ("emission_mean", "emission_log_scale", "transition_logits"):
        assert torch.equal(getattr(hmm, name)[3], getattr(before, name)[3])
        assert not torch.equal(getattr(hmm, name)[2], getattr(before, name)[2])


def test_a_node_that_a_real_log_never_visits_keeps_its_parameters():
    """Its counts are 1e-37, not 0: what the messages flush to, so their ratios mean nothing."""
    hmm = random_hmm(scale=0.01)
    before = copy.deepcopy(hmm)
    observations = hmm.emission_mean[torch.tensor([0, 1] * 20)].detach()
    unseen = hmm.e_step(observations).node < 1e-8
    hmm.m_step(hmm.e_step(observations))
    assert unseen.sum() == hmm.num_nodes - 2
    for name in ("emission_mean", "emission_log_scale"):
        assert torch.equal(getattr(hmm, name)[unseen], getattr(before, name)[unseen])
    close(
        hmm.log_transition()[unseen].exp(), before.log_transition()[unseen].exp(), atol=EXACT_ATOL
    )


def test_pseudo_counts_enter_every_edge_that_exists():
    hmm = random_hmm()
    statistics, _, _ = known_statistics(hmm)
    hmm.m_step(statistics, pseudo_count=0.5)
    counts = (statistics.edge + 0.5) * hmm.successor_mask
    expected = counts / counts.sum(1, keepdim=True)
    close(hmm.log_transition().exp(), expected, atol=EXACT_ATOL)


def test_the_trace_keeps_its_share_of_means_and_variances_only():
    hmm = random_hmm()
    before = copy.deepcopy(hmm)
    statistics, mean, variance = known_statistics(hmm)
    hmm.m_step(statistics, trace=0.25)
    seen = torch.arange(hmm.num_nodes) != 3
    expected_mean = 0.75 * mean + 0.25 * before.emission_mean
    expected_variance = 0.75 * variance + 0.25 * before.emission_scale**2
    close(hmm.emission_mean[seen], expected_mean[seen], atol=EXACT_ATOL)
    close(hmm.emission_scale[seen] ** 2, expected_variance[seen], atol=EXACT_ATOL)
    edge = statistics.edge / statistics.edge.sum(1, keepdim=True)
    close(hmm.log_transition().exp()[seen], edge[seen], atol=EXACT_ATOL)


def test_fixed_parameters_stay():
    names = [name for name, _ in GridHMM((2, 2), 1).named_parameters()]
    for fixed in names:
        hmm = random_hmm()
        before = copy.deepcopy(hmm)
        hmm.m_step(known_statistics(hmm)[0], fixed=frozenset({fixed}))
        for name in names:
            is_same = torch.equal(getattr(hmm, name), getattr(before, name))
            assert is_same == (name == fixed)


def test_no_scale_falls_under_the_floor():
    hmm = random_hmm()
    observations = torch.full((30, 2), 0.3)
    for _ in range(3):
        hmm.m_step(hmm.e_step(observations), min_scale=0.02)
    assert hmm.emission_scale.min() >= 0.02 * (1 - EXACT_ATOL)
    assert torch.isfinite(hmm.log_likelihood(observations))


@pytest.mark.parametrize("missing", [0.0, 0.2])
@pytest.mark.parametrize("graph", [{}, {"boundary": "torus"}, {"shape": (2, 2, 3)}])
def test_the_log_likelihood_never_falls_under_plain_em(graph, missing):
    observations = draw(random_hmm(seed=1, scale=0.05, **graph), 300, seed=1)
    is_missing = torch.rand(observations.shape, generator=torch.Generator().manual_seed(2))
    observations[is_missing < missing] = torch.nan
    hmm = random_hmm(seed=2, scale=0.3, **graph)
    record = []
    for _ in range(40):
        statistics = hmm.e_step([observations[:100], observations[100:]])
        record.append(statistics.log_likelihood.item())
        hmm.m_step(statistics, min_scale=1e-4)
    assert record[-1] > record[0] + 100
    for before, after in itertools.pairwise(record):
        assert after >= before - LIKELIHOOD_FALL_RTOL * abs(before)


def test_forbidden_edges_never_open():
    hmm = random_hmm((4, 4), radius=1.0, scale=0.02)
    forbidden = hmm.transition_matrix() == 0
    teleports = torch.cat([draw(hmm, 4, seed) for seed in range(25)])
    for pseudo_count in (0.0, 0.0, 0.0, 0.1):
        hmm.m_step(hmm.e_step(teleports), pseudo_count=pseudo_count)
        assert (hmm.transition_matrix()[forbidden] == 0).all()
        close(hmm.transition_matrix().sum(1), torch.ones(16), atol=EXACT_ATOL)


def test_statistics_of_a_list_are_the_sum_of_separate_ones():
    hmm = random_hmm()
    logs = [draw(hmm, 20, 1), draw(hmm, 1, 2), draw(hmm, 33, 3)]
    together, apart = hmm.e_step(logs), [hmm.e_step(log) for log in logs]
    total = apart[0] + apart[1] + apart[2]
    for field in fields(Statistics):
        close(getattr(together, field.name), getattr(total, field.name))
    close(together.scaled(0.5).edge, 0.5 * together.edge)


def test_an_update_is_a_step_of_the_filter():
    hmm = random_hmm()
    observations = draw(hmm, 40)
    observations[7] = torch.nan
    filtered = hmm.filter(observations)
    belief = filtered[0]
    for t in range(1, len(observations)):
        belief = hmm.update(belief, observations[t])
        close(belief, filtered[t], atol=POSTERIOR_ATOL)
    assert not belief.requires_grad  # else a controller's graph would grow for ever


@pytest.mark.parametrize("graph", [{}, {"boundary": "torus"}])
def test_a_forecast_is_a_power_of_the_transition_matrix(graph):
    hmm = random_hmm(**graph)
    belief = torch.rand(12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    belief /= belief.sum()
    matrix = hmm.transition_matrix().detach()
    powers = torch.stack([belief @ torch.linalg.matrix_power(matrix, n) for n in range(1, 6)])
    close(hmm.forecast(belief, 5), powers, atol=EXACT_ATOL)


def test_a_forecast_observation_is_the_mixtures_mean_and_deviation():
    hmm = random_hmm()
    belief = torch.zeros(12, dtype=torch.float64)
    belief[[2, 5]] = torch.tensor([0.3, 0.7], dtype=torch.float64)
    mean, deviation = hmm.forecast_observation(belief)
    first, second = hmm.emission_mean[[2, 5]]
    expected = 0.3 * first + 0.7 * second
    between = 0.3 * (first - expected) ** 2 + 0.7 * (second - expected) ** 2
    close(mean, expected, atol=EXACT_ATOL)
    close(deviation, (between + 0.1**2).sqrt(), atol=EXACT_ATOL)


def test_a_sample_has_the_models_frequencies_means_and_scales():
    hmm = random_hmm((2, 3), seed=3)
    num_steps = 8_000
    nodes, observations = hmm.sample(num_steps, torch.Generator().manual_seed(0))
    assert (nodes.shape, observations.shape) == ((num_steps,), (num_steps, 2))
    counts = torch.zeros(6, 6).double()
    counts.index_put_((nodes[:-1], nodes[1:]), torch.ones(num_steps - 1).double(), accumulate=True)
    visits = counts.sum(1, keepdim=True)
    matrix = hmm.transition_matrix().detach()
    error = (matrix * (1 - matrix) / visits).sqrt()  # of a frequency
    assert ((counts / visits - matrix).abs() <= 5 * error).all()
    for node in range(6):
        own = observations[nodes == node]
        error = 0.1 / math.sqrt(len(own))
        close(own.mean(0), hmm.emission_mean[node], atol=5 * error)
        close(own.std(0), hmm.emission_scale[node], atol=5 * error)
    starts = torch.stack(
        [hmm.sample(1, torch.Generator().manual_seed(seed)).nodes[0] for seed in range(500)]
    )
    close(starts.bincount(minlength=6) / 500, hmm.initial_logits.softmax(0), atol=0.1)


def test_keep_nodes_leaves_the_subgraph_renormalised():
    hmm = random_hmm((4, 4))
    before = copy.deepcopy(hmm)
    kept = torch.ones(16, dtype=torch.bool)
    kept[[0, 5, 6, 13]] = False
    hmm.keep_nodes(kept)
    assert hmm.num_nodes == 12
    close(hmm.emission_mean, before.emission_mean[kept])
    inside = before.transition_matrix()[kept][:, kept]
    close(hmm.transition_matrix(), inside / inside.sum(1, keepdim=True), atol=EXACT_ATOL)
    hmm.keep_nodes(torch.ones(12, dtype=torch.bool))
    close(hmm.transition_matrix(), inside / inside.sum(1, keepdim=True), atol=EXACT_ATOL)


def test_a_node_that_is_never_entered_can_go_without_a_trace():
    hmm = random_hmm((3, 3))
    with torch.no_grad():
        hmm.transition_logits.masked_fill_(hmm.successor == 4, MIN_LOG_PROB)
        hmm.initial_logits[4] = MIN_LOG_PROB
    smaller = copy.deepcopy(hmm)
    kept = torch.arange(9) != 4
    smaller.keep_nodes(kept)
    observations = draw(smaller, 50)
    close(smaller.smooth(observations), hmm.smooth(observations)[:, kept], atol=POSTERIOR_ATOL)
    path = torch.arange(9)[kept][smaller.most_likely_path(observations)]
    assert path.tolist() == hmm.most_likely_path(observations).tolist()


def test_no_node_left_is_an_error():
    with pytest.raises(ValueError, match="at least one"):
        random_hmm().keep_nodes(torch.zeros(12, dtype=torch.bool))


def test_a_state_dict_brings_everything_back():
    hmm = random_hmm()
    observations = draw(hmm, 30)
    other = random_hmm(seed=9)
    other.load_state_dict(hmm.state_dict())
    assert torch.equal(other.smooth(observations), hmm.smooth(observations))
    for twin in (copy.deepcopy(hmm), pickle.loads(pickle.dumps(hmm))):
        assert torch.equal(twin.smooth(observations), hmm.smooth(observations))


def test_a_state_dict_brings_another_graph_of_the_same_size():
    hmm = random_hmm((4, 4), radius=1.0, boundary="torus")
    other = random_hmm((4, 4), radius=1.0)
    assert other.successor.shape == hmm.successor.shape
    other.load_state_dict(hmm.state_dict())
    observations = draw(hmm, 60)
    assert torch.equal(other.smooth(observations), hmm.smooth(observations))
    assert torch.equal(other.e_step(observations).edge, hmm.e_step(observations).edge)


@pytest.mark.parametrize(
    ("observations", "message"),
    [
        (torch.rand(10, 3), r"shape \(10, 3\), need \(T, 2\)"),
        (torch.rand(10), r"shape \(10,\)"),
        (torch.rand(2, 10, 2), r"shape \(2, 10, 2\)"),
        (torch.zeros(0, 2), r"shape \(0, 2\)"),
        ([], "no sequence"),
        ([torch.rand(4, 2), torch.rand(4, 1)], r"shape \(4, 1\)"),
        (torch.tensor([[0.0, 0.0], [0.0, torch.inf]]), "observation 1, reading 1 is inf"),
        (torch.tensor([[-torch.inf, 0.0]]), "observation 0, reading 0 is -inf"),
        (np.array([[0.0, 0.0], [1e200, 0.0]]), r"observation 1, reading 0 is 1e\+200"),
    ],
)
def test_bad_observations_are_named(observations, message):
    hmm = random_hmm()
    for method in (hmm.log_likelihood, hmm.e_step):
        with pytest.raises(ValueError, match=message):
            method(observations)
    if not isinstance(observations, list):
        for method in (hmm.filter, hmm.smooth, hmm.most_likely_path):
            with pytest.raises(ValueError, match=message):
                method(observations)


def test_any_array_of_numbers_will_do():
    hmm = random_hmm(scale=0.5)
    observations = (draw(hmm, 20) * 3).round().numpy()
    expected = hmm.e_step(observations)
    read_only = observations.copy()
    read_only.flags.writeable = False
    for same in (
        read_only,
        observations.astype(np.int64),
        observations.astype(np.float32),
        np.asfortranarray(observations),
        np.repeat(observations, 2, axis=0)[::2],
        observations[::-1].copy()[::-1],
        torch.from_numpy(observations).to(torch.int32),
        torch.from_numpy(observations).bfloat16().float(),
        torch.from_numpy(observations).T.contiguous().T,
        torch.from_numpy(observations).requires_grad_(),
    ):
        close(hmm.e_step(same).edge, expected.edge)
        close(hmm.log_likelihood([same, same]), 2 * expected.log_likelihood, rtol=1e-9)
    belief = hmm.filter(observations)[0]
    for one in (observations[1], read_only[1], torch.from_numpy(observations[1])):
        close(hmm.update(belief, one), hmm.filter(observations)[1], atol=POSTERIOR_ATOL)


def test_observations_are_not_written_to():
    hmm = random_hmm()
    observations = draw(hmm, 20)
    observations[3, 1] = torch.nan
    before = observations.clone()
    hmm.m_step(hmm.e_step(observations))
    hmm.most_likely_path(observations)
    close(observations, before, equal_nan=True)


def test_a_narrow_gaussian_far_from_zero_keeps_its_variance():
    """Sums of squares are taken about the data's centre: about zero, float32 would lose it."""
    hmm = GridHMM((1, 1), 1)
    generator = torch.Generator().manual_seed(0)
    observations = 1_000 + 0.01 * torch.randn(500, 1, generator=generator, dtype=torch.float64)
    hmm.m_step(hmm.e_step(observations), min_scale=1e-6)
    close(hmm.emission_mean[0], observations.mean(0), rtol=1e-9)
    close(hmm.emission_scale[0], observations.std(0, correction=0), rtol=1e-3)


def test_the_criteria_count_what_em_is_free_to_choose():
    hmm = random_hmm()
    observations = draw(hmm, 50)
    num_edges = int(hmm.successor_mask.sum())
    free = (num_edges - 12) + 11 + 2 * hmm.emission_mean.numel()
    assert hmm.num_free_parameters() == free
    log_likelihood = hmm.log_likelihood(observations).item()
    assert hmm.aic(observations) == pytest.approx(2 * free - 2 * log_likelihood)
    assert hmm.bic([observations]) == pytest.approx(free * math.log(50) - 2 * log_likelihood)


def test_a_parameter_to_be_fixed_must_exist():
    hmm = random_hmm()
    with pytest.raises(ValueError, match=r"`fixed` names \['mean'\]"):
        hmm.m_step(hmm.e_step(draw(hmm, 5)), fixed=frozenset({"mean"}))


def test_a_filter_stepped_online_is_the_filter_and_its_evidence_the_likelihood():
    hmm = random_hmm()
    observations = draw(hmm, 40)
    filtered, chain = hmm.filter(observations), hmm.chain()
    state = inference.start_filter(chain, filtered[0].numpy())
    total = hmm.log_likelihood(observations[:1]).item()
    for t in range(1, 40):
        belief, evidence = inference.filter_step(chain, state, observations[t].numpy())
        close(torch.from_numpy(belief), filtered[t], atol=POSTERIOR_ATOL)
        total += evidence
    assert total == pytest.approx(hmm.log_likelihood(observations).item(), abs=1e-4)


@pytest.mark.parametrize("teleport", [1e-12, 0.01, 0.5])
def test_a_filter_with_teleports_mixes_in_the_uniform_belief(teleport):
    hmm = random_hmm()
    observations = torch.cat([draw(hmm, 10), 50 + draw(hmm, 1), draw(hmm, 10)])
    observations[5, 0] = torch.nan
    chain, matrix = hmm.chain(), hmm.transition_matrix().detach()
    state, belief = inference.start_filter(chain), torch.full((12,), 1 / 12).double()
    for observation in observations:
        predicted = (1 - teleport) * (belief @ matrix) + teleport / 12
        log_rows = inference.log_emission(chain, observation[None].numpy())[0, chain.cell]
        log_joint = predicted.log() + torch.from_numpy(log_rows)
        belief = log_joint.softmax(0)
        actual, evidence = inference.filter_step(chain, state, observation.numpy(), teleport)
        close(torch.from_numpy(actual), belief, atol=POSTERIOR_ATOL)
        assert evidence == pytest.approx(log_joint.logsumexp(0).item(), rel=1e-6, abs=1e-4)


def test_the_online_filter_never_loses_a_node():
    """A thousand frames of one place leave the others e**-10000 likely, and still possible."""
    hmm = random_hmm()
    with torch.no_grad():
        hmm.emission_log_scale.fill_(math.log(0.05))
    chain = hmm.chain()
    state = inference.start_filter(chain)
    here, there = hmm.emission_mean.detach()[[0, 11]].numpy()
    for _ in range(1_000):
        inference.filter_step(chain, state, here)
    for _ in range(20):
        belief, _ = inference.filter_step(chain, state, there)
    assert belief.argmax() == 11
