"""`experiments.describe`: what is odd in a log is named, and what is not is left alone."""

import csv
import sys

import numpy as np
import pytest
import torch
from worlds import dot_log

from experiments import cli, describe, train
from rfl_torch import Agent, Trajectory, read_logs, save_logs


def oddities(logs, side=None):
    logs = [logs] if isinstance(logs, Trajectory) else logs
    return [line for line in describe.describe(logs, side) if line.startswith("!")]


def changed(log, change):
    observations, actions = log.observations.copy(), log.actions.copy()
    change(observations, actions)
    return Trajectory(observations, actions, *log.bounds)


@pytest.fixture(scope="module")
def log():
    return dot_log(2000)


def test_a_plain_log_has_nothing_odd(log):
    assert oddities(log) == []
    assert "suggested grid: 8 x 8" in describe.describe([log])[-1]  # 2000 / 64 = 31 steps a node


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda o, a: o.__setitem__((slice(None), 2), 7.0), "readings [2] never change"),
        (lambda o, a: o.__setitem__((slice(None), 2), np.nan), "readings [2] are always missing"),
        (lambda o, a: o.__setitem__((slice(10, 30), 1), np.nan), "at most 20 steps in a row"),
        (lambda o, a: o.__setitem__((slice(500, None), 3), o[500:, 3] + 3), "after step 499"),
        (lambda o, a: o.__setitem__((slice(None), 0), 1e-4 * o[:, 0]), "reading 0 has a range"),
        (lambda o, a: o.__setitem__((7, 0), 1e3), "readings [0] keep 98 %"),
        (lambda o, a: a.__setitem__((slice(900), 1), 1.0), "action 1 is saturated: 0 % of"),
    ],
)
def test_what_is_odd_is_named(log, change, message):
    assert any(message in line for line in oddities(changed(log, change)))


def test_breaks_between_episodes_are_no_jumps_inside_them(log):
    parts = [
        Trajectory(log.observations[a : b + 1], log.actions[a:b], *log.bounds)
        for a, b in ((0, 700), (1200, 2000))
    ]
    (line,) = oddities(parts)
    assert line.startswith("! 1 episode break,")
    assert "700 to 800 steps" in line


def test_too_little_data_for_the_nodes_asked_is_named(log):
    (line,) = oddities(log, side=20)
    assert "too little data for 20 x 20 nodes: 5.0 steps a node" in line
    assert "record 10000 steps" in line
    assert oddities(log, side=8) == []


def test_one_hot_actions_are_a_choice(log):
    choice = np.eye(3)[np.arange(log.num_steps) % 3]
    text = "\n".join(describe.describe([Trajectory(log.observations, choice)]))
    assert "a choice among 3, taken [33, 33, 33] % of the time" in text


def write_csv(path, num_steps=600):
    """A maze-like log of 24 readings: 3 and 17 constant, 5 with gaps, a break in the middle."""
    logs = [dot_log(num_steps // 2, seed) for seed in (0, 1)]
    rng = np.random.default_rng(0)
    mixing = rng.random((4, 24))
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*(f"obs_{i}" for i in range(24)), "act_x", "act_y", "episode"])
        for episode, log in enumerate(logs):
            observations = log.observations @ mixing
            observations[:, [3, 17]] = 0.25
            actions = np.concatenate([log.actions, [[np.nan, np.nan]]])
            for row, action in zip(observations, actions, strict=True):
                cells = [f"{value:.5f}" for value in row]
                if rng.random() < 0.1:
                    cells[5] = ""
                writer.writerow([*cells, *action, episode])


def test_a_csv_with_constant_columns_gaps_and_a_break_is_described_and_trains(
    tmp_path, capsys, monkeypatch
):
    write_csv(tmp_path / "drive.csv")
    describe.main(describe.Config(log=(str(tmp_path / "drive.csv"),)))
    text = capsys.readouterr().out
    assert "! readings [3, 17] never change" in text
    assert "! reading 5 has gaps" in text
    assert "! 1 episode break" in text
    assert text.count("!") == 3
    out = tmp_path / "drive.safetensors"
    train.main(train.Config(log=(str(tmp_path / "drive.csv"),), out=out, side=5))
    assert "note: readings [3, 17] never change" in capsys.readouterr().err
    agent, logs = Agent.load(out), read_logs(tmp_path / "drive.csv")
    assert agent.hmm.emission_mean.shape[1] == 22
    assert np.isfinite(agent.executor(0).act(logs[0].observations[0])).all()
    # The same log as one npz learns the same.
    save_logs(logs, tmp_path / "drive.npz")
    again = tmp_path / "again.safetensors"
    train.main(train.Config(log=(str(tmp_path / "drive.npz"),), out=again, side=5))
    other = Agent.load(again)
    for name, value in agent.hmm.state_dict().items():
        assert torch.equal(value, other.hmm.state_dict()[name]), name


def test_bad_input_is_refused_in_one_line(tmp_path, capsys, monkeypatch):
    for arguments, message in (
        (["--log", str(tmp_path / "none.npz")], "none.npz"),
        (["--log", "minari:no/such-v0"], "minari:no/such-v0"),
    ):
        monkeypatch.setattr(sys, "argv", ["describe", *arguments])
        with pytest.raises(SystemExit) as end:
            cli.run(describe.main, describe.Config, describe.__doc__)
        assert end.value.code == cli.BAD_INPUT
        (line,) = capsys.readouterr().err.splitlines()
        assert message in line
