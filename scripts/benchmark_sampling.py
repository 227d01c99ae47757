"""Work and precision of farthest point sampling: time per frame for all environments against the coverage radius.

    python scripts/benchmark_sampling.py [points=256] [repeats=11] [threads=1] [overrides, e.g. num_envs=64]

Samples the proximal hits of one frame among moving obstacles, of 1000 rays and of all 20,000 rays of a Mid-360 frame
(rays=1000,20000). The coverage radius is the largest distance of a hit to its nearest sample. Exact and approximate
samplings are timed in turn, with the library fpsample where it is installed. A star marks the Pareto front.
"""

from __future__ import annotations

import sys

import omniperception  # noqa: F401  before torch, whose threads it sets up
from benchmarks.sampling_benchmark import clouds, hits_per_environment, measure, pareto
from omniperception import build, config

OWN = {"points": "256", "repeats": "11", "threads": "1", "rays": "1000,20000"}


def main() -> None:
    with config.one_line_errors():
        own, overrides = config.split_arguments(sys.argv[1:], OWN)
        points, repeats, threads = (
            int(config.positive(key, own[key], int)) for key in ("points", "repeats", "threads")
        )
        for rays in own["rays"].split(","):
            num_rays = int(config.positive("rays", rays, int))
            given = ["num_envs=64", "perception=pd_risknet", f"lidar.num_rays={num_rays}", *overrides]
            run = build.assemble(config.compose(given))
            frame, max_range = clouds(run), run.env.lidar.max_range
            print(
                f"\n{len(frame.ranges)} environments x {num_rays} rays, {hits_per_environment(frame, max_range):.0f}"
                f" proximal hits each, to {points} points, {threads} threads\n"
            )
            rows = measure(frame, points, max_range, repeats, threads)
            front = pareto(rows)
            print("| sampling | ms per frame | coverage radius (m) | to exact | mean distance (m) | |")
            print("|---|---|---|---|---|---|")
            for row in rows:
                cells = (
                    f"{row.milliseconds:.2f}",
                    f"{row.radius:.3f}",
                    f"{row.radius_ratio:.2f}",
                    f"{row.mean_distance:.3f}",
                )
                print(f"| {row.name} | {' | '.join(cells)} | {'*' if row.name in front else ''} |")


if __name__ == "__main__":
    main()
