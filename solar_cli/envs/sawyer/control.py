"""Kinematics of the arm, and the velocity controller that both engines share.

Poses are those of the brick in the hand, in the world's frame; arrays are float64.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solar_cli.envs.sawyer.facts import HELD, HOME, LINKS, Vector

Floats = NDArray[np.float64]

PERIOD = 0.02
"""seconds between two corrections of the servos' targets"""
SCALE = np.array([0.1, 0.1, 0.1, 0.5])
"""what an action of 1 is: m/s along x, y and z, and rad/s about z"""
RIGHTING = 2.0
"""rad/s of roll and pitch for a tilt of 1 rad"""
DAMPING = 0.02
"""of the inverse: joints stay slow near singular postures"""
LEASH = np.array([0.004, 0.004, 0.004, 0.03, 0.03, 0.03])
"""m and rad that a target may be ahead of the arm: one that is blocked must not wind up"""
TOLERANCE, ATTEMPTS = 1e-10, 100


class Pose(NamedTuple):
    """Of a rigid body."""

    position: Floats
    """(3,) in m"""
    rotation: Floats
    """(3, 3): its axes as columns"""


def rotation(turn: Vector) -> Floats:
    """The rotation by roll, pitch and yaw about fixed axes."""
    (a, b, c), (x, y, z) = np.cos(turn), np.sin(turn)
    return np.array(
        [
            [b * c, x * y * c - a * z, a * y * c + x * z],
            [b * z, x * y * z + a * c, a * y * z - x * c],
            [-y, x * b, a * b],
        ]
    )


def _chain() -> tuple[Floats, Floats]:
    """(7, 4, 4) from each joint to the next, the first from the world; (4, 4) to the held brick."""
    links = {link.name: link for link in LINKS}
    path = [links[HELD]]
    while path[0].parent in links:
        path.insert(0, links[path[0].parent])
    offsets, since = [], np.eye(4)
    for link in path:
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = rotation(link.turn), link.at
        since = since @ step
        if link.joint is not None:
            offsets.append(since)
            since = np.eye(4)
    return np.stack(offsets), since


OFFSETS, TAIL = _chain()
JOINTS = tuple(link.joint for link in LINKS if link.joint is not None)
LOWER, UPPER = np.array([joint.lower for joint in JOINTS]), np.array([j.upper for j in JOINTS])
SPEED = np.array([joint.speed for joint in JOINTS])


def kinematics(joints: Floats) -> tuple[Pose, Floats]:
    """The held brick's pose, and its Jacobian (6, 7): velocity, then angular velocity."""
    turned = OFFSETS.copy()
    cos, sin = np.cos(joints)[:, None], np.sin(joints)[:, None]
    turned[:, :3, 0] = OFFSETS[:, :3, 0] * cos + OFFSETS[:, :3, 1] * sin
    turned[:, :3, 1] = OFFSETS[:, :3, 1] * cos - OFFSETS[:, :3, 0] * sin
    frames = np.empty_like(turned)
    frame = np.eye(4)
    for number, step in enumerate(turned):
        frames[number] = frame = frame @ step
    tip = frame @ TAIL
    axes, arms = frames[:, :3, 2], tip[:3, 3] - frames[:, :3, 3]
    return Pose(tip[:3, 3], tip[:3, :3]), np.vstack([_cross(axes, arms).T, axes.T])


def _cross(a: Floats, b: Floats) -> Floats:
    """Rows' vector products, in a fraction of `numpy.cross`'s time."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def _rates(jacobian: Floats, twist: Floats) -> Floats:
    """Joint velocities (7,) for a twist (6,), by damped least squares."""
    square = jacobian @ jacobian.T + DAMPING**2 * np.eye(6)
    return np.asarray(jacobian.T @ np.linalg.solve(square, twist))


def angles(position: Floats, yaw: float) -> Floats:
    """Joint angles (7,) near `HOME` with which the held brick is upright at ``position``."""
    joints, wanted = np.array(HOME), rotation((0.0, 0.0, yaw))
    for _ in range(ATTEMPTS):
        pose, jacobian = kinematics(joints)
        turn = 0.5 * _cross(pose.rotation.T, wanted.T).sum(axis=0)
        twist = np.concatenate([position - pose.position, turn])
        if np.abs(twist).max() < TOLERANCE:
            return joints
        joints = joints + _rates(jacobian, twist)
    raise ValueError(f"the arm cannot hold a brick at {position} with yaw {yaw}")


class VelocityControl:
    """Turns actions into targets of the joints' servos."""

    def __init__(self, joints: Floats) -> None:
        self._targets = joints.copy()

    def targets(self, action: Floats, joints: Floats) -> Floats:
        """Where the joints, now at ``joints``, should be a `PERIOD` later.

        An action (4,) in [-1, 1] is a velocity of the brick and a yaw rate, in units of `SCALE`.
        Roll and pitch return to upright by themselves.
        """
        pose, jacobian = kinematics(joints)
        ahead = jacobian @ (self._targets - joints)
        if (excess := ahead - np.clip(ahead, -LEASH, LEASH)).any():
            self._targets = self._targets - _rates(jacobian, excess)
        velocity, up = SCALE * action, pose.rotation[:, 2]
        righting = (RIGHTING * up[1], -RIGHTING * up[0])
        rates = _rates(jacobian, np.array([*velocity[:3], *righting, velocity[3]]))
        rates /= max(1.0, (np.abs(rates) / SPEED).max())
        self._targets = np.clip(self._targets + PERIOD * rates, LOWER, UPPER)
        return self._targets.copy()
