"""What keeps an exported policy from harm: limits on its inputs and targets, and reasons to stop."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from enum import StrEnum

import numpy as np

from omnirobot.runtime.coverage import Coverage
from omnirobot.runtime.description import DeployError, Description
from omnirobot.runtime.sampling import Attitude, is_hit

log = logging.getLogger("omnirobot.runtime")


class SafetyStop(DeployError):
    """The policy must not move the robot any longer; the message says why. Let the joints be damped."""


class LidarStatus(StrEnum):
    """Whether a policy sees well enough to walk."""

    FRESH = "fresh"
    SLOWING = "slowing"
    STOPPED = "stopped"


@dataclass(frozen=True)
class SafetyConfig:
    """Limits of :class:`Safety`. The robot's own (joints, torques, commands) come from its description.

    Attributes:
        frame_age_s: the robot slows down when its newest good frame is older.
        slow_down_s: time in which the command then falls to 0, and in which it comes back.
        min_hits: least hits of a good frame, as a share of the rays that training used. A frame with fewer is empty
            or covered, not free space: a sensor on a robot always sees some ground.
        max_tilt_deg: most that the base may lean.
        joint_margin: most that a joint may be beyond its limits, rad; noise and play.
        max_joint_vel: most that a joint may turn, rad/s; the Go2's turn at up to 30.
        target_rate: most that a joint target may change, rad/s.
        torque_s: longest that a joint may give its whole torque, where torques are measured.
    """

    frame_age_s: float = 0.35
    slow_down_s: float = 0.3
    min_hits: float = 0.05
    max_tilt_deg: float = 50.0
    joint_margin: float = 0.2
    max_joint_vel: float = 50.0
    target_rate: float = 40.0
    torque_s: float = 0.5

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not (math.isfinite(value) and value > 0):
                raise DeployError(f"safety.{item.name}={value}: a number above 0 was expected")


class Safety:
    """Limits of one robot with their memory; :class:`~omnirobot.runtime.ExportedPolicy` calls it in every step.

    Attributes:
        config: the limits.
        counts: how often each limit has acted since the start, by name.
        lidar_status: whether frames are fresh; always for a blind policy.
        coverage: directions that the newest frames cover; None for a blind policy.
    """

    def __init__(self, description: Description, config: SafetyConfig) -> None:
        self.config, self._dt = config, description.control_period_s
        joints, lidar = description.joints, description.lidar
        self._names = tuple(joints.names)
        self._lower, self._upper = _or(joints.lower, -math.inf), _or(joints.upper, math.inf)
        self._torque_limits = np.asarray(joints.torque_limits, np.float32)
        self._command_low, self._command_high = command_limits(description.command).astype(np.float32)
        self._min_cos = math.cos(math.radians(config.max_tilt_deg))
        self._sees = lidar is not None and description.perception is not None
        self._min_hits = config.min_hits * lidar.num_rays if lidar is not None else 0.0
        self._max_range = lidar.max_range if lidar is not None else 0.0
        self.coverage = Coverage(lidar.least_bins, lidar.max_range) if self._sees and lidar is not None else None
        self.counts: Counter[str] = Counter()
        self.reset()

    def reset(self) -> None:
        """As at the start of an episode; the counts stay."""
        self.lidar_status, self._age, self._pace = LidarStatus.FRESH, 0.0, 1.0
        self._targets: np.ndarray | None = None
        self._strained, self._lacks = np.zeros(len(self._names), np.int64), False
        if self.coverage is not None:
            self.coverage.reset()

    def await_frame(self) -> None:
        """Holds a policy that sees at a command of 0 until a good frame comes; training begins without that wait."""
        if self._sees:
            self.lidar_status, self._age, self._pace = LidarStatus.STOPPED, math.inf, 0.0
            log.warning("standing until a good frame comes")

    def frame_is_good(self, points: np.ndarray, attitude: Attitude) -> bool:
        """Takes in a frame (n, 3), m; whether it holds enough hits. Counts and names it otherwise."""
        hits = int(is_hit(points, self._max_range).sum())
        if hits >= self._min_hits and hits:
            self._age = 0.0
            if self.coverage is not None:
                self.coverage.add_frame(points, attitude)
            return True
        self._count(
            logging.WARNING, "frames refused", f"a frame has {hits} hits, at least {self._min_hits:.0f} were expected"
        )
        return False

    def miss_frame(self) -> None:
        """Takes in that a frame was due and none, or none that is good, came."""
        if self.coverage is not None:
            self.coverage.repeat_frame()

    def limit_command(self, command: np.ndarray) -> np.ndarray:
        """(3,) the command within training's ranges and 0, slowed down while no good frame comes and where it leads to
        directions that frames lack; once per step.

        To stand is always allowed, also where training's ranges leave 0 out.
        """
        limited = np.clip(command, self._command_low, self._command_high)
        if (limited != command).any():
            self._count(
                logging.INFO, "commands limited", f"command {command.tolist()} is beyond training's: {limited.tolist()}"
            )
        self._look()
        limited = limited * np.float32(self._pace)
        if self.coverage is None or self.coverage.covered.all():
            self._lacks = False
            return limited
        if not self._lacks:
            self._lacks = True
            self._count(logging.WARNING, "frames in part", f"no points from {self.coverage.lacking()}: not going there")
        return self.kept_to_covered(limited)

    def kept_to_covered(self, command: np.ndarray) -> np.ndarray:
        """(3,) a command, slowed down where it leads into directions that frames lack."""
        if self.coverage is None:
            return command
        return np.concatenate((self.coverage.kept_to_covered(command[:2]), command[2:]))

    def check_state(self, cos_tilt: float, joint_pos: np.ndarray, joint_vel: np.ndarray) -> None:
        """Raises SafetyStop where the robot has fallen or its joints are where they cannot be.

        Args:
            cos_tilt: cosine of the angle between the base's and the world's vertical.
            joint_pos: (num_joints,) rad.
            joint_vel: (num_joints,) rad/s.
        """
        if not cos_tilt >= self._min_cos:
            tilt = math.degrees(math.acos(min(1.0, max(-1.0, cos_tilt))))
            raise SafetyStop(f"the base leans by {tilt:.0f} degrees, {self.config.max_tilt_deg:g} are allowed")
        beyond = np.maximum(self._lower - joint_pos, joint_pos - self._upper)
        if not beyond.max() <= self.config.joint_margin:
            worst = int(beyond.argmax())
            raise SafetyStop(
                f"{self._names[worst]} is at {joint_pos[worst]:.2f} rad, {beyond[worst]:.2f} beyond its limit"
            )
        if not abs(joint_vel).max() <= self.config.max_joint_vel:
            worst = int(abs(joint_vel).argmax())
            raise SafetyStop(f"{self._names[worst]} turns at {joint_vel[worst]:.0f} rad/s")

    def check_torque(self, torque: np.ndarray) -> None:
        """Raises SafetyStop where a joint has given its whole torque (num_joints,), N m, for too long."""
        if torque.shape != (len(self._names),) or not np.isfinite(torque).all():
            raise SafetyStop(f"joint_torque: {len(self._names)} finite numbers were expected, {torque} given")
        self._strained = np.where(abs(torque) >= 0.98 * self._torque_limits, self._strained + 1, 0)
        if self._strained.max() > self.config.torque_s / self._dt:
            worst = int(self._strained.argmax())
            raise SafetyStop(f"{self._names[worst]} has given {torque[worst]:.1f} N m for {self.config.torque_s:g} s")

    def limit_targets(self, targets: np.ndarray, joint_pos: np.ndarray) -> np.ndarray:
        """(num_joints,) joint targets within the joints' limits and the rate; the first within reach of the joints."""
        if not np.isfinite(targets).all():
            raise SafetyStop(f"the policy's targets are not finite: {targets}")
        before = joint_pos if self._targets is None else self._targets
        step = np.float32(self.config.target_rate * self._dt)
        limited = np.clip(targets, before - step, before + step)
        limited = np.clip(limited, self._lower, self._upper)
        if (limited != targets).any():
            self.counts["targets limited"] += 1
        self._targets = limited
        return limited

    def _look(self) -> None:
        """One control step without or with a frame: how fast the robot may go."""
        if not self._sees:
            return
        fresh = self._age <= self.config.frame_age_s
        change = np.clip(self._dt / self.config.slow_down_s, 0.0, 1.0)
        self._pace = min(1.0, self._pace + change) if fresh else max(0.0, self._pace - change)
        status = LidarStatus.FRESH if fresh else LidarStatus.SLOWING if self._pace > 0.0 else LidarStatus.STOPPED
        if status is not self.lidar_status:
            age = f"no good frame for {self._age:.2f} s"
            log.warning(
                {LidarStatus.FRESH: "frames are back", LidarStatus.SLOWING: f"{age}: slowing down"}.get(
                    status, f"{age}: standing"
                )
            )
            self.counts["stops for want of frames"] += status is LidarStatus.SLOWING
            self.lidar_status = status
        self._age += self._dt

    def _count(self, level: int, what: str, why: str) -> None:
        """Counts, and logs the first of each kind."""
        self.counts[what] += 1
        if self.counts[what] == 1:
            log.log(level, "%s: %s", what, why)


def _or(limits: Sequence[float | None], without: float) -> np.ndarray:
    return np.array([without if limit is None else limit for limit in limits], np.float32)


def command_limits(ranges: Mapping[str, Sequence[float]]) -> np.ndarray:
    """(2, 3) least and largest v_x, v_y (m/s) and yaw rate (rad/s): training's ranges, widened to 0."""
    low, high = np.array([ranges[name] for name in ("lin_vel_x", "lin_vel_y", "ang_vel_z")]).T
    return np.stack((np.minimum(low, 0.0), np.maximum(high, 0.0)))
