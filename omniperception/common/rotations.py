"""Quaternion algebra on tensors; (w, x, y, z), unit norm, batch first."""

from __future__ import annotations

import torch


def rotate_inverse(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Expresses a world vector (n, 3) in the frame whose orientation in the world is `quat` (n, 4)."""
    w, q = quat[:, :1], quat[:, 1:]
    t = 2.0 * torch.linalg.cross(q, vec)
    return vec - w * t + torch.linalg.cross(q, t)


def rotate(quat: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Expresses in the world a vector (..., 3) given in the frame whose orientation in the world is `quat` (..., 4)."""
    w, (q, vec) = quat[..., :1], torch.broadcast_tensors(quat[..., 1:], vec)
    t = 2.0 * torch.linalg.cross(q, vec)
    return vec + w * t + torch.linalg.cross(q, t)


def multiply(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Quaternions (..., 4) of the rotations by `second` and then by `first`, each (..., 4)."""
    first, second = torch.broadcast_tensors(first, second)
    w, q = first[..., :1], first[..., 1:]
    v, r = second[..., :1], second[..., 1:]
    real = w * v - (q * r).sum(-1, keepdim=True)
    return torch.cat((real, w * r + v * q + torch.linalg.cross(q, r)), -1)


def yaw_of(quat: torch.Tensor) -> torch.Tensor:
    """Heading (rad) of the body's x axis in the world's horizontal plane, (n,)."""
    w, x, y, z = quat.unbind(-1)
    return torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def yaw_quat(yaw: torch.Tensor) -> torch.Tensor:
    """Quaternion (..., 4) of a rotation by `yaw` (...) about the vertical."""
    zero = torch.zeros_like(yaw)
    return torch.stack(((yaw / 2).cos(), zero, zero, (yaw / 2).sin()), -1)


def rotate_yaw(yaw: torch.Tensor, vec: torch.Tensor) -> torch.Tensor:
    """Turns horizontal vectors (n, ..., 2) by the angles `yaw` (n,)."""
    shape = (-1,) + (1,) * (vec.dim() - 2)
    cos, sin = yaw.cos().reshape(shape), yaw.sin().reshape(shape)
    x, y = vec.unbind(-1)
    return torch.stack((cos * x - sin * y, sin * x + cos * y), -1)


def matrix_of(quat: torch.Tensor) -> torch.Tensor:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4): from the body's frame to the one it is given in."""
    w, x, y, z = quat.unbind(-1)
    rows = (
        *(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        *(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        *(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
