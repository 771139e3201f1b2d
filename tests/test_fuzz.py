"""The public surface under whatever comes: a right answer or a documented error, nothing else.

`RFL_FUZZ_CASES=10000 python -m pytest tests/test_fuzz.py` is the long run.
"""

import dataclasses
import itertools
import math
import os
import warnings

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.sparse import csr_array
from test_inference import check_path, close, log_chain, log_rows, random_hmm
from worlds import dot_config, dot_log

from rfl_torch import Agent, AgentConfig, GridHMM, Trajectory, logspace
from rfl_torch.hmm import MAX_READING
from rfl_torch.planner import cost_to_go, reachability_path

CASES = int(os.environ.get("RFL_FUZZ_CASES", "300"))
TESTS = 6.33  # one of the seven takes a third of the others' cases
fuzzed = settings(
    max_examples=math.ceil(CASES / TESTS),
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
)

sizes = st.integers(1, 4)
shapes = st.one_of(st.tuples(sizes, sizes), st.tuples(sizes, sizes, st.integers(1, 2)))


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def agent():
    return Agent(dot_config()).fit(dot_log(1500))


def as_given(array, kind):
    """The same numbers in another guise."""
    if kind == "tensor":
        return torch.from_numpy(array)
    if kind == "strided":
        wide = np.zeros((2 * len(array), 2 * array.shape[1]), array.dtype)
        wide[::2, ::2] = array
        return wide[::2, ::2]
    if kind == "fortran":
        return np.asfortranarray(array)
    if kind == "read-only":
        array.flags.writeable = False
        return array
    return array.astype(kind)


def tells(error, *words):
    """Whether an error is one of those that the documentation names."""
    assert any(word in str(error) for word in words), error


guises = st.sampled_from(["tensor", "strided", "fortran", "read-only", "float32", "float64"])


@fuzzed
@given(
    shapes,
    st.integers(0, 9),
    st.integers(1, 5),
    st.floats(1.0, 3.0),
    st.sampled_from(["euclidean", "chebyshev"]),
    st.sampled_from(["open", "torus"]),
    st.integers(-6, 6),
    st.floats(0, 1),
    guises,
    st.integers(0, 2**31),
)
def test_inference_is_the_definitions_on_any_graph_and_scale(
    shape, num_steps, obs_dim, radius, metric, boundary, exponent, missing, guise, seed
):
    hmm = random_hmm(shape, obs_dim, seed, radius=radius, metric=metric, boundary=boundary)
    unit = 10.0**exponent
    with torch.no_grad():  # the same model in other units
        hmm.emission_mean.mul_(unit)
        hmm.emission_log_scale.add_(math.log(unit))
    rng = np.random.default_rng(seed)
    observations = unit * (rng.random((num_steps, obs_dim)) * 2 - 0.5)
    observations[rng.random(observations.shape) < missing] = np.nan
    observations = observations.astype(np.float32).astype(np.float64)
    given_as = as_given(observations, guise)
    if num_steps == 0:
        with pytest.raises(ValueError, match="T >= 1"):
            hmm.e_step(given_as)
        return
    whole = torch.tensor(observations)
    chain, rows = log_chain(hmm), log_rows(hmm, whole)
    statistics = hmm.e_step(given_as)
    counts = logspace.expected_counts(chain, rows)
    close(statistics.log_likelihood, logspace.log_likelihood(chain, rows), rtol=1e-6, atol=1e-4)
    close(hmm.filter(given_as), logspace.filtered(chain, rows), atol=1e-5)
    close(hmm.smooth(given_as), logspace.smoothed(chain, rows), atol=1e-5)
    close(statistics.node, counts.node, atol=1e-4)
    close(statistics.edge, counts.edge, atol=1e-4)
    first = logspace.smoothed(chain, rows).T @ whole.nan_to_num(0.0)
    close(statistics.first / unit, first / unit, atol=1e-4)
    check_path(hmm, rows, hmm.most_likely_path(given_as))


@fuzzed
@given(
    st.one_of(
        hnp.arrays(
            st.sampled_from([np.float16, np.float32, np.float64, np.int8, np.int64, bool]),
            hnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=4),
        ),
        hnp.arrays(np.float64, (3, 2), elements=st.floats(allow_nan=True, allow_infinity=True)),
    )
)
def test_observations_are_taken_or_refused(observations):
    hmm = random_hmm((3, 3), 2, 0)
    is_right = observations.ndim == 2 and observations.shape[1] == 2 and len(observations) > 0
    as_float = np.asarray(observations, np.float64) if is_right else np.zeros((1, 1))
    is_right &= not (np.abs(as_float) > MAX_READING).any()
    try:
        value = hmm.log_likelihood(observations).item()
    except ValueError as error:
        tells(error, "nats" if is_right else "need")
    else:
        assert is_right
        assert math.isfinite(value)
        np.testing.assert_allclose(hmm.filter(observations).sum(1), 1.0, atol=1e-5)
        path = hmm.most_likely_path(observations)
        assert path.min() >= 0
        assert path.max() < hmm.num_nodes


numbers = st.floats(allow_nan=True, allow_infinity=True, width=32)


@fuzzed
@given(
    st.data(),
    st.integers(0, 5),
    st.integers(0, 5),
    st.integers(0, 3),
    st.integers(0, 3),
    st.sampled_from([np.float32, np.float64, np.int32, np.uint8, bool, object]),
)
def test_a_log_is_whole_or_refused_and_comes_back_from_its_file(
    tmp_path_factory, data, rows, num_actions, width, action_width, dtype
):
    elements = numbers if np.dtype(dtype).kind == "f" else None
    kind = np.float64 if dtype is object else dtype
    seen = data.draw(hnp.arrays(kind, (rows, width), elements=elements)).astype(dtype)
    done = data.draw(hnp.arrays(np.float32, (num_actions, action_width), elements=numbers))
    try:
        with np.errstate(over="ignore"):
            log = Trajectory(seen, done)
    except ValueError as error:
        tells(error, "need")
        return
    assert len(log.observations) == log.num_steps + 1 > 1
    assert not np.isinf(log.observations).any()
    assert np.isfinite(log.actions).all()
    path = tmp_path_factory.getbasetemp() / "log.npz"
    log.save(path)
    back = Trajectory.load(path)
    np.testing.assert_array_equal(back.observations, log.observations)
    np.testing.assert_array_equal(back.actions, log.actions)


@settings(fuzzed, max_examples=math.ceil(CASES / (3 * TESTS)))  # learning takes its time
@given(
    st.integers(1, 80),
    st.integers(1, 5),
    st.integers(1, 4),
    st.integers(-5, 5),
    st.floats(0, 0.6),
    st.booleans(),
    st.sampled_from(["rbf", "mlp", "svr"]),
    st.integers(0, 2**31),
)
def test_any_log_is_learned_from_or_refused(
    num_steps, obs_dim, action_dim, exponent, missing, is_constant, controller, seed
):
    rng = np.random.default_rng(seed)
    actions = rng.uniform(-1, 1, (num_steps, action_dim)).astype(np.float32)
    mixed = rng.standard_normal((action_dim, obs_dim))
    walk = np.concatenate([np.zeros((1, action_dim)), actions.cumsum(0)])
    seen = 10.0**exponent * np.sin(walk @ mixed)
    seen[rng.random(seen.shape) < missing] = np.nan
    if is_constant:
        seen[:, 0] = 0.25
    config = dot_config(
        shape=(3, 3),
        controller=controller,
        stages=tuple(dataclasses.replace(s, iterations=2) for s in AgentConfig().stages),
    )
    bounds = -np.ones(action_dim, np.float32), np.ones(action_dim, np.float32)
    log = Trajectory(seen.astype(np.float32), actions, *bounds)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "readings .* never change", UserWarning)
            agent = Agent(config).fit(log)
    except ValueError as error:
        tells(error, "too few", "no reading changes")
        return
    acts_within_bounds(agent, seen.astype(np.float32)[:3])
    agent.partial_fit(log)
    acts_within_bounds(agent, seen.astype(np.float32)[:3])


def acts_within_bounds(agent, observations):
    low, high = agent.actions
    executor = agent.executor(agent.num_nodes - 1)
    for observation in observations:
        action = executor.act(observation)
        assert action.dtype == np.float32
        assert ((low <= action) & (action <= high)).all()
        assert abs(executor.belief.sum() - 1) < 1e-9
        assert 0 <= executor.node < agent.num_nodes
        assert all(0 <= node < agent.num_nodes for node in executor.path)


@fuzzed
@given(
    st.lists(
        hnp.arrays(
            np.float64, (4,), elements=st.floats(allow_nan=True, allow_infinity=True, width=32)
        ),
        max_size=8,
    ),
    st.integers(-2, 60),
    st.sampled_from([np.float32, np.float64]),
)
def test_an_executor_takes_any_readings_and_any_goal(agent, stream, goal, dtype):
    if not 0 <= goal < agent.num_nodes:
        with pytest.raises(ValueError, match="no kept node"):
            agent.executor(goal)
        return
    executor = agent.executor(goal)
    for observation in stream:
        action = executor.act(observation.astype(dtype))
        assert (np.abs(action) <= 1).all()
        assert abs(executor.belief.sum() - 1) < 1e-9
        assert executor.status in ("running", "reached", "gave_up")


@fuzzed
@given(hnp.arrays(np.float64, (5, 5), elements=st.sampled_from([0, 0, 0, 0.3, 1, 2.5])))
def test_plans_are_the_shortest_of_all_ways(weight):
    np.fill_diagonal(weight, 0)
    graph, nodes = csr_array(weight), range(5)
    cost = cost_to_go(graph, np.array([4]))
    for start in nodes:
        ways = [
            (start, *between, 4)
            for count in range(4)
            for between in itertools.permutations(set(nodes) - {start, 4}, count)
        ]
        ways = [(4,)] if start == 4 else ways
        open_ways = [way for way in ways if all(weight[i, j] for i, j in itertools.pairwise(way))]
        total = [sum(weight[i, j] for i, j in itertools.pairwise(way)) for way in open_ways]
        np.testing.assert_allclose(cost[start], min(total, default=np.inf))
        path = reachability_path(graph, start, 4)
        assert len(path) == min(map(len, open_ways), default=0)
        assert not path or tuple(path) in open_ways


@fuzzed
@given(
    st.lists(st.integers(-2, 6), max_size=4),
    st.one_of(st.floats(allow_nan=True), st.integers(-1, 3)),
    st.integers(-1, 3),
)
def test_a_lattice_is_laid_out_or_refused(shape, radius, obs_dim):
    try:
        hmm = GridHMM(tuple(shape), obs_dim, radius if abs(radius) < 4 else math.nan)
    except ValueError as error:
        tells(error, "needs")
        return
    assert hmm.num_nodes == math.prod(shape)
    torch.testing.assert_close(
        hmm.transition_matrix().sum(1), torch.ones(hmm.num_nodes, dtype=torch.float64)
    )
