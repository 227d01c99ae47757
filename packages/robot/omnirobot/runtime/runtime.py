"""Runs an exported policy: joint states, IMU and LiDAR points in, joint targets out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from omnirobot.runtime.description import (
    FILE,
    FINGERPRINT,
    DeployError,
    Description,
    Group,
    Lidar,
    checksum,
    export_line,
)
from omnirobot.runtime.odometry import Odometry, TimedOdometry
from omnirobot.runtime.safety import LidarStatus, Safety, SafetyConfig, SafetyStop
from omnirobot.runtime.sampling import Attitude, CloudSampler, down, make_sampler

if TYPE_CHECKING:
    from onnxruntime import InferenceSession


@dataclass(frozen=True)
class RobotState:
    """A robot's own measured state at a control step.

    Attributes:
        joint_pos: (num_joints,) rad, in the order of `Description.joints`.
        joint_vel: (num_joints,) rad/s.
        base_quat: (4,) orientation of the base in the world from the IMU, (w, x, y, z); the heading does not matter.
        base_ang_vel: (3,) angular velocity in the base frame from the gyroscope, rad/s.
        base_lin_vel: (3,) linear velocity in the base frame from a state estimator, m/s; None if the policy neither
            observes it nor follows the base's motion, or estimates it.
        joint_torque: (num_joints,) N m, measured; None: torques are not checked.
        other: readings, by name, of what the policy observes besides: training's terms with `measured_as`.
    """

    joint_pos: ArrayLike
    joint_vel: ArrayLike
    base_quat: ArrayLike
    base_ang_vel: ArrayLike
    base_lin_vel: ArrayLike | None = None
    joint_torque: ArrayLike | None = None
    other: Mapping[str, ArrayLike] | None = None


DEFAULT_SAFETY = SafetyConfig()


class ExportedPolicy:
    """The policy of one robot with its memory: proprioception, frames and the previous action.

    Call :meth:`step` once per `description.control_period_s`, with the points of a LiDAR frame whenever one is
    complete, once per `description.lidar.period_s`; where one is lost, call :meth:`repeat_frame`. Points are in the
    sensor frame, in metres, in the order of their measurement, without a correction for the robot's motion. Rows that
    are not finite or zero are misses, and so are points nearer or farther than training's sensor measures.

    Unless `safety` is None, commands are limited to the ranges of training and targets to the limits and a rate of the
    joints; without good frames the robot slows down and stands, blind, and it does not go where frames lack points; and
    :meth:`step` raises :class:`SafetyStop` when it leans too far, a joint or torque is where it cannot be, or a number
    is not finite.

    Attributes:
        description: names, scales and rates.
        safety: limits and what they did; None: none are applied, as in training.
        action: (num_joints,) float32, the newest action, before its target is limited, as in training.
        observation: (observation_size,) float32 that the newest action was computed from.
        frames: (history, num_points, 3) float32 sampled frames, newest last; None for a blind policy.
        frame_count: how many of the newest frames are valid.
        base_lin_vel: (3,) float32 m/s, base frame, that the policy has estimated; None where it estimates nothing, and
            before its first step.
    """

    def __init__(
        self, description: Description, session: InferenceSession, safety: SafetyConfig | None = DEFAULT_SAFETY
    ) -> None:
        self.description, self._session = description, session
        self.safety = Safety(description, safety) if safety is not None else None
        joints, perception = description.joints, description.perception
        self._default_pos = np.asarray(joints.default_pos, np.float32)
        self._sampler = make_sampler(perception.sampler) if perception is not None else None
        self._histories: dict[str, deque[np.ndarray]] = {
            group.name: deque(maxlen=group.history) for group in description.observations
        }
        self.frames: np.ndarray | None = None
        self._odometry: Odometry | TimedOdometry | None = None
        self._rays = _rays_of_points(description.lidar) if description.lidar is not None else np.zeros(0, np.int64)
        self.observation = np.zeros(description.observation_size, np.float32)
        self.reset()

    @classmethod
    def load(
        cls, folder: str | Path, num_threads: int = 1, safety: SafetyConfig | None = DEFAULT_SAFETY
    ) -> ExportedPolicy:
        """The policy in a folder that `omniperception export` wrote.

        Args:
            folder: with policy.json and the ONNX file.
            num_threads: CPU threads of the network.
            safety: limits; None for none.
        """
        folder = Path(folder)
        description = Description.read(folder)
        import onnxruntime

        if "onnx" not in description.files or not (folder / description.files["onnx"]).is_file():
            raise DeployError(f"{folder} has no ONNX file; write it: {export_line(folder)}")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = num_threads, 1
        path = folder / description.files["onnx"]
        try:
            session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own exceptions have no common base
            raise DeployError(f"{path} cannot be loaded ({str(error).splitlines()[0][:160]}); export again") from None
        belongs = session.get_modelmeta().custom_metadata_map.get(FINGERPRINT)
        if belongs != description.fingerprint or checksum(path) != description.checksums.get("onnx"):
            raise DeployError(f"{path} and {FILE} are not from the same export, or were changed; export again")
        return cls(description, session, safety)

    def clone(self) -> ExportedPolicy:
        """The same policy for another robot, which shares the network and nothing else."""
        return ExportedPolicy(self.description, self._session, self.safety.config if self.safety else None)

    def reset(self) -> None:
        """Clears all histories, as at the start of an episode: the next step's observation fills them."""
        self.action = np.zeros(len(self._default_pos), np.float32)
        self.pose = self._default_pos
        for history in self._histories.values():
            history.clear()
        self.frame_count = self._steps = self._steps_stood = 0
        self._has_missed = False
        self._reference = np.zeros(3, np.float32)
        self._asked = np.zeros(3 if self.description.turns else 2, np.float32)
        self.base_lin_vel: np.ndarray | None = None
        if self.safety is not None:
            self.safety.reset()
        perception = self.description.perception
        if perception is not None:
            self.frames = np.zeros((perception.history, perception.num_points, 3), np.float32)
        if perception is not None and perception.base_motion:
            kind = TimedOdometry if perception.times else Odometry
            self._odometry = kind(self.description.control_period_s)

    def subsample(self, points: np.ndarray, offsets_s: ArrayLike | None = None) -> np.ndarray:
        """The points of a device's frame that training would have kept, by the time of their measurement.

        Of what was trained with `lidar.selection=stratified`, as many, spread over the frame.

        Args:
            points: (n, 3) m; misses are zero, or left out.
            offsets_s: (n,) seconds of each point since the frame began; of several at one time, by lasers that fire
                together, none may have been left out. None: row k is the k-th that the device measured, so none at all.

        Returns:
            (num_rays, 3), zeros where a ray hit nothing or its point is lacking.
        """
        lidar = self._perception()[0]
        points = _cloud(points)
        if offsets_s is None:
            if not 0.95 <= len(points) / lidar.points_per_frame <= 1.05:
                raise DeployError(
                    f"points: a whole frame of {lidar.points_per_frame} was expected, {len(points)} given; where misses"
                    " are left out, give the points' times: subsample(points, offsets_s)"
                )
            numbers = np.arange(len(points))
        else:
            offsets = np.asarray(offsets_s, np.float64)
            if not (np.abs(offsets) <= 2.0 * lidar.period_s).all():
                raise DeployError(
                    f"offsets_s: seconds since the frame began, 0 to {lidar.period_s:g}, were expected,"
                    f" {offsets.min():g} to {offsets.max():g} given"
                )
            numbers = np.rint(offsets * (lidar.points_per_frame / lidar.period_s)).astype(np.int64)
            order = np.argsort(numbers, kind="stable")  # those of one time are of lasers that fire together, in order
            numbers[order] += np.arange(len(numbers)) - np.searchsorted(numbers[order], numbers[order])
        rays = self._rays
        inside = (numbers >= 0) & (numbers < len(rays))
        rows = rays[numbers[inside]]
        kept = np.zeros((lidar.num_rays, 3), np.float32)
        kept[rows[rows >= 0]] = points[inside][rows >= 0]
        return kept

    def add_frame(
        self, points: np.ndarray, base_quat: ArrayLike, joint_pos: ArrayLike | None = None, age_s: float = 0.0
    ) -> None:
        """Appends a LiDAR frame to the history, unless it holds too few hits; :meth:`step` does it for its points.

        Args:
            points: (n, 3) m in the sensor frame, in the order of measurement.
            base_quat: (4,) orientation of the base at the end of the frame, (w, x, y, z); now, where the policy reads
                `age_s`.
            joint_pos: (num_joints,) rad at that moment; needed where `description.lidar.carried_by` names joints.
            age_s: since the end of the frame; read where `description.perception.times` is true.
        """
        if not 0.0 <= age_s < np.inf:
            raise DeployError(f"age_s: seconds since the end of the frame were expected, at least 0, {age_s} given")
        lidar, sampler, frames = self._perception()
        points = _without_nearer(_cloud(points), lidar.min_range)
        if isinstance(self._odometry, TimedOdometry):
            base_quat = self._odometry.attitude(age_s)
        attitude = Attitude(self._carrier_quat(lidar, base_quat, joint_pos), lidar.mount_pos, lidar.mount_quat)
        if self.safety is not None and not self.safety.frame_is_good(points, attitude):
            return self.repeat_frame()
        frames[:-1] = frames[1:]
        frames[-1, : sampler.num_points] = sampler(points, attitude)
        if isinstance(self._odometry, TimedOdometry):
            frames[-1, -TimedOdometry.num_rows :] = self._odometry.take(age_s)
        elif self._odometry is not None:
            frames[-1, -1] = self._odometry.since_last_frame()
        self.frame_count = min(self.frame_count + 1, len(frames))

    def _carrier_quat(self, lidar: Lidar, base_quat: ArrayLike, joint_pos: ArrayLike | None) -> np.ndarray:
        """(4,) orientation of the link that carries the LiDAR."""
        quat = _quaternion(base_quat)
        if not lidar.carried_by:
            return quat
        names = list(self.description.joints.names)
        angles = np.zeros(0) if joint_pos is None else np.asarray(joint_pos, np.float64)
        if angles.shape != (len(names),):
            raise DeployError(
                f"joint_pos: the LiDAR is carried by {', '.join(turn.joint for turn in lidar.carried_by)}; angles of"
                f" {len(names)} joints were expected, {len(angles) or 'none'} given"
            )
        for turn in lidar.carried_by:
            half = 0.5 * (angles[names.index(turn.joint)] - turn.rest)
            own = np.array([np.cos(half), *(np.sin(half) * np.asarray(turn.axis, np.float64))])
            quat = _product(quat, _product(np.asarray(turn.quat, np.float64), own))
        return quat

    def repeat_frame(self) -> None:
        """Repeats the last frame in the history, with no motion of the base, where one was due and did not come.

        Training does the same (`randomization.frames_lost`); the motion of the next frame spans both periods.
        """
        frames = self._perception()[2]
        if self.safety is not None:
            self.safety.miss_frame()
        if not self.frame_count:
            return
        frames[:-1] = frames[1:]
        if isinstance(self._odometry, TimedOdometry):
            frames[-1, -TimedOdometry.num_rows :] = self._odometry.take(None)
            self._has_missed = True  # and is yet older once the step that begins has been taken in
        elif self._odometry is not None:
            frames[-1, -1] = 0.0
        self.frame_count = min(self.frame_count + 1, len(frames))

    def step(
        self,
        state: RobotState,
        command: ArrayLike,
        points: np.ndarray | None = None,
        age_s: float = 0.0,
        blind: bool = False,
    ) -> np.ndarray:
        """One control step.

        Args:
            state: what the robot senses of itself now.
            command: (3,) v_x, v_y (m/s) and yaw rate (rad/s) in the base frame.
            points: (n, 3) m in the sensor frame of a LiDAR frame that has just been completed; None without one.
            age_s: of that frame, see :meth:`add_frame`.
            blind: whether it acts as if nothing were near, and does as commanded.

        Returns:
            (num_joints,) float32 joint targets, rad, in the order of `description.joints`.

        Raises:
            SafetyStop: the joints must be damped now.
        """
        command = np.asarray(command, np.float32)
        if self.safety is not None:
            self._check(state, command, self.safety)
        if self._odometry is not None:
            self._odometry.advance(_quaternion(state.base_quat), self._velocity(state))
            if self._has_missed and isinstance(self._odometry, TimedOdometry) and self.frames is not None:
                self.frames[-1, -TimedOdometry.num_rows :] = self._odometry.take(None)
            self._has_missed = False
        if points is not None:
            self.add_frame(points, state.base_quat, state.joint_pos, age_s)
        if self.safety is not None:
            command = self.safety.limit_command(command)
            self._reference = self.safety.kept_to_covered(self._reference)
        self.observation = self._observe(state, command)
        self._follow(command)
        feed = {"observations": self.observation[None]}
        if self.frames is not None:
            blind |= self.safety is not None and self.safety.lidar_status is LidarStatus.STOPPED
            feed |= {"frames": self.frames[None], "frame_count": np.array([[0 if blind else self.frame_count]])}
        joints = self.description.joints
        if self.description.max_acceleration is not None:
            feed["last_asked"] = self._asked[None]
        found = self._session.run(None, feed)
        outputs = {name: output[0] for name, output in zip(self.description.outputs, found, strict=True)}
        self.base_lin_vel, self._asked = outputs.get("estimate"), outputs.get("asked", self._asked)
        self._steps += 1
        self.action = np.clip(outputs["actions"], -joints.action_limit, joints.action_limit)
        self.pose = self._default_pos + self._stepping_offset(command)
        self._steps_stood = 0 if np.any(command) else self._steps_stood + 1
        targets = self.pose + np.asarray(joints.action_scale, np.float32) * self.action
        if self.safety is None:
            return targets
        return self.safety.limit_targets(targets, np.asarray(state.joint_pos, np.float32))

    def _check(self, state: RobotState, command: np.ndarray, safety: Safety) -> None:
        """Raises SafetyStop where the state is no state to walk in, or a number is not finite."""
        given: dict[str, ArrayLike] = {
            name: getattr(state, name) for name in ("joint_pos", "joint_vel", "base_quat", "base_ang_vel")
        }
        given |= {} if state.base_lin_vel is None else {"base_lin_vel": state.base_lin_vel}
        for name, value in (given | dict(state.other or {})).items():
            if not np.isfinite(np.asarray(value, np.float64)).all():
                raise SafetyStop(f"{name}: finite numbers were expected, {np.asarray(value).tolist()} given")
        joint_pos, joint_vel = (np.asarray(value, np.float32) for value in (state.joint_pos, state.joint_vel))
        if joint_pos.shape == joint_vel.shape == self._default_pos.shape:  # otherwise the observation names it
            safety.check_state(-float(_projected_gravity(self, state, command)[2]), joint_pos, joint_vel)
        if state.joint_torque is not None:
            safety.check_torque(np.asarray(state.joint_torque, np.float32))
        if command.shape != (3,) or not np.isfinite(command).all():
            raise SafetyStop(f"command: 3 finite numbers were expected, {command} given")

    def reference(self, command: np.ndarray) -> np.ndarray:
        """(3,) the command as the policy observes it: it follows the given one no faster than in training."""
        return command if self.description.command_acceleration is None else self._reference

    def _follow(self, command: np.ndarray) -> None:
        """Moves what is observed at the next step towards the command."""
        if self.description.command_acceleration is None:
            return
        linear, angular = (rate * self.description.control_period_s for rate in self.description.command_acceleration)
        change = command - self._reference
        change[:2] *= linear / max(linear, float(np.hypot(*change[:2])))
        change[2] = np.clip(change[2], -angular, angular)
        self._reference = self._reference + change

    def _velocity(self, state: RobotState) -> np.ndarray:
        """(3,) m/s, base frame: estimated at the step before, or measured."""
        if not self.description.estimated:
            return _reading("base_lin_vel", state.base_lin_vel)
        return np.zeros(3, np.float32) if self.base_lin_vel is None else self.base_lin_vel

    def _observe(self, state: RobotState, command: ArrayLike) -> np.ndarray:
        parts: list[np.ndarray] = []
        for group in self.description.observations:
            history = self._histories[group.name]
            value = self._measure(group, state, command)
            history.extend([value] * (1 if history else group.history))
            parts += history
        return np.concatenate(parts)

    def _measure(self, group: Group, state: RobotState, command: ArrayLike) -> np.ndarray:
        """(width,) the group's terms at this step."""
        values = []
        for term in group.terms:
            name = term.quantity
            if term.frequency is not None:
                value = self._phase(term.frequency, term.rest_s, command)
            elif name in QUANTITIES:
                value = QUANTITIES[name](self, state, command)
            else:  # one that only this policy's training knows
                other = (state.other or {}).get(name)
                value = _reading(name, other, f"; give RobotState(..., other={{'{name}': ...}})")
            if value.shape != (term.size,):
                raise DeployError(f"{name}: shape ({term.size},) was expected, {value.shape} given")
            if not np.isfinite(value).all():
                raise DeployError(f"{name}: finite numbers were expected, {value} given")
            values.append(value * np.float32(term.scale))
        return np.concatenate(values)

    def _phase(self, frequency: float, rest_s: float, command: ArrayLike) -> np.ndarray:
        """(2,) sine and cosine of the clock since the last reset; 0 where it rests."""
        angle = 2 * np.pi * frequency * self._steps * self.description.control_period_s
        return np.array([np.sin(angle), np.cos(angle)], np.float32) * (not self._rests(rest_s, command))

    def _rests(self, rest_s: float, command: ArrayLike) -> bool:
        """Tell whether the command has been to stand for `rest_s`."""
        stood_s = self._steps_stood * self.description.control_period_s
        return not np.any(command) and stood_s > rest_s - 1e-3

    def _stepping_offset(self, command: ArrayLike) -> np.ndarray | float:
        """(num_joints,) rad: what lifts the feet at the end of the step that begins; see `Stepping`."""
        stepping = self.description.stepping
        if stepping is None or self._rests(stepping.rest_s, command):
            return 0.0
        rows = np.asarray(stepping.offsets, np.float32)
        place = stepping.frequency * self._steps * self.description.control_period_s % 1.0 * len(rows)
        row = int(place)
        now, following = rows[row % len(rows)], rows[(row + 1) % len(rows)]
        return now + np.float32(place - row) * (following - now)

    def _perception(self) -> tuple[Lidar, CloudSampler, np.ndarray]:
        """The sensor, the sampler and the history of frames of a policy that sees."""
        if self.description.lidar is None or self._sampler is None or self.frames is None:
            raise DeployError("this policy is blind: it was trained without a LiDAR and takes no points")
        return self.description.lidar, self._sampler, self.frames


def _rays_of_points(lidar: Lidar) -> np.ndarray:
    """(points_per_frame,) which of training's rays each point of a device's frame is, -1: none."""
    count = np.arange(lidar.num_rays)
    if lidar.keep_every is None:  # one of each part of the frame, so that it is not always the same laser's
        edges = np.arange(lidar.num_rays + 1) * lidar.points_per_frame // lidar.num_rays
        kept = np.random.default_rng(0).integers(edges[:-1], edges[1:])
    else:
        kept = count * lidar.keep_every
    rays = np.full(lidar.points_per_frame, -1)
    rays[kept] = count
    return rays


def _without_nearer(points: np.ndarray, min_range: float) -> np.ndarray:
    """(n, 3) m with points nearer than training's sensor measures made misses, as they are there."""
    nearest = np.float32((min_range * (1.0 - 1e-6)) ** 2)  # what training keeps is not lost by rounding
    return np.where((np.einsum("ij,ij->i", points, points) < nearest)[:, None], np.float32(0.0), points)


Quantity = Callable[[ExportedPolicy, RobotState, ArrayLike], np.ndarray]
"""Observations of a policy, from the robot's state and the command."""


def _cloud(points: ArrayLike) -> np.ndarray:
    """(n, 3) float32 points; another shape is refused."""
    cloud = np.asarray(points, np.float32)
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise DeployError(f"points: shape (n, 3) was expected, {cloud.shape} given")
    return cloud


def _reading(name: str, value: ArrayLike | None, remedy: str = ", None was given") -> np.ndarray:
    """float32 of a reading that the policy needs."""
    if value is None:
        raise DeployError(f"{name}: this policy observes it{remedy}")
    return np.asarray(value, np.float32)


def _joint_pos_offset(policy: ExportedPolicy, state: RobotState, command: ArrayLike) -> np.ndarray:
    """Joint position relative to the default pose, rad."""
    joint_pos = np.asarray(state.joint_pos, np.float32)
    return joint_pos - policy._default_pos if joint_pos.shape == policy._default_pos.shape else joint_pos


def _projected_gravity(policy: ExportedPolicy, state: RobotState, command: ArrayLike) -> np.ndarray:
    """Unit vector of gravity in the base frame."""
    return down(_quaternion(state.base_quat)).astype(np.float32)


def _quaternion(given: ArrayLike) -> np.ndarray:
    """(4,) float64 of unit length."""
    quat = np.asarray(given, np.float64)
    length = float(np.linalg.norm(quat)) if quat.shape == (4,) else float("nan")
    if not abs(length - 1.0) < 1e-2:
        raise SafetyStop(f"base_quat: a unit quaternion (w, x, y, z) was expected, {quat.tolist()} given")
    return quat / length


def _product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(4,) the turn q, then p, both (w, x, y, z)."""
    w, vector = p[0] * q[0] - p[1:] @ q[1:], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.array([w, *vector])


QUANTITIES: dict[str, Quantity] = {
    "joint_pos_offset": _joint_pos_offset,
    "joint_vel": lambda policy, state, command: _reading("joint_vel", state.joint_vel),
    "base_lin_vel": lambda policy, state, command: _reading("base_lin_vel", state.base_lin_vel),
    "base_ang_vel": lambda policy, state, command: _reading("base_ang_vel", state.base_ang_vel),
    "projected_gravity": _projected_gravity,
    "command": lambda policy, state, command: policy.reference(np.asarray(command, np.float32)),
    "previous_action": lambda policy, state, command: policy.action,
}
"""Quantities that a policy can observe, by the name of training's observation term."""
