"""`experiments.scoring` against scipy and hand-made maps: nobody gets credit that is not due."""

import dataclasses
import math
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from scipy.sparse import csr_array
from scipy.stats import binomtest
from worlds import dot_config, dot_log

from experiments import scoring
from experiments.scoring import MAZE, PENDULUM, NodeTable, Outcome, Task, Trial
from rfl_torch import Agent, Trajectory
from sims.layouts import load_layout


class Line:
    """A robot on a line: moves by its action, tells where it is unless asked not to."""

    unwrapped = SimpleNamespace()
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, is_told=True):
        self.is_told, self.position = is_told, 0.0

    def reset(self, *, seed=None, options=None):
        self.position = float((options or {}).get("position", (0.0, 0.0))[0])
        return self._observe()

    def step(self, action):
        self.position += 10.0 * float(action[0])
        observation, info = self._observe()
        return observation, 0.0, False, False, info

    def _observe(self):
        truth = {"ground_truth": np.array([self.position, 0.0])} if self.is_told else {}
        return np.array([self.position], np.float32), truth


class Says:
    """An executor that moves right, and says `status` at decision `after`."""

    def __init__(self, status="reached", after=3):
        self.goal, self.status, self.node, self.path = 0, "running", 0, []
        self._says, self._left, self.reason = status, after, ""

    def act(self, observation):
        self._left -= 1
        if self._left == 0:
            self.status = self._says
        return np.ones(1, np.float32)


def agent_saying(status, after=3):
    return SimpleNamespace(
        executor=lambda goal, seed: Says(status, after),
        readings=SimpleNamespace(normalize=lambda observation: observation),
        log_emission=lambda normal: np.zeros(1),
        least_familiar=-1.0,
    )


def trial(status, is_true, num_steps=5):
    outcome = Outcome(status, num_steps, None, np.zeros(1, np.int64), [], np.zeros(1), {})
    return Trial(0, None, outcome, is_true)


# -- shares -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("successes", "trials"), [(0, 7), (7, 7), (1, 2), (108, 118), (3, 1000), (1, 1)]
)
def test_wilson_interval_is_that_of_scipy(successes, trials):
    share = scoring.wilson(successes, trials)
    expected = binomtest(successes, trials).proportion_ci(method="wilson")
    assert share.share == pytest.approx(successes / trials, abs=1e-15)
    assert share.low == pytest.approx(expected.low, abs=1e-12)
    assert share.high == pytest.approx(expected.high, abs=1e-12)


def test_share_is_printed_as_in_the_paper():
    assert str(scoring.wilson(108, 118)) == "108/118 91.5 % [85.1, 95.3]"


@pytest.mark.parametrize(("successes", "trials"), [(1, 0), (3, 2), (-1, 2)])
def test_impossible_shares_are_refused(successes, trials):
    with pytest.raises(ValueError, match="successes"):
        scoring.wilson(successes, trials)


def test_score_counts_and_takes_medians_of_what_was_done():
    trials = [
        trial("reached", True, 10),
        trial("reached", True, 30),
        trial("reached", False, 500),
        trial("gave_up", False, 600),
        trial("running", False, 800),
    ]
    score = scoring.score(trials)
    assert (score.believed.successes, score.true.successes, score.gave_up) == (3, 2, 1)
    assert score.median_steps == 20
    assert math.isnan(score.median_detour)
    assert score.to_json()["median_detour"] is None


def test_unknown_ground_truth_leaves_only_belief():
    score = scoring.score([trial("reached", None, 10), trial("gave_up", None, 20)])
    assert score.true is None
    assert score.to_json()["true"] is None
    assert (score.believed.successes, score.median_steps) == (1, 10)


# -- the table of nodes -----------------------------------------------------------------------


def test_table_holds_means_deviations_and_counts():
    truth = np.array([[0.0, 0.0], [10.0, 0.0], [5.0, 7.0]])
    table = scoring.table_of(np.array([0, 0, 2]), truth, 4, MAZE)
    np.testing.assert_allclose(table.mean[[0, 2]], [[5, 0], [5, 7]], atol=1e-12)
    np.testing.assert_allclose(table.spread[[0, 2]], [5, 0], atol=1e-12)
    assert np.isnan(table.mean[[1, 3]]).all()
    assert table.num_steps.tolist() == [2, 0, 1, 0]


def test_angles_are_averaged_on_the_circle():
    truth = np.array([[math.pi - 0.1, 1.0], [-math.pi + 0.3, 3.0]])
    table = scoring.table_of(np.zeros(2, np.int64), truth, 1, PENDULUM)
    assert math.remainder(table.mean[0, 0] - (math.pi + 0.1), 2 * math.pi) == pytest.approx(0)
    assert table.mean[0, 1] == pytest.approx(2.0)
    np.testing.assert_allclose(table.deviation[0], [0.2, 1.0], atol=1e-12)


def test_pendulum_tolerance_is_a_box_around_the_state_that_wraps():
    upright = np.array([math.pi, 0.0])
    assert PENDULUM.distance([-math.pi + 0.29, -0.99], upright) <= 1
    assert PENDULUM.distance([-math.pi + 0.31, 0.0], upright) > 1
    assert PENDULUM.distance([math.pi, 1.01], upright) > 1


def test_maze_tolerance_is_a_disc():
    assert MAZE.distance([31.0, 31.0], [0, 0]) <= 1
    assert MAZE.distance([32.0, 32.0], [0, 0]) > 1


def test_unknown_place_is_never_near():
    assert not MAZE.distance([0.0, 0.0], [np.nan, np.nan]) <= 1


# -- the map ----------------------------------------------------------------------------------


def hand_made(spread, num_steps):
    deviation = np.stack([np.asarray(spread, float), np.zeros(len(spread))], 1)
    return NodeTable(np.zeros((len(spread), 2)), deviation, np.asarray(num_steps))


def test_wormholes_are_weighed_by_steps():
    assert scoring.wormhole_share(hand_made([10, 61, 60], [70, 20, 10])) == pytest.approx(0.2)


def test_map_scores_of_a_hand_made_map():
    graph = csr_array(np.array([[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 1], [0, 0, 0, 0]]))
    agent = SimpleNamespace(
        num_nodes=4, graph=graph, config=SimpleNamespace(executor=SimpleNamespace(recognition="x"))
    )
    scores = scoring.map_scores(agent, hand_made([0, 10, 20, 300], [30, 30, 30, 10]), MAZE)
    assert scores["strongly_connected_share"] == 0.75
    assert scores["kept_nodes"] == 4
    assert scores["median_spread_mm"] == pytest.approx(15)
    assert scores["rms_spread_mm"] == pytest.approx(math.sqrt(0.3 * 500 + 0.1 * 90000))
    assert scores["wormhole_share"] == pytest.approx(0.1)


def test_paper_map_is_connected_by_probable_transitions():
    transition = np.array([[0.995, 0.005, 0], [0, 0.5, 0.5], [0, 0.5, 0.5]])
    agent = SimpleNamespace(
        hmm=SimpleNamespace(transition_matrix=lambda: torch_like(transition)),
        config=SimpleNamespace(executor=SimpleNamespace(recognition="path", epsilon=0.01)),
    )
    edges = np.stack(scoring.planning_graph(agent).nonzero(), 1).tolist()
    assert sorted(edges) == [[1, 2], [2, 1]]


def torch_like(array):
    return SimpleNamespace(detach=lambda: SimpleNamespace(numpy=lambda: array))


def test_coverage_counts_free_cells_only():
    layout = load_layout("paper")
    cells = layout.free_cells(scoring.NODE_SPACING)
    table = NodeTable(cells[:1], np.zeros((1, 2)), np.ones(1, np.int64))
    share = scoring.coverage(layout, cells[: len(cells) // 2], table)
    assert share["coverage_log"] == pytest.approx((len(cells) // 2) / len(cells))
    near = np.hypot(*(cells - cells[0]).T) <= scoring.NODE_SPACING
    assert share["coverage_nodes"] == pytest.approx(near.mean())
    everywhere = NodeTable(cells, np.zeros_like(cells), np.ones(len(cells), np.int64))
    whole = scoring.coverage(layout, cells + 5.0, everywhere)
    assert whole == {"coverage_log": 1.0, "coverage_nodes": 1.0}


def test_velocity_r2_is_one_for_velocity_nodes_and_zero_for_one_node():
    rng = np.random.default_rng(0)
    nodes = rng.integers(0, 3, 300)
    truth = np.stack([rng.uniform(-3, 3, 300), nodes - 1.0], 1)
    table = scoring.table_of(nodes, truth, 4, PENDULUM)
    assert scoring.velocity_r2(table, nodes, truth) == pytest.approx(1.0)
    single = scoring.table_of(np.zeros(300, np.int64), truth, 1, PENDULUM)
    assert scoring.velocity_r2(single, np.zeros(300, np.int64), truth) == pytest.approx(0.0)
    unseen = np.full(300, 3)  # recognised in a fresh log, never in the training log
    assert scoring.velocity_r2(table, unseen, truth) == pytest.approx(0.0)


def test_logs_without_ground_truth_are_refused():
    with pytest.raises(ValueError, match="no ground_truth"):
        scoring.ground_truth([SimpleNamespace(ground_truth=None)])


# -- tasks ------------------------------------------------------------------------------------


def test_task_ends_when_the_executor_says_so():
    env = Line()
    outcome = scoring.run_task(env, Says("reached", after=3), *env.reset(), limit=800)
    assert (outcome.status, outcome.num_steps) == ("reached", 2)
    np.testing.assert_allclose(outcome.trace[:, 0], [0, 10, 20])
    assert outcome.path_length == pytest.approx(20.0)
    assert len(outcome.nodes) == 3


def test_task_ends_at_the_limit_and_its_last_step_is_still_judged():
    env = Line()
    outcome = scoring.run_task(env, Says("reached", after=99), *env.reset(), limit=7)
    assert (outcome.status, outcome.num_steps, env.position) == ("running", 7, 70)
    outcome = scoring.run_task(env, Says("reached", after=8), *env.reset(), limit=7)
    assert (outcome.status, outcome.num_steps) == ("reached", 7)


@pytest.mark.parametrize(
    ("status", "target", "expected"),
    [
        ("reached", 20.0, True),
        ("reached", 64.0, True),
        ("reached", 65.0, False),  # it lies
        ("reached", np.nan, False),  # a node that the log never showed
        ("gave_up", 20.0, False),  # there, but does not know
        ("running", 20.0, False),
    ],
)
def test_true_needs_both_belief_and_truth(status, target, expected):
    tasks = [Task(0, np.array([target, 0.0]))]
    trials = list(scoring.run_tasks(Line(), agent_saying(status), tasks, MAZE, None, 0, limit=2))
    assert trials[0].is_true is expected
    score = scoring.score(trials)
    assert score.true.successes == int(expected)
    assert score.true.successes <= score.believed.successes


def test_liar_scores_nothing():
    tasks = [Task(0, np.array([500.0, 0.0]), start=np.zeros(2))] * 9
    score = scoring.score(
        list(scoring.run_tasks(Line(), agent_saying("reached"), tasks, MAZE, None, 0))
    )
    assert (score.believed.successes, score.true.successes) == (9, 0)


def test_places_have_a_tolerance_of_their_own():
    wide = scoring.PLACE_TOLERANCE / scoring.NODE_SPACING
    for target, expected in ((79.0, True), (81.0, False)):
        tasks = [Task(0, np.array([target, 0.0]), tolerance=wide)]
        (done,) = scoring.run_tasks(Line(), agent_saying("reached"), tasks, MAZE, None, 0)
        assert done.is_true is expected


def test_chained_tasks_start_where_the_last_one_ended():
    tasks = [Task(0, np.zeros(2))] * 3
    start = np.array([100.0, 0.0])
    trials = list(scoring.run_tasks(Line(), agent_saying("reached"), tasks, MAZE, start, 0))
    assert [t.outcome.trace[0, 0] for t in trials] == [100, 120, 140]


def test_independent_tasks_start_at_their_own_place():
    tasks = [Task(0, np.zeros(2), start=np.array([x, 0.0])) for x in (70.0, 30.0)]
    trials = list(scoring.run_tasks(Line(), agent_saying("reached"), tasks, MAZE, None, 0))
    assert [t.outcome.trace[0, 0] for t in trials] == [70, 30]


@pytest.mark.parametrize(("mean", "width"), [(20.04, 0.01), (20.19, 0.2)])
def test_world_without_ground_truth_is_judged_by_the_last_observation(mean, width):
    """The robot is at 20 after each task's two actions; a node's width is near, 0.05 at least."""
    agent = agent_saying("reached")
    agent.hmm = SimpleNamespace(emission_mean=torch.tensor([[mean]]))
    agent.node_width = lambda nodes: np.full(len(nodes), width)
    tasks = [Task(0, None)] * 2
    trials = list(scoring.run_tasks(Line(is_told=False), agent, tasks, None, None, 0))
    assert [t.outcome.observation.item() for t in trials] == [20.0, 40.0]
    assert [t.is_true for t in trials] == [True, False]
    assert math.isnan(trials[0].outcome.path_length)


def test_random_walk_finds_near_goals_and_not_far_ones():
    tasks = [Task(0, np.array([x, 0.0]), start=np.zeros(2)) for x in (40.0, 70.0, 1e5)]
    trials = list(scoring.run_tasks(Line(), agent_saying("reached"), tasks, MAZE, None, 0))
    share = scoring.random_walk_share(Line(), trials, tasks, MAZE, seed=0)
    assert share == pytest.approx(2 / 3)


def test_node_goals_are_drawn_from_the_given_nodes_with_their_places():
    table = NodeTable(np.arange(20.0).reshape(10, 2), np.zeros((10, 2)), np.ones(10, np.int64))
    nodes = np.array([2, 5, 7])
    tasks = scoring.node_tasks(nodes, table, 60, np.random.default_rng(0))
    assert {task.goal for task in tasks} == set(nodes.tolist())
    assert all((task.target == table.mean[task.goal]).all() for task in tasks)


def test_place_goals_show_what_the_robot_sees_there():
    import sims.maze

    with sims.maze.RangefinderMazeEnv() as env:
        tasks = scoring.place_tasks(env, 5, np.random.default_rng(0))
        for task in tasks:
            assert env.layout.is_free(task.target)
            seen, _ = env.reset(options={"position": tuple(task.target)})
            np.testing.assert_array_equal(seen, task.goal)
        starts = [
            t.start for t in scoring.from_anywhere(tasks, env, None, np.random.default_rng(1))
        ]
        assert all(env.layout.is_free(start) for start in starts)


def test_detour_is_known_between_free_places_only():
    layout = load_layout("paper")
    rng = np.random.default_rng(0)
    a, b = (np.array(layout.random_free_position(rng)) for _ in range(2))
    trace = np.stack([a, a + 1000.0, a])
    outcome = Outcome("reached", 2, trace, np.zeros(3, np.int64), [], np.zeros(1), {})
    shortest = layout.shortest_path_length(a, b)
    detour = scoring.detour(Trial(0, b, outcome, True), layout)
    assert detour == pytest.approx(2000 * math.sqrt(2) / shortest)
    for target in (np.zeros(2), np.full(2, np.nan), a + 1.0, None):
        assert math.isnan(scoring.detour(Trial(0, target, outcome, True), layout))


def test_forecasts_of_a_models_own_samples_are_as_sure_as_right():
    agent = Agent(dot_config(repairs=False)).fit(dot_log(1500, seed=4))
    generator = torch.Generator().manual_seed(0)
    drawn = agent.hmm.sample(3000, generator).observations.numpy()
    raw = drawn * agent.readings.scale + agent.readings.low
    log = Trajectory(raw.astype(np.float32), np.zeros((2999, 2), np.float32))
    agent.chain = agent.hmm.chain()
    ranks = scoring.forecast_ranks(agent, log, (1, 10), 1000, np.random.default_rng(1))
    nominal = np.linspace(0.1, 0.9, 9)
    for steps in (1, 10):
        np.testing.assert_allclose(scoring.held_shares(ranks[steps], nominal), nominal, atol=0.03)
    agent.hmm.emission_log_scale.data += 0.7  # twice as unsure as right
    wide = scoring.forecast_ranks(agent, log, (1,), 1000, np.random.default_rng(1))[1]
    assert (scoring.held_shares(wide, nominal) > nominal + 0.03).mean() > 0.7


def test_the_longest_stay_counts_unbroken_steps_near_the_target():
    class Line:
        def __init__(self, truths):
            self._truths = iter(truths)

        def step(self, action):
            truth = np.array([next(self._truths), 0.0])
            return truth, 0.0, False, False, {"ground_truth": truth}

    class Still:
        def act(self, observation):
            return np.zeros(1)

    world = dataclasses.replace(PENDULUM, limit=7)
    task = Task(0, np.array([np.pi, 0.0]))
    outcome = Outcome("reached", 0, None, np.zeros(0, np.int64), [], np.zeros(1), {})
    env = Line([3.1, -3.1, 0.0, 3.0, 3.2, 3.3, 0.0])
    assert scoring.longest_stay(env, Still(), outcome, task, world) == 3
