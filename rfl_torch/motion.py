"""What the log tells about motion: what each choice would lead to, from anywhere in it.

Where a node can't be waited in and no edge can be walked backwards, a map isn't enough to act on:
the same node is passed at many speeds, and one step's action shows only in what follows. So there
a controller knows a short history and looks forward instead of back:

    x_t = (o_t, o_t - o_t-1)                     a situation: where things are, and how they go
    (o_t+1, .., o_t+K) = g_l(x_t, u)             local models, one a landmark, with u held

in place of u_t = f_j(o_t, o_t+1) (eq. 12). Landmarks are situations of the log, evenly spread, and
others that the models say can be reached from them. A choice is held until it has led about two
spacings on, so a landmark is left whatever the speed, as a node is when its edge is taken. A log
that changed its actions sooner teaches shorter models, and one is put after the other.

Where observations show the motion themselves, the landmarks are spread over them alone.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from rfl_torch.memory import Memory, join

Array = NDArray[np.float64]

MAX_CHOICES = 9
"""A log with more distinct actions has continuous ones: no model of each can be learned."""


HORIZON = 12
"""K: control steps that a choice is held for at most. At 20 a pendulum no longer stays upright."""

MOVE = 2.0
"""Landmark spacings that a choice leads on. A fixed 5 steps change too little where all is slow:
what is interpolated between landmarks then blurs more than a choice changes, and plans stand still.
At 3 spacings some pendulums fell that had stood."""

NUM_LANDMARKS = 4000
"""At most."""

NUM_SEEN = 2000
"""Of them, situations of the log."""

SAMPLES_PER_WEIGHT = 6
"""A local model is fitted to that many of the nearest samples for each of its weights."""

NEIGHBORS = 6
"""Landmarks that a situation is interpolated between."""

MIN_SAMPLES = 100
"""Steps that motion can be learned from at all."""

TRUST = 1.5
"""Spacings from the log within which the models are believed: at 3, a tenth of the choices from
imagined landmarks was wrong by over 1 rad/s on the pendulum."""

STRAY = 3.0
"""Spacings from the landmarks from which on a situation counts as off them."""

SHOWN = 0.5
"""Observations show the motion if, with their changes known too, more than this share stays open of
what they leave open of what comes next. It is 0.85 and more with velocities among the readings, up
to 0.14 without."""

UNHEEDED = 1e6
"""Spread of changes that makes them count for nothing."""

RIDGE = 1e-6
"""Of the local fits, whose inputs are of order one: only keeps them solvable."""

FIT_BLOCK = 500
"""Landmarks fitted at once, for memory's sake."""


def remember(logs: list[tuple[Tensor, Tensor, Tensor]]) -> Memory | None:
    """Join recognised logs, each given as node (T+1,), observation (T+1, E) and action (T, A).

    None if they hold too few steps to learn motion from, or too many distinct actions.
    """
    memory = join([(node.numpy(), seen.numpy(), action.numpy()) for node, seen, action in logs])
    if (
        len(_inner_rows(memory, held_steps(memory))) < MIN_SAMPLES
        or len(choices(memory.action)) > MAX_CHOICES
    ):
        return None
    return memory


def remember_more(memory: Memory, node: Tensor, observation: Tensor, action: Tensor) -> Memory:
    """Take one more recognised log into the memory; shapes as in `remember`.

    One whose actions make too many choices is left out.
    """
    longer = memory.plus(join([(node.numpy(), observation.numpy(), action.numpy())]))
    return memory if len(choices(longer.action)) > MAX_CHOICES else longer


def choices(action: NDArray[np.float32]) -> NDArray[np.float32]:
    """The distinct actions (C, A) of a log (T, A): those to choose from."""
    return np.unique(action, axis=0)


class Prospect(NamedTuple):
    """What every choice would lead to, from B situations."""

    trace: Array
    """(B, C, K, 2 E) the situations after 1..K steps."""
    num_steps: NDArray[np.int64]
    """(B, C) steps that the choice is held for, 1..K."""

    @property
    def end(self) -> Array:
        """(B, C, 2 E) the situations that the choices end in."""
        return np.take_along_axis(self.trace, self.num_steps[..., None, None] - 1, 2)[:, :, 0]

    @property
    def is_held(self) -> NDArray[np.bool_]:
        """(B, C, K) whether the choice is still held."""
        return np.arange(1, self.trace.shape[2] + 1) <= self.num_steps[..., None]


class Motion:
    """Landmarks with their local models, and where each choice leads from each of them.

    Distances between situations are taken over `scale`: the observations' spread and that of their
    changes count alike. Where observations show by themselves how things go, as they do with
    velocities among the readings, `is_shown` is True and changes count for nothing.

    Args:
        memory: recognised logs.
    """

    def __init__(self, memory: Memory) -> None:
        self.memory = memory
        self.obs_dim = memory.observation.shape[1]
        self._reach = held_steps(memory)
        rows = _inner_rows(memory, self._reach)
        observation, action = memory.observation.astype(np.float64), memory.action
        now, before = observation[rows], observation[rows - 1]
        self.choices = choices(action[rows])
        spread = [np.maximum(part.std(0).mean(), 1e-9) for part in (now, now - before)]
        self.scale = self._spread = np.repeat(spread, self.obs_dim)
        situation = np.concatenate([now, now - before], 1) / self.scale
        ask = (observation[rows + 1] - now, action[rows], rows)
        blind = left_open(now, *ask)
        self.is_shown = left_open(situation, *ask) > SHOWN * blind
        if self.is_shown:
            self.scale = np.repeat([spread[0], UNHEEDED], self.obs_dim)
            situation = np.concatenate([now, now - before], 1) / self.scale
        self._log_tree, self._log_node = cKDTree(situation), memory.node[rows]
        self._learn_from(rows, situation, observation, action)
        landmark = situation[spread_out(situation, NUM_SEEN)]
        self.spacing = float(cKDTree(landmark).query(landmark, 2)[0][:, 1].mean())
        self._tree, self._weight = cKDTree(landmark), self._fit(landmark)
        self._set_landmarks(self._explore(landmark))

    def _learn_from(
        self,
        rows: NDArray[np.int64],
        situation: Array,
        observation: Array,
        action: NDArray[np.float32],
    ) -> None:
        """Gather the samples whose action was held; of those the models are made."""
        ahead = rows[:, None] + np.arange(self._reach)
        is_held = (action[ahead] == action[rows][:, None]).all((1, 2))
        rows, ahead, situation = rows[is_held], ahead[is_held], situation[is_held]
        held = action[rows]
        self._sample = self._inputs(situation, held)
        change = observation[ahead + 1] - observation[rows][:, None]
        self._sample_change = change.reshape(len(rows), -1)
        # Neighbours in the log are often of one action, and say nothing of what others do.
        kind = ((held[:, None] - self.choices) ** 2).sum(-1).argmin(1)
        self._kinds = [np.flatnonzero(kind == k) for k in np.unique(kind)]
        self._kind_trees = [cKDTree(situation[own]) for own in self._kinds]

    def _inputs(self, scaled: Array, held: NDArray[np.float32]) -> Array:
        """Rows (x_t, u, 1) that the models are linear in; changes count in them in any case."""
        one = np.ones((len(scaled), 1))
        return np.concatenate([scaled * (self.scale / self._spread), held, one], 1)

    def _fit(self, scaled: Array) -> Array:
        """Local linear models around situations (B, 2 E), (B, I, H E), of the H steps ahead.

        Ridge regressions on the nearest samples, as many of each choice.
        """
        each = -(-SAMPLES_PER_WEIGHT * self._sample.shape[1] // len(self._kinds))
        near = np.concatenate(
            [
                own[tree.query(scaled, range(1, min(each, len(own)) + 1))[1]]
                for own, tree in zip(self._kinds, self._kind_trees, strict=True)
            ],
            1,
        )
        blocks = []
        for first in range(0, len(scaled), FIT_BLOCK):
            block = near[first : first + FIT_BLOCK]
            inputs, change = self._sample[block], self._sample_change[block]
            gram = inputs.mT @ inputs + RIDGE * np.eye(inputs.shape[2])
            blocks.append(np.linalg.solve(gram, inputs.mT @ change))
        return np.concatenate(blocks)

    def _explore(self, landmark: Array) -> Array:
        """Add situations that choices lead to, where none is near but the log is."""
        front = landmark
        while len(landmark) < NUM_LANDMARKS:
            prospect = self._prospect(front * self.scale, self._fit(front))
            end = prospect.end.reshape(-1, len(self.scale)) / self.scale
            end = end[self._log_tree.query(end)[0] < TRUST * self.spacing]
            end = end[cKDTree(landmark).query(end)[0] > self.spacing]
            front = apart(end, self.spacing)[: NUM_LANDMARKS - len(landmark)]
            if not len(front):
                break
            landmark = np.concatenate([landmark, front])
        return landmark

    def _set_landmarks(self, landmark: Array) -> None:
        self.landmark = landmark * self.scale
        self._tree, self._weight = cKDTree(landmark), self._fit(landmark)
        self.node = self._log_node[self._log_tree.query(landmark)[1]]
        self.prospect = self._prospect(self.landmark, self._weight)
        num, num_choices = len(landmark), len(self.choices)
        near, weight = self.interpolate(self.prospect.end.reshape(num * num_choices, -1))
        width = near.shape[1]
        self.leads_to = [
            csr_array(
                (
                    weight[choice::num_choices].ravel(),
                    near[choice::num_choices].ravel(),
                    np.arange(num + 1) * width,
                ),
                shape=(num, num),
            )
            for choice in range(num_choices)
        ]

    # -- looking ahead ------------------------------------------------------------------------

    def look_ahead(self, situation: Array) -> Prospect:
        """What every choice leads to from situations (B, 2 E)."""
        nearest = self._tree.query(situation / self.scale)[1]
        return self._prospect(situation, self._weight[nearest])

    def _prospect(self, situation: Array, weight: Array) -> Prospect:
        trace = np.stack([self._hold(situation, weight, choice) for choice in self.choices], 1)
        moved = np.linalg.norm((trace - situation[:, None, None]) / self.scale, axis=-1)
        has_left = moved > MOVE * self.spacing
        has_left[..., -1] = True
        return Prospect(trace, has_left.argmax(-1) + 1)

    def _hold(self, situation: Array, weight: Array, choice: NDArray[np.float32]) -> Array:
        """Situations (B, K, 2 E) while a choice is held, by one local model after the other."""
        parts: list[Array] = []
        for done in range(0, HORIZON, self._reach):
            scaled, now = situation / self.scale, situation[:, None, : self.obs_dim]
            if done:
                weight = self._weight[self._tree.query(scaled)[1]]
            inputs = self._inputs(scaled, np.tile(choice, (len(scaled), 1)))
            change = (inputs[:, None] @ weight)[:, 0].reshape(len(scaled), -1, self.obs_dim)
            course = np.concatenate([now, now + change], 1)
            parts.append(np.concatenate([course[:, 1:], np.diff(course, axis=1)], -1))
            situation = parts[-1][:, -1]
        return np.concatenate(parts, 1)[:, :HORIZON]

    def interpolate(self, situation: Array) -> tuple[NDArray[np.int64], Array]:
        """The landmarks around situations (B, 2 E) and their weights, (B, NEIGHBORS) each."""
        num = min(NEIGHBORS, len(self.landmark))
        distance, near = self._tree.query(situation / self.scale, num)
        distance, near = distance.reshape(-1, num), near.reshape(-1, num)
        # Falls to zero at the furthest, so that the interpolation has no jumps.
        taper = np.maximum(1.0 - (0.999 * distance / distance[:, -1:].clip(1e-12)) ** 2, 1e-6)
        weight = taper / (distance**2 + (0.1 * self.spacing) ** 2)
        return near, weight / weight.sum(1, keepdims=True)

    def stray(self, situation: Array) -> Array:
        """How far situations (..., 2 E) lie off the landmarks, in units of STRAY, from 0 on."""
        distance = self._tree.query(situation / self.scale)[0]
        return np.maximum(distance / (STRAY * self.spacing) - 1.0, 0.0)

    def nearest_node(self, situation: Array) -> NDArray[np.int64]:
        """Node of the log's nearest situation, (...,), for situations (..., 2 E)."""
        return self._log_node[self._log_tree.query(situation / self.scale)[1]]

    def center(self, node: int) -> Array | None:
        """Mean situation of a node's steps in the logs, (2 E,); None if it has none."""
        own: Array = np.asarray(self._log_tree.data)[self._log_node == node]
        return np.asarray(own.mean(0) * self.scale) if len(own) else None


def held_steps(memory: Memory) -> int:
    """For how many steps more, up to K, at least half of the actions of the logs are held."""
    num = len(memory.action)
    is_last = np.append((memory.action[1:] != memory.action[:-1]).any(1), True)
    is_last[memory.start[1:] - 1] = True
    left = np.flatnonzero(is_last)[is_last.cumsum() - is_last] - np.arange(num) + 1
    return int(np.clip(np.quantile(left, 0.5, method="lower"), 1, HORIZON))


def _inner_rows(memory: Memory, ahead: int) -> NDArray[np.int64]:
    """Rows that have an observation before them and so many after them in the same log."""
    ends = [*memory.start[1:].tolist(), len(memory.observation)]
    spans = [
        np.arange(start + 1, end - ahead)
        for start, end in zip(memory.start.tolist(), ends, strict=True)
    ]
    rows = np.concatenate(spans)
    is_missing = np.isnan(memory.observation).any(1).astype(np.int64)
    missing = np.concatenate([[0], is_missing.cumsum()])  # before each row
    return np.asarray(rows[missing[rows + ahead + 1] == missing[rows - 1]])


def left_open(
    situation: Array, change: Array, action: NDArray[np.float32], time: NDArray[np.int64]
) -> float:
    """How far apart what changes next (M, R) is in situations (M, D) that look most alike.

    Each is compared with the nearest of those of the same action (M, A) and another time (M,), by
    the mean absolute difference, each reading over its usual change; NaN if there are none.
    """
    kind = np.unique(action, axis=0, return_inverse=True)[1].ravel()
    parts = []
    for k in range(kind.max() + 1):
        own = np.flatnonzero(kind == k)
        rank = range(1, min(HORIZON, len(own)) + 1)
        near = own[cKDTree(situation[own]).query(situation[own], rank)[1]]
        is_other = np.abs(time[near] - time[own][:, None]) > 2 * HORIZON
        other = near[np.arange(len(own)), is_other.argmax(1)]
        parts.append(np.abs(change[own] - change[other])[is_other.any(1)])
    difference = np.concatenate(parts)
    if not len(difference):
        return np.nan
    return float((difference.mean(0) / np.abs(change).mean(0).clip(1e-12)).mean())


def spread_out(points: Array, num: int) -> NDArray[np.int64]:
    """Indices of `num` of the points, each as far as can be from those before it."""
    num = min(num, len(points))
    chosen, distance = np.zeros(num, np.int64), np.full(len(points), np.inf)
    for i in range(1, num):
        away = points - points[chosen[i - 1]]
        distance = np.minimum(distance, np.einsum("ij,ij->i", away, away))
        chosen[i] = distance.argmax()
    return chosen


def apart(points: Array, distance: float) -> Array:
    """Those points, taken in order, that lie further than `distance` from all taken before."""
    if not len(points):
        return points
    tree, is_left_out = cKDTree(points), np.zeros(len(points), bool)
    taken = []
    for i, point in enumerate(points):
        if not is_left_out[i]:
            taken.append(i)
            is_left_out[tree.query_ball_point(point, distance)] = True
    return points[taken]
