"""Work and precision of the perception: points kept and how, and how many frames of them a network sees."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from benchmarks.harness.pareto import Choice, Study
from benchmarks.harness.rotations import matrices
from benchmarks.harness.timing import paired_timings
from omnilidar import Lidar, ScanPattern, SectorDistances, quat_from_rpy
from omniperception.avoidance.sector_motion import NEARNESS_RANGE
from omniperception.avoidance.velocity import SECTOR_TARGET
from omniperception.build import RunConfig, assemble
from omniperception.common.rotations import yaw_quat
from omniperception.common.sectors import sector_of
from omniperception.config import compose
from omniperception.env.config import HEIGHT_TARGET
from omniperception.env.env import OmniEnv
from omniperception.env.heights import height_grid
from omniperception.perception import Attitude, PdSampler, PerceptionNetwork, ProximitySampler, Sampler
from omniperception.scene.rays import HitClass

from .scene import dense_directions

SAMPLING = "CPU time of sampling a frame (us per environment)"
EMBEDDING = "CPU time of an embedding (us per environment)"
COVERAGE, HEIGHT, SECTOR = "coverage radius (m)", "height RMSE (m)", "sector distance RMSE (m)"
FRAME_BYTES = "bytes per frame"
ABOVE_GROUND = 0.1
"""A kept point so far (m) above flat ground is an obstacle's to the decoder of sectors."""
NEAR = 1.5
"""A sector whose obstacle is this near (m) counts as near."""
BODY = (0.5, 0.28)
"""Half length and half width of the robot's own body around the base, metres; the decoders skip what lies there."""
EPISODE_S = 1.2
DENSE_DEG = 1.5
"""Spacing of the rays that tell what is truly near."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        num_envs: Environments of a frame.
        rounds: How often each choice is timed, in turn.
        block_s: About how long at once, s.
        episodes: Scenes per environment from which networks learn.
        steps: Of Adam that a network is given.
        batch: Windows of each of them.
    """

    num_envs: int = 128
    rounds: int = 5
    block_s: float = 0.02
    episodes: int = 8
    steps: int = 300
    batch: int = 128


SMALL = Sizes(num_envs=8, rounds=2, block_s=0.002, episodes=2, steps=3, batch=8)


@dataclass(frozen=True)
class Cloud:
    """Rays of E environments and what is true of them.

    Attributes:
        ranges, directions_s, elevation, azimuth: As a sampler takes them, noise-free.
        attitude: How the sensors stand.
        heights: The 17 x 11 grid, base height minus ground, m, (E, 187).
        sectors: Horizontal distance to the nearest obstacle hit of the frame's rays by sector, m, (E, 36).
        true_sectors: The same of rays ``DENSE_DEG`` apart all over the field of view.
        max_range: Of the sensor, m.
    """

    ranges: torch.Tensor
    directions_s: torch.Tensor
    elevation: torch.Tensor
    azimuth: torch.Tensor
    attitude: Attitude
    heights: torch.Tensor
    sectors: torch.Tensor
    true_sectors: torch.Tensor
    max_range: float

    def sample(self, sampler: Sampler, out: torch.Tensor) -> torch.Tensor:
        """Points (E, P, 3) in the sensor's frame over the maximum range, written into ``out``."""
        sampler(self.ranges, self.directions_s, self.elevation, self.azimuth, out, self.attitude)
        return out

    def level(self, points: torch.Tensor) -> torch.Tensor:
        """Points (E, P, 3) of the sensor's frame, m, in the levelled, yaw-aligned frame of the base."""
        base = torch.from_numpy(matrices(self.attitude.base_quat.numpy()))
        yaw = torch.atan2(base[:, 1, 0], base[:, 0, 0])
        level = torch.from_numpy(matrices(yaw_quat(-yaw).numpy())) @ base
        mount = torch.from_numpy(matrices(np.array(self.attitude.mount_quat)))
        in_base = points.double() @ mount.T + torch.tensor(self.attitude.mount_pos, dtype=torch.float64)
        return in_base @ level.transpose(1, 2)


class Recorder:
    """An environment of a configuration whose robots are put down again every ``EPISODE_S`` seconds."""

    def __init__(self, overrides: Sequence[str], num_envs: int, extra: Sequence[str]) -> None:
        given = [*overrides, "randomization=none", f"num_envs={num_envs}", "sim.num_threads=1"]
        self.run: RunConfig = assemble(compose([*given, f"terminations.episode_length_s={EPISODE_S}", *extra]))
        targets = (HEIGHT_TARGET, SECTOR_TARGET)
        self.env = OmniEnv(replace(self.run.env, targets=targets, skip_curricula=True))
        self.generator = torch.Generator().manual_seed(0)
        self._dense, self._dense_sectors = self._look_everywhere()

    def _look_everywhere(self) -> tuple[Lidar, SectorDistances]:
        """A sensor at the same place with rays all over its field of view."""
        sensing = self.env.sensing
        elevation, config = sensing.lidar.pattern.elevation, sensing.config
        directions = dense_directions((float(elevation.min()), float(elevation.max())), DENSE_DEG)
        pattern = ScanPattern.from_directions(directions, len(directions) / config.period_s)
        config = replace(config, num_rays=len(directions), selection="every_kth", motion_segments=0)
        outputs = ("true_ranges", "directions_s", "class_id")
        dense = Lidar(config, pattern, sensing.scene, sensing.carrier, outputs=outputs)
        rays = (dense.frame.true_ranges, dense.frame.directions_s, dense.frame.class_id)
        place = (sensing.scene.body_pos, sensing.scene.body_quat, sensing.base, config.mount_pos, config.quat)
        kind, carrier = int(HitClass.OBSTACLE), sensing.carrier
        return dense, SectorDistances(*rays, *place, kind, config.max_range, carrier=carrier, num_threads=1)

    def frames(self, count: int) -> list[Cloud]:
        """The next frames while the robots stand and shake a little."""
        clouds = []
        with torch.inference_mode():
            while len(clouds) < count:
                shape = (self.env.num_envs, self.env.num_actions)
                self.env.step(0.2 * torch.randn(shape, generator=self.generator))
                if self.env.sensing.due(self.env.step_count):
                    clouds.append(self._cloud())
        return clouds

    @property
    def frames_per_episode(self) -> int:
        return round(EPISODE_S / self.run.env.lidar.period_s)

    def _cloud(self) -> Cloud:
        sensor, frame = self.env.sensing.config, self.env.sensing.frame
        rays = (frame.true_ranges, frame.directions_s, frame.elevation, frame.azimuth)
        self._dense.cast(self.env.step_count * self.env.control_dt)
        quat = self.env.state.kinematics.base_quat_w.float().contiguous().clone()
        return Cloud(
            *(tensor.clone() for tensor in rays),
            Attitude(quat, sensor.mount_pos, sensor.mount_quat or quat_from_rpy(*sensor.mount_rpy)),
            self.env.get_observations()[HEIGHT_TARGET].clone(),
            self.env.avoidance.sector_distance.clone(),
            self._dense_sectors().clone(),
            sensor.max_range,
        )


ROUGH = (
    "obstacles=none",
    "terrain=mixed",
    "terrain.curriculum=null",
    "commands.spawn.x=[-3,3]",
    "commands.spawn.y=[-3,3]",
)
"""For heights: uneven ground without obstacles, robots anywhere on its tiles."""
CROWD = ("obstacles=mixed",)
"""For sectors: obstacles on flat ground."""


def farthest_study(overrides: Sequence[str], sizes: Sizes, counts: Sequence[int] = (32, 64, 128, 256)) -> Study:
    """Proximal points kept by farthest point sampling, and by what is cheaper: how well they cover the cloud."""
    recorder = Recorder(overrides, sizes.num_envs, CROWD)
    cloud, configured = recorder.frames(2)[-1], recorder.run.perception.sampler()
    options = {"max_range": cloud.max_range, "split_deg": math.degrees(configured.split), "num_threads": 1}
    near = torch.isfinite(cloud.ranges) & (cloud.elevation > configured.split)
    in_order, shuffled = torch.arange(near.shape[1]), torch.randperm(near.shape[1], generator=recorder.generator)
    samplers, clouds = {}, {}
    for count in sorted({*counts, configured.num_proximal}):
        ways = {"farthest": cloud, "farthest of 4 times as many": _thinned(cloud, near, 4 * count, in_order)}
        ways |= {"every k-th": _thinned(cloud, near, count, in_order), "random": _thinned(cloud, near, count, shuffled)}
        for way, thinned in ways.items():
            samplers[f"{count} {way}"], clouds[f"{count} {way}"] = PdSampler(count, 0, **options), thinned
    costs, kept = _sampled(clouds, samplers, sizes)
    hits = cloud.ranges.clamp(max=cloud.max_range)[..., None] * cloud.directions_s
    choices = []
    for name, points in kept.items():
        radius = [_radius(h[m], p) for h, m, p in zip(hits, near, points * cloud.max_range, strict=True) if m.any()]
        errors = {COVERAGE: float(torch.stack(radius).mean())}
        facts = {FRAME_BYTES: points[0].numel() * 4}
        default = name == f"{configured.num_proximal} farthest"
        choices.append(Choice(name, costs[name], errors, default, name.split(" ", 1)[1], facts))
    notes = (
        f"{float(near.sum(1).float().mean()):.0f} proximal hits of {cloud.ranges.shape[1]} rays on average, {len(hits)}"
        " environments. The coverage radius is the largest distance of a hit to its nearest sample, in float64."
        " Thinning before sampling is not timed.",
    )
    return Study("farthest", "Farthest point sampling of the near cloud", SAMPLING, COVERAGE, choices, 1e-4, notes)


def _thinned(cloud: Cloud, near: torch.Tensor, num_hits: int, order: torch.Tensor) -> Cloud:
    """The cloud with only so many of the ``near`` hits (E, R), evenly spaced in an order of the rays."""
    ranges = cloud.ranges.clone()
    for row, mask in zip(ranges, near, strict=True):
        hits = order[mask[order]]
        if len(hits) > num_hits:
            kept = torch.zeros_like(mask)
            kept[hits[torch.linspace(0, len(hits) - 1, num_hits).round().long()]] = True
            row[mask & ~kept] = math.inf
    return replace(cloud, ranges=ranges)


def heights_study(overrides: Sequence[str], sizes: Sizes, counts: Sequence[int] = (16, 32, 64, 128, 256, 512)) -> Study:
    """Proximal points kept: the ground's height that can be read from them."""
    recorder = Recorder(overrides, sizes.num_envs, ROUGH)
    cloud, configured = recorder.frames(2)[-1], recorder.run.perception.sampler()
    options = {"max_range": cloud.max_range, "split_deg": math.degrees(configured.split), "num_threads": 1}
    samplers = {f"{n} points": PdSampler(n, 0, **options) for n in sorted({*counts, configured.num_proximal})}
    costs, kept = _sampled(dict.fromkeys(samplers, cloud), samplers, sizes)
    choices = []
    for name, points in kept.items():
        read = read_heights(cloud.level(points * cloud.max_range), points.abs().sum(-1) > 0)
        error = {HEIGHT: _rmse(read, cloud.heights)}
        facts = {FRAME_BYTES: points[0].numel() * 4}
        choices.append(Choice(name, costs[name], error, name == f"{configured.num_proximal} points", facts=facts))
    flat = cloud.heights.double().std(1).mean()
    notes = (
        "Decoder: a cell of the grid has the height of the kept point that is horizontally nearest to it, the robot's"
        f" own body left out. One frame of {len(cloud.heights)} robots on terrain=mixed, whose ground varies by"
        f" {float(flat):.3f} m within a grid. Reference: the terrain's heights.",
    )
    return Study("heights", "Proximal points kept: heights", SAMPLING, HEIGHT, choices, 1e-4, notes)


def sectors_study(overrides: Sequence[str], sizes: Sizes, counts: Sequence[int] = (32, 64, 128, 216, 256)) -> Study:
    """The distal half averaged or as proximities: the nearest obstacle by sector that can be read from it."""
    recorder = Recorder(overrides, sizes.num_envs, CROWD)
    cloud, configured = recorder.frames(2)[-1], recorder.run.perception.sampler()
    split = math.degrees(configured.split)
    options = {"max_range": cloud.max_range, "split_deg": split, "num_threads": 1}
    samplers: dict[str, Sampler] = {}
    for count in counts:
        samplers[f"{count} average"] = PdSampler(0, count, ring_deg=math.degrees(configured.ring), **options)
    edges, decay = (-0.34, -0.25, -0.15, -0.05, 0.15, 0.5, 3.0), 0.5
    if isinstance(configured, ProximitySampler):
        edges, decay = tuple(configured.edges.tolist()), configured.decay
    for sectors in (18, 36):
        for bands in (edges, (edges[0], edges[2], edges[4], edges[-1])):
            name = f"{sectors} x {len(bands) - 1} proximity"
            samplers[name] = ProximitySampler(
                0, sectors, band_edges=bands, decay=decay, blind=0.3, body=BODY, **options
            )
    default = f"{configured.num_distal} average"
    if isinstance(configured, ProximitySampler):
        default = f"{configured.num_sectors} x {len(configured.edges) - 1} proximity"
    costs, kept = _sampled(dict.fromkeys(samplers, cloud), samplers, sizes)
    every = cloud.sectors.clamp(max=NEARNESS_RANGE)
    choices = []
    for name, points in kept.items():
        sampler, height = samplers[name], cloud.heights.median(1).values
        if isinstance(sampler, ProximitySampler):
            read = read_proximity(points, sampler, height)
        else:
            read = read_sectors(cloud.level(points * cloud.max_range), points.abs().sum(-1) > 0, height)
        near = cloud.true_sectors < NEAR
        errors = {
            SECTOR: _rmse(read, cloud.true_sectors.clamp(max=NEARNESS_RANGE)),
            "near sectors, RMSE (m)": _rmse(read[near], cloud.true_sectors[near]) if near.any() else 0.0,
            "against all rays kept (m)": _rmse(read, cloud.sectors.clamp(max=NEARNESS_RANGE)),
        }
        family = name.split(" ")[-1]
        choices.append(Choice(name, costs[name], errors, name == default, family, {FRAME_BYTES: points[0].numel() * 4}))
    notes = (
        f"Decoder: the nearest kept point more than {ABOVE_GROUND:g} m above the flat ground in a sector, the robot's"
        f" body left out; of proximities, the largest of the bands above it. Up to {NEARNESS_RANGE:g} m; near: within"
        f" {NEAR:g} m. Reference: obstacle hits of rays {DENSE_DEG:g} degrees apart over the whole field of view, so"
        f" that what is cut off at {split:g} degrees and what {cloud.ranges.shape[1]} rays miss counts as an error. All"
        f" rays: {_rmse(every, cloud.true_sectors.clamp(max=NEARNESS_RANGE)):.3f} m."
        f" {len(cloud.sectors)} robots among obstacles=mixed on flat ground.",
    )
    return Study("sectors", "Distal points kept: sectors", SAMPLING, SECTOR, choices, 1e-4, notes)


def history_study(overrides: Sequence[str], sizes: Sizes, histories: Sequence[int] = (1, 2, 5, 10)) -> Study:
    """How many frames the network sees in a window."""
    recorder = Recorder(overrides, sizes.num_envs, CROWD)
    perception, per_episode = recorder.run.perception, recorder.frames_per_episode
    sampler = perception.sampler()
    sampler.num_threads = 1
    clouds = recorder.frames(per_episode * sizes.episodes)
    out = torch.empty(sizes.num_envs, sampler.num_points, 3)
    frames = torch.stack([cloud.sample(sampler, out).clone() for cloud in clouds], 1)
    frames = frames.unflatten(1, (sizes.episodes, per_episode)).flatten(0, 1)[
        :, :-1
    ]  # the reset takes the last one's truth
    targets = torch.stack([cloud.true_sectors for cloud in clouds], 1).unflatten(1, (sizes.episodes, per_episode))
    targets = (1.0 - targets.flatten(0, 1)[:, -2] / NEARNESS_RANGE).clamp(min=0.0)
    held_out = torch.arange(len(frames)) >= len(frames) * 3 // 4  # other environments
    networks: dict[str, Callable[[], PerceptionNetwork]] = {
        f"window of {n}": partial(perception.network, **sampler.sizes, history=n)
        for n in sorted({*histories, perception.history} & set(range(1, per_episode)))
    }
    default = f"window of {perception.history}"
    built, errors = {}, {}
    for name, build in networks.items():
        torch.manual_seed(0)
        built[name] = build()
        _fit(built[name], frames[~held_out], targets[~held_out], sizes)
        with torch.inference_mode():
            read = _embed(built[name], frames[held_out])
        errors[name] = NEARNESS_RANGE * _rmse(read, targets[held_out])
    costs = _embedding_costs(built, frames, sizes)
    choices = []
    for name, network in built.items():
        facts = {"bytes per environment": frames[0, 0].numel() * 4 * network.history}
        choices.append(Choice(name, costs[name], {SECTOR: errors[name]}, name == default, facts=facts))
    notes = (
        f"The network as configured, {sizes.steps} steps of Adam (1e-3) on {int((~held_out).sum())} scenes of"
        f" {per_episode - 1} frames, tested on {int(held_out.sum())} others; robots stand among obstacles=mixed. Short"
        " training: it compares what is easily learnt. Reference: rays all over the field of view at the newest frame."
        " Cost: one newest embedding for 64 environments.",
    )
    return Study("history", "Frames that a network sees", EMBEDDING, SECTOR, choices, 1e-3, notes)


STUDIES: dict[str, Callable[[Sequence[str], Sizes], Study]] = {
    "farthest": farthest_study,
    "heights": heights_study,
    "sectors": sectors_study,
    "history": history_study,
}


def measure(overrides: Sequence[str], sizes: Sizes, only: Sequence[str] = ()) -> Iterator[Study]:
    """All studies, or some by name, of the configuration that the overrides compose to, as they are done."""
    yield from (study(overrides, sizes) for name, study in STUDIES.items() if not only or name in only)


def read_heights(points: torch.Tensor, used: torch.Tensor) -> torch.Tensor:
    """Base height minus ground (E, 187), m, from levelled points (E, P, 3), of which ``used`` (E, P) are points."""
    own = (points[..., 0].abs() < BODY[0]) & (points[..., 1].abs() < BODY[1])
    away = torch.cdist(height_grid().double()[None], points[..., :2])  # (E, 187, P)
    away = away.masked_fill(~(used & ~own)[:, None], math.inf)
    return -points[..., 2].gather(1, away.argmin(-1))


def read_sectors(points: torch.Tensor, used: torch.Tensor, height: torch.Tensor, num_sectors: int = 36) -> torch.Tensor:
    """Distance to the nearest point above the ground by sector, m, (E, num_sectors), from levelled points (E, P, 3)."""
    own = (points[..., 0].abs() < BODY[0]) & (points[..., 1].abs() < BODY[1])
    stands = used & ~own & (points[..., 2] > ABOVE_GROUND - height[:, None])
    distance = points[..., :2].norm(dim=-1).masked_fill(~stands, math.inf)
    sector = sector_of(points[..., :2], num_sectors)
    nearest = torch.full((len(points), num_sectors), math.inf, dtype=distance.dtype)
    return nearest.scatter_reduce(1, sector, distance, "amin").clamp(max=NEARNESS_RANGE)


def read_proximity(points: torch.Tensor, sampler: ProximitySampler, height: torch.Tensor) -> torch.Tensor:
    """The same from a proximity grid (E, bands * sectors, 3): exp(-d / decay) in its third number."""
    proximity = points[..., 2].unflatten(1, (-1, sampler.num_sectors)).double()  # (E, bands, sectors)
    above = sampler.edges[:-1].double() >= ABOVE_GROUND - height[:, None]
    nearest = proximity.masked_fill(~above[..., None], 0.0).amax(1)
    distance = (-sampler.decay * nearest.log()).clamp(max=NEARNESS_RANGE)
    return distance.repeat_interleave(36 // sampler.num_sectors, dim=1)


def _sampled(
    clouds: Mapping[str, Cloud], samplers: Mapping[str, Sampler], sizes: Sizes
) -> tuple[dict[str, float], dict[str, torch.Tensor]]:
    """CPU time per environment, us, and the points (E, P, 3) of every sampler of its cloud."""
    outs = {name: torch.empty(len(clouds[name].ranges), s.num_points, 3) for name, s in samplers.items()}
    calls = {name: (lambda _, n=name: clouds[n].sample(samplers[n], outs[n])) for name in samplers}
    timings = paired_timings(calls, sizes.rounds, block_s=sizes.block_s)
    return {name: 1e6 * t.least_cpu_s / len(clouds[name].ranges) for name, t in timings.items()}, outs


def _embedding_costs(networks: Mapping[str, PerceptionNetwork], frames: torch.Tensor, sizes: Sizes) -> dict[str, float]:
    """CPU time of the newest embedding, us per environment."""
    num_envs = 64
    some = frames[torch.arange(num_envs) % len(frames)]

    def embed(network: PerceptionNetwork) -> None:
        count = torch.full((num_envs, 1), network.history)
        with torch.inference_mode():
            network(some[:, -network.history :], count)

    calls = {name: (lambda _, n=network: embed(n)) for name, network in networks.items()}
    timings = paired_timings(calls, sizes.rounds, block_s=sizes.block_s)
    return {name: 1e6 * t.least_cpu_s / num_envs for name, t in timings.items()}


def _fit(network: PerceptionNetwork, frames: torch.Tensor, targets: torch.Tensor, sizes: Sizes) -> None:
    """Regresses the sector part of the newest embedding on the nearness (B, 36)."""
    adam, generator = torch.optim.Adam(network.parameters(), lr=1e-3), torch.Generator().manual_seed(0)
    for _ in range(sizes.steps):
        chosen = torch.randint(len(frames), (sizes.batch,), generator=generator)
        loss = (_embed(network, frames[chosen]) - targets[chosen]).square().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()


def _embed(network: PerceptionNetwork, frames: torch.Tensor) -> torch.Tensor:
    """The sector part (B, 36) of the newest embedding of sequences (B, F, P, 3)."""
    count = torch.full((len(frames), 1), network.history)
    embedding = network(frames[:, -network.history :], count)[:, 0]
    return embedding[:, network.supervised["sector_target"]]


def _radius(hits: torch.Tensor, samples: torch.Tensor) -> torch.Tensor:
    """Largest distance of a hit (n, 3) to its nearest sample (K, 3), m; slots of zeros are no samples."""
    used = samples[samples.abs().sum(-1) > 0]
    away = torch.cdist(hits.double(), used.double(), compute_mode="donot_use_mm_for_euclid_dist")
    return away.min(-1).values.max()


def _rmse(read: torch.Tensor, truth: torch.Tensor) -> float:
    return float((read.double() - truth.double()).square().mean().sqrt())
