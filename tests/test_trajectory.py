"""`rfl_torch.trajectory` and `rfl_torch.innate`: logs hold what was done, or say what is wrong."""

import numpy as np
import pytest
from worlds import DotWorld

from rfl_torch import InnateController, Trajectory, env_action, record, record_episodes


def arrays(num_steps=5):
    rng = np.random.default_rng(0)
    return rng.random((num_steps + 1, 3)), rng.random((num_steps, 2))


def test_a_saved_log_loads_equal(tmp_path):
    log = Trajectory(*arrays(), ground_truth=np.random.default_rng(1).random((6, 2)))
    log.save(tmp_path / "log.npz")
    back = Trajectory.load(tmp_path / "log.npz")
    for name in ("observations", "actions", "action_low", "action_high", "ground_truth"):
        np.testing.assert_array_equal(getattr(back, name), getattr(log, name))
    assert back.observations.dtype == np.float32
    assert back.ground_truth is not None
    assert back.ground_truth.dtype == np.float64


def test_a_plain_npz_of_observations_and_actions_is_a_log(tmp_path):
    observations, actions = arrays()
    np.savez(tmp_path / "plain.npz", observations=observations, actions=actions)
    log = Trajectory.load(tmp_path / "plain.npz")
    np.testing.assert_allclose(log.action_low, actions.min(0), rtol=1e-6)
    assert log.ground_truth is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda o, a: (o[:-1], a), "one observation more"),
        (lambda o, a: (o[:1], a[:0]), "at least one action"),
        (lambda o, a: (o[:, 0], a), r"shape \(6,\)"),
        (
            lambda o, a: (np.where(o == o[2, 1], np.inf, o), a),
            "observation 2 has inf in dimension 1",
        ),
        (lambda o, a: (o, np.where(a == a[3, 0], np.nan, a)), "action 3 has nan in dimension 0"),
        (lambda o, a: (o.astype(str), a), "need numbers"),
    ],
)
def test_a_bad_log_is_refused_with_what_was_found(change, message):
    with pytest.raises(ValueError, match=message):
        Trajectory(*change(*arrays()))


def test_an_action_outside_its_bounds_is_refused():
    observations, actions = arrays()
    with pytest.raises(ValueError, match="outside"):
        Trajectory(observations, actions, np.zeros(2), np.full(2, 0.01))


def test_a_missing_reading_is_allowed():
    observations, actions = arrays()
    observations[2, 1] = np.nan
    assert np.isnan(Trajectory(observations, actions).observations[2, 1])


@pytest.mark.parametrize("content", [b"", b"no npz", b"PK\x03\x04cut"])
def test_a_file_that_is_no_log_is_named(tmp_path, content):
    path = tmp_path / "bad.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"bad\.npz"):
        Trajectory.load(path)


def test_a_pickled_array_is_refused_unread(tmp_path):
    path = tmp_path / "pickle.npz"
    np.savez(path, observations=np.array([object()]), actions=np.zeros((1, 1)))
    with pytest.raises(ValueError, match=r"pickle\.npz"):
        Trajectory.load(path)


def test_recorded_observations_follow_from_the_actions():
    log = record(DotWorld(), 50, hold=3, seed=4)
    world = DotWorld()
    world.reset()
    for t, action in enumerate(log.actions):
        observation = world.step(action)[0]
        np.testing.assert_array_equal(log.observations[t + 1], observation)
    assert log.ground_truth is not None
    assert log.ground_truth.shape == (51, 2)


def test_the_same_seed_records_the_same_log_and_another_seed_another():
    first, again, other = (record(DotWorld(), 30, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.actions, again.actions)
    assert (first.actions != other.actions).any()


def test_actions_are_held_and_uniform_within_the_bounds():
    innate = InnateController(np.array([-2.0, 0.0]), np.array([2.0, 1.0]), hold=4, seed=0)
    actions = np.stack([innate.act() for _ in range(8000)])
    blocks = actions.reshape(2000, 4, 2)
    assert (blocks == blocks[:, :1]).all()
    np.testing.assert_allclose(actions.mean(0), [0.0, 0.5], atol=0.1)
    np.testing.assert_allclose(actions.std(0), [4 / 12**0.5, 1 / 12**0.5], rtol=0.05)


def test_three_levels_are_low_middle_and_high():
    innate = InnateController(np.array([-5.0]), np.array([5.0]), levels=3, seed=0)
    actions, counts = np.unique([innate.act() for _ in range(3000)], return_counts=True)
    np.testing.assert_array_equal(actions, [-5.0, 0.0, 5.0])
    assert counts.min() > 900


class Ending(DotWorld):
    """Ends its episodes after four steps."""

    def reset(self, **options):
        self.steps = 0
        return super().reset(**options)

    def step(self, action):
        self.steps += 1
        observation, reward, _, _, info = super().step(action)
        return observation, reward, self.steps == 4, False, info


def test_an_episode_that_ends_is_no_log():
    with pytest.raises(ValueError, match="episode ended at step 4 of 10"):
        record(Ending(), 10)


def test_every_episode_becomes_a_log_that_begins_at_a_reset():
    logs = record_episodes(Ending(), 10, seed=3)
    assert [log.num_steps for log in logs] == [4, 4, 2]
    start = DotWorld().reset()[0]
    for log in logs:
        np.testing.assert_array_equal(log.observations[0], start)
    whole = record(DotWorld(), 10, seed=3)
    np.testing.assert_array_equal(np.concatenate([log.actions for log in logs]), whole.actions)
    np.testing.assert_array_equal(logs[0].observations, whole.observations[:5])


class Discrete:
    """The space of Gymnasium, by its name: three actions from -1 on."""

    n, start = 3, -1


class Choosing(DotWorld):
    """Takes -1, 0 or 1 and remembers what it was given."""

    def __init__(self):
        super().__init__()
        self.action_space, self.given = Discrete(), []

    def step(self, action):
        self.given.append(action)
        return super().step(np.full(2, float(action)))


def test_discrete_actions_are_logged_as_one_hot_rows_and_drawn_evenly():
    world = Choosing()
    log = record(world, 3000, hold=2, seed=0)
    assert all(type(action) is int for action in world.given)
    np.testing.assert_array_equal(log.actions.argmax(1) - 1, world.given)
    np.testing.assert_array_equal(np.sort(log.actions, 1), np.tile([0, 0, 1], (3000, 1)))
    np.testing.assert_allclose(log.actions.mean(0), 1 / 3, atol=0.04)
    assert env_action(Discrete(), np.array([0.2, 0.1, 0.7])) == 1
    with pytest.raises(ValueError, match="levels is 2"):
        record(Choosing(), 10, levels=2)


def test_spaces_that_are_no_vectors_are_refused_with_a_wrapper_to_use():
    class Image(DotWorld):
        def __init__(self):
            super().__init__()
            self.observation_space.shape = (8, 8, 3)

    with pytest.raises(ValueError, match="GrayscaleObservation"):
        record(Image(), 10)

    class Unbounded(DotWorld):
        def __init__(self):
            super().__init__()
            self.action_space.high[:] = np.inf

    with pytest.raises(ValueError, match="RescaleAction"):
        record(Unbounded(), 10)
