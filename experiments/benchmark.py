"""Measure this engine and these agents, and others on the same data in the same run.

python -m experiments.benchmark em             one EM iteration against the other libraries
python -m experiments.benchmark em --full      up to a million steps, and the paper's schedule
python -m experiments.benchmark online         one control step, at 400 and at 10,000 nodes
python -m experiments.benchmark reach          places reached by this method and by peers
torchrun --standalone --nproc-per-node 2 -m experiments.benchmark fleet      what ranks cost

Seconds are the process's own on one core, and by the wall on several; the best of some runs. A
library that is not installed is left out with a note; `pip install rfl-torch[peers]` installs them.
"""

import importlib.util
import math
import multiprocessing
import os
import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Annotated
from unittest import mock

import gymnasium as gym
import numpy as np
import torch
import tyro

import sims
from experiments import cli
from experiments.reach import Reach, benchmark_reach
from experiments.scoring import maze_layout
from rfl_torch import Agent, AgentConfig, Trajectory, distributed, inference, learning, record
from rfl_torch.hmm import GridHMM, Statistics
from rfl_torch.planner import largest_component

NUM_STEPS, SHAPE, OBS_DIM = 10_000, (20, 20), 24
"""The job that the table's ratios stand for: the paper's maze."""

ROUNDS = 25
"""Times that what is to be compared is run in turn."""


@dataclass(frozen=True)
class Em:
    """Learning: one EM iteration, how it grows, Viterbi, and the other libraries."""

    cores: int = 1
    """Processor cores to use."""
    peer_steps: int = 2_000
    """Steps that the other libraries get; their time is linear in them, and long."""
    full: bool = False
    """Also a million steps, 10,000 nodes, and the paper's whole schedule."""
    seed: int = 0
    """Seed of the data."""


@dataclass(frozen=True)
class Online:
    """A step of the filter and `Executor.act` on maps that are laid out, and `act` in the maze."""

    cores: int = 1
    """Processor cores to use."""
    num_steps: int = 2_000
    """Control steps to time."""
    sides: tuple[int, ...] = (20, 100)
    """Sides of the square grids: 400 and 10,000 nodes."""
    maze_steps: int = 20_000
    """Steps of the log, held 3, that the maze's map is learned from."""
    seed: int = 0
    """Seed of the data."""


@dataclass(frozen=True)
class Fleet:
    """Learning by several ranks under torchrun, a core each: the constants of docs/fleet.md."""

    num_steps: int = 10_000
    """Steps of each rank's log."""
    sides: tuple[int, ...] = (20, 40)
    """Sides of the square grids."""
    seed: int = 0
    """Seed of the data."""


Config = (
    Annotated[Em, tyro.conf.subcommand("em")]
    | Annotated[Online, tyro.conf.subcommand("online")]
    | Annotated[Fleet, tyro.conf.subcommand("fleet")]
    | Annotated[Reach, tyro.conf.subcommand("reach")]
)


@dataclass(frozen=True)
class Job:
    """A model and a log to learn it from."""

    hmm: GridHMM
    observations: torch.Tensor


def main(config: Em | Online | Fleet | Reach) -> None:
    """Run one of the benchmarks on so many cores."""
    if isinstance(config, Reach):
        benchmark_reach(config)
        return
    if isinstance(config, Fleet):
        benchmark_fleet(config)
        return
    cli.check_count("cores", config.cores)
    use_cores(config.cores)
    if isinstance(config, Em):
        benchmark_em(config)
    else:
        benchmark_online(config)


def use_cores(count: int) -> None:
    """Keep the process, and every thread it starts, to so many cores."""
    global clock
    clock = time.process_time if count == 1 else time.perf_counter
    torch.set_num_threads(count)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-count:])


# -- the arrays ---------------------------------------------------------------------------------


def make_log(num_steps: int, seed: int, obs_dim: int = OBS_DIM) -> torch.Tensor:
    """Rays of a random walk in a room with an inner wall, in [0, 1], noise 0.01; (T, D)."""
    rng = np.random.default_rng(seed)
    place = _walk(num_steps, rng)
    observations = rng.standard_normal((num_steps, obs_dim))
    observations *= 0.01
    for start in range(0, num_steps, 10_000):
        observations[start : start + 10_000] += _rays(place[start : start + 10_000], obs_dim)
    return torch.from_numpy(observations)


def _walk(num_steps: int, rng: np.random.Generator) -> np.ndarray:
    """Places in the unit square, 0.02 apart, (T, 2)."""
    heading = np.cumsum(0.3 * rng.standard_normal(num_steps))
    place = np.cumsum(0.02 * np.stack([np.cos(heading), np.sin(heading)], 1), 0)
    return np.abs((place + 0.5) % 2 - 1)  # reflected at the walls


def _rays(place: np.ndarray, obs_dim: int = OBS_DIM) -> np.ndarray:
    """What is seen from places (T, 2) without noise, (T, D)."""
    angle = np.arange(obs_dim) * (2 * np.pi / obs_dim)
    return _distances(place, np.stack([np.cos(angle), np.sin(angle)], 1))


def _distances(place: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Distance along each ray to the unit square's walls or the inner one, (T, D)."""
    with np.errstate(divide="ignore"):
        to_wall = np.where(ray > 0, 1 - place[:, None], -place[:, None]) / ray
        to_inner = (0.5 - place[:, None, 0]) / ray[:, 0]
    height = place[:, None, 1] + to_inner * ray[:, 1]
    is_hit = (to_inner > 0) & (height < 0.6)
    distance = np.minimum(np.where(np.abs(ray) < 1e-12, np.inf, to_wall).min(2), 1.5)
    return np.where(is_hit, np.minimum(distance, to_inner), distance) / 1.5


def make_job(num_steps: int, shape: tuple[int, int], seed: int, obs_dim: int = OBS_DIM) -> Job:
    """The log and a model whose means are random frames of it, shrunk half-way to 0.5."""
    observations = make_log(num_steps, seed, obs_dim)
    generator = torch.Generator().manual_seed(seed)
    hmm = GridHMM(shape, obs_dim)
    frames = torch.randint(num_steps, (hmm.num_nodes,), generator=generator)
    with torch.no_grad():
        hmm.emission_mean.copy_(0.5 * observations[frames] + 0.25)
        hmm.emission_log_scale.fill_(0.5 * math.log(0.05))
    return Job(hmm, observations)


# -- clocks -------------------------------------------------------------------------------------


clock: Callable[[], float] = time.process_time
"""On one core, seconds that the machine gave to others don't count."""


def best(work: Callable[[], object], repeats: int = 5) -> float:
    """The least seconds of several runs, the first, which compiles, not counted."""
    work()
    seconds = []
    for _ in range(repeats):
        begin = clock()
        work()
        seconds.append(clock() - begin)
    return min(seconds)


def best_in_turn(works: list[Callable[[], object]], rounds: int) -> list[float]:
    """The least seconds of each, run in turn, so that a minute of a busy machine hits all alike.

    Each is run twice in a row and the second run counted: the first finds the caches full of, and
    threads still spinning from, the one before.
    """
    least = [math.inf] * len(works)
    for _ in range(rounds):
        for i, work in enumerate(works):
            work()
            least[i] = min(least[i], once(work))
    return least


def gemm_pair(num_steps: int, num_nodes: int) -> Callable[[], object]:
    """The two float32 products that no EM iteration can do without: [T, 2D] x [2D, N] and back."""
    generator = torch.Generator().manual_seed(0)
    features = torch.rand(num_steps, 2 * OBS_DIM, generator=generator)
    parameters = torch.rand(2 * OBS_DIM, num_nodes, generator=generator)
    gamma = torch.rand(num_steps, num_nodes, generator=generator)
    out, back = torch.empty_like(gamma), torch.empty_like(parameters)

    def work() -> None:
        torch.mm(features, parameters, out=out)
        torch.mm(features.T, gamma, out=back)

    return work


def iterate(job: Job) -> Callable[[], object]:
    """One EM iteration from the same parameters each time."""
    start = {name: tensor.clone() for name, tensor in job.hmm.state_dict().items()}

    def work() -> Statistics:
        with torch.no_grad():
            for name, parameter in job.hmm.named_parameters():
                parameter.copy_(start[name])
        statistics = job.hmm.e_step(job.observations)
        job.hmm.m_step(statistics)
        return statistics

    return work


# -- other libraries, one EM iteration on the same arrays ------------------------------------------


def run_hmmlearn(job: Job) -> float:
    """`GaussianHMM` with implementation="scaling", float64."""
    import logging

    from hmmlearn.hmm import GaussianHMM

    logging.getLogger("hmmlearn").setLevel(logging.CRITICAL)
    hmm = job.hmm
    model = GaussianHMM(
        hmm.num_nodes, "diag", n_iter=1, init_params="", params="stmc", implementation="scaling",
        min_covar=1e-4, covars_prior=0.0,
    )  # fmt: skip
    model.n_features = OBS_DIM
    model.startprob_ = hmm.initial_logits.detach().softmax(0).numpy()
    model.transmat_ = hmm.transition_matrix().detach().numpy()
    model.means_ = hmm.emission_mean.detach().numpy()
    model.covars_ = hmm.emission_scale.detach().numpy() ** 2
    return once(lambda: model.fit(job.observations.numpy()))


def run_dynamax(job: Job) -> float:
    """`DiagonalGaussianHMM` with jax on the CPU, float32; compiling is not counted."""
    os.environ.setdefault(
        "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    )
    import jax.numpy as jnp
    from dynamax.hidden_markov_model import DiagonalGaussianHMM
    from jax import jit

    hmm = job.hmm
    model = DiagonalGaussianHMM(hmm.num_nodes, OBS_DIM)
    params, props = model.initialize(
        initial_probs=jnp.array(hmm.initial_logits.detach().softmax(0).numpy()),
        transition_matrix=jnp.array(hmm.transition_matrix().detach().numpy()),
        emission_means=jnp.array(hmm.emission_mean.detach().numpy()),
        emission_scale_diags=jnp.array(hmm.emission_scale.detach().numpy()),
    )
    emissions = jnp.array(job.observations.numpy())[None]
    m_step_state = model.initialize_m_step_state(params, props)

    @jit
    def step(params, state):  # type: ignore[no-untyped-def]
        from jax import vmap

        statistics, _ = vmap(lambda x: model.e_step(params, x, None))(emissions)
        return model.m_step(params, props, statistics, state)

    def work() -> None:
        import jax

        jax.block_until_ready(step(params, m_step_state))

    work()
    return once(work)


def run_pomegranate(job: Job) -> float:
    """`SparseHMM` over the same edges, float32."""
    from pomegranate.distributions import Normal
    from pomegranate.hmm import SparseHMM

    hmm = job.hmm
    means, variances = hmm.emission_mean.detach().float(), hmm.emission_scale.detach().float() ** 2
    nodes = [
        Normal(mean, variance, covariance_type="diag")
        for mean, variance in zip(means, variances, strict=True)
    ]
    prob = hmm.log_transition().exp().detach()
    edges = [
        (nodes[i], nodes[int(hmm.successor[i, k])], float(prob[i, k]))
        for i, k in hmm.successor_mask.nonzero().tolist()
    ]
    start = hmm.initial_logits.detach().softmax(0).float()
    model = SparseHMM(
        nodes, edges=edges, starts=start, ends=torch.full_like(start, 1e-6), max_iter=1
    )
    data = job.observations.float()[None]

    def work() -> None:
        model.summarize(data)
        model.from_summaries()

    return once(work)


@torch.no_grad()
def run_torch_loop(job: Job) -> float:
    """A plain PyTorch loop: log-space, float32, neighbours gathered by index."""
    hmm = job.hmm
    source = torch.arange(hmm.num_nodes)[:, None].expand_as(hmm.successor)[hmm.successor_mask]
    target = hmm.successor[hmm.successor_mask]
    order = target.argsort(stable=True)
    width = hmm.successor.shape[1]
    into = torch.zeros(hmm.num_nodes, width, dtype=torch.int64)
    log_in = torch.full((hmm.num_nodes, width), -torch.inf)
    rank = torch.zeros(hmm.num_nodes, dtype=torch.int64)
    log_transition = hmm.log_transition()[hmm.successor_mask].float()
    for edge in order.tolist():
        node = int(target[edge])
        into[node, rank[node]], log_in[node, rank[node]] = source[edge], log_transition[edge]
        rank[node] += 1
    log_out = hmm.log_transition().float()
    mean, scale = hmm.emission_mean.float(), hmm.emission_scale.float()
    x = job.observations.float()

    def work() -> None:
        precision = scale**-2
        log_norm = -0.5 * (mean**2 * precision).sum(1) - scale.log().sum(1)
        log_norm -= 0.5 * OBS_DIM * math.log(2 * math.pi)
        log_b = -0.5 * x**2 @ precision.T + x @ (mean * precision).T + log_norm
        alpha = torch.empty_like(log_b)
        alpha[0] = log_b[0] - math.log(hmm.num_nodes)
        for t in range(1, len(x)):
            alpha[t] = (alpha[t - 1][into] + log_in).logsumexp(1) + log_b[t]
        log_likelihood = alpha[-1].logsumexp(0)
        beta, counts = torch.zeros(hmm.num_nodes), torch.zeros_like(log_out)
        gamma = torch.empty_like(log_b)
        gamma[-1] = alpha[-1].softmax(0)
        for t in range(len(x) - 1, 0, -1):
            onward = log_out + (log_b[t] + beta)[hmm.successor]
            counts += (alpha[t - 1][:, None] + onward - log_likelihood).exp()
            beta = onward.logsumexp(1)
            gamma[t - 1] = (alpha[t - 1] + beta).softmax(0)
        _ = gamma.T @ torch.cat([x, x**2], 1), counts / counts.sum(1, keepdim=True)

    return once(work)


PEERS: dict[str, tuple[str, Callable[[Job], float]]] = {
    "hmmlearn, scaling": ("hmmlearn", run_hmmlearn),
    "dynamax, float32": ("dynamax", run_dynamax),
    "pomegranate, SparseHMM": ("pomegranate", run_pomegranate),
    "PyTorch loop, log-space": ("torch", run_torch_loop),
}


def once(work: Callable[[], object]) -> float:
    """Seconds of a single run."""
    begin = clock()
    work()
    return clock() - begin


# -- tables -------------------------------------------------------------------------------------


def benchmark_em(config: Em) -> None:
    """Print every table of the learning benchmark."""
    cli.check_count("peer-steps", config.peer_steps)
    num_nodes = math.prod(SHAPE)
    compile_seconds = once(iterate(make_job(100, SHAPE, config.seed)))
    job, trained = (make_job(NUM_STEPS, SHAPE, config.seed) for _ in range(2))
    for _ in range(3):  # a map that has begun to form, whose posterior is narrow
        trained.hmm.m_step(trained.hmm.e_step(job.observations), min_scale=0.01)
    works = [gemm_pair(NUM_STEPS, num_nodes), iterate(job), iterate(trained)]
    gemm, first, fourth = best_in_turn(works, ROUNDS)
    print(f"T = {NUM_STEPS}, N = {num_nodes}, D = {OBS_DIM}, {config.cores} core(s)")
    print(f"first call, with compiling if nothing is cached: {compile_seconds:.2f} s\n")
    rows = [
        ["two float32 matrix products", *seconds_and_ratio(gemm, gemm)],
        ["EM iteration, first", *seconds_and_ratio(first, gemm)],
        ["EM iteration, fourth", *seconds_and_ratio(fourth, gemm)],
        ["Viterbi", *seconds_and_ratio(best(lambda: find_path(job), 3), gemm)],
        ["filter step", *seconds_and_ratio(filter_seconds(job.hmm, job.observations), gemm)],
    ]
    print(cli.table(["this engine", "seconds", "x products"], rows), "\n")
    print_peers(config)
    print_scaling(config)
    if config.full:
        print_schedule(config)


def seconds_and_ratio(seconds: float, unit: float) -> list[str]:
    """Two cells of a table."""
    return [f"{seconds:.3g}", f"{seconds / unit:.2f}"]


def find_path(job: Job) -> torch.Tensor:
    """Viterbi over the whole log."""
    return job.hmm.most_likely_path(job.observations)


def filter_seconds(hmm: GridHMM, observations: torch.Tensor) -> float:
    """Median seconds of `inference.filter_step`."""
    chain = hmm.chain()
    state, seconds = inference.start_filter(chain), []
    for observation in observations[:2_000].numpy():
        begin = time.perf_counter()
        inference.filter_step(chain, state, observation)
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds))


def print_peers(config: Em) -> None:
    """One EM iteration of every library that is installed, each in a process of its own."""
    own = best(iterate(make_job(config.peer_steps, SHAPE, config.seed)), 9)
    rows = [["rfl_torch", f"{own:.3g}", "1"]]
    for name, (package, _) in PEERS.items():
        if importlib.util.find_spec(package) is None:
            rows.append([name, "not installed", ""])
            continue
        seconds = time_peer(name, config)
        rows.append([name, f"{seconds:.3g}", f"{seconds / own:.0f}"])
    print(cli.table([f"EM iteration, T = {config.peer_steps}", "seconds", "x rfl_torch"], rows))
    print()


def time_peer(name: str, config: Em) -> float:
    """Seconds of one library's EM iteration, in a new process: some leave threads spinning."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_time_here, name, config).result()


def _time_here(name: str, config: Em) -> float:
    use_cores(config.cores)
    return PEERS[name][1](make_job(config.peer_steps, SHAPE, config.seed))


def print_scaling(config: Em) -> None:
    """Seconds an iteration by length and by nodes."""
    sizes = [(num_steps, SHAPE) for num_steps in (1_000, NUM_STEPS, 100_000)]
    sizes += [(4_000, (side, side)) for side in (10, 20, 40)]
    if config.full:
        sizes += [(1_000_000, SHAPE), (4_000, (100, 100))]
    short = [size for size in sizes if size[0] * math.prod(size[1]) <= 1e7]
    works = [iterate(make_job(*size, config.seed)) for size in short]
    least = dict(zip(short, best_in_turn(works, ROUNDS), strict=True))
    works.clear()
    rows, each = [], []
    for num_steps, shape in sizes:
        num_nodes = math.prod(shape)
        if (num_steps, shape) not in least:
            least[num_steps, shape] = best(iterate(make_job(num_steps, shape, config.seed)), 2)
        seconds = least[num_steps, shape]
        rows.append(growth(num_steps, num_nodes, OBS_DIM, seconds))
        each.append(seconds / (num_steps * num_nodes))
    for obs_dim in (8, 48):
        work = iterate(make_job(NUM_STEPS, SHAPE, config.seed, obs_dim))
        rows.append(growth(NUM_STEPS, 400, obs_dim, best(work)))
    print(cli.table(["growth", "seconds", "ns per step and node"], rows))
    middle = math.sqrt(min(each) * max(each))
    off = max(each) / middle - 1
    print(
        f"at {OBS_DIM} readings every length and size is within {100 * off:.0f} % of "
        f"{1e9 * middle:.1f} ns per step and node"
    )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"largest memory so far: {peak:.2f} GB\n")


def growth(num_steps: int, num_nodes: int, obs_dim: int, seconds: float) -> list[str]:
    """A row of the table of growth."""
    each = 1e9 * seconds / (num_steps * num_nodes)
    return [f"T = {num_steps}, N = {num_nodes}, D = {obs_dim}", f"{seconds:.3g}", f"{each:.1f}"]


def print_schedule(config: Em) -> None:
    """The paper's 200 iterations at each of four rates, none left out."""
    job = make_job(NUM_STEPS, SHAPE, config.seed)
    stages = tuple(replace(stage, tolerance=-math.inf) for stage in learning.paper_stages())
    learning.start(job.hmm, [job.observations], "equal", config.seed)
    begin = clock()
    record = learning.learn(job.hmm, [job.observations], stages)
    seconds = clock() - begin
    print(f"the paper's schedule, {len(record)} iterations: {seconds:.1f} s")


def benchmark_online(config: Online) -> None:
    """Print what a control step takes."""
    cli.check_count("num-steps", config.num_steps)
    rows = []
    for side in config.sides:
        begin = time.perf_counter()
        agent = make_agent(side, max(2_000, 4 * side**2), config.seed)
        print(f"{agent.num_nodes} nodes: set up in {time.perf_counter() - begin:.1f} s")
        for name, seconds in (
            ("filter step", filter_times(agent, config.num_steps, config.seed)),
            ("Executor.act", act_times(agent, config.num_steps, config.seed)),
        ):
            rows.append([f"{name}, N = {side**2}", *microseconds(seconds)])
    agent, seconds = maze_times(config)
    rows.append([f"the same put down anywhere, N = {agent.num_nodes}", *microseconds(seconds)])
    print(cli.table(["one control step", "median us", "99 % us"], rows))


def maze_times(config: Online) -> tuple[Agent, list[float]]:
    """The agent, and seconds of each `Executor.act` of robots that don't know where they are."""
    rng, seconds = np.random.default_rng(config.seed), []
    gym.register_envs(sims)
    with gym.make("rfl/RangefinderMaze-v0", layout="paper") as env:
        agent = Agent(AgentConfig(), config.seed).fit(
            record(env, config.maze_steps, 3, config.seed)
        )
        room = maze_layout(env)
        executor = None
        for _ in range(config.num_steps):
            if executor is None or executor.status != "running":
                place = room.random_free_position(rng)
                observation, _ = env.reset(options={"position": place})
                executor = agent.executor(int(rng.integers(agent.num_nodes)))
            begin = clock()
            action = executor.act(observation)
            seconds.append(clock() - begin)
            observation, *_ = env.step(action)
    return agent, seconds


def make_agent(side: int, num_steps: int, seed: int) -> Agent:
    """An agent whose map is known: a node at every place of a lattice over the room.

    It learns controllers and edges from a walk of `num_steps`, as it would after EM.
    """
    rng = np.random.default_rng(seed)
    place = _walk(num_steps + 1, rng)
    actions = np.diff(place, axis=0).astype(np.float32)
    bound = np.full(2, np.abs(actions).max(), np.float32)
    log = Trajectory(_see(place, rng), actions, action_low=-bound, action_high=bound)
    agent = Agent(replace(AgentConfig(), shape=(side, side), repairs=False), seed=seed)
    nodes = (np.indices((side, side)).reshape(2, -1).T + 0.5) / side

    @torch.no_grad()
    def lay_out(hmm: GridHMM, *_: object) -> list[learning.Progress]:
        hmm.emission_mean.copy_(torch.from_numpy(agent.readings.normalize(_rays(nodes))))
        hmm.emission_log_scale.fill_(math.log(math.hypot(0.01, 0.25 / side)))
        hmm.transition_logits.zero_()
        return []

    with mock.patch.object(learning, "learn", lay_out), mock.patch.object(learning, "prune"):
        return agent.fit(log)


def _see(place: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Noisy observations from places (T, 2), float32 (T, D)."""
    noise = 0.01 * rng.standard_normal((len(place), OBS_DIM))
    return (_rays(place) + noise).astype(np.float32)


def filter_times(agent: Agent, num_steps: int, seed: int) -> list[float]:
    """Seconds of each step of the filter alone."""
    chain = agent.hmm.chain()
    state, seconds = inference.start_filter(chain), []
    for observation in agent.readings.normalize(make_log(num_steps, seed).numpy()):
        begin = clock()
        inference.filter_step(chain, state, observation, 0.01)
        seconds.append(clock() - begin)
    return seconds


def act_times(agent: Agent, num_steps: int, seed: int) -> list[float]:
    """Seconds of each `Executor.act` of a point robot that drives from one node to the next."""
    rng = np.random.default_rng(seed)
    goals = np.flatnonzero(largest_component(agent.graph))
    place, seconds, reached = np.full((1, 2), 0.5), [], 0
    executor = agent.executor(int(rng.choice(goals)))
    for _ in range(num_steps):
        observation = _see(place, rng)[0]
        begin = clock()
        action = executor.act(observation)
        seconds.append(clock() - begin)
        place = np.clip(place + action, 0.01, 0.99)
        if executor.status != "running":
            reached += executor.status == "reached"
            executor = agent.executor(int(rng.choice(goals)))
    print(f"{agent.num_nodes} nodes: the robot reached {reached} goals on the way")
    return seconds


def benchmark_fleet(config: Fleet) -> None:
    """Print what an iteration costs each rank, and what the sum over the ranks adds."""
    global clock
    cli.check_count("num-steps", config.num_steps)
    clock = time.perf_counter  # a rank that waits takes time too
    torch.set_num_threads(1)
    with distributed.job() as rank:
        if hasattr(os, "sched_setaffinity"):
            cores = sorted(os.sched_getaffinity(0))
            os.sched_setaffinity(0, {cores[rank.index % len(cores)]})
        rows = [fleet_row(config, side, rank) for side in config.sides]
        nothing = best(lambda: distributed.add_up(torch.zeros(1)), 50)
    if rank.index == 0:
        header = [
            f"{rank.count} rank(s), T = {config.num_steps} each", "own s", "sum s", "both s",
            "ns per step and node", "bytes summed", "bytes per s",
        ]  # fmt: skip
        print(cli.table(header, rows))
        print(f"a sum of one number: {1e6 * nothing:.0f} us")


def fleet_row(config: Fleet, side: int, rank: distributed.Rank) -> list[str]:
    """Seconds of an iteration on a rank's own log, of the sum, and of both together."""
    job = make_job(config.num_steps, (side, side), config.seed + rank.index)
    own = iterate(job)
    vector = job.hmm.e_step(job.observations[:10]).to_vector()
    num_nodes, num_edges = job.hmm.successor.shape
    num_bytes = distributed.bytes_reduced(num_nodes, num_edges, OBS_DIM)

    def add_up() -> torch.Tensor:
        return distributed.add_up(vector)

    own_seconds, sum_seconds = best(own), best(add_up, 20)
    both_seconds = best(lambda: (own(), add_up()))
    each = 1e9 * own_seconds / (config.num_steps * side**2)
    cells = [f"{seconds:.3g}" for seconds in (own_seconds, sum_seconds, both_seconds)]
    return [
        f"N = {side**2}",
        *cells,
        f"{each:.1f}",
        str(num_bytes),
        f"{num_bytes / sum_seconds:.2g}",
    ]


def microseconds(seconds: list[float]) -> list[str]:
    """Median and 99th percentile of all but the first steps."""
    settled = 1e6 * np.array(seconds[10:])
    return [f"{np.median(settled):.0f}", f"{np.percentile(settled, 99):.0f}"]


if __name__ == "__main__":
    cli.run(main, Config, __doc__)  # type: ignore[arg-type]
