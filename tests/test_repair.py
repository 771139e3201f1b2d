import numpy as np
import pytest
import torch
from scipy.sparse import csr_array

from rfl_torch import GridHMM, repair


def two_corridors():
    """Old nodes 0-4 to and fro, a bridge 10-19, then 5-9 which look the same."""
    there = [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    bridge = [node for node in range(10, 20) for _ in range(2)]
    back = [5, 5, 6, 6, 7, 7, 8, 8, 9, 9]
    path = (there + there[::-1]) * 3 + bridge + (back + back[::-1]) * 3 + bridge[::-1]
    path = np.array(path * 2)
    look = np.where(path < 5, path, np.where(path < 10, path - 5, path))
    return look, path


def test_one_look_at_two_places_becomes_two_nodes():
    look, path = two_corridors()
    (node,) = repair.split_by_place([look], [path])
    for old in range(5):
        assert set(node[path == old]).isdisjoint(node[path == old + 5])
    for part in np.unique(node):
        assert len(np.unique(look[node == part])) == 1


def test_one_node_with_two_looks_becomes_two_nodes():
    path = np.array([0, 0, 1, 1] * 20)
    look = np.array([0, 0, 1, 1] * 10 + [2, 2, 1, 1] * 10)
    (node,) = repair.split_by_place([look], [path])
    assert np.unique(node).tolist() == [0, 1, 2]
    assert (node == look).all()


def test_a_slip_of_recognition_makes_no_node():
    look, path = two_corridors()
    slipped = path.copy()
    slipped[2] = 15  # one step of look 1 at a far node
    (node,) = repair.split_by_place([look], [slipped])
    assert node[2] in node[path == 1][1:]


def test_counts_of_two_logs_add_to_the_counts_of_both():
    rng = np.random.default_rng(2)
    nodes = [rng.integers(4, size=50), rng.integers(6, size=40)]
    seen = [rng.random((50, 3)), rng.random((40, 3))]
    seen[1][3, 1] = np.nan
    both = repair.Counts.of(nodes, seen, 6)
    one = repair.Counts.of(nodes[:1], seen[:1], 4).padded(6)
    total = one + repair.Counts.of(nodes[1:], seen[1:], 6)
    assert (both.edges != total.edges).nnz == 0
    for name in ("weight", "first", "second"):
        np.testing.assert_allclose(getattr(both, name), getattr(total, name))
    assert both.weight[:, 1].sum() == 89


def test_a_rebuilt_map_has_the_frequencies_means_and_scales_of_the_labelled_log():
    rng = np.random.default_rng(3)
    path = rng.integers(3, size=3000)
    path = np.where(path == 2, 0, path)  # 0 and 1 only ...
    path[1000:1003] = [0, 2, 0]  # ... and a glimpse of 2
    center = np.array([[0.2, 0.2], [0.5, 0.9], [0.8, 0.1]])
    seen = center[path] + 0.05 * rng.standard_normal((3000, 2))
    counts = repair.Counts.of([path], [seen], 3)
    hmm = GridHMM((2, 2), 2)
    repair.rebuild(hmm, counts, is_reversible=False, min_scale=0.01, pseudo_count=1e-9)
    dense = counts.edges.toarray()
    expected = dense / dense.sum(1, keepdims=True)
    np.testing.assert_allclose(hmm.transition_matrix().detach().numpy(), expected, atol=1e-6)
    for node in range(2):
        own = seen[path == node]
        np.testing.assert_allclose(hmm.emission_mean[node].detach(), own.mean(0))
        np.testing.assert_allclose(hmm.emission_scale[node].detach(), own.std(0))
    assert (hmm.most_likely_path(seen).numpy() == path).mean() > 0.999


def test_a_reversible_rebuild_joins_both_ways_and_another_one_way():
    counts = repair.Counts.of([np.array([0, 1, 2])], [np.eye(3)], 3)
    for is_reversible, num_edges in ((False, 5), (True, 7)):
        hmm = GridHMM((2, 2), 3)
        repair.rebuild(hmm, counts, is_reversible, min_scale=0.1, pseudo_count=0.01)
        assert int(hmm.successor_mask.sum()) == num_edges  # with 3 loops
        assert (hmm.transition_matrix()[1, 0] > 0) == is_reversible


def test_a_reading_that_a_node_never_had_counts_as_the_logs():
    seen = np.array([[0.0, np.nan], [0.0, np.nan], [1.0, 4.0], [1.0, 6.0]])
    counts = repair.Counts.of([np.array([0, 0, 1, 1])], [seen], 2)
    hmm = GridHMM((2, 2), 2)
    repair.rebuild(hmm, counts, True, min_scale=0.01, pseudo_count=0.01)
    assert hmm.emission_mean[0].tolist() == [0.0, 5.0]
    assert hmm.emission_scale[0].tolist() == pytest.approx([0.01, 1.0])


def test_inference_on_a_rebuilt_map_is_that_of_its_dense_transitions():
    """Forward sums over a dense matrix, in float64 log-space."""
    rng = np.random.default_rng(4)
    path = rng.integers(30, size=4000)
    seen = rng.random((30, 2))[path]
    hmm = GridHMM((2, 2), 2)
    counts = repair.Counts.of([path], [seen], 30)
    sparse = counts.edges.multiply(counts.edges >= 4)
    counts = repair.Counts(csr_array(sparse), counts.weight, counts.first, counts.second)
    repair.rebuild(hmm, counts, True, min_scale=0.1, pseudo_count=0.01)
    with torch.no_grad():
        log_a = hmm.transition_matrix().log()
        value = torch.from_numpy(seen[:200])
        normal = torch.distributions.Normal(hmm.emission_mean, hmm.emission_scale)
        log_b = normal.log_prob(value[:, None]).sum(-1)
        alpha = log_b[0] + hmm.initial_logits.log_softmax(0)
        for t in range(1, 200):
            alpha = (alpha[:, None] + log_a).logsumexp(0) + log_b[t]
    assert hmm.log_likelihood(value).item() == pytest.approx(alpha.logsumexp(0).item(), rel=1e-6)


def test_nodes_keep_the_number_of_the_old_node_that_they_share_most_steps_with():
    before = np.array([0, 0, 0, 1, 1, 2, 2, 3])
    nodes = np.array([2, 2, 0, 0, 0, 4, 4, 4, 1, 3])  # 3 has joined 2; 1 and 3 are new
    assert repair.keep_numbers(nodes, before).tolist() == [0, 0, 1, 1, 1, 2, 2, 2, 3, 4]
    rng = np.random.default_rng(0)
    before = rng.integers(20, size=300)
    shuffled = rng.permutation(20)[before]
    assert (repair.keep_numbers(shuffled, before) == before).all()


def test_numbers_have_no_gaps_when_nodes_are_gone():
    rng = np.random.default_rng(1)
    for _ in range(20):
        before, nodes = rng.integers(12, size=50), rng.integers(8, size=60)
        found = repair.keep_numbers(np.unique(nodes, return_inverse=True)[1], before)
        num_nodes = len(np.unique(nodes))
        assert set(found) == set(range(num_nodes))
        assert len({*zip(found.tolist(), nodes.tolist(), strict=True)}) == num_nodes


def test_a_node_that_only_the_last_step_came_to_can_be_stayed_at():
    path = np.array([0, 1, 0, 1, 2])
    counts = repair.Counts.of([path], [np.eye(3)[path]], 3)
    hmm = GridHMM((2, 2), 3)
    repair.rebuild(hmm, counts, False, 0.3, 0.0)
    transition = hmm.transition_matrix().detach().numpy()
    np.testing.assert_allclose(transition.sum(1), 1.0)
    assert transition[2, 2] == pytest.approx(1.0)
