"""Articulated obstacles from files: the parts of an MJCF or URDF, whose hinges swing through their ranges."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import mujoco
import numpy as np

from omniperception.scene.meshes import compiled, mesh_vertices
from omniperception.scene.parts import GEOM_TYPES, SIZES, PartConfig, SwingConfig

SUFFIXES = (".xml", ".mjcf", ".urdf")
_KINDS = {int(geom_type): kind for kind, geom_type in GEOM_TYPES.items()}
"""Kind of a part by the type of its geom."""


def is_thing(file: str) -> bool:
    """Tell whether a file's name is that of an articulated thing."""
    return Path(file).suffix.lower() in SUFFIXES


@cache
def parts_of(file: str, frequency: float) -> dict[str, PartConfig]:
    """Parts by name of a thing, in the file's frame: z = 0 is the ground, x is ahead.

    Every geom that can touch something (contype or conaffinity) is a part; of a mesh its hull. A part whose chain of
    bodies has a hinge swings through the hinge's range, `frequency` times a second (0: it stands in the middle). A free
    joint is left out: the obstacle's group says where it is and how it moves.

    Raises:
        ValueError: one line that names the file, the element and what was expected.
    """
    model = compiled(file)
    data = mujoco.MjData(model)
    for joint in range(model.njnt):
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
            data.qpos[model.jnt_qposadr[joint]] = _middle(model, joint)
    mujoco.mj_kinematics(model, data)
    geoms = [k for k in range(model.ngeom) if model.geom_contype[k] or model.geom_conaffinity[k]]
    if not geoms:
        raise ValueError(f"obstacles: file={file} has no geom that can touch something (contype or conaffinity)")
    names = [_name(model, k) for k in geoms]
    return {name: _part(file, model, data, k, frequency) for name, k in zip(names, geoms, strict=True)}


def _name(model: mujoco.MjModel, geom: int) -> str:
    """The geom's own name, or its body's and its number."""
    return model.geom(geom).name or f"{model.body(model.geom_bodyid[geom]).name or 'body'}_{geom}"


def _part(file: str, model: mujoco.MjModel, data: mujoco.MjData, geom: int, frequency: float) -> PartConfig:
    """The part that a geom is, with hinges in the middles of their ranges."""
    kind, mesh, size = int(model.geom_type[geom]), None, model.geom_size[geom]
    turn, middle = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    kind_name = _KINDS.get(kind)
    if kind_name == "mesh":
        name = model.mesh(model.geom_dataid[geom]).name
        vertices = mesh_vertices(file, name)
        low, high = vertices.min(0), vertices.max(0)
        size, mesh, middle = (high - low) / 2, f"{file}#{name}", middle + turn @ (low + high) / 2
    elif kind_name is not None:
        size = size[: len(SIZES[kind_name])]
    else:
        found = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
        raise ValueError(
            f"obstacles: geom {_name(model, geom)} of {file} is of type {found}; expected are box, cylinder, sphere,"
            " capsule and mesh"
        )
    given = {"size": size.tolist(), "rpy_deg": _rpy_deg(turn), "file": mesh}
    hinge = _hinge(file, model, geom)
    if hinge is None or not frequency:
        return PartConfig(kind_name, pos=middle.tolist(), **given)
    anchor, axis = data.xanchor[hinge], turn.T @ data.xaxis[hinge]
    low, high = model.jnt_range[hinge]
    swing = SwingConfig(axis.tolist(), math.degrees(high - low) / 2, frequency)
    return PartConfig(kind_name, pos=anchor.tolist(), hang=(turn.T @ (middle - anchor)).tolist(), swing=swing, **given)


def _hinge(file: str, model: mujoco.MjModel, geom: int) -> int | None:
    """The joint that moves a geom; a ValueError unless it is one hinge with a range, or none."""
    joints: list[int] = []
    body = int(model.geom_bodyid[geom])
    while body:
        first = int(model.body_jntadr[body])
        joints += range(first, first + int(model.body_jntnum[body]))
        body = int(model.body_parentid[body])
    joints = [joint for joint in joints if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE]
    if not joints:
        return None
    names = ", ".join(model.joint(joint).name or f"number {joint}" for joint in joints)
    if len(joints) > 1 or model.jnt_type[joints[0]] != mujoco.mjtJoint.mjJNT_HINGE:
        raise ValueError(
            f"obstacles: geom {_name(model, geom)} of {file} is moved by {names}; expected is one hinge, or none"
        )
    if not model.jnt_limited[joints[0]] or not model.jnt_range[joints[0], 1] > model.jnt_range[joints[0], 0]:
        raise ValueError(f"obstacles: hinge {names} of {file} has no range; give it one: it swings through it")
    return joints[0]


def _middle(model: mujoco.MjModel, joint: int) -> float:
    return float(model.jnt_range[joint].mean()) if model.jnt_limited[joint] else 0.0


def _rpy_deg(turn: np.ndarray) -> list[float]:
    """Roll, pitch and yaw (deg) about fixed axes of a rotation matrix (3, 3)."""
    pitch = math.asin(float(np.clip(-turn[2, 0], -1.0, 1.0)))
    if abs(turn[2, 0]) < 1.0 - 1e-9:
        roll, yaw = math.atan2(turn[2, 1], turn[2, 2]), math.atan2(turn[1, 0], turn[0, 0])
    else:  # x points straight up or down: roll and yaw are about one axis
        roll, yaw = 0.0, math.atan2(-turn[0, 1], turn[1, 1])
    return [math.degrees(angle) for angle in (roll, pitch, yaw)]
