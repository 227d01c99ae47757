"""Domain randomization: the paper's table, and errors and disturbances of a real robot, each absent if null."""

from __future__ import annotations

import math
from dataclasses import fields
from operator import attrgetter
from typing import Annotated

import torch
from pydantic import Field

from omnilidar import AngularJitter, DistanceNoise, Dropout, GaussianNoise, MaskNoise, MixedPixels, Noise
from omniperception.common.checked import (
    AtLeastOne,
    NonNegative,
    NonNegativePair,
    Pair,
    Point,
    Positive,
    PositivePair,
    Text,
    checked,
)
from omniperception.common.random import EnvRandom
from omniperception.common.stateful import Stateful
from omniperception.env.mdp.curriculum import FULL, Curriculum, CurriculumConfig
from omniperception.env.partial_frames import PartialFramesConfig
from omniperception.scene.terrain import ground_solrefs
from omniperception.sim import Simulator

_Lost = Annotated[float, Field(ge=0, lt=1), "a share: at least 0 and less than 1"]

_MASSES = {"added_mass", "payload_mass", "com_x", "com_y", "com_z"}
DRAWN = (
    "ground_friction",
    "ground_restitution",
    "motor_strength",
    "gravity_offset",
    "joint_offset",
    "latency_s",
    "added_mass",
    "payload_mass",
    "com_x",
    "com_y",
    "com_z",
)
"""Parameters of the physics and the actuation that are drawn at a reset, in this order."""
_MEASURED = (
    "velocity_scale",
    "velocity_drift",
    "gyro_bias",
    "gyro_noise",
    "attitude_bias_deg",
    "attitude_noise_deg",
    "joint_pos_noise",
    "joint_vel_noise",
)
"""Errors of what the robot measures of itself."""


@checked("condition")
class Condition:
    """Name of a fixed randomization (conf/condition), as a run or a result records it.

    Attributes:
        name: of the condition.
        version: raised whenever one of its values changes: results under different versions are not comparable.
    """

    name: Text
    version: AtLeastOne


@checked("randomization: a drift's ")
class Drift:
    """A slowly wandering error: an Ornstein-Uhlenbeck process, stationary from the first step of an episode on.

    Attributes:
        sd: standard deviation of each axis.
        time_s: time (s) after which a fraction 1/e of an error is left.
    """

    sd: NonNegative
    time_s: Positive


@checked("randomization.pushes")
class PushesConfig:
    """Sudden changes of the base's horizontal velocity.

    Attributes:
        every_s: (low, high) s between two pushes, drawn uniformly; the first comes after a random part of it.
        speed: largest change (m/s), drawn uniformly from 0 on, in a direction drawn uniformly.
    """

    every_s: PositivePair
    speed: NonNegative


@checked("randomization")
class RandomizationConfig:
    """Ranges (low, high) drawn uniformly per environment; null leaves a row out.

    The rows from `added_mass` to `latency_s` are drawn at every reset, and so are scale errors and biases; noise is
    drawn in every control step, and the LiDAR's with every frame. Errors of what is measured change `EnvState.measured`
    and what is computed of it (the actor's observations, the odometry of LiDAR frames, the levelling of clouds), never
    the truth that rewards, terminations and the critic see. What is drawn for several axes or joints is drawn for each.

    Attributes:
        lidar_device: whether ranges and directions have the noise that the maker of the LiDAR in use states.
        lidar_measured: whether it has what recordings of the LiDAR in use show, within the ranges that they cover.
        lidar_mask: points replaced by short distances.
        lidar_distance: multiplicative noise of the measured distances.
        lidar_gaussian: normal noise of the measured distances.
        lidar_jitter: noise of the rays' directions.
        lidar_dropout: points lost.
        lidar_mixed: points between foreground and background at depth edges.
        added_mass: mass (kg) added to the base at its centre of mass.
        payload_mass: mass (kg) carried at `payload_position`.
        com_x, com_y, com_z: displacement (m) of the base's centre of mass.
        ground_friction: sliding friction coefficient.
        ground_restitution: coefficient of restitution of the ground; see `scene.terrain.ground_solrefs`.
        motor_strength: factor on the PD torque; the torque limit stays.
        joint_offset: calibration error (rad) of every joint, added to the joint targets.
        gravity_offset: acceleration (m/s^2) added to each axis of gravity.
        latency_s: age (s) of the proprioception that the actor sees.
        payload_position: where the payload sits in the base frame (m).
        velocity_scale: factor on the base's measured linear velocity: leg odometry misjudges lengths and slip.
        velocity_drift: error (m/s) of each axis of it, base frame: an estimator's bias wanders.
        gyro_bias: error (rad/s) of each axis of the measured angular velocity.
        gyro_noise: likewise, drawn in every control step.
        attitude_bias_deg: error (deg) of measured roll and pitch each, as of an IMU that is mounted askew.
        attitude_noise_deg: likewise, drawn in every control step.
        joint_pos_noise: error (rad) of every measured joint position, drawn in every control step.
        joint_vel_noise: error (rad/s) of every measured joint velocity, likewise.
        frames_lost: share of the LiDAR frames that never come, in each environment on its own.
        frames_late_s: age (s) of the scene that a LiDAR frame shows when it comes, drawn for every frame, rounded to
            control steps.
        partial_frames: spells in which frames lack a part of their points.
        pushes: of the base.
        curriculum: of the share of the ranges, but for the LiDAR's, about what is there without randomization; None:
            the whole ranges from the first step.
    """

    lidar_device: bool = False
    lidar_measured: bool = False
    lidar_mask: MaskNoise | None = None
    lidar_distance: DistanceNoise | None = None
    lidar_gaussian: GaussianNoise | None = None
    lidar_jitter: AngularJitter | None = None
    lidar_dropout: Dropout | None = None
    lidar_mixed: MixedPixels | None = None
    added_mass: Pair | None = None
    payload_mass: Pair | None = None
    com_x: Pair | None = None
    com_y: Pair | None = None
    com_z: Pair | None = None
    ground_friction: NonNegativePair | None = None
    ground_restitution: NonNegativePair | None = None
    motor_strength: NonNegativePair | None = None
    joint_offset: Pair | None = None
    gravity_offset: Pair | None = None
    latency_s: NonNegativePair | None = None
    payload_position: Point = (0.0, 0.0, 0.1)
    velocity_scale: NonNegativePair | None = None
    velocity_drift: Drift | None = None
    gyro_bias: Pair | None = None
    gyro_noise: Pair | None = None
    attitude_bias_deg: Pair | None = None
    attitude_noise_deg: Pair | None = None
    joint_pos_noise: Pair | None = None
    joint_vel_noise: Pair | None = None
    frames_lost: _Lost | None = None
    frames_late_s: NonNegativePair | None = None
    partial_frames: PartialFramesConfig | None = None
    pushes: PushesConfig | None = None
    curriculum: CurriculumConfig | None = None

    def __post_init__(self) -> None:
        if self.ground_restitution is not None and self.ground_restitution[1] > 1:
            raise ValueError(f"randomization.ground_restitution={list(self.ground_restitution)} must not exceed 1")

    @property
    def measures_exactly(self) -> bool:
        """Tell whether what the robot measures of itself has no errors."""
        return all(getattr(self, name) is None for name in _MEASURED)

    @property
    def noise(self) -> tuple[Noise, ...]:
        """The LiDAR noise models, but for those of the device."""
        models = (getattr(self, item.name) for item in fields(self) if item.name.startswith("lidar_"))
        return tuple(model for model in models if not isinstance(model, bool | None))


class Randomizer(Stateful):
    """Draws each environment's physical parameters at its resets and writes them into the simulator's model."""

    buffers = ("drawn", "delay")

    def __init__(
        self, config: RandomizationConfig, sim: Simulator, random: EnvRandom, curriculum: Curriculum = FULL
    ) -> None:
        self.config, self._sim, self._random, self._curriculum = config, sim, random, curriculum
        self._model = model = sim.world.model
        self._base = sim.world.base_body
        self._ground = model.geom("ground").id
        self._nominal: dict[str, torch.Tensor] = {}  # of what is randomized, when it is first drawn
        self._check_mass()
        self._shapes = self._drawn_shapes()
        widths = [math.prod(shape) for shape in self._all_shapes().values()]
        self.drawn = torch.zeros(sim.num_envs, sum(widths), device=sim.device)
        """(num_envs, W) what was drawn, in the order of DRAWN and in its own units: a number for each joint of motor
        strength and joint offset, three of gravity, one of every other row; 0 where not randomized."""
        if self._shapes:
            columns = torch.arange(sum(widths), device=sim.device).split(widths)
            self._columns = torch.cat([c for name, c in zip(DRAWN, columns, strict=True) if name in self._shapes])
            bounds = [getattr(config, name) for name, shape in self._shapes.items() for _ in range(math.prod(shape))]
            low, high = torch.tensor(bounds, dtype=torch.float64, device=sim.device).unbind(1)
            self._low, self._span = low.float(), (high - low).float()
            self._neutral = torch.cat([self._neutral_of(name).expand(math.prod(s)) for name, s in self._shapes.items()])
        self._mass = bool(_MASSES & self._shapes.keys())
        if self._mass:
            self._payload_position = torch.tensor(config.payload_position, dtype=torch.float64, device=sim.device)
        self.joint_offset: torch.Tensor | None = None
        """(num_envs, num_joints) rad added to the joint targets, a view of `drawn`; None when not randomized."""
        self.delay: torch.Tensor | None = None
        """(num_envs,) int64 physics steps by which proprioception is late; None when not randomized."""
        if config.joint_offset:
            self.joint_offset = self.drawn.split(widths, 1)[DRAWN.index("joint_offset")]
        if config.latency_s:
            self.delay = torch.zeros(sim.num_envs, dtype=torch.int64, device=sim.device)

    def _nominal_of(self, name: str) -> torch.Tensor:
        """A field of the model as compiled."""
        if name not in self._nominal:
            value = attrgetter(name)(self._model)
            self._nominal[name] = torch.tensor(value, device=self._sim.device)
        return self._nominal[name]

    @property
    def max_delay(self) -> int:
        """The largest delay in physics steps that can be drawn."""
        return round(self.config.latency_s[1] / self._sim.world.model.opt.timestep) if self.config.latency_s else 0

    def reset(self, env_ids: torch.Tensor) -> None:
        """Draws new parameters for some environments (n,)."""
        if not self._shapes:
            return
        self._random.start_episode(env_ids)
        drawn = self._draw(env_ids)
        if "ground_friction" in drawn:
            self._write("geom_friction", env_ids, drawn["ground_friction"], self._ground, 0)
        if "ground_restitution" in drawn:
            self._write("geom_solref", env_ids, ground_solrefs(drawn["ground_restitution"]), self._ground)
        if "motor_strength" in drawn:
            for name in ("actuator_gainprm", "actuator_biasprm"):
                self._write(name, env_ids, self._nominal_of(name) * drawn["motor_strength"])
        if "gravity_offset" in drawn:
            self._write("opt.gravity", env_ids, self._nominal_of("opt.gravity") + drawn["gravity_offset"])
        if self.delay is not None:
            steps = (drawn["latency_s"] / self._model.opt.timestep).round().long()
            self.delay[env_ids] = steps.clamp(max=self.max_delay)  # drawn in float32, which rounds half steps anyhow
        if self._mass:
            self._set_masses(env_ids, drawn)

    def _write(self, field: str, env_ids: torch.Tensor, values: torch.Tensor, *index: int) -> None:
        """Writes float64 values into a model field of some environments, at an index, in the engine's precision."""
        model_field = self._sim.model_field(field)
        where: tuple[torch.Tensor | int, ...] = (env_ids, *index)
        model_field[where] = values.to(model_field.dtype)

    def _check_mass(self) -> None:
        """Refuses ranges that can leave the base without mass, with which physics diverges at once."""
        config, base = self.config, float(self._model.body_mass[self._base])
        lightest = base + sum(bounds[0] for bounds in (config.added_mass, config.payload_mass) if bounds)
        if lightest <= 0:
            raise ValueError(
                f"randomization.added_mass={config.added_mass} and payload_mass={config.payload_mass} leave a base of"
                f" {base:g} kg with {lightest:g} kg; it must keep a positive mass"
            )

    def _drawn_shapes(self) -> dict[str, tuple[int, ...]]:
        """Parameters and shapes that are drawn for one environment, in the order of the draws."""
        return {name: shape for name, shape in self._all_shapes().items() if getattr(self.config, name) is not None}

    def _all_shapes(self) -> dict[str, tuple[int, ...]]:
        """Likewise of all that could be drawn."""
        joints = self._sim.world.robot.num_joints
        shapes = {"motor_strength": (joints, 1), "gravity_offset": (3,), "joint_offset": (joints,)}
        return {name: shapes.get(name, ()) for name in DRAWN}

    def _neutral_of(self, name: str) -> torch.Tensor:
        """(1,) float64: what a parameter is without randomization."""
        terrain_friction = float(self._model.geom_friction[self._ground, 0])
        neutral = {"motor_strength": 1.0, "ground_friction": terrain_friction}
        neutral["ground_restitution"] = self._sim.world.terrain.restitution
        value = neutral.get(name, 0.0)
        return torch.tensor([value], dtype=torch.float64, device=self._sim.device)

    def _draw(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """All parameters of some environments, float64, at once."""
        u = self._random.uniform(env_ids, (len(self._low),))
        values = (self._low + self._span * u).double()
        if self._curriculum.level < 1.0:
            values = self._neutral + self._curriculum.level * (values - self._neutral)
        self.drawn[env_ids[:, None], self._columns] = values.float()
        parts = values.split([math.prod(shape) for shape in self._shapes.values()], 1)
        shapes = self._shapes.items()
        return {name: part.reshape(-1, *shape) for (name, shape), part in zip(shapes, parts, strict=True)}

    def _set_masses(self, env_ids: torch.Tensor, drawn: dict[str, torch.Tensor]) -> None:
        """Mass and centre of mass of base, added mass and payload together; the base's inertia stays nominal."""
        nothing = torch.zeros(len(env_ids), dtype=torch.float64, device=env_ids.device)
        base_mass = float(self._model.body_mass[self._base])
        body = base_mass + drawn.get("added_mass", nothing)
        payload = drawn.get("payload_mass", nothing)
        offset = torch.stack([drawn.get(name, nothing) for name in ("com_x", "com_y", "com_z")], 1)
        centre = self._nominal_of("body_ipos")[self._base] + offset
        total = body + payload
        self._write("body_mass", env_ids, total, self._base)
        combined = (body[:, None] * centre + payload[:, None] * self._payload_position) / total[:, None]
        self._write("body_ipos", env_ids, combined, self._base)
        self._sim.update_model(env_ids)
