"""Floor plans of the maze: reading, checking and measuring them. Lengths are millimetres.

A plan is a JSON file; the outer walls are added, and `start` null means any free place:

    {"size": [1000, 600], "walls": [[250, 0, 250, 380], [250, 380, 420, 380]], "start": [320, 500]}

A plan may come from anyone, so nothing in it is believed before it is checked.
"""

import json
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

ROBOT_RADIUS = 27.5  # mm
WALL_THICKNESS = 4.0  # mm; a segment of the plan is the wall's middle line
TOLERANCE = 1e-6  # mm; a robot that touches a wall is still free

GRID_PITCH = 10.0  # mm between the places that paths are made of
MAX_PLACES = 200_000  # above it the pitch grows: a few hundred MB for the largest path search

MAX_FILE_BYTES = 1_000_000
MAX_SIZE = 100_000.0  # mm
MAX_WALLS = 10_000

BUILT_IN = Path(__file__).parent / "layouts"

# Moves of up to three places each way, 32 directions: no path is more than 1.4 % too long.
_MOVES = [
    (i, j) for i in range(4) for j in range(-3, 4) if math.gcd(i, j) == 1 and (i > 0 or j > 0)
]


class Places(NamedTuple):
    """The free places of a regular grid and which of them hang together."""

    points: Array
    """(P, 2) positions [mm]."""
    number: NDArray[np.int64]
    """(columns, rows) number of the place in each grid node; -1 where there is none."""
    graph: csr_array
    """(P, P) lengths of the moves between neighbours [mm]."""
    region: NDArray[np.int64]
    """(P,) number of the connected region."""
    tree: cKDTree
    """Nearest places to a position."""
    pitch: float
    """Grid pitch [mm]."""


@dataclass(frozen=True, eq=False)
class Layout:
    """The floor plan of a room, seen by a disc-shaped robot.

    The room is `[0, size[0]] x [0, size[1]]` mm; its outer walls stand outside that rectangle.
    An inner wall is `WALL_THICKNESS` thick and reaches half of that beyond its end points, so
    that two walls which share an end point leave no notch.
    """

    name: str
    size: tuple[float, float]
    """Width and height [mm]."""
    walls: Array
    """(W, 4) inner walls x0, y0, x1, y1 [mm]."""
    start: tuple[float, float] | None
    """Where the robot starts [mm]; None for any free place."""

    @cached_property
    def solid_walls(self) -> Array:
        """(W + 4, 4) middle lines of all walls, the outer ones last [mm]."""
        (width, height), half = self.size, WALL_THICKNESS / 2
        left, right, bottom, top = -half, width + half, -half, height + half
        outer = [
            [left, bottom, right, bottom],
            [right, bottom, right, top],
            [right, top, left, top],
            [left, top, left, bottom],
        ]
        return np.concatenate([self.walls, np.array(outer)])

    def clearance(self, position: ArrayLike) -> Array:
        """Return how far each position (..., 2) is from the nearest wall; 0 inside a wall [mm]."""
        position = np.asarray(position, np.float64)
        width, height = self.size
        x, y = position[..., 0], position[..., 1]
        outer = np.minimum(np.minimum(x, width - x), np.minimum(y, height - y))
        clearance = np.maximum(outer, 0.0)
        if len(self.walls):
            inner = _distance_to_walls(position[..., None, :], self.walls).min(-1)
            clearance = np.minimum(clearance, inner)
        return clearance

    def is_free(self, position: ArrayLike, radius: float = ROBOT_RADIUS) -> bool:
        """Return whether a disc of `radius` [mm] at `position` touches no wall from inside."""
        return bool(self.clearance(position) >= radius - TOLERANCE)

    def is_way_free(self, a: ArrayLike, b: ArrayLike, radius: float = ROBOT_RADIUS) -> bool:
        """Return whether a disc can go from `a` straight to `b` without touching a wall."""
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        # Half of the radius apart, two free discs leave a nick of 3 % of the radius at most.
        steps = max(2, math.ceil(float(np.hypot(*(b - a))) / (radius / 2)) + 1)
        return bool((self.clearance(np.linspace(a, b, steps)) >= radius - TOLERANCE).all())

    def random_free_position(
        self, rng: np.random.Generator, radius: float = ROBOT_RADIUS
    ) -> tuple[float, float]:
        """Return a uniformly random place [mm], free and connected with the start.

        Raises:
            ValueError: if no such place has room for `radius`.
        """
        places = self.places
        reachable = np.flatnonzero(places.region == self._main_region)
        for _ in range(1000):
            jitter = rng.uniform(-0.5, 0.5, 2) * places.pitch
            position = places.points[rng.choice(reachable)] + jitter
            if self.is_free(position, radius):
                return float(position[0]), float(position[1])
        raise ValueError(
            f"layout {self.name!r} showed no place for a disc of radius {radius} mm in 1000 "
            "draws; ask for a smaller radius or widen its corridors."
        )

    def free_cells(self, cell: float) -> Array:
        """Return the centres (C, 2) of the cells that the robot can stand in and reach [mm].

        Args:
            cell: side of a square cell [mm]; cells start at the corner (0, 0), and those cut by
                the far walls count when their centre is in the room.
        """
        if not cell > 0:
            raise ValueError(f"cell is {cell}; the side of a cell must be above 0 mm, e.g. 44.")
        axes = [np.arange(cell / 2, length, cell) for length in self.size]
        centres = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
        regions = [self._region(centre) for centre in centres]
        return centres[[region == self._main_region for region in regions]]

    def shortest_path_length(self, a: ArrayLike, b: ArrayLike) -> float:
        """Return the length of the robot's shortest way from `a` to `b` [mm]; inf if none.

        Exact where the straight way is free; elsewhere a grid path, right to about 2 %.

        Raises:
            ValueError: if the robot cannot stand at one of the two.
        """
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        for point in (a, b):
            if not self.is_free(point):
                raise ValueError(
                    f"the robot cannot stand at {point.tolist()} mm in layout {self.name!r}: "
                    f"a wall is closer than {ROBOT_RADIUS} mm; test with is_free first."
                )
        if self.is_way_free(a, b):
            return float(np.hypot(*(b - a)))
        source, target = self._anchor(a), self._anchor(b)
        if source is None or target is None:
            return math.inf
        # Stepping onto the grid and off it lengthens and shortens the way equally often.
        return float(self._distances_from(source)[target])

    @cached_property
    def places(self) -> Places:
        """The free places of the room, and the moves between them; in any region."""
        return _free_places(self)

    @cached_property
    def _main_region(self) -> int | None:
        """The region of the start, or the largest one; None if nothing is free."""
        if self.start is not None:
            return self._region(np.array(self.start))
        region = self.places.region
        return int(np.bincount(region).argmax()) if len(region) else None

    @cached_property
    def _distances_from(self) -> Any:
        graph = self.places.graph
        # Symmetric by construction; 64 sources are enough for the goals of one evaluation.
        return lru_cache(maxsize=64)(lambda source: dijkstra(graph, indices=source))

    def _anchor(self, position: Array) -> int | None:
        """Return the nearest place that the robot can reach from `position` straight."""
        points = self.places.points
        if not len(points):
            return None
        for place in self.places.tree.query(position, k=min(16, len(points)))[1].reshape(-1):
            # Half of the radius: in a gap as wide as the robot, grid places are a bit too close.
            if self.is_way_free(position, points[place], ROBOT_RADIUS / 2):
                return int(place)
        return None

    def _region(self, position: Array) -> int | None:
        place = self._anchor(position) if self.is_free(position) else None
        return None if place is None else int(self.places.region[place])


def load_layout(layout: str | Path) -> Layout:
    """Return the built-in layout of that name, or the one in that JSON file.

    Raises:
        ValueError: if there is none, or the file is not a layout; names the file and the fault.
    """
    path = BUILT_IN / f"{layout}.json"
    if str(layout) not in built_in_layouts():
        path = Path(layout)
        if not path.is_file():
            names = ", ".join(built_in_layouts())
            raise ValueError(
                f"layout {str(layout)!r} is neither built in nor a file; "
                f"pass one of {names}, or the path of a JSON file."
            )
    try:
        return _parse(path.stem, _read_json(path))
    except (OSError, ValueError, RecursionError) as error:  # deep nesting ends json in recursion
        raise ValueError(f"{path} is not a layout: {error}") from error


def built_in_layouts() -> list[str]:
    """Return the names of the layouts that come with the package."""
    return sorted(path.stem for path in BUILT_IN.glob("*.json"))


def _read_json(path: Path) -> Any:
    with path.open("rb") as file:
        content = file.read(MAX_FILE_BYTES + 1)  # a size asked for beforehand may have changed
    if len(content) > MAX_FILE_BYTES:
        raise ValueError(f"it is larger than {MAX_FILE_BYTES} bytes; use fewer walls.")
    return json.loads(content)


def _parse(name: str, plan: Any) -> Layout:
    if not isinstance(plan, dict) or not {"size", "walls"} <= plan.keys():
        found = sorted(map(str, plan))[:5] if isinstance(plan, dict) else type(plan).__name__
        raise ValueError(
            f'found {found}; it needs an object with the keys "size", "walls" and "start".'
        )
    width, height = _numbers(plan["size"], 2, "size")
    if not (0 < width <= MAX_SIZE and 0 < height <= MAX_SIZE):
        raise ValueError(
            f"size is [{width:g}, {height:g}]; each side must be above 0 and at most "
            f"{MAX_SIZE:g} mm."
        )
    walls = _parse_walls(plan["walls"], width, height)
    start = plan.get("start")
    if start is not None:
        x, y = _numbers(start, 2, "start")
        start = (x, y)
    layout = Layout(name, (width, height), walls, start)
    _check_free(layout)
    return layout


def _parse_walls(walls: Any, width: float, height: float) -> Array:
    if not isinstance(walls, list):
        raise ValueError(f'"walls" is a {type(walls).__name__}; it must be a list of segments.')
    if len(walls) > MAX_WALLS:
        raise ValueError(f"it has {len(walls)} walls; at most {MAX_WALLS} are allowed.")
    parsed = np.array([_numbers(w, 4, f"wall {i}") for i, w in enumerate(walls)]).reshape(-1, 4)
    for i, (x0, y0, x1, y1) in enumerate(parsed.tolist()):
        if min(x0, y0, x1, y1) < 0 or max(x0, x1) > width or max(y0, y1) > height:
            raise ValueError(
                f"wall {i} is {walls[i]}, outside the room of {width:g} x {height:g} mm; "
                "enlarge the size or cut the wall."
            )
        if math.hypot(x1 - x0, y1 - y0) < 1.0:
            raise ValueError(f"wall {i} is {walls[i]}, shorter than 1 mm; leave it out.")
    return parsed


def _numbers(value: Any, count: int, what: str) -> list[float]:
    """Return `value` as finite floats; a bool is no number here, though it is one to Python."""
    if not isinstance(value, list) or len(value) != count:
        raise ValueError(f"{what} is {_short(value)}; it must be a list of {count} numbers [mm].")
    for number in value:
        is_number = isinstance(number, int | float) and not isinstance(number, bool)
        if not is_number or not abs(number) < 1e12:  # nan, infinity and huge integers end here
            raise ValueError(
                f"{what} is {_short(value)}; it must hold finite numbers [mm] and nothing else."
            )
    return [float(number) for number in value]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _check_free(layout: Layout) -> None:
    if layout.start is not None and not layout.is_free(layout.start):
        raise ValueError(
            f"start {list(layout.start)} is inside a wall or closer than {ROBOT_RADIUS} mm to one; "
            "move it, or write null for any free place."
        )
    if layout._main_region is None:
        raise ValueError(
            f"it has no free place for a robot of radius {ROBOT_RADIUS} mm; "
            "enlarge the size or take walls away."
        )


def _distance_to_walls(points: Array, walls: Array) -> Array:
    """Return the distance from each point (..., 2) to the face of each wall (..., 4) [mm]."""
    middle, along = (walls[..., :2] + walls[..., 2:]) / 2, walls[..., 2:] - walls[..., :2]
    length = np.hypot(along[..., 0], along[..., 1])
    ux, uy = along[..., 0] / length, along[..., 1] / length
    dx, dy = points[..., 0] - middle[..., 0], points[..., 1] - middle[..., 1]
    beyond_end = np.maximum(np.abs(dx * ux + dy * uy) - (length + WALL_THICKNESS) / 2, 0.0)
    beyond_side = np.maximum(np.abs(dy * ux - dx * uy) - WALL_THICKNESS / 2, 0.0)
    return np.hypot(beyond_end, beyond_side)


def _free_places(layout: Layout) -> Places:
    (width, height), longest_move = layout.size, math.hypot(3, 2)
    pitch = max(GRID_PITCH, math.sqrt(width * height / MAX_PLACES))
    # So far from walls that no move between two places can cross one, however coarse the grid.
    radius = max(ROBOT_RADIUS, pitch * longest_move / 2)
    columns, rows = (max(1, math.ceil(length / pitch)) for length in layout.size)
    x = (np.arange(columns) + 0.5) * width / columns
    y = (np.arange(rows) + 0.5) * height / rows
    free = (np.minimum(x, width - x) >= radius - TOLERANCE)[:, None] & (
        np.minimum(y, height - y) >= radius - TOLERANCE
    )
    for wall in layout.walls:
        _clear_around(free, wall, x, y, radius)
    index = np.full(free.shape, -1)
    index[free] = np.arange(free.sum())
    points = np.stack(np.broadcast_arrays(x[:, None], y), -1)[free]
    graph = _move_graph(index, points)
    region = connected_components(graph, directed=False)[1].astype(np.int64)
    return Places(points, index, graph, region, cKDTree(points), pitch)


def _clear_around(free: NDArray[np.bool_], wall: Array, x: Array, y: Array, radius: float) -> None:
    """Mark as not free what lies within `radius` of the wall, in a band along it only."""
    if abs(wall[3] - wall[1]) > abs(wall[2] - wall[0]):  # let x be the longer direction
        free, wall, x, y = free.T, wall[[1, 0, 3, 2]], y, x
    reach = radius + WALL_THICKNESS
    x0, y0, x1, y1 = wall if wall[0] <= wall[2] else wall[[2, 3, 0, 1]]
    i = np.flatnonzero((x >= x0 - reach) & (x <= x1 + reach))
    middle = y0 + (x[i] - x0) * (y1 - y0) / (x1 - x0)
    pitch = 2 * y[0]
    spread = math.ceil(reach * math.sqrt(2) / pitch) + 1  # the band is at most at 45 degrees
    j = np.floor(middle / pitch).astype(int)[:, None] + np.arange(-spread, spread + 1)
    column = np.broadcast_to(i[:, None], j.shape)[inside := (j >= 0) & (j < len(y))]
    row = j[inside]
    near = _distance_to_walls(np.stack([x[column], y[row]], -1), wall) < radius - TOLERANCE
    free[column[near], row[near]] = False


def _move_graph(index: NDArray[np.int64], points: Array) -> csr_array:
    sources, targets = [], []
    columns, rows = index.shape
    for i, j in _MOVES:
        low, high = max(0, -j), rows - max(0, j)
        source = index[: max(0, columns - i), low:high]
        target = index[i:, low + j : high + j]
        if source.size:
            both = (source >= 0) & (target >= 0)
            sources.append(source[both])
            targets.append(target[both])
    source = np.concatenate([*sources, *targets]) if sources else np.zeros(0, int)
    target = np.concatenate([*targets, *sources]) if sources else np.zeros(0, int)
    length = np.hypot(*(points[target] - points[source]).T)
    return coo_array((length, (source, target)), shape=(len(points),) * 2).tocsr()
