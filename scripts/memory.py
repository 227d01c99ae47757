"""How much memory a run needs, by part, and how much it uses.

    python scripts/memory.py [measure=false] [overrides, e.g. experiment=paper sim=mujoco_warp num_envs=4096]

Physics, rays, task, rollout and networks are counted from two builds with a handful of environments, so that a run can
be judged that fits nowhere; the update's mini-batch is reckoned. Not counted: what the engines take for the duration of
a call. `measure=true` trains the run at its real size for two iterations and prints what it has used.
"""

from __future__ import annotations

import sys

import omniperception  # noqa: F401  before torch, whose threads it sets up

# isort: split
from benchmarks.memory import measure, predict, table
from omniperception import build, config
from omniperception.learning.memory import device_bytes


def main() -> None:
    with config.one_line_errors():
        own, overrides = config.split_arguments(sys.argv[1:], {"measure": "false"})
        if own["measure"] not in ("true", "false"):
            raise config.ConfigError(f"measure={own['measure']} must be true or false")
        run = build.assemble(config.compose(overrides or ["experiment=paper"]))
        rows = table(predict(run), run.env.num_envs)
        used = measure(run) if own["measure"] == "true" else None
    device = run.env.sim.torch_device
    print(f"{' '.join(overrides) or 'experiment=paper'}: {run.env.num_envs} environments, on {device}\n")
    print("| part | MB shared | kB per environment | MB |\n|---|---|---|---|")
    for name, shared, per_env, total in rows:
        print(f"| {name} | {shared:z.1f} | {per_env:z.1f} | {total:z.0f} |")
    everything = device_bytes(device)
    if everything:
        print(f"\n{rows[-1][3] / 1e3:.2f} GB of {everything / 1e9:.1f} GB")
    if used is not None:
        ratio = used.peak / 1e6 / rows[-1][3]
        print(
            f"used: {used.held / 1e6:.0f} MB held, {used.peak / 1e6:.0f} MB at most ({used.source}): {ratio:.2f} times"
        )


if __name__ == "__main__":
    main()
