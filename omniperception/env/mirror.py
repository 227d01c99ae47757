"""Left-right mirror images of actions and observations, of a robot that is its own mirror image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import mujoco
import numpy as np
import torch
from tensordict import TensorDict

from omniperception.env.env import OmniEnv
from omniperception.env.mdp.observations import gait_phase
from omniperception.env.mdp.terms import JOINT_MAGNITUDES, JOINTS, ROTATION, VECTOR
from omniperception.env.mixed import MixedEnv
from omniperception.scene import RobotConfig
from omniperception.scene.robot_file import compile_robot, read_robot


class Mirror:
    """Adds mirror images to samples; rsl_rl's `data_augmentation_func`."""

    def __init__(self, env: OmniEnv | MixedEnv) -> None:
        """Args: env: whose groups and robot to mirror.

        Raises:
            ValueError: a joint or a term has no mirror image.
        """
        joints = mirrored_joints(env.robot)
        groups = env.config.observations.groups.values()
        if any(getattr(term, "func", term) is gait_phase for group in groups for term in group.terms.values()):
            _check_feet(env.robot)
        self._joints = tuple(torch.as_tensor(part, device=env.device) for part in joints)
        self._groups = {}
        for name, group in env.config.observations.groups.items():
            parts, widths = [], env.observation_widths(name)
            for term_name, term in group.terms.items():
                parts += _parts(f"observations.groups.{name}.terms.{term_name}", term, widths[term_name], joints)
            index, sign, start = [], [], 0
            for part_index, part_sign in parts:
                index.append(part_index + start)
                sign.append(part_sign)
                start += len(part_index)
            self._groups[name] = (
                torch.as_tensor(np.concatenate(index), device=env.device),
                torch.as_tensor(np.concatenate(sign), device=env.device),
            )

    def __call__(
        self, env: OmniEnv | MixedEnv, obs: TensorDict | None, actions: torch.Tensor | None
    ) -> tuple[TensorDict | None, torch.Tensor | None]:
        """Samples (B, ...), then their mirror images: (2 B, ...)."""
        if obs is not None:
            images = {}
            for name, value in obs.items():
                assert isinstance(value, torch.Tensor)  # groups of observations are not nested
                images[name] = self._with_image(value, *self._groups[name])
            obs = TensorDict(images, batch_size=[2 * len(obs)])
        if actions is not None:
            actions = self._with_image(actions, *self._joints)
        return obs, actions

    def _with_image(self, value: torch.Tensor, index: torch.Tensor, sign: torch.Tensor) -> torch.Tensor:
        """(B, history * width) -> (2 B, history * width)."""
        steps = value.unflatten(1, (-1, len(index)))
        return torch.cat((value, (steps[..., index] * sign).flatten(1)))


def mirrored_joints(robot: RobotConfig) -> tuple[np.ndarray, np.ndarray]:
    """For each joint the one that is its mirror image (index), and the sign of its angle in the mirror.

    Raises:
        ValueError: a joint has no mirror image, or the default pose is not its own.
    """
    if robot.locked:
        held, angles = tuple(robot.locked), np.array(list(robot.locked.values()))
        twins, signs = joint_twins(compile_robot(read_robot(robot.path()), robot.file), robot.base, held)
        if not np.allclose(angles[twins] * signs, angles, atol=_SAME):
            raise ValueError("ppo.symmetry=true: robot.locked is not its own mirror image; set ppo.symmetry=false")
    index, sign = joint_twins(robot.compiled(), robot.base, robot.joints)
    default = np.array(robot.by_joint("default_joint_pos"))
    if not np.allclose(default[index] * sign, default, atol=_SAME):
        raise ValueError(
            "ppo.symmetry=true: robot.default_joint_pos is not its own mirror image; set ppo.symmetry=false"
        )
    return index, sign


def _check_feet(robot: RobotConfig) -> None:
    """The mirror image of the clock is half a period off, so the feet of a pair must step in turn.

    Raises:
        ValueError: they do not.
    """
    if robot.gait is None:
        return
    model = robot.compiled()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    ids = [model.geom(name).id for name in robot.foot_names]
    at = (data.geom_xpos[ids] - data.body(robot.base).xpos) @ data.body(robot.base).xmat.reshape(3, 3)
    twins = np.linalg.norm(at[:, None] - at * VECTOR, axis=2).argmin(1)
    offsets = np.array(robot.gait.offsets)
    if not np.allclose((offsets[twins] - offsets) % 1.0, 0.5, atol=_SAME):
        raise ValueError(
            f"ppo.symmetry=true: with robot.gait.offsets={offsets.tolist()} left and right feet do not step half a"
            " period apart, as the mirror image of the observed clock does; set ppo.symmetry=false"
        )


def joint_twins(model: mujoco.MjModel, base: str, joints: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """`mirrored_joints` of any model, whatever its default pose.

    Found at joint angles of 0 from the joints' anchors and axes: an axis is axial, (x, y, z) -> (-x, y, -z).
    """
    data = mujoco.MjData(model)
    data.qpos[:7] = (0, 0, 0, 1, 0, 0, 0)
    for name in joints:
        data.joint(name).qpos = 0
    mujoco.mj_kinematics(model, data)
    ids = [model.joint(name).id for name in joints]
    anchor, axis = data.xanchor[ids] - data.body(base).xpos, data.xaxis[ids]
    index, sign = np.zeros(len(ids), np.int64), np.zeros(len(ids), np.float32)
    for j, name in enumerate(joints):
        there = np.linalg.norm(anchor - anchor[j] * VECTOR, axis=1) < _SAME
        along = axis @ (axis[j] * ROTATION)
        twins = np.flatnonzero(there & (np.abs(along) > 1 - _SAME))
        if len(twins) != 1:
            raise ValueError(
                f"ppo.symmetry=true: no single joint of robot.joints is the mirror image of {name} at angles of 0;"
                " set ppo.symmetry=false"
            )
        index[j], sign[j] = twins[0], np.sign(along[twins[0]])
    return index, sign


_SAME = 1e-3
"""Difference (m, rad, cosine) up to which two joints are mirror images."""


def _parts(
    name: str, term: Callable, width: int, joints: tuple[np.ndarray, np.ndarray]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Index and sign of each part of a term."""
    declared = getattr(term.func if isinstance(term, partial) else term, "mirror", None)
    if declared is None:
        raise ValueError(
            f"ppo.symmetry=true: {name} does not say how it looks in the mirror; declare it with @mirrors(...), or set"
            " ppo.symmetry=false"
        )
    index, _ = joints
    of_joints = {JOINTS: joints, JOINT_MAGNITUDES: (index, np.ones(len(index), np.float32))}
    parts = []
    for part in declared:
        parts.append(of_joints[part] if part in of_joints else (np.arange(len(part)), np.asarray(part, np.float32)))
    total = sum(len(index) for index, _ in parts)
    if len(parts) == 1 and width % total == 0:
        parts, total = parts * (width // total), width
    if total != width:
        raise ValueError(f"ppo.symmetry=true: {name} declares the mirror image of {total} numbers, but has {width}")
    return parts
