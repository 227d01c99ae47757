"""Observation terms: functions of the state that return (num_envs, width), and how each looks in the mirror."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from omniperception.avoidance.navigation import navigation_inputs
from omniperception.avoidance.sector_motion import encode
from omniperception.avoidance.velocity_risk import VelocityRisk
from omniperception.common.rotations import rotate_yaw
from omniperception.env.mdp.terms import JOINT_MAGNITUDES, JOINTS, ROTATION, VECTOR, StatefulTerm, mirrors
from omniperception.env.state import EnvState, requires, rests


@requires("legs")
@mirrors(JOINTS)
def joint_pos_offset(state: EnvState) -> torch.Tensor:
    """Joint position relative to the default pose, rad, as measured (with latency when randomized)."""
    return state.measured.joint_pos - state.default_joint_pos


@requires("legs")
@mirrors(JOINTS)
def joint_vel(state: EnvState, scale: float = 1.0) -> torch.Tensor:
    """Joint velocity, rad/s, times `scale`, as measured."""
    return state.measured.joint_vel * scale


@mirrors(VECTOR)
def base_lin_vel(state: EnvState) -> torch.Tensor:
    """Base linear velocity in the base frame, m/s, as measured."""
    return state.measured.base_lin_vel_b


@mirrors(ROTATION)
def base_ang_vel(state: EnvState, scale: float = 1.0) -> torch.Tensor:
    """Base angular velocity in the base frame, rad/s, times `scale`, as measured."""
    return state.measured.base_ang_vel_b * scale


@mirrors(VECTOR)
def projected_gravity(state: EnvState) -> torch.Tensor:
    """Unit vector of gravity in the base frame, as measured."""
    return state.measured.projected_gravity_b


@mirrors((1.0, -1.0, -1.0))
def command(state: EnvState) -> torch.Tensor:
    """v_x, v_y (m/s) and yaw rate (rad/s) in the base frame: `EnvState.reference`."""
    return state.reference


@mirrors(JOINTS)
def previous_action(state: EnvState) -> torch.Tensor:
    """The action applied in the step that ended."""
    return state.actions[0]


@mirrors((-1.0, -1.0))
def gait_phase(state: EnvState, frequency: float, rest_s: float) -> torch.Tensor:
    """Sine and cosine of a clock of `frequency` (Hz) that starts with the episode; 0 once the robot should rest.

    It should rest while the command is to stand, and has been for `rest_s` (s): whoever runs has to step to stop.

    Its mirror image is half a period off, as the feet of a trot are.
    """
    angle = 2 * torch.pi * frequency * state.time_s
    return torch.stack((angle.sin(), angle.cos()), 1) * ~rests(state, rest_s)[:, None]


@requires("legs")
@mirrors(JOINTS, JOINTS, VECTOR, ROTATION, VECTOR)
def true_proprioception(state: EnvState, joint_vel_scale: float = 1.0, ang_vel_scale: float = 1.0) -> torch.Tensor:
    """The 33 proprioceptive values without latency or noise: privileged."""
    k = state.kinematics
    return torch.cat(
        (
            k.joint_pos - state.default_joint_pos,
            k.joint_vel * joint_vel_scale,
            k.base_lin_vel_b,
            k.base_ang_vel_b * ang_vel_scale,
            k.projected_gravity_b,
        ),
        1,
    )


@mirrors(VECTOR)
def true_base_lin_vel(state: EnvState) -> torch.Tensor:
    """Base linear velocity in the base frame, m/s, without latency or error: privileged."""
    return state.kinematics.base_lin_vel_b


@mirrors((1.0,))
def base_height(state: EnvState) -> torch.Tensor:
    """Height (m) of the base origin above the ground, less the default pose's: privileged."""
    return state.base_height[:, None] - state.default_base_height


# in the order of randomization.DRAWN
@mirrors((1.0, 1.0), JOINT_MAGNITUDES, VECTOR, JOINTS, (1.0, 1.0, 1.0), VECTOR)
def drawn_physics(state: EnvState) -> torch.Tensor:
    """What randomization drew for the physics and the actuation; see `Randomizer.drawn`: privileged."""
    return state.drawn_physics


def heights(state: EnvState) -> torch.Tensor:
    """The 187-point height grid around the robot: privileged."""
    return state.heights


@mirrors((1.0, -1.0, 1.0, -1.0, 1.0, 1.0))
def nearest_obstacles(state: EnvState, count: int, max_distance: float) -> torch.Tensor:
    """Relative position, relative velocity, radius and nearness of the nearest obstacles: privileged.

    Per obstacle, nearest edge first, in the yaw-aligned frame: x, y (m, divided by max_distance), v_x, v_y (m/s),
    radius (m), and 1 - distance / max_distance (0 beyond, or when fewer obstacles take part). Edges and radii are those
    of the circles around the footprints, which say little about long walls. No wider than there are obstacles.
    """
    pos, vel, radius, active, *_ = state.obstacles
    distance = (pos.norm(dim=-1) - radius).masked_fill(~active, float("inf"))
    nearest, index = distance.topk(min(count, distance.shape[1]), dim=1, largest=False)
    nearness = (1 - nearest / max_distance).clamp(min=0.0)
    gather = index[..., None].expand(-1, -1, 2)
    rel_vel = vel - state.kinematics.base_lin_vel_yaw[:, None]
    features = torch.cat(
        (
            pos.gather(1, gather) / max_distance,
            rel_vel.gather(1, gather),
            radius.gather(1, index)[..., None],
            nearness[..., None],
        ),
        -1,
    )
    return (features * (nearness > 0)[..., None]).flatten(1)


@requires("avoidance")
@mirrors((1.0, -1.0))
def avoidance_target(state: EnvState) -> torch.Tensor:
    """The avoidance velocity (m/s, yaw-aligned frame) that the reward asks for: privileged."""
    return state.avoidance_velocity


@dataclass(frozen=True)
class SectorErrors:
    """Errors of what is known by sector, beside the truth.

    Standard deviations are drawn for each robot and episode between none and those given here, so that a policy learns
    from good eyes and from bad ones.

    Attributes:
        distance: largest standard deviation (m) of a distance of 1 m; it grows with the distance.
        velocity: largest standard deviation (m/s) of each component of a velocity.
        slowed: (low, high) factor on velocities, drawn for each robot and episode: a network that is unsure says less.
        lost: share of the sectors that are empty although something is there.
        late: share of the steps in which what is known is one step old.
        lasts_s: time (s) after which a fraction 1/e of an error is left.
        seen_deg: to either side of straight ahead an obstacle is seen; the body hides what is behind from a LiDAR at
            the head.
        remembered_s: time (s) for which an obstacle is known after it was seen last.
    """

    distance: float
    velocity: float
    slowed: Sequence[float]
    lost: float
    late: float
    lasts_s: float
    seen_deg: float = 180.0
    remembered_s: float = 0.8


class NavigationView(StatefulTerm):
    """What a navigation policy reads (`avoidance.navigation`), from the true sectors with errors."""

    def __init__(self, risk: VelocityRisk, errors: SectorErrors | None = None) -> None:
        """
        Args:
            risk: the controller on whose choice the policy builds.
            errors: of the sectors; None: they are true.
        """
        self._risk, self._errors = risk, errors
        self._candidates: torch.Tensor | None = None

    def __call__(self, state: EnvState) -> torch.Tensor:
        if self._candidates is None:
            self._begin(state)
        assert self._candidates is not None
        sectors = state.sectors if self._errors is None else self._with_errors(state, self._errors)
        velocity, asked = state.measured.planar_velocity, state.asked
        return navigation_inputs(sectors, state.reference, velocity, asked, self._risk, self._candidates)

    def _begin(self, state: EnvState) -> None:
        self._candidates = self._risk.candidates(state.device)
        self.wrong = torch.zeros_like(state.sectors)
        self.slowed, self.level = torch.ones(2, state.num_envs, device=state.device).unbind(0)
        self.before = torch.zeros_like(state.sectors)
        self.before[..., 0] = torch.inf
        obstacles = len(state.true_sectors.names) if self._errors is not None else 0
        self.unseen_s = torch.full((state.num_envs, obstacles), torch.inf, device=state.device)
        if self._errors is not None:
            self.reset(torch.arange(state.num_envs, device=state.device))

    def _with_errors(self, state: EnvState, errors: SectorErrors) -> torch.Tensor:
        kept = math.exp(-state.control_dt / errors.lasts_s)
        self.wrong = kept * self.wrong + math.sqrt(1 - kept**2) * torch.randn_like(self.wrong)
        true, wrong = self._known(state, errors), self.wrong * self.level[:, None, None]
        distance = true[..., 0] * (1 + errors.distance * wrong[..., 0])
        velocity = true[..., 1:] * self.slowed[:, None, None] + errors.velocity * wrong[..., 1:]
        lost = torch.rand_like(distance) < errors.lost
        known = torch.cat((distance.clamp(min=0.0).masked_fill(lost, torch.inf)[..., None], velocity), -1)
        late = torch.rand(len(known), 1, 1, device=known.device) < errors.late
        shown, self.before = torch.where(late, self.before, known), known
        return shown

    def _known(self, state: EnvState, errors: SectorErrors) -> torch.Tensor:
        """True sectors of what was seen lately."""
        if errors.seen_deg >= 180.0:
            return state.sectors
        kinematics = state.kinematics
        seen = state.true_sectors.in_view(kinematics.base_pos_w, kinematics.yaw, math.radians(errors.seen_deg))
        self.unseen_s = torch.where(seen, 0.0, self.unseen_s + state.control_dt)
        known = self.unseen_s <= errors.remembered_s
        return state.true_sectors.measure(kinematics.base_pos_w, kinematics.yaw, known)

    def reset(self, env_ids: torch.Tensor) -> None:
        if self._errors is None or self._candidates is None:
            return
        self.unseen_s = self.unseen_s.index_fill(0, env_ids, torch.inf)
        low, high = self._errors.slowed
        self.slowed[env_ids] = low + (high - low) * torch.rand(len(env_ids), device=self.slowed.device)
        self.level[env_ids] = torch.rand(len(env_ids), device=self.level.device)
        self.wrong[env_ids] = torch.randn_like(self.wrong[env_ids])
        self.before[env_ids, :, 0] = torch.inf


def true_sectors(state: EnvState) -> torch.Tensor:
    """(num_envs, 108) nearness, radial and tangential velocity by sector (`sector_motion.encode`): privileged."""
    return encode(state.sectors).flatten(1)


def true_motion(state: EnvState) -> torch.Tensor:
    """(num_envs, 6) v_x, v_y (m/s, yaw-aligned frame) and yaw rate (rad/s), and what the gait is asked for now:
    privileged."""
    return torch.cat((state.kinematics.planar_velocity, state.asked), 1)


def way_to_goal(state: EnvState, unit: float) -> torch.Tensor:
    """(num_envs, 3) place of the goal (m, yaw-aligned frame) in units of `unit`, at most 2 of them, and the time that
    the episode has lasted, in units of 20 s: privileged; 0 without a goal."""
    goal_w = state.goal_w
    if goal_w is None:
        place = torch.zeros(state.num_envs, 2, device=state.device)
    else:
        k = state.kinematics
        place = rotate_yaw(-k.yaw, goal_w - k.base_pos_w[:, :2]) / unit
    return torch.cat((place.clamp(-2.0, 2.0), state.time_s[:, None] / 20.0), 1)


def drawn_response(state: EnvState) -> torch.Tensor:
    """(num_envs, 13) how a robot without legs answers: gain, lag, delay and offset by axis, and radius: privileged."""
    return state.drawn_response


@mirrors((1.0, -1.0, -1.0))
def planar_velocity(state: EnvState) -> torch.Tensor:
    """v_x, v_y (m/s, yaw-aligned frame) and yaw rate (rad/s), as measured."""
    return state.measured.planar_velocity


@mirrors((1.0, -1.0, -1.0))
def asked_velocity(state: EnvState) -> torch.Tensor:
    """What the gait is asked for now, v_x, v_y (m/s, yaw-aligned frame) and yaw rate (rad/s)."""
    return state.asked.clone()
