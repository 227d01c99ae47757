"""What is measured of a gait, trial by trial: how it follows sudden commands, and what its joints and feet bear."""

from __future__ import annotations

import math

import torch

from omniperception.env.env import OmniEnv
from omniperception.env.mdp.commands import VelocityCommand
from omniperception.evaluation.trials.outcomes import GRAVITY
from omniperception.evaluation.trials.tally import trial_numbers

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

_SUMS = (
    *("steps", "settled", "velocity_error", "yaw_rate_error", "torque_limited", "at_stop", "target_change"),
    *("contact", "slip", "landings", "swing_height", "impact"),
    *("standing", "standing_speed", "standing_joint_speed"),
)


class WalkingTally:
    """Adds up the running trial of every environment and files the first `num_trials` when they end.

    Needs commands that are velocities, and the contact sensor "foot_force".
    """

    def __init__(self, env: OmniEnv, num_trials: int) -> None:
        if not isinstance(env.command, VelocityCommand):
            raise ValueError("a gait is measured on velocity commands; use commands=velocity")
        self._env, self._trial, self._count, self._command = env, trial_numbers(env), num_trials, env.command
        n, device, double = env.num_envs, env.device, torch.float64
        self._sums = torch.zeros(n, len(_SUMS), dtype=double, device=device)
        self._filed = torch.zeros(num_trials, len(_SUMS), dtype=double, device=device)
        self._fastest = torch.zeros(n, device=device)
        self._filed_fastest = torch.zeros(num_trials, device=device)
        self._tile = torch.zeros(num_trials, 2, dtype=torch.int64, device=device)
        feet = len(env.robot.foot_geoms)
        self._left_at, self._peak = torch.zeros(2, n, feet, device=device).unbind(0)
        self._was_down = torch.zeros(n, feet, dtype=torch.bool, device=device)
        self._swung_s = torch.full((n, feet), torch.nan, device=device)  # since it left the ground, if that was seen
        self._weight = float(env.world.model.body_subtreemass[env.world.base_body]) * GRAVITY
        _ = env.state.joint_torque, env.state.foot_force, env.state.foot_vel_w  # recorded from now on

    def begin(self, fresh: torch.Tensor) -> None:
        """Takes in where trials are about to begin, in environments (n,)."""
        fresh = fresh[self._trial[fresh] < self._count]
        ground = self._env.ground
        if ground is not None:
            self._tile[self._trial[fresh]] = torch.stack((ground.level[fresh], ground.column[fresh]), 1)

    def record(self) -> None:
        """Takes in the control step that has just been done, before finished environments are reset."""
        with self._env.timer.stage("measuring"):
            self._add_step()
            self._file_ended()

    def _add_step(self) -> None:
        env, state = self._env, self._env.state
        kinematics = state.kinematics
        settled = self._command.settled
        stands = settled & (state.command == 0).all(1)
        joint_pos, joint_speed = kinematics.joint_pos, kinematics.joint_vel.abs()
        stop = (joint_pos < state.joint_lower + AT_STOP) | (joint_pos > state.joint_upper - AT_STOP)
        limited = state.joint_torque.abs() >= AT_LIMIT * state.joint_torque_limit
        change = (state.targets[0] - state.targets[1]).abs().mean(1)
        speed = kinematics.base_lin_vel_yaw.norm(dim=1)
        step = {
            "steps": torch.ones_like(settled),
            "settled": settled,
            "velocity_error": env.velocity_error * settled,
            "yaw_rate_error": env.yaw_rate_error * settled,
            "torque_limited": limited.any(1),
            "at_stop": stop.any(1),
            "target_change": change,
            **self._feet(),
            "standing": stands,
            "standing_speed": speed * stands,
            "standing_joint_speed": joint_speed.mean(1) * stands,
        }
        healthy = env.healthy[:, None]
        self._sums += torch.where(healthy, torch.stack([step[name].double() for name in _SUMS], 1), 0.0)
        self._fastest = torch.where(env.healthy, torch.maximum(self._fastest, joint_speed.amax(1)), self._fastest)

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
            "slip": (state.foot_vel_w[..., :2].norm(dim=-1) * down).sum(1),
            "landings": landed.sum(1),
            "swing_height": torch.where(landed, rise, 0.0).sum(1),
            "impact": torch.where(landed, force, 0.0).sum(1),
        }

    def _file_ended(self) -> None:
        env = self._env
        filed = (env.done & (self._trial < self._count)).nonzero().flatten()
        if len(filed):
            self._filed[self._trial[filed]] = self._sums[filed]
            self._filed_fastest[self._trial[filed]] = self._fastest[filed]
        self._sums *= ~env.done[:, None]
        self._fastest *= ~env.done
        self._was_down &= ~env.done[:, None]
        self._swung_s.masked_fill_(env.done[:, None], torch.nan)

    def columns(self) -> dict[str, torch.Tensor]:
        """(num_trials,) float64 each, by the names in COLUMNS."""
        sums = dict(zip(_SUMS, self._filed.cpu().unbind(1), strict=True))
        dt = self._env.control_dt
        level, tile = self._tile.cpu().double().unbind(1)
        return {
            "settled_s": sums["settled"] * dt,
            "settled_velocity_error": sums["velocity_error"] / sums["settled"],
            "settled_yaw_rate_error": sums["yaw_rate_error"] / sums["settled"],
            **{name: sums[name] / sums["steps"] for name in ("torque_limited", "at_stop", "target_change")},
            "joint_speed": self._filed_fastest.cpu().double(),
            "foot_slip": sums["slip"] / sums["contact"],
            "swing_height": sums["swing_height"] / sums["landings"],
            "impact": sums["impact"] / sums["landings"],
            "standing_s": sums["standing"] * dt,
            "standing_speed": sums["standing_speed"] / sums["standing"],
            "standing_joint_speed": sums["standing_joint_speed"] / sums["standing"],
            "level": level,
            "tile": tile,
        }
