"""Files from strangers are refused by name or read as they were written."""

import json
import os
import struct

import numpy as np
import pytest
import torch

from experiments import trust
from rfl_torch import Agent, Trajectory
from rfl_torch.checkpoint import check_layout, load_checkpoint, save_checkpoint


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("files") / "agent.safetensors"
    trust.small_agent().save(path)
    return path


@pytest.mark.parametrize(("make", "cases"), [(trust.damaged, 200), (trust.forged, 200)])
def test_no_damaged_or_forged_file_is_believed(path, make, cases):
    rng = np.random.default_rng(5)
    outcomes = [trust.judge(path, make(path, rng)) for _ in range(cases)]
    assert set(outcomes) <= {"refused", "read right"}
    assert outcomes.count("refused") > 0.7 * cases


def test_a_forged_size_is_refused_before_memory_is_taken_for_it(tmp_path):
    """The header claims 8 TB; the file has a hundred bytes."""
    header = json.dumps(
        {"w": {"dtype": "F64", "shape": [2**40], "data_offsets": [0, 2**43]}}
    ).encode()
    claim = tmp_path / "claim.safetensors"
    claim.write_bytes(struct.pack("<Q", len(header)) + header)
    with pytest.raises(ValueError, match=r"claim\.safetensors"):
        load_checkpoint(claim)
    claim.write_bytes(struct.pack("<Q", 2**62))
    with pytest.raises(ValueError, match=r"claim\.safetensors"):
        load_checkpoint(claim)


def test_a_lattice_far_larger_than_the_map_is_refused(path, tmp_path):
    config, state = load_checkpoint(path)
    config["agent"]["shape"] = [10**6, 10**6]
    save_checkpoint(tmp_path / "big.safetensors", config, state)
    with pytest.raises(ValueError, match=r"big\.safetensors.* cells for "):
        Agent.load(tmp_path / "big.safetensors")


def test_older_and_newer_files_are_refused_with_their_format(path, tmp_path, monkeypatch):
    config, state = load_checkpoint(path)
    for name in ("rfl_torch/1", "rfl_torch/3"):
        with monkeypatch.context() as patch:
            patch.setattr("rfl_torch.checkpoint.FORMAT", name)
            save_checkpoint(tmp_path / "other.safetensors", config, state)
        with pytest.raises(ValueError, match=f"other.safetensors.*{name}"):
            Agent.load(tmp_path / "other.safetensors")


def test_a_folder_and_a_pipe_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for name in ("", "pipe"):
        with pytest.raises(ValueError, match="folder or a device"):
            Agent.load(tmp_path / name)


def test_a_file_is_for_those_whom_the_umask_lets_read(path, tmp_path):
    config, state = load_checkpoint(path)
    for mask, mode in ((0o022, 0o644), (0o077, 0o600)):
        before = os.umask(mask)
        try:
            save_checkpoint(tmp_path / "a.safetensors", config, state)
        finally:
            os.umask(before)
        assert (tmp_path / "a.safetensors").stat().st_mode & 0o777 == mode


def test_a_loaded_agent_has_every_tensor_of_the_saved_one(path, tmp_path):
    Agent.load(path).save(tmp_path / "again.safetensors")
    assert trust.equal(load_checkpoint(path)[1], load_checkpoint(tmp_path / "again.safetensors")[1])


def test_layouts_name_the_tensor_that_does_not_fit():
    state = {"a": torch.zeros(2, 3), "b": torch.zeros(3)}
    layout = {"a": (torch.float32, "NK"), "b": (torch.float32, "K")}
    assert check_layout(state, layout) == {"N": 2, "K": 3}
    with pytest.raises(ValueError, match="b has shape"):
        check_layout(state, layout | {"b": (torch.float32, "N")})
    with pytest.raises(ValueError, match=r"b is torch\.float32"):
        check_layout(state, layout | {"b": (torch.int64, "K")})
    state["b"][1] = torch.nan
    with pytest.raises(ValueError, match="b has a number"):
        check_layout(state, layout)


def test_a_log_that_unpacks_to_more_than_is_taken_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "log.npz"
    np.savez_compressed(path, observations=np.zeros((1000, 50)), actions=np.zeros((999, 1)))
    assert path.stat().st_size < 10_000
    monkeypatch.setattr("rfl_torch.trajectory.MOST_BYTES", 100_000)
    with pytest.raises(ValueError, match=r"log\.npz"):
        Trajectory.load(path)
