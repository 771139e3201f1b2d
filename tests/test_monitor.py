"""`rfl_torch.monitor`, read back with TensorBoard's own reader."""

import math
import sys

import numpy as np
import pytest
import torch
from scipy.spatial import procrustes

from rfl_torch import monitor
from rfl_torch.hmm import GridHMM
from rfl_torch.learning import Progress, Stage, learn
from rfl_torch.monitor import TensorBoardMonitor, map_layout, map_picture, transition_entropy

event_accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")

SCALARS = {
    "hmm/log_likelihood_per_step",
    "hmm/active_nodes",
    "hmm/transition_entropy",
    "hmm/temperature",
    "time/seconds_per_iteration",
}


@pytest.fixture
def observations():
    return torch.rand(60, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def read(logdir):
    events = event_accumulator.EventAccumulator(str(logdir))
    events.Reload()
    return events


def test_learning_is_read_back_from_one_event_file(tmp_path, observations):
    hmm = GridHMM((3, 3), 2)
    stages = (Stage(2, 3, temperature=(0.5, 1.0)), Stage(1, 2))
    with TensorBoardMonitor(tmp_path) as writer:
        record = learn(hmm, [observations], stages, writer)
    assert len(list(tmp_path.iterdir())) == 1
    events = read(tmp_path)
    assert set(events.Tags()["scalars"]) == SCALARS
    likelihood = events.Scalars("hmm/log_likelihood_per_step")
    assert [event.step for event in likelihood] == [0, 1, 2, 3, 4]
    expected = [progress.log_likelihood_per_step for progress in record]
    np.testing.assert_allclose([event.value for event in likelihood], expected, rtol=1e-6)
    temperature = [event.value for event in events.Scalars("hmm/temperature")]
    np.testing.assert_allclose(temperature, [p.temperature for p in record], rtol=1e-6)
    images = events.Images("map/graph")
    assert [image.step for image in images] == [0, 3, 5]  # the first, and each stage's end
    assert {(image.width, image.height) for image in images} == {(640, 640)}


def test_the_map_is_drawn_again_and_again(tmp_path, monkeypatch, observations):
    monkeypatch.setattr(monitor, "MAP_EVERY", 2)
    with TensorBoardMonitor(tmp_path) as writer:
        learn(GridHMM((3, 3), 2), [observations], (Stage(1, 5, tolerance=0.0),), writer)
    assert [image.step for image in read(tmp_path).Images("map/graph")] == [0, 2, 4, 5]


@pytest.mark.filterwarnings("ignore:.*NumPy:DeprecationWarning")
def test_nodes_are_written_for_the_projector_with_labels(tmp_path):
    hmm = GridHMM((2, 3), 4)
    hmm.keep_nodes(torch.tensor([True, False, True, True, True, True]))
    with TensorBoardMonitor(tmp_path) as writer:
        writer.nodes(hmm, np.arange(5) * 10)
    (vectors,) = tmp_path.rglob("tensors.tsv")
    np.testing.assert_allclose(
        np.loadtxt(vectors, delimiter="\t"), hmm.emission_mean.detach(), rtol=1e-6
    )
    (labels,) = tmp_path.rglob("metadata.tsv")
    rows = [line.split("\t") for line in labels.read_text().splitlines()]
    assert rows[0] == ["node", "steps of the log", "neighbours"]
    assert rows[1][:2] == ["0", "0"]
    assert rows[5][:2] == ["4", "40"]
    degree = monitor._symmetric_graph(hmm).toarray().astype(bool).sum(1)
    assert [int(row[2]) for row in rows[1:]] == degree.tolist()
    assert len(list(tmp_path.glob("events*"))) == 1
    assert "nodes" in (tmp_path / "projector_config.pbtxt").read_text()


def test_active_nodes_are_those_expected_at_least_once(tmp_path, observations):
    hmm = GridHMM((2, 2), 2)
    statistics = hmm.e_step(observations)
    statistics.node[:] = torch.tensor([0.0, 0.99, 1.0, 58.0])
    with TensorBoardMonitor(tmp_path) as writer:
        writer.on_iteration(hmm, statistics, Progress(0, 0, 1.0, -1.0, 0.1))
    assert read(tmp_path).Scalars("hmm/active_nodes")[0].value == 2


def test_transition_entropy_is_weighted_by_visits(observations):
    hmm = GridHMM((2, 2), 2, radius=1.0)  # two neighbours each, without itself or with: uniform
    statistics = hmm.e_step(observations)
    with torch.no_grad():
        hmm.transition_logits[0] = torch.tensor([0.0] + [-1e9] * (hmm.successor.shape[1] - 1))
    uniform = math.log(int(hmm.successor_mask[1].sum()))
    statistics.node[:] = torch.tensor([3.0, 1.0, 0.0, 0.0])
    assert transition_entropy(hmm, statistics) == pytest.approx(uniform / 4, abs=1e-12)


def test_texts_numbers_and_pictures_are_read_back(tmp_path):
    picture = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    with TensorBoardMonitor(str(tmp_path)) as writer:
        writer.config({"seed": 3, "stage": {"stride": (2, 1)}, "note": "a|b\nc"})
        writer.text("note", "**bold**")
        writer.scalar("execute/success_rate", 0.5, 7)
        writer.image("execute/way", picture, 2)
        writer.close()
    events = read(tmp_path)
    assert {"config/text_summary", "note/text_summary"} <= set(events.Tags()["tensors"])
    table = events.Tensors("config/text_summary")[0].tensor_proto.string_val[0].decode()
    assert "| seed | 3 |" in table
    assert "| stage.stride | (2, 1) |" in table
    assert r"| note | a\|b c |" in table
    assert events.Scalars("execute/success_rate")[0].step == 7
    assert (events.Images("execute/way")[0].width, events.Images("execute/way")[0].height) == (6, 4)


def test_map_of_an_untrained_lattice_is_the_lattice():
    nodes, place = map_layout(GridHMM((6, 9), 2))
    expected = np.stack(np.unravel_index(nodes, (6, 9)), -1)
    assert procrustes(expected, place)[2] < 0.05  # share of the variance that does not fit


def test_map_shows_the_largest_connected_part():
    hmm = GridHMM((1, 8), 2, radius=1.0)
    kept = torch.ones(8, dtype=torch.bool)
    kept[2] = False  # two nodes on one side, five on the other
    hmm.keep_nodes(kept)
    nodes, place = map_layout(hmm)
    assert nodes.tolist() == [2, 3, 4, 5, 6]
    assert place.shape == (5, 2)


def test_map_of_few_nodes_is_drawn():
    picture = map_picture(GridHMM((2, 1), 2))
    assert picture.shape == (640, 640, 3)
    assert picture.std() > 0


def test_map_is_left_out_without_matplotlib_or_with_too_many_nodes(
    tmp_path, monkeypatch, observations
):
    hmm = GridHMM((3, 3), 2)
    with monkeypatch.context() as patch:
        patch.setattr(monitor, "MAX_MAP_NODES", 8)
        assert map_picture(hmm) is None
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with TensorBoardMonitor(tmp_path) as writer:
        learn(hmm, [observations], (Stage(1, 1),), writer)
    assert read(tmp_path).Tags()["images"] == []


def test_missing_tensorboard_names_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ImportError, match="pip install tensorboard"):
        TensorBoardMonitor(tmp_path)
    assert not list(tmp_path.iterdir())
