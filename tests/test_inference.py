"""`rfl_torch.inference` against `rfl_torch.logspace`, and both against the sum over every path."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp

from rfl_torch import inference, kernels, logspace
from rfl_torch.hmm import MIN_LOG_PROB, GridHMM

EXACT_ATOL = 1e-9  # float64 against float64
LIKELIHOOD_RTOL = 1e-9  # float32 mantissas; seen: 4e-11
LIKELIHOOD_ATOL = 1e-4  # [nat] rounding of the weights over 1,000 steps; seen: 2e-6
POSTERIOR_ATOL = 1e-6  # float32 probabilities; seen: 1e-7
COUNT_ATOL = 1e-5  # sums of those over 1,000 steps; seen: 1e-6
COUNT_RTOL = 1e-6  # float32 partial sums over 256 steps; seen: 2.5e-7


pytestmark = pytest.mark.usefixtures("one_thread")


def random_hmm(shape, obs_dim, seed, *, scale=0.1, spread=2.0, drop=0.0, **graph):
    """A model with nothing equal: transitions, start, means and scales are drawn."""
    generator = torch.Generator().manual_seed(seed)
    hmm = GridHMM(shape, obs_dim, **graph)
    with torch.no_grad():
        for logits in (hmm.transition_logits, hmm.initial_logits):
            logits.copy_(spread * torch.randn(logits.shape, generator=generator))
        hmm.emission_mean.copy_(torch.rand(hmm.emission_mean.shape, generator=generator))
        stretch = torch.rand(hmm.emission_mean.shape, generator=generator)
        hmm.emission_log_scale.copy_(math.log(scale) + stretch)
    if drop > 0:
        kept = torch.rand(hmm.num_nodes, generator=generator) >= drop
        kept[0] = True
        hmm.keep_nodes(kept)
    return hmm


def map_hmm(seed=0, scale=0.01):
    """400 nodes and 24 sharp readings that change smoothly over the grid, as a learned map's do."""
    generator = torch.Generator().manual_seed(seed)
    hmm = GridHMM((20, 20), 24)
    place = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0))
    wave = torch.rand(2, 24, generator=generator) - 0.5
    with torch.no_grad():
        hmm.emission_mean.copy_(0.5 + 0.4 * torch.sin(place @ wave))
        hmm.emission_log_scale.fill_(math.log(scale))
        shape = hmm.transition_logits.shape
        hmm.transition_logits.copy_(torch.randn(shape, generator=generator))
    return hmm


def log_chain(hmm, *, uniform_start=False):
    log_initial = hmm.initial_logits.detach().log_softmax(0).clamp(min=MIN_LOG_PROB)
    if uniform_start:
        log_initial = torch.full_like(log_initial, -math.log(hmm.num_nodes))
    log_transition = hmm.log_transition().detach().clamp(min=MIN_LOG_PROB)
    return logspace.LogChain(log_initial, log_transition, hmm.successor, hmm.successor_mask)


def log_rows(hmm, observations):
    mean, scale = hmm.emission_mean.detach(), hmm.emission_scale.detach()
    return logspace.emission_log_prob(torch.as_tensor(observations).double(), mean, scale)


def path_score(chain, rows, path):
    """Log p(path, observations); -inf if the path leaves the graph."""
    score = chain.log_initial[path[0]] + rows[0, path[0]]
    for t, (i, j) in enumerate(itertools.pairwise(path.tolist()), start=1):
        edge = (chain.successor[i] == j) & chain.mask[i]
        step = chain.log_transition[i, edge].item() if edge.any() else -math.inf
        score += step + rows[t, j]
    return score.item()


def close(actual, expected, **tolerances):
    actual, expected = torch.as_tensor(actual), torch.as_tensor(expected)
    torch.testing.assert_close(
        actual.double(), expected.double(), **{"rtol": 0.0, "atol": 0.0} | tolerances
    )


def check_against_logspace(hmm, observations):
    """Every result of the engine, next to the definition's."""
    chain, rows = log_chain(hmm), log_rows(hmm, observations)
    log_likelihood = logspace.log_likelihood(chain, rows)
    counts = logspace.expected_counts(chain, rows)
    smoothed = logspace.smoothed(chain, rows)
    statistics = hmm.e_step(observations)
    likelihood = {"rtol": LIKELIHOOD_RTOL, "atol": LIKELIHOOD_ATOL}
    close(hmm.log_likelihood(observations), log_likelihood, **likelihood)
    close(statistics.log_likelihood, log_likelihood, **likelihood)
    close(hmm.filter(observations), logspace.filtered(chain, rows), atol=POSTERIOR_ATOL)
    close(hmm.smooth(observations), smoothed, atol=POSTERIOR_ATOL)
    close(statistics.initial, counts.initial, atol=POSTERIOR_ATOL)
    close(statistics.node, counts.node, rtol=COUNT_RTOL, atol=COUNT_ATOL)
    close(statistics.edge, counts.edge, rtol=COUNT_RTOL, atol=COUNT_ATOL)
    check_moments(statistics, smoothed, observations)
    check_path(hmm, rows, hmm.most_likely_path(observations))


def check_moments(statistics, smoothed, observations):
    known = ~observations.isnan()
    filled = observations.nan_to_num()
    largest = max(1.0, filled.abs().max().item())
    for actual, feature, size in (
        (statistics.weight, known.double(), 1.0),
        (statistics.first, filled, largest),
        (statistics.second, filled**2, largest**2),
    ):
        close(actual, smoothed.T @ feature, rtol=COUNT_RTOL, atol=COUNT_ATOL * size)


def check_path(hmm, rows, path):
    chain = log_chain(hmm, uniform_start=True)
    expected = path_score(chain, rows, logspace.most_likely_path(chain, rows))
    actual = path_score(chain, rows, path)
    assert actual == pytest.approx(expected, rel=LIKELIHOOD_RTOL, abs=LIKELIHOOD_ATOL)


class EveryPath:
    """All N**T paths of a tiny chain with their log-probabilities: no recursion at all."""

    def __init__(self, hmm, observations, *, uniform_start=False):
        chain, rows = log_chain(hmm, uniform_start=uniform_start), log_rows(hmm, observations)
        log_dense = np.full((hmm.num_nodes, hmm.num_nodes), -np.inf)
        for i, k in chain.mask.nonzero().tolist():
            log_dense[i, chain.successor[i, k]] = chain.log_transition[i, k]
        num_steps = len(rows)
        self.num_nodes, self.chain = hmm.num_nodes, chain
        self.paths = np.array(list(itertools.product(range(hmm.num_nodes), repeat=num_steps)))
        self.score = chain.log_initial.numpy()[self.paths[:, 0]]
        self.score = self.score + rows.numpy()[np.arange(num_steps), self.paths].sum(1)
        self.score += log_dense[self.paths[:, :-1], self.paths[:, 1:]].sum(1)
        self.log_likelihood = logsumexp(self.score)
        self.prob = np.exp(self.score - self.log_likelihood)

    def smoothed(self):
        steps = [np.bincount(c, self.prob, self.num_nodes) for c in self.paths.T]
        return np.stack(steps)

    def edge(self):
        dense = np.zeros((self.num_nodes, self.num_nodes))
        for i, j in zip(self.paths[:, :-1].T, self.paths[:, 1:].T, strict=True):
            np.add.at(dense, (i, j), self.prob)
        sparse = np.take_along_axis(dense, self.chain.successor.numpy(), 1)
        return np.where(self.chain.mask, sparse, 0.0)


def tiny(name):
    """Chains small enough to sum over all paths: the model and its longest length."""
    return {
        "square": lambda: (random_hmm((2, 2), 2, 0, radius=1.0), 6),
        "line": lambda: (random_hmm((1, 5), 1, 1, radius=1.0), 5),
        "wide": lambda: (random_hmm((2, 3), 3, 2, radius=2.0, metric="chebyshev"), 5),
        "torus": lambda: (random_hmm((2, 3), 2, 3, radius=1.0, boundary="torus"), 5),
        "ring": lambda: (random_hmm((1, 6), 1, 4, radius=2.0, boundary="torus"), 5),
        "cube": lambda: (random_hmm((2, 1, 3), 2, 5, radius=math.sqrt(2)), 5),
        "pruned": lambda: (random_hmm((3, 4), 2, 6, drop=0.5), 5),
        "islands": lambda: (island_hmm(), 5),
        "one node": lambda: (random_hmm((1, 1), 2, 7), 6),
    }[name]()


def island_hmm():
    """Two corners that no edge joins once the nodes between them are gone."""
    hmm = random_hmm((3, 3), 2, 8, radius=1.0)
    kept = torch.ones(9, dtype=torch.bool)
    kept[[2, 4, 6]] = False
    hmm.keep_nodes(kept)
    return hmm


TINY = ["square", "line", "wide", "torus", "ring", "cube", "pruned", "islands", "one node"]


def tiny_case(name):
    hmm, longest = tiny(name)
    generator = torch.Generator().manual_seed(9)
    observations = torch.rand(longest, hmm.obs_dim, generator=generator, dtype=torch.float64)
    return hmm, [observations[:length] for length in range(1, longest + 1)]


@pytest.mark.parametrize("name", TINY)
def test_the_definition_is_the_sum_over_all_paths(name):
    hmm, cases = tiny_case(name)
    for observations in cases:
        every, chain, rows = (
            EveryPath(hmm, observations),
            log_chain(hmm),
            log_rows(hmm, observations),
        )
        counts = logspace.expected_counts(chain, rows)
        last = every.smoothed()[-1]
        close(logspace.log_likelihood(chain, rows), every.log_likelihood, atol=EXACT_ATOL)
        close(logspace.smoothed(chain, rows), every.smoothed(), atol=EXACT_ATOL)
        close(logspace.filtered(chain, rows)[-1], last, atol=EXACT_ATOL)
        close(counts.initial, every.smoothed()[0], atol=EXACT_ATOL)
        close(counts.node, every.smoothed().sum(0), atol=EXACT_ATOL)
        close(counts.edge, every.edge(), atol=EXACT_ATOL)
        best = every.paths[every.score.argmax()]
        assert logspace.most_likely_path(chain, rows).tolist() == best.tolist()


@pytest.mark.parametrize("name", TINY)
def test_the_engine_is_the_sum_over_all_paths(name):
    hmm, cases = tiny_case(name)
    for observations in cases:
        every, statistics = EveryPath(hmm, observations), hmm.e_step(observations)
        log_likelihood = every.log_likelihood
        close(hmm.log_likelihood(observations), log_likelihood, atol=POSTERIOR_ATOL)
        close(statistics.log_likelihood, log_likelihood, atol=POSTERIOR_ATOL)
        close(hmm.smooth(observations), every.smoothed(), atol=POSTERIOR_ATOL)
        close(hmm.filter(observations)[-1], every.smoothed()[-1], atol=POSTERIOR_ATOL)
        close(statistics.initial, every.smoothed()[0], atol=POSTERIOR_ATOL)
        close(statistics.node, every.smoothed().sum(0), atol=POSTERIOR_ATOL)
        close(statistics.edge, every.edge(), atol=POSTERIOR_ATOL)
        uniform = EveryPath(hmm, observations, uniform_start=True)
        best = uniform.paths[uniform.score.argmax()]
        assert hmm.most_likely_path(observations).tolist() == best.tolist()


def test_expected_edge_counts_are_the_gradient_of_the_log_likelihood():
    hmm = random_hmm((3, 3), 2, 10)
    observations = hmm.sample(30, torch.Generator().manual_seed(1)).observations
    chain = log_chain(hmm)
    chain.log_transition.requires_grad_()
    logspace.log_likelihood(chain, log_rows(hmm, observations)).backward()
    close(
        chain.log_transition.grad, hmm.e_step(observations).edge, rtol=COUNT_RTOL, atol=COUNT_ATOL
    )


def map_data(kind, hmm, num_steps=400):
    """What a map meets: its own data, other data, and data that no path of the graph explains."""
    generator = torch.Generator().manual_seed(2)
    observations = hmm.sample(num_steps, generator).observations
    if kind == "held-out":  # ten times the noise that the model expects
        noise = torch.randn(observations.shape, generator=generator, dtype=torch.float64)
        return observations + 0.1 * noise
    if kind == "teleporting":
        length = num_steps // 20
        return torch.cat([hmm.sample(length, generator).observations for _ in range(20)])
    if kind == "outlying frames":
        index = torch.randperm(num_steps, generator=generator)[: num_steps // 50]
        observations[index] = torch.rand(
            len(index), hmm.obs_dim, generator=generator, dtype=torch.float64
        )
    if kind == "noise":
        return torch.rand(observations.shape, generator=generator, dtype=torch.float64)
    if kind == "missing":
        observations[torch.rand(observations.shape, generator=generator) < 0.2] = torch.nan
        observations[100:130] = torch.nan
        observations[:, 5] = torch.nan
        observations[0], observations[-1] = torch.nan, torch.nan
    if kind == "wrong units":
        observations[200:203] = 50.0
    return observations


@pytest.mark.parametrize(
    "kind",
    [
        "training",
        "held-out",
        "teleporting",
        "outlying frames",
        "noise",
        "missing",
        "wrong units",
    ],
)
def test_400_sharp_nodes_are_exact_on(kind):
    hmm = map_hmm()
    check_against_logspace(hmm, map_data(kind, hmm))


def test_the_same_step_in_the_linear_domain_would_lose_the_path():
    """Guards the tests above: their data must be hard enough to need separate exponents."""
    hmm = map_hmm()
    chain, rows = log_chain(hmm), log_rows(hmm, map_data("teleporting", hmm))
    log_alpha = logspace.forward(chain, rows)
    path = logspace.most_likely_path(chain, rows)
    depth = log_alpha.amax(1) - log_alpha[torch.arange(len(path)), path]
    assert depth.max() > 1_000  # float64 ends at 745 nats


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_random_graphs_sizes_and_scales_agree_with_the_definition(data):
    shape = data.draw(
        st.one_of(st.tuples(*[st.integers(1, 5)] * 2), st.tuples(*[st.integers(1, 3)] * 3))
    )
    hmm = random_hmm(
        shape,
        data.draw(st.integers(1, 5), "obs_dim"),
        data.draw(st.integers(0, 10_000), "seed"),
        scale=data.draw(st.sampled_from([0.01, 0.03, 0.2, 2.0]), "scale"),
        spread=data.draw(st.sampled_from([0.0, 1.0, 30.0, 300.0]), "spread"),
        drop=data.draw(st.sampled_from([0.0, 0.4]), "drop"),
        radius=data.draw(st.sampled_from([1.0, 1.5, 2.0, 3.0]), "radius"),
        metric=data.draw(st.sampled_from(["euclidean", "chebyshev"]), "metric"),
        boundary=data.draw(st.sampled_from(["open", "torus"]), "boundary"),
    )
    num_steps = data.draw(st.integers(1, 60), "num_steps")
    generator = torch.Generator().manual_seed(data.draw(st.integers(0, 10_000), "data seed"))
    stretch = data.draw(st.sampled_from([1.0, 1.0, 10.0, 100.0]), "stretch")
    observations = torch.rand(num_steps, hmm.obs_dim, generator=generator, dtype=torch.float64)
    missing = torch.rand(observations.shape, generator=generator)
    observations[missing < data.draw(st.sampled_from([0.0, 0.3, 1.0]), "missing")] = torch.nan
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inference, "BLOCK", data.draw(st.sampled_from([1, 2, 7, 8192]), "block"))
        check_against_logspace(hmm, stretch * observations)


@pytest.mark.parametrize("block", [1, 2, 7, 50, 51, 99])
def test_block_boundaries_change_nothing(block, monkeypatch):
    hmm = random_hmm((4, 4), 2, 11, scale=0.02)
    observations = hmm.sample(101, torch.Generator().manual_seed(3)).observations
    whole = hmm.e_step(observations), hmm.smooth(observations), hmm.filter(observations)
    monkeypatch.setattr(inference, "BLOCK", block)
    monkeypatch.setattr(inference, "_CACHE_BLOCK", block)
    monkeypatch.setattr(inference, "_SEGMENT_CELLS", 20 * 16)  # segments of 20 steps, in a first
    monkeypatch.setattr(inference.kernels, "cached_steps", lambda num_cells: 7)  # run 7 at a time
    statistics, smoothed, filtered = whole
    cut = hmm.e_step(observations)
    close(hmm.smooth(observations), smoothed)
    close(hmm.filter(observations), filtered)
    close(cut.edge, statistics.edge, rtol=COUNT_RTOL, atol=COUNT_ATOL)
    close(cut.second, statistics.second, rtol=COUNT_RTOL, atol=COUNT_ATOL)
    close(cut.initial, statistics.initial)
    close(cut.log_likelihood, statistics.log_likelihood, rtol=1e-12)
    check_path(hmm, log_rows(hmm, observations), hmm.most_likely_path(observations))


def test_a_log_longer_than_two_blocks_is_treated_as_one_sequence(monkeypatch):
    hmm = random_hmm((3, 3), 1, 12)
    monkeypatch.setattr(inference, "BLOCK", 4096)
    monkeypatch.setattr(inference, "_SEGMENT_CELLS", 0)
    num_steps = 2 * inference.BLOCK + 1_001  # each half is run twice over 500 steps, 22 at a time
    observations = hmm.sample(num_steps, torch.Generator().manual_seed(4)).observations
    cut = hmm.e_step(observations), hmm.smooth(observations), hmm.log_likelihood(observations)
    monkeypatch.setattr(inference, "BLOCK", num_steps)
    close(cut[1], hmm.smooth(observations))
    close(cut[2], hmm.log_likelihood(observations), rtol=1e-12)
    close(cut[0].edge, hmm.e_step(observations).edge, rtol=COUNT_RTOL)
    close(cut[0].log_likelihood, cut[2], rtol=LIKELIHOOD_RTOL, atol=LIKELIHOOD_ATOL)


@pytest.mark.parametrize("num_steps", [1, 2, 3, 4, 5, 255, 256, 257, 258, 513])
def test_counts_add_up_to_the_steps_taken(num_steps):
    hmm = random_hmm((3, 4), 2, 13)
    observations = hmm.sample(num_steps, torch.Generator().manual_seed(5)).observations
    statistics, smoothed = hmm.e_step(observations), hmm.smooth(observations).double()
    close(smoothed.sum(1), torch.ones(num_steps), atol=POSTERIOR_ATOL)
    close(statistics.node, smoothed.sum(0), rtol=COUNT_RTOL, atol=COUNT_ATOL)
    close(statistics.edge.sum(1), smoothed[:-1].sum(0), rtol=COUNT_RTOL, atol=COUNT_ATOL)
    into = torch.zeros(12).double()
    into.index_add_(0, hmm.successor.flatten(), statistics.edge.flatten())
    close(into, smoothed[1:].sum(0), rtol=COUNT_RTOL, atol=COUNT_ATOL)


def test_a_list_of_ragged_logs_adds_up_and_no_edge_joins_two_logs():
    hmm = map_hmm()
    logs = [hmm.sample(n, torch.Generator().manual_seed(n)).observations for n in (40, 1, 2, 77)]
    chain = log_chain(hmm)
    counts = [logspace.expected_counts(chain, log_rows(hmm, log)) for log in logs]
    likelihood = sum(logspace.log_likelihood(chain, log_rows(hmm, log)) for log in logs)
    statistics = hmm.e_step(logs)
    assert statistics.num_steps == 120
    close(statistics.initial, sum(c.initial for c in counts), rtol=COUNT_RTOL, atol=COUNT_ATOL)
    close(statistics.node, sum(c.node for c in counts), rtol=COUNT_RTOL, atol=COUNT_ATOL)
    close(statistics.edge, sum(c.edge for c in counts), rtol=COUNT_RTOL, atol=COUNT_ATOL)
    close(hmm.log_likelihood(logs), likelihood, atol=LIKELIHOOD_ATOL)


def test_a_log_without_a_single_reading_has_likelihood_one():
    hmm = random_hmm((3, 4), 2, 14)
    observations = torch.full((9, 2), torch.nan, dtype=torch.float64)
    close(hmm.log_likelihood(observations), 0.0, atol=POSTERIOR_ATOL)
    powers = [torch.linalg.matrix_power(hmm.transition_matrix().detach(), n) for n in range(9)]
    initial = hmm.initial_logits.detach().softmax(0)
    close(hmm.smooth(observations), torch.stack([initial @ p for p in powers]), atol=POSTERIOR_ATOL)
    assert hmm.e_step(observations).weight.sum() == 0


def test_a_missing_reading_is_marginalised():
    hmm = random_hmm((3, 4), 3, 15)
    observations = hmm.sample(20, torch.Generator().manual_seed(6)).observations
    observations[:, 1] = torch.nan
    without = random_hmm((3, 4), 2, 15)
    with torch.no_grad():
        for name, parameter in hmm.named_parameters():
            kept = parameter[:, [0, 2]] if name.startswith("emission") else parameter
            getattr(without, name).copy_(kept)
    other = without.smooth(observations[:, [0, 2]])
    close(hmm.smooth(observations), other, atol=POSTERIOR_ATOL)


def test_the_temperature_is_the_power_of_the_densities():
    hmm = random_hmm((3, 4), 2, 16)
    observations = hmm.sample(30, torch.Generator().manual_seed(7)).observations
    rows = 0.3 * log_rows(hmm, observations)
    statistics = hmm.e_step(observations, temperature=0.3)
    counts = logspace.expected_counts(log_chain(hmm), rows)
    close(statistics.edge, counts.edge, rtol=COUNT_RTOL, atol=COUNT_ATOL)
    expected = logspace.log_likelihood(log_chain(hmm), rows)
    close(statistics.log_likelihood, expected, atol=LIKELIHOOD_ATOL)


def test_an_edge_that_is_not_in_the_graph_is_never_counted():
    hmm = random_hmm((4, 4), 2, 17, radius=1.0, scale=0.01)
    observations = torch.rand(80, 2, generator=torch.Generator().manual_seed(8)).double()
    statistics = hmm.e_step(observations)
    assert (statistics.edge[~hmm.successor_mask] == 0).all()
    path = hmm.most_likely_path(observations)
    matrix = hmm.transition_matrix()
    assert all(matrix[i, j] > 0 for i, j in itertools.pairwise(path.tolist()))


def test_the_path_is_the_best_among_thousands_that_are_nearly_as_good():
    hmm = random_hmm((5, 5), 1, 19, scale=5.0, spread=0.01)
    observations = hmm.sample(300, torch.Generator().manual_seed(9)).observations
    check_path(hmm, log_rows(hmm, observations), hmm.most_likely_path(observations))


@pytest.mark.parametrize("num_steps", [1, 2, 30])
@pytest.mark.parametrize("drop", [0.0, 0.4])
def test_the_path_and_the_end_scores_start_from_the_models_own_start(num_steps, drop):
    hmm = random_hmm((4, 4), 1, 20, scale=1.0, spread=5.0, drop=drop)
    observations = hmm.sample(num_steps, torch.Generator().manual_seed(10)).observations
    chain, rows = log_chain(hmm), log_rows(hmm, observations)
    path = inference.most_likely_path(hmm.chain(), observations.numpy())
    expected = path_score(chain, rows, logspace.most_likely_path(chain, rows))
    assert path_score(chain, rows, path) == pytest.approx(expected, abs=LIKELIHOOD_ATOL)
    ends = torch.full((hmm.num_nodes,), -torch.inf).double()  # delta_T, by all last nodes
    for node in range(hmm.num_nodes):
        only = rows.clone()
        only[-1, torch.arange(hmm.num_nodes) != node] = -torch.inf
        ends[node] = path_score(chain, only, logspace.most_likely_path(chain, only))
    scores = inference.viterbi_scores(hmm.chain(), observations.numpy())
    close(scores, ends - ends.max(), atol=LIKELIHOOD_ATOL)


@pytest.mark.parametrize(
    ("num_steps", "jump"), [(2, 1), (3, 1), (3, 2), (6, 1), (6, 2), (6, 3), (6, 4), (6, 5)]
)
def test_a_jump_past_the_exponents_range_is_an_error_wherever_it_falls(num_steps, jump):
    """Frames of +-1e7 leave one end of a line alive, then the other, which no edge joins."""
    hmm = random_hmm((1, 12), 1, 18, radius=1.0, scale=0.01)
    with torch.no_grad():
        hmm.emission_mean.copy_(torch.linspace(0, 1, 12)[:, None])
        hmm.emission_log_scale.fill_(math.log(0.01))
    observations = torch.full((num_steps, 1), -1e7, dtype=torch.float64)
    observations[jump:] = 1e7
    for method in (hmm.log_likelihood, hmm.filter, hmm.smooth, hmm.e_step):
        with pytest.raises(ValueError, match=r"more than 1.8e8 nats from every node"):
            method(observations)


@pytest.mark.parametrize("cores", [(2, 2), (1, 2)])
def test_one_thread_and_two_give_the_same_bits_every_time(cores, monkeypatch):
    hmm = map_hmm()
    observations = map_data("held-out", hmm)
    monkeypatch.setattr(inference, "_SHORT", 0)
    monkeypatch.setattr(inference, "_num_cores", lambda: cores[0])
    first = hmm.e_step(observations)
    monkeypatch.setattr(inference, "_num_cores", lambda: cores[1])
    again = hmm.e_step(observations)
    for name in ("initial", "node", "edge", "weight", "first", "second", "log_likelihood"):
        assert torch.equal(getattr(first, name), getattr(again, name))


def test_an_error_on_two_threads_leaves_neither_at_work_on_the_next_log(monkeypatch):
    hmm = map_hmm()
    observations = map_data("held-out", hmm)
    monkeypatch.setattr(inference, "_SHORT", 0)
    monkeypatch.setattr(inference, "_num_cores", lambda: 2)
    expected = hmm.e_step(observations).log_likelihood
    far = observations.clone()
    far[len(far) // 4] = 1e9  # the forward thread fails at once, the other runs on
    far[len(far) // 4 + 1] = -1e9
    for _ in range(3):
        with pytest.raises(ValueError, match="from every node"):
            hmm.e_step(far)
        assert torch.equal(hmm.e_step(observations).log_likelihood, expected)


def test_what_is_left_out_of_the_sums_is_within_the_stated_bound():
    """Counts down to 1e-28 against the definition's: T * NEGLIGIBLE is all that may be lost.

    Of six tiles one explains the readings; the posterior in the fourth is 2**-76 to 2**-54.
    """
    num_nodes, num_steps = 96, 40
    hmm = random_hmm((1, num_nodes), 1, 31, radius=1.0)
    with torch.no_grad():
        hmm.emission_mean.copy_(0.05 * torch.arange(num_nodes)[:, None])
        hmm.emission_log_scale.fill_(math.log(1.0))
    generator = torch.Generator().manual_seed(5)
    observations = 0.8 + 0.5 * torch.randn(num_steps, 1, generator=generator).double()
    statistics = hmm.e_step(observations)
    expected = logspace.expected_counts(log_chain(hmm), log_rows(hmm, observations))
    bound = num_steps * kernels.NEGLIGIBLE
    close(statistics.node, expected.node, rtol=1e-5, atol=bound)  # seen: 2e-6
    close(statistics.edge, expected.edge, rtol=1e-5, atol=bound)
    is_small = (expected.node > bound) & (expected.node < 1e-12)
    is_left_out = (statistics.node == 0) & (expected.node > 0)
    assert is_small.sum() > 10
    assert (statistics.node[is_small] > 0).all()
    assert is_left_out.sum() > 10
