"""`rfl_torch.online_svr` against scikit-learn's batch solver and the optimality conditions."""

import copy
import io

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.svm import SVR

from rfl_torch import online_svr
from rfl_torch.online_svr import OnlineSVR, SVRBank

ORACLE_ATOL = 1e-6  # libsvm keeps the kernel in single precision, whatever its `tol`
KKT_ATOL = 2e-9  # times max(1, cost): twice the ridge
DEGENERATE_ATOL = 2e-8  # times max(1, cost): repeated samples may need ten times the ridge
COLLINEAR_ATOL = 1e-5  # as above, times the theta of many samples that cancel
EXACT_ATOL = 1e-10  # two orders of the same arithmetic


def batch_svr(x, y, *, bandwidth, cost, tube):
    gamma = 1 / (2 * bandwidth**2)
    return SVR(kernel="rbf", gamma=gamma, C=cost, epsilon=tube, tol=1e-12, shrinking=False).fit(
        x, y
    )


def online(x, y, **options):
    svr = OnlineSVR(**options)
    for row, target in zip(x, y, strict=True):
        svr.add(row, target)
    return svr


def violation(svr, x, y, *, bandwidth, cost, tube):
    """The largest distance of any sample from its optimality condition, one sample at a time."""
    worst = abs(sum(svr.dual_coef))
    for x_i, y_i, theta in zip(x, y, svr.dual_coef, strict=True):
        kernel = [np.exp(-np.sum((x_j - x_i) ** 2) / (2 * bandwidth**2)) for x_j in x]
        h = np.dot(kernel, svr.dual_coef) + svr.bias - y_i
        if theta == 0:
            worst = max(worst, abs(h) - tube)
        elif abs(theta) == cost:
            worst = max(worst, np.sign(theta) * h + tube)
        else:
            worst = max(worst, abs(h + np.sign(theta) * tube), abs(theta) - cost)
    return worst


def random_data(seed, n, dim):
    generator = np.random.default_rng(seed)
    x = generator.random((n, dim))
    return x, np.sin(4 * x[:, 0]) / 2 + 0.5 + 0.1 * generator.standard_normal(n)


def check_against_batch(svr, x, y, options):
    oracle = batch_svr(x, y, **options)
    dual_coef = np.zeros(len(x))
    dual_coef[oracle.support_] = oracle.dual_coef_[0]
    query = np.random.default_rng(99).random((50, x.shape[1])) * 2 - 0.5
    np.testing.assert_allclose(svr.predict(query), oracle.predict(query), atol=ORACLE_ATOL)
    np.testing.assert_allclose(svr.dual_coef, dual_coef, atol=10 * ORACLE_ATOL)
    assert svr.bias == pytest.approx(oracle.intercept_[0], abs=ORACLE_ATOL)


SETTINGS = [  # n, dim, bandwidth, cost, tube
    (40, 4, 0.3, 10.0, 0.02),
    (40, 2, 0.3, 0.5, 0.1),
    (60, 1, 0.05, 2.0, 0.05),
    (30, 48, 1.0, 10.0, 0.02),
    (30, 48, 2.0, 30.0, 0.1),
    (50, 3, 0.5, 0.01, 0.02),  # every theta at its bound: the bias is the middle of an interval
    (20, 2, 0.05, 100.0, 0.01),  # a kernel matrix close to the identity
    (30, 2, 0.3, 1.0, 0.6),  # a tube as wide as the data
]


@pytest.mark.parametrize(("n", "dim", "bandwidth", "cost", "tube"), SETTINGS)
def test_adding_one_by_one_equals_the_batch_solution(n, dim, bandwidth, cost, tube):
    options = {"bandwidth": bandwidth, "cost": cost, "tube": tube}
    x, y = random_data(0, n, dim)
    svr = online(x, y, **options)
    check_against_batch(svr, x, y, options)
    assert violation(svr, x, y, **options) < KKT_ATOL * max(1, options["cost"])


@pytest.mark.parametrize(("n", "dim", "bandwidth", "cost", "tube"), SETTINGS)
def test_removing_equals_the_batch_solution_of_the_rest(n, dim, bandwidth, cost, tube):
    options = {"bandwidth": bandwidth, "cost": cost, "tube": tube}
    x, y = random_data(1, n, dim)
    svr = online(x, y, **options)
    generator = np.random.default_rng(2)
    for _ in range(n // 2):
        index = int(generator.integers(len(x)))
        svr.remove(index)
        x, y = np.delete(x, index, axis=0), np.delete(y, index)
        assert violation(svr, x, y, **options) < KKT_ATOL * max(1, options["cost"])
    check_against_batch(svr, x, y, options)


def test_the_order_of_samples_does_not_matter():
    options = {"bandwidth": 0.3, "cost": 2.0, "tube": 0.05}
    x, y = random_data(3, 40, 2)
    order = np.random.default_rng(4).permutation(40)
    one, other = online(x, y, **options), online(x[order], y[order], **options)
    np.testing.assert_allclose(one.dual_coef[order], other.dual_coef, atol=EXACT_ATOL)
    np.testing.assert_allclose(one.bias, other.bias, atol=EXACT_ATOL)


def test_removing_undoes_adding():
    options = {"bandwidth": 0.3, "cost": 2.0, "tube": 0.05}
    x, y = random_data(5, 30, 2)
    svr, before = online(x, y, **options), online(x[:20], y[:20], **options)
    for _ in range(10):
        svr.remove(20)
    np.testing.assert_allclose(svr.dual_coef, before.dual_coef, atol=EXACT_ATOL)
    np.testing.assert_allclose(svr.bias, before.bias, atol=EXACT_ATOL)


GRID = st.tuples(st.integers(0, 2), st.integers(0, 1), st.integers(0, 4))


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    samples=st.lists(GRID, min_size=1, max_size=14),
    removals=st.lists(st.integers(0, 100), max_size=8),
    bandwidth=st.sampled_from([0.3, 1.0, 5.0]),
    cost=st.sampled_from([0.1, 0.5, 1.0, 10.0]),
    tube=st.sampled_from([0.0, 0.05, 0.125, 0.25]),
    spread=st.sampled_from([0.0, 1e-8, 1e-5, 1e-3]),
)
def test_repeated_inputs_and_ties_stay_optimal(samples, removals, bandwidth, cost, tube, spread):
    """Targets are multiples of a quarter, so that tubes touch; spread makes near-repeats."""
    options = {"bandwidth": bandwidth, "cost": cost, "tube": tube}
    limit = DEGENERATE_ATOL * max(1, cost)
    x = np.array([sample[:2] for sample in samples], np.float64)
    x += spread * np.random.default_rng(0).standard_normal(x.shape)
    y = np.array([sample[2] for sample in samples]) / 4
    svr = OnlineSVR(**options)
    for i in range(len(x)):
        svr.add(x[i], y[i])
        assert violation(svr, x[: i + 1], y[: i + 1], **options) < limit
    for number in removals[: len(x)]:
        index = number % len(x)
        svr.remove(index)
        x, y = np.delete(x, index, axis=0), np.delete(y, index)
        if len(x):
            assert violation(svr, x, y, **options) < limit


def collinear_data(seed, n):
    """One node of a pendulum held by a torque: successive angles and a motor of three levels."""
    generator = np.random.default_rng(seed)
    angle = 0.13 + 0.04 * generator.standard_normal(n)
    following = angle - 0.04 + 0.003 * generator.standard_normal(n)
    return np.stack((angle, following), axis=1), generator.choice([0, 0.5, 1], n, p=[0.8, 0.1, 0.1])


@pytest.mark.parametrize("seed", [0, 2])  # rounding misleads the path in both
def test_collinear_inputs_with_unlearnable_targets_need_few_events(seed, monkeypatch):
    options = {"bandwidth": 0.5, "cost": 10.0, "tube": 0.02}
    x, y = collinear_data(seed, 120)
    refit, refits = OnlineSVR._refit, []
    monkeypatch.setattr(OnlineSVR, "_refit", lambda svr: (refits.append(len(svr)), refit(svr)))
    svr = OnlineSVR(**options)
    for i in range(len(x)):
        before = svr.num_events
        svr.add(x[i], y[i])
        assert svr.num_events - before <= 4 * (i + 10)
        assert svr.kkt_residual() < KKT_ATOL * options["cost"]
    assert svr.num_events <= 40 * len(x)
    assert len(refits) <= len(x) // 4
    oracle = batch_svr(x, y, **options)
    np.testing.assert_allclose(svr.predict(x), oracle.predict(x), atol=COLLINEAR_ATOL)
    whole = OnlineSVR(**options)
    whole.resume(x, y, np.zeros(len(x)), 0.5)  # solved as a batch
    np.testing.assert_allclose(svr.predict(x), whole.predict(x), atol=KKT_ATOL * options["cost"])


def test_a_path_that_cycles_is_finished_by_the_batch_solver(monkeypatch):
    options = {"bandwidth": 0.5, "cost": 10.0, "tube": 0.02}
    x, y = collinear_data(2, 40)
    expected = online(x, y, **options)
    monkeypatch.setattr(OnlineSVR, "_patience", lambda svr: range(1))
    svr = online(x, y, **options)
    for _ in range(10):
        expected.remove(0)
        svr.remove(0)
    assert violation(svr, x[10:], y[10:], **options) < KKT_ATOL * options["cost"]
    np.testing.assert_allclose(svr.predict(x), expected.predict(x), atol=KKT_ATOL * 10)


def test_contradicting_targets_at_one_input_give_their_middle():
    svr = online([[0.0], [0.0]], [0.2, 0.8], bandwidth=1.0, cost=10.0, tube=0.1)
    assert svr.predict([0.0]) == pytest.approx(0.5, abs=EXACT_ATOL)
    np.testing.assert_allclose(svr.dual_coef, [-10.0, 10.0])  # no move of theta brings them nearer
    svr.remove(0)
    assert svr.predict([0.0]) == pytest.approx(0.8, abs=EXACT_ATOL)


def test_without_support_only_the_bias_moves():
    svr = OnlineSVR(bandwidth=1.0, cost=1.0, tube=0.1)
    assert svr.predict([[3.0, 4.0]]) == [0.5]
    svr.add([0.0], 0.9)
    assert svr.bias == pytest.approx(0.9, abs=EXACT_ATOL)
    svr.add([1.0], 1.0)  # a bias of 0.95 serves both without a theta
    assert svr.bias == pytest.approx(0.95, abs=EXACT_ATOL)
    assert len(svr.support_set) == 0
    assert svr.dual_coef.tolist() == [0.0, 0.0]
    svr.remove(0)
    svr.remove(0)
    assert (len(svr), svr.bias) == (0, 0.5)


def test_the_three_sets_partition_the_samples_by_their_coefficients():
    x, y = random_data(6, 60, 2)
    svr = online(x, y, bandwidth=0.3, cost=0.5, tube=0.05)
    size = np.abs(svr.dual_coef)
    np.testing.assert_array_equal(svr.support_set, np.flatnonzero((size > 0) & (size < 0.5)))
    np.testing.assert_array_equal(svr.error_set, np.flatnonzero(size == 0.5))
    np.testing.assert_array_equal(svr.remaining_set, np.flatnonzero(size == 0))
    assert min(map(len, (svr.support_set, svr.error_set, svr.remaining_set))) > 0


def test_the_inverse_kept_by_rank_one_updates_is_the_inverse():
    x, y = random_data(7, 40, 2)
    svr = online(x, y, bandwidth=0.2, cost=0.5, tube=0.05)
    for _ in range(15):
        svr.remove(0)
    support = svr._support
    difference = x[15:][support][:, None] - x[15:][support]
    bordered = np.ones((len(support) + 1,) * 2)
    bordered[0, 0] = 0
    bordered[1:, 1:] = np.exp(-(difference**2).sum(-1) / (2 * 0.2**2))
    np.testing.assert_allclose(svr._inverse @ bordered, np.eye(len(bordered)), atol=1e-8)


def test_kkt_residual_is_the_violation():
    options = {"bandwidth": 0.3, "cost": 0.5, "tube": 0.05}
    x, y = random_data(8, 30, 2)
    svr = online(x, y, **options)
    assert svr.kkt_residual() < KKT_ATOL
    svr._bias += 0.01
    assert svr.kkt_residual() == pytest.approx(violation(svr, x, y, **options), abs=KKT_ATOL)
    assert svr.kkt_residual() > 0.009


@pytest.mark.parametrize("damage", ["inverse", "theta", "set"])
def test_drift_beyond_the_tolerance_is_repaired(damage):
    options = {"bandwidth": 0.3, "cost": 2.0, "tube": 0.05}
    x, y = random_data(9, 30, 2)
    svr = online(x[:25], y[:25], **options)
    if damage == "inverse":
        svr._inverse *= 1 + 1e-2 * np.random.default_rng(0).random(svr._inverse.shape)
    elif damage == "theta":
        svr._theta[svr.support_set] *= 0.9
    else:
        svr._leave(svr._support[0], 0.0)
    for i in range(25, 30):
        svr.add(x[i], y[i])
    check_against_batch(svr, x, y, options)


def test_a_drifted_inverse_is_factored_anew_without_learning_again(monkeypatch):
    options = {"bandwidth": 0.3, "cost": 2.0, "tube": 0.05}
    x, y = random_data(9, 30, 2)
    svr = online(x, y, **options)
    svr._inverse *= 1 + 1e-2 * np.random.default_rng(0).random(svr._inverse.shape)
    svr._theta[svr.support_set] *= 0.99
    monkeypatch.setattr(OnlineSVR, "_refit", lambda svr: pytest.fail("learned again"))
    svr._verify()
    assert violation(svr, x, y, **options) < KKT_ATOL * max(1, options["cost"])


def test_a_resumed_solution_that_does_not_hold_is_refitted():
    options = {"bandwidth": 0.3, "cost": 2.0, "tube": 0.05}
    x, y = random_data(10, 30, 2)
    svr = OnlineSVR(**options)
    svr.resume(x, y, np.random.default_rng(0).uniform(-2, 2, 30), 0.0)
    check_against_batch(svr, x, y, options)


def test_predict_keeps_the_leading_shape():
    x, y = random_data(11, 10, 3)
    svr = online(x, y, bandwidth=0.3)
    query = np.random.default_rng(0).random((4, 5, 3))
    assert svr.predict(query).shape == (4, 5)
    assert svr.predict(query)[1, 2] == pytest.approx(float(svr.predict(query[1, 2])))


def test_errors_say_what_was_found():
    with pytest.raises(ValueError, match=r"bandwidth=0\.0"):
        OnlineSVR(bandwidth=0.0)
    svr = online([[0.0, 1.0]], [0.5], bandwidth=1.0)
    with pytest.raises(ValueError, match=r"sample 1 is x=\[nan  0\.\]"):
        svr.add([np.nan, 0.0], 0.5)
    with pytest.raises(ValueError, match=r"shape \(3,\), needs \(2,\)"):
        svr.add([0.0, 0.0, 0.0], 0.5)
    with pytest.raises(IndexError, match="sample 1 does not exist, 1 are kept"):
        svr.remove(1)


NUM_NODES, INPUT_DIM, ACTION_DIM = 6, 4, 2
OPTIONS = {"bandwidth": 0.5, "cost": 5.0, "tube": 0.03}


def bank_data(seed, batch):
    """Samples of nodes 0 to 4; node 5 never gets one."""
    generator = torch.Generator().manual_seed(seed)
    inputs = torch.rand(batch, INPUT_DIM, generator=generator, dtype=torch.float64)
    targets = torch.rand(batch, ACTION_DIM, generator=generator, dtype=torch.float64)
    return inputs, targets, torch.randint(0, NUM_NODES - 1, (batch,), generator=generator)


def new_bank():
    return SVRBank(NUM_NODES, INPUT_DIM, ACTION_DIM, **OPTIONS)


def saved_and_loaded(bank):
    file = io.BytesIO()
    torch.save(bank.state_dict(), file)
    file.seek(0)
    other = new_bank()
    other.load_state_dict(torch.load(file))
    return other


def test_bank_predicts_what_each_nodes_own_regression_predicts(monkeypatch):
    inputs, targets, node = bank_data(0, 90)
    bank = new_bank()
    error = bank.partial_fit(inputs, targets, node)
    expected = torch.empty_like(targets)
    for k in range(NUM_NODES - 1):
        mine = node == k
        for a in range(ACTION_DIM):
            svr = online(inputs[mine].numpy(), targets[mine, a].numpy(), **OPTIONS)
            expected[mine, a] = torch.from_numpy(svr.predict(inputs[mine].numpy()))
    torch.testing.assert_close(bank(inputs, node), expected, atol=EXACT_ATOL, rtol=0)
    assert error == pytest.approx(float((expected - targets).abs().mean()))
    monkeypatch.setattr(online_svr, "MAX_GATHERED", 1000)  # several pieces
    torch.testing.assert_close(bank(inputs, node), expected, atol=EXACT_ATOL, rtol=0)


def test_nodes_without_samples_predict_the_stop_action():
    bank = new_bank()
    inputs, targets, node = bank_data(1, 10)
    assert (bank(inputs, node) == 0.5).all()
    bank.partial_fit(inputs, targets, node)
    assert (bank(inputs, torch.full((10,), NUM_NODES - 1)) == 0.5).all()
    assert bank(inputs[:0], node[:0]).shape == (0, ACTION_DIM)
    assert bank.partial_fit(inputs[:0], targets[:0], node[:0]) == 0.0


def test_learning_continues_after_loading_as_if_it_had_never_stopped():
    inputs, targets, node = bank_data(2, 120)
    bank = new_bank()
    bank.partial_fit(inputs[:80], targets[:80], node[:80])
    loaded = saved_and_loaded(bank)
    for part in (slice(80, 81), slice(81, 120)):
        bank.partial_fit(inputs[part], targets[part], node[part])
        loaded.partial_fit(inputs[part], targets[part], node[part])
    for name, value in bank.state_dict().items():
        assert torch.equal(value, loaded.state_dict()[name]), name
    whole = new_bank()
    whole.partial_fit(inputs, targets, node)
    torch.testing.assert_close(bank.dual_coef, whole.dual_coef, atol=EXACT_ATOL, rtol=0)
    torch.testing.assert_close(bank.bias, whole.bias, atol=EXACT_ATOL, rtol=0)


def test_a_state_replaces_whatever_the_bank_held():
    inputs, targets, node = bank_data(3, 60)
    small, large = new_bank(), new_bank()
    small.partial_fit(inputs[:5], targets[:5], node[:5])
    large.partial_fit(inputs, targets, node)
    small_state = copy.deepcopy(small.state_dict())
    small.load_state_dict(large.state_dict())
    torch.testing.assert_close(small(inputs, node), large(inputs, node), atol=0, rtol=0)
    large.load_state_dict(small_state)
    assert int(large.num_samples.sum()) == 5
    with pytest.raises(RuntimeError, match="size mismatch"):
        SVRBank(NUM_NODES + 1, INPUT_DIM, ACTION_DIM, **OPTIONS).load_state_dict(small_state)


def test_fit_forgets_and_partial_fit_does_not():
    inputs, targets, node = bank_data(4, 40)
    bank, fresh = new_bank(), new_bank()
    bank.fit(inputs[:20], targets[:20], node[:20])
    bank.fit(inputs[20:], targets[20:], node[20:])
    fresh.partial_fit(inputs[20:], targets[20:], node[20:])
    for name, value in bank.state_dict().items():
        assert torch.equal(value, fresh.state_dict()[name]), name
    bank.partial_fit(inputs[:20], targets[:20], node[:20])
    assert int(bank.num_samples.sum()) == 40
    bank.reset()
    for name, value in bank.state_dict().items():
        assert torch.equal(value, new_bank().state_dict()[name]), name


def test_single_precision_inputs_and_buffers_are_accepted():
    inputs, targets, node = bank_data(5, 60)
    bank = new_bank()
    bank.partial_fit(inputs.float(), targets.float(), node)
    assert bank(inputs.float(), node).dtype == torch.float32
    single = copy.deepcopy(bank).float()
    torch.testing.assert_close(single(inputs, node), bank(inputs, node), atol=1e-4, rtol=0)
    single.partial_fit(inputs[:5] + 0.1, targets[:5], node[:5])
    bank.partial_fit(inputs[:5] + 0.1, targets[:5], node[:5])
    torch.testing.assert_close(single(inputs, node), bank(inputs, node), atol=1e-4, rtol=0)


def test_prediction_has_a_gradient_with_respect_to_the_inputs():
    inputs, targets, node = bank_data(6, 30)
    bank = new_bank()
    bank.partial_fit(inputs, targets, node)
    query = inputs[:4].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: bank(x, node[:4]), query)


def test_bank_errors_name_the_sample_and_leave_the_bank_alone():
    inputs, targets, node = bank_data(7, 5)
    bank = new_bank()
    with pytest.raises(ValueError, match=r"node\[2\] is 6, needs 0 to 5"):
        bank.partial_fit(inputs, targets, torch.tensor([0, 1, 6, 0, 0]))
    with pytest.raises(ValueError, match="need"):
        bank.partial_fit(inputs, targets[:, :1], node)
    targets[3, 1] = torch.nan
    with pytest.raises(ValueError, match="sample 3 has a number that is not finite"):
        bank.partial_fit(inputs, targets, node)
    assert int(bank.num_samples.sum()) == 0
