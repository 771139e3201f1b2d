"""Write the page of the library's public names from their docstrings.

python -m experiments.api --out docs/api.md

What `rfl_torch` exports is on the page, in that order, read from the sources by griffe2md.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import rfl_torch
from experiments import cli

INTRODUCTION = """# The library

All that `import rfl_torch` offers. This page is made from the docstrings by
`python -m experiments.api`; lengths are in the units of the environment, angles in radians, times
in control steps, log-likelihoods in nats.
"""


ALSO = ("executor.BeliefExecutor", "spaces.Readings", "spaces.Actions")
"""What users hold without naming it: `Agent.executor` makes one, agents have the others."""


@dataclass(frozen=True)
class Config:
    """Options of the page."""

    out: Path = Path("docs/api.md")
    """Page to write."""


def main(config: Config) -> None:
    """Write the page."""
    cli.check_writable(config.out)
    page = api_page()
    with cli.replacing(config.out) as new:
        new.write_text(page, encoding="utf-8")
    print(f"{config.out}: {len(rfl_torch.__all__) + len(ALSO)} names")


def api_page() -> str:
    """Return the page.

    Raises:
        ImportError: if griffe2md is not installed.
    """
    try:
        import griffe
        from griffe2md import render_object_docs
    except ImportError:
        raise ImportError("the page needs griffe2md; try pip install griffe2md.") from None
    options: dict[str, object] = {
        "docstring_style": "google",
        "line_length": 100,
        "show_signature_annotations": True,
        "members_order": "source",
        "show_if_no_docstring": False,
        "summary": False,
        "inherited_members": False,
    }
    package = griffe.load("rfl_torch", docstring_parser="google", resolve_aliases=True)
    parts = []
    for name in [*rfl_torch.__all__, *ALSO]:
        found = package[name]
        own = found.final_target if isinstance(found, griffe.Alias) else found
        parts.append(render_object_docs(own, options | {"show_root_full_path": False}))
    text = re.sub(r"`rfl_torch\.(?:\w+\.)*?([A-Z]\w+(?:\.\w+)?)`", r"`\1`", "\n".join(parts))
    text = INTRODUCTION + "\n" + text
    text = re.sub(r"\[([^\]]+)\]\(#[^)]*\)", r"\1", text)  # links to names that are elsewhere
    text = re.sub(r"</?code>", "`", text)
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"


if __name__ == "__main__":
    cli.run(main, Config, __doc__)
