"""A policy's own process: what the robot and its LiDAR say -> joint targets to the guard."""

from __future__ import annotations

import contextlib
import json
import math
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from omnirobot.common.signals import interruptible
from omnirobot.drive.guard import GuardConfig, Link, StateReader, start
from omnirobot.drive.legs import base_velocity
from omnirobot.drive.machine import DRIVEN, MachineConfig, Mode, Request
from omnirobot.drive.operator import Goal, Operator, make_operator
from omnirobot.drive.recording import Recorder, Step, make_folder
from omnirobot.runtime import DeployError, ExportedPolicy, RobotState, SafetyStop
from omnirobot.runtime.description import FILE, Description
from omnirobot.runtime.go2 import MOTORS, RANGES
from omnirobot.runtime.odometry import Odometry
from omnirobot.runtime.runtime import QUANTITIES
from omnirobot.runtime.sampling import down
from omnirobot.wire.clouds import Frame, Points
from omnirobot.wire.dds import LOW_STATE_TOPIC, Network
from omnirobot.wire.lidar import Frames, LidarSource
from omnirobot.wire.messages import LOW_STATE, remote
from omnirobot.wire.saying import say
from omnirobot.wire.sensor_clock import FrameAges
from omnirobot.wire.switcher import ensure_released


@dataclass(frozen=True)
class RobotConfig:
    """What runs on a robot.

    Attributes:
        policy: folder of an exported policy.
        interface: network interface of DDS; "lo" for a simulated robot on this machine.
        domain: of DDS.
        lidar: where points come from; None for a blind policy.
        steer: see `operator.make_operator`.
        check_crc: whether states with another checksum than theirs are refused.
        sport_mode: what is done about the robot's own controller, see `switcher.ensure_released`.
        record: .mcap file of a recording; None: none is made.
        report: .json file of what was measured, for `robot-trials`; None: none is written.
        seconds: how long it runs; None: until it is ended.
    """

    policy: Path
    interface: str = "lo"
    domain: int = 0
    lidar: LidarSource | None = None
    steer: str = "remote"
    check_crc: bool = True
    sport_mode: str = "check"
    record: Path | None = None
    report: Path | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class Report:
    """What a run of the policy's process has measured.

    Attributes:
        begin_ms: (steps,) from when a step was due to when it began.
        step_ms: (steps,) duration of each.
        period_ms: of control.
        frames: of the LiDAR, that were complete.
        counts: what the limits and the LiDAR have counted, by name.
    """

    begin_ms: np.ndarray
    step_ms: np.ndarray
    period_ms: float
    frames: int
    counts: dict[str, int]

    @property
    def late(self) -> int:
        """Steps begun more than half a period after their time."""
        return int((self.begin_ms > self.period_ms / 2).sum())

    def write(self, path: Path) -> None:
        """As JSON."""
        parts = {"begin_ms": self.begin_ms.round(3).tolist(), "step_ms": self.step_ms.round(3).tolist()}
        parts |= {"period_ms": self.period_ms, "frames": self.frames, "counts": self.counts}
        path.write_text(json.dumps(parts))

    def __str__(self) -> str:
        counts, parts = dict(self.counts), ["no state has come from the robot"]
        if len(self.step_ms):
            p50, p99 = np.percentile(self.step_ms, (50, 99))
            parts = [f"{len(self.step_ms)} steps, {self.late} late", f"p50 {p50:.2f} ms, p99 {p99:.2f} ms"]
        if "LiDAR messages" in counts:
            points, messages = counts.pop("LiDAR points"), counts.pop("LiDAR messages")
            parts.append(f"{self.frames} frames of {points} points in {messages} LiDAR messages")
        parts.append(", ".join(f"{value} {name}" for name, value in counts.items() if value) or "nothing else to tell")
        return "; ".join(parts)


_ROUNDING = 1e-3
"""Difference (rad) up to which two angles of a robot's description are the same."""


def motor_order(description: Description) -> np.ndarray:
    """(12,) motor of each joint of the policy.

    Raises:
        DeployError: the policy moves another robot.
    """
    names = description.joints.names
    if set(names) != set(MOTORS) or len(names) != len(MOTORS):
        other = sorted(set(names) ^ set(MOTORS))
        raise DeployError(f"the policy moves another robot than a Go2: {', '.join(other[:4])} ...")
    for name, lower, upper in zip(names, description.joints.lower, description.joints.upper, strict=True):
        lowest, highest = RANGES[name]
        if (lower is not None and lower < lowest - _ROUNDING) or (upper is not None and upper > highest + _ROUNDING):
            raise DeployError(
                f"the policy moves another robot than a Go2: its {name} goes from {lower} to {upper} rad, a Go2's from"
                f" {lowest} to {highest}"
            )
    return np.array([MOTORS.index(name) for name in names])


def machine_config(description: Description) -> MachineConfig:
    """The guard's machine for a policy: its gains, its default pose to stand in, its limits, in the motors' order.

    Raises:
        DeployError: the policy moves another robot, acts too seldom, observes what no robot measures, or a joint has no
            limits to keep targets within.
    """
    joints, motors = description.joints, motor_order(description)
    ranges = zip(joints.names, joints.lower, joints.upper, strict=True)
    free = [name for name, lower, upper in ranges if lower is None or upper is None]
    if free:
        raise DeployError(
            f"joints without limits in the policy's {FILE}: {', '.join(free)}; the guard keeps targets within limits:"
            " give these joints a range in the robot's file (robot.file) and export again"
        )

    slowest_s = 0.5 * MachineConfig.silence_s
    if description.control_period_s > slowest_s + 1e-9:
        raise DeployError(
            f"the policy acts every {1e3 * description.control_period_s:g} ms, at most every {1e3 * slowest_s:g} was"
            " expected, since the guard damps motors that nobody commands; train with a shorter control step"
            " (sim.timestep x sim.decimation)"
        )
    terms = [term for group in description.observations for term in group.terms if term.frequency is None]
    if own := [term.quantity for term in terms if term.quantity not in QUANTITIES]:
        raise DeployError(f"the policy observes {', '.join(own)}, which this robot's messages do not hold")

    def in_motors_order(values: object) -> list[float]:
        ordered = np.zeros(len(MOTORS))
        ordered[motors] = np.asarray(values)  # one number for all, or one each
        return ordered.tolist()

    return MachineConfig(
        stand_pose=in_motors_order(joints.default_pos),
        lower=in_motors_order(joints.lower),
        upper=in_motors_order(joints.upper),
        kp=in_motors_order(joints.kp),
        kd=in_motors_order(joints.kd),
    )


class States(Protocol):
    """The robot's, see `guard.StateReader`."""

    def newest(self) -> np.ndarray | None: ...


class FrameSource(Protocol):
    """The LiDAR's, see `lidar.Frames`."""

    received: list[Points]

    def new(self) -> list[Frame]: ...


class Waiting:
    """Says every few seconds what does not come, and what comes instead."""

    SAY_EVERY_S = 3.0

    def __init__(self, awaited: Mapping[str, StateReader | Frames]) -> None:
        self._awaited, self._came = awaited, dict.fromkeys(awaited, 0)
        self._due = dict.fromkeys(awaited, math.inf)

    def look(self, now: float) -> None:
        """Once per control step."""
        for name, one in self._awaited.items():
            if one.came != self._came[name] or self._due[name] == math.inf:
                self._came[name], self._due[name] = one.came, now + self.SAY_EVERY_S
            elif now >= self._due[name]:
                self._due[name] = now + self.SAY_EVERY_S
                say(f"waiting for {name}: {one.why_silent()}")


class GuardLink(Protocol):
    """To the guard, see `guard.Link`."""

    mode: Mode
    reason: str

    def poll(self) -> None: ...

    def ask(self, request: Request) -> None: ...

    def send_targets(self, targets: np.ndarray) -> None: ...


class Listener(Protocol):
    """Who takes down what happens, see `recording.Recorder`."""

    def points(self, now: float, points: Points) -> None: ...

    def step(self, step: Step) -> None: ...


class Control:
    """The loop of a policy's process, a step at a time.

    Attributes:
        policy: with its memory.
        missed: frames that were due and did not come.
    """

    def __init__(
        self,
        policy: ExportedPolicy,
        states: States,
        frames: FrameSource | None,
        operator: Operator,
        link: GuardLink,
        listener: Listener | None = None,
    ) -> None:
        self.policy, self._states, self._frames, self._operator, self._link = policy, states, frames, operator, link
        self._listener = listener
        self._motors = motor_order(policy.description)
        described = policy.description
        observed = {term.quantity for group in described.observations for term in group.terms}
        moves = described.perception is not None and described.perception.base_motion
        self._is_led = isinstance(operator, Goal)
        self._needs_velocity = not described.estimated and (moves or "base_lin_vel" in observed)
        self._state: np.ndarray | None = None
        self._heard, self._stopped = -math.inf, ""
        self.missed = 0
        self._mode, self._last_frame = Mode.DAMPING, math.inf
        self._velocity, self._ages = np.zeros(3), FrameAges()
        self._begin_odometry()

    def _begin_odometry(self) -> None:
        self._pose, self._odometry = np.zeros(3), Odometry(self.policy.description.control_period_s)

    def step(self, now: float) -> bool:
        """One control step; False without a state of the robot so far."""
        newest = self._states.newest()
        if newest is not None:
            self._state, self._heard = newest, now
        frames = [] if self._frames is None else self._frames.new()
        if self._listener is not None and self._frames is not None:
            received = self._frames.received
            if received:  # in one message: a thread beside the loop encodes it
                points_of, times_of = ([getattr(part, name) for part in received] for name in ("points", "times_ns"))
                self._listener.points(now, Points(np.concatenate(points_of), np.concatenate(times_of)))
        self._link.poll()
        if self._state is None:
            return False
        if self._is_led:
            self._advance_odometry(self._state)
        command, asked = self._operator.poll(now, remote(self._state["wireless_remote"]), self._pose)
        for request in asked:
            self._link.ask(request)
        before, self._mode = self._mode, self._link.mode
        drives_on = before in DRIVEN and self._mode in DRIVEN
        if not drives_on:
            self.policy.reset()  # what it would do from here, not what it would have done since: nobody follows it
            if self._mode is Mode.POLICY:
                if self.policy.safety is not None:
                    self.policy.safety.await_frame()  # the sensor may never have spoken
                self._begin_odometry()
        given = command if self._mode is Mode.POLICY else np.zeros(3)
        points = self._points(frames, now)
        targets, stopped = self._decide(self._robot_state(self._state), given, points)
        is_heard = now - self._heard <= MachineConfig.state_age_s  # from an older state nothing follows
        if targets is not None and is_heard:
            self._link.send_targets(targets)
        if self._listener is not None:
            mode = f"{self._mode}: {self._link.reason}"
            action = np.zeros(len(MOTORS))
            action[self._motors] = self.policy.action
            self._listener.step(Step(now, self._state, mode, command, points, targets, action, stopped))
        return True

    def _decide(
        self, state: RobotState, command: np.ndarray, points: np.ndarray | None
    ) -> tuple[np.ndarray | None, str]:
        """(12,) rad, in the motors' order; or why the policy stops while it drives: the guard is asked to damp."""
        try:
            slows = self._mode is Mode.SLOWING  # what is told to stand does not step aside instead
            targets = self.policy.step(state, command, points, self._ages.newest_s, blind=slows)
        except SafetyStop as stop:
            is_driven = self._mode in DRIVEN
            if is_driven or str(stop) != self._stopped:
                say(f"stop: {stop}")
            self._stopped = str(stop)
            if is_driven:
                self._link.ask(Request.DAMP)
            return None, str(stop) if is_driven else ""
        in_order = np.zeros(len(MOTORS))
        in_order[self._motors] = targets
        return in_order, ""

    def _points(self, frames: list, now: float) -> np.ndarray | None:
        """The newest frame as training saw it; a period without one is a frame lost."""
        if self._frames is None:
            return None
        period = self.policy.description.lidar.period_s  # type: ignore[union-attr]
        if not frames:
            if now - self._last_frame > 1.5 * period:
                self._last_frame += period
                self.policy.repeat_frame()
                self.missed += self._mode in DRIVEN
            return None
        self._last_frame = now
        self._ages.add(int(frames[-1].start_ns) + round(1e9 * period), now)
        return self.policy.subsample(frames[-1].points, frames[-1].offsets_s)

    def _advance_odometry(self, state: np.ndarray) -> None:
        """Adds one step to the pose (3,) x, y (m), heading (rad) since the policy began."""
        self._odometry.advance(state["imu_state"]["quaternion"].astype(float), self._leg_velocity(state))
        dx, dy, turned = self._odometry.since_last_frame()
        cos, sin = np.cos(self._pose[2]), np.sin(self._pose[2])
        self._pose = self._pose + np.array([cos * dx - sin * dy, sin * dx + cos * dy, turned])

    def _leg_velocity(self, state: np.ndarray) -> np.ndarray:
        """(3,) m/s in the base; the newest known while no foot stands."""
        motors, imu = state["motor_state"][:12], state["imu_state"]
        angles, speeds, torques = (motors[name].astype(float) for name in ("q", "dq", "tau_est"))
        gyro, vertical = imu["gyroscope"].astype(float), down(imu["quaternion"].astype(float))
        stood = base_velocity(angles, speeds, torques, gyro, vertical)
        self._velocity = self._velocity if stood is None else stood
        return self._velocity

    def _robot_state(self, state: np.ndarray) -> RobotState:
        """Of a LOW_STATE, in the policy's order of joints."""
        motors, imu = state["motor_state"][:12], state["imu_state"]
        quat, gyro = imu["quaternion"].astype(float), imu["gyroscope"].astype(float)
        velocity = self._leg_velocity(state) if self._needs_velocity else None
        order = self._motors
        return RobotState(motors["q"][order], motors["dq"][order], quat, gyro, velocity, motors["tau_est"][order])


def run(config: RobotConfig, should_end: Callable[[], bool] = lambda: False) -> Report:
    """Runs a policy on a robot until `should_end`, an interrupt, SIGTERM, SIGHUP, or the guard's end.

    Raises:
        DeployError: what was asked for cannot be done, or no state has come from the robot.
    """
    policy = ExportedPolicy.load(config.policy)
    description = policy.description
    machine = machine_config(description)
    if config.report is not None:
        make_folder(config.report, "report")
    with interruptible(), contextlib.ExitStack() as closing:  # whatever ends it, the terminal is left as it was found
        operator = make_operator(config.steer, description.command)
        closing.callback(operator.close)
        network = Network(config.interface, config.domain)
        states = StateReader(network.reader(LOW_STATE_TOPIC, LOW_STATE), config.check_crc)
        lidar = description.lidar if description.perception is not None else None
        if lidar is not None and config.lidar is None:
            raise DeployError("this policy sees: points=none is for a blind one")
        if config.sport_mode != "release":  # a refusal leaves nothing behind
            ensure_released(network, config.sport_mode)
        frames = None
        if lidar is not None and config.lidar is not None:  # it listens from here on; what waits for long is lost
            frames = Frames(config.lidar, lidar, network)
            closing.callback(frames.close)
        recorder = None if config.record is None else Recorder(config.record, description)
        if recorder is not None:
            closing.callback(recorder.close)
        if config.sport_mode == "release":  # after all that may fail: nothing moves the robot from here to the guard
            ensure_released(network, config.sport_mode)
        link, guard = start(GuardConfig(machine, config.interface, config.domain, config.check_crc))
        closing.callback(link.close)
        control = Control(policy, states, frames, operator, link, recorder)
        awaited: dict[str, StateReader | Frames] = {"states of the robot": states}
        awaited |= {"LiDAR frames": frames} if frames else {}
        period_s, waiting = description.control_period_s, Waiting(awaited)
        begins, times, skipped = drive(control, link, period_s, config.seconds, should_end, waiting.look)
        if link.is_closed:
            with contextlib.suppress(subprocess.TimeoutExpired):
                guard.wait(1.0)
            if guard.returncode != 0:
                raise DeployError("the guard has ended; its message stands above")
        counts = {} if policy.safety is None else dict(policy.safety.counts)
        counts |= {"steps skipped": skipped, "states": states.came}
        counts |= {"states refused": states.refused, "states repeated": states.repeated}
        if frames is not None:
            counts |= {"frames missed": control.missed} | frames.counts()
        number = 0 if frames is None else frames.number
        report = Report(np.array(begins), np.array(times), 1e3 * description.control_period_s, number, counts)
        if config.report is not None:
            try:
                report.write(config.report)
            except OSError as error:  # what it would hold is printed all the same
                print(f"report={config.report} cannot be written: {error.strerror}", file=sys.stderr, flush=True)
        if not begins:
            raise DeployError(str(report))
    return report


def drive(
    control: Control,
    link: Link,
    period_s: float,
    seconds: float | None = None,
    should_end: Callable[[], bool] = lambda: False,
    after_step: Callable[[float], None] = lambda now: None,
) -> tuple[list[float], list[float], int]:
    """Steps in real time, and then lies down; what `_loop` gives."""
    try:
        return _loop(control, link, period_s, seconds, should_end, after_step)
    finally:
        if link.mode in (Mode.STANDING, Mode.STANDING_UP, *DRIVEN):
            link.ask(Request.LIE)
        if link.mode in DRIVEN:  # it slows the robot down before the guard lays it down
            _loop(control, link, period_s, 2.0, lambda: link.mode not in DRIVEN)


def _loop(
    control: Control,
    link: Link,
    period_s: float,
    seconds: float | None,
    should_end: Callable[[], bool],
    after_step: Callable[[float], None] = lambda now: None,
) -> tuple[list[float], list[float], int]:
    """How long after their time the steps began, how long they took, ms, and how many a stall has cost."""
    begin = due = time.monotonic()
    skipped = 0
    begins: list[float] = []
    times: list[float] = []
    try:
        while not (link.is_closed or should_end() or (seconds is not None and due - begin >= seconds)):
            now = time.monotonic()
            if control.step(now):
                begins.append(1e3 * (now - due))
                times.append(1e3 * (time.monotonic() - now))
            after_step(now)
            due += period_s
            missed = max(0, math.ceil((time.monotonic() - due) / period_s) - 1)  # a stall's steps are not made up for
            due, skipped = due + missed * period_s, skipped + missed
            time.sleep(max(0.0, due - time.monotonic()))
    except KeyboardInterrupt:
        say("ended: the guard lays the robot down")
    return begins, times, skipped
