"""`rfl_torch.distributed`, with ranks that torchrun really starts."""

import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch

from rfl_torch import distributed, learning
from rfl_torch.distributed import Rank
from rfl_torch.hmm import GridHMM

HERE = Path(__file__).resolve().parent

STAGES = (
    learning.Stage(2, 4, temperature=(0.2, 1.0), pseudo_count=0.1, all_phases=True),
    learning.Stage(1, 6),
)


def make_logs():
    """Two logs of unequal length with a missing reading, and an untrained model."""
    generator = np.random.default_rng(0)
    walk = np.cumsum(0.02 * generator.standard_normal((900, 2)), 0)
    readings = 0.5 + 0.4 * np.sin(3 * walk @ generator.standard_normal((2, 3)))
    readings += 0.01 * generator.standard_normal(readings.shape)
    readings[50, 1] = np.nan
    return [torch.from_numpy(readings[:600]), torch.from_numpy(readings[600:])]


SCRIPT = """
    import os, sys
    import torch
    from test_distributed import STAGES, make_logs
    from rfl_torch import distributed
    from rfl_torch.hmm import GridHMM

    class Fault:
        def on_iteration(self, hmm, statistics, progress):
            if "fault" in sys.argv and progress.stage == 1:
                os._exit(3)

        def on_stage_end(self, hmm, stage):
            pass

    with distributed.job() as rank:
        logs, hmm = make_logs(), GridHMM((4, 5), 3)
        own = [logs[i] for i in distributed.share([len(log) for log in logs], rank)]
        assert len(own) == 1
        distributed.start(hmm, own, "data", seed=rank.index)  # rank 0's counts
        fault = Fault() if rank.index == 1 else None
        record = distributed.learn(hmm, own, STAGES, fault)
        likelihoods = [progress.log_likelihood_per_step for progress in record]
        torch.save((hmm.state_dict(), likelihoods), f"{sys.argv[1]}/rank{rank.index}.pt")
"""


def torchrun(folder, *arguments):
    script = folder / "job.py"
    script.write_text(textwrap.dedent(SCRIPT))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    return subprocess.run(
        [*command, script, folder, *arguments],
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": f"{HERE}:{HERE.parent}"},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )


def test_two_ranks_with_a_log_each_learn_what_one_process_learns(tmp_path):
    done = torchrun(tmp_path)
    assert done.returncode == 0, done.stderr
    logs, hmm = make_logs(), GridHMM((4, 5), 3)
    learning.start(hmm, logs, "data", seed=0)
    record = learning.learn(hmm, logs, STAGES)
    (first, course), (second, _) = (torch.load(tmp_path / f"rank{i}.pt") for i in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert course == pytest.approx([p.log_likelihood_per_step for p in record], rel=1e-9)
    for name, expected in hmm.state_dict().items():
        torch.testing.assert_close(first[name], expected, rtol=1e-6, atol=1e-6)


def test_a_rank_that_dies_ends_the_job_and_the_others_say_why(tmp_path):
    done = torchrun(tmp_path, "fault")
    assert done.returncode != 0
    assert "rank 0 of 2 lost another rank" in done.stderr or "exitcode  : 3" in done.stderr
    assert not list(tmp_path.glob("rank*.pt"))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_every_log_has_one_rank_and_the_steps_are_shared_evenly(count):
    lengths = [10, 70, 30, 20, 40, 5]
    shares = [distributed.share(lengths, Rank(index, count)) for index in range(count)]
    assert sorted(index for share in shares for index in share) == list(range(6))
    loads = [sum(lengths[index] for index in share) for share in shares]
    assert max(loads) <= max(70, 1.2 * 175 / count)


def test_more_ranks_than_logs_is_an_error():
    with pytest.raises(ValueError, match="2 logs cannot be shared among 3 ranks"):
        distributed.share([5, 6], Rank(0, 3))


def test_without_torchrun_the_job_is_one_process(monkeypatch):
    monkeypatch.delenv("RANK", raising=False)
    with distributed.job() as rank:
        assert rank == Rank(0, 1)
    hmm, alone, logs = GridHMM((4, 5), 3), GridHMM((4, 5), 3), make_logs()
    distributed.start(hmm, logs, "data", seed=0)
    distributed.learn(hmm, logs, STAGES[:1])
    learning.start(alone, logs, "data", seed=0)
    learning.learn(alone, logs, STAGES[:1])
    assert all(torch.equal(a, b) for a, b in zip(hmm.parameters(), alone.parameters(), strict=True))


def test_an_iteration_sums_the_bytes_that_the_formula_says(monkeypatch):
    """Counted where the ranks' tensors are summed, over every iteration of a job of one."""
    summed = []
    monkeypatch.setattr(distributed.dist, "is_initialized", lambda: True)
    monkeypatch.setattr(distributed.dist, "broadcast", lambda tensor, src: None)
    monkeypatch.setattr(distributed.dist, "all_reduce", lambda tensor: summed.append(tensor.nbytes))
    hmm = GridHMM((4, 5), 3)
    record = distributed.learn(hmm, make_logs(), STAGES[:1])
    num_nodes, num_edges = hmm.successor.shape
    assert summed == [distributed.bytes_reduced(num_nodes, num_edges, 3)] * len(record)
    assert len(record) == 4
