"""`rfl_torch.spaces`: readings and actions in the units that all else counts in."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rfl_torch import Trajectory
from rfl_torch.spaces import Actions, Readings

ROUNDING = 1e-6
"""Actions are float32."""


def log_of(observations, low=-1.0, high=1.0):
    observations = np.asarray(observations, np.float32)
    actions = np.zeros((len(observations) - 1, 2), np.float32)
    return Trajectory(observations, actions, np.float32([low, low]), np.float32([high, high]))


def test_what_the_logs_read_lies_between_0_and_1_and_comes_back():
    rng = np.random.default_rng(0)
    logs = [log_of(rng.normal([5, -300], [1, 40], (50, 2))) for _ in range(2)]
    readings = Readings.of_logs(logs, unwraps=False)
    seen = np.concatenate([log.observations for log in logs])
    normal = readings.normalize(seen)
    np.testing.assert_array_equal([normal.min(0), normal.max(0)], [[0, 0], [1, 1]])
    np.testing.assert_allclose(readings.restore(normal), seen, rtol=ROUNDING)


def test_a_reading_that_never_changes_is_left_out_with_a_warning_and_still_taken_in():
    seen = np.stack([np.arange(20.0), np.full(20, 7.0), np.arange(20.0)[::-1]], 1)
    with pytest.warns(UserWarning, match=r"readings \[1\] never change"):
        readings = Readings.of_logs([log_of(seen)], unwraps=False)
    assert readings.used.tolist() == [0, 2]
    assert readings.normalize(seen[3].astype(np.float32)).shape == (2,)
    with pytest.raises(ValueError, match="no reading changes"):
        Readings.of_logs([log_of(np.ones((20, 3)))], unwraps=False)


def test_missing_readings_stay_missing_and_spoil_no_range():
    seen = np.stack([np.arange(20.0), np.arange(20.0)], 1)
    seen[5, 0] = np.nan
    readings = Readings.of_logs([log_of(seen)], unwraps=False)
    assert readings.scale.tolist() == [19.0, 19.0]
    assert np.isnan(readings.normalize(seen.astype(np.float32))[5]).tolist() == [True, False]


def test_a_reading_that_wraps_becomes_two_on_a_circle_and_has_no_unit_of_its_own():
    angle = np.cumsum(np.full(2000, 0.1)) % (2 * np.pi)
    seen = np.stack([angle, np.linspace(3.0, 5.0, 2000)], 1)
    readings = Readings.of_logs([log_of(seen)], unwraps=True)
    normal = readings.normalize(seen.astype(np.float32))
    assert normal.shape == (2000, 3)
    assert np.abs(np.diff(normal, axis=0)).max() < 0.1  # no jump is left
    np.testing.assert_allclose(readings.restore(normal), seen, atol=1e-3)
    low, scale = readings.own_units()
    np.testing.assert_allclose([low[0], scale[0]], [3.0, 2.0], rtol=ROUNDING)
    assert (low[1:].tolist(), scale[1:].tolist()) == ([0, 0], [1, 1])


def test_a_wider_range_measures_by_what_then_counts_as_0_and_1():
    seen = np.stack([np.linspace(0, 10, 20), np.full(20, 1.0), np.linspace(5, 6, 20)], 1)
    with pytest.warns(UserWarning, match="never change"):
        readings = Readings.of_logs([log_of(seen)], unwraps=False)
    low, high = np.array([-0.5, 0.0]), np.array([1.5, 2.0])
    wider = readings.widened(low, high)
    normal = readings.normalize(seen.astype(np.float32))
    np.testing.assert_allclose(
        wider.normalize(seen.astype(np.float32)), (normal - low) / (high - low), atol=ROUNDING
    )
    assert readings.scale[0] == 10.0  # what was there before is as it was
    assert wider.used.tolist() == [0, 2]


def test_an_observation_of_other_width_is_refused():
    readings = Readings.of_logs([log_of(np.random.default_rng(0).random((20, 3)))], False)
    with pytest.raises(ValueError, match=r"observation has shape \(4,\), needs \(\.\.\., 3\)"):
        readings.normalize(np.zeros(4, np.float32))


@given(arrays(np.float64, 2, elements=st.floats(-3, 3)))
def test_a_move_too_long_is_shortened_not_bent_and_one_within_bounds_comes_back(move):
    actions = Actions(np.array([-2, 0], np.float32), np.array([2, 8], np.float32))
    done = actions.to_move(actions.of_move(move))
    expected = move / max(1.0, np.abs(move).max())
    np.testing.assert_allclose(done, expected, atol=ROUNDING)


def test_the_widest_bounds_of_all_logs_count_and_rest_is_their_middle():
    seen = np.random.default_rng(0).random((20, 3))
    actions = Actions.of_logs([log_of(seen, -1, 1), log_of(seen, -0.5, 3)])
    assert (actions.low.tolist(), actions.high.tolist()) == ([-1, -1], [3, 3])
    assert actions.rest.tolist() == [1, 1]
    assert actions.of_unit(np.array([np.nan, 0.5])).tolist() == [1, 1]  # it says nothing
