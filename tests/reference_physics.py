"""Independent oracles for the simulators: an RK4 pendulum and an analytic ray caster."""

import numpy as np


def rk4_pendulum(angle, velocity, torques, *, dt, friction, gravity=9.8, rk4_steps=20):
    """Integrate w' = -g sin(angle) - friction * w + torque, m = l = 1, angle 0 hanging.

    Returns (T + 1, 2) unwrapped angles [rad] and velocities [rad/s], one row per control step.
    """

    def slope(state, torque):
        return np.array(
            [state[1], -gravity * np.sin(state[0]) - friction * state[1] + torque], np.float64
        )

    state, states, h = np.array([angle, velocity], np.float64), [], dt / rk4_steps
    states.append(state)
    for torque in torques:
        for _ in range(rk4_steps):
            k1 = slope(state, torque)
            k2 = slope(state + h / 2 * k1, torque)
            k3 = slope(state + h / 2 * k2, torque)
            k4 = slope(state + h * k3, torque)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        states.append(state)
    return np.array(states)


def cast_rays(origin, walls, angles, *, thickness, reach):
    """Return how far from `origin` each ray meets the first wall, `reach` if none does.

    Walls are segments (W, 4), drawn as rectangles `thickness` wide and half of that longer at
    either end. A ray is clipped against the two slabs of each rectangle, in its own frame.
    """
    origin, half = np.asarray(origin, np.float64), thickness / 2
    directions = np.stack([np.cos(angles), np.sin(angles)], -1)  # (R, 2)
    distance = np.full(len(directions), float(reach))
    for x0, y0, x1, y1 in np.asarray(walls, np.float64):
        length = np.hypot(x1 - x0, y1 - y0)
        along = np.array([x1 - x0, y1 - y0]) / length
        frame = np.array([along, [-along[1], along[0]]])
        middle = np.array([x0 + x1, y0 + y1]) / 2
        extent = np.array([length / 2 + half, half])
        offset, slope = frame @ (origin - middle), directions @ frame.T  # (2,), (R, 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = (-extent - offset) / slope, (extent - offset) / slope
        enter = np.minimum(first, second).max(-1)
        leave = np.maximum(first, second).min(-1)
        is_hit = (enter <= leave) & (enter >= 0)
        distance = np.where(is_hit, np.minimum(distance, enter), distance)
    return distance
