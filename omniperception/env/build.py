"""Builds the parts of an environment that not every task has; what a part imports is loaded where it is built."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from omniperception.avoidance.velocity import MOTION_TARGET
from omniperception.common.random import EnvRandom
from omniperception.env.config import EnvConfig
from omniperception.env.state import AVOIDANCE, CLOUD, DISTAL_RANGE, MEASURED_CLOUD
from omniperception.scene import ObstacleField, TerrainConfig, World
from omniperception.sim import Simulator

if TYPE_CHECKING:
    from omniperception.avoidance.avoidance import Avoidance
    from omniperception.env.consumers import FrameConsumer
    from omniperception.env.frame_delivery import FrameDelivery
    from omniperception.env.height_lookup import HeightLookup
    from omniperception.env.mdp.curriculum import Curriculum
    from omniperception.env.mdp.pushes import Pushes
    from omniperception.env.measurement import MeasurementErrors
    from omniperception.env.partial_frames import PartialFrames
    from omniperception.env.sensing import LidarSensing, SensorConfig
    from omniperception.env.terrain_levels import TerrainLevels
    from omniperception.perception import Sampler
    from omniperception.scene.ground import Ground
    from omniperception.sim.planar_world import PlanarSimulator


def build_sim(config: EnvConfig, world: World, random: EnvRandom) -> Simulator:
    """The physics; robots without legs draw how they answer from `random`."""
    sim = config.sim.build(world, config.num_envs, record_states=config.randomization.latency_s is not None)
    if not config.sim.has_legs:
        _without_legs(sim).draw_by(random)
    return sim


def _without_legs(sim: Simulator) -> PlanarSimulator:
    """A simulator of a task whose `sim` has no legs."""
    from omniperception.sim.planar_world import PlanarSimulator

    assert isinstance(sim, PlanarSimulator)
    return sim


def build_ground(
    config: EnvConfig, sim: Simulator, random: EnvRandom
) -> tuple[Ground | None, TerrainLevels | None, HeightLookup | None]:
    """A ground that is not flat, the curriculum over its tiles and the look-up of heights above it."""
    if isinstance(config.terrain, TerrainConfig):
        return None, None, None
    from omniperception.env.height_lookup import HeightLookup
    from omniperception.env.terrain_levels import TerrainLevels
    from omniperception.scene.ground import Ground

    assert sim.ground_pos is not None  # tiles move
    ground = Ground(config.terrain, sim.world.model, sim.ground_pos, config.sim.num_threads or None)
    max_steps = round(config.terminations.episode_length_s / config.sim.control_dt)
    levels = TerrainLevels(ground, random, config.sim.control_dt, max_steps, config.trials)
    return ground, levels, HeightLookup(ground, sim.num_envs, sim.device, config.robot.footprint)


def build_errors(config: EnvConfig, random: EnvRandom, curriculum: Curriculum) -> MeasurementErrors | None:
    """Errors of what the robot measures of itself."""
    if config.randomization.measures_exactly:
        return None
    from omniperception.env.measurement import MeasurementErrors

    branch, joints = random.branch("measurement"), config.robot.num_joints
    return MeasurementErrors(config.randomization, config.num_envs, joints, config.sim.control_dt, branch, curriculum)


def build_pushes(config: EnvConfig, sim: Simulator, random: EnvRandom, curriculum: Curriculum) -> Pushes | None:
    """Pushes of the robot."""
    if config.randomization.pushes is None:
        return None
    from omniperception.env.mdp.pushes import Pushes

    return Pushes(config.randomization.pushes, sim, config.sim.control_dt, random.branch("pushes"), curriculum)


def build_obstacles(
    config: EnvConfig, sim: Simulator, random: EnvRandom, ground: Ground | None
) -> ObstacleField | None:
    """The obstacles, where there are some."""
    if not config.obstacles.num_obstacles:
        return None
    field = ObstacleField(config.obstacles, sim.mocap_pos, sim.mocap_quat, random, ground)
    if not config.sim.has_legs:
        _without_legs(sim).set_obstacles(field)
    return field


def build_avoidance(config: EnvConfig, field: ObstacleField | None, device: torch.device) -> Avoidance | None:
    """The avoidance velocity, where a term or a supervised network reads something of it."""
    reads_velocity = AVOIDANCE in config.requirements()
    if config.lidar is None or not config.uses_lidar or not (reads_velocity or MOTION_TARGET in config.targets):
        return None
    from omniperception.avoidance.avoidance import Avoidance

    return Avoidance(
        config.rewards.avoidance,
        config.num_envs,
        device,
        config.lidar.max_range,
        config.obstacles,
        field,
        reads_velocity,
    )


def build_delivery(config: EnvConfig, random: EnvRandom) -> FrameDelivery | None:
    """How LiDAR frames come, where they are lost, late or partial."""
    rows, sensor = config.randomization, config.lidar
    if sensor is None or (rows.frames_lost, rows.frames_late_s, rows.partial_frames) == (None, None, None):
        return None
    from omniperception.env.frame_delivery import FrameDelivery
    from omniperception.env.partial_frames import PartialFrames

    partial, branch = None, random.branch("frames")
    if rows.partial_frames is not None:
        spells = random.branch("partial_frames")
        partial = PartialFrames(rows.partial_frames, sensor.period_s, sensor.num_rays, config.num_envs, spells)
    late_s = None if rows.frames_late_s is None else (rows.frames_late_s[0], rows.frames_late_s[1])
    return FrameDelivery(rows.frames_lost, late_s, config.sim.control_dt, config.num_envs, branch, partial)


LOWEST_BAND = 0.05
"""Height (m) above the ground up to which a sampler's bands may begin: what is lower does not stop a robot."""


def build_sampler(config: EnvConfig) -> Sampler | None:
    """What a network sees of a cloud.

    Raises:
        ValueError: its bands of height, which count from the base's origin, begin above the ground that carries it, or
            it takes another number of rays than there are.
    """
    if config.sampler is None or config.lidar is None:
        return None
    from omniperception.perception import ProximitySampler, RawSampler

    sampler, link = config.sampler(), config.lidar.mount_body
    if isinstance(sampler, RawSampler) and config.network_sees_frames and sampler.num_points != config.lidar.num_rays:
        raise ValueError(
            f"lidar.num_rays={config.lidar.num_rays} must be perception.sampler.num_rays={sampler.num_points}: the"
            " network reads every ray; give both the same"
        )
    if isinstance(sampler, ProximitySampler):
        height, lowest = config.robot.height_of(link), float(sampler.edges[0])
        if lowest + height > LOWEST_BAND:
            raise ValueError(
                f"perception.sampler.band_edges begins {lowest + height:.2f} m above the ground, at {lowest:g} m from"
                f" the origin of {link or 'the base'} at {height:g}, and what is lower would not be seen; begin it at"
                f" {-height - 0.01:.2f}, or use perception=polar_rings"
            )
    return sampler


def build_sensing(
    config: EnvConfig, sim: Simulator, random: EnvRandom, avoidance: Avoidance | None
) -> LidarSensing | None:
    """The LiDAR, where something reads it."""
    if config.lidar is None or not config.uses_lidar:
        return None
    from omniperception.env.odometry import Odometry, TimedOdometry
    from omniperception.env.sensing import LidarSensing

    delivery = build_delivery(config, random)
    late, partial = (0, None) if delivery is None else (delivery.max_late_steps, delivery.partial)
    odometry: Odometry | TimedOdometry | None = None
    if config.frame_times:
        odometry = TimedOdometry(config.num_envs, config.sim.control_dt, late, sim.device)
    elif config.base_motion:
        odometry = Odometry(config.num_envs, config.sim.control_dt, sim.device)
    return LidarSensing(
        config.lidar,
        sim,
        config.sim.control_dt,
        build_consumers(config, config.lidar, avoidance, partial),
        noise=config.lidar_noise,
        seed=config.seed,
        num_threads=config.sim.num_threads or None,
        delivery=delivery,
        odometry=odometry,
    )


def build_consumers(
    config: EnvConfig, sensor: SensorConfig, avoidance: Avoidance | None, partial: PartialFrames | None
) -> dict[str, FrameConsumer]:
    """What takes something of each frame, in this order: the task's own by their classes, others by their names."""
    from omniperception.env import consumers
    from omniperception.env.sensing import least_bins_of

    found: list[FrameConsumer] = []
    needed, sampler = config.requirements(), build_sampler(config)
    reads_points = MEASURED_CLOUD in needed or (sampler is not None and config.network_sees_frames)
    if partial is not None and reads_points:
        least = least_bins_of(sensor, sensor.scan_pattern(), config.robot)
        found.append(consumers.CoveredSectors(partial, least))
    if avoidance is not None and avoidance.obstacle_names:
        found.append(consumers.Sightings(avoidance.obstacle_names))
    if DISTAL_RANGE in needed:
        found.append(consumers.DistalRange())
    if sampler is not None:
        found.append(consumers.FrameHistory(sampler, config.frame_history, config.network_sees_frames))
    if avoidance is not None and avoidance.sector_distance is not None:
        found.append(consumers.SectorRanges(avoidance.sector_distance))
    read = {CLOUD: ("true_ranges", "directions_s", "elevation"), MEASURED_CLOUD: ("ranges", "directions_s")}
    if needed & read.keys():
        found.append(consumers.Clouds({name for key in needed & read.keys() for name in read[key]}))
    own = {name: build() for name, build in sensor.consumers.items()}
    return {type(consumer).__name__: consumer for consumer in found} | own
