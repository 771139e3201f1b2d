"""`experiments.benchmark`: that its tables say what was run, not how fast this machine is."""

import importlib.util
import json
import os

import gymnasium as gym
import pytest
import torch

from experiments import benchmark, reach
from rfl_torch import Agent, AgentConfig, Stage, record


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """A job of a moment, on the processor cores that the tests had before."""
    monkeypatch.setattr(benchmark, "NUM_STEPS", 60)
    monkeypatch.setattr(benchmark, "SHAPE", (4, 4))
    monkeypatch.setattr(benchmark, "ROUNDS", 2)
    cores, threads = os.sched_getaffinity(0), torch.get_num_threads()
    yield
    os.sched_setaffinity(0, cores)
    torch.set_num_threads(threads)


def test_the_log_is_seeded_noisy_and_follows_a_walk():
    log = benchmark.make_log(500, seed=1)
    assert log.shape == (500, 24)
    assert torch.equal(log, benchmark.make_log(500, seed=1))
    assert not torch.equal(log, benchmark.make_log(500, seed=2))
    assert -0.1 < log.min() < log.max() < 1.1
    assert log.diff(dim=0).abs().mean() < 0.3 * log.std(0).mean()  # neighbours look alike


def test_every_timed_iteration_starts_from_the_same_model():
    job = benchmark.make_job(60, (4, 4), 0)
    work = benchmark.iterate(job)
    first, second = work(), work()
    assert torch.equal(first.log_likelihood, second.log_likelihood)


def test_what_is_compared_is_run_in_turn_and_the_second_of_two_runs_counts(monkeypatch):
    calls, now = [], iter([0.0, 3.0, 3.0, 8.0, 8.0, 10.0, 10.0, 16.0])
    monkeypatch.setattr(benchmark, "clock", lambda: next(now))
    works = [lambda: calls.append("a"), lambda: calls.append("b")]
    assert benchmark.best_in_turn(works, 2) == [2.0, 5.0]
    assert calls == list("aabbaabb")


def test_the_plain_loop_takes_the_jobs_arrays():
    assert benchmark.run_torch_loop(benchmark.make_job(30, (4, 4), 0)) > 0


def test_a_library_that_is_not_installed_is_left_out_with_a_note(monkeypatch, capsys):
    peers = {"nothing": ("no_such_package", benchmark.run_hmmlearn)}
    monkeypatch.setattr(benchmark, "PEERS", peers)
    benchmark.print_peers(benchmark.Em(peer_steps=30))
    lines = capsys.readouterr().out.splitlines()
    assert [line.split() for line in lines if "nothing" in line] == [
        ["nothing", "not", "installed"]
    ]


@pytest.mark.parametrize("name", [n for n, (p, _) in benchmark.PEERS.items() if p != "torch"])
def test_an_installed_library_runs_on_the_same_arrays(name):
    package, _ = benchmark.PEERS[name]
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    assert benchmark.time_peer(name, benchmark.Em(peer_steps=20)) > 0


def test_online_times_a_step_of_an_agent_that_keeps_all_its_nodes(capsys):
    benchmark.main(benchmark.Online(num_steps=300, sides=(4,), maze_steps=500))
    out = capsys.readouterr().out
    assert "filter step, N = 16" in out
    assert "Executor.act, N = 16" in out
    assert "the same put down anywhere, N = " in out


def test_fleet_times_a_job_of_one_without_torchrun(monkeypatch, capsys):
    monkeypatch.delenv("RANK", raising=False)
    benchmark.main(benchmark.Fleet(num_steps=60, sides=(4,)))
    out = capsys.readouterr().out
    assert "1 rank(s), T = 60 each" in out
    assert " 11152 " in out  # 8 (16 (2 + 13 + 72) + 2) bytes


def test_em_times_the_engine_against_two_matrix_products(monkeypatch, capsys):
    monkeypatch.setattr(benchmark, "PEERS", {})
    monkeypatch.setattr(benchmark, "print_scaling", lambda config: None)
    benchmark.main(benchmark.Em(peer_steps=30))
    lines = capsys.readouterr().out.splitlines()
    products = next(line for line in lines if line.startswith("two float32"))
    assert products.split()[-1] == "1.00"


@pytest.mark.parametrize(("layout", "least", "most"), [("paper", 20, 20), ("twins", 8, 16)])
def test_a_sight_tells_a_place_unless_another_looks_the_same(layout, least, most):
    """Of 20 places; in `twins` half are in bays of which four look alike."""
    with gym.make("rfl/RangefinderMaze-v0", layout=layout) as env:
        row = reach.Judge(env, layout, 0, 20).best_by_sight()
    assert least <= row.places.successes <= most


def test_who_learns_from_tasks_knows_more_after_each_half_and_the_contestant_stays_as_it_was():
    """A log of 2,000 steps knows a part of the room."""
    stages = (Stage(3, 60, (0.01, 1.0), pseudo_count=0.01, min_scale=0.05, tolerance=0.0),)
    with gym.make("rfl/RangefinderMaze-v0", layout="paper") as env:
        log = record(env, 2000, hold=3, seed=0)
        agent = Agent(AgentConfig(shape=(8, 8), stages=stages)).fit(log)
        assert agent.has_track
        judge, num_nodes = reach.Judge(env, "paper", 0, 6), agent.num_nodes
        before = judge.score("before", agent, [log], 0.0)
        rows = list(judge.score_on_the_way("learning", agent, log))
    assert before.coverage + 0.1 < rows[0].coverage <= rows[1].coverage
    assert 2000 < rows[0].num_steps < rows[1].num_steps
    assert [row.anywhere.trials for row in rows] == [3, 3]
    assert agent.num_nodes == num_nodes


def test_reach_runs_whom_it_is_asked_for_and_keeps_their_rows(tmp_path, capsys):
    choices = {"num_steps": 300, "trials": 3, "seeds": 1, "layouts": ("paper",)}
    names = ("best-by-sight", "held-3", "knows-walls")
    benchmark.main(reach.Reach(contestants=names, out=tmp_path, **choices))
    rows = {row["name"]: row for row in json.loads((tmp_path / "results.json").read_text())}
    assert list(rows) == ["best by sight", "default, held 3", "knows the walls, not the log held 3"]
    assert rows["default, held 3"]["num_steps"] == 600
    assert rows["knows the walls, not the log held 3"]["anywhere"]["trials"] == 3
    assert (tmp_path / "reach.png").stat().st_size > 0
    table = capsys.readouterr().out
    assert all(name in table for name in rows)
