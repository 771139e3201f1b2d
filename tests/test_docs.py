"""Every command and snippet of the pages in docs/ runs as written, in smaller sizes.

The blocks of a page run in order in one folder, as a reader would. Sizes are reduced by options
given again at the end of a command and by the numbers in REDUCED; all else is as printed.
"""

import functools
import importlib.util
import re
import shlex
from pathlib import Path

import pytest
import tyro
from worlds import DotWorld, dot_log

import rfl_torch
from experiments import api, reproduce, scoring, train
from rfl_torch import AgentConfig, Stage

ROOT = Path(__file__).parents[1]
PAGES = ["method", "choosing", "figures", "failures", "robot"]

SMALLER = {
    "record": ["--num-steps", "400"],
    "train": ["--side", "5"],
    "practice": ["--num-steps", "60"],
    "execute": ["--trials", "2", "--limit", "10"],
    "reproduce": ["--trials", "1", "--num-steps", "200"],
}
REDUCED = {"num_steps=10_000": "num_steps=900", "num_steps=2_000": "num_steps=60", "10.0": "1e6"}
STAGES = (
    Stage(2, 30, (0.05, 1.0), pseudo_count=0.01, min_scale=0.05),
    Stage(1, 5, min_scale=0.05),
)


class Robot:
    """What docs/robot.md asks of a robot, on a square of DotWorld."""

    def __init__(self):
        self.world = DotWorld()
        self.seen, _ = self.world.reset()

    def sense(self):
        return self.seen

    def move(self, action):
        self.seen = self.world.step(action)[0]


def small(name):
    """An agent's choices that are learned at once."""
    return AgentConfig(shape=(5, 5), stages=STAGES)


def stream():
    """Messages (time, observation, action) of two runs with a gap between them."""
    log = dot_log(400)
    for step, action in enumerate(log.actions):
        yield step * 0.1 + (60.0 if step >= 200 else 0.0), log.observations[step], action


def write_csv(path):
    log = dot_log(300)
    rows = ["obs_0,obs_1,obs_2,obs_3,act_0,act_1"]
    for seen, done in zip(log.observations, [*log.actions, ("", "")], strict=True):
        rows.append(",".join(map(str, [*seen, *done])))
    path.write_text("\n".join(rows))


def blocks(page):
    text = (ROOT / "docs" / f"{page}.md").read_text()
    return re.findall(r"^```(\w+)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


def run_command(line, monkeypatch):
    words = shlex.split(line)
    assert words[:2] == ["python", "-m"], line
    name = words[2].removeprefix("experiments.")
    module = importlib.import_module(words[2])
    if name == "live":
        if importlib.util.find_spec("nicegui") is None:  # an extra: the rest of the page must run
            tyro.cli(module.Config, args=words[3:])
            return
        nicegui = importlib.import_module("nicegui")
        monkeypatch.setattr(nicegui.ui, "run", lambda *_, **__: None)  # it would serve for ever
    arguments = words[3:] + SMALLER.get(name, [])
    module.main(tyro.cli(module.Config, args=arguments))


@pytest.fixture(autouse=True)
def small_sizes(monkeypatch):
    monkeypatch.setattr(
        train, "CONFIGS", {name: functools.partial(small, name) for name in train.CONFIGS}
    )
    monkeypatch.setattr(reproduce, "ATTRACTOR_PITCH", 60.0)
    monkeypatch.setattr(reproduce, "AGENTS", {"maze": {"default": "default"}})
    run_task = scoring.run_task

    def run_short_task(env, executor, observation, info, limit, on_step=None):
        return run_task(env, executor, observation, info, min(limit, 30), on_step)

    monkeypatch.setattr(scoring, "run_task", run_short_task)
    names = {"shape": (5, 5), "stages": STAGES}

    class Small(AgentConfig):
        """The real one, but for sizes that are not given."""

        def __new__(cls, **changes):
            return AgentConfig(**(names | changes))

        paper = staticmethod(AgentConfig.paper)

    monkeypatch.setattr(rfl_torch, "AgentConfig", Small)


@pytest.mark.parametrize("page", PAGES)
def test_every_block_of_a_page_runs(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_csv(tmp_path / "drive.csv")
    namespace = {"robot": Robot(), "stream": stream()}
    kinds = set()
    for kind, block in blocks(page):
        kinds.add(kind)
        if kind == "bash":
            for line in block.replace("\\\n", " ").splitlines():
                run_command(line, monkeypatch)
        else:
            assert kind == "python"
            for long, short in REDUCED.items():
                block = block.replace(long, short)
            exec(compile(block, f"{page}.md", "exec"), namespace)
    assert kinds
    if page == "robot":
        assert len(namespace["logs"]) == 2
        assert namespace["executor"].status in {"running", "reached", "gave_up"}
        assert capsys.readouterr().out.splitlines()


@pytest.mark.parametrize("page", [*PAGES, "api"])
def test_every_file_that_a_page_names_exists(page):
    text = (ROOT / "docs" / f"{page}.md").read_text()
    for link in re.findall(r"\]\(([^)#]+)\)", text):
        assert (ROOT / "docs" / link).exists(), link
    for module in re.findall(r"python -m (experiments\.\w+)", text):
        assert (ROOT / f"{module.replace('.', '/')}.py").exists(), module


def test_messages_that_the_failure_guide_quotes_are_in_the_sources():
    """A message that is split over lines is put together."""
    sources = "".join(path.read_text() for path in sorted(ROOT.glob("*/*.py")))
    sources = re.sub(r'"\s*\n\s*f?"', "", sources)
    table = (ROOT / "docs" / "failures.md").read_text()
    messages = re.findall(r'^\| (?:gave up: )?"([^"]+)"', table, re.MULTILINE)
    assert len(messages) > 10
    assert [message for message in messages if message not in sources] == []


def test_the_library_page_is_made_from_the_docstrings():
    pytest.importorskip("griffe2md", reason="griffe2md is not installed: pip install -e '.[dev]'")
    written = (ROOT / "docs" / "api.md").read_text()
    assert written == api.api_page(), "run python -m experiments.api"
    for name in rfl_torch.__all__:
        assert f"## `{name}`" in written


def test_the_library_page_names_what_it_needs(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "griffe2md", None)
    with pytest.raises(ImportError, match="pip install griffe2md"):
        api.main(api.Config())
