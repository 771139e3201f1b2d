"""`rfl_torch.logs`: what is read is what was written, and what can't be read is named."""

import sys

import numpy as np
import pytest

from rfl_torch import Trajectory, read_logs, save_logs


@pytest.fixture
def logs():
    rng = np.random.default_rng(0)
    return [
        Trajectory(
            rng.random((steps + 1, 3)),
            rng.random((steps, 2)),
            np.zeros(2),
            np.ones(2),
            rng.random((steps + 1, 1)),
        )
        for steps in (5, 1, 3)
    ]


def assert_equal(first, second):
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.observations, other.observations)
        np.testing.assert_array_equal(one.actions, other.actions)


@pytest.mark.parametrize("num", [1, 3])
def test_saved_episodes_are_read_back(tmp_path, logs, num):
    save_logs(logs[:num], tmp_path / "logs.npz")
    back = read_logs(tmp_path / "logs.npz")
    assert_equal(back, logs[:num])
    for log, own in zip(back, logs, strict=False):
        np.testing.assert_array_equal(log.ground_truth, own.ground_truth)
        np.testing.assert_array_equal(log.bounds, own.bounds)


def test_a_file_of_several_episodes_is_no_single_log(tmp_path, logs):
    save_logs(logs, tmp_path / "logs.npz")
    with pytest.raises(ValueError, match=r"3 episodes.*read_logs"):
        Trajectory.load(tmp_path / "logs.npz")


@pytest.mark.parametrize("steps", [[5, 4], [4, 4, 1, 0], [[9]], [4.5, 4.5]])
def test_episode_steps_that_do_not_fit_are_refused(tmp_path, steps):
    np.savez(
        tmp_path / "bad.npz",
        observations=np.random.default_rng(0).random((10, 2)),
        actions=np.ones((9, 1)),
        episode_steps=np.array(steps),
    )
    with pytest.raises(ValueError, match=r"bad\.npz.*episode_steps"):
        read_logs(tmp_path / "bad.npz")


def test_logs_of_different_robots_are_not_saved_together(tmp_path, logs):
    other = Trajectory(np.random.default_rng(0).random((4, 2)), np.ones((3, 2)))
    with pytest.raises(ValueError, match="needs one kind"):
        save_logs([*logs, other], tmp_path / "logs.npz")


CSV = """time,obs_front,act_speed,obs_side,truth_x,episode
0.0,0.5,1.0,2.0,10,first
0.1,0.6,-1.0,,11,first
0.2,0.7,0.5,2.5,12,first
0.0,0.1,0.25,3.0,20,second
0.1,0.2,,nan,21,second
"""


def test_a_csv_is_read_column_by_column_and_episode_by_episode(tmp_path):
    (tmp_path / "drive.csv").write_text(CSV)
    first, second = read_logs(tmp_path / "drive.csv")
    np.testing.assert_allclose(first.observations, [[0.5, 2.0], [0.6, np.nan], [0.7, 2.5]])
    np.testing.assert_allclose(first.actions, [[1.0], [-1.0]])
    np.testing.assert_allclose(second.observations, [[0.1, 3.0], [0.2, np.nan]])
    np.testing.assert_allclose(second.actions, [[0.25]])
    np.testing.assert_array_equal(second.ground_truth, [[20], [21]])
    np.testing.assert_allclose(second.bounds, [[-1.0], [1.0]])  # of all episodes: one robot


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no CSV with a header"),
        ("a,b\n1,2\n", "needs obs_"),
        ("obs_0,act_0\n1,2\n3\n", "line 3 has 1 cells"),
        ("obs_0,act_0\n1,2\nfar,2\n", "line 3 has 'far' in obs_0"),
        ("obs_0,act_0\n1,2\n", "two rows"),
        ("obs_0,act_0\n1,\n2,1\n3,1\n", "action 0 has nan"),
    ],
)
def test_a_bad_csv_is_refused_with_what_was_found(tmp_path, text, message):
    (tmp_path / "bad.csv").write_text(text)
    with pytest.raises(ValueError, match=message) as refusal:
        read_logs(tmp_path / "bad.csv")
    assert "bad.csv" in str(refusal.value)


def test_missing_minari_names_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(ValueError, match="pip install"):
        read_logs("minari:some/set-v0")


@pytest.fixture
def minari(tmp_path, monkeypatch):
    module = pytest.importorskip("minari", reason="minari is not installed: an optional extra")
    pytest.importorskip("h5py", reason="h5py is not installed: minari keeps its data in it")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return module


@pytest.mark.filterwarnings("ignore")  # of Minari, about what a published data set should have
def test_a_minari_data_set_is_read_episode_by_episode(minari):
    import gymnasium as gym

    env = minari.DataCollector(gym.make("CartPole-v1"))
    done = 0
    env.reset(seed=0)
    lengths, steps = [], 0
    while done < 3:
        _, _, terminated, truncated, _ = env.step(1)
        steps += 1
        if terminated or truncated:
            done += 1
            lengths.append(steps)
            steps = 0
            env.reset()
    env.create_dataset("cart/random-v0")
    logs = read_logs("minari:cart/random-v0")
    assert [log.num_steps for log in logs] == lengths
    assert logs[0].observations.shape == (lengths[0] + 1, 4)
    np.testing.assert_array_equal(logs[0].actions, np.tile([0, 1], (lengths[0], 1)))
    with pytest.raises(ValueError, match="minari list local"):
        read_logs("minari:cart/none-v0")
