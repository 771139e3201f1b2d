"""What the README shows runs as it stands, and names no file that isn't there."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_the_example_learns_and_arrives(tmp_path, monkeypatch, capsys):
    code = re.search(r"<!-- example -->\n```python\n(.*?)```", README, re.DOTALL)
    assert code is not None
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(code[1], "README.md", "exec"), names)
    names["env"].close()
    assert capsys.readouterr().out.startswith("reached")
    end = names["info"]["ground_truth"]
    assert ((end - (480, 540)) ** 2).sum() ** 0.5 < 60.0  # mm


def test_every_file_in_the_table_exists():
    named = re.findall(r"^\| `([^`]+)`", README, re.MULTILINE)
    assert len(named) > 10
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_every_command_shown_is_a_module():
    modules = set(re.findall(r"python -m (experiments\.\w+)", README))
    assert modules
    assert [m for m in modules if not (ROOT / f"{m.replace('.', '/')}.py").exists()] == []
