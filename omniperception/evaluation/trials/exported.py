"""An exported policy in the environments of a run: it gets what a robot would sense, not the observations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from tensordict import TensorDict

from omnilidar import Lidar, LidarFrame
from omniperception.deploy.export import own_quantity
from omniperception.env.env import OmniEnv
from omnirobot.runtime import DeployError, ExportedPolicy, RobotState, SafetyStop
from omnirobot.runtime.latency import Reading


class ExportedPolicies:
    """A policy for `run_episodes`: one exported policy per environment, with the memory that a robot's would have.

    Attributes:
        robots: the exported policies.
    """

    def __init__(self, env: OmniEnv, policy: ExportedPolicy) -> None:
        """Args: env: at the start of its first episodes; policy: what each robot runs."""
        described = policy.description
        if tuple(described.joints.names) != tuple(env.robot.joints):
            raise DeployError(f"the policy moves {list(described.joints.names)}, this robot has {env.robot.joints}")
        self._env = env
        self.robots = [policy.clone() for _ in range(env.num_envs)]
        self._tick = 0

    def __call__(self, observations: TensorDict) -> torch.Tensor:
        """(num_envs, num_actions) for the environment's present state; the observations are not read.

        What a robot's safety limits is limited here, and a robot that it stops is damped: its targets are where the
        joints are.
        """
        env = self._env
        if env.step_count:
            for index in env.done.nonzero().flatten().tolist():
                self.robots[index].reset()
        late = None if env.sensing is None else env.sensing.late_steps
        ages_s = [0.0] * env.num_envs if late is None else (late * env.control_dt).tolist()  # of the newest frames
        commands = env.command.value.cpu().numpy()
        given = zip(self.robots, robot_states(env), commands, self._new_clouds(), ages_s, strict=True)
        return torch.from_numpy(np.stack([_action(*each) for each in given])).to(env.device)

    def _new_clouds(self) -> list[np.ndarray | None]:
        """Points of the frame that has just come; None without one, or where the episode has just begun."""
        env = self._env
        if self.robots[0].frames is None or env.sensing is None or env.sensing.tick == self._tick:
            return [None] * env.num_envs
        self._tick = env.sensing.tick
        frame = env.sensing.frame
        assert frame is not None and env.sensing.history is not None  # it has ticked, and the policy looks
        for robot, came in zip(self.robots, env.sensing.fresh.tolist(), strict=True):
            if not came:
                robot.repeat_frame()
        new = (env.sensing.fresh & (env.sensing.history.count[:, 0] > 0)).tolist()
        return [cloud if is_new else None for cloud, is_new in zip(raw_points(frame), new, strict=True)]


def _action(
    robot: ExportedPolicy, state: RobotState, command: np.ndarray, cloud: np.ndarray | None, age_s: float
) -> np.ndarray:
    """(num_actions,) the action whose target is the robot's."""
    joints = robot.description.joints
    try:
        targets = robot.step(state, command, cloud, age_s)
    except SafetyStop:
        targets = np.asarray(state.joint_pos, np.float32)
    if robot.safety is None:
        return robot.action
    return (targets - robot.pose) / np.asarray(joints.action_scale, np.float32)


def robot_states(env: OmniEnv) -> list[RobotState]:
    """Measured state of each robot, with the latency that the environment gives it."""
    m = env.state.measured
    tensors = m.joint_pos, m.joint_vel, m.base_quat_w, m.base_ang_vel_b, m.base_lin_vel_b
    other = {name: value.cpu().numpy() for name, value in _other_readings(env).items()}
    states = [RobotState(*values) for values in zip(*(tensor.cpu().numpy() for tensor in tensors), strict=True)]
    return [replace(one, other={name: value[k] for name, value in other.items()}) for k, one in enumerate(states)]


def _other_readings(env: OmniEnv) -> dict[str, torch.Tensor]:
    """(num_envs, width) newest values of the actor's terms that are measured by names of their own."""
    readings = {}
    for name in env.config.observations.actor:
        group, widths = env.config.observations.groups[name], list(env.observation_widths(name).values())
        newest = env.observations[name][:, -sum(widths) :].split(widths, 1)
        for term, value in zip(group.terms.values(), newest, strict=True):
            if (quantity := own_quantity(term)) is not None:
                readings[quantity] = value
    return readings


def raw_points(frame: LidarFrame) -> np.ndarray:
    """(num_envs, num_rays, 3) points (m, sensor frame) of a frame, noise included, misses as zeros."""
    assert frame.ranges is not None and frame.directions_s is not None  # asked for
    points = torch.where(frame.ranges.isfinite()[..., None], frame.ranges[..., None] * frame.directions_s, 0.0)
    return points.cpu().numpy()


def record(env: OmniEnv, policy: ExportedPolicy, steps: int, whole_frames: bool) -> list[Reading]:
    """Readings of the first robot while the policy drives it.

    Args:
        env: at the start of its first episodes.
        policy: what each robot runs.
        steps: control steps.
        whole_frames: all points that the device measures, in place of those that training kept; without noise.
    """
    policies, sensing = ExportedPolicies(env, policy), env.sensing
    device = _whole_device(env) if whole_frames else None
    readings, tick = [], 0
    for step in range(steps):
        points = None
        if policies.robots[0].frames is not None and sensing is not None and sensing.tick != tick:
            tick, frame = sensing.tick, sensing.frame
            if device is not None:
                time_s = torch.full((env.num_envs,), step * env.control_dt, dtype=torch.float64)
                frame = device.cast(time_s.to(env.device))
            assert frame is not None  # it has ticked
            points = raw_points(frame)[0].copy()
        readings.append(Reading(robot_states(env)[0], env.command.value[0].cpu().numpy().copy(), points))
        with torch.no_grad():
            env.step(policies(env.get_observations()))
    return readings


def _whole_device(env: OmniEnv) -> Lidar:
    """The environment's LiDAR with every point that it measures."""
    sensing = env.sensing
    assert sensing is not None  # the policy looks at points
    config, pattern = sensing.config, sensing.config.scan_pattern()
    lidar = Lidar(
        replace(config, num_rays=pattern.points_per_frame(config.period_s), selection="every_kth"),
        pattern,
        sensing.scene,
        mount_body=sensing.carrier,
        seed=env.config.seed,
        outputs=("ranges", "directions_s"),
    )
    lidar.phase_rows.copy_(sensing.lidar.phase_rows)
    return lidar
