import functools

import gymnasium as gym
import numpy as np
import pytest

import sims  # noqa: F401  registers the maze
from rfl_torch import Agent, AgentConfig, record
from rfl_torch.checkpoint import load_checkpoint, save_checkpoint
from rfl_torch.contact import Contact
from rfl_torch.explorer import BLIND, FINE, WIDE, Cells, Explorer
from rfl_torch.free_ways import LONGEST, FreeWays, ways
from rfl_torch.places import NEAR, NODE_STEPS, within


@functools.cache
def learned():
    """A log of 6,000 steps in the paper's maze, and what was learned from it."""
    with gym.make("rfl/RangefinderMaze-v0", layout="paper") as env:
        log = record(env, 6000, hold=3, seed=0)
    return log, Agent(AgentConfig(), 0).fit(log)


NOTHING_FELT = Contact.unknown(2, 8)

BOUNDS = (np.full(2, -1.0, np.float32), np.ones(2, np.float32))


class Hook:
    """A room shaped like a C, two arms of 60 x 20 full actions; a robot that sees 8 free ways."""

    PARTS = (((0, 0), (60, 20)), ((0, 0), (20, 60)), ((0, 40), (60, 60)))

    def __init__(self, position, noise=0.0):
        self.position, self._noise = np.array(position, np.float64), noise
        self._rng = np.random.default_rng(0)

    def is_free(self, points):
        inside = [((points >= low) & (points <= high)).all(-1) for low, high in self.PARTS]
        return np.any(inside, 0)

    def see(self):
        reach = np.arange(0, LONGEST, 0.25)
        free = self.is_free(self.position + ways(2)[:, None] * reach[:, None])
        length = np.where(free.all(1), LONGEST, reach[free.argmin(1)]) / LONGEST
        return length * (1 + self._noise * self._rng.uniform(-1, 1, length.shape))

    def do(self, action):
        for axis in range(2):  # as far as there is room
            for share in (1.0, 0.5, 0.25, 0.0):
                there = self.position.copy()
                there[axis] += share * action[axis]
                if self.is_free(there):
                    self.position = there
                    break


def explorer(still=0.0, gap=WIDE):
    sees_all = FreeWays(np.concatenate([LONGEST * np.eye(8), np.zeros((1, 8))]), still)
    radius = 2 * 0.6 / LONGEST  # an action changes six ways of eight
    return Explorer(*BOUNDS, radius, sees_all, NOTHING_FELT, 0, gap)


@pytest.mark.parametrize(("noise", "still"), [(0.0, 0.0), (0.05, 0.01)])
def test_an_explorer_goes_from_one_end_of_a_room_to_the_other(noise, still):
    room, search = Hook((55, 10), noise), explorer(still)
    num_steps = 0
    while np.linalg.norm(room.position - (55, 50)) > 8 and num_steps < 400:
        room.do(search.act(room.see()))
        num_steps += 1
    assert num_steps < 320  # 140 by the shortest way


def test_an_explorer_knows_where_it_is_though_walls_stood_in_its_way():
    room, search = Hook((30, 10)), explorer()
    for _ in range(200):
        room.do(search.act(room.see()))
    search.act(room.see())
    rest = np.array([30, 10]) + search.position - room.position
    assert np.abs(rest).max() < 5  # a part of an action a wall


def test_an_explorer_knows_where_it_is_after_steps_that_another_chose():
    room, search, rng = Hook((30, 10)), explorer(), np.random.default_rng(0)
    for step in range(200):
        if step % 40 < 20:
            room.do(search.act(room.see()))
        else:
            action = np.zeros(2)
            action[step // 2 % 2] = rng.choice([-1.0, 1.0])
            search.watch(room.see(), action)
            room.do(action)
    search.act(room.see())
    rest = np.array([30, 10]) + search.position - room.position
    assert np.abs(rest).max() < 5


def test_readings_far_beyond_those_of_the_logs_tell_free_ways_only_by_one_that_points_there():
    def steps(weight, gain):
        room = Hook((30, 10))
        search = Explorer(*BOUNDS, 2 * 0.6 / LONGEST, FreeWays(weight, 0.0), NOTHING_FELT, 0)
        for _ in range(40):
            room.do(search.act(gain * room.see()))
        return room.position

    blind = np.zeros((9, 8))
    blind[-1] = BLIND
    by_one = np.concatenate([LONGEST * np.eye(8), np.zeros((1, 8))])
    by_all = by_one.copy()
    by_all[:-1] += 1e-9
    np.testing.assert_array_equal(steps(by_all / 5, 5.0), steps(blind, 5.0))
    np.testing.assert_array_equal(steps(by_one / 5, 5.0), steps(by_one, 1.0))
    assert np.abs(steps(by_all, 1.0) - steps(blind, 1.0)).max() > 5


def test_an_explorer_that_sees_nothing_of_free_ways_still_enters_new_cells():
    room = Hook((55, 10))
    blind = FreeWays(np.zeros((9, 8)), 0.0)
    search = Explorer(*BOUNDS, 2 * 0.6 / LONGEST, blind, NOTHING_FELT, 0)
    entered = set()
    for _ in range(300):
        room.do(search.act(room.see()))
        entered.add(tuple((room.position // 10).astype(int)))
    assert len(entered) > 8  # of 32 squares of 10 x 10, where a random walk enters 4


def test_an_explorer_does_without_missing_readings():
    room, search = Hook((55, 10)), explorer()
    for step in range(60):
        seen = room.see()
        seen[step % 8] = np.nan
        action = search.act(seen)
        assert np.isfinite(action).all()
        assert (np.abs(action) <= 1).all()
        room.do(action)
    assert np.isfinite(search.act(np.full(8, np.nan))).all()


@pytest.mark.parametrize("side", [-1, 1])
def test_an_explorer_leaves_what_is_known(side):
    room, search = Hook((30, 10)), explorer()
    x, y = np.meshgrid(np.arange(0, 31, 2), np.arange(-10, 11, 2), indexing="ij")
    search.know(np.stack([-side * x.ravel(), y.ravel()], 1))
    for _ in range(20):
        room.do(search.act(room.see()))
    assert side * (room.position[0] - 30) > 5


@pytest.mark.parametrize("gap", [FINE, WIDE])
def test_a_cell_is_new_beyond_a_gap_around_those_that_were_entered(gap):
    cells, row = Cells(2, gap), np.array([[x, 0] for x in range(-8, 9)])
    for cell in row:
        cells.enter(cell)
    way = cells.way_to_new(np.array([0, 0]))
    assert len(way) == abs(way[-1][1]) == gap + 1


def test_an_agent_feels_a_wall_in_a_direction_in_which_its_log_met_none():
    """Upwards, where the way is told by the reading that points there."""
    _, agent = learned()
    with gym.make("rfl/RangefinderMaze-v0", layout="paper") as env:
        before_the_wall, amid = (
            agent.readings.normalize(env.reset(options={"position": (900.0, y)})[0])
            for y in (570.0, 500.0)
        )
    assert agent.contact.is_blocked(3, before_the_wall) is True
    assert agent.contact.is_blocked(3, amid) is False


def test_who_completes_a_map_finds_something_new_nearer_than_who_is_lost():
    log, agent = learned()
    seen = agent.readings.normalize(log.observations[3000])
    node = int(agent.memory.node[3000])
    lost, fine = agent.explorer(), agent.explorer(node=node)
    lost.know(agent.positions - agent.positions[node])  # all that differs is the gap
    for search in (lost, fine):
        search.act(seen)
    assert 0 < fine.cells_to_new < lost.cells_to_new


def test_what_lies_beside_a_node_is_its_surroundings_though_no_log_went_there():
    _, agent = learned()
    apart = np.linalg.norm(agent.positions[:, None] - agent.positions, axis=2)
    beside = apart <= NODE_STEPS
    assert agent.near.toarray()[beside].all()
    assert not within(agent.edges, NEAR).toarray()[beside].all()


def test_where_controllers_lead_nowhere_a_robot_goes_by_dead_reckoning(monkeypatch):
    log, agent = learned()
    start, goal = 2000, int(agent.memory.node[3000])
    with gym.make("rfl/RangefinderMaze-v0", layout="paper", max_episode_steps=-1) as env:
        observation, info = env.reset(options={"position": tuple(log.ground_truth[start])})
        agent.last_seen = None
        executor = agent.executor(goal)
        monkeypatch.setattr(agent, "control_by_reckoning", lambda *_: agent.actions.rest)
        for _ in range(500):
            action = executor.act(observation)
            assert not executor.recovering
            if executor.status != "running":
                break
            observation, _, _, _, info = env.step(action)
    assert executor.status == "reached"
    assert np.linalg.norm(info["ground_truth"] - log.ground_truth[3000]) < 44


def test_an_explorer_says_how_far_it_is_to_what_is_new():
    room, search = Hook((30, 10)), explorer()
    search.act(room.see())
    assert 0 < search.cells_to_new < 8
    x, y = np.meshgrid(np.arange(-40, 41, 2), np.arange(-20, 61, 2), indexing="ij")
    far = explorer()
    far.know(np.stack([x.ravel(), y.ravel()], 1))
    far.act(room.see())
    assert far.cells_to_new >= 8


@pytest.mark.parametrize(
    ("start", "most"),
    [((100.0, 100.0), 300), ((60.0, 60.0), 300), ((630.0, 300.0), 800), ((900.0, 520.0), 800)],
)
def test_a_robot_put_where_its_log_never_was_comes_back_to_its_goal(start, most):
    """In as many steps as a task of the maze has, or 300 where trying what was tried least at each
    look takes more than that."""
    with gym.make("rfl/RangefinderMaze-v0", layout="paper", max_episode_steps=-1) as env:
        log, agent = learned()
        assert np.linalg.norm(log.ground_truth - start, axis=1).min() > 90
        observation, info = env.reset(options={"position": start})
        agent.last_seen = None
        executor = agent.executor(int(agent.memory.node[3000]))
        for _ in range(most):
            action = executor.act(observation)
            if executor.status != "running":
                break
            observation, _, _, _, info = env.step(action)
        assert executor.status == "reached"
        assert np.linalg.norm(info["ground_truth"] - log.ground_truth[3000]) < 44


def test_what_walls_feel_like_is_kept_in_the_file(tmp_path):
    _, agent = learned()
    agent.save(tmp_path / "agent.safetensors")
    loaded = Agent.load(tmp_path / "agent.safetensors")
    assert agent.contact.side.any()
    for own, other in zip(agent.contact, loaded.contact, strict=True):
        np.testing.assert_array_equal(own, other)
    config, state = load_checkpoint(tmp_path / "agent.safetensors")
    short = state | {name: state[name][:-1] for name in ("contact.threshold", "contact.side")}
    save_checkpoint(tmp_path / "short.safetensors", config, short)
    with pytest.raises(ValueError, match=r"contact\.side has 3 rows, needs 4"):
        Agent.load(tmp_path / "short.safetensors")
    for name in ("contact.threshold", "contact.side"):
        del state[name]
    save_checkpoint(tmp_path / "old.safetensors", config, state)
    assert not Agent.load(tmp_path / "old.safetensors").contact.side.any()
