"""Try to make the software lose or misstate something, and count how often it did.

python -m experiments.trust resume      kill training and practice at random moments
python -m experiments.trust files       damage and forge checkpoints
python -m experiments.trust threads     learn with one thread and with several
python -m experiments.trust faults      break sensors and walls of the maze
python -m experiments.trust soak        act and practise for very long
python -m experiments.trust sizes       the smallest and the largest

Each prints a table; docs/trust.md has them all. What is counted as a failure ends the command with
status 1.
"""

import contextlib
import multiprocessing
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
import tyro
from safetensors.torch import load_file
from tqdm import tqdm

import rfl_torch
from experiments import cli, faults, practice, record, train
from rfl_torch import Agent, AgentConfig, Trajectory, footprint
from rfl_torch.checkpoint import load_checkpoint, save_checkpoint

Rng = np.random.Generator


@dataclass(frozen=True)
class Resume:
    """Kill -9 at random moments; the tensors must be those of a run never killed."""

    kills: int = 20
    """Kills of each command, spread over its runs."""
    num_steps: int = 5_000
    """Steps of the log, and of the practice."""
    seed: int = 0
    """Seed of the log and of the moments."""


@dataclass(frozen=True)
class Files:
    """Damaged and forged checkpoints: each is refused by name, or read as it was written."""

    cases: int = 1_000
    """Files of each kind."""
    seed: int = 0
    """Seed of the damage."""


@dataclass(frozen=True)
class Threads:
    """The same learning in processes with one thread and with more."""

    num_steps: int = 5_000
    """Steps of the log."""
    seed: int = 0
    """Seed of the log."""


@dataclass(frozen=True)
class Faults:
    """Faults of sensors and worlds: success in the maze beside the healthy figure."""

    num_steps: int = 10_000
    """Steps of the log, held 3 steps each."""
    tasks: int = 60
    """Tasks for each fault and log: nodes, one after the other."""
    seeds: int = 2
    """Logs, each learned from."""
    seed: int = 0
    """Seed of the first log, its goals and its faults."""


@dataclass(frozen=True)
class Soak:
    """Execution with goals that change, and practice: memory and step time must not grow."""

    num_steps: int = 1_000_000
    """Control steps of execution in a room without physics."""
    maze_steps: int = 20_000
    """Control steps of execution in the maze."""
    practice_steps: int = 100_000
    """Control steps of practice, in the room and in the maze."""
    seed: int = 0
    """Seed of everything."""


@dataclass(frozen=True)
class Sizes:
    """Logs and maps of the smallest and the largest sizes: time, memory, or the refusal."""

    num_steps: int = 1_000_000
    """Steps of the longest log."""
    side: int = 100
    """Nodes along the side of the largest grid."""


Config = (
    Annotated[Resume, tyro.conf.subcommand("resume")]
    | Annotated[Files, tyro.conf.subcommand("files")]
    | Annotated[Threads, tyro.conf.subcommand("threads")]
    | Annotated[Faults, tyro.conf.subcommand("faults")]
    | Annotated[Soak, tyro.conf.subcommand("soak")]
    | Annotated[Sizes, tyro.conf.subcommand("sizes")]
)


def main(config: Any) -> None:
    """Run one of the trials; exits with 1 if anything failed."""
    trials: dict[type, Callable[[Any], bool]] = {
        Resume: try_resume,
        Files: try_files,
        Threads: try_threads,
        Faults: try_faults,
        Soak: try_soak,
        Sizes: try_sizes,
    }
    if not trials[type(config)](config):
        sys.exit(1)


# -- resume -------------------------------------------------------------------------------------


def try_resume(config: Resume) -> bool:
    """Kill both commands; print how many kills there were, and whether the ends are the same."""
    cli.check_count("--kills", config.kills)
    rows, is_good = [], True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "log.npz"
        record.main(record.Config(log, num_steps=config.num_steps, hold=3, seed=config.seed))
        whole = train.Config((str(log),), folder / "whole.safetensors")
        rng = np.random.default_rng(config.seed)
        for run, options in (
            (_train, whole),
            (
                _practise,
                practice.Config(
                    whole.out, folder / "practised.safetensors", num_steps=config.num_steps
                ),
            ),
        ):
            kills, runs, same = kill_and_compare(run, options, config.kills, rng)
            rows.append([run.__name__.strip("_"), str(kills), str(runs), f"{same}/{runs}"])
            is_good &= same == runs
    print(cli.table(["command", "kills", "runs", "same tensors"], rows))
    return is_good


def kill_and_compare(
    run: Callable[[Any], None], options: Any, kills: int, rng: Rng, most_a_run: int = 3
) -> tuple[int, int, int]:
    """Run to the end once, then again with kills; returns kills, runs and runs that end the same.

    Args:
        run: a function of a module, called with `options` in a process of its own.
        options: with the field `out`, an agent's file.
        kills: how many.
        rng: of the moments.
        most_a_run: kills before a run is left to end.
    """
    _in_process(_nothing, None, None)  # the server of processes starts with the first
    begin = time.perf_counter()
    _in_process(run, options, None)
    seconds = time.perf_counter() - begin
    _, whole = load_checkpoint(options.out)
    done = runs = same = 0
    while done < kills:
        again = replace(options, out=options.out.with_name(f"killed-{runs}-{options.out.name}"))
        left = min(most_a_run, kills - done)
        while left and not _in_process(run, again, float(rng.uniform(0, 0.9 * seconds))):
            left -= 1
            done += 1
        if not left:
            _in_process(run, again, None)
        _, found = load_checkpoint(again.out)
        is_clean = not cli.unfinished(again.out).exists()
        same += is_clean and equal(whole, found)
        runs += 1
    return done, runs, same


def equal(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    """Whether two checkpoints have the same tensors, bit for bit."""
    return first.keys() == second.keys() and all(
        torch.equal(tensor, second[name]) and tensor.dtype == second[name].dtype
        for name, tensor in first.items()
    )


def _in_process(run: Callable[[Any], None], options: Any, seconds: float | None) -> bool:
    """Call `run` in a process that is killed after so many seconds; whether it came to its end."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["experiments.train", "experiments.practice"])
    process = context.Process(target=run, args=(options,))
    process.start()
    process.join(seconds)
    if process.is_alive():
        process.kill()
        process.join()
    if process.exitcode not in (0, -9):
        raise RuntimeError(f"a run of {run.__name__} ended with status {process.exitcode}")
    return process.exitcode == 0


def _nothing(_: None) -> None:
    pass


def _train(options: train.Config) -> None:
    with _quiet():
        train.main(options)


def _practise(options: practice.Config) -> None:
    practice.PIECE = 500
    with _quiet():
        practice.main(options)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        nowhere = stack.enter_context(open(os.devnull, "w"))
        stack.enter_context(contextlib.redirect_stdout(nowhere))
        stack.enter_context(contextlib.redirect_stderr(nowhere))
        yield


# -- files --------------------------------------------------------------------------------------


def try_files(config: Files) -> bool:
    """Damage and forge a small agent's file; print what became of each kind."""
    rng = np.random.default_rng(config.seed)
    rows, failures = [], 0
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "agent.safetensors"
        small_agent(config.seed).save(path)
        for kind, make in (("damaged", damaged), ("forged", forged)):
            counts = {"refused": 0, "read right": 0, "wrong": 0}
            for _ in tqdm(range(config.cases), desc=kind, unit="file"):
                outcome = judge(path, make(path, rng))
                counts[outcome if outcome in counts else "wrong"] += 1
                if outcome not in counts:
                    tqdm.write(f"{kind}: {outcome}", file=sys.stderr)
            rows.append([kind, str(config.cases), *map(str, counts.values())])
            failures += counts["wrong"]
    print(cli.table(["files", "number", "refused", "read right", "wrong"], rows))
    return failures == 0


class Room(gym.Env):
    """A point in the unit square that feels how far its corners are: all costs are the agent's."""

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(0.0, 1.5, (4,))
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,))
        self._place = np.full(2, 0.5)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Put the point into the middle."""
        self._place = np.full(2, 0.5)
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Move by up to 0.1."""
        self._place = np.clip(self._place + 0.1 * np.asarray(action, np.float64), 0, 1)
        return self._observe(), 0.0, False, False, {}

    def _observe(self) -> Any:
        corners = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
        return np.linalg.norm(corners - self._place, axis=1).astype(np.float32)


def small_agent(seed: int = 0) -> Agent:
    """Return an agent of a few nodes that has learned from a room of four walls."""
    log = rfl_torch.record(Room(), 600, seed=seed)
    choices = AgentConfig(shape=(5, 5))
    stages = tuple(replace(stage, iterations=12) for stage in choices.stages)
    return Agent(replace(choices, stages=stages), seed).fit(log)


def damaged(path: Path, rng: Rng) -> Path:
    """Write a copy with flipped bits, lost or doubled parts, or other bytes altogether."""
    data = bytearray(path.read_bytes())
    kind = int(rng.integers(7))
    header = 8 + int.from_bytes(data[:8], "little")
    if kind == 0:
        data = data[: int(rng.integers(len(data)))]
    elif kind in (1, 2):  # in the header, anywhere
        for _ in range(int(rng.integers(1, 4))):
            data[int(rng.integers(header if kind == 1 else len(data)))] ^= 1 << int(rng.integers(8))
    elif kind == 3:
        begin = int(rng.integers(len(data)))
        data[begin : begin + int(rng.integers(1, 500))] = rng.bytes(int(rng.integers(500)))
    elif kind == 4:
        data += rng.bytes(int(rng.integers(1, 100)))
    elif kind == 5:  # other numbers in the header
        digits = [k for k in range(header) if chr(data[k]).isdigit()]
        for k in rng.choice(digits, int(rng.integers(1, 4))):
            data[int(k)] = ord(str(int(rng.integers(10))))
    else:
        data = bytearray(rng.bytes(int(rng.integers(1000))))
    new = path.with_name("damaged.safetensors")
    new.write_bytes(data)
    return new


def forged(path: Path, rng: Rng) -> Path:
    """Write a whole file, with its digest, of tensors or choices that don't fit."""
    config, state = load_checkpoint(path)
    name = str(rng.choice(sorted(state)))
    tensor, kind = state[name].clone(), int(rng.integers(8))
    if kind == 0:
        del state[name]
    elif kind == 1:
        kinds = [torch.float64, torch.float32, torch.int64, torch.bool, torch.uint8, torch.float16]
        state[name] = tensor.to(kinds[int(rng.integers(len(kinds)))])
    elif kind == 2:
        state[name] = tensor[None] if rng.random() < 0.5 or not tensor.ndim else tensor[:-1]
    elif kind == 3:
        huge = [0, 2**50] if rng.random() < 0.5 else [2**50, 0]
        state[name] = torch.zeros(huge, dtype=tensor.dtype)
    elif kind in (4, 5) and tensor.numel():
        flat = tensor.flatten()
        index = int(rng.integers(len(flat)))
        if flat.dtype == torch.int64:
            flat[index] = int(rng.choice([-1, 10**9, 2**62]))
        elif flat.is_floating_point():
            flat[index] = float(rng.choice([np.nan, np.inf, -1e38]))
        state[name] = flat.reshape(tensor.shape)
    elif kind == 6:
        place = config["agent"]
        while isinstance(place, dict):
            key = str(rng.choice(sorted(place)))
            if not isinstance(place[key], dict):
                break
            place = place[key]
        values: list[Any] = [None, -1, 0, 10**12, np.nan, "no", [], {}, [10**6] * 2, True, 1e308]
        place[key] = values[int(rng.integers(len(values)))]
    else:
        config["seed"] = [None, "x", 2**70, -1, []][int(rng.integers(5))]
    new = path.with_name("forged.safetensors")
    save_checkpoint(new, config, state)
    return new


def judge(whole: Path, path: Path) -> str:
    """Say what became of reading a file: "refused", "read right", or what went wrong.

    Right is what has the tensors of the whole file; or, of a forged one, acts within bounds.
    """
    try:
        agent = Agent.load(path)
    except ValueError as error:
        return "refused" if path.name in str(error) else f"no name in {error}"
    except BaseException as error:  # the bindings panic with one that is no Exception
        return f"{type(error).__name__}: {error}"
    try:
        if path.name.startswith("damaged") and not equal(load_file(whole), load_file(path)):
            return "altered, and read"
        low, high = agent.actions
        executor = agent.executor(0)
        for value in (0.5, np.nan, 0.1):
            seen = np.full(len(agent.readings.low), value, np.float32)
            action = executor.act(seen)
            if not ((low <= action) & (action <= high)).all():
                return f"acts outside of its space: {action}"
            if abs(executor.belief.sum() - 1) > 1e-6:
                return f"belief sums to {executor.belief.sum()}"
    except Exception as error:
        return f"{type(error).__name__} after loading: {error}"
    return "read right"


# -- threads ------------------------------------------------------------------------------------


def try_threads(config: Threads) -> bool:
    """Learn in processes with 1, 2 and 4 threads; print the largest difference of any tensor."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "log.npz"
        record.main(record.Config(log, num_steps=config.num_steps, hold=3, seed=config.seed))
        states = {}
        for count in (1, 2, 4):
            options = train.Config((str(log),), folder / f"{count}.safetensors")
            _in_process(_TrainWith(count), options, None)
            states[count] = load_checkpoint(options.out)[1]
        for count in (2, 4):
            rows.append([f"1 and {count} threads", difference(states[1], states[count])])
    print(cli.table(["compared", "largest difference"], rows))
    return True


def difference(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> str:
    """Say how far two checkpoints' tensors are apart."""
    if equal(first, second):
        return "none: the same bits"
    shapes = [name for name in first if first[name].shape != second[name].shape]
    if shapes:
        return f"other shapes: {', '.join(shapes)}"
    apart = {
        name: float((first[name].double() - second[name].double()).abs().max())
        for name in first
        if first[name].numel()
    }
    worst = max(apart, key=lambda name: apart[name])
    return f"{apart[worst]:.2g} in {worst}"


@dataclass(frozen=True)
class _TrainWith:
    """Trains with so many threads of torch and of the compiled code."""

    count: int

    @property
    def __name__(self) -> str:
        return f"training with {self.count} threads"

    def __call__(self, options: train.Config) -> None:
        import numba

        torch.set_num_threads(self.count)
        with contextlib.suppress(ValueError):  # more than the machine has
            numba.set_num_threads(self.count)
        _train(options)


# -- faults -------------------------------------------------------------------------------------

DEAD_SHARE, OUTLIER_SHARE = 0.85, 0.95
"""Of the healthy figure, with 2 of 24 sensors dead and with 2 % of outliers."""


def try_faults(config: Faults) -> bool:
    """Drive with every fault; whether dead sensors and outliers leave as much as they must."""
    cli.check_count("--tasks", config.tasks)
    cli.check_count("--seeds", config.seeds)
    pooled: dict[str, list[faults.Tally]] = {name: [] for name in faults.FAULTS}
    with tempfile.TemporaryDirectory() as name:
        for seed in range(config.seed, config.seed + config.seeds):
            env = cli.make_env("rfl/RangefinderMaze-v0", "paper")
            log = rfl_torch.record(env, config.num_steps, hold=3, seed=seed)
            env.close()
            path = Path(name) / f"{seed}.safetensors"
            train.fit(AgentConfig(), [log], seed).save(path)
            for kind in tqdm(faults.FAULTS, desc=f"seed {seed}", unit="fault"):
                agent = Agent.load(path)  # what one fault taught it, the next must not know
                tally = faults.go(agent, log, faults.FAULTS[kind], config.tasks, seed)
                pooled[kind].append(tally)
    header = ["fault", "true", "believed, not true", "gave up", "ran out", "steps", "of healthy"]
    rows, shares = [], {}
    for kind, tallies in pooled.items():
        done = sum(tally.true for tally in tallies)
        tasks = sum(tally.reachable for tally in tallies)
        shares[kind] = done / tasks
        false, gave_up = (sum(getattr(t, x) for t in tallies) for x in ("false", "gave_up"))
        ran_out = sum(tally.tasks for tally in tallies) - done - false - gave_up
        steps = f"{np.nanmedian([tally.steps for tally in tallies]):.0f}"
        relative = f"{100 * shares[kind] / shares['healthy']:.0f} %"
        rows.append(
            [kind, f"{done}/{tasks}", *map(str, (false, gave_up, ran_out)), steps, relative]
        )
    print(cli.table(header, rows))
    dead = min(share for kind, share in shares.items() if kind.startswith("2 sensors"))
    outliers = shares["2 % of readings outliers"]
    healthy = shares["healthy"]
    return dead >= DEAD_SHARE * healthy and outliers >= OUTLIER_SHARE * healthy


# -- soak ---------------------------------------------------------------------------------------

PARTS = 10
"""Equal parts of a soak; the last ones are compared with the first but one: the first warms up."""

MOST_GROWTH = 1.1
"""Of step time, and of the memory of what learns: median of the last three parts over that of the
second to fourth."""

MOST_MEMORY = 8.0
"""MB more in the last three parts than in the second to fourth, of what doesn't learn."""


class Part(NamedTuple):
    """A part of a soak."""

    microseconds: float
    """Of the process, for a step."""
    megabytes: float
    """Resident at its end."""
    goals: int
    """Ended in the part, reached or given up."""
    worst_sum: float
    """Largest distance of the belief's sum from one."""
    num_nodes: int


def try_soak(config: Soak) -> bool:
    """Run long; print what the parts took."""
    agent = small_agent(config.seed)
    soaks = {"execution": soak_execution(Room(), agent, config.num_steps, config.seed)}
    if config.maze_steps:
        env = cli.make_env("rfl/RangefinderMaze-v0", "paper")
        log = rfl_torch.record(env, 5_000, hold=3, seed=config.seed)
        learned = train.fit(AgentConfig(), [log], config.seed)
        soaks["in the maze"] = soak_execution(env, learned, config.maze_steps, config.seed)
    soaks["practice"] = soak_practice(Room(), agent, config.practice_steps, config.seed)
    if config.maze_steps:
        parts = soak_practice(env, learned, config.practice_steps, config.seed)
        soaks["practice in the maze"] = parts
        env.close()
    header = [
        "soak",
        "us a step, early",
        "late",
        "MB, early",
        "late",
        "nodes",
        "goals",
        "belief off",
    ]
    rows, is_good = [], True
    for name, parts in soaks.items():
        (early, held), (late, holds) = (
            np.median([part[:2] for part in some], 0) for some in (parts[1:4], parts[-3:])
        )
        is_learning = name == "practice in the maze"
        most = MOST_GROWTH * held if is_learning else held + MOST_MEMORY
        worst = max(part.worst_sum for part in parts)
        is_good &= bool(late <= MOST_GROWTH * early and holds <= most) and worst < 1e-9
        memory = f"{held:.1f}", f"{holds:.1f}"
        goals = sum(part.goals for part in parts)
        nodes = f"{parts[0].num_nodes} to {parts[-1].num_nodes}"
        times = f"{early:.0f}", f"{late:.0f}"
        rows.append([name, *times, *memory, nodes, str(goals), f"{worst:.1g}"])
    print(cli.table(header, rows))
    return is_good


def soak_execution(env: Any, agent: Agent, num_steps: int, seed: int) -> list[Part]:
    """Go to one random node after the other."""
    rng = np.random.default_rng(seed)
    seen, _ = env.reset(seed=seed)
    parts = []
    low, high = agent.actions
    executor = agent.executor(0, seed=seed)
    for _ in tqdm(range(PARTS), desc="soak", unit="part"):
        begin, goals, worst = time.process_time(), 0, 0.0
        for _ in range(num_steps // PARTS):
            if executor.status != "running":
                goal = int(rng.integers(agent.num_nodes))
                executor = agent.executor(goal, seed=int(rng.integers(2**31)))
                goals += 1
            action = executor.act(seen)
            worst = max(worst, abs(float(executor.belief.sum()) - 1))
            if not ((low <= action) & (action <= high)).all():  # true for NaN as well
                raise RuntimeError(f"the action {action} is outside of {low} to {high}")
            seen, *_ = env.step(action)
        seconds = time.process_time() - begin
        each = 1e6 * seconds / (num_steps // PARTS)
        parts.append(Part(each, _resident(), goals, worst, agent.num_nodes))
    return parts


def soak_practice(env: Any, agent: Agent, num_steps: int, seed: int) -> list[Part]:
    """Practise part by part."""
    parts = []
    for index in tqdm(range(PARTS), desc="practice", unit="part"):
        begin = time.process_time()
        history = agent.practice(env, num_steps // PARTS, seed=seed + index)
        seconds = time.process_time() - begin
        worst = float((agent.hmm.transition_matrix().sum(1) - 1).detach().abs().max())
        each = 1e6 * seconds / (num_steps // PARTS)
        parts.append(Part(each, _resident(), len(history), worst, agent.num_nodes))
    return parts


def _resident() -> float:
    """Memory of the process that is in use, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


# -- sizes --------------------------------------------------------------------------------------


def try_sizes(config: Sizes) -> bool:
    """Learn from the smallest and the largest; print seconds, memory, and what was refused."""
    rows, is_foretold = [], True
    cases: list[tuple[str, tuple[int, int, int]]] = [
        ("1 node", (2_000, 1, 4)),
        ("1-step log", (1, 5, 4)),
        ("30-step log", (30, 5, 4)),
        ("1 reading", (2_000, 5, 1)),
        ("256 readings", (2_000, 5, 256)),
        (f"grid of {config.side**2} nodes", (2_000, config.side, 8)),
        (f"{config.num_steps} steps", (config.num_steps, 10, 4)),
        (f"{config.num_steps} steps, 24 readings", (config.num_steps, 10, 24)),
    ]
    runs: list[tuple[str, Callable[..., Size], tuple[int, ...]]] = [
        *((name, learn_size, sizes) for name, sizes in cases),
        (f"map of {config.side**2} nodes", keep_size, (config.side,)),
    ]
    for name, run, sizes in tqdm(runs, desc="sizes", unit="size"):
        # Each in a process of its own: the peak is the process's.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            size = pool.submit(run, *sizes).result()
        foretold = "" if size.foretold is None else f"{size.foretold:.0f}"
        is_foretold &= size.foretold is None or size.taken <= size.foretold
        rows.append([name, f"{size.seconds:.1f}", f"{size.taken:.0f}", foretold, size.outcome])
    print(cli.table(["size", "seconds", "MB taken", "at most, foretold", "outcome"], rows))
    return is_foretold


class Size(NamedTuple):
    """What learning of some size took."""

    seconds: float
    taken: float
    """MB beyond those that the process had, with the log, before."""
    foretold: float | None
    """MB at most; None where nothing is."""
    outcome: str


def learn_size(num_steps: int, side: int, obs_dim: int) -> Size:
    """Learn from a log of so many steps on a square grid, and act once."""
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (num_steps, 2)).astype(np.float32)
    place = np.abs((0.05 * np.concatenate([np.zeros((1, 2)), actions]).cumsum(0) + 0.5) % 2 - 1)
    seen = place.astype(np.float32) @ rng.uniform(0.5, 3, (2, obs_dim)).astype(np.float32)
    np.sin(seen + rng.uniform(0, 3, obs_dim).astype(np.float32), out=seen)
    ends = np.ones(2, np.float32)
    choices = AgentConfig(shape=(side, side))
    stages = tuple(replace(stage, iterations=2) for stage in choices.stages)
    log = Trajectory(seen, actions, -ends, ends)
    before, begin = _resident(), time.perf_counter()
    foretold = footprint.to_fit(num_steps, obs_dim, 2, side**2, choices.horizon) / 1e6
    try:
        agent = Agent(replace(choices, stages=stages)).fit(log)
        agent.executor(0).act(log.observations[0])
        outcome = f"{agent.num_nodes} nodes"
    except ValueError as error:
        outcome = f"refused: {str(error)[:60]}..."
    seconds = time.perf_counter() - begin
    return Size(seconds, _peak() - before, foretold, outcome)


def keep_size(side: int) -> Size:
    """Act on a map of so many nodes along each side of a square, each a place of its own."""
    before, begin = _resident(), time.perf_counter()
    line, middle = np.linspace(0, 1, 4 * side), (np.arange(side) + 0.5) / side
    ends = np.ones(2, np.float32)
    logs, nodes = [], []
    for k in range(2 * side):  # along each row and each column, to and fro
        along = np.concatenate([line, line[::-1]])
        across = middle[k // 2] + 0.4 / side * np.sin(np.arange(len(along)) * np.pi / 8)
        place = np.stack([along, across] if k % 2 else [across, along], 1)
        actions = np.diff((len(line) - 1) * place, axis=0).clip(-1, 1).astype(np.float32)
        logs.append(Trajectory(_sense(place, side), actions, -ends, ends))
        cell = (place * side).astype(int).clip(0, side - 1)
        nodes.append(cell[:, 0] * side + cell[:, 1])
    choices = AgentConfig(shape=(2, 2), repairs=False)
    stages = tuple(replace(stage, iterations=2) for stage in choices.stages)
    agent = Agent(replace(choices, stages=stages)).fit(logs[:: side // 10])
    agent.learn_from_labels(logs, nodes)
    place, goal = np.array([0.1, 0.2]), (side + 1) * (8 * side // 10)
    executor = agent.executor(goal)
    steps, started = 0, time.perf_counter()
    while executor.status == "running" and steps < 2_000:
        action = executor.act(_sense(place, side))
        place = (place + action / (4 * side - 1)).clip(0, 1)
        steps += 1
    each = 1e3 * (time.perf_counter() - started) / steps
    outcome = f"{agent.num_nodes} nodes, {executor.status} in {steps} steps of {each:.1f} ms"
    return Size(time.perf_counter() - begin, _peak() - before, None, outcome)


def _sense(place: Any, side: int) -> Any:
    """Readings (..., 6) of a place (..., 2) that differ from node to node and are unique."""
    angle = 2 * np.pi * (side / 10) * place
    return np.concatenate([place, np.sin(angle), np.cos(angle)], -1).astype(np.float32)


def _peak() -> float:
    """Most memory that the process ever had, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


if __name__ == "__main__":
    cli.run(main, Config, __doc__)  # type: ignore[arg-type]
