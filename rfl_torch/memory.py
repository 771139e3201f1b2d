"""Recognised logs, kept in a row where learning more goes back to them.

Motion is learned from them where a world can't run backwards (`motion`). Where actions add up to
positions, all of them are laid out anew together with what comes next (`places`): there, what was
seen often enough since is left out, oldest first, so they grow with the map and not with time.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

LEAST_STEPS, STEPS_A_NODE = 10_000, 30
"""Steps that are kept whatever they show, in all and for each node: 10,000 are laid out in half a
second."""

ENOUGH = 10
"""Latest steps at a node that are kept in any case."""

PIECE = 25
"""Steps that are left out together. Where the robot then was is known from the nodes around."""

SAME = 3e-6
"""Distance of normalised observations that are one and the same: what is kept was rounded again
whenever more data made the range wider that they are normalised by."""

FAR = 1e30
"""What a missing reading is taken for where the same is sought: nothing is as far."""


class Memory(NamedTuple):
    """The recognised logs that are learned from.

    observation: float32 (M, E) normalised, all logs in a row, without gaps.
    action: float32 (M, A) in [0, 1]; the row at a log's last observation means nothing.
    node: int64 (M,).
    start: int64 (L,), where each log begins.
    settled: int64 (), steps that were kept when some were left out last. Of the logs that begin
        among them what is left is where its nodes are, whatever it looks like.
    """

    observation: NDArray[np.float32]
    action: NDArray[np.float32]
    node: NDArray[np.int64]
    start: NDArray[np.int64]
    settled: NDArray[np.int64] = np.zeros((), np.int64)

    def logs(self) -> tuple[list[NDArray[np.float64]], list[NDArray[np.float32]]]:
        """Observations (T+1, E) and actions (T, A) of each log."""
        cuts = self.start[1:]
        seen = np.split(self.observation.astype(np.float64), cuts)
        return seen, [action[:-1] for action in np.split(self.action, cuts)]

    def paths(self) -> list[NDArray[np.int64]]:
        """Nodes (T+1,) of each log."""
        return np.split(self.node, self.start[1:])

    def remember(self, observations: NDArray[np.float64]) -> NDArray[np.int64]:
        """Nodes (T,) where observations (T, E) were kept, -1 for what was not.

        Of the steps that saw the very same, the one is meant that goes on from the last.
        """
        seen, first, number = np.unique(
            self.observation, axis=0, return_index=True, return_inverse=True
        )
        number = number.ravel()
        sought = np.nan_to_num(observations.astype(np.float32), nan=FAR)
        tree, remembered, after = cKDTree(seen), np.full(len(sought), -1), len(number)
        _, nearest = tree.query(sought, distance_upper_bound=SAME)
        for t, same in enumerate(tree.query_ball_point(sought, SAME)):
            if not same:
                after = len(number)
                continue
            goes_on = after < len(number) and number[after] in same
            step = after if goes_on else first[nearest[t]]
            remembered[t], after = self.node[step], step + 1
        return remembered

    def ends_with(self, observation: NDArray[np.float64]) -> bool:
        """Whether the readings (E,) that are there are those of the last step."""
        is_there = ~np.isnan(observation)
        is_same = np.abs(observation - self.observation[-1]) <= SAME
        return bool(is_there.any() and is_same[is_there].all())

    def thinned(self) -> "Memory":
        """This memory without the oldest pieces of what is more than the map needs.

        A piece is left out if all its nodes are shown ENOUGH by the rest. A log that loses one from
        its middle becomes two; the end of the last stays.
        """
        num_steps, left = len(self.node), np.bincount(self.node)
        too_many = num_steps - max(LEAST_STEPS, STEPS_A_NODE * len(left))
        if too_many <= 0:
            return self
        is_kept, begins = np.ones(num_steps, bool), np.zeros(num_steps, bool)
        ends = np.append(self.start[1:], num_steps)
        for begin, end in zip(self.start, ends, strict=True):
            for piece in np.array_split(np.arange(begin, end), max(1, (end - begin) // PIECE)):
                if too_many <= 0 or piece[-1] == num_steps - 1:
                    break
                node, count = np.unique(self.node[piece], return_counts=True)
                if (left[node] - count >= ENOUGH).all():
                    left[node] -= count
                    too_many -= len(piece)
                    is_kept[piece] = False
        begins[self.start] = True
        begins[1:] |= ~is_kept[:-1]
        rows = (self.observation[is_kept], self.action[is_kept], self.node[is_kept])
        return Memory(*rows, np.flatnonzero(begins[is_kept]), np.array(is_kept.sum()))

    def plus(self, more: "Memory", goes_on: bool = False) -> "Memory":
        """This memory with another's logs behind.

        Args:
            more: other logs.
            goes_on: its first log is what became of the last one, from that one's last step.
        """
        end = len(self.node) - goes_on
        start = np.append(self.start, more.start[int(goes_on) :] + end)
        return Memory(
            np.concatenate([self.observation[:end], more.observation]),
            np.concatenate([self.action[:end], more.action]),
            np.concatenate([self.node[:end], more.node]),
            start,
            self.settled,
        )


def join(
    logs: list[tuple[NDArray[np.int64], NDArray[np.floating], NDArray[np.float32]]],
) -> Memory:
    """Put logs in a row, each given as node (T+1,), observation (T+1, E) and action (T, A)."""
    return Memory(
        np.concatenate([seen for _, seen, _ in logs], dtype=np.float32, casting="same_kind"),
        np.concatenate([np.concatenate([action, action[-1:]]) for *_, action in logs]),
        np.concatenate([node for node, *_ in logs]),
        np.cumsum([0, *(len(node) for node, *_ in logs[:-1])]),
    )
