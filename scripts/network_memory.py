"""What training each perception network needs: parameters, optimiser, rollout, and whether it fits.

    python scripts/network_memory.py [budget_gb=24] [overrides, e.g. experiment=paper lidar.num_rays=20000]

Nothing is allocated: networks run on torch's meta device. Policy, critic, physics and rays are not counted. Of the raw
cloud there is a second row, as a storage without shared frames would have it: every control step's whole window kept.
"""

from __future__ import annotations

import sys

import omniperception  # noqa: F401  before torch, whose threads it sets up
from benchmarks.network_memory import footprint_of_windows, largest_cloud
from omniperception import build, config
from omniperception.build import steps_per_frame
from omniperception.evaluation.ablation import VARIANTS, overrides_of
from omniperception.learning.memory import GB, Footprint, footprint

COLUMNS = ("parameters", "weights, Adam", "sensor", "rollout", "mini-batch", "total", "verdict")


def row(name: str, needs: Footprint, budget: float) -> str:
    sizes = (needs.optimization, needs.sensor, needs.rollout, needs.mini_batch, needs.total)
    cells = [f"{needs.parameters / 1e6:.2f} M", *(f"{size / GB:.3f}" for size in sizes)]
    verdict = "fits" if needs.total <= budget else "OUT OF MEMORY"
    return f"| {name} | {' | '.join(cells)} | {verdict} |"


def main() -> None:
    with config.one_line_errors():
        own, overrides = config.split_arguments(sys.argv[1:], {"budget_gb": "24"})
        budget = config.positive("budget_gb", own["budget_gb"], float) * GB
        overrides = overrides or ["experiment=paper"]
        lines, largest = [], []
        for name in sorted({*config.presets("perception"), *VARIANTS}):
            if name == "none":
                continue
            run = build.assemble(config.compose([*overrides, *overrides_of(name)]))
            sizes = (run.perception, run.ppo, run.env.num_envs, steps_per_frame(run))
            lines.append(row(name, footprint(*sizes), budget))
            if name == "direct_mlp":
                lines.append(row(f"{name}, window per step", footprint_of_windows(*sizes), budget))
                largest = [largest_cloud(*sizes, budget), largest_cloud(*sizes, budget, footprint_of_windows)]
    print(
        f"{' '.join(overrides)}: {sizes[2]} environments x {run.ppo.num_steps_per_env} steps, a frame every {sizes[3]},"
        f" {run.ppo.num_mini_batches} mini-batches, {run.env.lidar.num_rays} rays; GB (10^9 bytes), limit"
        f" {budget / GB:g}\n"
    )
    print(f"| perception | {' | '.join(COLUMNS)} |\n|{'---|' * (1 + len(COLUMNS))}")
    print("\n".join(lines))
    print(f"\ndirect_mlp fits up to {largest[0]:,} rays per frame; with a window per step up to {largest[1]:,}")


if __name__ == "__main__":
    main()
