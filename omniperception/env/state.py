"""State that terms read, of the robot and its surroundings at the end of a control step, computed at the first read."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
import torch

from omniperception.common.lazy import lazy
from omniperception.common.rotations import rotate, rotate_yaw
from omniperception.common.stateful import Stateful
from omniperception.common.vectors import moved_towards
from omniperception.env.heights import flat_heights
from omniperception.env.kinematics import Kinematics
from omniperception.env.mdp.curriculum import Curriculum
from omniperception.scene.build import FOOT_FORCE, LINK_FORCE, OBSTACLE_CONTACT, OBSTACLE_FORCE
from omniperception.scene.stepping import stepping_offsets

if TYPE_CHECKING:  # parts that not every task has
    from omnilidar import LidarFrame
    from omniperception.avoidance.avoidance import Avoidance
    from omniperception.avoidance.true_sectors import TrueSectors
    from omniperception.env.config import EnvConfig
    from omniperception.env.consumers import FrameConsumer
    from omniperception.env.height_lookup import HeightLookup
    from omniperception.env.mdp.commands import Command
    from omniperception.env.mdp.randomization import Randomizer
    from omniperception.env.measurement import MeasurementErrors
    from omniperception.env.sensing import LidarSensing
    from omniperception.scene import ObstacleField, RobotConfig, SteppingConfig
    from omniperception.sim import Simulator

AVOIDANCE, DISTAL_RANGE, CLOUD, MEASURED_CLOUD = "avoidance", "distal_range", "cloud", "measured_cloud"
"""Outputs of the LiDAR that can be required: V_avoid and sector distances, mean distal ranges, clouds without noise and
with it."""
LEGS = "legs"
"""Required by what reads joints, feet or torques, which not every simulator has."""
CONTACT_SENSORS = frozenset({FOOT_FORCE, LINK_FORCE, OBSTACLE_CONTACT, OBSTACLE_FORCE})
REQUIREMENTS = (*sorted(CONTACT_SENSORS), AVOIDANCE, DISTAL_RANGE, CLOUD, MEASURED_CLOUD, LEGS)
"""What must exist before the world is compiled: sensors, and legs."""

CONTACT_FORCE = 1.0
"""Vertical force (N) from which on a foot is in contact."""

_WITHOUT_LEGS = "of robots without legs; use sim=planar, or other observations"

Marked = TypeVar("Marked", bound=Callable)
Part = TypeVar("Part")


def requires(*names: str) -> Callable[[Marked], Marked]:
    """Declares which of REQUIREMENTS a term (a function or a class) reads; everything else is computed when read."""
    unknown = set(names) - set(REQUIREMENTS)
    if unknown:
        raise ValueError(f"@requires({', '.join(sorted(unknown))}) is unknown; known: {', '.join(REQUIREMENTS)}")

    def mark(term: Marked) -> Marked:
        term.requires = frozenset(names)  # type: ignore[attr-defined]  # functions and classes take attributes
        return term

    return mark


def requirements(term: Callable) -> frozenset[str]:
    """Requirements that a term (or a partial of one) declared with `requires`."""
    while isinstance(term, partial):
        term = term.func
    return getattr(term, "requires", frozenset())


class Obstacles(NamedTuple):
    """The parts of obstacles whose poses are not fixed; without any, O = 0.

    Attributes:
        pos_yaw: (n, O, 2) m, from the base's origin, in the yaw-aligned frame.
        vel_yaw: (n, O, 2) m/s, in the yaw-aligned frame.
        radius: (n, O) m, of the circles around the footprints.
        active: (n, O) bool: which take part in the episode and do not hang high enough to pass under.
        axis_yaw: (n, O, 2) unit vectors along the first sides of the footprints, in the yaw-aligned frame.
        half_sides: (n, O, 2) m, of the footprints that are rectangles; the second is negative for a circle.
    """

    pos_yaw: torch.Tensor
    vel_yaw: torch.Tensor
    radius: torch.Tensor
    active: torch.Tensor
    axis_yaw: torch.Tensor
    half_sides: torch.Tensor


class EnvState(Stateful):
    """State of all environments, (num_envs, ...): a quantity is computed when it is first read, and never otherwise.

    Quantities are computed at first use and hold until the environment calls `invalidate`, after the physics steps of a
    control step and again after resets. They describe the newest moment but for these: contact forces and torques are
    those of the last physics step, which describes the state before it (one physics step old); `measured` is as old
    as the randomized latency, with the randomized errors; `before` is the start of the control step; sector distances
    and clouds are those of the newest LiDAR frame, and V_avoid follows from it, with a velocity risk for the command at
    the control step's end.

    What a term keeps of earlier steps belongs to the term, but for the times of the feet's contacts: they are followed
    from the first read on, at every control step.

    Attributes:
        actions: (num_envs, num_actions) each, of joints or, without legs, v_x, v_y (m/s) and yaw rate (rad/s) that are
            asked for: those applied, the newest first, and the two before; 0 after a reset.
        pose: (num_envs, num_joints) rad: to which the actions of the control step are added; the default pose after a
            reset.
        targets: (num_envs, num_joints) rad each: of the control step, and of the one before; the default pose after a
            reset.
        before: kinematics at the start of the control step; the present ones after a reset.
        default_joint_pos, joint_lower, joint_upper: (num_joints,) rad; joints without limits have infinite ones.
        action_scale: (num_joints,) rad.
        joint_torque_limit: (num_joints,) N m.
        default_base_height: m, of the default pose.
        drawn_physics: (num_envs, W) what randomization drew; see `Randomizer.drawn`.
        stand_s: (num_envs,) s for which the command has been to stand.
        last_asked: (num_envs, 2) m/s, or (num_envs, 3) with the yaw rate (rad/s): what the policy asked its gait for in
            the step that ended; 0 after a reset, and where no policy says so.
    """

    saved = ("actions", "targets", "stand_s", "last_asked", "_reference", "_history", "_errors", "_foot_times")

    def __init__(
        self,
        config: EnvConfig,
        sim: Simulator,
        *,
        episode_steps: torch.Tensor,
        command: Command,
        randomizer: Randomizer,
        difficulty: Curriculum,
        errors: MeasurementErrors | None,
        height_lookup: HeightLookup | None,
        obstacles: ObstacleField | None,
        sensing: LidarSensing | None,
        avoidance: Avoidance | None,
    ) -> None:
        """
        Args:
            config: of the task.
            sim: the physics.
            episode_steps: (num_envs,) int64 control steps since the episodes began, the environment's own.
            command: source of the commands.
            randomizer: of the physics; tells how late `measured` is.
            difficulty: share of the randomization; the less of it, the faster `reference` follows.
            errors: of what is measured.
            height_lookup: heights above ground that is not flat; None on a plane at 0.
            obstacles: None without any.
            sensing: the LiDAR.
            avoidance: source of V_avoid.
        """
        self._declared = config.requirements()
        self._errors, self._episode_steps = errors, episode_steps
        self._velocity_source: Callable[[], torch.Tensor | None] | None = None
        self._asked_source: Callable[[], torch.Tensor | None] | None = None
        self._sim, self._command, self._obstacles, self._height_lookup = sim, command, obstacles, height_lookup
        self.num_envs, self.device, self.control_dt = sim.num_envs, sim.device, config.sim.control_dt
        self._avoidance, self._sensing = avoidance, sensing
        robot, model = sim.world.robot, sim.world.model
        ids = [model.joint(name).id for name in robot.joints]
        limits = np.where(model.jnt_limited[ids, None], model.jnt_range[ids], (-math.inf, math.inf))
        self.joint_lower, self.joint_upper = torch.tensor(limits, dtype=torch.float32, device=self.device).unbind(1)
        self.default_joint_pos, self.joint_torque_limit, self.action_scale = (
            torch.tensor(robot.by_joint(name), dtype=torch.float32, device=self.device)
            for name in ("default_joint_pos", "torque_limits", "action_scale")
        )
        self.default_base_height = robot.base_height
        self._foot_geoms = tuple(model.geom(name).id for foot in robot.feet for name in foot)
        self._foot_of = _membership([len(foot) for foot in robot.feet], self.device)
        self._has_legs = config.sim.has_legs
        self.actions: tuple[torch.Tensor, ...]
        self.actions = (torch.zeros(self.num_envs, config.num_actions, device=self.device),) * 3
        self.drawn_physics = randomizer.drawn
        self._history = None if randomizer.delay is None else StateHistory(sim, randomizer)
        self._foot_times: AirTimes | None = None
        self._true_sectors: TrueSectors | None = None
        self.before = self.kinematics
        self.stand_s = torch.zeros(self.num_envs, device=self.device)
        self.last_asked = torch.zeros(self.num_envs, config.num_asked, device=self.device)
        self._command_acceleration, self._difficulty = config.observations.command_acceleration, difficulty
        self._reference = torch.zeros(self.num_envs, 3, device=self.device)
        self._rest = self.default_joint_pos if self._has_legs else torch.zeros(3, device=self.device)
        self.pose = self._rest.expand(self.num_envs, -1)
        self.targets = (self.pose, self.pose)
        self._stepping = None if config.stepping is None else Stepping(config.stepping, robot, self.device)

    # ---- followed by the environment ---------------------------------------------------------------------------------

    def begin_step(self, actions: torch.Tensor) -> None:
        """Takes in the actions (num_envs, num_actions) of the control step that begins."""
        self.before, self.actions = self.kinematics, (actions, *self.actions[:-1])
        if self._stepping is not None:
            self.pose = self.default_joint_pos + self._stepping(self)
        scale = self.action_scale if self._has_legs else 1.0
        self.targets = (self.pose + scale * actions, self.targets[0])
        asked = self._asked_source() if self._asked_source is not None else None
        self.last_asked = self.last_asked if asked is None else asked

    def end_step(self) -> None:
        """Takes in the physics steps of the control step."""
        self.invalidate()
        command = self.allowed_command
        self.stand_s = torch.where((command == 0).all(1), self.stand_s + self.control_dt, 0.0)
        if self._command_acceleration is not None:
            most = [rate * self.control_dt / max(self._difficulty.level, 1e-3) for rate in self._command_acceleration]
            self._reference = _ramped(self.reference, command, *most)
        if self._history is not None:
            self._history.record()
        if self._errors is not None:
            self._errors.advance()
        if self._foot_times is not None:
            self._foot_times.advance(self.foot_contact, self.control_dt)

    def reset(self, env_ids: torch.Tensor) -> None:
        """Clears the history of environments (n,) whose physics has been reset."""
        self.invalidate()
        self.actions = tuple(action.index_fill(0, env_ids, 0.0) for action in self.actions)
        fresh = torch.zeros(self.num_envs, 1, dtype=torch.bool, device=self.device).index_fill(0, env_ids, True)
        last, before = (torch.where(fresh, self._rest, targets) for targets in self.targets)
        self.targets, self.pose = (last, before), torch.where(fresh, self._rest, self.pose)
        self.before = self.before.replaced(fresh, self.kinematics)
        self.stand_s = self.stand_s.index_fill(0, env_ids, 0.0)
        self.last_asked = self.last_asked.index_fill(0, env_ids, 0.0)
        self._reference = self._reference.index_fill(0, env_ids, 0.0)
        if self._history is not None:
            self._history.reset(env_ids)
        if self._errors is not None:
            self._errors.reset(env_ids)
        if self._foot_times is not None:
            self._foot_times.reset(env_ids)

    def invalidate(self) -> None:
        """Drops the cached quantities, because the simulation has changed."""
        for name in _CACHED & self.__dict__.keys():
            del self.__dict__[name]

    def measure_velocity_by(self, source: Callable[[], torch.Tensor | None]) -> None:
        """Takes the base's measured linear velocity (num_envs, 3) in m/s, base frame, from somewhere else from now on;
        None until there is one."""
        self._velocity_source = source

    def ask_by(self, source: Callable[[], torch.Tensor | None]) -> None:
        """Takes `last_asked` from a policy from now on; None until it has acted."""
        self._asked_source = source

    def has_computed(self, name: str) -> bool:
        """Tell whether a quantity has been read since the last `invalidate`."""
        return name in self.__dict__

    def load_state_dict(self, state: dict) -> None:
        self.invalidate()
        super().load_state_dict(state)

    # ---- the robot ---------------------------------------------------------------------------------------------------

    @lazy
    def kinematics(self) -> Kinematics:
        """Base and joints."""
        return Kinematics(*self._sim.robot_state())

    @lazy
    def measured(self) -> Kinematics:
        """Base and joints as the robot's sensors give them, with latency and errors where they are randomized."""
        measured = self.kinematics if self._history is None else self._history.delayed()
        if self._errors is not None:
            measured = self._errors.added_to(measured)
        estimate = self._velocity_source() if self._velocity_source is not None else None
        return measured if estimate is None else with_velocity(measured, estimate)

    @property
    def time_s(self) -> torch.Tensor:
        """(num_envs,) s since the episode began."""
        return self._episode_steps * self.control_dt

    @property
    def command(self) -> torch.Tensor:
        """(num_envs, 3) v_x, v_y (m/s) and yaw rate (rad/s) in the base frame."""
        return self._command.value

    @property
    def allowed_command(self) -> torch.Tensor:
        """(num_envs, 3) likewise, slowed down where it leads into directions that LiDAR frames lack."""
        return self._known_to_be_free(self.command)

    def _known_to_be_free(self, command: torch.Tensor) -> torch.Tensor:
        return command if self._sensing is None else self._sensing.known_to_be_free(command)

    @property
    def reference(self) -> torch.Tensor:
        """(num_envs, 3) v_x, v_y (m/s) and yaw rate (rad/s) in the base frame: the command as policies observe it and
        tracking terms ask for it, 0 when an episode begins and then towards the allowed command at no more than
        `ObservationsConfig.command_acceleration` over the difficulty; without one that command itself. Where it leads
        into directions that LiDAR frames lack it falls at once."""
        return self._known_to_be_free(self.command if self._command_acceleration is None else self._reference)

    @lazy
    def joint_acc(self) -> torch.Tensor:
        """(num_envs, num_joints) rad/s^2: change of the joint velocity over the control step."""
        return (self.kinematics.joint_vel - self.before.joint_vel) / self.control_dt

    @lazy
    def joint_torque(self) -> torch.Tensor:
        """(num_envs, num_joints) N m."""
        return self._sim.joint_torque()

    @lazy
    def base_height(self) -> torch.Tensor:
        """(num_envs,) m: the base's origin above the ground, the mean of what lies below it and below the hips."""
        if self._height_lookup is None:
            return self.kinematics.base_pos_w[:, 2]
        return self._height_lookup.base_height(self.kinematics)

    @lazy
    def heights(self) -> torch.Tensor:
        """(num_envs, 187) m: the base's origin above the ground at `height_grid`, clipped to +-1 m."""
        if self._height_lookup is None:
            return flat_heights(self.base_height)
        return self._height_lookup.around(self.kinematics)

    @lazy
    def foot_height(self) -> torch.Tensor:
        """(num_envs, F) m: of `foot_pos_w` above the ground below each."""
        height = self.foot_pos_w[..., 2]
        return height if self._height_lookup is None else height - self._height_lookup.ground(self.foot_pos_w)

    # ---- contacts ----------------------------------------------------------------------------------------------------

    @lazy
    def foot_force(self) -> torch.Tensor:
        """(num_envs, F, 3) N, environment frame: of each foot on what it touches, so that a foot that stands pushes
        down. Requires "foot_force"."""
        force = self._contact_force(FOOT_FORCE)
        return force if self._foot_of is None else self._foot_of @ force

    @lazy
    def link_force(self) -> torch.Tensor:
        """(num_envs, L, 3) N, environment frame: likewise of the robot's penalised links. Requires "link_force"."""
        return self._contact_force(LINK_FORCE)

    @lazy
    def obstacle_contact(self) -> torch.Tensor:
        """(num_envs,) bool: whether a link touched an obstacle in any physics step of the control step. Requires
        "obstacle_contact"; False for all without obstacles."""
        if OBSTACLE_CONTACT not in self._sim.world.sensors:
            return torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        return self._sim.touched(OBSTACLE_CONTACT)

    @lazy
    def obstacle_impulse(self) -> torch.Tensor:
        """(num_envs,) N s: sum over the physics steps of the control step and over obstacles of |force on it| * step.
        Requires "obstacle_force"; 0 for all without obstacles."""
        if OBSTACLE_FORCE not in self._sim.world.sensors:
            return torch.zeros(self.num_envs, device=self.device)
        return self._sim.contact_impulse(OBSTACLE_FORCE)

    def _contact_force(self, kind: str) -> torch.Tensor:
        if kind not in self._sim.world.sensors:
            raise UndeclaredQuantity(kind)
        return self._sim.contact_sensor(kind).unflatten(1, (-1, 3))

    # ---- feet, in the order of robot.foot_geoms ----------------------------------------------------------------------

    @property
    def foot_pos_w(self) -> torch.Tensor:
        """(num_envs, F, 3) m, environment frame: centres of the foot geoms, and the mean of a foot of several."""
        return self.foot_motion[0]

    @property
    def foot_vel_w(self) -> torch.Tensor:
        """(num_envs, F, 3) m/s, environment frame: of the same points."""
        return self.foot_motion[1]

    @lazy
    def foot_motion(self) -> tuple[torch.Tensor, torch.Tensor]:
        """`foot_pos_w` and `foot_vel_w`, which the simulator has at once."""
        motion = self._sim.geom_motion(self._foot_geoms)
        if self._foot_of is None:
            return motion
        mean = self._foot_of / self._foot_of.sum(1, keepdim=True)
        return mean @ motion[0], mean @ motion[1]

    @lazy
    def foot_contact(self) -> torch.Tensor:
        """(num_envs, F) bool: which feet push down with more than CONTACT_FORCE. Requires "foot_force"."""
        return self.foot_force[..., 2].abs() > CONTACT_FORCE

    @property
    def foot_times(self) -> AirTimes:
        """Time of the feet in the air. Requires "foot_force"."""
        if self._foot_times is None:
            self._foot_times = AirTimes(self.foot_contact)
        return self._foot_times

    # ---- around the robot --------------------------------------------------------------------------------------------

    @lazy
    def obstacles(self) -> Obstacles:
        """Positions, velocities and footprints of the obstacles that have no fixed pose."""
        n, field, yaw = self.num_envs, self._obstacles, self.kinematics.yaw
        if field is None:
            nothing = torch.zeros(n, 0, 2, device=self.device)
            return Obstacles(nothing, nothing, nothing[..., 0], nothing[..., 0].bool(), nothing, nothing)
        free = field.free
        offset = field.pos_w[:, free, :2].float() - self.kinematics.base_pos_w[:, None, :2]
        velocity = rotate_yaw(-yaw, field.velocity_w[:, free].float())
        heading = field.yaw[:, free].float() - yaw[:, None]
        axis = torch.stack((heading.cos(), heading.sin()), -1)
        radius, outline = field.radius[:, free].float(), field.outline[:, free].float()
        return Obstacles(rotate_yaw(-yaw, offset), velocity, radius, field.in_the_way()[:, free], axis, outline)

    @lazy
    def sectors(self) -> torch.Tensor:
        """(num_envs, 36, 3) distance (m, infinite without an obstacle) and velocity (m/s, yaw-aligned frame) of the
        nearest true obstacle by azimuth sector; see `TrueSectors`."""
        return self.true_sectors.measure(self.kinematics.base_pos_w, self.kinematics.yaw)

    @property
    def true_sectors(self) -> TrueSectors:
        """What measures `sectors`."""
        if self._true_sectors is None:
            from omniperception.avoidance.navigation import NUM_SECTORS
            from omniperception.avoidance.true_sectors import TrueSectors

            world = self._sim.world.obstacles
            self._true_sectors = TrueSectors(NUM_SECTORS, world, self._obstacles, self.num_envs, self.device)
        return self._true_sectors

    @property
    def asked(self) -> torch.Tensor:
        """(num_envs, 3) m/s and rad/s, yaw-aligned frame: what the gait is asked for now, where a simulator without
        legs follows that."""
        asked = getattr(self._sim, "asked", None)
        if asked is None:
            raise UndeclaredQuantity("asked", _WITHOUT_LEGS)
        return asked

    @property
    def drawn_response(self) -> torch.Tensor:
        """(num_envs, 13) of robots without legs: gain, lag (s), delay (s), offset (m/s, rad/s) by axis, radius (m)."""
        drawn = getattr(self._sim, "drawn_response", None)
        if drawn is None:
            raise UndeclaredQuantity("drawn_response", _WITHOUT_LEGS)
        return drawn

    @property
    def goal_w(self) -> torch.Tensor | None:
        """(num_envs, 2) m, environment frame: where the commands lead; None where they lead nowhere."""
        return self._command.goal_w

    @property
    def avoidance_velocity(self) -> torch.Tensor:
        """(num_envs, 2) m/s, yaw-aligned frame: V_avoid of the newest frame; with a velocity risk it is chosen again
        for the command at every control step's end. Requires "avoidance"."""
        return self._part(self._avoidance, AVOIDANCE).velocity

    @property
    def cloud(self) -> LidarFrame | None:
        """The newest frame of the LiDAR, with noise-free ranges; None before the first. Requires "cloud"."""
        return self._part(self._sensing, CLOUD).frame

    def mean_distal_range(self, max_distance: float) -> torch.Tensor:
        """(num_envs,) m: mean of the noise-free distal ranges of the newest frame, each capped at `max_distance` (m);
        the cap before the first frame. Requires "distal_range"."""
        return self._part(self._sensing, DISTAL_RANGE).mean_distal_range(max_distance)

    def consumer(self, name: str) -> FrameConsumer:
        """What `lidar.consumers` has by this name."""
        if self._sensing is None or name not in self._sensing.consumers:
            raise UndeclaredQuantity(name, f"of LiDAR frames; give lidar.consumers.{name}")
        return self._sensing.consumers[name]

    def _part(self, part: Part | None, name: str) -> Part:
        """The part that has a quantity, if it was declared: otherwise it is not computed."""
        if part is None or name not in self._declared:
            raise UndeclaredQuantity(name)
        return part


def rests(state: EnvState, after_s: float) -> torch.Tensor:
    """(num_envs,) bool: whose command is to stand, and has been for `after_s` (s)."""
    return (state.command == 0).all(1) & (state.stand_s > after_s - 1e-3)  # sums of time steps are not exact


class Stepping:
    """Joint angles that lift the feet in turn, as `scene.stepping.stepping_offsets` over the clock's period."""

    def __init__(self, config: SteppingConfig, robot: RobotConfig, device: torch.device) -> None:
        assert robot.gait is not None  # or there are no offsets
        rows = torch.tensor(stepping_offsets(robot, config.lift), dtype=torch.float32, device=device)
        self._rows, self._frequency, self._rest_s = torch.cat((rows, rows[:1])), robot.gait.frequency, config.rest_s

    def __call__(self, state: EnvState) -> torch.Tensor:
        """(num_envs, num_joints) rad, at the episodes' present time; 0 once the robot should rest."""
        place = torch.remainder(self._frequency * state.time_s, 1.0) * (len(self._rows) - 1)
        row = place.long().clamp(max=len(self._rows) - 2)
        offsets = torch.lerp(self._rows[row], self._rows[row + 1], (place - row)[:, None])
        return offsets * ~rests(state, self._rest_s)[:, None]


def _ramped(now: torch.Tensor, there: torch.Tensor, linear: float, angular: float) -> torch.Tensor:
    """Velocities (n, 3) `now`, moved towards `there` by at most `linear` (m/s) and `angular` (rad/s)."""
    turn = (there - now)[:, 2:].clamp(-angular, angular)
    return torch.cat((moved_towards(now[:, :2], there[:, :2], linear), now[:, 2:] + turn), 1)


_CACHED = frozenset(name for name, value in vars(EnvState).items() if isinstance(value, lazy))


def _membership(sizes: Sequence[int], device: torch.device) -> torch.Tensor | None:
    """(F, G) float32: which of G geoms in a row belong to which of F feet; None where each foot has one."""
    if all(size == 1 for size in sizes):
        return None
    foot = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes))
    return (foot == torch.arange(len(sizes))[:, None]).float().to(device)


class UndeclaredQuantity(ValueError):
    """A quantity, by its name, that this task does not have, and why; mostly because none of its terms declares it."""

    def __init__(self, name: str, why: str | None = None) -> None:
        why = why or f"without declaring it; decorate the term with @requires({name!r})"
        super().__init__(f"a term reads {name} {why}")
        self.name = name


def with_velocity(state: Kinematics, lin_vel_b: torch.Tensor) -> Kinematics:
    """A state with another linear velocity (n, 3) in m/s, base frame."""
    lin_vel_w = rotate(state.base_quat_w, lin_vel_b)
    return Kinematics(
        torch.cat((state.base_pos_w, state.base_quat_w, state.joint_pos), 1),
        torch.cat((lin_vel_w, state.base_ang_vel_b, state.joint_vel), 1),
    )


class StateHistory(Stateful):
    """The physics states that a delayed measurement may show."""

    saved = ("_past",)

    def __init__(self, sim: Simulator, randomizer: Randomizer) -> None:
        assert randomizer.delay is not None  # measurements are late
        self._sim, self._delay = sim, randomizer.delay
        self._past = tuple(x[:, None].repeat(1, randomizer.max_delay + 1, 1) for x in sim.robot_state())
        self._all_envs = torch.arange(sim.num_envs, device=sim.device)

    def record(self) -> None:
        """Takes in the states after each physics step of the last control step."""
        for past, recorded in zip(self._past, self._sim.recorded_states(), strict=True):
            past.copy_(torch.cat((past[:, recorded.shape[1] :], recorded), 1)[:, -past.shape[1] :])

    def reset(self, env_ids: torch.Tensor) -> None:
        for past, now in zip(self._past, self._sim.robot_state(), strict=True):
            past[env_ids] = now[env_ids, None]

    def delayed(self) -> Kinematics:
        """The state `delay` physics steps ago, by environment."""
        qpos, qvel = self._past
        index = qpos.shape[1] - 1 - self._delay
        return Kinematics(qpos[self._all_envs, index], qvel[self._all_envs, index])


class AirTimes(Stateful):
    """Time that each foot has been in the air, updated in every control step; all (num_envs, F).

    Attributes:
        air: s: of the present phase in the air; 0 in contact.
        last_air: s: of the last such phase that has ended in this episode; 0 before.
        touched_down: bool: contact began in this control step.
    """

    saved = ("air", "last_air", "touched_down")

    def __init__(self, contact: torch.Tensor) -> None:
        """Starts all times at 0; `contact` (num_envs, F) bool gives the shape."""
        self.air, self.last_air = torch.zeros(2, *contact.shape, device=contact.device).unbind(0)
        self.touched_down = torch.zeros_like(contact)

    def advance(self, contact: torch.Tensor, dt: float) -> None:
        """Takes in a control step of `dt` (s) at whose end the feet are in `contact` (num_envs, F) bool or not."""
        self.touched_down = contact & (self.air > 0)
        self.last_air = torch.where(self.touched_down, self.air, self.last_air)
        self.air = torch.where(contact, 0.0, self.air + dt)

    def reset(self, env_ids: torch.Tensor) -> None:
        for name, value in vars(self).items():
            setattr(self, name, value.index_fill(0, env_ids, 0))
