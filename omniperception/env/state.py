"""What the terms of the task can read about the robot, as float32 tensors."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import torch

from omniperception.common.rotations import rotate_inverse, rotate_yaw, yaw_of

Term = TypeVar("Term", bound=Callable)


def reads(*fields: str) -> Callable[[Term], Term]:
    """Declares the optional parts of the task that a term reads; only what somebody reads is built."""

    def mark(term: Term) -> Term:
        term.reads = frozenset(fields)
        return term

    return mark


def fields_read(term: Callable) -> frozenset[str]:
    """The optional fields that a term (or a partial of one) declared."""
    return getattr(plain(term), "reads", frozenset())


def plain(term: Callable) -> Callable:
    """The function below partials."""
    while isinstance(term, partial):
        term = term.func
    return term


def checked_term(name: str, term: Term) -> Term:
    """The term as a plain function or partial; refuses one that the environment alone cannot call, such as one with a
    misspelt parameter.

    The partials that Hydra makes check their target anew in every call (0.25 ms); a term is called in every step.
    """
    try:
        inspect.signature(term).bind(None)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {error}") from None
    return partial(term.func, *term.args, **term.keywords) if isinstance(term, partial) else term


@dataclass
class Kinematics:
    """Base and joint state at one moment, every field (num_envs, ...).

    Attributes:
        base_pos_w: (n, 3) m, environment frame.
        base_quat_w: (n, 4).
        yaw: (n,) rad.
        base_lin_vel_b: (n, 3) m/s, base frame.
        base_lin_vel_yaw: (n, 2) m/s, horizontal velocity in the yaw-aligned frame.
        base_ang_vel_b: (n, 3) rad/s, base frame.
        projected_gravity_b: (n, 3) unit vector of gravity in the base frame.
        joint_pos: (n, num_joints) rad.
        joint_vel: (n, num_joints) rad/s.
    """

    base_pos_w: torch.Tensor
    base_quat_w: torch.Tensor
    yaw: torch.Tensor
    base_lin_vel_b: torch.Tensor
    base_lin_vel_yaw: torch.Tensor
    base_ang_vel_b: torch.Tensor
    projected_gravity_b: torch.Tensor
    joint_pos: torch.Tensor
    joint_vel: torch.Tensor

    @classmethod
    def of(cls, qpos: torch.Tensor, qvel: torch.Tensor) -> Kinematics:
        """From `Simulator.robot_state`: (n, 7 + joints) and (n, 6 + joints)."""
        qpos, qvel = qpos.float(), qvel.float()
        quat = qpos[:, 3:7]
        yaw = yaw_of(quat)
        down = torch.zeros_like(qvel[:, :3])
        down[:, 2] = -1.0
        in_base = rotate_inverse(quat.repeat(2, 1), torch.cat((qvel[:, :3], down)))
        return cls(
            base_pos_w=qpos[:, :3],
            base_quat_w=quat,
            yaw=yaw,
            base_lin_vel_b=in_base[: len(quat)],
            base_lin_vel_yaw=rotate_yaw(-yaw, qvel[:, :2]),
            base_ang_vel_b=qvel[:, 3:6],
            projected_gravity_b=in_base[len(quat) :],
            joint_pos=qpos[:, 7:],
            joint_vel=qvel[:, 6:],
        )
