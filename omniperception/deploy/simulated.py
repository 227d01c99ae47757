"""A Go2 with a Mid-360 as a process of its own: MuJoCo in real time behind the robot's own messages and packets."""

from __future__ import annotations

import json
import math
import socket
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from omnilidar import Lidar
from omniperception.deploy.faults import FAULTS, Faults
from omniperception.env.env import OmniEnv
from omnirobot.common.cli import argument
from omnirobot.drive.machine import Request
from omnirobot.runtime.description import DeployError
from omnirobot.runtime.go2 import MOTORS
from omnirobot.wire.dds import LOW_CMD_TOPIC, LOW_STATE_TOPIC, Network
from omnirobot.wire.livox import POINTS_PER_PACKET, write_points
from omnirobot.wire.messages import LOW_CMD, LOW_STATE, MOTOR_ON, crc, sealed
from omnirobot.wire.switcher import SwitcherService

STEP_S, CONTROL_STEPS = 0.002, 10
"""Physics step, which is also the period of rt/lowstate, and how many of them make a step of the world."""
SCAN_STEPS = 5
"""The LiDAR's rays are cast every so many steps, from where the robot is then."""
_CROUCH = (0.0, 1.36, -2.65)
_LYING_HEIGHT, _UP_HEIGHT = 0.12, 0.2
_TEMPERATURE = 30
_AFTER_FAULT_S = 6.0
"""From a fault's beginning to the end of the simulation."""


@dataclass(frozen=True, kw_only=True)
class SimulatedConfig:
    """How the simulated robot behaves on the wire; what it is in a world, `robot-sim` adds.

    What a Go2's motors do when no command comes is not known here: that they go on with the last is the worst case.
    """

    interface: str = argument("lo", "network interface of DDS")
    domain: int = argument(0, "of DDS", least=0)
    crc: bool = argument(True, "whether states carry a checksum and commands without theirs are refused")
    point_to: int = argument(56301, "UDP port of this machine that LiDAR packets go to", least=1)
    steer_to: int | None = argument(None, "UDP port that the world's commands are sent to; null: none are")
    hold_last: bool = argument(True, "whether motors go on with the last command when none comes")
    sport_mode: str | None = argument(None, "name of a controller of its own, which runs until it is released")
    fault: str | None = argument(None, "fault of the wire a second after it has begun to walk", choices=tuple(FAULTS))
    fault_s: float = argument(2.0, "how long the fault lasts", positive=True)
    report: Path | None = argument(None, "file of what became of the robot; null: none", suffixes=(".json",))
    seconds: float | None = argument(None, "simulated time; null: until the goal or an interrupt", positive=True)


@dataclass
class Outcome:
    """What has become of the robot since it stood up.

    Attributes:
        stood: whether it has.
        touched: whether it has touched an obstacle.
        fell: whether the base leant by more than 60 degrees.
        reached: whether it has reached the world's goal.
        reached_s: how long after standing up; None: it has not.
        height: of the base over the ground at the end, m; a robot that lies is below 0.15.
        speed: of the base at the end, m/s.
        largest_tilt_deg: of the base.
        path_m: length of its way.
        lag_s: most that the simulation was behind real time.
        refused: commands whose checksum or length was wrong.
        commands: that came.
    """

    stood: bool = False
    touched: bool = False
    fell: bool = False
    reached: bool = False
    reached_s: float | None = None
    height: float = 0.0
    speed: float = 0.0
    largest_tilt_deg: float = 0.0
    path_m: float = 0.0
    lag_s: float = 0.0
    refused: int = 0
    commands: int = 0

    def __str__(self) -> str:
        if not self.stood:
            return f"it never stood up; {self.commands} commands came, {self.refused} were refused"
        did = [name for name in ("reached", "touched", "fell") if getattr(self, name)] or ["neither touched nor fell"]
        return (
            f"{', '.join(did)}; {self.path_m:.1f} m, tilt at most {self.largest_tilt_deg:.0f} degrees; {self.commands}"
            f" commands, {self.refused} refused; at most {1e3 * self.lag_s:.0f} ms behind real time"
        )


class Motors:
    """Position controllers of the joints: what rt/lowcmd asks for, with the engine's own damping and torque limits."""

    def __init__(self, env: OmniEnv) -> None:
        """Args: env: of one robot, just reset; its randomized gains scale every command's."""
        if set(env.robot.joints) != set(MOTORS):
            raise DeployError("robot-sim simulates a Go2; robot=go2")
        sim = env.sim
        self._of_joint = np.array([MOTORS.index(name) for name in env.robot.joints])
        self._gain, self._bias = sim.model_field("actuator_gainprm"), sim.model_field("actuator_biasprm")
        self._strength = self._gain[0, :, 0] / torch.tensor(env.robot.by_joint("kp"), dtype=torch.float64)
        self.targets = torch.zeros(1, len(MOTORS))
        self.follow(LOW_CMD.zeros())

    def follow(self, command: np.ndarray) -> None:
        """Takes a LOW_CMD in; a motor that is off, is limp. Feed-forward torques and velocities are not simulated."""
        motors = command["motor_cmd"][:12][self._of_joint]
        on = (motors["mode"] == MOTOR_ON).astype(np.float64)
        kp, kd = (torch.from_numpy(motors[name] * on) * self._strength for name in ("kp", "kd"))
        self._gain[0, :, 0], self._bias[0, :, 1], self._bias[0, :, 2] = kp, -kp, -kd
        self.targets = torch.from_numpy(motors["q"].astype(np.float32)[None])


class Scanner:
    """The Mid-360 of a simulated robot: rays in the order and at the times of the device, packets of 96 points."""

    def __init__(self, env: OmniEnv, config: SimulatedConfig) -> None:
        """Args: env: whose sensing says where the sensor is and how noisy; config: where packets go."""
        sensing = env.sensing
        assert sensing is not None
        self._sensing, pattern = sensing, sensing.config.scan_pattern()
        period_s = STEP_S * SCAN_STEPS
        rays = pattern.points_per_frame(period_s)
        whole = replace(sensing.config, period_s=period_s, num_rays=rays, selection="every_kth", motion_segments=0)
        self._lidar = Lidar(
            whole,
            pattern,
            sensing.scene,
            mount_body=sensing.carrier,
            noise=env.config.lidar_noise,
            seed=env.config.seed,
            outputs=("ranges", "directions_s"),
        )
        self._lidar.phase_rows.copy_(sensing.lidar.phase_rows)
        self._period_ns, self._rays = round(1e9 * period_s), rays
        self._left, self._number = np.zeros((0, 3), np.float32), 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._to: tuple[str, int] | None = ("127.0.0.1", config.point_to)

    def scan(self, time_s: float, faults: Faults) -> None:
        """Sends the packets of the points measured since the call before; time_s: now; faults: on their way."""
        self._sensing.place_bodies()
        frame = self._lidar.cast(time_s)
        assert frame.ranges is not None and frame.directions_s is not None
        ranges = frame.ranges[0, :, None]
        new = torch.where(ranges.isfinite(), ranges * frame.directions_s[0], 0.0).numpy()
        first_ns = round(1e9 * time_s) - self._period_ns - round(len(self._left) * self._period_ns / self._rays)
        points = np.concatenate((self._left, new))
        interval = POINTS_PER_PACKET * self._period_ns // self._rays
        whole, packets = len(points) // POINTS_PER_PACKET, []
        for k in range(whole):
            part = points[k * POINTS_PER_PACKET : (k + 1) * POINTS_PER_PACKET]
            packets.append(write_points(part, max(first_ns + k * interval, 0), self._number, interval))
            self._number += 1
        for packet in faults.packets(time_s, packets):
            if self._to is not None:
                self._socket.sendto(packet, self._to)
        self._left = points[whole * POINTS_PER_PACKET :]

    def close(self) -> None:
        """Ends it."""
        self._socket.close()


class SimulatedRobot:
    """One robot in a world, a physics step at a time. The world stands still until the robot has stood up.

    Attributes:
        outcome: what has become of it.
        time_s: simulated.
        up_since: simulated time at which it stood up; None before.
        faults: of the wire.
    """

    def __init__(self, env: OmniEnv, config: SimulatedConfig, network: Network) -> None:
        """Args: env: one environment with a physics step of 2 ms; config: how it behaves; network: of DDS."""
        if env.num_envs != 1 or abs(env.config.sim.timestep - STEP_S) > 1e-9:
            raise DeployError(f"robot-sim needs num_envs=1 sim.timestep={STEP_S} sim.decimation={CONTROL_STEPS}")
        self._env, self._config = env, config
        self._lay_down()
        self.motors = Motors(env)
        self.scanner = Scanner(env, config) if env.sensing is not None else None
        self._commands = network.reader(LOW_CMD_TOPIC, LOW_CMD, 2)
        self._states = network.writer(LOW_STATE_TOPIC, LOW_STATE)
        self._switcher = SwitcherService(network, config.sport_mode or "")
        self._operator = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.outcome, self.time_s = Outcome(), 0.0
        self.up_since: float | None = None
        self.faults, self._walks_since = Faults(config.fault or "", config.fault_s), math.inf
        self._ticks, self._last_command = 0, -1.0
        self._path: tuple[torch.Tensor, torch.Tensor | None] | None = None

    def _lay_down(self) -> None:
        qpos = self._env.sim.qpos
        joints = dict(zip(("hip", "thigh", "calf"), _CROUCH, strict=True))
        pose = [joints[name.split("_")[1]] for name in self._env.robot.joints]
        ground = float(qpos[0, 2]) - self._env.robot.base_height
        qpos[0, 2] = ground + _LYING_HEIGHT
        qpos[0, 7:] = torch.tensor(pose)
        self._ground = ground
        self._env.state.invalidate()

    def step(self) -> None:
        """One physics step, one LOW_STATE, and every fifth time the packets of the LiDAR's last 10 ms."""
        self._receive()
        env, sim, phase = self._env, self._env.sim, self._ticks % CONTROL_STEPS
        if phase == 0 and self.up_since is not None and env.obstacles is not None:
            moved, turned = env.obstacles.travel(STEP_S, CONTROL_STEPS, sim.qpos[:, :2])
            self._path = moved.clone(), None if turned is None else turned.clone()
        ways = self._path if self._path is not None else (None, None)
        here = slice(phase, phase + 1)
        before = sim.qpos[0, :2].clone()
        path, turn = (None if way is None else way[:, here] for way in ways)
        sim.step(self.motors.targets, 1, path, turn)
        self._ticks += 1
        self.time_s = self._ticks * STEP_S
        env.state.invalidate()
        self._judge(float((sim.qpos[0, :2] - before).norm()))
        state = self.faults.state(self.time_s, self._low_state())
        if state is not None:
            self._states.write(state)
        if self.scanner is not None and self._ticks % SCAN_STEPS == 0:
            self.scanner.scan(self.time_s, self.faults)
        if self._ticks % CONTROL_STEPS == 0:
            self._switcher.answer()
            self._command()

    def _receive(self) -> None:
        for data in self._commands.take():
            self.outcome.commands += 1
            try:
                command = LOW_CMD.from_cdr(data)
            except DeployError:
                self.outcome.refused += 1
                continue
            if self._config.crc and crc(command) != command["crc"]:
                self.outcome.refused += 1
                continue
            if self._switcher.controller:
                continue
            self._last_command = self.time_s
            self.motors.follow(command)
        if not self._config.hold_last and self.time_s - self._last_command > 0.1:
            self.motors.follow(LOW_CMD.zeros())

    def _low_state(self) -> np.ndarray:
        """() LOW_STATE of now."""
        state, order = LOW_STATE.zeros(), self.motors._of_joint
        positions, velocities = (part[0].numpy() for part in self._env.sim.robot_state())
        state["head"], state["level_flag"] = (0xFE, 0xEF), 0xFF
        imu, motors = state["imu_state"], state["motor_state"]
        imu["quaternion"], imu["gyroscope"] = positions[3:7], velocities[3:6]
        torques = self._env.sim.joint_torque()[0].numpy()
        for name, values in (("q", positions[7:]), ("dq", velocities[6:]), ("tau_est", torques)):
            motors[name][order] = values
        motors["mode"][:12], motors["temperature"][:12] = MOTOR_ON, _TEMPERATURE
        state["tick"] = round(1e3 * self.time_s)
        state["power_v"] = 29.0
        return sealed(state) if self._config.crc else state

    def _judge(self, moved: float) -> None:
        """Follows what becomes of the robot."""
        x, y = (float(v) for v in self._env.sim.qpos[0, 4:6])
        outcome, height = self.outcome, float(self._env.sim.qpos[0, 2]) - self._ground
        tilt = float(np.degrees(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))))
        if self.up_since is None:
            if height > _UP_HEIGHT:
                self.up_since, outcome.stood = self.time_s, True
            return
        outcome.path_m += moved
        outcome.largest_tilt_deg = max(outcome.largest_tilt_deg, tilt)
        outcome.fell |= tilt > 60.0
        outcome.touched |= bool(self._env.state.obstacle_contact[0])
        outcome.height, outcome.speed = height, moved / STEP_S
        if self.has_walked:
            self._walks_since = min(self._walks_since, self.time_s)
            if self.time_s >= self._walks_since + 1.0:
                self.faults.begin(self.time_s)

    def _command(self) -> None:
        """Sends what the world commands, and asks the robot to stand up and walk."""
        env, port = self._env, self._config.steer_to
        kinematics = env.state.kinematics
        if self.up_since is not None:
            env.command.advance(CONTROL_STEPS * STEP_S, kinematics)
            walking_s = self.time_s - self.up_since
            reached = env.command.reached(kinematics, walking_s)
            if reached is not None and reached[0] and not self.outcome.reached:
                self.outcome.reached, self.outcome.reached_s = True, walking_s
        if port is None:
            return
        words = " ".join(f"{value:.6f}" for value in env.command.value[0].tolist())
        asked = Request.STAND if self.up_since is None else Request.WALK
        if self._ticks % (50 * CONTROL_STEPS) == 0 and (self.up_since is None or not self.has_walked):
            self._operator.sendto(asked.encode(), ("127.0.0.1", port))
        self._operator.sendto(words.encode(), ("127.0.0.1", port))

    @property
    def is_over(self) -> bool:
        """Whether a fault has been looked at for long enough."""
        began = self.faults.begun_s
        return began is not None and self.time_s >= began + _AFTER_FAULT_S

    @property
    def has_walked(self) -> bool:
        """Whether it has gone half a metre since it stood up."""
        return self.outcome.path_m > 0.5

    def close(self) -> None:
        """Ends it."""
        self._operator.close()
        if self.scanner is not None:
            self.scanner.close()


def run(env: OmniEnv, config: SimulatedConfig, should_end: Callable[[], bool] = lambda: False) -> Outcome:
    """Simulates in real time until the goal is reached, `seconds` have passed, or an interrupt."""
    robot = SimulatedRobot(env, config, Network(config.interface, config.domain))
    print("robot-sim: ready", flush=True)
    begin, walks = time.monotonic(), False
    try:
        while not (should_end() or robot.outcome.reached or robot.is_over):
            if robot.has_walked and not walks:
                walks = True
                print("robot-sim: walks", flush=True)
            if config.seconds is not None and robot.time_s >= config.seconds:
                break
            robot.step()
            ahead = begin + robot.time_s - time.monotonic()
            robot.outcome.lag_s = max(robot.outcome.lag_s, -ahead)
            if ahead > 0:
                time.sleep(ahead)
    except KeyboardInterrupt:
        pass
    finally:
        robot.close()
    if config.report is not None:
        config.report.parent.mkdir(parents=True, exist_ok=True)
        config.report.write_text(json.dumps(asdict(robot.outcome)))
    return robot.outcome
