"""An exported policy in the environments of a run: it gets what a robot would sense, not the observations."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDict

from omniperception.deploy import DeployError, ExportedPolicy, RobotState
from omniperception.task.env import OmniEnv


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
        self.robots = [policy.another() for _ in range(env.num_envs)]
        self._tick = 0

    def __call__(self, observations: TensorDict) -> torch.Tensor:
        """(num_envs, num_actions) for the environment's present state; the observations are not read."""
        env = self._env
        if env.step_count:
            for index in env.done.nonzero().flatten().tolist():
                self.robots[index].reset()
        states, commands, clouds = robot_states(env), env.command.value.cpu().numpy(), self._new_clouds()
        for robot, state, command, cloud in zip(self.robots, states, commands, clouds, strict=True):
            robot.step(state, command, cloud)
        return torch.from_numpy(np.stack([robot.action for robot in self.robots])).to(env.device)

    def _new_clouds(self) -> list[np.ndarray | None]:
        """Points of the frame that has just been cast; None without one, or where the episode has just begun."""
        env = self._env
        if self.robots[0].frames is None or env.sensing is None or env.sensing.tick == self._tick:
            return [None] * env.num_envs
        self._tick = env.sensing.tick
        clouds = raw_points(env)
        return [cloud if count else None for cloud, count in zip(clouds, env.sensing.frame_count, strict=True)]


def robot_states(env: OmniEnv) -> list[RobotState]:
    """What each robot senses of itself, with the latency that the environment gives it."""
    sensed = env.sensed
    tensors = (
        sensed.joint_pos,
        sensed.joint_vel,
        sensed.base_quat_w,
        sensed.base_ang_vel_b,
        sensed.base_lin_vel_b,
    )
    return [RobotState(*values) for values in zip(*(tensor.cpu().numpy() for tensor in tensors), strict=True)]


def raw_points(env: OmniEnv) -> np.ndarray:
    """(num_envs, num_rays, 3) points (m, sensor frame) of the newest frame, noise included, misses as zeros."""
    frame = env.sensing.frame
    points = torch.where(frame.ranges.isfinite()[..., None], frame.ranges[..., None] * frame.directions_s, 0.0)
    return points.cpu().numpy()
