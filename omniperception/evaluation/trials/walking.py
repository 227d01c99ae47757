"""What is measured of a gait, trial by trial: how it follows sudden commands, and what its joints and feet bear."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch

from omniperception.env.env import OmniEnv
from omniperception.env.mdp.commands import VelocityCommand
from omniperception.evaluation.trials.outcomes import GRAVITY

AT_LIMIT = 0.999
"""Share of its limit from which on a torque counts as limited."""
AT_STOP = math.radians(0.5)
"""Angle (rad) from the end of its range up to which a joint counts as at its stop."""

SWING_S = 0.06
"""Time (s) off the ground from which on a foot has swung; one that is down sooner has bounced."""

COLUMNS = {
    "settled_s": "time (s) later than commands.SETTLE_S after a new command",
    "settled_velocity_error": "mean error (m/s) of the horizontal velocity in that time",
    "settled_yaw_rate_error": "mean error (rad/s) of the yaw rate in that time",
    "torque_limited": "share of the control steps in which a joint's torque is at its limit",
    "at_stop": "share of the control steps in which a joint is at its stop",
    "joint_speed": "highest speed (rad/s) of any joint",
    "target_change": "mean change (rad) of a joint's target from one control step to the next",
    "foot_slip": "mean horizontal speed (m/s) of feet in contact",
    "swing_height": "mean over swings of SWING_S or more of the highest point (m) above where the foot left the ground",
    "impact": "mean over the ends of those swings of the foot's force over the robot's weight",
    "standing_s": "time (s) commanded to stand, later than commands.SETTLE_S after that command",
    "standing_speed": "mean horizontal speed (m/s) in that time",
    "standing_joint_speed": "mean speed (rad/s) of a joint in that time",
    "level": "row of the terrain's tile; 0 on flat ground",
    "tile": "column of the terrain's tile; 0 on flat ground",
}
"""Figures of a trial; NaN where there was nothing to measure them on. Torques and forces are those of the last physics
step of each control step."""


class Walking:
    """Figures of a gait in each control step, which `Tally` sums up and files by trial.

    Needs commands that are velocities, and the contact sensor "foot_force".
    """

    SUMS = (
        *("settled", "settled_velocity_error", "settled_yaw_rate_error", "torque_limited", "at_stop", "target_change"),
        *("contact", "foot_slip", "landings", "swing_height", "impact"),
        *("standing", "standing_speed", "standing_joint_speed"),
    )

    def __init__(self, env: OmniEnv, num_trials: int) -> None:
        self._env, n, device, feet = env, env.num_envs, env.device, len(env.robot.foot_geoms)
        self._fastest = torch.zeros(n, device=device)
        self._filed_fastest = torch.zeros(num_trials, device=device)
        self._tile = torch.zeros(num_trials, 2, dtype=torch.int64, device=device)
        self._left_at, self._peak = torch.zeros(2, n, feet, device=device).unbind(0)
        self._was_down = torch.zeros(n, feet, dtype=torch.bool, device=device)
        self._swung_s = torch.full((n, feet), torch.nan, device=device)  # since it left the ground, if that was seen
        self._weight = float(env.world.model.body_subtreemass[env.world.base_body]) * GRAVITY
        _ = env.state.joint_torque, env.state.foot_force, env.state.foot_vel_w  # recorded from now on

    def begin(self, env_ids: torch.Tensor, trials: torch.Tensor) -> None:
        """Takes in where trials (n,) are about to begin, in environments (n,)."""
        ground = self._env.ground
        if ground is not None:
            self._tile[trials] = torch.stack((ground.level[env_ids], ground.column[env_ids]), 1)

    def step(self) -> dict[str, torch.Tensor]:
        """(num_envs,) SUMS of the control step that has just been done."""
        env, state = self._env, self._env.state
        assert isinstance(env.command, VelocityCommand)
        kinematics, settled = state.kinematics, env.command.settled
        stands = settled & (state.command == 0).all(1)
        joint_pos, joint_speed = kinematics.joint_pos, kinematics.joint_vel.abs()
        stop = (joint_pos < state.joint_lower + AT_STOP) | (joint_pos > state.joint_upper - AT_STOP)
        limited = state.joint_torque.abs() >= AT_LIMIT * state.joint_torque_limit
        self._fastest = torch.where(env.healthy, torch.maximum(self._fastest, joint_speed.amax(1)), self._fastest)
        return {
            "settled": settled,
            "settled_velocity_error": env.velocity_error * settled,
            "settled_yaw_rate_error": env.yaw_rate_error * settled,
            "torque_limited": limited.any(1),
            "at_stop": stop.any(1),
            "target_change": (state.targets[0] - state.targets[1]).abs().mean(1),
            **self._feet(),
            "standing": stands,
            "standing_speed": kinematics.base_lin_vel_yaw.norm(dim=1) * stands,
            "standing_joint_speed": joint_speed.mean(1) * stands,
        }

    def _feet(self) -> dict[str, torch.Tensor]:
        """Sums over the feet in this control step."""
        state = self._env.state
        down, height = state.foot_contact, state.foot_pos_w[..., 2]
        lifted = ~down & self._was_down
        landed = down & (self._swung_s > SWING_S - 0.5 * self._env.control_dt)
        self._left_at = torch.where(lifted, height, self._left_at)
        self._peak = torch.where(lifted, height, torch.maximum(self._peak, height))
        force = state.foot_force.norm(dim=-1) / self._weight
        rise = self._peak - self._left_at
        self._swung_s = (torch.where(lifted, 0.0, self._swung_s) + self._env.control_dt).masked_fill(down, torch.nan)
        self._was_down = down
        return {
            "contact": down.sum(1),
            "foot_slip": (state.foot_vel_w[..., :2].norm(dim=-1) * down).sum(1),
            "landings": landed.sum(1),
            "swing_height": torch.where(landed, rise, 0.0).sum(1),
            "impact": torch.where(landed, force, 0.0).sum(1),
        }

    def end(self, env_ids: torch.Tensor, trials: torch.Tensor, done: torch.Tensor) -> None:
        """Files what is no sum of environments (n,) in trials (n,), and starts again where done (num_envs,)."""
        self._filed_fastest[trials] = self._fastest[env_ids]
        self._fastest *= ~done
        self._was_down &= ~done[:, None]
        self._swung_s.masked_fill_(done[:, None], torch.nan)

    def columns(self, sums: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """(num_trials,) float64 each, by the names in COLUMNS, from the sums (num_trials,) of SUMS and steps."""

        def mean(over: str, *names: str) -> dict[str, torch.Tensor]:
            return {name: sums[name] / sums[over] for name in names}

        level, tile = self._tile.cpu().double().unbind(1)
        return {
            "settled_s": sums["settled"] * self._env.control_dt,
            **mean("settled", "settled_velocity_error", "settled_yaw_rate_error"),
            **mean("steps", "torque_limited", "at_stop", "target_change"),
            "joint_speed": self._filed_fastest.cpu().double(),
            **mean("contact", "foot_slip"),
            **mean("landings", "swing_height", "impact"),
            "standing_s": sums["standing"] * self._env.control_dt,
            **mean("standing", "standing_speed", "standing_joint_speed"),
            "level": level,
            "tile": tile,
        }
