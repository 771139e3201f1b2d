"""How every command starts, makes its environment, writes its files and fails."""

import contextlib
import functools
import io
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import gymnasium as gym
import tyro

from rfl_torch import Trajectory, read_logs
from rfl_torch.innate import action_bounds, env_action

Config = TypeVar("Config")

BAD_INPUT = 2
INTERRUPTED = 130
EXPECTED = (ValueError, OSError, ImportError, gym.error.Error)
"""What bad input raises. Anything else is a fault of ours and keeps its traceback."""


def run(main: Callable[[Config], None], config: type[Config], description: str | None) -> NoReturn:
    """Read the options, call `main` with them, and end the process with an exit status."""
    try:
        main(_options(config, description))
    except EXPECTED as error:
        _fail(str(error) or type(error).__name__)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    sys.exit(0)


def make_env(
    env_id: str,
    layout: str | None = None,
    kwargs: str = "{}",
    observation_keys: Sequence[str] = (),
    **more: Any,
) -> gym.Env:
    """Make the environment `env_id`, without a limit on its steps.

    Args:
        env_id: a registered id; `module:id` imports the module that registers it.
        layout: passed on as `layout=` if not None.
        kwargs: more arguments of the environment, a JSON object.
        observation_keys: of dictionary observations, those to join into one vector.
        more: arguments of `gym.make`.

    Raises:
        ValueError: if there is no such environment, or it refuses its arguments.
    """
    try:
        arguments = json.loads(kwargs)
    except json.JSONDecodeError as error:
        raise ValueError(f"--env-kwargs {kwargs!r} is no JSON ({error}).") from None
    if not isinstance(arguments, dict):
        raise ValueError(
            f'--env-kwargs {kwargs!r} is no JSON object; try \'{{"layout": "loop"}}\'.'
        )
    if layout is not None:
        arguments["layout"] = layout
    _import_sims()
    try:
        env = gym.make(env_id, disable_env_checker=True, max_episode_steps=-1, **more, **arguments)
    except (TypeError, ModuleNotFoundError, gym.error.Error) as error:
        raise ValueError(f"environment {env_id!r} can't be made: {error}") from None
    return _joined(env, observation_keys) if observation_keys else env


def _joined(env: gym.Env, keys: Sequence[str]) -> gym.Env:
    """Make dictionary observations one vector of the values of some keys."""
    space = env.observation_space
    known = sorted(space) if isinstance(space, gym.spaces.Dict) else []
    if missing := [key for key in keys if key not in known]:
        env.close()
        raise ValueError(
            f"--observation-keys names {missing}, but the environment's observations have "
            + (f"the keys {known}." if known else f"no keys: {space}; leave it out.")
        )
    return gym.wrappers.FlattenObservation(gym.wrappers.FilterObservation(env, list(keys)))


def with_action_rows(env: gym.Env) -> gym.Env:
    """Let the environment take the action rows of a log: those of a Box are its own."""
    space = env.action_space
    if not isinstance(space, gym.spaces.Discrete):
        return env
    low, high = action_bounds(space)
    return gym.wrappers.TransformAction(
        env, functools.partial(env_action, space), gym.spaces.Box(low, high)
    )


def read_all_logs(
    sources: Sequence[str | Path], observation_keys: Sequence[str] = ()
) -> list[Trajectory]:
    """Read the logs of all files and data sets."""
    return [log for source in sources for log in read_logs(source, observation_keys)]


def check_writable(path: Path) -> None:
    """Make the folder of `path`, and make sure that the file can be written before long work.

    Raises:
        OSError: if it can't.
    """
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; needs the name of a file to write.")
    path.parent.mkdir(parents=True, exist_ok=True)
    probe = path.with_name(f".probe-{os.getpid()}-{path.name}")
    probe.touch()
    probe.unlink()


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give the name of a new file that takes the place of `path` once the block is through."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(f".new-{os.getpid()}-{path.name}")
    try:
        yield new
        os.replace(new, path)
    finally:
        new.unlink(missing_ok=True)


def unfinished(path: Path) -> Path:
    """Return where a command keeps what it needs to go on with `path`, should it be killed."""
    return path.with_name(path.name + ".unfinished")


def check_count(name: str, value: int) -> None:
    """Refuse a number of things below one."""
    if value < 1:
        raise ValueError(f"{name} is {value}; needs at least 1.")


def table(header: list[str], rows: list[list[str]]) -> str:
    """Return lines of text with aligned columns: the first to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    lines = []
    for row in [header, ["-" * width for width in widths], *rows]:
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        lines.append("  ".join([row[0].ljust(widths[0]), *cells[1:]]).rstrip())
    return "\n".join(lines)


def _options(config: type[Config], description: str | None) -> Config:
    """Parse the command line; of tyro's framed complaint only the text is kept."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(config, description=description)
    except SystemExit as end:
        if not end.code:
            raise
    lines = [line.strip("│ ") for line in complaint.getvalue().splitlines()]
    words = [line for line in lines if line and line[0] not in "╭╰─"]
    text = " ".join(words).split(" Argument helptext:")[0].split(" For full helptext")[0]
    _fail(f"{text}; see --help")


def _fail(message: str) -> NoReturn:
    print("error:", " ".join(message.split()), file=sys.stderr)
    sys.exit(BAD_INPUT)


def _import_sims() -> None:
    """Register our environments; Bullet's greeting on stderr is kept from the user."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        import sims.maze
        import sims.pendulum  # noqa: F401
    finally:
        os.dup2(kept, 2)
        os.close(kept)
