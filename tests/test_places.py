"""Places that look the same, told apart by how far the robot went between them."""

import itertools
import json
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csr_array

import sims  # noqa: F401  registers the maze
from rfl_torch import Agent, AgentConfig, Stage, Trajectory, places, record, repair
from rfl_torch.looks import find_looks, look_radius

PLAN = {
    "size": [600, 480],
    "walls": [
        [0, 180, 80, 180],
        [220, 180, 380, 180],
        [520, 180, 600, 180],
        [300, 180, 300, 480],
        [150, 360, 150, 480],
        [450, 360, 450, 480],
    ],
    "start": [150, 90],
}
"""A corridor with two bays that look the same from inside."""


class Walk(NamedTuple):
    """A log in the maze, and what it is taken apart from."""

    log: Trajectory
    look: NDArray[np.int64]
    seen: NDArray[np.float64]
    radius: float

    def parts(self, num):
        """Looks, observations and actions, as of so many logs."""
        cuts = np.linspace(0, len(self.seen), num + 1).astype(int)[1:-1]
        looks, seen = np.split(self.look, cuts), np.split(self.seen, cuts)
        actions = np.split((self.log.actions + 1) / 2, cuts)
        return looks, seen, [row[: len(look) - 1] for row, look in zip(actions, looks, strict=True)]

    def nodes(self, num=1, most=10_000):
        return np.concatenate(places.split_by_track(*self.parts(num), self.radius, most))

    def extent(self, node):
        """Largest distance [mm] between two steps of each node, along x or y."""
        return np.array(
            [np.ptp(self.log.ground_truth[node == k], 0).max() for k in np.unique(node)]
        )


def walk_in(layout, num_steps):
    with gym.make("rfl/RangefinderMaze-v0", layout=layout) as env:
        log = record(env, num_steps, hold=10, seed=0)
    low = log.observations.min(0)
    seen = ((log.observations - low) / np.ptp(log.observations, axis=0)).astype(np.float64)
    actions = [(log.actions + 1) / 2]
    radius = look_radius([seen], actions)
    (look,) = find_looks([seen], actions, radius)
    return Walk(log, look, seen, radius)


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    path = tmp_path_factory.mktemp("places") / "bays.json"
    path.write_text(json.dumps(PLAN))
    return path


@pytest.fixture(scope="module")
def walk(plan):
    return walk_in(plan, 6000)


def test_two_rooms_that_look_the_same_become_different_nodes(walk):
    assert (walk.extent(walk.look) > 250).sum() > 20  # looks that are in both bays
    assert walk.extent(walk.nodes()).max() < 120


def test_a_ring_is_one_ring_once_it_was_gone_round():
    """`loop`: two corridors that look the same, joined at both ends."""
    ring = walk_in("loop", 8000)
    node = ring.nodes()
    assert (ring.extent(ring.look) > 200).any()
    assert ring.extent(node).max() < 150  # between the corridors there are 175 mm and more
    truth = ring.log.ground_truth
    angle = np.unwrap(np.arctan2(truth[:, 1] - 200, truth[:, 0] - 400))
    assert np.ptp(angle) > 2 * np.pi
    assert len(np.unique(node)) < 1.6 * len(np.unique(ring.look))


def test_shifts_are_what_was_moved_and_not_what_was_asked_for(walk):
    (shift,) = places.find_shifts(*walk.parts(1), walk.radius)
    moved = np.diff(walk.log.ground_truth, axis=0) / 10.0
    was_stopped = (np.abs(moved - walk.log.actions) > 0.01).any(1)
    assert was_stopped.mean() > 0.1
    error = np.linalg.norm(shift - moved, axis=1)
    asked = np.linalg.norm(walk.log.actions - moved, axis=1)
    assert np.median(error[was_stopped]) < 0.2 * np.median(asked[was_stopped])
    drift = (
        np.linalg.norm((shift - moved).sum(0)),
        np.linalg.norm((walk.log.actions - moved).sum(0)),
    )
    assert drift[0] < 10 < 30 < drift[1]


def test_logs_that_begin_anywhere_are_laid_on_one_another(walk):
    node = walk.nodes(3)
    assert walk.extent(node).max() < 120
    assert len(np.unique(node)) < 1.1 * len(np.unique(walk.nodes()))


def test_a_track_that_never_comes_back_is_not_believed():
    """Of a robot that goes round and round one way: each time around is farther on."""
    rng = np.random.default_rng(0)
    action = 0.5 + 0.5 * rng.random((2999, 1))
    angle = np.concatenate([[0.0], (0.1 * (2 * action[:, 0] - 1)).cumsum()])
    look = np.floor(angle % (2 * np.pi) / (2 * np.pi) * 20).astype(np.int64)
    seen = np.stack([np.cos(angle), np.sin(angle)], 1)
    log = ([look], [seen], [action])
    (node,) = places.split_by_track(*log, radius=0.2, most=10_000)
    assert len(np.unique(node)) > 300
    assert places.split_by_track(*log, radius=0.2, most=40) is None


def test_relaxed_tracks_are_the_least_squares():
    """By a dense solver; two logs share places."""
    rng = np.random.default_rng(1)
    nodes = [rng.integers(4, size=12), rng.integers(4, size=9)]
    shifts = [rng.standard_normal((11, 2)), rng.standard_normal((8, 2))]
    tracks = [rng.standard_normal((12, 2)), rng.standard_normal((9, 2))]
    rows, right = [], []
    for begin, node, shift, track in (
        (0, nodes[0], shifts[0], tracks[0]),
        (12, *(nodes[1], shifts[1], tracks[1])),
    ):
        for t in range(len(node)):
            row = np.zeros(25)
            row[begin + t], row[21 + node[t]] = 1, -1
            rows.append(row / places.PLACE_WIDTH)
            right.append(np.zeros(2))
            loose = np.zeros(25)
            loose[begin + t] = np.sqrt(places.LOOSE)
            rows.append(loose)
            right.append(np.sqrt(places.LOOSE) * track[t])
            if t > 0:
                row = np.zeros(25)
                row[begin + t], row[begin + t - 1] = 1, -1
                rows.append(row / places.SHIFT_ERROR)
                right.append(shift[t - 1] / places.SHIFT_ERROR)
    expected = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    found = np.concatenate(places.relax(nodes, shifts, tracks))
    np.testing.assert_allclose(found, expected[:21], atol=1e-5)


def test_twins_look_the_same_and_are_not_near_each_other():
    """A chain 0-9 whose ends 0-2 and 7-9 look the same; 4 and 5 do too, side by side."""
    mean = np.array([0, 1, 2, 3, 4, 4, 6, 2, 1, 0], np.float64)[:, None]
    scale = np.full((10, 1), 0.01)
    edges = csr_array(np.diag(np.ones(9), 1))
    twins = places.find_twins(mean, scale, 1.0, edges)
    assert np.argwhere(np.triu(twins.toarray())).tolist() == [[0, 9], [1, 8], [2, 7]]
    near = places.within(edges, 2).toarray()
    assert near.tolist() == (np.abs(np.subtract.outer(range(10), range(10))) <= 2).tolist()


def test_a_robot_can_tell_where_it_is_between_rooms_that_look_the_same_not_deep_in_one():
    edges = csr_array(np.diag(np.ones(29), 1))
    twins = np.zeros((30, 30), bool)
    twins[3, 20] = twins[20, 3] = True  # 0-1 and 22-29 may be in the other room too
    assert places.find_telling(csr_array(twins), edges).tolist() == list(range(7, 17))
    twins[26, 9] = twins[9, 26] = True
    assert places.find_telling(csr_array(twins), edges).tolist() == [
        13,
        14,
        15,
        16,
    ]  # no two of a pair


def test_a_robot_that_passes_no_rooms_can_tell_where_it_is_in_the_larger_part_away_from_twins():
    edges = csr_array(np.diag(np.ones(29), 1))
    twins = np.zeros((30, 30), bool)
    twins[3, 4] = twins[4, 3] = True  # two of one room
    assert places.find_telling(csr_array(twins), edges).tolist() == list(range(8, 30))
    none = csr_array((30, 30), dtype=bool)
    assert places.find_telling(none, edges).tolist() == list(range(30))


def test_of_several_twins_the_most_alike_one_is_matched():
    """Two corridors 0-3 and 10-13, a step of 1 from node to node; all look alike in pairs."""
    mean = np.array([0, 1, 2, 3, 50, 51, 52, 53, 54, 55, 0.1, 1.1, 2.1, 3.1])[:, None]
    scale = np.full((14, 1), 1.0)
    edges = csr_array(np.diag(np.ones(13), 1))
    twins = places.find_twins(mean, scale, 1.0, edges)
    assert twins.toarray()[0].sum() > 1
    matched = places.match_twins(twins, mean, scale, edges).toarray()
    assert (matched == matched.T).all()
    assert np.argwhere(np.triu(matched)).tolist() == [[k, k + 10] for k in range(4)]


def test_tied_twins_have_one_emission_and_the_same_ways_on():
    rng = np.random.default_rng(2)
    path = np.array([0, 1, 2, 1, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 8, 9, 9])
    look = np.where(path >= 7, 9 - path, path)
    seen = look[:, None] + 0.1 * rng.standard_normal((len(path), 3))
    counts = repair.Counts.of([path], [seen], 10)
    tied = repair.tie(counts, power=1.0, min_scale=0.1)
    for own, twin in ((0, 9), (1, 8), (2, 7)):
        mean = tied.first / tied.weight
        np.testing.assert_allclose(mean[own], mean[twin])
        np.testing.assert_allclose(mean[own], seen[look == own].mean(0))
        assert tied.edges[own, own] == tied.edges[twin, twin]
    assert tied.edges[9, 8] == counts.edges[9, 8] + counts.edges[0, 1]
    np.testing.assert_array_equal(tied.first[4:6], counts.first[4:6])


def test_a_robot_put_into_one_of_two_rooms_goes_to_see_which_it_is(plan, walk):
    """Started in one bay and sent to the same or another place in either."""
    stages = (Stage(3, 60, (0.01, 1.0), pseudo_count=0.01, min_scale=0.05, tolerance=0.0),)
    agent = Agent(AgentConfig(shape=(12, 12), stages=stages)).fit(walk.log)
    path = agent.recognize(walk.log.observations)
    truth = walk.log.ground_truth
    place = np.array([truth[path == k].mean(0) for k in range(agent.num_nodes)])
    assert 0 < len(agent.telling) < agent.num_nodes
    bays = [(60.0, 400.0), (360.0, 400.0)]
    reached = 0
    with gym.make("rfl/RangefinderMaze-v0", layout=plan) as env:
        for seed, (start, end) in enumerate(itertools.product(bays, bays)):
            goal = int(np.linalg.norm(place - end, axis=1).argmin())
            agent.last_seen = None
            observation, info = env.reset(options={"position": start})
            executor = agent.executor(goal, seed=seed)
            for _ in range(800):
                action = executor.act(observation)
                if executor.status != "running":
                    break
                observation, _, _, _, info = env.step(action)
            assert executor.status != "reached" or executor.node == goal
            away = np.linalg.norm(info["ground_truth"] - place[goal])
            reached += executor.status == "reached" and bool(away < 44)
    assert reached == 4
