"""Learning and practice that are killed go on, and end as if they had not been."""

import os
import warnings

import numpy as np
import pytest
from worlds import dot_config, dot_log

from experiments import practice, record, train, trust
from rfl_torch import Agent, Trajectory, resume
from rfl_torch.checkpoint import load_checkpoint


@pytest.fixture(scope="module")
def log_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("resume") / "log.npz"
    record.main(record.Config(path, num_steps=400, hold=3))
    return path


def test_training_killed_at_random_moments_ends_with_the_same_tensors(log_path, tmp_path):
    options = train.Config((str(log_path),), tmp_path / "a.safetensors", side=6)
    kills, runs, same = trust.kill_and_compare(
        trust._train, options, 4, np.random.default_rng(0), most_a_run=4
    )
    assert (kills, same) == (4, runs)


def test_practice_killed_at_random_moments_ends_with_the_same_tensors(log_path, tmp_path):
    model = tmp_path / "a.safetensors"
    trust._train(train.Config((str(log_path),), model, side=6))
    options = practice.Config(model, tmp_path / "b.safetensors", num_steps=1000)
    kills, runs, same = trust.kill_and_compare(
        trust._practise, options, 2, np.random.default_rng(1), most_a_run=2
    )
    assert (kills, same) == (2, runs)


class StopError(Exception):
    pass


class StopAt:
    """A monitor that ends learning at an iteration."""

    def __init__(self, last):
        self.count, self.last = 0, last

    def on_iteration(self, *_):
        self.count += 1
        if self.count == self.last:
            raise StopError

    def on_stage_end(self, *_):
        pass

    def scalar(self, *_):
        pass


@pytest.mark.parametrize("last", [1, 40, 50])
def test_learning_stopped_at_any_iteration_goes_on_from_there(tmp_path, monkeypatch, last):
    """40 iterations are the first stage's: between stages there is more to be taken up."""
    monkeypatch.setattr(resume, "WRITING_SHARE", np.inf)
    log, path = dot_log(300), tmp_path / "unfinished"
    whole = Agent(dot_config()).fit(log)
    with pytest.raises(StopError):
        Agent(dot_config()).fit(log, StopAt(last), resume=path)
    count = StopAt(-1)
    agent = Agent(dot_config()).fit(log, count, resume=path)
    assert count.count == len(whole.record) - last
    assert [p.log_likelihood_per_step for p in agent.record] == [
        p.log_likelihood_per_step for p in whole.record
    ]
    whole.save(tmp_path / "a.safetensors")
    agent.save(tmp_path / "b.safetensors")
    first, second = (load_checkpoint(tmp_path / f"{x}.safetensors")[1] for x in "ab")
    assert trust.equal(first, second)


def stopped(path, monkeypatch):
    monkeypatch.setattr(resume, "WRITING_SHARE", np.inf)
    with pytest.raises(StopError):
        Agent(dot_config()).fit(dot_log(300), StopAt(5), resume=path)


@pytest.mark.parametrize("other", ["log", "seed", "config", "damage"])
def test_what_was_kept_of_another_learning_is_not_taken_up(tmp_path, monkeypatch, other):
    path = tmp_path / "unfinished"
    stopped(path, monkeypatch)
    log, config, seed = dot_log(300), dot_config(), 0
    if other == "log":
        changed = log.observations.copy()
        changed[7, 1] += 1e-6
        log = Trajectory(changed, log.actions, *log.bounds)
    elif other == "config":
        config = dot_config(repairs=False)
    elif other == "seed":
        seed = 1
    else:
        path.write_bytes(path.read_bytes()[:-1])
    count = StopAt(-1)
    with pytest.warns(UserWarning, match=r"unfinished.*starts from the beginning"):
        agent = Agent(config, seed).fit(log, count, resume=path)
    assert count.count == len(agent.record)


def test_a_full_disk_leaves_what_was_kept_and_learning_goes_on(tmp_path, monkeypatch):
    path = tmp_path / "unfinished"
    stopped(path, monkeypatch)
    before = path.read_bytes()

    def no_space(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="unfinished learning can't be kept")
        Agent(dot_config()).fit(dot_log(300), resume=path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
