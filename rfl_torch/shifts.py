"""How far each step of some logs went: what was asked for, or less where a wall stood in the way.

Around each look, the change of the readings is linear in the move. A move is the action, but for
those of its dimensions in which something was in the way, or what is left of two of its dimensions
along a slanted wall:

    c_t = B_l m_t + e_t                e_t Laplace by reading
    m_t = q_t * u_t                    q_td in SHARES, most likely 1
    m_t = (u_t . s) s                  in two dimensions, s in SLIDES

B_l, the noise and the moves are found in turns, first by regressing actions on changes. Where no
reading changes with a dimension of the action, as halfway along a wide corridor, nothing is in
sight that could be in the way there, and what was asked for counts as done.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from rfl_torch.looks import LOOK_STEPS

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

NEAREST = 300
"""Steps around a look that show which change of the readings goes with which move."""

OTHERS = 0.5
"""Weight of the steps there at other looks. Halfway along a hall few steps are told apart, and the
nearest others are where its ends are in sight: there moves along it show."""

FINE = 0.1
"""Steps at which the same was seen, to this share of a full action's usual change, count once: a
robot that is pressed against a wall for long would hide what shows when it comes off it."""

RIDGE = 1e-4
"""Of the actions' regression, as a share of the changes' total variance. A hundred times as much
shortens what is measured of noisy readings until rooms are mixed."""

MOVE_RIDGE = 1e-3
"""Of the changes' regression, as moves of one full action a step."""

SHARES = np.linspace(1.0, 0.0, 11)
"""Of an action's dimension that may have been moved. Fewer, and a slide explains better what was
stopped on the way, by a move along the wall that hardly shows."""

NATS = np.log([0.85, *[0.1 / 9] * 9, 0.05])
"""Log probabilities of the shares."""

SLIDES = np.array([(np.cos(x), np.sin(x)) for x in np.pi / 16 * np.arange(16) if x % (np.pi / 2)])
"""Directions in two dimensions that a wall may have, (S, 2); along one of them shares do."""

SLIDE_NATS = float(np.log(0.1 / len(SLIDES)))
"""Log probability of each."""

BY_BOTH = 1.0
"""Nats that each of its dimensions must explain: where one doesn't show, a wall is in the way of
the other."""

EVIDENCE = 0.25
"""Share of the readings' log likelihoods that counts, for one thing changes many of them."""

TURNS = 3
"""Times that what shows is learned from the likeliest moves, and those by what shows."""

FLOOR = 0.05
"""Of the noise, as a share of a full action's usual change."""


class Shifts(NamedTuple):
    """How far each step of some logs went.

    steps: in full actions, (T, A) for each log.
    misfit: how much the readings changed otherwise than such a move changes them, over the median,
        (T,) for each log. A step that slid around a corner has much, and is wrong.
    shown: share of the actions' variance that the changes of the readings show.
    grip: how much a full action along each dimension changes what is seen at each look, over what
        full actions usually change, at most 1, (L, A).
    """

    steps: list[Array]
    misfit: list[Array]
    shown: float
    grip: Array


def find_shifts(
    looks: list[Labels],
    observations: list[Array],
    unit_actions: list[NDArray[np.float32]],
    radius: float,
) -> Shifts:
    """How far each step went, and how well it shows.

    A reading that jumps, as a ray does that slips past a corner, counts as one that changes by a
    look's radius.

    Args:
        looks: of every observation of each log.
        observations: (T+1, D) each, without missing readings.
        unit_actions: (T, A) each, in [0, 1].
        radius: of a look.
    """
    change = np.concatenate([np.diff(seen, axis=0) for seen in observations])
    change, unit = change.clip(-radius, radius), radius / LOOK_STEPS
    middle = np.concatenate([(seen[1:] + seen[:-1]) / 2 for seen in observations])
    action = np.concatenate([2.0 * actions - 1.0 for actions in unit_actions]).astype(np.float64)
    look = np.concatenate([look[:-1] for look in looks])
    _, told = np.unique((middle / (FINE * unit)).round(), axis=0, return_index=True)
    told_apart = middle[told]
    shift, measured = np.empty_like(action), np.empty_like(action)
    misfit = np.empty(len(action))
    grip = np.ones((max(int(own.max()) for own in looks) + 1, action.shape[1]))
    for own, steps in enumerate(
        np.split(look.argsort(kind="stable"), np.bincount(look).cumsum()[:-1])
    ):
        if not len(steps):
            continue
        away = cdist(np.median(middle[steps], 0)[None], told_apart, "cityblock")[0]
        is_own = look[told] == own
        is_near = is_own.copy()
        is_near[away.argpartition(min(NEAREST, len(away)) - 1)[:NEAREST]] = True
        near, weight = told[is_near], np.where(is_own[is_near], 1.0, OTHERS)
        asked, seen = action[near], change[near]
        gain = _ridge(seen, asked, weight, RIDGE * max(float((weight @ seen**2).sum()), 1e-12))
        measured[steps] = change[steps] @ gain
        moved = np.where((seen @ gain) * asked > 0.5 * asked**2, asked, 0.0)
        shown, noise = _what_shows(moved, seen, weight, unit)
        for _ in range(TURNS):
            before, moved = moved, _likeliest(seen, asked, shown, noise)
            if (moved == before).all():
                break
            shown, noise = _what_shows(moved, seen, weight, unit)
        shift[steps] = _likeliest(change[steps], action[steps], shown, noise)
        misfit[steps] = (np.abs(change[steps] - shift[steps] @ shown) / noise).mean(1)
        grip[own] = np.minimum(1.0, np.abs(shown).mean(1) / unit)
    measured /= np.maximum(1.0, np.abs(measured).max(1, keepdims=True))
    share = 1.0 - float(((action - measured) ** 2).sum() / max((action**2).sum(), 1e-12))
    misfit /= max(float(np.median(misfit)), 1e-12)
    ends = np.cumsum([len(part) for part in unit_actions])[:-1]
    return Shifts(np.split(shift, ends), np.split(misfit, ends), share, grip)


def _ridge(inputs: Array, outputs: Array, weight: Array, penalty: float) -> Array:
    """Weights (I, O) of a ridge regression without a constant, on rows that count so much, (T,)."""
    weighted = inputs.T * weight
    gram = weighted @ inputs + penalty * np.eye(inputs.shape[1])
    return np.asarray(np.linalg.solve(gram, weighted @ outputs))


def _what_shows(moved: Array, seen: Array, weight: Array, unit: float) -> tuple[Array, Array]:
    """Change of the readings for a full action in each dimension, (A, D), and their noise, (D,)."""
    shown = _ridge(moved, seen, weight, MOVE_RIDGE * float(weight.sum()))
    noise = weight @ np.abs(seen - moved @ shown) / weight.sum()
    return shown, noise + FLOOR * unit


@njit(nogil=True, cache=True)
def _likeliest(change: Array, asked: Array, shown: Array, noise: Array) -> Array:
    """The likeliest moves (T, A): each dimension twice with the others as they are, then slides.

    Args:
        change: of the readings, (T, D).
        asked: actions (T, A), in full ones.
        shown: change of the readings for a full action in each dimension, (A, D).
        noise: of each reading, (D,).
    """
    moved, dim = asked.copy(), asked.shape[1]
    change, shown, prior = change / noise, shown / noise, np.empty(dim)
    left = np.empty(len(noise))
    for t in range(len(asked)):
        for turn in range(2 * dim):
            axis = turn % dim
            _explain(left, change[t], moved[t], shown, axis, axis)
            most = -np.inf
            for k in range(len(SHARES)):
                x = asked[t, axis] * SHARES[k]
                own = NATS[k] - _against(left, x, shown[axis], 0.0, shown[axis])
                if own > most:
                    most, moved[t, axis], prior[axis] = own, x, NATS[k]
        for i in range(dim):
            for j in range(i + 1, dim):
                _explain(left, change[t], moved[t], shown, i, j)
                most = prior[i] + prior[j]
                most -= _against(left, moved[t, i], shown[i], moved[t, j], shown[j])
                if most >= SLIDE_NATS:  # no slide is likelier
                    continue
                for k in range(len(SLIDES)):
                    along = asked[t, i] * SLIDES[k, 0] + asked[t, j] * SLIDES[k, 1]
                    x, y = along * SLIDES[k, 0], along * SLIDES[k, 1]
                    miss = _against(left, x, shown[i], y, shown[j])
                    by_one = min(
                        _against(left, x, shown[i], asked[t, j], shown[j]),
                        _against(left, asked[t, i], shown[i], y, shown[j]),
                    )
                    if SLIDE_NATS - miss > most and miss < by_one - BY_BOTH:
                        most, moved[t, i], moved[t, j] = SLIDE_NATS - miss, x, y
                        prior[i] = prior[j] = SLIDE_NATS / 2
    return moved


@njit(nogil=True, cache=True)
def _explain(left: Array, change: Array, moved: Array, shown: Array, i: int, j: int) -> None:
    """What a change of the readings (D,) is but for a move (A,) in all dimensions except two."""
    left[:] = change
    for axis in range(len(moved)):
        if axis not in (i, j):
            for d in range(len(left)):
                left[d] -= moved[axis] * shown[axis, d]


@njit(nogil=True, cache=True, fastmath=True)
def _against(left: Array, x: float, by_x: Array, y: float, by_y: Array) -> float:
    """Nats that a change of the readings speaks against a move.

    Args:
        left: the change that two dimensions of the move must explain, over its noise, (D,).
        x: the move in the first of them, in full actions.
        by_x: change that a full action in it makes, over its noise, (D,).
        y: in the second.
        by_y: by that one.
    """
    miss = 0.0
    for d in range(len(left)):
        miss += abs(left[d] - x * by_x[d] - y * by_y[d])
    return EVIDENCE * miss
