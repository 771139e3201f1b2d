"""Acting and practising for long, and the smallest sizes; `experiments.trust` has the long runs."""

import numpy as np
import pytest
from worlds import dot_config, dot_log

from experiments import trust
from rfl_torch import Agent, GridHMM, footprint
from rfl_torch.planner import look_alikes


def test_a_short_soak_keeps_memory_and_belief():
    agent = trust.small_agent()
    parts = trust.soak_execution(trust.Room(), agent, 3_000, 0)
    parts_of_practice = trust.soak_practice(trust.Room(), agent, 600, 0)
    assert sum(part.goals for part in parts) > 100
    assert parts[-1].megabytes - parts[1].megabytes < trust.MOST_MEMORY
    assert max(part.worst_sum for part in parts + parts_of_practice) < 1e-9


@pytest.mark.parametrize(("num_steps", "side", "obs_dim"), [(60, 1, 1), (300, 3, 256)])
def test_small_maps_and_one_or_many_readings_work(num_steps, side, obs_dim):
    assert trust.learn_size(num_steps, side, obs_dim).outcome.endswith(" nodes")


def test_a_log_of_one_step_is_refused_with_what_is_needed():
    assert "too few" in trust.learn_size(1, 3, 2).outcome


def test_a_map_of_400_nodes_in_use_is_acted_on():
    assert trust.keep_size(20).outcome.startswith("400 nodes, reached")


def test_what_takes_more_memory_than_there_is_is_refused_before_it_is_taken(monkeypatch, tmp_path):
    world = dot_log(1500)
    agent = Agent(dot_config()).fit(world)
    monkeypatch.setattr(footprint, "MEMINFO", tmp_path / "meminfo")
    footprint.MEMINFO.write_text("MemTotal: 9999999 kB\nMemAvailable:    100 kB\n")
    with pytest.raises(ValueError, match=r"1500 steps of 4 readings takes .* and 0\.000102 GB"):
        Agent(dot_config()).fit(world)
    with pytest.raises(ValueError, match=rf"1500 steps into {agent.num_nodes} nodes takes"):
        agent.partial_fit(world)
    footprint.MEMINFO.unlink()  # a system that says nothing
    assert footprint.available() is None
    agent.partial_fit(world)


def test_a_grid_and_a_map_that_are_too_large_are_refused():
    with pytest.raises(ValueError, match=r"takes 4\.8e\+03 GB"):
        GridHMM((1_000_000, 8_000), 24)
    with pytest.raises(ValueError, match="pairs of the 12000 nodes look alike"):
        look_alikes(np.zeros((12_000, 2)), np.ones((12_000, 2)), 1.0)
