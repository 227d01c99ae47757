"""The robot preset: its file, default pose, gains, and which of its parts play which role."""

from __future__ import annotations

import importlib.resources
import os
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
from pydantic import Field, SkipValidation

from omniperception.common.checked import AsTuple, Counts, Inside, Names, NonNegative, Pair, Point, Positive, checked
from omniperception.scene.fetched import SCHEME, fetched
from omniperception.scene.robot_file import (
    FRAME,
    carrier,
    collides,
    compile_robot,
    drop_unseen,
    lock,
    read_robot,
    rigid_geoms,
)
from omnirobot.common.errors import repeated

ByJoint = float | Mapping[str, float]
"""One number for all joints, or one for each by name."""


@checked("robot.mounts: ")
class Mount:
    """A place for a LiDAR on the robot.

    Attributes:
        pos: (x, y, z) of the sensor in the frame of `body` (m).
        rpy: orientation of the sensor in that frame: roll, pitch, yaw about fixed axes (rad).
        exclude_geoms: geoms of the robot that the rays pass through: the housing around the sensor, in each form that
            the file has of it.
        body: link that carries the sensor; None: the base.
    """

    pos: Point
    rpy: Point = (0.0, 0.0, 0.0)
    exclude_geoms: Names = ()
    body: str | None = None


@dataclass(frozen=True)
class SensorPose:
    """Where a sensor is.

    Attributes:
        body: the moving link that carries it, of the compiled model; None: the base, or what is fixed to it.
        pos: m, in that link's frame.
        quat: (w, x, y, z), likewise.
    """

    body: str | None
    pos: tuple[float, float, float]
    quat: tuple[float, float, float, float]


_Phases = Annotated[tuple[Annotated[float, Field(ge=0, lt=1)], ...], AsTuple, "shares of a period, from 0 to below 1"]


@checked("robot.gait")
class Gait:
    """How a robot walks: its rhythm, for rewards and observations that follow a clock, and how fast it shall be.

    Attributes:
        frequency: steps of each foot per second (Hz).
        offsets: when each foot's step begins after the clock's, in periods, in the order of the robot's feet.
        duty: share of a step for which a foot is down.
        foot_height: height (m) above the ground to which a foot's centre rises.
        lift: how high feet are lifted while it steps on the spot (`SteppingConfig`), as a share of foot_height.
        lin_vel_x, lin_vel_y, ang_vel_z: least and most velocity (m/s, m/s, rad/s) that experiment=gait asks of it.
    """

    frequency: Positive
    offsets: _Phases
    duty: Inside
    foot_height: Positive
    lift: Positive
    lin_vel_x: Pair
    lin_vel_y: Pair
    ang_vel_z: Pair


_BY_JOINT = ("kp", "kv", "torque_limits", "action_scale", "frictionloss", "armature", "damping")
"""What a preset has as one number, or as one by joint."""


_Outline = Annotated[tuple[Positive, Positive, Positive], AsTuple, "three positive lengths (m): behind, before, beside"]
_Footprint = Annotated[tuple[NonNegative, NonNegative], AsTuple, "[half length, half width] (m), not negative"]
_Pairs = Annotated[tuple[Annotated[tuple[str, str], AsTuple], ...], AsTuple, "pairs of bodies"]
_Feet = Annotated[tuple[str | Names, ...], AsTuple, "a list of geoms, or of lists of them"]


@checked("robot")
class RobotConfig:
    """A legged robot.

    Parts of the file that have no name are called after their body: the first geom without a name of body `calf` is
    `calf_geom_0`.

    Attributes:
        file: MJCF or URDF: one of `omniperception/scene/assets`, `fetched:` and a place in the cache of `robot-fetch`,
            or a path. Its actuators, sensors and keyframes are not used; the root link of a URDF floats.
        base: name of the free-floating base body.
        joints: joints that are actuated, in the order of actions, joint observations and the exported policy; the file
            may have them in any order. All others but the base's and `locked` are passive: nothing drives or observes
            them.
        default_joint_pos: joint angle (rad) of the default pose, by joint name; passive joints may be named, too, and
            otherwise start as in the file.
        base_height: height (m) of the base origin above the ground in the default pose.
        kp: proportional gain (N m / rad) of the joint position actuators.
        kv: derivative gain (N m s / rad).
        torque_limits: torque limit (N m).
        action_scale: joint target = default + action_scale * action (rad).
        foot_geoms: geoms that carry the robot; a foot of several is a list of them.
        penalized_geoms: links whose contact forces the link-collision reward penalises.
        footprint: half length and half width (m) of the rectangle around the base at whose corners, and in whose
            middle, the ground is looked up from which the base's height is measured.
        footing: distance (m) from the base within which no ground is higher than the feet when a robot starts.
        outline: how far (m) the robot reaches behind, before and beside the base's origin while it walks: what a LiDAR
            sees within is taken for the robot itself.
        height: (m) above the ground from which on a thing hangs too high to be in the robot's way.
        radius, half_length: (m) of the capsule that avoidance takes the robot for: all within `radius` of a line from
            `half_length` behind to as much before the base's origin.
        min_base_height: height (m) of the base origin above the ground below which the robot has fallen.
        frictionloss: dry friction (N m) of the actuated joints; None: as in the file.
        armature: rotor inertia (kg m^2) of the actuated joints, seen from the joint; None: as in the file.
        damping: viscous friction (N m s / rad) of the actuated joints; None: as in the file.
        self_collision: pairs of bodies that can touch each other, with what is fixed to them. Others pass through each
            other; none: the robot never touches itself.
        ray_groups: geom groups of the file that LiDAR rays can hit; None: the geoms that can be touched.
        mounts: places for a LiDAR, by name.
        locked: angle (rad; m of a slide) of joints that are held, by name: their links become part of what carries
            them, and all else that the preset says of them does not count. A real robot has to hold them there.
        gait: the rhythm in which it walks; None: nothing may ask for one.
    """

    file: str
    base: str
    joints: Names
    default_joint_pos: Mapping[str, float]
    base_height: Positive
    kp: ByJoint
    kv: ByJoint
    torque_limits: ByJoint
    action_scale: ByJoint
    foot_geoms: _Feet
    penalized_geoms: Names
    footprint: _Footprint
    footing: Positive
    outline: _Outline
    height: Positive
    radius: Positive
    min_base_height: NonNegative
    frictionloss: ByJoint | None = None
    armature: ByJoint | None = None
    damping: ByJoint | None = None
    self_collision: _Pairs = ()
    ray_groups: Counts | None = None
    mounts: Mapping[str, SkipValidation[Mount]] = field(default_factory=dict)
    locked: Mapping[str, float] = field(default_factory=dict)
    gait: Gait | None = None
    half_length: NonNegative = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", tuple(joint for joint in self.joints if joint not in self.locked))
        if not self.joints:
            raise ValueError("robot.joints without those of robot.locked is empty; a robot needs a joint to drive")
        for name in ("default_joint_pos", *_BY_JOINT):
            given = getattr(self, name)
            if isinstance(given, Mapping):
                kept = {joint: value for joint, value in given.items() if joint not in self.locked}
                object.__setattr__(self, name, kept)
        if not self.foot_geoms or not all(self.foot_geoms):
            raise ValueError("robot.foot_geoms has an empty list; a robot needs feet, and a foot at least one geom")
        geoms = [geom for foot in self.feet for geom in foot]
        for name, names in (("joints", self.joints), ("foot_geoms", geoms)):
            if twice := repeated(names):
                raise ValueError(f"robot.{name} names {', '.join(twice)} more than once")
        missing = sorted(set(self.joints) - set(self.default_joint_pos))
        if missing:
            raise ValueError(f"robot.default_joint_pos must name all of robot.joints; missing: {missing}")
        if self.gait is not None and len(self.gait.offsets) != len(self.feet):
            raise ValueError(
                f"robot.gait.offsets={list(self.gait.offsets)} must have one for each of the {len(self.feet)} feet"
            )
        for name in _BY_JOINT:
            self._check_by_joint(name, positive=name in ("kp", "torque_limits", "action_scale"))

    def _check_by_joint(self, name: str, positive: bool) -> None:
        given = getattr(self, name)
        if isinstance(given, Mapping):
            differing = sorted(set(self.joints) ^ set(given))
            if differing:
                raise ValueError(f"robot.{name} must name exactly robot.joints, or be a number; differing: {differing}")
        values = given if isinstance(given, Mapping) else {} if given is None else {"": given}
        for joint, value in values.items():
            if value < 0 or (positive and value == 0):
                key = f"{name}.{joint}".rstrip(".")
                raise ValueError(f"robot.{key}={value} must {'be positive' if positive else 'not be negative'}")

    @property
    def num_joints(self) -> int:
        return len(self.joints)

    @property
    def feet(self) -> tuple[tuple[str, ...], ...]:
        """The geoms of each foot."""
        return tuple((foot,) if isinstance(foot, str) else foot for foot in self.foot_geoms)

    @property
    def foot_names(self) -> tuple[str, ...]:
        """Each foot by its first geom."""
        return tuple(foot[0] for foot in self.feet)

    def by_joint(self, name: str) -> tuple[float, ...]:
        """`kp`, `kv`, `torque_limits`, `action_scale` or `default_joint_pos` of each of `joints`, in their order."""
        given = getattr(self, name)
        return tuple(given[joint] if isinstance(given, Mapping) else given for joint in self.joints)

    def spec(self) -> mujoco.MjSpec:
        """The robot's file with position actuators (PD with torque limit) in the order of `joints`."""
        spec = read_robot(self.path())
        if spec.body(self.base) is None:
            known = ", ".join(body.name for body in spec.bodies[1:])
            raise ValueError(f"robot.base={self.base} is no body of {self.file}; known: {known}")
        lock(spec, self.locked, self.file)
        for pair in list(spec.pairs):  # who touches whom is said by self_collision alone
            spec.delete(pair)
        gains = zip(*(self.by_joint(name) for name in ("kp", "kv", "torque_limits")), strict=True)
        for name, (kp, kv, limit) in zip(self.joints, gains, strict=True):
            joint = spec.joint(name)
            if joint is None:
                known = ", ".join(joint.name for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE)
                raise ValueError(f"robot.joints names {name}, which {self.file} does not have; known: {known}")
            self._set_joint(joint)
            actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.set_to_position(kp=kp, kv=kv)
            actuator.forcerange, actuator.forcelimited = [-limit, limit], mujoco.mjtLimited.mjLIMITED_TRUE
            joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE  # a URDF's effort would cap it besides
        self._add_self_collision(spec)
        return spec

    def compiled(self) -> mujoco.MjModel:
        """The robot alone, without geoms that nothing touches and no ray hits."""
        spec = self.spec()
        drop_unseen(spec, self.ray_groups)
        return compile_robot(spec, self.file)

    def _set_joint(self, joint: mujoco.MjsJoint) -> None:
        for name in ("frictionloss", "armature", "damping"):
            given = getattr(self, name)
            if given is not None:
                value = given[joint.name] if isinstance(given, Mapping) else given
                setattr(joint, name, [value, 0.0, 0.0] if name == "damping" else value)

    def _add_self_collision(self, spec: mujoco.MjSpec) -> None:
        for first, second in self.self_collision:
            bodies = [spec.body(name) for name in (first, second)]
            for name, body in zip((first, second), bodies, strict=True):
                if body is None:
                    known = ", ".join(body.name for body in spec.bodies[1:])
                    raise ValueError(
                        f"robot.self_collision names {name}, which {self.file} does not have; known: {known}"
                    )
            if carrier(bodies[0]) == carrier(bodies[1]):  # locked joints have fixed them to each other
                continue
            touching = [[geom.name for geom in rigid_geoms(body) if collides(geom)] for body in bodies]
            for geom in touching[0]:
                for other in touching[1]:
                    spec.add_pair(geomname1=geom, geomname2=other)

    def built_geoms(self, names: Iterable[str], built: Collection[str]) -> tuple[str, ...]:
        """Those of a mount's `exclude_geoms` that are built: some are of the robot as meshes, others as primitives.

        Args:
            names: of geoms.
            built: names of those that are.

        Raises:
            ValueError: the file does not have one.
        """
        given = tuple(names)
        if not set(given) <= set(built):
            known = dict.fromkeys((*built, *(geom.name for geom in read_robot(self.path()).geoms)))
            unknown = sorted(set(given) - known.keys())
            if unknown:
                raise ValueError(
                    f"robot.mounts: exclude_geoms names {', '.join(unknown)}; known: {', '.join(filter(None, known))}"
                )
        return tuple(name for name in given if name in built)

    def place(self, mount: Mount) -> SensorPose:
        """A mount in the frame of the moving link that carries it."""
        pos, quat = np.array(mount.pos, np.float64), np.empty(4)
        mujoco.mju_euler2Quat(quat, np.array(mount.rpy, np.float64), "XYZ")
        if mount.body is None or mount.body == self.base:
            return SensorPose(None, _vector(pos), _quaternion(quat))
        model = self.compiled()
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        link, link_pos, link_quat = _frame(model, data, mount.body, self.file)
        base = model.body(self.base).id
        carrier = base if model.body_weldid[link] == model.body_weldid[base] else int(model.body_weldid[link])
        back, turn, at, moved = np.empty(4), np.empty(4), np.empty(3), np.empty(4)
        mujoco.mju_negQuat(back, data.xquat[carrier])
        mujoco.mju_mulQuat(turn, back, link_quat)
        mujoco.mju_rotVecQuat(at, link_pos - data.xpos[carrier], back)
        mujoco.mju_rotVecQuat(pos, pos.copy(), turn)
        mujoco.mju_mulQuat(moved, turn, quat)
        return SensorPose(None if carrier == base else model.body(carrier).name, _vector(at + pos), _quaternion(moved))

    def height_of(self, link: str | None) -> float:
        """Height (m) of a moving link's origin above the ground in the default pose; of the base's for None."""
        if link is None:
            return self.base_height
        data = self.posed(self.compiled())
        return self.base_height + float(data.body(link).xpos[2] - data.body(self.base).xpos[2])

    def posed(self, model: mujoco.MjModel) -> mujoco.MjData:
        """The default pose, the base upright at its height above where it is in the file; kinematics are up to date."""
        data = mujoco.MjData(model)
        start = model.jnt_qposadr[model.body(self.base).jntadr[0]]
        data.qpos[start + 2 : start + 7] = self.base_height, 1.0, 0.0, 0.0, 0.0
        for name, angle in self.default_joint_pos.items():
            data.joint(name).qpos = angle
        mujoco.mj_kinematics(model, data)
        return data

    def path(self) -> Path:
        """The robot's file; a packaged one by its name alone, a downloaded one as `fetched:...`."""
        if self.file.startswith(SCHEME):
            return fetched(self.file)
        asset = importlib.resources.files("omniperception.scene") / "assets" / self.file
        path = Path(str(asset)) if asset.is_file() else Path(os.path.expanduser(self.file))
        if not path.is_file():
            raise ValueError(f"robot.file={self.file} is neither a packaged asset nor a file")
        return path


def _frame(model: mujoco.MjModel, data: mujoco.MjData, link: str, file: str) -> tuple[int, np.ndarray, np.ndarray]:
    """Body, position (m) and quaternion of a link, which may have been fused into another."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, link)
    if body > 0:
        return body, data.xpos[body], data.xquat[body]
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, FRAME + link)
    if site < 0:
        fused = [
            model.site(k).name.removeprefix(FRAME) for k in range(model.nsite) if model.site(k).name.startswith(FRAME)
        ]
        known = dict.fromkeys((*(model.body(k).name for k in range(1, model.nbody)), *fused))
        raise ValueError(f"robot.mounts: body={link} is no link of {file}; known: {', '.join(known)}")
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, data.site_xmat[site])
    return int(model.site_bodyid[site]), data.site_xpos[site], quat


def _vector(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _quaternion(values: np.ndarray) -> tuple[float, float, float, float]:
    w, x, y, z = values.tolist()
    return w, x, y, z
