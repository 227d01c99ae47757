"""Places the obstacles of all environments, draws their sizes and moves them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch

from omniperception.common.random import EnvRandom
from omniperception.common.rotations import yaw_quat
from omniperception.scene.articulation import Articulation, tilt_of
from omniperception.scene.obstacle_group import COMPOUND
from omniperception.scene.obstacle_motion import Approach, Wander, bounce, wrap
from omniperception.scene.obstacles import ObstaclesConfig
from omniperception.scene.part_shapes import PartShapes, SizeRanges, footprint_radius, reach
from omniperception.scene.placement import Placement, unit, within
from omniperception.scene.poses import Poses, Presence

if TYPE_CHECKING:
    from omniperception.scene.ground import Ground

PARKED_HEIGHT = -100.0
"""Height (m) at which an inactive obstacle is parked, below the ground where no ray and no contact finds it."""


class ObstacleField:
    """Places and moves the O obstacles of all environments, and their P parts.

    Where every obstacle is its own only part, what is known of obstacles is the very memory of what is known of parts.

    Attributes:
        parts: the parts, in the order of the kinematic bodies.
        pos_w: (num_envs, P, 3) m, environment frame, middles of the parts; the simulator's own kinematic positions,
            whose precision everything here has.
        quat_w: (num_envs, P, 4); the simulator's own kinematic orientations.
        velocity_w: (num_envs, P, 2) m/s, of the middles.
        active: (num_envs, P) bool: whether a part takes part in the current episode.
        size: (num_envs, P, 3) m, in MuJoCo's order, padded with 0; drawn at every reset. A mesh's is its box's.
        outline: (num_envs, P, 2) m: half x and half y of the rectangle seen from above, about `yaw`; radius and -1 of
            a circle.
        radius: (num_envs, P) m, of the circle around the outline.
        half_height: (num_envs, P) m.
        free: index of the parts that have no fixed pose.
        any_fixed: whether some are there whatever the level is.
        articulation: how parts belong to their obstacles; None where every obstacle is its own only part.
        root_pos_w: (num_envs, O, 3) m, where the obstacles are: the parts' middles without an articulation.
        root_velocity_w: (num_envs, O, 2) m/s.
        root_active: (num_envs, O) bool.
        root_radius: (num_envs, O) m, of the circle around all that an obstacle covers, however it swings.
        varying: indices of the parts whose sizes differ between environments.
        level: share of obstacles and of their speed that the curriculum lets in, 0 to 1; fixed ones are always there.
    """

    outline: torch.Tensor
    radius: torch.Tensor
    half_height: torch.Tensor
    root_radius: torch.Tensor

    def __init__(
        self,
        config: ObstaclesConfig,
        pos_w: torch.Tensor,
        quat_w: torch.Tensor,
        random: EnvRandom,
        ground: Ground | None = None,
    ) -> None:
        """`ground` is what they stand on and move over, at the height below their roots; None: a plane at 0."""
        self.config, self._ground = config, ground
        self.pos_w, self.quat_w = pos_w, quat_w
        self._random = random
        self.parts, obstacles, device = config.parts(), config.obstacles(), pos_w.device
        self._dtype, n, count = pos_w.dtype, len(pos_w), len(obstacles)

        def column(*values: float | Sequence[float]) -> torch.Tensor:
            return torch.tensor(values, dtype=self._dtype, device=device)

        def flags(values: list[bool]) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.bool, device=device)

        groups = [obstacle.group for obstacle in obstacles]
        self._ranges = SizeRanges(self.parts, self._dtype, device)
        self._shapes = PartShapes([part.kind for part in self.parts], self._dtype, device)
        self.varying = tuple(k for k, part in enumerate(self.parts) if part.varies)
        self._speed = column(*(group.speed for group in groups))
        self._bottom = column(*(group.bottom for group in groups))
        self._heading = torch.deg2rad(column(*(group.heading_deg for group in groups)))
        self._yaw = torch.deg2rad(column(*(group.yaw_deg for group in groups)))
        self._poses, self._presence = Poses(config, random, pos_w), Presence(config, random)
        self._placement = Placement(config, random, pos_w, self._poses.areas is not None)
        self.any_fixed = bool(self._poses.fixed.any())
        loose = [k for k, part in enumerate(self.parts) if groups[part.obstacle].poses is None]
        self.free = slice(None) if len(loose) == len(self.parts) else torch.tensor(loose, device=device)
        self._approach = Approach(groups, random, pos_w)
        wanders = any(group.motion is not None for group in groups)
        self._wander = Wander(groups, n, random, pos_w) if wanders else None
        self._placed = self._approach.which | self._poses.which
        self._any_moves = any(group.moves for group in groups)
        self._stands = flags([not group.moves for group in groups]) & ~self._poses.which
        self._faces = flags([group.moves and group.kind == COMPOUND for group in groups])
        self._any_faces = bool(self._faces.any())
        self._scale = column(*(group.scale for group in groups))
        compounds = (own if own.group.kind == COMPOUND else None for own in obstacles)
        self._reach = column(*(reach(own.group.parts_of(own.index)) if own else 0.0 for own in compounds))
        self.velocity_w = torch.zeros(n, len(self.parts), 2, dtype=self._dtype, device=device)
        self.active = torch.zeros(n, len(self.parts), dtype=torch.bool, device=device)
        self.articulation: Articulation | None = None
        self.root_pos_w, self.root_velocity_w, self.root_active = self.pos_w, self.velocity_w, self.active
        if any(part.form is not None for part in self.parts):
            self.articulation = Articulation(self.parts, n, self._dtype, device)
            self.root_pos_w, self.root_velocity_w = pos_w.new_zeros(n, count, 3), pos_w.new_zeros(n, count, 2)
            self.root_active = self.active.new_zeros(n, count)
        self._root_yaw, self._pace = pos_w.new_zeros(2, n, count).unbind(0)
        self.level = 1.0 if config.curriculum is None else 0.0
        self._above_ground = pos_w.new_zeros(n if ground is not None else 0, count)
        self._allocate_path(0)
        first = {part.obstacle: k for k, part in reversed(list(enumerate(self.parts)))}
        self._first_part = torch.tensor([first[k] for k in range(count)], device=device)
        self.size = self._ranges.draw(pos_w.new_zeros(n, 3, len(self.parts)), pos_w.new_zeros(n, count))
        self._follow_sizes()

    @property
    def world(self) -> torch.Tensor:
        """(num_envs, L) int64, which world of each of the L layouts an environment has."""
        return self._poses.world

    def routes(self, env_ids: torch.Tensor) -> torch.Tensor:
        """(n, R, 2) m, paths through the worlds that environments (n,) have."""
        assert self._poses.routes is not None
        return self._poses.routes[self.world[env_ids, 0]]

    @property
    def yaw(self) -> torch.Tensor:
        """(num_envs, P) orientation (rad) about the vertical; what a swinging part does besides is its tilt."""
        return 2 * torch.atan2(self.quat_w[..., 3], self.quat_w[..., 0])

    def bottom_above_ground(self) -> torch.Tensor:
        """(num_envs, P) height (m) of the lowest points above the ground below the middles."""
        bottom = self.pos_w[..., 2] - self.half_height
        return bottom if self._ground is None else bottom - self._ground.height(self.pos_w[..., :2])

    def in_the_way(self) -> torch.Tensor:
        """(num_envs, P) bool: which take part and do not hang as high as `ObstaclesConfig.headroom`."""
        return self.active & (self.bottom_above_ground() < self.config.headroom)

    def reset(
        self,
        env_ids: torch.Tensor,
        robot_xy_w: torch.Tensor,
        goal_w: torch.Tensor | None = None,
        command: Callable[[], torch.Tensor] | None = None,
    ) -> None:
        """Places the obstacles of some environments again, in newly drawn sizes.

        Args:
            env_ids: (n,) which environments.
            robot_xy_w: (n, 2) where the robot stands, m.
            goal_w: (n, 2) where it is to go, m; only a free path needs it.
            command: gives the velocity (n, 2) in m/s, environment frame, past which obstacles approach. It is called
                once their world is drawn, since a command may follow a route through it. None: the robot stands.
        """
        robot = robot_xy_w.to(self._dtype)
        u = self._random.uniform(env_ids, (9, self.root_pos_w.shape[1])).to(self._dtype)
        bottom, yaw, heading = (
            within(bounds, u[:, row]) for row, bounds in ((6, self._bottom), (2, self._yaw), (4, self._heading))
        )
        pose, posed = self._resize(env_ids, u[:, 7], u[:, 8])
        self._follow_world(env_ids)
        active = (u[:, 5] < self.level) | self._poses.fixed
        present = self._presence.draw(env_ids)
        if present is not None:
            active = active & present
        in_the_way = active & self._stands & (bottom < self.config.headroom)
        radius, placed = self.root_radius[env_ids], self._placed
        xy, found = self._placement.choose(env_ids, u[:, :2], robot, goal_w, radius, in_the_way, placed)
        active = active & found
        if self._poses.any:
            active = active & (posed | ~self._poses.which)
            xy = torch.where(self._poses.which[:, None], pose[..., :2], xy)
            yaw = torch.where(self._poses.which, pose[..., 2], yaw)
        self._pace[env_ids] = within(self._speed, u[:, 3]) * self.level * active
        self.root_active[env_ids], self._root_yaw[env_ids] = active, yaw
        self.root_velocity_w[env_ids] = unit(heading) * self._pace[env_ids][..., None]
        above_ground = bottom if self.articulation is not None else bottom + self.half_height[env_ids]
        z = torch.where(active, above_ground, PARKED_HEIGHT)
        self.root_pos_w[env_ids] = torch.cat((xy, z[..., None]), -1)
        if self._wander is not None:
            self._wander.reset(env_ids, heading)
        if self._ground is not None:
            self._above_ground[env_ids] = above_ground
        velocity = torch.zeros_like(robot) if command is None else command().to(self._dtype)
        if self._approach.any:
            self._start_approach(env_ids, self._approach.which & active, robot, velocity)
        if self._ground is not None:
            self.root_pos_w[env_ids, :, 2] = self._over_ground(env_ids)
        self._face(env_ids)
        self._place_parts(env_ids)

    def advance(self, dt: float, robot_xy_w: torch.Tensor) -> None:
        """Moves every obstacle level by `dt` (s); `robot_xy_w` (num_envs, 2) is the centre of a wrapping area.

        Parts of compounds follow in `travel`.
        """
        xy = self.root_pos_w[..., :2]
        if self._any_moves:
            xy += self.root_velocity_w * dt
        if self._placement.follows:
            wrap(xy, robot_xy_w.to(self._dtype), self._placement.bounds, ~self._placed)
        elif self._any_moves:
            bounce(xy, self.root_velocity_w, self._placement.bounds, ~self._placed)

    def travel(
        self,
        dt: float,
        num_steps: int,
        robot_xy_w: torch.Tensor,
        command: Callable[[], torch.Tensor] | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Moves every obstacle by `num_steps` steps of `dt` (s); see `advance`.

        With `command`, which gives (num_envs, 2) in m/s as in `reset`, those that have passed their robot start again.

        Returns:
            (num_envs, num_steps, P, 3) m, where the parts are after each step, on the ground, and
            (num_envs, num_steps, P, 4) their orientations, None where they keep them; the same memory in every call.
        """
        if command is not None and self._approach.any:
            self.restart_approaching(robot_xy_w, command())
        if self._path.shape[1] != num_steps:
            self._allocate_path(num_steps)
        if self._wander is not None:
            robot = robot_xy_w.to(self._dtype)
            self._wander.choose(dt * num_steps, self.root_pos_w[..., :2], self.root_velocity_w, self._pace, robot)
        for step in range(num_steps):
            self.advance(dt, robot_xy_w)
            self._path[:, step] = self.root_pos_w
            if self.articulation is not None:
                self._face()
                self._yaw_path[:, step] = self._root_yaw
        if self._ground is not None and self._path.numel():
            self._ground.lift(self._path, self._above_ground, self.root_active, PARKED_HEIGHT)
            self.root_pos_w.copy_(self._path[:, -1])
        return (self._path, None) if self.articulation is None else self._articulate(dt)

    def _articulate(self, dt: float) -> tuple[torch.Tensor, torch.Tensor | None]:
        """The path of the parts along that of their obstacles, and the parts at its end."""
        parts, speed = self.articulation, self.root_velocity_w.norm(dim=-1)
        assert parts is not None
        for step in range(self._path.shape[1]):
            parts.advance(dt, speed)
            pos, quat = parts.pose(self._path[:, step], self._yaw_path[:, step])
            self._part_path[:, step], self._quat_path[:, step] = pos, quat
        self.pos_w.copy_(pos)
        self.quat_w.copy_(quat)
        self.velocity_w.copy_(parts.velocity(self.root_velocity_w, self._root_yaw))
        if parts.swings:
            self._follow_sizes()
        return self._part_path, self._quat_path if parts.turns else None

    def restart_approaching(self, robot_xy_w: torch.Tensor, command_w: torch.Tensor) -> None:
        """Restarts approaching obstacles that have passed the robots at (num_envs, 2) m, commanded to go `command_w`
        (num_envs, 2) in m/s."""
        robot_xy = robot_xy_w.to(self._dtype)
        gone = self._approach.have_passed(self.root_pos_w[..., :2], robot_xy) & self.root_active
        env_ids = gone.any(1).nonzero().flatten()
        if len(env_ids):
            self._start_approach(env_ids, gone[env_ids], robot_xy[env_ids], command_w[env_ids].to(self._dtype))

    @property
    def rises(self) -> bool:
        """Whether there is a curriculum."""
        return self.config.curriculum is not None

    def follow(self, velocity_error: float, seconds: float) -> None:
        """Raises the curriculum's level while the robot walks well (`velocity_error` in m/s)."""
        curriculum = self.config.curriculum
        if curriculum is None:
            return
        bound = curriculum.max_velocity_error if self.level > 0 else curriculum.start_velocity_error
        if velocity_error < bound:
            self.level = min(1.0, self.level + curriculum.rise * seconds)

    def state_dict(self) -> dict:
        """State that `load_state_dict` needs to go on; poses of the parts belong to the simulator's state."""
        state = {name: value.clone() for name, value in self._kept().items()}
        return {"level": self.level, **state, **{name: part.state_dict() for name, part in self._with_state().items()}}

    def load_state_dict(self, state: dict) -> None:
        self.level = state["level"]
        for name, value in self._kept().items():
            value.copy_(state[name])
        for name, part in self._with_state().items():
            part.load_state_dict(state[name])
        self._follow_sizes()
        self._follow_world(torch.arange(len(self.world), device=self.world.device))

    def _follow_world(self, env_ids: torch.Tensor) -> None:
        """Keeps the obstacles of environments (n,) within the areas of their worlds, where those have some."""
        areas = self._poses.areas_of(env_ids)
        if areas is not None:
            self._placement.stay_within(env_ids, areas)

    def _kept(self) -> dict[str, torch.Tensor]:
        """Tensors of the state, by name."""
        kept = {"size": self.size, "velocity_w": self.velocity_w, "active": self.active, "pace": self._pace}
        kept |= {"above_ground": self._above_ground, "yaw": self._root_yaw, "world": self._poses.world}
        if self.articulation is not None:
            kept |= {"root_pos_w": self.root_pos_w, "root_velocity_w": self.root_velocity_w}
            kept["root_active"] = self.root_active
        return kept

    def _with_state(self) -> dict[str, Articulation | Wander]:
        parts = {"articulation": self.articulation, "wander": self._wander}
        return {name: part for name, part in parts.items() if part is not None}

    # ---- sizes and parts ---------------------------------------------------------------------------------------------

    def _resize(
        self, env_ids: torch.Tensor, share: torch.Tensor, cycle: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Draws sizes; compounds are as large as `share` (n, O) of their ranges, and their swings begin at `cycle`.

        Returns:
            What `Poses.draw` does, which decides sizes of layouts.
        """
        u = self._random.uniform(env_ids, (3, len(self.parts))).to(self._dtype)
        size = self._ranges.draw(u, share)
        poses = self._poses.draw(env_ids, size)
        self.size[env_ids] = size
        if self.articulation is not None:
            half_height = self._shapes.half_extents(size)[..., 2]
            self.articulation.reset(env_ids, within(self._scale, share), half_height, cycle)
        self._follow_sizes(env_ids)
        return poses

    def _follow_sizes(self, env_ids: torch.Tensor | None = None) -> None:
        """Brings what depends on sizes and tilts up to date, in all environments or in some (n,)."""
        rows = slice(None) if env_ids is None else env_ids
        parts, size = self.articulation, self.size[rows]
        tilt = None if parts is None else tilt_of(parts.orientation(rows))
        half = self._shapes.half_extents(size, tilt)
        outline = self._shapes.outline(half, tilt)
        radius = root_radius = footprint_radius(outline)
        if parts is not None:
            root_radius = torch.where(self._reach > 0, self._reach * parts.scale[rows], radius[:, self._first_part])
        derived = {"outline": outline, "radius": radius, "half_height": half[..., 2], "root_radius": root_radius}
        for name, value in derived.items():
            setattr(self, name, value if env_ids is None else getattr(self, name).index_copy(0, env_ids, value))

    def _face(self, rows: torch.Tensor | slice = slice(None)) -> None:
        """Turns compounds that move into the way they move."""
        if self._any_faces:
            velocity, yaw = self.root_velocity_w[rows], self._root_yaw[rows]
            moving = self._faces & (velocity.square().sum(-1) > 0)
            self._root_yaw[rows] = torch.where(moving, torch.atan2(velocity[..., 1], velocity[..., 0]), yaw)

    def _place_parts(self, env_ids: torch.Tensor) -> None:
        """Puts the parts where their obstacles are, in some environments (n,)."""
        parts, yaw = self.articulation, self._root_yaw[env_ids]
        if parts is None:
            self.quat_w[env_ids] = yaw_quat(yaw)
            return
        self.pos_w[env_ids], self.quat_w[env_ids] = parts.pose(self.root_pos_w[env_ids], yaw, env_ids)
        self.velocity_w[env_ids] = parts.velocity(self.root_velocity_w[env_ids], yaw, env_ids)
        self.active[env_ids] = self.root_active[env_ids][:, parts.obstacle]

    @torch.inference_mode(False)  # it is written in and out of rollouts
    def _allocate_path(self, num_steps: int) -> None:
        n, count = self.root_pos_w.shape[:2]
        self._path = self.root_pos_w.new_zeros(n, num_steps, count, 3)
        if self.articulation is not None:
            self._yaw_path = self._path.new_zeros(n, num_steps, count)
            self._part_path = self._path.new_zeros(n, num_steps, len(self.parts), 3)
            self._quat_path = self._path.new_zeros(n, num_steps, len(self.parts), 4)

    def _start_approach(
        self, env_ids: torch.Tensor, which: torch.Tensor, robot: torch.Tensor, command: torch.Tensor
    ) -> None:
        """Puts obstacles `which` (n, O) around the robots (n, 2) on courses that lead past them."""
        xy, velocity = self._approach.start(env_ids, robot, command, self._pace[env_ids])
        self.root_pos_w[env_ids, :, :2] = torch.where(which[..., None], xy, self.root_pos_w[env_ids, :, :2])
        self.root_velocity_w[env_ids] = torch.where(which[..., None], velocity, self.root_velocity_w[env_ids])

    def _over_ground(self, env_ids: torch.Tensor) -> torch.Tensor:
        """Heights (n, O) of the obstacles where they are."""
        assert self._ground is not None
        above = self._above_ground[env_ids] + self._ground.height(self.root_pos_w[env_ids, :, :2], env_ids)
        return torch.where(self.root_active[env_ids], above, PARKED_HEIGHT)
