"""The robot preset: its MJCF, default pose, PD gains, and which of its parts play which role."""

from __future__ import annotations

import importlib.resources
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco


@dataclass(frozen=True)
class Mount:
    """A place for a LiDAR on the base.

    Attributes:
        pos: (x, y, z) of the sensor in the base frame (m).
        rpy: orientation of the sensor in the base frame: roll, pitch, yaw about fixed axes (rad).
        exclude_geoms: geoms of the robot that the rays pass through: the housing around the sensor.
    """

    pos: Sequence[float]
    rpy: Sequence[float] = (0.0, 0.0, 0.0)
    exclude_geoms: Sequence[str] = ()


@dataclass(frozen=True)
class RobotConfig:
    """A legged robot.

    Attributes:
        mjcf: a file in `omniperception/scene/assets`, or a path to a user's own MJCF without actuators.
        base: name of the free-floating base body.
        joints: all joints but the base's free one, in the order of actions, joint observations and the exported policy;
            the file may have them in any order.
        default_joint_pos: joint angle (rad) of the default pose, by joint name.
        base_height: height (m) of the base origin above the ground in the default pose.
        kp: proportional gain (N m / rad) of the joint position actuators.
        kv: derivative gain (N m s / rad).
        torque_limits: torque limit (N m), by joint name.
        action_scale: joint target = default + action_scale * action (rad).
        foot_geoms: geoms that carry the robot.
        penalized_geoms: links whose contact forces the link-collision reward penalises.
        frictionloss: dry friction (N m) of every joint.
        mounts: places for a LiDAR, by name.
    """

    mjcf: str
    base: str
    joints: tuple[str, ...]
    default_joint_pos: Mapping[str, float]
    base_height: float
    kp: float
    kv: float
    torque_limits: Mapping[str, float]
    action_scale: float
    foot_geoms: tuple[str, ...]
    penalized_geoms: tuple[str, ...]
    frictionloss: float = 0.0
    mounts: Mapping[str, Mount] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("joints", "foot_geoms", "penalized_geoms"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name in ("base_height", "kp", "action_scale"):
            if getattr(self, name) <= 0:
                raise ValueError(f"robot.{name}={getattr(self, name)} must be positive")
        if self.kv < 0 or self.frictionloss < 0:
            raise ValueError(f"robot.kv={self.kv} and robot.frictionloss={self.frictionloss} must not be negative")
        if len(set(self.joints)) != len(self.joints):
            twice = sorted({name for name in self.joints if self.joints.count(name) > 1})
            raise ValueError(f"robot.joints names {', '.join(twice)} more than once")
        for name in ("default_joint_pos", "torque_limits"):
            missing = set(self.joints) ^ set(getattr(self, name))
            if missing:
                raise ValueError(f"robot.{name} must name exactly robot.joints; differing: {sorted(missing)}")

    @property
    def num_joints(self) -> int:
        return len(self.joints)

    def spec(self) -> mujoco.MjSpec:
        """The robot's MJCF with position actuators (PD with torque limit) added in the order of `joints`."""
        spec = mujoco.MjSpec.from_file(str(self._mjcf_path()))
        for name in self.joints:
            joint = spec.joint(name)
            if joint is None:
                known = ", ".join(joint.name for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE)
                raise ValueError(f"robot.joints names {name}, which {self.mjcf} does not have; known: {known}")
            joint.frictionloss = self.frictionloss
            actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.set_to_position(kp=self.kp, kv=self.kv)
            limit = self.torque_limits[name]
            actuator.forcerange = [-limit, limit]
        return spec

    def _mjcf_path(self) -> Path:
        asset = importlib.resources.files("omniperception.scene") / "assets" / self.mjcf
        path = Path(str(asset)) if asset.is_file() else Path(self.mjcf)
        if not path.is_file():
            raise ValueError(f"robot.mjcf={self.mjcf} is neither a packaged asset nor a file")
        return path
