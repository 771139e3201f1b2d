"""A pendulum whose motor is too weak to lift it in one swing, seen by its angle alone.

    m l^2 dw/dt = -m g l sin(angle) - friction w + torque,    m = 1 kg, l = 1 m, g = 9.8 m/s^2

with the angle 0 where it hangs and pi where it stands. After K. Doya, "Reinforcement learning in
continuous time and space", Neural Computation 12 (2000), whose angle is 0 where it stands.
"""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pybullet
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw

from sims.bullet import Client

GRAVITY = 9.8  # m/s^2
MASS = 1.0  # kg, a point at the end of the rod
ROD_LENGTH = 1.0  # m
CONTROL_STEP = 0.02  # s
SUBSTEPS = 4  # of Bullet in one control step
MAX_VELOCITY = 1000.0  # rad/s; Bullet would clamp at 100 without a word

PICTURE_SIZE = 240  # pixels


class TorquePendulumEnv(gym.Env):
    """Torque-limited pendulum, without a reward.

    Description: a point of 1 kg on a massless rod of 1 m, with a motor and viscous friction in its
    joint. The motor cannot hold it level (m g l = 9.8 N m), so it must swing up.

    Action, Box (1,) float32 in [-1, 1]: torque as a fraction of `max_torque`, held for 0.02 s;
    values outside are clipped.

    Observation, Box (1,) float32 in [0, 1]: (angle + pi) / (2 pi), with the angle [rad] from
    hanging in [-pi, pi). Hanging is 0.5; the jump from 1 to 0 is upright. Velocity is hidden.

    Reward: always 0. Episodes neither terminate nor truncate.

    Starting state: `options={"state": (angle, velocity)}` [rad, rad/s] of `reset`, else hanging at
    rest.

    Info: `ground_truth`, (angle in [-pi, pi) [rad], angular velocity [rad/s]) float64.

    Arguments:
        friction: viscous torque per angular velocity [N m s/rad].
        max_torque: torque of the full action [N m].
        render_mode: None, or "rgb_array" for a picture from the side.

    Bullet steps with symplectic Euler, the leapfrog whose angle runs `velocity * h / 2` ahead of
    its velocity, with h the substep. The environment takes that off what it reports and adds it to
    what it sets; against RK4 a swing from 1 rad is then right to 1e-5 rad after 1 s and 2e-4 rad
    after 10 s, a spin at 9 rad/s to 1e-4 rad after 1 s.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self, friction: float = 0.1, max_torque: float = 5.0, render_mode: str | None = None
    ) -> None:
        if not 0 <= friction < math.inf:
            raise ValueError(f"friction is {friction}; it must be finite and at least 0 N m s/rad.")
        if not 0 < max_torque < math.inf:
            raise ValueError(f"max_torque is {max_torque}; it must be finite and above 0 N m.")
        self.friction, self.max_torque = float(friction), float(max_torque)
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Box(0.0, 1.0, (1,))
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,))
        self._h = CONTROL_STEP / SUBSTEPS
        self._world = Client()
        self._build()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Hang at rest, unless `options` says otherwise."""
        super().reset(seed=seed)
        options = options or {}
        if unknown := sorted(options.keys() - {"state"}):
            raise ValueError(
                f'reset options {unknown} are unknown; use {{"state": (angle, velocity)}}.'
            )
        angle, velocity = _checked_state(options.get("state", (0.0, 0.0)))
        self._world.resetJointState(self._rod, 0, angle + velocity * self._h / 2, velocity)
        return self._observe()

    def step(
        self, action: ArrayLike
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold the torque `action` * `max_torque` for 0.02 s."""
        motor = self.max_torque * _checked_action(action)
        for _ in range(SUBSTEPS):  # Bullet forgets a torque after every step
            # Bullet's own `jointDamping` is right to first order only: 1e-3 rad/s off in 1 s.
            torque = motor - self.friction * self._mid_velocity(motor)
            self._world.setJointMotorControl2(self._rod, 0, pybullet.TORQUE_CONTROL, force=torque)
            self._world.stepSimulation()
        observation, info = self._observe()
        return observation, 0.0, False, False, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the pendulum from the side, (240, 240, 3) uint8."""
        if self.render_mode is None:
            return None
        angle, middle = self._state()[0], PICTURE_SIZE / 2
        picture = Image.new("RGB", (PICTURE_SIZE, PICTURE_SIZE), (255, 255, 255))
        draw = ImageDraw.Draw(picture)
        reach = 0.4 * PICTURE_SIZE
        x, y = middle + reach * math.sin(angle), middle + reach * math.cos(angle)
        draw.line([middle, middle, x, y], fill=(40, 44, 52), width=5)
        for cx, cy, radius, colour in (
            (middle, middle, 5, (40, 44, 52)),
            (x, y, 14, (214, 90, 49)),
        ):
            draw.ellipse([cx - radius, cy - radius, cx + radius, cy + radius], fill=colour)
        return np.asarray(picture)

    def close(self) -> None:
        """Free the physics world; safe to call twice."""
        self._world.close()

    def _build(self) -> None:
        world = self._world
        world.setGravity(0, 0, -GRAVITY)
        world.setTimeStep(self._h)
        self._rod = world.createMultiBody(
            baseMass=0,
            linkMasses=[MASS],
            linkCollisionShapeIndices=[-1],
            linkVisualShapeIndices=[-1],
            linkPositions=[[0, 0, 0]],
            linkOrientations=[[0, 0, 0, 1]],
            linkInertialFramePositions=[[0, 0, -ROD_LENGTH]],
            linkInertialFrameOrientations=[[0, 0, 0, 1]],
            linkParentIndices=[0],
            linkJointTypes=[pybullet.JOINT_REVOLUTE],
            linkJointAxis=[[0, -1, 0]],  # a positive angle swings to the right, towards +x
        )
        # Every joint comes with a motor that holds it still, and every link with air drag.
        world.setJointMotorControl2(self._rod, 0, pybullet.VELOCITY_CONTROL, force=0)
        world.changeDynamics(
            self._rod,
            0,
            linearDamping=0,
            angularDamping=0,
            maxJointVelocity=MAX_VELOCITY,
        )

    def _mid_velocity(self, motor: float) -> float:
        """Return the velocity half a substep from now under this motor torque [rad/s].

        Friction taken at the velocity of now would be late by h / 2, a hundred times the error of
        the rest. Solved for the velocity that it slows itself, so no friction is too strong.
        """
        angle, velocity = self._world.getJointState(self._rod, 0)[:2]
        inertia = MASS * ROD_LENGTH**2
        weight = MASS * GRAVITY * ROD_LENGTH * math.sin(angle)
        half = self._h / 2 / inertia
        return (velocity + half * (motor - weight)) / (1 + half * self.friction)

    def _state(self) -> tuple[float, float]:
        """Return the angle in [-pi, pi) [rad] and the velocity [rad/s] at the same instant."""
        angle, velocity = self._world.getJointState(self._rod, 0)[:2]
        turned = (angle - velocity * self._h / 2 + math.pi) % (2 * math.pi)
        return turned - math.pi, velocity

    def _observe(self) -> tuple[NDArray[np.float32], dict[str, Any]]:
        angle, velocity = self._state()
        turn = (angle + math.pi) / (2 * math.pi)
        return np.array([turn], np.float32), {"ground_truth": np.array([angle, velocity])}


def _checked_action(action: Any) -> float:
    """Return the action clipped to [-1, 1]."""
    checked = _floats(action)
    if checked is None or checked.shape != (1,) or not np.isfinite(checked).all():
        raise ValueError(
            f"action is {action!r}; it must be an array of one finite number in [-1, 1], "
            "a fraction of max_torque."
        )
    return min(max(float(checked[0]), -1.0), 1.0)


def _checked_state(state: Any) -> tuple[float, float]:
    checked = _floats(state)
    if checked is None or checked.shape != (2,) or not np.isfinite(checked).all():
        raise ValueError(
            f'reset option "state" is {state!r}; it must be two finite numbers (angle [rad], '
            "velocity [rad/s])."
        )
    angle, velocity = checked.tolist()
    if abs(velocity) > MAX_VELOCITY:
        raise ValueError(
            f'reset option "state" has velocity {velocity} rad/s; at most {MAX_VELOCITY:g} is '
            "simulated."
        )
    return math.remainder(angle, 2 * math.pi), velocity


def _floats(value: Any) -> NDArray[np.float64] | None:
    """Return `value` as a float64 array; None if it is not made of numbers."""
    try:
        return np.array(value, np.float64)
    except (TypeError, ValueError):
        return None
