from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
import torch
from test_growth import covered, half_log
from worlds import DotWorld, dot_config, dot_log

from rfl_torch import Agent, record
from rfl_torch.executor import CONFIRMED
from rfl_torch.frontier import untried
from rfl_torch.innate import nearest_direction
from rfl_torch.practice import STAY, Goals, Strategy, _explore


class Recorder(DotWorld):
    """Keeps count of steps, and ends an episode every `length` of them."""

    def __init__(self, length=10**9):
        super().__init__()
        self.length, self.steps, self.resets = length, 0, 0

    def reset(self, **kwargs):
        self.resets += 1
        return super().reset(**kwargs)

    def step(self, action):
        assert (np.abs(action) <= 1.0).all()
        self.steps += 1
        observation, reward, _, _, info = super().step(action)
        return observation, reward, self.steps % self.length == 0, False, info


@pytest.fixture(scope="module")
def half_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("practice") / "half.safetensors"
    Agent(dot_config()).fit(half_log()).save(path)
    return path


def test_frontier_practice_takes_the_map_from_half_of_the_square_to_all_of_it(half_path):
    agent = Agent.load(half_path)
    log = dot_log(1500, seed=5)
    assert covered(agent, half_log(9)) < 0.7
    agent.practice(DotWorld(), 2000)
    assert covered(agent, log) > 0.9


@pytest.mark.parametrize("strategy", get_args(Strategy))
def test_practice_takes_exactly_the_steps_it_was_given_and_learns_from_all(half_path, strategy):
    agent = Agent.load(half_path)
    before, world = agent.edges.sum(), Recorder()
    history = agent.practice(world, 700, strategy=strategy)
    assert (world.steps, world.resets) == (700, 1)
    assert agent.edges.sum() == before + 700
    starts = [attempt.step for attempt in history]
    assert starts == sorted(set(starts))
    assert all(0 <= attempt.goal < agent.num_nodes for attempt in history)


def test_no_transition_is_learned_across_the_end_of_an_episode(half_path):
    agent = Agent.load(half_path)
    before, world = agent.edges.sum(), Recorder(length=40)
    agent.practice(world, 400)
    assert world.resets == 1 + 400 // 40
    assert agent.edges.sum() == before + 400


class ChoiceWorld(DotWorld):
    """Five choices instead of two numbers: stand still, or move along a side."""

    moves = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])

    class _Choices:
        n, start = 5, 0

    _Choices.__name__ = "Discrete"

    def __init__(self):
        super().__init__()
        self.action_space, self.chosen = self._Choices(), []

    def step(self, action):
        assert isinstance(action, int)
        self.chosen.append(action)
        return super().step(self.moves[action])


def test_practice_gives_an_environment_its_choices_and_learns_what_was_chosen():
    world = ChoiceWorld()
    agent = Agent(dot_config(repairs=False)).fit(record(world, 800, seed=1))
    before, tried = agent.edges.sum(), agent.tried.sum()
    world.chosen.clear()
    agent.practice(world, 600)
    assert len(world.chosen) == 600
    assert len(set(world.chosen)) == 5
    assert agent.edges.sum() == before + 600
    assert agent.tried.sum() == tried + 600  # each step was a whole choice, none a mixture
    rows = agent.samples.action.numpy()
    assert set(np.unique(rows)) == {0.0, 1.0}
    assert (rows.sum(1) == 1).all()


def test_practice_is_the_same_for_the_same_seed(half_path):
    first, again, other = (Agent.load(half_path) for _ in range(3))
    history = first.practice(DotWorld(), 600, seed=1)
    assert again.practice(DotWorld(), 600, seed=1) == history
    assert other.practice(DotWorld(), 600, seed=2) != history


def test_a_direction_is_untried_until_it_was_taken_or_a_neighbour_lies_there(half_path):
    agent = Agent.load(half_path)
    is_open = untried(agent)
    assert (agent.tried[is_open] < 5).all()
    mean = agent.hmm.emission_mean.detach().float()
    graph = agent.graph.tocoo()
    inputs = torch.cat([mean[graph.row], mean[graph.col]], 1)
    with torch.no_grad():
        way, _ = nearest_direction(agent.bank(inputs, torch.from_numpy(graph.col).long()).numpy())
    assert not is_open[graph.row, way].any()
    agent.tried[:] = 0
    none_tried = untried(agent)
    agent.tried[:] = 99
    assert none_tried.any()
    assert not untried(agent).any()


def test_each_strategy_takes_the_node_it_promises(half_path):
    agent = Agent.load(half_path)
    rng = np.random.default_rng(0)
    assert agent.visits[Goals(agent, "least_visited", rng).choose(0)] == agent.visits.min()
    progress = Goals(agent, "progress", rng)
    progress.note(3, True)
    assert progress.choose(0) == 3
    frontier = Goals(agent, "frontier", rng)
    frontier.untried[:] = False
    frontier.untried[5, 0] = True
    assert frontier.choose(0) == 5
    frontier.untried[6, 0] = True
    for best in (5, 6):
        frontier.promise[:] = 1.0
        frontier.promise[best] = 1000.0  # worth any way
        assert frontier.choose(0) == best
    frontier.untried[6, 0] = False
    assert frontier.try_out(5) == 0
    assert frontier.try_out(5) is None
    assert len({Goals(agent, "random", rng).choose(0) for _ in range(50)}) > 5


@pytest.mark.parametrize(("away", "goes_on"), [(STAY, True), (STAY + 1, False), (0, False)])
def test_a_walk_in_unknown_land_goes_on_while_something_new_is_near(away, goes_on):
    """The map looks familiar from the first step on; after 40 steps nothing is new any more."""
    explorer = SimpleNamespace(cells_to_new=away, num_steps=0)

    def act(_):
        explorer.num_steps += 1
        explorer.cells_to_new = away if explorer.num_steps <= 40 else 0

    explorer.act = act
    agent = SimpleNamespace(readings=SimpleNamespace(normalize=lambda observation: observation))
    run = SimpleNamespace(observation=None, step=lambda action: None)
    executor = SimpleNamespace(is_familiar=True, watch=lambda *_: None)
    num_steps = _explore(agent, run, executor, explorer, 100)
    assert num_steps == explorer.num_steps == (41 if goes_on else CONFIRMED)


def test_a_grid_map_can_be_practised_with_too():
    agent = Agent(dot_config(repairs=False)).fit(dot_log(800, seed=1))
    before = agent.edges.sum()
    agent.practice(DotWorld(), 300)
    assert agent.edges.sum() == before + 300
