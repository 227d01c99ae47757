"""What is measured of every trial while it runs, filed by the trial's number when it ends."""

from __future__ import annotations

import math

import torch

from omniperception.common.random import TrialRandom
from omniperception.env.env import OmniEnv
from omniperception.env.mdp.commands import GoalCommand, GoalCommandConfig, VelocityCommand
from omniperception.env.metrics import OUTCOMES
from omniperception.evaluation.trials.clearance import Clearance
from omniperception.evaluation.trials.outcomes import CLEARANCE_CAP, GRAVITY, Episodes
from omniperception.evaluation.trials.tracks import Tracks
from omniperception.evaluation.trials.walking import Walking
from omniperception.scene.build import FOOT_FORCE

CLEARANCE_EVERY = 2
"""Control steps between two measurements of the clearance."""

_SUMS = (
    *("steps", "velocity_error", "yaw_rate_error", "free", "free_velocity_error"),
    *("contacts", "impulse", "energy", "path"),
)
"""Sums over the control steps of a trial."""


def trial_numbers(env: OmniEnv) -> torch.Tensor:
    """(num_envs,) the trial that each environment is in.

    Raises:
        ValueError: its episodes are no trials.
    """
    if not isinstance(env.random, TrialRandom):
        raise ValueError("the episodes of this environment are no trials; build it with EnvConfig.trials")
    return env.random.trial


class Tally:
    """Adds up the running trial of every environment and files the first `num_trials` when they end.

    Trials begin in the order of their numbers, and all that have begun are waited for: short ones count no more than
    long ones.

    Attributes:
        left: trials that have not ended yet.
    """

    def __init__(self, env: OmniEnv, num_trials: int) -> None:
        self._env, self._trial, self._count, self.left = env, trial_numbers(env), num_trials, num_trials
        device, double = env.device, torch.float64
        n, filed = (env.num_envs,), (num_trials,)
        measures_walking = isinstance(env.command, VelocityCommand) and FOOT_FORCE in env.world.sensors
        self._walking = Walking(env, num_trials) if measures_walking else None
        self._names = _SUMS + (Walking.SUMS if measures_walking else ())
        self._sums = torch.zeros(*n, len(self._names), dtype=double, device=device)
        self._is_contact = torch.tensor([name == "contacts" for name in self._names], device=device)
        self._filed = torch.zeros(*filed, len(self._names), dtype=double, device=device)
        self._outcome = torch.zeros(filed, dtype=torch.int64, device=device)
        self._first_contact = torch.full(n, math.inf, dtype=double, device=device)
        self._filed_contact = torch.zeros(filed, dtype=double, device=device)
        self._free_time = torch.zeros(filed, dtype=double, device=device)
        layouts = env.obstacles.world.shape[1] if env.obstacles is not None else 0
        self._world = torch.zeros(filed, dtype=torch.int64, device=device) if layouts == 1 else None
        self._clearance = Clearance(env) if env.config.obstacles.num_obstacles else None
        self._least = torch.full(n, CLEARANCE_CAP, device=device)
        self._filed_least = torch.zeros(filed, device=device)
        _ = env.state.joint_torque  # recorded from now on
        self._was_touching = torch.zeros(n, dtype=torch.bool, device=device)
        self._knows_free = True

    def begin(self, fresh: torch.Tensor) -> None:
        """Takes in the scenes of environments (n,) in which trials are about to begin."""
        commands, goal = self._env.config.commands, self._env.command.goal_w
        fresh = fresh[self._trial[fresh] < self._count]
        if self._walking is not None:
            self._walking.begin(fresh, self._trial[fresh])
        if self._world is not None and self._env.obstacles is not None:
            self._world[self._trial[fresh]] = self._env.obstacles.world[fresh, 0]
        if isinstance(commands, GoalCommandConfig) and goal is not None:
            way = goal[fresh] - self._env.state.kinematics.base_pos_w[fresh, :2]
            length = way[:, 0] if commands.radius is None else way.norm(dim=1) - commands.radius
            command = self._env.command
            if commands.route_ahead is not None and isinstance(command, GoalCommand):
                length = command.way(self._env.state.kinematics)[fresh]
            speed: torch.Tensor | float = commands.speeds[0]
            if isinstance(command, GoalCommand) and commands.speeds[0] < commands.speeds[1]:
                speed = command.speed[fresh, 0].double()
            free = (length.double() / speed).clamp(min=commands.hold_s)
            self._free_time[self._trial[fresh]] = free

    def record(self) -> None:
        """Takes in the control step that has just been done, before finished environments are reset."""
        with self._env.timer.stage("measuring"):
            self._add_step()
            self._file_ended()

    def _add_step(self) -> None:
        env, dt = self._env, self._env.control_dt
        free = env.no_obstacle_near
        self._knows_free = free is not None
        if free is None:
            free = torch.zeros_like(env.done)
        began = env.contacts & ~self._was_touching
        kinematics = env.state.kinematics
        step = {
            "steps": torch.ones_like(free),
            "velocity_error": env.velocity_error,
            "yaw_rate_error": env.yaw_rate_error,
            "free": free,
            "free_velocity_error": env.velocity_error * free,
            "contacts": began,
            "impulse": env.state.obstacle_impulse,
            "energy": (env.state.joint_torque * kinematics.joint_vel).abs().sum(1) * dt,
            "path": kinematics.base_lin_vel_yaw.norm(dim=1) * dt,
        }
        if self._walking is not None:
            step |= self._walking.step()
        counted = env.healthy[:, None] | self._is_contact  # what physics diverges from is touched all the same
        self._sums += torch.where(counted, torch.stack([step[name].double() for name in self._names], 1), 0.0)
        time = self._sums[:, 0] * dt
        self._first_contact = torch.where(began, torch.minimum(self._first_contact, time), self._first_contact)
        if self._clearance is not None:
            between = (env.episode_length_buf % CLEARANCE_EVERY != 0) & ~env.done
            skipped = between | (self._trial >= self._count) | self._first_contact.isfinite()
            nearer = self._clearance.measure(self._least.masked_fill(skipped, 0.0))
            self._least = torch.where(skipped, self._least, nearer)
        self._was_touching = env.contacts & ~env.done

    def _file_ended(self) -> None:
        env = self._env
        filed = (env.done & (self._trial < self._count)).nonzero().flatten()
        trial = self._trial[filed]
        self._filed[trial] = self._sums[filed]
        self._filed_contact[trial] = self._first_contact[filed]
        self._filed_least[trial] = torch.where(self._first_contact[filed].isinf(), self._least[filed], 0.0)
        self._outcome[trial] = torch.stack([env.outcomes[name] for name in OUTCOMES], 1)[filed].int().argmax(1)
        self.left -= len(filed)
        if self._walking is not None:
            self._walking.end(filed, trial, env.done)
        self._sums *= ~env.done[:, None]
        self._first_contact.masked_fill_(env.done, math.inf)
        self._least = self._least.masked_fill(env.done, CLEARANCE_CAP)

    def episodes(self, us_per_env_step: dict[str, float], tracks: Tracks | None) -> Episodes:
        """All trials, in their order."""
        env, dt = self._env, self._env.control_dt
        sums = dict(zip(self._names, self._filed.cpu().unbind(1), strict=True))
        steps, free, has_goal = sums["steps"], sums["free"], env.command.goal_w is not None
        return Episodes(
            length_s=steps * dt,
            outcome=self._outcome.cpu(),
            contacts=sums["contacts"].long(),
            first_contact_s=self._filed_contact.cpu(),
            impulse=sums["impulse"] if self._clearance is not None else None,
            clearance=self._filed_least.cpu().double() if self._clearance is not None else None,
            energy=sums["energy"],
            path=sums["path"],
            free_time_s=self._free_time.cpu() if has_goal else None,
            velocity_error=sums["velocity_error"] / steps,
            free_velocity_error=sums["free_velocity_error"] / free if self._knows_free else None,
            free_s=free * dt if self._knows_free else None,
            yaw_rate_error=sums["yaw_rate_error"] / steps,
            has_goal=has_goal,
            weight=float(env.world.model.body_subtreemass[env.world.base_body]) * GRAVITY,
            world=None if self._world is None else self._world.cpu(),
            us_per_env_step=us_per_env_step,
            tracks=tracks,
            walking=None if self._walking is None else self._walking.columns(sums),
        )
