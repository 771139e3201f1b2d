"""How far each step of some logs went: what was asked for, or less where a wall stood in the way.

Around each look, the change of the readings is linear in the move, and a move is the action but for
those of its dimensions in which something was in the way:

    c_t = B_l (q_t * u_t) + e_t        q_td in SHARES, most likely 1; e_t Laplace by reading

B_l, the noise and the shares are found in turns, first by regressing actions on changes. Where no
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

SHARES = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
"""Of an action's dimension that may have been moved."""

NATS = np.log([0.05, 0.05 / 3, 0.05 / 3, 0.05 / 3, 0.9])
"""Log probabilities of the shares."""

EVIDENCE = 0.25
"""Share of the readings' log likelihoods that counts, for one thing changes many of them."""

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
        moved = _likeliest(seen, asked, *_what_shows(moved, seen, weight, unit))
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
    noise = np.average(np.abs(seen - moved @ shown), axis=0, weights=weight)
    return shown, noise + FLOOR * unit


@njit(nogil=True, cache=True)
def _likeliest(change: Array, asked: Array, shown: Array, noise: Array) -> Array:
    """The likeliest moves (T, A), each dimension twice with the others as they are.

    Args:
        change: of the readings, (T, D).
        asked: actions (T, A), in full ones.
        shown: change of the readings for a full action in each dimension, (A, D).
        noise: of each reading, (D,).
    """
    moved, open_ = asked.copy(), np.empty(len(noise))
    dim = asked.shape[1]
    for t in range(len(asked)):
        for turn in range(2 * dim):
            axis = turn % dim
            open_[:] = change[t]
            for other in range(dim):
                if other != axis:
                    open_ -= moved[t, other] * shown[other]
            most = -np.inf
            for k in range(len(SHARES)):
                could = asked[t, axis] * SHARES[k]
                miss = 0.0
                for d in range(len(noise)):
                    miss += abs(open_[d] - could * shown[axis, d]) / noise[d]
                nats = NATS[k] - EVIDENCE * miss
                if nats > most:
                    most, moved[t, axis] = nats, could
    return moved
