"""A world small enough to learn in a second: a dot on a square that feels four corner beacons."""

import numpy as np

from rfl_torch import AgentConfig, Stage, Trajectory


class DotWorld:
    """A dot in the unit square; it moves by up to 0.1 a step and reads four smooth distances."""

    class _Box:
        def __init__(self, low: float, high: float, size: int) -> None:
            self.low = np.full(size, low, np.float32)
            self.high = np.full(size, high, np.float32)
            self.shape = (size,)

    _Box.__name__ = "Box"

    def __init__(self) -> None:
        self.observation_space = self._Box(0.0, 1.5, 4)
        self.action_space = self._Box(-1.0, 1.0, 2)
        self.position = np.full(2, 0.5)

    def reset(self, *, seed=None, options=None):
        self.position = np.array((options or {}).get("position", (0.5, 0.5)), np.float64)
        return self._observe()

    def step(self, action):
        self.position = np.clip(self.position + 0.1 * np.asarray(action), 0.0, 1.0)
        observation, info = self._observe()
        return observation, 0.0, False, False, info

    def _observe(self):
        corners = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
        distance = np.linalg.norm(corners - self.position, axis=1)
        return distance.astype(np.float32), {"ground_truth": self.position.copy()}


def dot_config(**changes) -> AgentConfig:
    """A recipe for DotWorld: 6 x 6 nodes, a short tempered schedule."""
    stages = (
        Stage(2, 40, (0.02, 1.0), pseudo_count=0.01, min_scale=0.02, tolerance=0.0),
        Stage(1, 10, (1.0, 1.0), pseudo_count=0.01, min_scale=0.02),
    )
    return AgentConfig(**({"shape": (6, 6), "stages": stages} | changes))


def dot_log(num_steps: int = 2000, seed: int = 0) -> Trajectory:
    """A random walk in DotWorld."""
    from rfl_torch import record

    return record(DotWorld(), num_steps, seed=seed)
