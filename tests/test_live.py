"""`experiments.live`: a robot that is driven by clicks, in a real browser."""

import dataclasses
import os
import re
import socket
import subprocess
import sys
import time
import types

import gymnasium as gym
import numpy as np
import pytest

from experiments import cli, live, record, scoring, train
from experiments.drive import Drive
from rfl_torch import Agent, AgentConfig, Stage, Trajectory

STAGES = (
    Stage(2, 80, (0.02, 1.0), pseudo_count=0.01, min_scale=0.02, tolerance=0.0),
    Stage(1, 10, pseudo_count=0.01, min_scale=0.02),
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A log of the maze and an agent that learned from it."""
    folder = tmp_path_factory.mktemp("live")
    record.main(record.Config(out=folder / "log.npz", num_steps=3000))
    log = Trajectory.load(folder / "log.npz")
    config = AgentConfig(shape=(9, 9), stages=STAGES)
    train.fit(config, [log], 0).save(folder / "maze.safetensors")
    return folder


@pytest.fixture
def drive(trained):
    with cli.make_env("rfl/RangefinderMaze-v0") as env:
        agent = Agent.load(trained / "maze.safetensors")
        yield Drive(env, agent, [Trajectory.load(trained / "log.npz")])


def far_node(drive):
    """The node furthest from the robot, among those that stand alone enough to be clicked."""
    place = np.nan_to_num(drive.place, nan=1e6)
    apart = np.linalg.norm(place[:, None] - place, axis=-1) + np.diag([np.inf] * len(place))
    away = np.linalg.norm(place - drive.truth, axis=1)
    is_fit = (apart.min(1) > 15) & np.isfinite(drive.place).all(1)
    is_fit &= scoring.largest_component(scoring.planning_graph(drive.agent))
    return int(np.where(is_fit, away, -1).argmax())


def texts(drive):
    return [event.text for event in drive.events]


def drive_until(drive, is_done, limit=2000):
    for _ in range(limit):
        drive.tick()
        if is_done():
            return
    raise AssertionError(f"{drive.status} after {limit} steps")


# -- without a page ---------------------------------------------------------------------------


def test_it_waits_goes_arrives_and_says_so(drive):
    assert drive.status == "waiting"
    start = drive.truth
    for _ in range(5):
        drive.tick()
    np.testing.assert_allclose(drive.truth, start, atol=1e-6)
    node = far_node(drive)
    drive.go_to(node)
    drive.tick()
    assert drive.path[-1] == node
    drive_until(drive, lambda: drive.status == "reached")
    assert np.linalg.norm(drive.truth - drive.place[node]) < 60.0  # mm
    assert texts(drive)[0] == f"going to node {node}"
    assert texts(drive)[-1] == f"reached node {node}"
    assert drive.path == []


def test_a_pause_holds_the_world(drive):
    drive.go_to(far_node(drive))
    drive.toggle_pause()
    before = drive.num_steps, drive.truth
    drive.tick()
    assert (drive.num_steps, drive.status) == (before[0], "paused")
    np.testing.assert_array_equal(drive.truth, before[1])
    drive.toggle_pause()
    drive.tick()
    assert drive.num_steps == before[0] + 1


def test_a_kidnapped_robot_is_elsewhere_and_still_arrives(drive):
    node = far_node(drive)
    drive.go_to(node)
    for _ in range(5):
        drive.tick()
    for _ in range(10):  # some of the places lie on its way
        before = drive.truth
        drive.kidnap()
        assert np.linalg.norm(drive.truth - before) > 1.0
        drive.go_to(node) if drive.status == "reached" else drive.tick()
    drive_until(drive, lambda: drive.status == "reached")
    assert "kidnapped" in texts(drive)
    assert any(text.startswith("re-planned") for text in texts(drive))
    assert drive.num_plans > 0


def test_a_robot_that_sees_what_the_log_never_saw_is_lost(drive):
    drive.go_to(far_node(drive))
    drive.observation = np.zeros_like(drive.observation)
    assert drive.status == "lost"


def test_practice_moves_the_robot_and_lays_the_map_out_anew(drive):
    def practice(env, num_steps, seed, progress):
        env.reset(seed=seed)
        for step in progress(range(num_steps)):
            assert drive.status == "practising"
            assert drive.practice_share == step / num_steps
            env.step(np.ones(2, np.float32))
            assert drive.executor.node >= 0

    drive.agent.practice = practice
    version, logs = drive.map_version, len(drive.logs)
    drive.go_to(3)
    drive.practise(7)
    assert drive.map_version == version + 1
    assert len(drive.logs) == logs + 1
    assert drive.logs[-1].num_steps == drive.num_steps == 7
    assert drive.status == "waiting"
    assert texts(drive)[-2] == "practising for 7 steps"


def test_practice_of_the_agent_itself_extends_the_map(drive):
    before = drive.agent.num_nodes
    drive.practise(600)  # the map grows on the way
    assert drive.agent.num_nodes >= before
    assert len(drive.place) == drive.agent.num_nodes
    assert np.isfinite(drive.place).all(1).mean() > 0.9
    live.chart_options(drive)
    drive.go_to(far_node(drive))
    drive_until(drive, lambda: drive.status == "reached")


def test_a_practice_that_fails_gives_the_robot_back(drive):
    def practice(env, num_steps, seed, progress):
        raise RuntimeError("broken")

    drive.agent.practice = practice
    with pytest.raises(RuntimeError, match="broken"):
        drive.practise(5)
    assert drive.status == "waiting"
    drive.tick()


def test_an_error_is_told_and_stops_the_robot_not_the_page(drive):
    drive.fail(RuntimeError("no answer from the motor"))
    assert drive.status == "paused"
    assert texts(drive)[-1] == "stopped: no answer from the motor"


def test_the_chart_shows_the_true_place_only_where_it_is_known(drive):
    drive.go_to(far_node(drive))
    drive.tick()
    series = {part["id"]: part["data"] for part in live.moving_series(drive)}
    np.testing.assert_allclose(series[live.TRUE], [drive.truth], atol=1e-3)
    np.testing.assert_allclose(series[live.GOAL], [drive.place[drive.goal]], atol=1e-3)
    np.testing.assert_allclose(series[live.PLAN][-1], drive.place[drive.goal], atol=1e-3)
    drive.logs = []
    drive.place_nodes()
    series = {part["id"]: part["data"] for part in live.moving_series(drive)}
    assert series[live.TRUE] == []
    assert len(series[live.BELIEVED]) == 1
    assert live.TRUE not in live.chart_options(drive)["legend"]["data"]


def test_an_ended_episode_begins_anew():
    """CartPole falls at once if it is always pushed one way."""
    executor = types.SimpleNamespace(
        act=lambda observation: np.array([0.0, 1.0]),
        status="running",
        node=0,
        path=[],
        belief=np.ones(1),
        recovering=False,
    )
    agent = types.SimpleNamespace(
        executor=lambda goal, seed: executor,
        readings=types.SimpleNamespace(normalize=lambda observation: observation),
        log_emission=lambda normal: np.zeros(1),
        least_familiar=-1.0,
        num_nodes=1,
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scoring, "node_places", lambda *_: (np.zeros((1, 2)), False))
        with cli.with_action_rows(gym.make("CartPole-v1")) as env:
            drive = Drive(env, agent, [])
            drive.goal = 0
            drive_until(drive, lambda: "the episode ended: back at the start" in texts(drive), 40)
            assert abs(drive.observation[2]) < 0.05


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rate": 0.0}, "--rate is 0"),
        ({"port": 99999}, "another --port"),
        ({"env": "rfl/TorquePendulum-v0"}, "the agent learned"),
    ],
)
def test_bad_input_is_refused(trained, change, message):
    pytest.importorskip("nicegui", reason="the extra `live` is not installed")
    config = live.Config(model=trained / "maze.safetensors", port=free_port())
    with pytest.raises(ValueError, match=message):
        live.main(dataclasses.replace(config, **change))


def test_missing_nicegui_names_the_remedy(monkeypatch, trained):
    monkeypatch.setitem(sys.modules, "nicegui", None)
    with pytest.raises(ImportError, match="pip install"):
        live.main(live.Config(model=trained / "maze.safetensors"))


# -- in a browser -----------------------------------------------------------------------------


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def server(trained):
    """The command as a user starts it, at a rate that does not bore a test; yields its address."""
    pytest.importorskip("nicegui", reason="the extra `live` is not installed")
    port = free_port()
    files = ["--model", trained / "maze.safetensors", "--log", trained / "log.npz"]
    arguments = [str(value) for value in [*files, "--port", port, "--rate", 100]]
    process = subprocess.Popen(
        [sys.executable, "-m", "experiments.live", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        # NiceGUI would take itself for a part of the test.
        env={name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")},
    )
    end = time.monotonic() + 60
    while time.monotonic() < end and process.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                break
        time.sleep(0.1)
    yield f"http://127.0.0.1:{port}/"
    process.terminate()
    printed = process.communicate(timeout=20)[0]
    assert "Traceback" not in printed, printed


def pixel(page, drive, place):
    """Where a place of the map is on the page."""
    box, inset = page.locator("#map").bounding_box(), live.INSET
    low, high = np.array(live.chart_limits(drive))
    share = (np.asarray(place) - low) / (high - low)
    width = box["width"] - inset["left"] - inset["right"]
    height = box["height"] - inset["top"] - inset["bottom"]
    x = box["x"] + inset["left"] + share[0] * width
    return x, box["y"] + inset["top"] + (1 - share[1]) * height


def wait_for(page, selector, text, timeout=30_000):
    page.locator(selector, has_text=text).wait_for(timeout=timeout)


def test_a_click_on_a_node_sends_the_robot_there(page, server, drive):
    page.goto(server)
    wait_for(page, "#status", "waiting")
    node = far_node(drive)
    page.wait_for_timeout(500)
    page.mouse.click(*pixel(page, drive, drive.place[node]))
    wait_for(page, "#going", f"node {node}")
    wait_for(page, "#status", "reached")
    assert f"It thinks it is at node {node} " in page.locator("#where").inner_text()
    # Another node, carried off on the way: it is told, and arrives all the same.
    page.get_by_role("button", name="Pause").click()
    wait_for(page, "#status", "paused")
    page.mouse.click(*pixel(page, drive, drive.place[far_from(drive, node)]))
    page.get_by_role("button", name="Kidnap").click()
    wait_for(page, "#events", "kidnapped")
    page.get_by_role("button", name="Go on").click()
    wait_for(page, "#status", "reached")
    assert len(re.findall("reached node", page.locator("#events").inner_text())) == 2
    assert page.errors == []


def far_from(drive, node):
    """Another node that can be clicked, far from this one."""
    drive.truth = drive.place[node]
    return far_node(drive)
