"""The search of one who knows all walls and where it is in them, but not what the log knows.

A yardstick for nodes to go to from anywhere in the room: `python -m experiments.benchmark reach`.
Who is put down off the map calls at points all over the room, the nearest first, until its way
crosses what the log saw. From there it takes the shortest way to the goal. No robot that has to
find out about walls can count on more; where a search happens to begin the right way, it may.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from experiments.scoring import NODE_SPACING, Task
from sims.layouts import Layout
from sims.maze import STEP_LENGTH

CALL_SPACING = 20.0
"""Full steps: every free place is as near as this to a point that is called at. Of 472 tasks in
`hall` 366 come out; with 12 steps, in a tour that is much longer, 205; with 30 352, with 45 364."""


class Tour:
    """Searches of a room for what a log saw of it.

    Args:
        layout: the room.
        seen: (T, 2) where the log was [mm].
    """

    def __init__(self, layout: Layout, seen: NDArray[np.floating]) -> None:
        places = layout.places
        source = np.repeat(np.arange(len(places.points)), np.diff(places.graph.indptr))
        move = np.abs(places.points[places.graph.indices] - places.points[source]).max(1)
        # An action moves the robot by a step in both dimensions at once.
        self._graph = csr_array(
            (move / STEP_LENGTH, places.graph.indices, places.graph.indptr), places.graph.shape
        )
        self._tree = places.tree
        self._is_known = cKDTree(seen).query(places.points)[0] <= NODE_SPACING
        self._call, self._steps, self._next = self._choose_calls(int(self._tree.query(seen[0])[1]))

    def steps(self, task: Task) -> float:
        """Return how many steps a task with a start of its own takes; inf if it can't be done."""
        at, target = (int(self._tree.query(end)[1]) for end in (task.start, task.target))
        to_goal = dijkstra(self._graph, indices=target)
        taken, is_left = 0.0, np.ones(len(self._call), bool)
        while not self._is_known[at]:
            call = int(np.where(is_left, self._steps[:, at], np.inf).argmin())
            if not (is_left[call] and np.isfinite(self._steps[call, at])):
                return np.inf
            way = self._way(call, at)
            if len(known := np.flatnonzero(self._is_known[way])):
                way = way[: known[0] + 1]
            taken += self._steps[call, at] - self._steps[call, way[-1]]
            is_left &= self._steps[:, way].min(1) > CALL_SPACING / 2
            at = int(way[-1])
        return float(taken + to_goal[at])

    def _way(self, call: int, at: int) -> NDArray[np.int64]:
        """Return the places on the way from one of them to a call, both included."""
        way = [at]
        while way[-1] != self._call[call]:
            way.append(int(self._next[call, way[-1]]))
        return np.array(way)

    def _choose_calls(self, first: int) -> tuple[NDArray[np.int64], ...]:
        """Return places far from one another, the steps from all to each, and the next on the way.

        The farthest from all so far is added until none is far. What doesn't hang together with
        `first` is left out.
        """
        call, steps, following = [first], [], []
        while True:
            distance, before = dijkstra(self._graph, indices=call[-1], return_predecessors=True)
            steps.append(distance)
            following.append(before)
            nearest = np.min(steps, 0)
            farthest = int(np.where(np.isfinite(nearest), nearest, 0.0).argmax())
            if nearest[farthest] <= CALL_SPACING:
                return np.array(call), np.array(steps), np.array(following)
            call.append(farthest)
