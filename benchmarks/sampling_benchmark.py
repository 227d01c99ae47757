"""Farthest point sampling against its approximations: how well a cloud is covered, and in what time."""

from __future__ import annotations

import importlib
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from omniperception.build import RunConfig
from omniperception.env.env import OmniEnv
from omniperception.lidar import LidarFrame
from omniperception.perception import PdSampler

SPLIT_DEG = 20.0
"""Elevation above which a hit is proximal, as in the presets."""
NEVER = 10**9
Method = Callable[[], torch.Tensor]
"""Samples all environments' clouds; (N, K, 3) points in metres."""


@dataclass(frozen=True)
class Row:
    """One way to sample.

    Attributes:
        name: of the way.
        milliseconds: per frame, for all environments; median.
        radius: mean over environments of the coverage radius (m): the largest distance of a hit to its nearest sample.
        radius_ratio: mean over environments of that radius over the exact sampling's.
        mean_distance: mean distance (m) of a hit to its nearest sample.
    """

    name: str
    milliseconds: float
    radius: float
    radius_ratio: float
    mean_distance: float


def clouds(run: RunConfig, num_steps: int = 12) -> LidarFrame:
    """A frame of all environments of a run among all its obstacles, after some steps of random actions."""
    env = OmniEnv(replace(run.env, initial_obstacle_level=1.0))
    with torch.inference_mode():
        for _ in range(num_steps):
            env.step(0.2 * torch.randn(env.num_envs, env.num_actions))
    return env.sensing.frame


def measure(frame: LidarFrame, num_points: int, max_range: float, repeats: int, num_threads: int | None) -> list[Row]:
    """Every method on the proximal hits of a frame, timed in turn; the first is the exact one.

    Args:
        frame: rays of N environments.
        num_points: K.
        max_range: metres, of the sensor.
        repeats: times that each method is timed.
        num_threads: CPU threads of the samplers; all by default. Peers have one.
    """
    hits = _hits(frame, max_range)
    methods = _ours(frame, num_points, max_range, num_threads) | _peers(hits, num_points)
    samples = {name: method().clone() for name, method in methods.items()}
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(repeats):
        for name, method in methods.items():
            start = time.perf_counter()
            method()
            seconds[name].append(time.perf_counter() - start)
    distances = {name: [_nearest(h, s) for h, s in zip(hits, sample, strict=True)] for name, sample in samples.items()}
    radii = {name: torch.stack([d.max() for d in of]) for name, of in distances.items()}
    exact = next(iter(radii.values()))
    return [
        Row(
            name,
            1e3 * statistics.median(seconds[name]),
            radii[name].mean().item(),
            (radii[name] / exact).mean().item(),
            torch.cat(distances[name]).mean().item(),
        )
        for name in methods
    ]


def pareto(rows: list[Row]) -> set[str]:
    """Names of the rows of which no other is faster and covers as well, to two digits of the ratio."""
    return {
        row.name
        for row in rows
        if not any(
            other.milliseconds <= row.milliseconds
            and round(other.radius_ratio, 2) <= round(row.radius_ratio, 2)
            and other is not row
            for other in rows
        )
    }


def hits_per_environment(frame: LidarFrame, max_range: float) -> float:
    """Mean number of proximal hits."""
    return statistics.mean(len(h) for h in _hits(frame, max_range))


def _ours(frame: LidarFrame, k: int, max_range: float, num_threads: int | None) -> dict[str, Method]:
    """Exact sampling by looking at every point and by buckets; from some hits only.

    Choosing those hits is not timed.
    """
    ranges, rest = frame.ranges, (frame.directions_s, frame.elevation, frame.azimuth)

    def method(ranges: torch.Tensor, buckets_from: int | None = None) -> Method:
        sampler = PdSampler(k, 0, max_range=max_range, split_deg=SPLIT_DEG, num_threads=num_threads)
        if buckets_from is not None:
            sampler.buckets_from = buckets_from
        out = torch.empty(len(ranges), k, 3)

        def sample() -> torch.Tensor:
            sampler(ranges, *rest, out)
            return out * max_range

        return sample

    ours = {"exact": method(ranges), "exact, every point": method(ranges, buckets_from=NEVER)}
    ours["exact, by bucket"] = method(ranges, buckets_from=1)
    for factor in (8, 4, 2):
        ours[f"stride to {factor} K, then exact"] = method(_strided(frame, factor * k))
    ours["stride"] = method(_strided(frame, k))
    ours["random"] = method(_strided(frame, k, torch.randperm(ranges.shape[1])))
    return ours


def _strided(frame: LidarFrame, num_hits: int, order: torch.Tensor | None = None) -> torch.Tensor:
    """(N, R) ranges with only so many proximal hits, evenly spaced in ray order or in another one."""
    order = torch.arange(frame.ranges.shape[1]) if order is None else order
    kept = frame.ranges.clone()
    for row, mask in zip(kept, _proximal(frame), strict=True):
        hits = order[mask[order]]
        chosen = hits[torch.linspace(0, len(hits) - 1, num_hits).round().long()] if len(hits) > num_hits else hits
        gone = mask.clone()
        gone[chosen] = False
        row[gone] = torch.inf
    return kept


def _peers(hits: list[torch.Tensor], k: int) -> dict[str, Method]:
    """The peer library fpsample, if it is installed, one cloud at a time as it offers."""
    try:
        fpsample = importlib.import_module("fpsample")
    except ImportError:
        return {}
    arrays = [h.numpy() for h in hits]
    functions = {
        "fpsample exact": lambda cloud: fpsample.fps_sampling(cloud, k, start_idx=0),
        "fpsample NPDU": lambda cloud: fpsample.fps_npdu_sampling(cloud, k, start_idx=0),
        "fpsample buckets, h 3": lambda cloud: fpsample.bucket_fps_kdline_sampling(cloud, k, 3, start_idx=0),
        "fpsample buckets, h 5": lambda cloud: fpsample.bucket_fps_kdline_sampling(cloud, k, 5, start_idx=0),
    }

    def method(function: Callable) -> Method:
        def sample() -> torch.Tensor:
            picked = [cloud[function(cloud)] if len(cloud) > k else cloud for cloud in arrays]
            padded = torch.zeros(len(picked), k, 3)
            for row, points in zip(padded, picked, strict=True):
                row[: len(points)] = torch.from_numpy(points)
            return padded

        return sample

    return {name: method(function) for name, function in functions.items()}


def _hits(frame: LidarFrame, max_range: float) -> list[torch.Tensor]:
    """Each environment's proximal hits (n, 3), metres."""
    points = frame.ranges.clamp(max=max_range)[..., None] * frame.directions_s
    return [cloud[mask].contiguous() for cloud, mask in zip(points, _proximal(frame), strict=True)]


def _proximal(frame: LidarFrame) -> torch.Tensor:
    """(N, R) which rays are proximal hits."""
    return torch.isfinite(frame.ranges) & (frame.elevation > torch.pi / 180 * SPLIT_DEG)


def _nearest(cloud: torch.Tensor, samples: torch.Tensor) -> torch.Tensor:
    """(n,) distance of each hit to the nearest sample; unused slots are zeros, which are no samples."""
    used = samples[samples.abs().sum(-1) > 0]
    return torch.cdist(cloud.double(), used.double(), compute_mode="donot_use_mm_for_euclid_dist").min(-1).values
