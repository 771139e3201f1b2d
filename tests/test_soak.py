"""Acting and practising for long, and the smallest sizes; `experiments.trust` has the long runs."""

import numpy as np
import pytest

from experiments import trust
from rfl_torch import GridHMM
from rfl_torch.planner import look_alikes


def test_a_short_soak_keeps_memory_and_belief():
    agent = trust.small_agent()
    parts = trust.soak_execution(trust.Room(), agent, 3_000, 0)
    parts_of_practice = trust.soak_practice(agent, 600, 0)
    assert sum(part.goals for part in parts) > 100
    assert parts[-1].megabytes - parts[1].megabytes < trust.MOST_MEMORY
    assert max(part.worst_sum for part in parts + parts_of_practice) < 1e-9


@pytest.mark.parametrize(("num_steps", "side", "obs_dim"), [(60, 1, 1), (300, 3, 256)])
def test_small_maps_and_one_or_many_readings_work(num_steps, side, obs_dim):
    assert trust._learn_size(num_steps, side, obs_dim) >= 1


def test_a_log_of_one_step_is_refused_with_what_is_needed():
    with pytest.raises(ValueError, match="too few"):
        trust._learn_size(1, 3, 2)


def test_memory_is_foretold_before_it_is_taken():
    with pytest.raises(ValueError, match=r"takes 4\.8e\+03 GB"):
        GridHMM((1_000_000, 8_000), 24)
    with pytest.raises(ValueError, match="pairs of the 12000 nodes look alike"):
        look_alikes(np.zeros((12_000, 2)), np.ones((12_000, 2)), 1.0)
