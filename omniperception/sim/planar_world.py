"""Robots without legs: outlines that follow an asked velocity as a measured gait does."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import mujoco
import torch
import warp as wp

from omnilidar.launch import launch_over_envs, view
from omniperception.common.random import Branch, EnvRandom
from omniperception.common.rotations import matrix_of, multiply, rotate, rotate_yaw, yaw_of, yaw_quat
from omniperception.scene import World
from omniperception.scene.build import OBSTACLE_CONTACT, OBSTACLE_FORCE
from omniperception.scene.terrain import TerrainConfig
from omniperception.sim.base import Failure, Failures
from omniperception.sim.planar_kernels import walk
from omniperception.sim.response import AXES, GaitResponse

if TYPE_CHECKING:
    from omniperception.scene import ObstacleField
    from omniperception.sim.planar import PlanarConfig

NEW_TARGET = 0.3
"""Change (m/s) of the asked velocity from one control step to the next from which on it may be a jump that throws the
robot over."""


class PlanarSimulator(Failures):
    """`num_envs` robots that are their outline, base height and attitude, behind the Simulator protocol.

    `step` takes velocities (num_envs, 3) in place of joint targets: v_x, v_y (m/s, yaw-aligned frame) and yaw rate
    (rad/s), which are clipped to the ranges of the gait. The asked velocity moves there at no more than
    `PlanarConfig.acceleration`, and the robot follows it as `AxisResponse` says, each robot and episode with a response
    of its own. A jump of the asked velocity throws it over as often as it was measured to. What it runs into touches
    it, holds it up, or pushes it aside. Base height, attitude and joints go through the recorded cycle of the command
    that is nearest to the asked velocity: legs are there to be seen, and for nothing else. Joint velocities are 0;
    torques and feet do not exist.

    Attributes:
        asked: (num_envs, 3) m/s and rad/s, what the gait is asked for now, after the limit of its change.
    """

    ground_pos: torch.Tensor | None = None

    def __init__(self, world: World, config: PlanarConfig, response: GaitResponse, num_envs: int) -> None:
        if not isinstance(world.terrain, TerrainConfig):
            raise ValueError("sim=planar has flat ground alone; use terrain=flat, or sim=mujoco")
        self.world, self.config, self.num_envs, self.response = world, config, num_envs, response
        self.device = torch.device("cpu")
        world.model.opt.timestep = config.timestep
        joints, parts = world.robot.num_joints, len(world.obstacles.parts())
        self.qpos = torch.zeros(num_envs, 7 + joints)
        self.qvel = torch.zeros(num_envs, 6 + joints)
        self.mocap_pos, self.mocap_quat = torch.zeros(num_envs, parts, 3), torch.zeros(num_envs, parts, 4)
        self.mocap_quat[..., 0] = 1.0
        self.failure = torch.zeros(num_envs, dtype=torch.int64)
        self._random: Branch = EnvRandom(0, num_envs).branch("response")
        self._follow_response()
        n = num_envs
        self._place, self._velocity, self.asked, self._before, self._error = torch.zeros(5, n, 3).unbind(0)
        self._target, self._wrong = torch.zeros(2, n, 3).unbind(0)
        self._gain, self._lag, self._delay, self._offset = torch.ones(4, n, 3).unbind(0)
        self._radius = torch.full((n,), response.radius)
        self._clock = torch.zeros(n)
        self._down, self._touched = torch.zeros(2, n, dtype=torch.bool).unbind(0)
        self._impulse = torch.zeros(n)
        steps = config.decimation
        self._places, self._velocities = torch.zeros(2, n, steps, 3).unbind(0)
        self._all_envs = torch.arange(n)
        self._field: ObstacleField | None = None
        none = torch.zeros(n, 0)
        self._nothing = (torch.zeros(n, 0, 2), none.bool(), none, none, torch.zeros(n, 0, 2))
        self._links: dict[tuple[int, ...], _Links] = {}
        self._mass = float(world.model.body_subtreemass[world.base_body])

    def _follow_response(self) -> None:
        """Reads the tables of the measured response."""
        response, own = self.response, self.response.conditions[self.config.under]
        axes = [own.axes[name] for name in AXES]
        pairs = [[getattr(axis, name) for axis in axes] for name in ("gain", "lag_s", "delay_s", "offset")]
        self._means, self._sds = torch.tensor(pairs, dtype=torch.float32).unbind(-1)  # (4 quantities, 3 axes) each
        self._noise = torch.tensor([axis.noise for axis in axes])
        noise_s = torch.tensor([axis.noise_s for axis in axes])
        self._kept = torch.exp(-self.config.control_dt / noise_s.clamp(min=1e-3))
        self._wobble = torch.tensor([own.height_sd, *own.tilt_sd])
        ends = [0.0, *(high for _, high, *_ in own.falls)]
        rates = [0.0, *(falls / max(jumps, 1.0) for _, _, jumps, falls in own.falls)]
        self._jump_ends, self._fall_rates = torch.tensor(ends), torch.tensor([*rates, rates[-1]])
        self._low, self._high = torch.tensor([response.ranges[name] for name in AXES]).unbind(1)
        cycles = response.cycles
        self._commands = torch.tensor([list(cycle.command) for cycle in cycles])
        bases = [[list(cycle.height), list(cycle.roll), list(cycle.pitch)] for cycle in cycles]
        self._bases = torch.tensor(bases).transpose(1, 2).contiguous()  # (cycles, P, 3): height, roll, pitch
        self._joints = torch.tensor([[list(pose) for pose in cycle.joints] for cycle in cycles])
        self._in_cycle = torch.zeros(self.num_envs, dtype=torch.int64)  # row of cycle and phase

    def draw_by(self, random: EnvRandom) -> None:
        """Draws responses and errors from streams of these from now on."""
        self._random = random.branch("response")

    def set_obstacles(self, field: ObstacleField) -> None:
        """Takes in the obstacles, whose outlines the robots touch."""
        self._field = field

    @property
    def drawn_response(self) -> torch.Tensor:
        """(num_envs, 13) gain, lag (s), delay (s), offset (m/s, rad/s) by axis, and radius (m)."""
        return torch.cat((self._gain, self._lag, self._delay, self._offset, self._radius[:, None]), 1)

    def robot_state(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self.qpos.clone(), self.qvel.clone()

    def recorded_states(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Places and velocities after each step; height, attitude and joints are those at the end."""
        steps = self._places.shape[1]
        qpos, qvel = self.qpos[:, None].repeat(1, steps, 1), self.qvel[:, None].repeat(1, steps, 1)
        yaw = self._places[..., 2]
        qpos[..., :2] = self._places[..., :2]
        qpos[..., 3:7] = multiply(yaw_quat(yaw - yaw[:, -1:]), qpos[..., 3:7])
        qvel[..., :2] = rotate_yaw(yaw.flatten(), self._velocities[..., :2].flatten(0, 1)).unflatten(0, yaw.shape)
        qvel[..., 5] = self._velocities[..., 2]
        return qpos, qvel

    def step(
        self,
        joint_target: torch.Tensor,
        num_steps: int = 1,
        mocap_path: torch.Tensor | None = None,
        mocap_turn: torch.Tensor | None = None,
    ) -> None:
        """Follows velocities (num_envs, 3) for `num_steps` steps; see the class."""
        target = self.finite_targets(joint_target.float(), self._before).clamp(self._low, self._high)
        u = self._random.uniform(self._all_envs, (7,))
        self._error = self._kept * self._error + self._noise * (1 - self._kept.square()).sqrt() * _normal(u[:, :3])
        self._throw_over(target, u[:, 3])
        target = torch.where(self._down[:, None], 0.0, target)
        self._velocity[:, :2] = rotate_yaw(-self._place[:, 2], self.qvel[:, :2])  # pushes change it
        self._target.copy_(target)
        torch.add(self._offset, self._error, out=self._wrong)
        self._walk(num_steps, mocap_path, mocap_turn)
        self._before.copy_(target)
        self._clock += num_steps * self.config.timestep
        self._pose(self._all_envs, _normal(u[:, 4:]) * self._wobble)

    def _throw_over(self, target: torch.Tensor, u: torch.Tensor) -> None:
        """Robots that are asked for a jump fall as often as they were seen to; `u` (num_envs,) uniform in [0, 1)."""
        jump = (target - self.asked)[:, :2].norm(dim=1)
        is_new = (target - self._before)[:, :2].norm(dim=1) > NEW_TARGET
        rate = self._fall_rates[torch.bucketize(jump, self._jump_ends)]
        self._down = self._down | (is_new & (u < rate))

    def _walk(self, num_steps: int, path: torch.Tensor | None, turn: torch.Tensor | None) -> None:
        if num_steps != self._places.shape[1]:
            self._places, self._velocities = torch.zeros(2, self.num_envs, num_steps, 3).unbind(0)
        field = self._field
        path = self.mocap_pos[:, None].expand(-1, num_steps, -1, -1).contiguous() if path is None else path
        quats = self.mocap_quat[:, None] if turn is None else turn
        seen = self._nothing if field is None else _outlines(field)
        velocity, active, half_height, radius, outline = (value.contiguous() for value in seen)
        config = self.config
        most_linear, most_angular = config.acceleration
        inputs = [
            config.timestep,
            num_steps,
            float(most_linear),
            float(most_angular),
            self.response.half_length,
            self._mass,
            float(self.world.obstacles.headroom),
            view(self._target, wp.vec3),
            view(self._before, wp.vec3),
            view(self._gain, wp.vec3),
            view(self._lag, wp.vec3),
            view(self._delay, wp.vec3),
            view(self._wrong, wp.vec3),
            view(self._radius, wp.float32),
            view(path, wp.vec3),
            view(quats, wp.vec4),
            int(turn is not None),
            view(velocity, wp.vec2),
            view(active, wp.bool),
            view(half_height, wp.float32),
            view(radius, wp.float32),
            view(outline, wp.vec2),
            view(self._place, wp.vec3),
            view(self._velocity, wp.vec3),
            view(self.asked, wp.vec3),
            view(self._touched, wp.bool),
            view(self._impulse, wp.float32),
            view(self._places, wp.vec3),
            view(self._velocities, wp.vec3),
        ]
        launch_over_envs(walk, self.num_envs, inputs, self.device)

    def _pose(self, env_ids: torch.Tensor, wobble: torch.Tensor) -> None:
        """Puts base and joints of environments (n,) where place, velocity and phase say; `wobble` (n, 3) is added to
        height (m), roll and pitch (rad)."""
        phases = self._bases.shape[1]
        cycle = torch.cdist(self.asked[env_ids], self._commands).argmin(1)
        phase = torch.remainder(self._clock[env_ids] * self.response.frequency, 1.0)
        row = cycle * phases + (phase * phases).long().clamp(max=phases - 1)
        self._in_cycle[env_ids] = row
        height, roll, pitch = (self._bases.flatten(0, 1)[row] + wobble).unbind(1)
        down = self._down[env_ids]
        roll, height = torch.where(down, 0.5 * math.pi, roll), torch.where(down, 0.1, height)
        place, velocity = self._place[env_ids], self._velocity[env_ids]
        self.qpos[env_ids] = torch.cat(
            (place[:, :2], height[:, None], _attitude(place[:, 2], roll, pitch), self._joints.flatten(0, 1)[row]), 1
        )
        self.qvel[env_ids, :2] = rotate_yaw(place[:, 2], velocity[:, :2])
        self.qvel[env_ids, 5] = velocity[:, 2]

    def reset(self, env_ids: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
        """Puts robots down at the places and headings of `qpos`, with new responses; height and joints are the
        gait's."""
        self._random.start_episode(env_ids)
        u = self._random.uniform(env_ids, (17,))
        z = _normal(u[:, :12]).unflatten(1, (4, 3)) * self.config.spread
        gain, lag, delay, offset = (self._means + z * self._sds).unbind(1)
        self._gain[env_ids], self._lag[env_ids] = gain, lag.clamp(min=0.0)
        self._delay[env_ids] = delay.clamp(0.0, self.config.control_dt)
        self._offset[env_ids] = offset
        self._error[env_ids] = self._noise * _normal(u[:, 12:15])
        self._radius[env_ids] = self.response.radius * (1.0 + 0.1 * self.config.spread * (2 * u[:, 15] - 1))
        self._place[env_ids] = torch.cat((qpos[:, :2], yaw_of(qpos[:, 3:7])[:, None]), 1).float()
        self._clock[env_ids] = u[:, 16] / max(self.response.frequency, 1e-3)
        for state in (self._velocity, self.asked, self._before, self._impulse, self._down, self._touched):
            state[env_ids] = 0
        self._velocity[env_ids, :2] = rotate_yaw(-self._place[env_ids, 2], qvel[:, :2].float())
        self.qvel[env_ids] = 0.0
        self.failure[env_ids] = Failure.NONE
        self._pose(env_ids, torch.zeros(len(env_ids), 3))
        self._places[env_ids], self._velocities[env_ids] = self._place[env_ids, None], self._velocity[env_ids, None]

    def joint_torque(self) -> torch.Tensor:
        """(num_envs, num_joints) NaN: nobody knows, and what is measured with it is not a number either."""
        return torch.full((self.num_envs, self.world.robot.num_joints), torch.nan)

    def contact_sensor(self, kind: str) -> torch.Tensor:
        raise ValueError(_no_legs(f"contact sensor {kind}"))

    def geom_motion(self, geoms: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        raise ValueError(_no_legs("moving geoms"))

    def touched(self, kind: str) -> torch.Tensor:
        assert kind == OBSTACLE_CONTACT
        return self._touched.clone()

    def contact_impulse(self, kind: str) -> torch.Tensor:
        """N s: mass times the speed that obstacles take away."""
        assert kind == OBSTACLE_FORCE
        return self._impulse.clone()

    def body_poses(self, bodies: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        if bodies not in self._links:
            self._links[bodies] = _Links(self.world, bodies, self._joints.flatten(0, 1))
        return self._links[bodies].poses(self.qpos, self._in_cycle, self.mocap_pos, self.mocap_quat)

    def geom_poses(self, geoms: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        model = self.world.model
        pos, quat = self.body_poses(tuple(int(model.geom_bodyid[k]) for k in geoms))
        index = list(geoms)
        local_pos = torch.tensor(model.geom_pos[index], dtype=torch.float32)
        local_quat = torch.tensor(model.geom_quat[index], dtype=torch.float32)
        return pos + rotate(quat, local_pos.expand_as(pos)), matrix_of(multiply(quat, local_quat))

    def resize(self, geoms: tuple[int, ...], env_ids: torch.Tensor, sizes: torch.Tensor) -> None:
        """Nothing: contacts are with the outlines of the obstacles, which have their sizes."""

    def model_field(self, name: str) -> torch.Tensor:
        raise ValueError(_no_legs(f"a {name} to randomize"))

    def update_model(self, env_ids: torch.Tensor) -> None:
        raise ValueError(_no_legs("a model to randomize"))

    def anomalies(self) -> dict[str, float]:
        return {}

    def state_dict(self) -> dict:
        return {"fields": {}, **{name: getattr(self, name).clone() for name in _STATE}}

    def load_state_dict(self, state: dict) -> None:
        for name in _STATE:
            getattr(self, name).copy_(state[name])
        self.failure.zero_()


_STATE = (
    *("qpos", "qvel", "mocap_pos", "mocap_quat", "asked", "_place", "_velocity", "_before", "_error", "_gain", "_lag"),
    *("_delay", "_offset", "_radius", "_clock", "_down", "_in_cycle", "_places", "_velocities", "_touched", "_impulse"),
)


class _Links:
    """Poses of some bodies: the robot's links by base pose and cycle, obstacles by the simulator's, others in place."""

    def __init__(self, world: World, bodies: tuple[int, ...], joints: torch.Tensor) -> None:
        """Args: joints: (R, num_joints) rad, of all rows of all cycles."""
        model, data = world.model, mujoco.MjData(world.model)
        base = world.base_body
        self._own = [k for k, body in enumerate(bodies) if model.body_rootid[body] == base]
        self._mocap = [k for k, body in enumerate(bodies) if model.body_mocapid[body] >= 0]
        self._mocap_ids = torch.tensor([int(model.body_mocapid[bodies[k]]) for k in self._mocap], dtype=torch.int64)
        links = [bodies[k] for k in self._own]
        addresses = [int(model.joint(name).qposadr[0]) for name in world.robot.joints]
        poses = []
        for pose in joints.double().numpy():
            data.qpos[:] = world.rest_positions
            data.qpos[:7] = (0, 0, 0, 1, 0, 0, 0)
            data.qpos[addresses] = pose
            mujoco.mj_kinematics(model, data)
            poses.append(torch.cat((torch.tensor(data.xpos[links]), torch.tensor(data.xquat[links])), 1))
        self._table = torch.stack(poses).float()  # (R, links, 7) in the base frame
        mujoco.mj_kinematics(model, data)
        self._pos = torch.tensor(data.xpos[list(bodies)], dtype=torch.float32)
        self._quat = torch.tensor(data.xquat[list(bodies)], dtype=torch.float32)

    def poses(
        self, qpos: torch.Tensor, row: torch.Tensor, mocap_pos: torch.Tensor, mocap_quat: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        n = len(qpos)
        pos, quat = self._pos.expand(n, -1, -1).clone(), self._quat.expand(n, -1, -1).clone()
        if self._own:
            local, base = self._table[row], qpos[:, None, 3:7]
            pos[:, self._own] = qpos[:, None, :3] + rotate(base, local[..., :3])
            quat[:, self._own] = multiply(base, local[..., 3:])
        if self._mocap:
            pos[:, self._mocap], quat[:, self._mocap] = mocap_pos[:, self._mocap_ids], mocap_quat[:, self._mocap_ids]
        return pos, quat


def _outlines(field: ObstacleField) -> tuple[torch.Tensor, ...]:
    return field.velocity_w, field.active, field.half_height, field.radius, field.outline


def _normal(u: torch.Tensor) -> torch.Tensor:
    """Standard normal numbers from uniform ones in [0, 1)."""
    return math.sqrt(2.0) * torch.erfinv((2.0 * u - 1.0).clamp(-1 + 1e-6, 1 - 1e-6))


def _attitude(yaw: torch.Tensor, roll: torch.Tensor, pitch: torch.Tensor) -> torch.Tensor:
    """(n, 4) orientation of a base that is turned by `yaw`, then pitched, then rolled (n,), rad."""
    y, p, r = (0.5 * angle for angle in (yaw, pitch, roll))
    cy, sy, cp, sp, cr, sr = y.cos(), y.sin(), p.cos(), p.sin(), r.cos(), r.sin()
    return torch.stack(
        (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ),
        1,
    )


def _no_legs(what: str) -> str:
    return f"sim=planar has no {what}; use rewards=navigate observations=navigate, or sim=mujoco"
