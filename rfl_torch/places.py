"""Tell apart places that look the same, by how far the robot went between them.

Two rooms that look exactly alike differ in nothing that a node shows, and EM makes one of them. The
moves between tell them apart: a robot is back where it was only if they add up to nothing. Actions
alone don't say how far it moved, for a wall may have stood in the way; the change of what it saw
does, once the log has shown which change goes with which action.

    shift      how far one step went, in full actions, by the change of what was seen
    track      where each step was: the sum of the shifts, pulled together where places recur
    place      where the track is when a look is seen, give or take PLACE_STEPS

This holds where an action leads as far, and the same way, from one place as from another. Where it
doesn't, as for a robot that turns, the track isn't where it was when a look is seen again: it
doesn't come back.
"""

from collections import deque
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.ndimage import uniform_filter1d
from scipy.sparse import csr_array, diags_array, eye_array, triu
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from rfl_torch.looks import LOOK_STEPS
from rfl_torch.planner import look_alikes
from rfl_torch.shifts import find_shifts

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

PLACE_STEPS = 8.0
"""Full actions within which one look is one place: more than a track drifts before it comes back,
less than what lies between two rooms."""

NODE_STEPS = 5.0
"""Full actions from end to end of a node. Along a wide corridor a look goes on for longer, and a
robot that is told to go there may then stop anywhere in it."""

TWINS = 4.0
"""Nats of separation under which two places, NEAR edges apart at least, look exactly the same:
what is left is by where in the place the robot happened to stand."""

NEAR = 3
"""Edges between two nodes that are one and the same place's surroundings."""

PULL = 0.01
"""Share of the way to a known place's middle that the track is pulled when it comes there."""

SHIFT_ERROR, PLACE_WIDTH = 0.02, 2.0
"""Standard deviations, in full actions, of a shift and of a step from its place's middle."""

USUAL, LARGEST = 1.5, 5.0
"""Misfit up to which a shift is as good as any, and how many times the error of those a shift may
have whose readings fit worse: it grows with the misfit's square. A step that slid around a corner
is off by a third of an action; a few such steps laid all that came after on a second sheet, beside
the first. Without a limit a hall shrinks in such steps."""

PLAIN, LEAST_HOLD = 0.2, 0.03
"""Share of a full action's usual change of the readings by which a move shows plainly, and what a
place holds the track by where none shows. Halfway along a hall a look goes on for so long that the
track shrank to a half of it; with no hold at all, a track that drifted stays so."""

HARDLY = 0.15
"""Hold below which moves hardly show."""

LOOSE = 1e-6
"""Weight of the track as followed, which holds what nothing else does."""

MOST_DRIFT = 18.0
"""Full actions that a track may be off when it comes back from where it never was: less than what
lies between two rooms that look the same."""

OLD = 300
"""Steps since a place was first come to, from which on it is old."""

AGREED, AGREED_SHARE = 40, 0.8
"""Steps at looks with old places, and their share that must agree on how far the track is off,
before it is moved."""

AWAY = 100
"""Steps after which a look that is seen again is come back to."""

MOST_STARTS = 10
"""Of a log, that are tried: those that most of its looks speak for."""

CLEAR = 0.5
"""Share of a log's steps at known looks that must agree with its start for no other to be asked."""

STRANGE = 8.0
"""Weight of a step that saw, at a place, what was never seen near it, nor the like, nor what is
seen right before or after it; the less, the farther it is from any place, up to none at a look's
reach. At a right start none or one in a hundred does, of a robot that went straight through unknown
land 6 (whose looks are new there in 41), and at one in the wrong of two rooms that look alike
many."""

BEND = 101
"""Steps over which a track may drift from another: where a log must begin, is asked of each such
part of it by itself."""

COMES_BACK, NEARER = 3.0, 0.3
"""Full actions that a track may be, when it comes back to a look, from the nearest place of that
look, and share of how far any other step is from it: medians. In mazes it is 1.2 to 2.7, a look's
reach, and 0.03 to 0.28 by their size; for pendulums, cars and robots that turn by a fifth of a
radian a step 3.2 and more. Who turns by a twentieth goes straight for long, and is believed."""

SHOWN = 0.5
"""Least share of the actions' variance that shows in the shifts, for actions to lead somewhere. In
mazes it is 0.78 to 0.93; for a car that stands at the end of its road, 0.03: it comes back, too."""


class Track(NamedTuple):
    """Where each step of some logs was, by the moves between."""

    looks: list[Labels]
    """(T+1,) each, of every observation."""
    shifts: list[Array]
    """(T, A) each, in full actions."""
    errors: list[Array]
    """(T,) each, in full actions: standard deviations of the shifts."""
    followed: list[Array]
    """(T+1, A) each, in full actions."""
    nodes: list[Labels]
    """(T+1,) each: the places as they were come upon."""
    num_places: int
    comes_back: bool
    """Whether a look that is seen again after long is seen where it was, by moves that were asked
    for."""

    hold: Array
    """How much each look holds the track along each dimension, (L, A), 1 where moves show."""

    def positions(self) -> list[Array]:
        """Of every observation on the relaxed track, in full actions, (T+1, A) each.

        A place is as large as a track drifts, and the track is drawn to its middle. Where moves
        hardly show there is next to nothing to hold against that, and a hall would come out too
        short: there it is relaxed anew with nodes for places.
        """
        holds = [self.hold[look] for look in self.looks]
        tracks = relax(self.nodes, self.shifts, self.followed, self.errors, holds)
        # What drifted apart and now lies together is one place: once more, with those.
        nodes = _gather(self.looks, tracks, 2 * PLACE_STEPS)
        tracks = relax(nodes, self.shifts, tracks, self.errors, holds)
        hardly_shows = [hold.min(1) < HARDLY for hold in holds]
        if not np.concatenate(hardly_shows).any():
            return tracks
        num_places = 1 + max(int(node.max()) for node in nodes)
        own = [node + num_places for node in self.split(tracks)]
        parts = zip(hardly_shows, own, nodes, strict=True)
        _, flat = np.unique(
            np.concatenate([np.where(*part) for part in parts]), return_inverse=True
        )
        return relax(np.split(flat, _starts(own)[1:]), self.shifts, tracks, self.errors, holds)

    def split(self, positions: list[Array]) -> list[Labels]:
        """Nodes, one for each look at each of the `positions`' places, int64 (T+1,) each."""
        return _gather(self.looks, positions, NODE_STEPS)


def follow_track(
    looks: list[Labels],
    observations: list[Array],
    unit_actions: list[NDArray[np.float32]],
    radius: float,
    known: Labels | None = None,
) -> Track:
    """Sum up the moves of some logs, and pull them together where places recur.

    Args:
        looks: of every observation of each log.
        observations: (T+1, D) each, without missing readings.
        unit_actions: (T, A) each, in [0, 1].
        radius: of a look.
        known: nodes of the first of these steps, from when they were laid out last. Their logs
            begin where those say, the others where most of their looks were seen.
    """
    shifts, misfit, shown, grip = find_shifts(looks, observations, unit_actions, radius)
    errors = [SHIFT_ERROR * np.clip((own / USUAL) ** 2, 1.0, LARGEST) for own in misfit]
    hold = np.clip((grip / PLAIN) ** 2, LEAST_HOLD, 1.0)
    come_to = KnownPlaces(hold, _much_alike(looks, observations, radius))
    starts: list[Array | None] = [None] * len(looks)
    if known is not None and len(known):
        starts = find_known_starts(known, shifts, errors)
    tracks, nodes = come_to.follow_all(looks, shifts, starts)
    used, flat = np.unique(np.concatenate(nodes), return_inverse=True)  # some were moved away from
    nodes = np.split(flat, _starts(nodes)[1:])
    comes_back = come_to.comes_back() and shown > SHOWN
    return Track(looks, shifts, errors, tracks, nodes, len(used), comes_back, hold)


class KnownPlaces:
    """The places that a track has come to: a look and a position each.

    Args:
        hold: how much each look holds the track along each dimension, (L, A), 1 where moves show.
        alike: looks that may be seen at one place, bool (L, L); only each itself if None.
    """

    def __init__(self, hold: Array, alike: csr_array | None = None) -> None:
        num_looks, dim = hold.shape
        self._hold = hold
        self._beside = csr_array(eye_array(num_looks)) if alike is None else alike
        self.look: list[int] = []
        self._of_look: list[list[int]] = [[] for _ in range(num_looks)]
        self._sum = np.zeros((64, dim))
        self._count = np.zeros(64)
        self._born: list[int] = []
        self._num_steps = 0
        self._last = np.full(num_looks, -1)
        self._returns: list[tuple[float, float]] = []

    @property
    def position(self) -> Array:
        """Mean of the track at each place, (N, A)."""
        num = len(self.look)
        return self._sum[:num] / self._count[:num, None]

    def follow(self, look: Labels, shift: Array, start: Array) -> tuple[Array, Labels]:
        """Go along a log from `start` (A,); returns its track (T+1, A) and its places (T+1,)."""
        track, node = np.empty((len(look), len(start))), np.empty(len(look), np.int64)
        here = start
        missed: deque[tuple[int, Array, bool]] = deque(maxlen=AGREED)
        for t in range(len(look)):
            if t > 0:
                here = here + shift[t - 1]
            own = int(look[t])
            if (off := self._off(own, here)) is not None:
                if (drift := _agreed(missed)) is not None:
                    here = here + drift
                    for step, *_ in missed:
                        node[step], _ = self._visit(int(look[step]), track[step] + drift)
                    missed.clear()
                else:
                    missed.append((t, off, bool(off @ off > (PLACE_STEPS / 2) ** 2)))
            if self._last[own] >= 0 and self._num_steps - self._last[own] > AWAY:
                self._returns.append((self._away(own, here), self._away(own, track[t // 2])))
            self._last[own] = self._num_steps
            self._num_steps += 1
            node[t], here = self._visit(own, here)
            track[t] = here
        return track, node

    def _off(self, look: int, here: Array) -> Array | None:
        """From a position to the nearest old place of a look, (A,); None if none is near."""
        places = [k for k in self._of_look[look] if self._num_steps - self._born[k] > OLD]
        if not places:
            return None
        _, way, length = self._nearest(places, here)
        return way if length < MOST_DRIFT else None

    def _nearest(self, places: list[int], here: Array) -> tuple[int, Array, float]:
        """Of some places the nearest to a position (A,), the way there (A,), and its length."""
        way = self._sum[places] / self._count[places, None] - here
        length = np.linalg.norm(way, axis=1)
        nearest = int(length.argmin())
        return places[nearest], way[nearest], float(length[nearest])

    def comes_back(self) -> bool:
        """Whether looks seen again after long were near their places, much nearer than others."""
        if not self._returns:
            return False
        away, others = np.median(self._returns, axis=0)
        return bool(away < min(COMES_BACK, NEARER * others))

    def _away(self, look: int, here: Array) -> float:
        """Distance of a position from the nearest place of a look, which has one."""
        return self._nearest(self._of_look[look], here)[2]

    def _visit(self, look: int, here: Array) -> tuple[int, Array]:
        """The place of a look at a position, a new one if need be; and the position, corrected."""
        places = self._of_look[look]
        node, way, length = self._nearest(places, here) if places else (-1, here, np.inf)
        if length < PLACE_STEPS:
            here = here + PULL * self._hold[look] * way
        else:
            node = len(self.look)
            self.look.append(look)
            self._born.append(self._num_steps)
            places.append(node)
            if node == len(self._count):
                self._sum = np.concatenate([self._sum, np.zeros_like(self._sum)])
                self._count = np.concatenate([self._count, np.zeros_like(self._count)])
        self._sum[node] += here
        self._count[node] += 1
        return node, here

    def follow_all(
        self, looks: list[Labels], shifts: list[Array], starts: list[Array | None]
    ) -> tuple[list[Array], list[Labels]]:
        """Go along logs, first those whose `starts` are known; returns tracks and places of each.

        The others follow in the order in which they show what is known by then: a log of a room
        comes after the one that leads there, whichever was written first.
        """
        parts = [
            None if start is None else self.follow(look, shift, start)
            for look, shift, start in zip(looks, shifts, starts, strict=True)
        ]
        waiting = {
            k: _Waiting(looks[k], shifts[k], self._hold) for k, part in enumerate(parts) if not part
        }
        log = np.repeat(np.arange(len(looks)), [len(look) for look in looks])
        seen = csr_array((np.ones(len(log)), (log, np.concatenate(looks))))
        seen.resize((len(looks), len(self._hold)))
        self._beside = csr_array(self._beside + within(sum_edges(looks, len(self._hold)), 1) > 0)
        while waiting:
            k, start = self._next(waiting, seen)
            del waiting[k]
            parts[k] = self.follow(looks[k], shifts[k], start)
        tracks, nodes = zip(*(part for part in parts if part), strict=True)
        return list(tracks), list(nodes)

    def _next(self, waiting: dict[int, "_Waiting"], seen: csr_array) -> tuple[int, Array]:
        """Of the logs that wait, the one that agrees in most steps with what is known; its start.

        The first that agrees in most of what it might is as good.

        Args:
            waiting: by their numbers.
            seen: how often each log saw each look.
        """
        first = next(iter(waiting))
        if not self.look:
            return first, np.zeros(self._hold.shape[1])
        num_places = np.array([len(own) for own in self._of_look])
        might, num_known = seen @ (num_places > 0), seen.sign() @ num_places
        numbers = np.array(list(waiting))
        numbers = numbers[might[numbers] > 0]
        best = None
        for k in numbers[might[numbers].argsort(kind="stable")[::-1]].tolist():
            log = waiting[k]
            if log.num_known != num_known[k]:
                log.num_known = num_known[k]
                log.start, log.agreement = self.find_start(*log.places)
            if best is None or log.agreement > waiting[best].agreement:
                best = k
            if log.agreement > CLEAR * might[k]:
                break
        if best is not None and waiting[best].agreement > 0:
            return best, waiting[best].start
        return first, self.position.max(0) + 100 * PLACE_STEPS + waiting[first].length

    def find_start(self, own: "KnownPlaces", path: Labels) -> tuple[Array, float]:
        """Where a log must begin, (A,), for most of its looks to be seen at known places.

        Args:
            own: places of the log, begun at 0, one of whose looks is known.
            path: those of its steps, (T+1,).

        Returns:
            The start, and the steps that agree with it, less those that don't.
        """
        pairs = [(i, j) for j, one in enumerate(own.look) for i in self._of_look[one]]
        there, here = np.array(pairs).T
        offset = self.position[there] - own.position[here]
        vote = np.minimum(self._count[there], own._count[here])
        near = cKDTree(offset).query_ball_point(offset, PLACE_STEPS / 2)
        starts: list[Array] = []
        left = np.array([vote[part].sum() for part in near])
        while left.max() > 0 and len(starts) < MOST_STARTS:
            best = near[int(left.argmax())]
            starts.append(np.average(offset[best], axis=0, weights=vote[best]))
            left[best] = 0.0
        agreement = [self._agreement(own, self._bend(own, path, start)) for start in starts]
        best = int(np.argmax(agreement))
        return starts[best], agreement[best]

    def _bend(self, other: "KnownPlaces", path: Labels, start: Array) -> Array:
        """Places of another track, begun at `start`, moved with those of BEND steps around, (N, A).

        Each as far as these are from the places of their looks: by a map that drifted by a few
        actions a robot in a passage would have been on the other side of a wall.

        Args:
            other: the track's places, begun at 0.
            path: those of its steps, (T+1,).
            start: of the track, (A,).
        """
        position = other.position + start
        away = np.full_like(position, np.nan)
        for own, look in enumerate(other.look):
            if places := self._of_look[look]:
                _, way, length = self._nearest(places, position[own])
                if length < PLACE_STEPS:
                    away[own] = way
        has_place = ~np.isnan(away[path]).any(1)
        near = uniform_filter1d(has_place.astype(np.float64), BEND, mode="constant")
        off = uniform_filter1d(np.nan_to_num(away[path]), BEND, axis=0, mode="constant")
        # Running means: a part without any place may have a share of 1e-17 of them.
        moved = np.divide(
            off, near[:, None], out=np.zeros_like(off), where=near[:, None] > 0.5 / BEND
        )
        return position + middles(path, [moved], len(position))

    def _agreement(self, other: "KnownPlaces", position: Array) -> float:
        """Steps of another track that saw what is known to be seen where they were.

        Less those, STRANGE times at most, that saw what was never seen near, nor anything like or
        beside that, where others were: in one of several rooms that look alike, most of what a
        robot sees fits the wrong one, too. But where two tracks cross, each saw few of the looks
        there.

        Args:
            other: the track's places.
            position: where they are, (N, A).
        """
        steps = other._count[: len(other.look)]
        tree, look = cKDTree(self.position), np.array(self.look)
        away, _ = tree.query(position)
        around = tree.query_ball_point(position, PLACE_STEPS)
        step = np.repeat(np.arange(len(around)), [len(near) for near in around])
        own, there = np.array(other.look)[step], look[np.concatenate(around).astype(np.int64)]
        known, fits = np.zeros((2, len(around)), bool)
        known[step[own == there]] = True
        fits[step[self._beside[own, there] > 0]] = True
        strange = ~fits * (1 - away / LOOK_STEPS).clip(0.0)
        return float(steps[known].sum() - STRANGE * steps @ strange)


def _much_alike(looks: list[Labels], observations: list[Array], radius: float) -> csr_array:
    """Looks whose mean sights are within a look's radius of each other, bool (L, L).

    Within 1.5 a room counts for another that looks alike but for a ray or two.
    """
    look = np.concatenate(looks)
    num_looks = int(look.max()) + 1
    mean = middles(look, observations, num_looks)
    return _close(mean, radius * mean.shape[1], p=1.0)


class _Waiting:
    """A log that is to be laid out, and where it must begin by what is known so far."""

    def __init__(self, look: Labels, shift: Array, hold: Array) -> None:
        self._log = look, shift, hold
        self.length = float(np.abs(shift).sum())
        self.num_known = 0.0  # places of its looks when it was asked last
        self.start, self.agreement = np.zeros(hold.shape[1]), -np.inf

    @cached_property
    def places(self) -> tuple[KnownPlaces, Labels]:
        """Its own, begun at 0, and those of its steps (T+1,)."""
        look, shift, hold = self._log
        own = KnownPlaces(hold)
        _, path = own.follow(look, shift, np.zeros(hold.shape[1]))
        return own, path


def find_known_starts(
    known: Labels, shifts: list[Array], errors: list[Array]
) -> list[Array | None]:
    """Where the logs begin of whose steps nodes (M,) are known, (A,) each; the first of them at 0.

    All of them at once, by the shifts and by the nodes that they have in common: a log inside one
    of several rooms that look the same can't be found by its looks. None for those that have no
    node in common with most of them, even by others, and for logs of whose steps none is known.
    """
    length = [len(shift) + 1 for shift in shifts]
    log = np.repeat(np.arange(len(shifts)), length)
    own_places = np.arange(len(log) - len(known)) + known.max() + 1  # for each new step one
    _, node = np.unique(np.concatenate([known, own_places]), return_inverse=True)
    num_logs = int(log[len(known) - 1]) + 1
    seen_by = csr_array((np.ones(len(log)), (log, node)))
    _, part = connected_components(seen_by @ seen_by.T, directed=False)
    nowhere = [np.zeros((num, shifts[0].shape[1])) for num in length]
    tracks = relax(np.split(node, np.cumsum(length)[:-1]), shifts, nowhere, errors)
    most = np.bincount(part[:num_logs], weights=length[:num_logs]).argmax()
    is_found = (part == most) & (np.arange(len(shifts)) < num_logs)
    origin = tracks[int(is_found.argmax())][0]
    return [
        track[0] - origin if is_own else None
        for track, is_own in zip(tracks, is_found, strict=True)
    ]


def _agreed(missed: deque[tuple[int, Array, bool]]) -> Array | None:
    """How far a track is off by what the last steps missed, (A,); None if it isn't, or unclear."""
    if len(missed) < AGREED:
        return None
    if sum(is_far for *_, is_far in missed) <= AGREED_SHARE * AGREED:
        return None  # the medians below say the same, and take fifty times as long
    off = np.array([own for _, own, _ in missed])
    drift = np.median(off, 0)
    is_alike = np.linalg.norm(off - drift, axis=1) < PLACE_STEPS / 2
    return drift if np.linalg.norm(drift) > PLACE_STEPS and is_alike.mean() > AGREED_SHARE else None


def relax(
    nodes: list[Labels],
    shifts: list[Array],
    tracks: list[Array],
    errors: list[Array],
    holds: list[Array] | None = None,
) -> list[Array]:
    """Tracks that agree best with the shifts and with a position for each place, by least squares.

    Args:
        nodes: places of every step of each log, (T+1,).
        shifts: (T, A) each.
        tracks: as followed, (T+1, A) each.
        errors: standard deviations of the shifts, (T,) each.
        holds: how much each step's place holds it along each dimension, (T+1, A) each; 1 if None.
    """
    node, track = np.concatenate(nodes), np.concatenate(tracks)
    hold = np.ones_like(track) if holds is None else np.concatenate(holds)
    num_steps, num_nodes = len(node), int(node.max()) + 1
    size = num_steps + num_nodes
    step = np.arange(num_steps)
    before = np.delete(step, np.cumsum([len(part) for part in nodes]) - 1)
    chain = _differences(before, before + 1, size)
    place = _differences(num_steps + node, step, size)
    loose = np.concatenate([np.full(num_steps, LOOSE), np.zeros(num_nodes)])
    pull = chain.T @ diags_array(np.concatenate(errors) ** -2.0)
    stiff = pull @ chain + diags_array(loose)
    right = pull @ np.concatenate(shifts)
    right[:num_steps] += LOOSE * track
    solved = np.empty_like(track)
    for axis, own in enumerate(hold.T):
        normal = stiff + place.T @ diags_array(own / PLACE_WIDTH**2) @ place
        solved[:, axis] = spsolve(normal.tocsc(), right[:, axis], "MMD_AT_PLUS_A")[:num_steps]
    return np.split(solved, _starts(nodes)[1:])


def keep_origin(positions: list[Array], before: Array, num_first: int) -> list[Array]:
    """Positions (T+1, A) each, shifted so that what was at a spot is there still.

    By what moves as the first log does: pieces of the map that found their place move otherwise.

    Args:
        positions: of all steps.
        before: of the first of these steps, from when they were laid out last, (M, A).
        num_first: steps of the first log.
    """
    moved = np.concatenate(positions)[: len(before)] - before
    away = np.linalg.norm(moved - np.median(moved[:num_first], axis=0), axis=1)
    shift = np.median(moved[away < PLACE_STEPS], axis=0)
    return [own - shift for own in positions]


def middles(node: Labels, positions: list[Array], num_nodes: int) -> Array:
    """Mean position (or sight) of the steps (T,) of each node, (N, A); 0 of one without."""
    position = np.concatenate(positions)
    total = np.zeros((num_nodes, position.shape[1]))
    np.add.at(total, node, position)
    return np.asarray(total / np.bincount(node, minlength=num_nodes).clip(1)[:, None])


def _differences(before: Labels, after: Labels, size: int) -> csr_array:
    """Rows that subtract one of `size` unknowns from another."""
    row = np.tile(np.arange(len(before)), 2)
    sign = np.repeat([-1.0, 1.0], len(before))
    return csr_array((sign, (row, np.concatenate([before, after]))), shape=(len(before), size))


def _starts(parts: list[Labels]) -> Labels:
    """Where each part begins among all."""
    return np.cumsum([0] + [len(part) for part in parts[:-1]])


def _gather(looks: list[Labels], tracks: list[Array], most: float) -> list[Labels]:
    """Number the places: steps of one look, no two of them more than `most` apart on the track."""
    look, track = np.concatenate(looks), np.concatenate(tracks)
    node, num_nodes = np.empty(len(look), np.int64), 0
    for steps in np.split(look.argsort(kind="stable"), np.bincount(look).cumsum()[:-1]):
        if not len(steps):
            continue
        spot, inverse = np.unique(track[steps].round(), axis=0, return_inverse=True)
        apart, place = pdist(spot), np.ones(len(spot), np.int64)
        if apart.max(initial=0.0) > most:
            place = fcluster(linkage(apart, "complete"), most, "distance").astype(np.int64)
        node[steps] = num_nodes + place[inverse.ravel()] - 1
        num_nodes += int(place.max())
    return np.split(node, _starts(looks)[1:])


def find_twins(mean: Array, scale: Array, power: float, near: csr_array) -> csr_array:
    """Pairs of nodes that look the same at different places, bool (N, N).

    Args:
        mean: of the nodes, (N, D).
        scale: of the nodes, (N, D).
        power: of the emission densities.
        near: pairs that are at one place, bool (N, N).
    """
    alike = look_alikes(mean, scale, power, TWINS)
    return csr_array(alike - alike.multiply(near) > 0)


def match_twins(twins: csr_array, mean: Array, scale: Array, edges: csr_array) -> csr_array:
    """The twins that look more alike than one of them and what is near the other.

    Along a corridor each node looks somewhat like several of another corridor.
    """
    i, j = triu(twins).coords
    apart = ((mean[i] - mean[j]) ** 2 / (scale[i] ** 2 + scale[j] ** 2)).sum(1)
    near = within(edges, NEAR)
    around = np.split(near.indices, near.indptr[1:-1])
    kept: list[tuple[int, int]] = []
    worse: set[tuple[int, int]] = set()
    for pair in apart.argsort(kind="stable"):
        a, b = int(i[pair]), int(j[pair])
        if (a, b) in worse:
            continue
        kept += [(a, b), (b, a)]
        others = [(a, int(other)) for other in around[b]] + [(int(other), b) for other in around[a]]
        worse.update((min(both), max(both)) for both in others)
    rows, columns = np.array(kept, np.int64).reshape(-1, 2).T
    return csr_array((np.ones(len(rows), bool), (rows, columns)), shape=twins.shape)


def sum_edges(paths: list[Labels], num_nodes: int) -> csr_array:
    """How often the paths go from one node to another, or stay, (N, N)."""
    source = np.concatenate([path[:-1] for path in paths])
    target = np.concatenate([path[1:] for path in paths])
    ones = np.ones(len(source))
    return csr_array((ones, (source, target)), shape=(num_nodes, num_nodes))


def within(edges: csr_array, most: int) -> csr_array:
    """Nodes with at most so many edges between them, either way, the node itself among them."""
    step = csr_array((edges + edges.T + eye_array(edges.shape[0])) > 0).astype(np.float64)
    near = step
    for _ in range(most - 1):
        near = csr_array(near @ step > 0).astype(np.float64)
    return csr_array(near > 0)


def surroundings(edges: csr_array, positions: Array | None, most: float = NODE_STEPS) -> csr_array:
    """Nodes that are one and the same place's surroundings, bool (N, N).

    Those NEAR edges apart at most, and, where nodes have positions, those not far apart: no log may
    have gone from one to the other.

    Args:
        edges: how often the logs took each, (N, N).
        positions: of the nodes, in full actions, (N, A); None if actions don't add up to any.
        most: full actions that they may be apart.
    """
    near = within(edges, NEAR)
    if positions is None:
        return near
    return csr_array(near + _close(positions, most) > 0)


def _close(points: Array, most: float, p: float = 2.0) -> csr_array:
    """Points (N, D) at most so far apart by the p-norm, each itself among them, bool (N, N)."""
    i, j = cKDTree(points).query_pairs(most, p, output_type="ndarray").T
    pairs = csr_array((np.ones(len(i), bool), (i, j)), shape=(len(points), len(points)))
    return csr_array(pairs + pairs.T + eye_array(len(points)) > 0)


def find_telling(twins: csr_array, edges: csr_array, positions: Array | None) -> Labels:
    """Nodes at which a robot can tell where it is: no place looks like them, as far as is known.

    What lies behind one of two places that look the same may lie behind the other too, if no log
    went on there. So of the parts of the map without twins those count beside which, for more than
    a half, it is known what lies there beside the twin; or the larger ones if there is none. Of
    their nodes, those NEAR edges away from all twins, if there are any. All nodes, if there are no
    twins, or if nothing is left.

    Args:
        twins: pairs of nodes that look the same, (N, N).
        edges: how often the logs took each, (N, N).
        positions: of the nodes, in full actions, (N, A); None if actions don't add up to any.
    """
    has_twin = twins.sum(1) > 0
    if not has_twin.any():
        return np.arange(len(has_twin))
    alone, part = _parts(edges, has_twin, 1)
    far, far_part = _parts(edges, has_twin, NEAR)
    told = alone[_is_told(alone, part, twins, edges, positions)[part]]
    if len(told):
        return np.intersect1d(told, far) if np.isin(told, far).any() else told
    if not len(far):
        return np.arange(len(has_twin))
    size = np.bincount(far_part)[far_part]
    return np.asarray(far[2 * size >= size.max()])


def _is_told(
    alone: Labels, part: Labels, twins: csr_array, edges: csr_array, positions: Array | None
) -> NDArray[np.bool_]:
    """Whether it is known what lies beside the twins of what each part lies beside, (P,).

    It is where the part lies beside the twin too, and where a node is as far from the twin, in the
    same direction, as the part is from the other.

    Args:
        alone: nodes without twins, (M,).
        part: that each is in, (M,).
        twins: pairs of nodes that look the same, (N, N).
        edges: how often the logs took each, (N, N).
        positions: of the nodes, (N, A), or None.
    """
    first, second = twins.nonzero()
    twin, number = np.unique(first, return_inverse=True)
    room = connected_components(edges[twin][:, twin], directed=False)[1]
    own, other = room[number], room[np.searchsorted(twin, second)]
    pair, inside = within(edges, 2)[first][:, alone].nonzero()
    beside = part[inside]
    leads_to = np.zeros((int(part.max(initial=-1)) + 1, int(room.max()) + 1), bool)
    leads_to[beside, own[pair]] = True
    is_known = (own != other)[pair] & leads_to[beside, other[pair]]
    if positions is not None:
        way = positions[alone[inside]] - positions[first[pair]]
        away, _ = cKDTree(positions).query(positions[second[pair]] + way)
        is_known |= away <= NODE_STEPS / 2
    num = np.bincount(beside, minlength=len(leads_to))
    return np.asarray(np.bincount(beside[is_known], minlength=len(leads_to)) > num / 2)


def _parts(edges: csr_array, has_twin: NDArray[np.bool_], away: int) -> tuple[Labels, Labels]:
    """Nodes more than so many edges from all twins, and which of them hang together."""
    (alone,) = np.nonzero(within(edges, away) @ has_twin.astype(np.float64) == 0)
    return alone, connected_components(edges[alone][:, alone], directed=False)[1]
