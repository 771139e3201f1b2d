"""A disc-shaped robot that feels its way through a maze with 24 rangefinders.

The world is planar but lives in Bullet, 1 m for 1000 mm. Its walls are one triangle mesh: of what
Bullet offers it is the exact one (5 rays in 100 000 wrong, where boxes have 230) and the fast one.
"""

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pybullet
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw

from sims.bullet import Client
from sims.layouts import ROBOT_RADIUS, WALL_THICKNESS, load_layout

NUM_RAYS = 24
RAY_RANGE = 500.0  # mm, from the robot's rim
STEP_LENGTH = 10.0  # mm per control step and axis at full action
METRE = 1000.0  # mm

MAX_MOTION_NOISE = 0.9  # a move stays below 27 mm, so the centre cannot get into a wall
MAX_PUSHES = 50  # a sharp corner takes many pushes, each a fraction shorter than the one before
CONTACT_TOLERANCE = 1e-10  # m; a shallower contact is left alone

PICTURE_SIZE = 500  # pixels along the longer side
WALLS_GROUP, ROBOT_GROUP = 2, 4  # rays look for the first alone; Bullet puts static bodies there


class RangefinderMazeEnv(gym.Env):
    """Rangefinder robot in a maze, without a reward.

    Description: a disc of radius 27.5 mm without a heading. It moves by what it is told, slides
    along the walls that it meets, and is never inside one.

    Action, Box (2,) float32 in [-1, 1]: (dx, dy) of this step as a fraction of 10 mm; values
    outside are clipped.

    Observation, Box (24,) float32 in [0, 1]: distance from the robot's rim to the nearest wall in
    direction 15 * k degrees (counter-clockwise from the world's x axis), divided by 500 mm; 1 where
    there is none within 500 mm.

    Reward: always 0. Episodes neither terminate nor truncate.

    Starting state: `options={"position": (x, y)}` [mm] of `reset`, else the layout's start, else a
    random free place.

    Info: `ground_truth`, (x, y) [mm] float64; `bumped`, whether a wall cut the move of this step.

    Arguments:
        layout: name of a built-in layout, or path of a JSON file (see `sims.layouts`).
        sensor_noise: each reading is multiplied by 1 + uniform(-sensor_noise, sensor_noise).
        motion_noise: dx and dy are each multiplied by 1 + uniform(-motion_noise, motion_noise).
        render_mode: None, or "rgb_array" for a picture from above, y upwards.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        layout: str | Path = "paper",
        sensor_noise: float = 0.0,
        motion_noise: float = 0.0,
        render_mode: str | None = None,
    ) -> None:
        self.layout = load_layout(layout)
        self.sensor_noise = _in_range("sensor_noise", sensor_noise, 1.0)
        self.motion_noise = _in_range("motion_noise", motion_noise, MAX_MOTION_NOISE)
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Box(0.0, 1.0, (NUM_RAYS,))
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,))
        self.position = np.zeros(2)  # mm
        angle = np.arange(NUM_RAYS) * (2 * math.pi / NUM_RAYS)
        self._directions = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
        self._rays = self._directions * ((ROBOT_RADIUS + RAY_RANGE) / METRE)
        self._world = Client()
        self._build()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Put the robot at its start and return what it sees there."""
        super().reset(seed=seed)
        options = options or {}
        if unknown := sorted(options.keys() - {"position"}):
            raise ValueError(f'reset options {unknown} are unknown; use {{"position": (x, y)}}.')
        if "position" in options:
            self.position = self._checked_position(options["position"])
        else:
            start = self.layout.start or self.layout.random_free_position(self.np_random)
            self.position = np.array(start)
        return self._observe(), self._info(bumped=False)

    def step(
        self, action: ArrayLike
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Move by `action` * 10 mm, or as far as the walls let the robot slide."""
        move = STEP_LENGTH * _checked_action(action)
        if self.motion_noise:
            move *= 1 + self.np_random.uniform(-self.motion_noise, self.motion_noise, 2)
        bumped = self._slide(move)
        return self._observe(), 0.0, False, False, self._info(bumped)

    def render(self) -> NDArray[np.uint8] | None:
        """Return the maze from above with the robot and its rays, (height, width, 3) uint8."""
        if self.render_mode is None:
            return None
        width, height = self.layout.size
        scale = PICTURE_SIZE / max(width, height)
        shape = (max(1, round(width * scale)), max(1, round(height * scale)))
        picture = Image.new("RGB", shape, (255, 255, 255))
        draw = ImageDraw.Draw(picture)
        x, y = self.position[0] * scale, (height - self.position[1]) * scale
        for reach, (dx, dy, _) in zip(self._ray_lengths() * scale, self._directions, strict=True):
            draw.line([x, y, x + reach * dx, y - reach * dy], fill=(200, 216, 236))
        radius = ROBOT_RADIUS * scale
        draw.ellipse([x - radius, y - radius, x + radius, y + radius], fill=(214, 90, 49))
        flipped = self.layout.walls * [1, -1, 1, -1] + [0, height, 0, height]
        thickness = max(2, round(WALL_THICKNESS * scale))
        for ends in (flipped * scale).tolist():
            draw.line(ends, fill=(40, 44, 52), width=thickness)
        draw.rectangle([0, 0, shape[0] - 1, shape[1] - 1], outline=(40, 44, 52), width=2)
        return np.asarray(picture)

    def close(self) -> None:
        """Free the physics world; safe to call twice."""
        self._world.close()

    def _build(self) -> None:
        vertices, indices = _wall_mesh(self.layout.solid_walls / METRE, WALL_THICKNESS / METRE)
        walls = self._world.createCollisionShape(
            pybullet.GEOM_MESH,
            vertices=vertices,
            indices=indices,
            flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
        )
        # A sphere stands for the disc: Bullet's distance from a sphere to a mesh is exact, that
        # from a cylinder is not, and in the plane of its centre the two are the same.
        ball = self._world.createCollisionShape(pybullet.GEOM_SPHERE, radius=ROBOT_RADIUS / METRE)
        self._walls = self._world.createMultiBody(0, walls)
        self._robot = self._world.createMultiBody(1, ball)
        for body, group in ((self._walls, WALLS_GROUP), (self._robot, ROBOT_GROUP)):
            self._world.setCollisionFilterGroupMask(body, -1, group, 0xFF)

    def _slide(self, move: NDArray[np.float64]) -> bool:
        """Move, then push the robot out of the walls along their normals; return if it was so.

        A move into a corner that leaves the robot inside a wall is tried at half its length.
        """
        for fraction in (1.0, 0.5, 0.25, 0.125):
            position, pushes = self._pushed_out(self.position + fraction * move)
            if pushes <= MAX_PUSHES:
                self.position = position
                return fraction < 1 or pushes > 0
        return True

    def _pushed_out(self, position: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
        """Return the nearby place [mm] clear of walls, and how many pushes led there."""
        for pushes in range(MAX_PUSHES + 1):
            x, y = (position / METRE).tolist()
            self._world.resetBasePositionAndOrientation(self._robot, (x, y, 0), (0, 0, 0, 1))
            contacts = self._world.getClosestPoints(self._robot, self._walls, 0.0)
            deepest = min(contacts, key=lambda contact: contact[8], default=None)
            if deepest is None or deepest[8] >= -CONTACT_TOLERANCE:
                return position, pushes
            normal, depth = np.array(deepest[7][:2]), -deepest[8]
            position = position + normal * (depth * METRE)
        return position, MAX_PUSHES + 1

    def _ray_lengths(self) -> NDArray[np.float64]:
        """Return the distance from the robot's centre to the wall along each ray [mm].

        Rays start in the centre: Bullet misjudges those that start within 1 mm of a wall, and the
        rim may touch one.
        """
        centre = np.array([*self.position, 0.0]) / METRE
        hits = self._world.rayTestBatch(
            [centre.tolist()] * NUM_RAYS,
            (centre + self._rays).tolist(),
            numThreads=1,
            collisionFilterMask=WALLS_GROUP,
        )
        return np.array([hit[2] for hit in hits]) * (ROBOT_RADIUS + RAY_RANGE)

    def _observe(self) -> NDArray[np.float32]:
        distance = (self._ray_lengths() - ROBOT_RADIUS) / RAY_RANGE
        if self.sensor_noise:
            noise = self.np_random.uniform(-self.sensor_noise, self.sensor_noise, NUM_RAYS)
            distance *= 1 + noise
        return np.clip(distance, 0.0, 1.0).astype(np.float32)

    def _info(self, bumped: bool) -> dict[str, Any]:
        return {"ground_truth": self.position.copy(), "bumped": bumped}

    def _checked_position(self, position: Any) -> NDArray[np.float64]:
        checked = _floats(position)
        if checked is None or checked.shape != (2,) or not np.isfinite(checked).all():
            raise ValueError(
                f'reset option "position" is {position!r}; it must be two finite numbers (x, y) '
                "[mm]."
            )
        if not self.layout.is_free(checked):
            width, height = self.layout.size
            raise ValueError(
                f'reset option "position" is {position!r}, inside a wall, closer than '
                f"{ROBOT_RADIUS} mm to one or outside the room of {width:g} x {height:g} mm; "
                "choose a place for which layout.is_free holds."
            )
        return checked


def _wall_mesh(walls: NDArray[np.float64], thickness: float) -> tuple[list[Any], list[int]]:
    """Return the vertices [m] and triangles of upright walls (W, 4), four sides each.

    The plane of the rays cuts every side near an end of its diagonal, not in the middle of the
    wall: a ray that meets the edge between two triangles may slip through.
    """
    bottom, top = -0.01, 10.0  # m
    vertices: list[Any] = []
    indices: list[int] = []
    for x0, y0, x1, y1 in walls.tolist():
        length = math.hypot(x1 - x0, y1 - y0)
        ax, ay = ((x1 - x0) / length * thickness / 2, (y1 - y0) / length * thickness / 2)
        corners = [
            (x0 - ax + ay, y0 - ay - ax),
            (x1 + ax + ay, y1 + ay - ax),
            (x1 + ax - ay, y1 + ay + ax),
            (x0 - ax - ay, y0 - ay + ax),
        ]
        first = len(vertices)
        vertices += [(x, y, bottom) for x, y in corners] + [(x, y, top) for x, y in corners]
        for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)):
            quad = [first + a, first + b, first + b + 4, first + a + 4]
            indices += [quad[0], quad[1], quad[2], quad[0], quad[2], quad[3]]
    return vertices, indices


def _checked_action(action: Any) -> NDArray[np.float64]:
    """Return the action as float64, clipped to [-1, 1]."""
    checked = _floats(action)
    if checked is None or checked.shape != (2,) or not np.isfinite(checked).all():
        raise ValueError(
            f"action is {action!r}; it must be two finite numbers (dx, dy) in [-1, 1], "
            "fractions of 10 mm."
        )
    return np.clip(checked, -1.0, 1.0)


def _floats(value: Any) -> NDArray[np.float64] | None:
    """Return `value` as a float64 array of its own; None if it is not made of numbers."""
    try:
        return np.array(value, np.float64)
    except (TypeError, ValueError):
        return None


def _in_range(name: str, value: float, limit: float) -> float:
    if not 0 <= value <= limit:
        raise ValueError(f"{name} is {value}; it must be in [0, {limit}], e.g. 0.02 for +-2 %.")
    return float(value)
