"""CPU time of the samplers and rings in the form that a CPU uses, and in the other forms that are kept beside it.

    python -m benchmarks.one_form num_envs=256 rays=1000,2000,20000

Samplers: all rays sorted at once as on a GPU, against one thread for each environment. Farthest points: every point
against buckets. Rings: operations that can be exported against the kernel. One thread, random clouds, 20 % misses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.harness.table import Table, about, report
from benchmarks.harness.timing import paired_ratio, paired_timings
from omniperception.cli import Command, argument
from omniperception.perception import Attitude, FpsSampler, PdSampler, ProximitySampler, Sampler
from omniperception.perception.networks import rings
from omniperception.perception.samplers import sorting

HALVES = {"max_range": 6.0, "split_deg": 20.0, "ring_deg": 9.0, "num_threads": 1}
CELLS = {"band_edges": (-0.34, -0.25, -0.15, -0.05, 0.15, 0.5, 3.0), "decay": 0.5, "blind": 0.3, "body": (0.5, 0.28)}
SAMPLERS: dict[str, Callable[[], Sampler]] = {
    "pd_risknet: 256 + 128": lambda: PdSampler(256, 128, **HALVES),
    "proximity_gru: 64 + 36 x 6": lambda: ProximitySampler(64, 36, **HALVES, **CELLS),
    "fps_gru_small: 280": lambda: FpsSampler(280, max_range=6.0, ring_deg=9.0, num_threads=1),
}


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    num_envs: int = argument(256, "environments", least=1)
    rays: tuple[int, ...] = argument((1000, 2000, 20000), "rays per frame", least=1)
    rounds: int = argument(9, "rounds in which each form is timed once", least=1)
    out: Path = argument(Path("outputs/one_form"), "folder of the tables")


def random_rays(num_envs: int, num_rays: int) -> tuple[torch.Tensor, ...]:
    """Ranges, directions, elevation (-7 to 52 degrees, as of a Mid-360) and azimuth of random clouds."""
    generator = torch.Generator().manual_seed(0)
    theta, phi, share = torch.rand(3, num_envs, num_rays, generator=generator)
    theta, phi = torch.deg2rad(59.0 * theta - 7.0), 2 * torch.pi * phi
    directions = torch.stack((theta.cos() * phi.cos(), theta.cos() * phi.sin(), theta.sin()), -1)
    ranges = torch.where(share < 0.2, torch.inf, 0.2 + 5.8 * (share - 0.2) / 0.8)
    return ranges, directions, theta, phi


def compared(name: str, size: str, kept: Callable, other: Callable, rounds: int) -> dict[str, object]:
    """A row: CPU time of both forms, and their ratio."""
    times = paired_timings({"kept": lambda _: kept(), "other": lambda _: other()}, rounds)
    ratio = paired_ratio(times["other"], times["kept"], "cpu")
    ms = (1e3 * times[form].median_cpu_s for form in ("kept", "other"))
    return {
        "operation": name,
        "size": size,
        **dict(zip(("used on a CPU, ms", "other form, ms"), ms, strict=True)),
        "ratio": str(ratio),
    }


def rows(given: Arguments) -> Iterator[dict[str, object]]:
    """All comparisons."""
    torch.set_num_threads(1)
    for num_rays in given.rays:
        size, cloud = f"{given.num_envs} x {num_rays}", random_rays(given.num_envs, num_rays)
        level = Attitude(torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(given.num_envs, 1), (0.3, 0.0, 0.0), (1, 0, 0, 0))
        for name, make in SAMPLERS.items():
            ours, at_once = make(), make()
            out = torch.empty(given.num_envs, ours.num_points, 3)
            used_on = sorting.SORT_ALL_RAYS_ON

            def sorted_at_once(sampler=at_once, cloud=cloud, out=out, level=level, used_on=used_on) -> None:
                sorting.SORT_ALL_RAYS_ON = ("cpu",)
                sampler(*cloud, out, level)
                sorting.SORT_ALL_RAYS_ON = used_on

            call = lambda s=ours, c=cloud, o=out, a=level: s(*c, o, a)  # noqa: E731
            yield compared(f"{name}, rays sorted at once", size, call, sorted_at_once, given.rounds)
        buckets, plain = (SAMPLERS["fps_gru_small: 280"]() for _ in range(2))
        buckets.buckets_from, plain.buckets_from = 1, 10**9
        out = torch.empty(given.num_envs, buckets.num_points, 3)
        calls = [lambda s=s, c=cloud, o=out: s(*c, o) for s in (buckets, plain)]
        yield compared("280 farthest points, every point against buckets", size, *calls, given.rounds)
    for envs, windows in ((given.num_envs, 1), (given.num_envs // 4, 6)):
        frames, shape = 4 + windows, rings.RingShape(36, 5, 0.5, (0.5, 2.0))
        bearing = 2 * torch.pi * torch.rand(envs, frames, 216)
        proximity = torch.exp(-8.0 * torch.rand(envs, frames, 216)) * (torch.rand(envs, frames, 216) < 0.4)
        cells = torch.stack((bearing.cos() * proximity, bearing.sin() * proximity, proximity), -1)
        inputs = cells, 0.05 * torch.randn(envs, frames, 3), torch.full((envs, windows), 5), shape
        calls = [lambda f=f, i=inputs: f(*i) for f in (rings.moved_rings, rings._moved_rings)]
        yield compared("rings, exportable operations", f"{envs} x {windows} windows", *calls, given.rounds)


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    report([Table.of("one_form", "forms of one operation", list(rows(given)))], about(1), given.out)


command = Command(main, Arguments, __doc__)

if __name__ == "__main__":
    command()
