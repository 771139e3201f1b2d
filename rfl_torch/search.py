"""Search where no map helps: off it, at its border, or where a controller holds the robot.

Random actions take it nowhere fast. Counting which actions were tried at which look spreads it over
the place like a flood. Where actions add up to positions, `explorer` knows better.
"""

import numpy as np
from numpy.typing import NDArray

from rfl_torch.innate import directions
from rfl_torch.looks import distance

HOLD = 10
"""Steps that an action is held at one look at most."""


class LookSearch:
    """Chooses actions that lead on from looks already seen.

    Args:
        low, high: bounds of the action space, (A,).
        radius: of a look, see `looks.look_radius`.
        seed: decides between actions that were tried equally often.
    """

    def __init__(
        self, low: NDArray[np.float32], high: NDArray[np.float32], radius: float, seed: int
    ) -> None:
        unit = directions(len(low))
        self._actions = (low + unit * (high - low)).astype(np.float32).clip(low, high)
        self._radius = radius
        self._rng = np.random.default_rng(seed)
        self._looks = np.empty((0, 0))
        self._tried: list[NDArray[np.int64]] = []
        self._look = -1
        self._choice = -1
        self._left = 0

    def act(self, normal: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the action of this step, (A,), at a normalised observation (D,)."""
        look = self._recognize(np.nan_to_num(normal, nan=0.5))
        if look != self._look or self._left == 0:
            tried = self._tried[look]
            least = np.flatnonzero(tried == tried.min())
            if look == self._look or self._choice not in least:  # else go straight on
                self._choice = int(self._rng.choice(least))
            tried[self._choice] += 1
            self._look, self._left = look, HOLD
        self._left -= 1
        return self._actions[self._choice]

    def _recognize(self, normal: NDArray[np.float64]) -> int:
        if len(self._looks):
            away = distance(normal[None], self._looks)[0]
            if away.min() <= self._radius:
                return int(away.argmin())
        self._looks = np.append(self._looks.reshape(-1, len(normal)), normal[None], axis=0)
        self._tried.append(np.zeros(len(self._actions), np.int64))
        return len(self._looks) - 1
