"""The commands of `experiments`: what they write, and how they refuse."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest

from experiments import cli, execute, practice, record, reproduce, scoring, train
from rfl_torch import Agent, AgentConfig, Stage, Trajectory

PENDULUM = "rfl/TorquePendulum-v0"


def tiny(config=None):
    stages = (Stage(2, 6, (0.05, 0.3), min_scale=0.05), Stage(1, 3, (0.3, 0.3), min_scale=0.05))
    return dataclasses.replace(config or AgentConfig(), shape=(5, 5), stages=stages)


@pytest.fixture(autouse=True)
def tiny_agents(monkeypatch):
    monkeypatch.setattr(
        train,
        "CONFIGS",
        {
            "default": tiny,
            "paper": lambda: tiny(AgentConfig.paper()),
            "pendulum": tiny,
            "paper-pendulum": lambda: tiny(AgentConfig.paper()),
        },
    )


@pytest.fixture
def log(tmp_path):
    record.main(record.Config(out=tmp_path / "log.npz", num_steps=400))
    return tmp_path / "log.npz"


@pytest.fixture
def model(tmp_path, log):
    train.main(train.Config(log=(str(log),), out=tmp_path / "maze.safetensors"))
    return tmp_path / "maze.safetensors"


def command(*arguments):
    return subprocess.run(
        [sys.executable, "-m", *map(str, arguments)], capture_output=True, text=True, timeout=60
    )


# -- what they do -----------------------------------------------------------------------------


def test_record_makes_folders_and_repeats_itself(tmp_path):
    paths = [tmp_path / "new" / "folder" / f"{i}.npz" for i in range(2)]
    for path in paths:
        record.main(record.Config(out=path, num_steps=50, layout="loop", seed=3))
    first, second = map(Trajectory.load, paths)
    assert first.num_steps == 50
    assert first.ground_truth is not None
    np.testing.assert_array_equal(first.observations, second.observations)


def test_record_holds_actions_of_few_levels(tmp_path):
    config = record.Config(out=tmp_path / "a.npz", env=PENDULUM, num_steps=90, hold=30, levels=3)
    record.main(config)
    actions = Trajectory.load(config.out).actions.reshape(3, 30)
    assert (actions == actions[:, :1]).all()
    assert set(np.unique(actions)) <= {-1.0, 0.0, 1.0}


def test_train_writes_an_agent_and_events_and_says_so(tmp_path, log, capsys):
    config = train.Config(
        log=(str(log), str(log)), out=tmp_path / "a.safetensors", logdir=tmp_path / "tb"
    )
    train.main(config)
    assert Agent.load(config.out).num_nodes > 1
    assert "log-likelihood per step" in capsys.readouterr().out
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = accumulator.EventAccumulator(str(config.logdir))
    events.Reload()
    assert len(events.Scalars("hmm/log_likelihood_per_step")) == 9
    assert events.Scalars("controllers/loss")


def test_execute_prints_belief_and_truth(tmp_path, log, model, capsys):
    config = execute.Config(
        model=model, trials=3, limit=40, log=(str(log),), gif=tmp_path / "way.gif"
    )
    execute.main(config)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:3] == ["goals", "believed", "true"]
    assert [line.split()[0] for line in lines[2:]] == ["nodes", "places"]
    assert config.gif.read_bytes()[:6] == b"GIF89a"


def test_execute_without_the_log_knows_places_but_no_nodes(tmp_path, model, capsys):
    execute.main(execute.Config(model=model, trials=2, limit=10, logdir=tmp_path / "tb"))
    nodes, places = capsys.readouterr().out.splitlines()[2:]
    assert "unknown" in nodes
    assert "unknown" not in places
    assert list((tmp_path / "tb").iterdir())


def test_execute_learns_between_the_tasks_if_told_to(tmp_path, log, model, capsys):
    out, before = tmp_path / "better.safetensors", model.read_bytes()
    config = execute.Config(model=model, trials=3, limit=300, log=(str(log),), learn=out)
    execute.main(config)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[2:]] == ["nodes", "places", f"{out}:"]
    assert lines[-1].endswith(f"{Agent.load(out).num_nodes} now")
    assert Agent.load(out).edges.sum() > Agent.load(model).edges.sum() + 50
    assert model.read_bytes() == before


def test_practice_learns_more_and_tells_by_strategy(tmp_path, model, capsys):
    out = tmp_path / "practised.safetensors"
    config = practice.Config(model, out, num_steps=120, strategy="random", logdir=tmp_path / "tb")
    practice.main(config)
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].startswith(f"{out}: {Agent.load(model).num_nodes} nodes before, ")
    assert lines[-1].endswith(f"{Agent.load(out).num_nodes} now")
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = accumulator.EventAccumulator(str(config.logdir))
    events.Reload()
    names = {f"practice/{name}/random" for name in ("success_rate", "surprise", "nodes")}
    assert set(events.Tags()["scalars"]) == names


def test_execute_goes_to_one_goal(model, capsys):
    execute.main(execute.Config(model=model, trials=2, limit=10, goal=1))
    assert capsys.readouterr().out.splitlines()[2].startswith("node 1 ")


@pytest.mark.parametrize(
    ("experiment", "pictures"),
    [
        (
            "maze",
            {
                "figure_5_trajectory.png",
                "figure_6_observations.png",
                "figure_7_map_paper.png",
                "figure_7_map_default.png",
                "figure_8_attractors.png",
                "figure_9_execution.png",
                "calibration.png",
                "execution.gif",
            },
        ),
        (
            "pendulum",
            {
                "figure_10b_map_paper.png",
                "figure_10b_map_default.png",
                "figure_11_execution.png",
                "swing_up.gif",
            },
        ),
    ],
)
def test_reproduce_writes_every_number_and_figure(
    tmp_path, capsys, monkeypatch, experiment, pictures
):
    monkeypatch.setattr(reproduce, "SWING_UPS", 2)
    run_task = scoring.run_task

    def run_short_task(env, executor, observation, info, limit, on_step=None):
        return run_task(env, executor, observation, info, min(limit, 30), on_step)

    monkeypatch.setattr(scoring, "run_task", run_short_task)
    reproduce.main(
        reproduce.Config(experiment, seeds=2, out=tmp_path / "run", trials=2, num_steps=400)
    )
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert names == pictures | {"results.json", "seed-0", "seed-1"}
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    for agent in ("paper", "default"):
        assert len(results["per_seed"][agent]) == 2
        for kind, score in results["pooled"][agent]["tasks"].items():
            assert score["believed"]["trials"] == 4, kind
            assert score["true"]["successes"] <= score["believed"]["successes"]
    assert {path.name for path in (tmp_path / "run" / "seed-1").iterdir()} == {
        "log.npz",
        "paper.safetensors",
        "default.safetensors",
        "tensorboard",
    }
    printed = capsys.readouterr().out
    assert "chained nodes" in printed
    assert str(tmp_path / "run") in printed


# -- how they refuse --------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["record", "train", "execute", "reproduce"])
def test_help_lists_the_seed(name, capsys, monkeypatch):
    module = {"record": record, "train": train, "execute": execute, "reproduce": reproduce}[name]
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as end:
        cli.run(module.main, module.Config, module.__doc__)
    assert end.value.code == 0
    assert "--seed" in capsys.readouterr().out


def refusal(capsys, monkeypatch, module, *arguments):
    """Return the line that a command ends with on stderr."""
    monkeypatch.setattr(sys, "argv", ["command", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        cli.run(module.main, module.Config, module.__doc__)
    assert end.value.code == cli.BAD_INPUT
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    return lines[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--num-steps", "0"], "num_steps is 0"),
        (["--num-steps", "many"], "Error parsing --num-steps"),
        (["--steps", "4"], "Unrecognized options"),
        (["--hold", "0"], "hold is 0"),
        (["--env", "rfl/NoSuchThing-v0"], "can't be made"),
        (["--env", "FrozenLake-v1"], "observation space is Discrete"),
        (["--env", "no_such_module:Env-v0"], "no_such_module"),
        (["--env", "Acrobot-v1", "--levels", "3"], "levels is 3"),
        (["--env", "Acrobot-v1", "--observation-keys", "tip"], "have no keys"),
        (["--layout", "nowhere"], "neither built in nor a file"),
        (["--env-kwargs", "{"], "no JSON"),
        (["--env-kwargs", "[1]"], "no JSON object"),
        (["--env-kwargs", '{"colour": 3}'], "colour"),
    ],
)
def test_record_refuses_in_one_line(tmp_path, capsys, monkeypatch, arguments, message):
    out = tmp_path / "log.npz"
    out.write_bytes(b"precious")
    line = refusal(capsys, monkeypatch, record, "--out", out, *arguments)
    assert line.startswith("error: ")
    assert message in line
    assert out.read_bytes() == b"precious"
    assert list(tmp_path.iterdir()) == [out]


def test_output_that_cannot_be_written_is_refused_before_work(tmp_path, capsys, monkeypatch):
    (tmp_path / "file").touch()
    assert "folder" in refusal(capsys, monkeypatch, record, "--out", tmp_path)
    refusal(capsys, monkeypatch, record, "--out", tmp_path / "file" / "log.npz")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--trials", "0"], "--trials is 0"),
        (["--limit", "0"], "--limit is 0"),
        (["--goal", "999"], "--goal is 999"),
        (["--gif", "way.gif"], "--log"),
        (["--gif", "way.gif", "--learn", "better.safetensors"], "leave one of them out"),
        (["--learn", "."], "folder"),
        (["--env", PENDULUM], "the agent learned"),
    ],
)
def test_execute_refuses_in_one_line(model, tmp_path, capsys, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    assert message in refusal(capsys, monkeypatch, execute, "--model", model, *arguments)


def test_reproduce_refuses_in_one_line(tmp_path, capsys, monkeypatch):
    out = ("--out", tmp_path)
    assert "--seeds is 0" in refusal(capsys, monkeypatch, reproduce, "maze", "--seeds", "0", *out)
    refusal(capsys, monkeypatch, reproduce, "swimming", *out)


def test_failed_training_leaves_the_older_agent(tmp_path):
    out, missing = tmp_path / "maze.safetensors", tmp_path / "missing.npz"
    out.write_bytes(b"precious")
    result = command("experiments.train", "--log", missing, "--out", out)
    assert result.returncode == cli.BAD_INPUT
    assert len(result.stderr.splitlines()) == 1
    assert "missing.npz" in result.stderr
    assert out.read_bytes() == b"precious"


def test_file_that_is_no_agent_is_refused_by_name(tmp_path):
    model = tmp_path / "broken.safetensors"
    model.write_bytes(b"\x00" * 100)
    result = command("experiments.execute", "--model", model)
    assert result.returncode == cli.BAD_INPUT
    assert len(result.stderr.splitlines()) == 1
    assert "broken.safetensors" in result.stderr


def test_crash_while_writing_leaves_the_older_file(tmp_path):
    path = tmp_path / "results.json"
    path.write_text("old")

    def write_half():
        with cli.replacing(path) as new:
            new.write_text("half of")
            raise RuntimeError("crash")

    with pytest.raises(RuntimeError, match="crash"):
        write_half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_table_aligns_its_columns():
    lines = cli.table(["name", "share"], [["a", "1"], ["long name", "100 %"]]).splitlines()
    assert lines == ["name       share", "---------  -----", "a              1", "long name  100 %"]


def test_the_goal_of_a_swing_up_is_the_slowest_node_well_inside_the_tolerance():
    mean = np.array([[3.1, 5.0], [-3.05, -2.0], [2.9, 0.0], [0.0, 0.0], [np.nan, np.nan]])
    table = scoring.NodeTable(mean, np.zeros_like(mean), np.ones(5, np.int64))
    assert reproduce.upright_node(table) == 1
    assert reproduce.upright_node(table._replace(mean=mean[2:])) == 0
