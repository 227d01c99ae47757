"""One PPO update with shared frames against one with every step's whole window through nn.GRU, on the same rollout.

    python scripts/benchmark_update.py [num_envs=64] [num_steps=24] [num_epochs=5] [repeats=5] [policy=small|paper]

PD-RiskNet of the paper: 256 + 128 points, 10 frames, LiDAR at a fifth of the control rate. `policy`: hidden layers of
actor and critic, [256, 128, 64] or the paper's [1024, 512, 256, 128], which cost the same in both formulations.
The two are timed in turn; the ratio is the median of the pairs.
"""

from __future__ import annotations

import statistics
import sys

import omniperception  # noqa: F401  before torch, whose threads it sets up

# isort: split
import torch

from omniperception import config
from omniperception.analysis.update_benchmark import UpdateCase, build, differences, rollout_bytes, seconds

POLICIES = {"small": (256, 128, 64), "paper": (1024, 512, 256, 128)}
OWN = {"num_envs": "64", "num_steps": "24", "num_epochs": "5", "repeats": "5", "policy": "small"}


def main() -> None:
    with config.one_line_errors():
        own, rest = config.split_arguments(sys.argv[1:], OWN)
        if rest:
            raise config.ConfigError(f"unknown argument '{rest[0]}'; known: {', '.join(OWN)}")
        if own["policy"] not in POLICIES:
            raise config.ConfigError(f"policy={own['policy']} must be one of {', '.join(POLICIES)}")
        sizes = {key: int(config.positive(key, own[key], int)) for key in ("num_envs", "num_steps", "num_epochs")}
        repeats = int(config.positive("repeats", own["repeats"], int))
    case = UpdateCase(**sizes, hidden_dims=POLICIES[own["policy"]])
    print(f"{case}, {torch.get_num_threads()} torch threads, torch {torch.__version__}")
    pair = build(case)
    features, gradients = differences(pair)
    print(f"relative difference: features {features:.1e}, gradients {gradients:.1e}")
    seconds(pair.shared), seconds(pair.stepwise)
    pairs = [(seconds(pair.shared), seconds(pair.stepwise)) for _ in range(repeats)]
    ratios = sorted(theirs / ours for ours, theirs in pairs)
    for name, algorithm, k in (("shared frames", pair.shared, 0), ("window per step", pair.stepwise, 1)):
        time = statistics.median(p[k] for p in pairs)
        print(f"{name:<16} {1e3 * time:9.1f} ms per update, rollout {rollout_bytes(algorithm) / 1e6:8.1f} MB")
    print(
        f"ratio            {statistics.median(ratios):9.2f} (median of {repeats} pairs, {ratios[0]:.2f} to"
        f" {ratios[-1]:.2f})"
    )


if __name__ == "__main__":
    main()
