"""Protocol of a physics engine, as the task needs it."""

from __future__ import annotations

from enum import IntEnum
from typing import Protocol

import mujoco
import torch

from omniperception.scene import World

MAX_SPEED = 1e3
"""A generalised velocity (m/s or rad/s) beyond this is a diverged simulation."""
MAX_DISTANCE = 1e4
"""So is a generalised position (m or rad) beyond this, where float32 resolves 1 mm."""


class Failure(IntEnum):
    """Why a simulation cannot go on; 0 while it can."""

    NONE = 0
    ACTION = 1
    """It was given a joint target that is not finite."""
    NOT_FINITE = 2
    """Its state is not finite."""
    TOO_FAST = 3
    """It moves faster than anything physical."""
    TOO_FAR = 4
    """It is so far away that single precision no longer resolves a millimetre."""
    ENGINE = 5
    """The engine warned or gave up: a singular inertia, full contact buffers, an acceleration out of bounds."""


class Simulator(Protocol):
    """Many copies of one world, stepped together. Tensors are live; all are (num_envs, ...).

    States have the engine's own precision, float64 or float32.
    """

    world: World
    num_envs: int
    device: torch.device
    qpos: torch.Tensor
    """(num_envs, nq): base position (m, environment frame), quaternion (wxyz), joints (rad) in the order of the
    robot's file, passive ones among them; `robot_state` has `robot.joints` in their order."""
    qvel: torch.Tensor
    """(num_envs, nv): base linear velocity (m/s, world), angular velocity (rad/s, base), joints likewise."""
    mocap_pos: torch.Tensor
    """(num_envs, num_parts, 3): positions (m) of the kinematic bodies."""
    mocap_quat: torch.Tensor
    """(num_envs, num_parts, 4): their quaternions."""
    ground_pos: torch.Tensor | None
    """(num_envs, 3): where a ground that is a height field lies (m, environment frame); None for a plane."""
    failure: torch.Tensor
    """(num_envs,) int64: the first `Failure` of each simulation since its last reset."""

    @property
    def failed(self) -> torch.Tensor:
        """(num_envs,) bool: simulations with a failure since their last reset."""

    def robot_state(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(num_envs, 7 + num_joints) and (num_envs, 6 + num_joints), float32: copies of `qpos` and `qvel` with
        `robot.joints` in their order."""

    def recorded_states(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(num_envs, num_steps, 7 + num_joints) and (num_envs, num_steps, 6 + num_joints): `robot_state` after each
        physics step of the last call of `step`, of a simulator that records states; valid until the next call."""

    def step(
        self,
        joint_target: torch.Tensor,
        num_steps: int = 1,
        mocap_path: torch.Tensor | None = None,
        mocap_turn: torch.Tensor | None = None,
    ) -> None:
        """Physics steps with (num_envs, num_joints) joint position targets (rad).

        Args:
            joint_target: held through all steps; one that is not finite is a failure, and the last one goes on.
            num_steps: physics steps.
            mocap_path: (num_envs, num_steps, num_parts, 3), m: where the kinematic bodies are during
                each step; None leaves them where they are.
            mocap_turn: (num_envs, num_steps, num_parts, 4), their orientations likewise; None leaves them as they are.
        """

    def reset(self, env_ids: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
        """Puts environments `env_ids` (n,) into states (n, 7 + num_joints) and (n, 6 + num_joints), joints in the order
        of `robot.joints`; passive joints rest in the default pose."""

    def joint_torque(self) -> torch.Tensor:
        """(num_envs, num_joints) actuator torque (N m) of the last physics step.

        The first call begins the recording; it and whatever follows a reset gives 0 until the next step.
        """

    def contact_sensor(self, kind: str) -> torch.Tensor:
        """(num_envs, width) float32 readings of one kind of contact sensor in the last physics step.

        Forces (N, environment frame) are those that the geom exerts on what it touches: a foot that stands pushes down.
        """

    def touched(self, kind: str) -> torch.Tensor:
        """(num_envs,) bool: whether a sensor of that kind found a contact in any step of the last call."""

    def contact_impulse(self, kind: str) -> torch.Tensor:
        """(num_envs,) float32, N s: the sum over sensors of that kind, which measure forces, and over the steps of the
        last call of |force| * time step."""

    def body_poses(self, bodies: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions (num_envs, n, 3) (m) and quaternions (num_envs, n, 4) of bodies at the current state, float32."""

    def geom_poses(self, geoms: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions (num_envs, n, 3) (m) and rotation matrices (num_envs, n, 3, 3) of geoms, likewise."""

    def geom_motion(self, geoms: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions (m) and linear velocities (m/s), (num_envs, n, 3) each, of the centres of geoms, likewise."""

    def resize(self, geoms: tuple[int, ...], env_ids: torch.Tensor, sizes: torch.Tensor) -> None:
        """Gives geoms, k of them, sizes of their own in environments `env_ids` (n,), and contacts follow.

        Args:
            geoms: boxes, spheres, cylinders, capsules or ellipsoids, each the only geom of its body.
            env_ids: (n,) which environments.
            sizes: (n, k, 3) m, as MuJoCo has them; numbers that a kind does not read are ignored.

        Raises:
            ValueError: a geom is of another kind or shares its body.
        """

    def model_field(self, name: str) -> torch.Tensor:
        """(num_envs, ...) per-environment values of a model field, made per-environment on the first call."""

    def anomalies(self) -> dict[str, float]:
        """By name, how many environments reached a limit of the engine since the last call."""

    def state_dict(self) -> dict:
        """Everything that the physics needs to go on exactly."""

    def load_state_dict(self, state: dict) -> None:
        """Resumes from a `state_dict` of the same world and number of environments."""

    def mark_failed(self, which: torch.Tensor, cause: Failure) -> None:
        """Marks simulations `which` (num_envs,) bool as failed, keeping the first cause."""

    def detect_failures(self) -> None:
        """Marks simulations whose state is no longer one that a robot can be in."""

    def update_model(self, env_ids: torch.Tensor) -> None:
        """Recomputes what the engine derives from model fields that were written for environments `env_ids` (n,)."""


class Failures:
    """The part of a simulator that keeps which simulations failed."""

    device: torch.device
    qpos: torch.Tensor
    qvel: torch.Tensor
    failure: torch.Tensor

    @property
    def failed(self) -> torch.Tensor:
        """(num_envs,) bool."""
        return self.failure != Failure.NONE

    def mark_failed(self, which: torch.Tensor, cause: Failure) -> None:
        """See :meth:`Simulator.mark_failed`."""
        self.failure.copy_(torch.where(which & (self.failure == Failure.NONE), int(cause), self.failure))

    def finite_targets(self, target: torch.Tensor, last: torch.Tensor) -> torch.Tensor:
        """Targets (num_envs, k); of simulations where one is not finite, which have failed, the last ones."""
        finite = torch.isfinite(target).all(1)
        if self.device.type == "cpu" and bool(finite.all()):
            return target
        self.mark_failed(~finite, Failure.ACTION)
        return torch.where(finite[:, None], target.to(last.dtype), last)

    def detect_failures(self) -> None:
        """See :meth:`Simulator.detect_failures`; looks at the largest velocity and position."""
        speed, distance = self.qvel.abs().amax(1), self.qpos.abs().amax(1)
        if self.device.type == "cpu" and bool(((speed < MAX_SPEED) & (distance < MAX_DISTANCE)).all()):
            return
        self.mark_failed(~torch.isfinite(speed + distance), Failure.NOT_FINITE)
        self.mark_failed(speed >= MAX_SPEED, Failure.TOO_FAST)
        self.mark_failed(distance >= MAX_DISTANCE, Failure.TOO_FAR)


class SizedGeoms:
    """Geoms of a model that are resized together.

    Attributes:
        index: (k,) int64, their ids.
        shapes: how their kinds read sizes.
    """

    def __init__(self, model: mujoco.MjModel, geoms: tuple[int, ...], device: torch.device) -> None:
        from omnilidar.mujoco import geom_kind  # with what casts rays, which other tasks do without
        from omnilidar.sizes import ShapeSizes

        names = [f"geom {model.geom(k).name}" for k in geoms]
        for name, k in zip(names, geoms, strict=True):
            if model.body_geomnum[model.geom_bodyid[k]] != 1:
                raise ValueError(f"{name} shares its body with other geoms; only one alone can be resized")
        self.index = torch.tensor(geoms, dtype=torch.int64, device=device)
        self.shapes = ShapeSizes(names, [geom_kind(model, k) for k in geoms], device)

    def read(self, sizes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Sizes (n, k, 3) as the engine stores them, and half extents (n, k, 3) of the boxes that hold the geoms."""
        sizes = self.shapes.read(sizes)
        return sizes, self.shapes.half_extents(sizes)


class JointColumns:
    """The order of `robot.joints` and that of the robot's file, which may have passive joints besides; nothing is
    moved where they agree."""

    def __init__(self, world: World, device: torch.device) -> None:
        self._columns: tuple[torch.Tensor, ...] | None = None
        if world.joint_columns is not None:
            positions, velocities = (torch.tensor(columns, device=device) for columns in world.joint_columns)
            self._columns = positions, velocities
            self._rest = torch.tensor(world.rest_positions, device=device)
            self._num_velocities = world.model.nv

    def state(self, qpos: torch.Tensor, qvel: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The engine's positions (..., nq) and velocities (..., nv) as (..., 7 + num_joints) and (..., 6 +
        num_joints)."""
        if self._columns is None:
            return qpos, qvel
        positions, velocities = self._columns
        return qpos[..., positions], qvel[..., velocities]

    def engine_state(self, qpos: torch.Tensor, qvel: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The inverse of `state` for (n, ...) states, with passive joints at rest in the default pose."""
        if self._columns is None:
            return qpos, qvel
        positions, velocities = self._columns
        full_qpos = self._rest.to(qpos.dtype).repeat(len(qpos), 1)
        full_qvel = qvel.new_zeros(len(qvel), self._num_velocities)
        full_qpos[:, positions], full_qvel[:, velocities] = qpos, qvel
        return full_qpos, full_qvel
