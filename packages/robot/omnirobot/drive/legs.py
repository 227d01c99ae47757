"""Leg kinematics of a Go2, and the base's velocity from feet that stand."""

from __future__ import annotations

import numpy as np

_HIP = np.array([[0.1934, -0.0465, 0], [0.1934, 0.0465, 0], [-0.1934, -0.0465, 0], [-0.1934, 0.0465, 0]])
"""Hips of FR, FL, RR, RL in the base, m; as the lengths below from Unitree's description (scene/assets/go2.xml)."""
_THIGH = np.array([[0, -0.0955, 0], [0, 0.0955, 0], [0, -0.0955, 0], [0, 0.0955, 0]])
_CALF, _FOOT = np.array([0.0, 0.0, -0.213]), np.array([-0.002, 0.0, -0.213])
FOOT_RADIUS = 0.022
"""m; a standing foot rolls about the point where it touches the ground."""
_STANDING_FORCE = 30.0
"""A foot that pushes down with less (N) does not count as standing."""


def feet(joint_pos: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position (4, 3) m of a point of each foot in the base, and its Jacobian (4, 3, 3): by axis and joint, m/rad.

    Args:
        joint_pos: (12,) rad, in the motors' order.
        offset: (3,) m in the base, from the foot's centre to the point.
    """
    hip, thigh, calf = joint_pos.reshape(4, 3).T
    shank = _about_y(thigh + calf, _FOOT)
    leg = _about_y(thigh, _CALF) + shank
    from_hip = _about_x(hip, _THIGH + leg)
    lateral = _about_x(hip, np.array([0.0, 1.0, 0.0]))
    turned = (
        np.cross([1.0, 0.0, 0.0], from_hip + offset),
        np.cross(lateral, _about_x(hip, leg) + offset),
        np.cross(lateral, _about_x(hip, shank) + offset),
    )
    return _HIP + from_hip + offset, np.stack(turned, -1)


def base_velocity(
    joint_pos: np.ndarray, joint_vel: np.ndarray, torque: np.ndarray, ang_vel: np.ndarray, down: np.ndarray
) -> np.ndarray | None:
    """(3,) m/s in the base: minus what the standing feet, which do not slip, do relative to it; None where none stands.

    Feet count by the force with which they push down, which follows from the torques of legs without mass.

    Args:
        joint_pos: (12,) rad, in the motors' order.
        joint_vel: (12,) rad/s.
        torque: (12,) N m, as estimated by the motors.
        ang_vel: (3,) rad/s of the base, in the base.
        down: (3,) unit vector of gravity in the base.
    """
    at, jacobian = feet(joint_pos, FOOT_RADIUS * down)
    velocity = np.einsum("fij,fj->fi", jacobian, joint_vel.reshape(4, 3))
    push = np.linalg.solve(jacobian.transpose(0, 2, 1), torque.reshape(4, 3, 1))[:, :, 0] @ down
    weight = np.where(push > _STANDING_FORCE, push, 0.0)
    if not weight.any():
        return None
    return -(weight @ (velocity + np.cross(ang_vel, at))) / weight.sum()


def _about_x(angle: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """(4, 3) vectors (4, 3) or (3,) turned by angles (4,)."""
    x, y, z = np.broadcast_to(vectors, (4, 3)).T
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack((x, cos * y - sin * z, sin * y + cos * z), 1)


def _about_y(angle: np.ndarray, vector: np.ndarray) -> np.ndarray:
    x, y, z = vector
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack((cos * x + sin * z, np.full(4, y), -sin * x + cos * z), 1)
