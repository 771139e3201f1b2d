"""The packages keep apart: the library knows no simulator, the simulators know no library."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def imported(folder):
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                yield from ((path, alias.name.split(".")[0]) for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                yield path, node.module.split(".")[0]


@pytest.mark.parametrize(
    ("folder", "forbidden"),
    [
        ("rfl_torch", {"gymnasium", "pybullet", "sims", "experiments"}),
        ("sims", {"torch", "rfl_torch", "experiments"}),
    ],
)
def test_imports_point_one_way(folder, forbidden):
    wrong = [(path.name, name) for path, name in imported(folder) if name in forbidden]
    assert wrong == []


def test_nothing_is_pickled():
    assert [path for path, name in imported("rfl_torch") if name in {"pickle", "shelve"}] == []
