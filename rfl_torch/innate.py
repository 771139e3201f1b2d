"""The innate controller: random actions before anything is learned, and the log they make.

Section 3.1 draws an action uniformly at every step; section 4.1 switches the torque among
{-max, 0, max} every 30 steps. Both are `hold` and `levels` of one controller.

Actions are rows of numbers everywhere. A Discrete(n) space becomes n of them, each 0 to 1: a log
has one-hot rows, and the environment is given the largest (`env_action`).
"""

import itertools
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rfl_torch.trajectory import Trajectory


class InnateController:
    """Draws an action and holds it for `hold` steps.

    Args:
        low: least action, (A,).
        high: largest action, (A,).
        hold: steps that each action is held.
        levels: None draws uniformly; 3 draws each dimension from {low, middle, high}, and so on.
        seed: of the draws.
    """

    def __init__(
        self,
        low: NDArray[np.float32],
        high: NDArray[np.float32],
        hold: int = 1,
        levels: int | None = None,
        seed: int = 0,
    ) -> None:
        if hold < 1 or (levels is not None and levels < 2):
            raise ValueError(
                f"hold is {hold} and levels {levels}; need hold >= 1 and levels >= 2 or None."
            )
        self.low, self.high = np.asarray(low, np.float32), np.asarray(high, np.float32)
        self.hold, self.levels = hold, levels
        self._rng = np.random.default_rng(seed)
        self._left = 0

    def act(self) -> NDArray[np.float32]:
        """Return the action of this step, (A,)."""
        if self._left == 0:
            self._left = self.hold
            if self.levels is None:
                share = self._rng.random(self.low.shape)
            else:
                share = self._rng.integers(self.levels, size=self.low.shape) / (self.levels - 1)
            drawn = self.low + share * (self.high - self.low)
            self._action = np.clip(drawn.astype(np.float32), self.low, self.high)
        self._left -= 1
        return self._action


def directions(action_dim: int) -> NDArray[np.float64]:
    """Full actions to choose among, rows in [0, 1], (K, A).

    In up to three dimensions all corners, edges and sides of the action space; else the two ends of
    each dimension.
    """
    if action_dim <= 3:
        rows = np.array(list(itertools.product((0.0, 0.5, 1.0), repeat=action_dim)))
        return rows[(rows != 0.5).any(1)]
    rows = np.full((2 * action_dim, action_dim), 0.5)
    rows[np.arange(len(rows)), np.arange(len(rows)) // 2] = np.tile([0.0, 1.0], action_dim)
    return rows


def nearest_direction(
    unit_actions: NDArray[np.floating],
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Which of the `directions` actions (T, A) point along, and whether they do so half-way out."""
    offset = unit_actions - 0.5
    ways = directions(offset.shape[1]) - 0.5
    along = offset @ (ways / np.linalg.norm(ways, axis=1, keepdims=True)).T
    return along.argmax(1), np.abs(offset).max(1) >= 0.25


def record(
    env: Any,
    num_steps: int,
    hold: int = 1,
    seed: int = 0,
    levels: int | None = None,
    progress: Callable[[range], Iterable[int]] = iter,
) -> Trajectory:
    """Drive a Gymnasium environment with innate actions and log what it shows.

    Args:
        env: one-dimensional Box observations, and Box or Discrete actions; rewards are not looked
            at. An `info["ground_truth"]` is logged beside the observations, for scoring. Of a
            Discrete space the log has one-hot rows (see `env_action`).
        num_steps: control steps.
        hold: steps that each action is held.
        seed: of the environment and of the actions.
        levels: see `InnateController`.
        progress: wraps the range of steps, as `tqdm.tqdm` does.

    Raises:
        ValueError: if the spaces are of another kind, or an episode ends before `num_steps`.
    """
    (log,) = _record(env, num_steps, hold, seed, levels, progress, is_unbroken=True)
    return log


def record_episodes(
    env: Any,
    num_steps: int,
    hold: int = 1,
    seed: int = 0,
    levels: int | None = None,
    progress: Callable[[range], Iterable[int]] = iter,
) -> list[Trajectory]:
    """Record as `record` does, and start anew whenever the environment ends an episode.

    Returns:
        One log an episode, `num_steps` in all; `Agent.fit` takes the list.
    """
    return _record(env, num_steps, hold, seed, levels, progress, is_unbroken=False)


def _record(
    env: Any,
    num_steps: int,
    hold: int,
    seed: int,
    levels: int | None,
    progress: Callable[[range], Iterable[int]],
    is_unbroken: bool,
) -> list[Trajectory]:
    check_spaces(env)
    if num_steps < 1:
        raise ValueError(f"num_steps is {num_steps}, needs at least 1; try 10000.")
    space = env.action_space
    if _is_discrete(space) and levels is not None:
        raise ValueError(f"levels is {levels}, but {space} has nothing between its actions.")
    low, high = action_bounds(space)
    innate = InnateController(low, high, hold, levels, seed)
    logs, actions = [], []
    observation, info = env.reset(seed=seed)
    observations, truths = [observation], [info.get("ground_truth")]
    for step in progress(range(num_steps)):
        row = innate.act()
        action = env_action(space, row)
        observation, _, terminated, truncated, info = env.step(action)
        actions.append(done_row(space, row))
        observations.append(observation)
        truths.append(info.get("ground_truth"))
        is_last = step + 1 == num_steps
        if (terminated or truncated) and not is_last and is_unbroken:
            raise ValueError(
                f"the episode ended at step {step + 1} of {num_steps}; a log is one unbroken run. "
                "Make the environment with a larger max_episode_steps, or use record_episodes."
            )
        if terminated or truncated or is_last:
            truth = None if truths[0] is None else np.stack(truths)
            logs.append(Trajectory(np.stack(observations), np.stack(actions), low, high, truth))
            if not is_last:
                observation, info = env.reset()
                observations, truths, actions = [observation], [info.get("ground_truth")], []
    return logs


def action_bounds(space: Any) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Bounds of a log's action rows, (A,) each: a Box's own, 0 and 1 for each Discrete action."""
    if _is_discrete(space):
        return np.zeros(int(space.n), np.float32), np.ones(int(space.n), np.float32)
    return space.low, space.high


def env_action(space: Any, row: NDArray[np.float32]) -> Any:
    """What the environment is given for an action row (A,): of a Discrete space its largest."""
    return int(space.start) + int(np.argmax(row)) if _is_discrete(space) else row


def done_row(space: Any, row: NDArray[np.float32]) -> NDArray[np.float32]:
    """What a log says of an action row (A,): of a Discrete space the one-hot row of what was done.

    Else rows that lead to the same action would look like different ones.
    """
    return np.eye(len(row), dtype=np.float32)[np.argmax(row)] if _is_discrete(space) else row


def _is_discrete(space: Any) -> bool:
    return type(space).__name__ == "Discrete"


REMEDIES = {
    "Dict": "gymnasium.wrappers.FilterObservation keeps the vectors that the robot senses and "
    "FlattenObservation joins them; the commands do both by --observation-keys.",
    "Image": "gymnasium.wrappers.ResizeObservation and GrayscaleObservation make images small, "
    "FlattenObservation makes them vectors.",
}
"""What helps with the usual spaces of observations."""


def check_spaces(env: Any) -> None:
    """Refuse spaces that are no vectors of numbers or, for actions, no choice; name a wrapper."""
    for name, space in (("observation", env.observation_space), ("action", env.action_space)):
        shape, kind = getattr(space, "shape", None), type(space).__name__
        if name == "action" and kind == "Discrete":
            continue
        if kind != "Box" or shape is None or len(shape) != 1 or shape[0] == 0:
            needed = "a Box of shape (n,)" + (" or Discrete" if name == "action" else "")
            remedy = f"gymnasium.wrappers.Transform{name.capitalize()} can make it one."
            if name == "observation":
                remedy = REMEDIES.get("Image" if kind == "Box" else kind, remedy)
            raise ValueError(
                f"the {name} space is {space}; needs {needed}. Wrap the environment: {remedy}"
            )
    low, high = action_bounds(env.action_space)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(
            f"the action space is {env.action_space}, without bounds; random actions need finite "
            "ones. Wrap the environment with gymnasium.wrappers.RescaleAction or ClipAction."
        )
