"""`experiments.report`: one page that says what happened and why, and needs nothing beside it."""

import dataclasses
import json
import re
import sys

import numpy as np
import pytest
from worlds import dot_config, dot_log

from experiments import cli, execute, report, scoring, train
from rfl_torch import Agent, TensorBoardMonitor


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with a log, an agent of it and the events of its training."""
    run = tmp_path_factory.mktemp("runs") / "dot <1>"
    run.mkdir()
    log = dot_log(1500)
    log.save(run / "log.npz")
    with TensorBoardMonitor(run / "tensorboard") as board:
        train.fit(dot_config(), [log], 0, board).save(run / "agent.safetensors")
    return run


def trial(goal, status="reached", true=True, reason="", start_known=True):
    return {
        "goal": goal,
        "status": status,
        "reason": reason,
        "true": true,
        "num_steps": 12,
        "start_node": 3,
        "end_node": 4,
        "start_known": start_known,
    }


TRIALS = [
    *[trial(0)] * 3,
    trial(1),
    trial(1, "reached", False),
    trial(2, "gave_up", False, "no way is known from here"),
    trial(2, "running", False, start_known=False),
    trial(5, "running", False),
]


def results(trials, options=None):
    share = scoring.wilson(5, 8)
    score = scoring.Score(share, scoring.wilson(4, 8), 12.0, float("nan"), 1)
    return {
        "options": options or {"env": "Pendulum-v1"},
        "tasks": {"nodes": score.to_json()},
        "random_walk": {"nodes": scoring.wilson(2, 8)._asdict()},
        "trials": {"nodes": trials},
    }


@pytest.fixture
def run(trained, tmp_path):
    """A copy of the folder with results and an animation."""
    new = tmp_path / trained.name
    new.mkdir()
    for path in trained.rglob("*"):
        target = new / path.relative_to(trained)
        target.mkdir() if path.is_dir() else target.write_bytes(path.read_bytes())
    (new / "results.json").write_text(json.dumps(results(TRIALS)))
    from PIL import Image

    Image.new("RGB", (40, 30), "white").save(new / "way.gif")
    return new


def render(run):
    report.main(report.Config(run))
    return (run / "report.html").read_text()


def test_a_page_holds_everything_itself(run):
    html = render(run)
    sources = re.findall(r'(?:src|href)="([^"]{0,20})', html)
    assert len(sources) == 3  # map, curves, animation
    assert all(source.startswith("data:image/") for source in sources)
    assert "<title>dot &lt;1&gt;</title>" in html
    for text in ("1500 steps", "62.5 %", "50.0 %", "25.0 %", "executor.max_plans", "Pendulum-v1"):
        assert text in html
    low, high = scoring.wilson(4, 8).low, scoring.wilson(4, 8).high
    assert f"[{100 * low:.1f}, {100 * high:.1f}] 4/8" in html


def test_the_hardest_goals_come_first_with_what_is_known_of_why(trained):
    agent = Agent.load(trained / "agent.safetensors")
    nodes = np.repeat(np.arange(agent.num_nodes), 50)
    nodes = nodes[nodes != 5]
    goals = report.hardest_goals(agent, TRIALS, nodes)
    assert [(goal.node, goal.tries, goal.done) for goal in goals] == [
        (2, 2, 0),
        (5, 1, 0),
        (1, 2, 1),
    ]
    assert "gave up: no way is known from here (1)" in goals[0].why
    assert "started where the log has not been (1)" in goals[0].why
    assert f"the log was there for 0 of {len(nodes)} steps" in goals[1].why
    assert "still on its way after 12 steps" in goals[1].why
    assert "believed to be there, and was elsewhere" in goals[2].why
    assert "missed from node 3" in goals[2].why


def test_a_goal_that_no_edge_leads_to_is_told(trained):
    agent = Agent.load(trained / "agent.safetensors")
    dense = agent.graph.toarray()
    dense[:, 5] = 0
    agent.graph = type(agent.graph)(dense)
    (goal,) = report.hardest_goals(agent, [trial(5, "gave_up", False)], np.zeros(0, np.int64))
    assert "no known edge leads to it" in goal.why


def test_missing_parts_are_left_out_and_named(trained, tmp_path):
    (tmp_path / "bare").mkdir()
    (tmp_path / "bare" / "a.safetensors").write_bytes((trained / "agent.safetensors").read_bytes())
    html = render(tmp_path / "bare")
    assert "experiments.execute --results" in html
    assert "There is no ground truth" in html
    assert "train with <code>--logdir</code>" in html


def test_execute_writes_what_the_report_reads(tmp_path, monkeypatch):
    stages = tuple(dataclasses.replace(stage, iterations=8) for stage in dot_config().stages)
    config = dataclasses.replace(dot_config(), shape=(5, 5), stages=stages)
    monkeypatch.setattr(train, "CONFIGS", {"default": lambda: config})
    from experiments import record

    run = tmp_path / "mine"
    record.main(record.Config(out=run / "log.npz", num_steps=400))
    train.main(train.Config(log=(str(run / "log.npz"),), out=run / "agent.safetensors"))
    execute.main(
        execute.Config(
            model=run / "agent.safetensors",
            log=(str(run / "log.npz"),),
            trials=3,
            limit=20,
            results=run / "results.json",
        )
    )
    written = json.loads((run / "results.json").read_text())
    assert set(written["tasks"]) == {"nodes", "places"}
    assert [set(entry) for entry in written["trials"]["nodes"]] == [set(trial(0))] * 3
    assert written["options"]["trials"] == 3
    html = render(run)
    assert "by the ground truth" in html
    assert "<td>places</td>" in html


@pytest.mark.parametrize(("content", "message"), [(None, "is no folder"), ({}, "holds no agent")])
def test_a_folder_without_a_run_is_refused(tmp_path, capsys, monkeypatch, content, message):
    if content is not None:
        (tmp_path / "run").mkdir()
    monkeypatch.setattr(sys, "argv", ["report", str(tmp_path / "run")])
    with pytest.raises(SystemExit) as end:
        cli.run(report.main, report.Config, report.__doc__)
    assert end.value.code == cli.BAD_INPUT
    assert message in capsys.readouterr().err


def test_the_page_shows_all_its_pictures_in_a_browser(run, page):
    render(run)
    page.goto((run / "report.html").as_uri())
    assert page.title() == "dot <1>"
    pictures = page.locator("img")
    assert pictures.count() == 3
    for i in range(3):
        assert pictures.nth(i).evaluate("image => image.naturalWidth") >= 40
        assert pictures.nth(i).bounding_box()["width"] >= 40
    assert page.locator("#hardest tr").nth(1).inner_text().split()[0] == "2"
    bar = page.locator("#success .bar i").first.bounding_box()
    whole = page.locator("#success .bar").first.bounding_box()
    assert bar["width"] / whole["width"] == pytest.approx(0.625, abs=0.02)
    assert page.errors == []
