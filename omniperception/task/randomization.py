"""Domain randomization: the thirteen rows of the paper's table and the LiDAR's own noise, each absent when null."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from operator import attrgetter

import torch

from omniperception.lidar import AngularJitter, DistanceNoise, Dropout, GaussianNoise, MaskNoise, MixedPixels, Noise
from omniperception.random import EnvRandom
from omniperception.rows import put
from omniperception.sim import Simulator
from omniperception.world.terrain import contact_solrefs

Range = Sequence[float] | None


@dataclass(frozen=True)
class RandomizationConfig:
    """Ranges (low, high) drawn uniformly per environment at every reset; null leaves a row out altogether.

    Attributes:
        lidar_device: whether ranges and directions have the noise that the maker of the LiDAR in use states.
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
        ground_restitution: coefficient of restitution.
        motor_strength: factor on the PD torque; the torque limit stays.
        joint_offset: calibration error (rad) of every joint, added to the joint targets.
        gravity_offset: acceleration (m/s^2) added to each axis of gravity.
        latency_s: age (s) of the proprioception that the actor sees.
        payload_position: where the payload sits in the base frame (m).
    """

    lidar_device: bool = False
    lidar_mask: MaskNoise | None = None
    lidar_distance: DistanceNoise | None = None
    lidar_gaussian: GaussianNoise | None = None
    lidar_jitter: AngularJitter | None = None
    lidar_dropout: Dropout | None = None
    lidar_mixed: MixedPixels | None = None
    added_mass: Range = None
    payload_mass: Range = None
    com_x: Range = None
    com_y: Range = None
    com_z: Range = None
    ground_friction: Range = None
    ground_restitution: Range = None
    motor_strength: Range = None
    joint_offset: Range = None
    gravity_offset: Range = None
    latency_s: Range = None
    payload_position: Sequence[float] = (0.0, 0.0, 0.1)

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name.startswith("lidar_") or item.name == "payload_position" or value is None:
                continue
            if len(value) != 2 or not -math.inf < value[0] <= value[1] < math.inf:
                raise ValueError(f"randomization.{item.name}={list(value)} must be [low, high] or null")
            object.__setattr__(self, item.name, (float(value[0]), float(value[1])))
        for name in ("ground_friction", "ground_restitution", "motor_strength", "latency_s"):
            value = getattr(self, name)
            if value is not None and value[0] < 0:
                raise ValueError(f"randomization.{name}={list(value)} must not be negative")
        if self.ground_restitution is not None and self.ground_restitution[1] > 1:
            raise ValueError(f"randomization.ground_restitution={list(self.ground_restitution)} must not exceed 1")

    @property
    def noise(self) -> tuple[Noise, ...]:
        """The LiDAR noise models, but for the device's own."""
        models = (getattr(self, item.name) for item in fields(self) if item.name.startswith("lidar_"))
        return tuple(model for model in models if not isinstance(model, bool | None))


class Randomizer:
    """Draws each environment's physical parameters at its resets and writes them into the simulator's model."""

    def __init__(self, config: RandomizationConfig, sim: Simulator, random: EnvRandom) -> None:
        self.config, self._sim, self._random = config, sim, random
        self._model = model = sim.world.model
        self._base = sim.world.base_body
        self._ground = model.geom("ground").id
        self._mass = any(getattr(config, n) for n in ("added_mass", "payload_mass", "com_x", "com_y", "com_z"))
        self._nominal: dict[str, torch.Tensor] = {}  # of what is randomized, when it is first drawn
        self._check_mass()
        if self._mass:
            self._payload_position = torch.tensor(config.payload_position, dtype=torch.float64, device=sim.device)
        self.joint_offset: torch.Tensor | None = None
        """(num_envs, num_joints) rad added to the joint targets; None when not randomized."""
        self.delay: torch.Tensor | None = None
        """(num_envs,) int64 physics steps by which proprioception is late; None when not randomized."""
        if config.joint_offset:
            self.joint_offset = torch.zeros(sim.num_envs, sim.world.robot.num_joints, device=sim.device)
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

    def reset(self, envs: torch.Tensor) -> None:
        """Draws new parameters for some environments."""
        config = self.config
        if config.ground_friction:
            self._write("geom_friction", envs, self._draw(envs, "ground_friction"), self._ground, 0)
        if config.ground_restitution:
            solref = contact_solrefs(self._draw(envs, "ground_restitution"))
            self._write("geom_solref", envs, solref, self._ground)
        if config.motor_strength:
            self._scale_motors(envs)
        if config.gravity_offset:
            offset = self._draw(envs, "gravity_offset", (3,))
            self._write("opt.gravity", envs, self._nominal_of("opt.gravity") + offset)
        if self.joint_offset is not None:
            put(self.joint_offset, envs, self._draw(envs, "joint_offset", self.joint_offset.shape[1:]))
        if self.delay is not None:
            steps = self._draw(envs, "latency_s") / self._model.opt.timestep
            put(self.delay, envs, steps.round())
        if self._mass:
            self._set_masses(envs)

    def state_dict(self) -> dict:
        """Parameters that live outside the physics model."""
        return {"joint_offset": self.joint_offset, "delay": self.delay}

    def load_state_dict(self, state: dict) -> None:
        for mine, saved in ((self.joint_offset, state["joint_offset"]), (self.delay, state["delay"])):
            if mine is not None:
                mine.copy_(saved)

    def _write(self, field: str, envs: torch.Tensor, values: torch.Tensor, *index: int) -> None:
        """Writes float64 values into a model field of some environments, at an index, in the engine's precision."""
        put(self._sim.model_field(field)[(slice(None), *index)], envs, values)

    def _check_mass(self) -> None:
        """Refuses ranges that can leave the base without mass, with which physics diverges at once."""
        config, base = self.config, float(self._model.body_mass[self._base])
        lightest = base + sum(bounds[0] for bounds in (config.added_mass, config.payload_mass) if bounds)
        if lightest <= 0:
            raise ValueError(
                f"randomization.added_mass={config.added_mass} and payload_mass={config.payload_mass} leave a base of"
                f" {base:g} kg with {lightest:g} kg; it must keep a positive mass"
            )

    def _draw(self, envs: torch.Tensor, name: str, shape: Sequence[int] = ()) -> torch.Tensor:
        low, high = getattr(self.config, name)
        return self._random.range(envs, low, high, tuple(shape)).double()

    def _draw_or_zero(self, envs: torch.Tensor, name: str) -> torch.Tensor:
        if getattr(self.config, name) is None:
            return torch.zeros(len(envs), dtype=torch.float64, device=envs.device)
        return self._draw(envs, name)

    def _scale_motors(self, envs: torch.Tensor) -> None:
        scale = self._draw(envs, "motor_strength", (self._model.nu, 1))
        for name in ("actuator_gainprm", "actuator_biasprm"):
            self._write(name, envs, self._nominal_of(name) * scale)

    def _set_masses(self, envs: torch.Tensor) -> None:
        """Mass and centre of mass of base, added mass and payload together; the base's inertia stays nominal."""
        base_mass = float(self._model.body_mass[self._base])
        body = base_mass + self._draw_or_zero(envs, "added_mass")
        payload = self._draw_or_zero(envs, "payload_mass")
        offset = torch.stack([self._draw_or_zero(envs, name) for name in ("com_x", "com_y", "com_z")], 1)
        centre = self._nominal_of("body_ipos")[self._base] + offset
        total = body + payload
        self._write("body_mass", envs, total, self._base)
        combined = (body[:, None] * centre + payload[:, None] * self._payload_position) / total[:, None]
        self._write("body_ipos", envs, combined, self._base)
        self._sim.update_model(envs)
