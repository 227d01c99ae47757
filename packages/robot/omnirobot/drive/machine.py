"""What stands between a policy and the motors: modes, the ways between them, and watchdogs.

    damping --stand--> standing up --> standing --walk--> policy --stand--> slowing down --> standing
                                  standing --lie--> lying down --> damping
                                                          policy --lie--> slowing down --> lying down --> damping
                                      policy, slowing down --the policy is silent--> damping
    every mode --fault--> damping       every mode --e-stop--> stopped, for good

Pure functions of time and messages: `guard` runs them on the wire. Arrays are in the order of the motors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import StrEnum

import numpy as np

from omnirobot.runtime.description import DeployError


class Mode(StrEnum):
    """What the motors do."""

    DAMPING = "damping"
    STANDING_UP = "standing up"
    STANDING = "standing"
    POLICY = "policy"
    SLOWING = "slowing down"
    LYING_DOWN = "lying down"
    STOPPED = "stopped"


DRIVEN = (Mode.POLICY, Mode.SLOWING)
"""Modes in which the policy drives."""


class Request(StrEnum):
    """What an operator or the policy asks for."""

    STAND = "stand"
    WALK = "walk"
    LIE = "lie"
    DAMP = "damp"
    STOP = "stop"


@dataclass(frozen=True)
class MachineConfig:
    """Times, gains and limits of a :class:`Machine`.

    Attributes:
        stand_pose: (12,) rad, in which the policy begins.
        crouch_pose: (12,) rad, folded legs.
        lower: (12,) joint limits, rad.
        upper: (12,) rad.
        kp: of the policy, N m / rad, one number or 12.
        kd: N m s / rad, likewise.
        stand_kp: while the machine itself moves the joints.
        stand_kd: the same.
        damping_kd: of damped joints; their kp is 0.
        state_age_s: the joints are damped when the newest valid state is older.
        silence_s: the joints are damped when the policy's newest targets are older while it drives: a walking robot
            sinks, and falls less often than one whose legs are led anywhere.
        fold_s: from where the joints are to the crouch.
        rise_s: from the crouch to standing.
        slow_s: for how long the policy, told to stand, still drives when something else is asked for: a robot that
            walks at 1 m/s and whose legs are led to the standing pose falls over them.
        settle_s: in which a robot that slowed down comes to the standing pose, before it lies down.
        fold_down_s: from standing to the crouch, or from wherever standing up was broken off.
        reach: most that a joint may be from the standing pose when the machine calls it standing, rad.
        max_tilt_deg: most that the base may lean when not damped.
        max_temperature: of a motor, degrees Celsius.
        max_step: most that a target may differ from the one before, and the first from where joints are held, rad.
    """

    stand_pose: Sequence[float]
    lower: Sequence[float]
    upper: Sequence[float]
    kp: float | Sequence[float]
    kd: float | Sequence[float]
    crouch_pose: Sequence[float] = (0.0, 1.36, -2.65) * 4
    stand_kp: float = 60.0
    stand_kd: float = 5.0
    damping_kd: float = 3.0
    state_age_s: float = 0.04
    silence_s: float = 0.04
    fold_s: float = 1.0
    rise_s: float = 1.0
    slow_s: float = 1.0
    settle_s: float = 0.6
    fold_down_s: float = 1.5
    reach: float = 0.3
    max_tilt_deg: float = 50.0
    max_temperature: float = 80.0
    max_step: float = 1.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not isinstance(value, int | float) and not _is_pose(value):
                raise DeployError(f"machine.{item.name}={list(value)}: 12 finite numbers were expected")


@dataclass(frozen=True)
class Sensed:
    """A robot's valid state.

    Attributes:
        time_s: when it came, on this machine's monotonic clock.
        joint_pos: (12,) rad.
        cos_tilt: cosine of the angle between the base's and the world's vertical.
        temperature: (12,) of the motors, degrees Celsius.
    """

    time_s: float
    joint_pos: np.ndarray
    cos_tilt: float
    temperature: np.ndarray


@dataclass(frozen=True)
class Drive:
    """What the motors are told: a position controller's targets (12,) rad, and its gains, one number or 12."""

    joint_pos: np.ndarray
    kp: float | Sequence[float]
    kd: float | Sequence[float]


class Machine:
    """Modes of one robot.

    Attributes:
        mode: what the motors do now.
        reason: why, in words.
    """

    def __init__(self, config: MachineConfig) -> None:
        self.config = config
        self._stand, self._crouch = np.array(config.stand_pose, float), np.array(config.crouch_pose, float)
        self._lower, self._upper = np.array(config.lower, float), np.array(config.upper, float)
        self._min_cos = math.cos(math.radians(config.max_tilt_deg))
        self.mode, self.reason = Mode.DAMPING, "start"
        self._since, self._from = 0.0, self._crouch
        self._sensed: Sensed | None = None
        self._targets: tuple[float, np.ndarray] | None = None
        self._held = self._stand
        self._settle_s, self._next = config.settle_s, Mode.STANDING

    def sense(self, sensed: Sensed) -> None:
        """Takes a valid state in."""
        self._sensed = sensed

    def follow(self, now: float, targets: np.ndarray) -> None:
        """Takes the policy's joint targets (12,), rad, in; faulty ones end in damping."""
        if not np.isfinite(targets).all():
            return self._fault(now, "the policy's targets are not finite")
        if self.mode in DRIVEN and self._targets is not None:
            step = float(abs(targets - self._targets[1]).max())
            if step > self.config.max_step:
                return self._fault(now, f"a target is {step:.1f} rad from the one before")
        self._targets = (now, np.clip(targets, self._lower, self._upper))

    def ask(self, now: float, request: Request) -> None:
        """Takes a request in; what the mode does not allow is refused, and `reason` says why."""
        if request is Request.STOP:
            return self._enter(now, Mode.STOPPED, "e-stop")
        if self.mode is Mode.STOPPED:
            return
        if request is Request.DAMP:
            self._enter(now, Mode.DAMPING, "asked for")
        elif request is Request.STAND and self.mode is Mode.DAMPING:
            obstacle = self._fault_now(now)
            if obstacle:
                self.reason = f"not standing up: {obstacle}"
            else:
                self._enter(now, Mode.STANDING_UP, "asked for")
        elif request in (Request.STAND, Request.LIE) and self.mode in DRIVEN:
            self._next = Mode.STANDING if request is Request.STAND else Mode.LYING_DOWN
            if self.mode is Mode.POLICY:
                self._enter(now, Mode.SLOWING, "asked for")
        elif request is Request.WALK and self.mode is Mode.STANDING:
            if self._targets is None or self._is_silent(now):
                self.reason = "not walking: the policy is silent"
            elif (away := float(abs(self._targets[1] - self._held).max())) > self.config.max_step:
                self.reason = f"not walking: a target is {away:.1f} rad from where the joints are held"
            else:
                self._enter(now, Mode.POLICY, "asked for")
        elif request is Request.LIE and self.mode in (Mode.STANDING_UP, Mode.STANDING):
            self._enter(now, Mode.LYING_DOWN, "asked for")

    def drive(self, now: float) -> Drive:
        """What the motors are told now; call it at the rate of the motors' commands."""
        self._watch(now)
        self._proceed(now)
        if self.mode in DRIVEN:
            assert self._targets is not None
            self._held = self._targets[1]
            return Drive(self._held, self.config.kp, self.config.kd)
        if self.mode in (Mode.DAMPING, Mode.STOPPED):
            position = self._stand  # with a kp of 0 it moves nothing
            if self._sensed is not None and np.isfinite(self._sensed.joint_pos).all():
                position = self._sensed.joint_pos
            return Drive(position, 0.0, self.config.damping_kd)
        self._held = self._pose(now - self._since)
        return Drive(self._held, self.config.stand_kp, self.config.stand_kd)

    def _watch(self, now: float) -> None:
        """Watchdogs."""
        if self.mode in (Mode.DAMPING, Mode.STOPPED):
            return
        fault = self._fault_now(now)
        if fault:
            self._fault(now, fault)
        elif self.mode in DRIVEN and self._is_silent(now):
            self._fault(now, f"the policy is silent for {1e3 * self.config.silence_s:.0f} ms")

    def _fault_now(self, now: float) -> str:
        """Why the joints must be damped; empty: they need not."""
        sensed, config = self._sensed, self.config
        if sensed is None or now - sensed.time_s > config.state_age_s:
            return f"no valid state for {1e3 * config.state_age_s:.0f} ms"
        if not np.isfinite(sensed.joint_pos).all() or not math.isfinite(sensed.cos_tilt):
            return "the state is not finite"
        if sensed.cos_tilt < self._min_cos:
            return f"the base leans by more than {config.max_tilt_deg:g} degrees"
        if sensed.temperature.max() > config.max_temperature:
            return f"motor {int(sensed.temperature.argmax())} has {sensed.temperature.max():.0f} degrees Celsius"
        return ""

    def _proceed(self, now: float) -> None:
        """Ends of movements."""
        since, config = now - self._since, self.config
        if self.mode is Mode.STANDING_UP and since >= config.fold_s + config.rise_s:
            assert self._sensed is not None
            away = float(abs(self._sensed.joint_pos - self._stand).max())
            if away <= config.reach:
                self._enter(now, Mode.STANDING, "stood up")
            elif since >= config.fold_s + config.rise_s + 1.0:
                self._fault(now, f"standing up failed: a joint is {away:.1f} rad away")
        elif self.mode is Mode.SLOWING and since >= config.slow_s:
            self._enter(now, self._next, self.reason)
        elif self.mode is Mode.LYING_DOWN and since >= self._settle_s + config.fold_down_s:
            self._enter(now, Mode.DAMPING, f"lay down ({self.reason})")

    def _pose(self, since: float) -> np.ndarray:
        """(12,) rad: where the joints are led in the modes that move them."""
        config = self.config
        if self.mode is Mode.STANDING_UP:
            return _along(
                since, (0.0, config.fold_s, config.fold_s + config.rise_s), (self._from, self._crouch, self._stand)
            )
        reached_s = config.settle_s / 2
        if self.mode is Mode.STANDING:
            return _along(since, (0.0, reached_s), (self._from, self._stand))
        if not self._settle_s:
            return _along(since, (0.0, config.fold_down_s), (self._from, self._crouch))
        times = (0.0, reached_s, config.settle_s, config.settle_s + config.fold_down_s)
        return _along(since, times, (self._from, self._stand, self._stand, self._crouch))

    def _is_silent(self, now: float) -> bool:
        return self._targets is None or now - self._targets[0] > self.config.silence_s

    def _fault(self, now: float, why: str) -> None:
        if self.mode is not Mode.STOPPED:
            self._enter(now, Mode.DAMPING, why)

    def _enter(self, now: float, mode: Mode, reason: str) -> None:
        """A mode, whose movement begins where the joints are led, or are if nothing led them."""
        if self.mode is Mode.STOPPED:
            return
        led = self.mode not in (Mode.DAMPING, Mode.STOPPED)
        self._from = self._held if led or self._sensed is None else self._sensed.joint_pos
        self._settle_s = 0.0 if self.mode is Mode.STANDING_UP else self.config.settle_s  # it does not stand yet
        self.mode, self.reason, self._since = mode, reason, now


def _is_pose(values: Sequence[float]) -> bool:
    """Tell whether there is a finite number for each of 12 motors."""
    return len(values) == 12 and all(value is not None and math.isfinite(value) for value in values)


def _along(time: float, times: Sequence[float], poses: Sequence[np.ndarray]) -> np.ndarray:
    """(12,) linear between poses at these times."""
    k = int(np.searchsorted(times, time, side="right"))
    if k == 0 or k == len(times):
        return poses[min(k, len(times) - 1)]
    share = (time - times[k - 1]) / (times[k] - times[k - 1])
    return (1.0 - share) * poses[k - 1] + share * poses[k]
