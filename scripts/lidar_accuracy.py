"""How far the LiDAR toolkit's ranges are from mj_ray in float64, by kind of shape, place and size, and what leaks.

    python scripts/lidar_accuracy.py [rays=1000000] [seed=0] [only=mesh]

A range is right within 1e-5 of it plus 1e-5 m. A ray that is not right is explained if mj_ray itself changes its mind
within 1e-4 rad of it, or within 1e-5 m of its origin (1e-4 m for bodies of 1 km). `error` is in units of the tolerance.
Exit status 1 if a share is below 99.99 %, a ray is unexplained, or a ray leaves a closed room.
"""

from __future__ import annotations

import sys

import mujoco
import warp as wp

from benchmarks.lidar_accuracy import cases, compare, leaks

OPTIONS = {"rays": "1000000", "seed": "0", "only": ""}
BAR = 0.9999


def main(arguments: list[str]) -> int:
    given = dict(argument.partition("=")[::2] for argument in arguments)
    if unknown := set(given) - set(OPTIONS):
        print(f"{sorted(unknown)} must be among {', '.join(f'{key}=' for key in OPTIONS)}", file=sys.stderr)
        return 2
    options = OPTIONS | given
    rays, seed = int(options["rays"]), int(options["seed"])
    print(f"Reference: mj_ray of MuJoCo {mujoco.__version__}, float64. Rays: Warp {wp.__version__} on the CPU.\n")
    print(f"{'case':26}{'rays':>9}{'hits':>6}{'within':>11}{'hit/miss':>9}{'explained':>10}{'unexplained':>12}", end="")
    print(f"{'error':>8}{'explained':>10}")
    good = True
    for case in cases():
        if options["only"] not in case.name:
            continue
        tally = compare(case, rays, seed)
        good &= tally.share_within >= BAR and tally.unexplained == 0
        print(
            f"{case.name:26}{tally.rays:9d}{tally.hits / tally.rays:6.0%}{tally.share_within:11.5%}"
            f"{tally.disagreements:9d}{tally.explained:10d}{tally.unexplained:12d}"
            f"{tally.worst[0]:8.2f}{tally.worst[1]:10.2f}",
            flush=True,
        )
        for example in tally.examples:
            print(f"    {example}")
    print()
    for leak in leaks(rays, seed):
        if options["only"] in leak.name:
            good &= leak.escaped == 0
            print(f"closed room, {leak.name}: {leak.escaped} of {leak.rays} rays escaped", flush=True)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
