"""One PPO update with shared frames against one with every step's whole window through nn.GRU, on the same rollout.

    python scripts/benchmark_update.py [num_envs=64] [num_steps=24] [num_epochs=5] [repeats=5] [policy=small|paper]

PD-RiskNet of the paper: 256 + 128 points, 10 frames, LiDAR at a fifth of the control rate. `policy`: hidden layers of
actor and critic, [256, 128, 64] or the paper's [1024, 512, 256, 128], which cost the same in both formulations.
The two are timed in turn; the ratio is the median of the pairs.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable

import omniperception  # noqa: F401  before torch, whose threads it sets up

# isort: split
import torch

from benchmarks.update_benchmark import (
    UpdateCase,
    UpdatePair,
    build,
    differences,
    embedding_seconds,
    rollout_bytes,
    seconds,
)
from omniperception import config
from omniperception.learning import PerceptivePpo

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
    sizes = [f"rollout {rollout_bytes(algorithm) / 1e6:8.1f} MB" for algorithm in (pair.shared, pair.stepwise)]
    print(f"shared frames: {sizes[0]}; window per step: {sizes[1]}")
    report("update", seconds, pair, repeats)
    report("perception network, one mini-batch", embedding_seconds, pair, repeats)


def report(name: str, timed: Callable[[PerceptivePpo], float], pair: UpdatePair, repeats: int) -> None:
    """Times both formulations in turn and prints the medians."""
    timed(pair.shared), timed(pair.stepwise)
    pairs = [(timed(pair.shared), timed(pair.stepwise)) for _ in range(repeats)]
    ratios = sorted(theirs / ours for ours, theirs in pairs)
    ours, theirs = (1e3 * statistics.median(p[k] for p in pairs) for k in (0, 1))
    print(
        f"{name}: shared frames {ours:.1f} ms, window per step {theirs:.1f} ms, ratio {statistics.median(ratios):.2f}"
        f" (median of {repeats} pairs, {ratios[0]:.2f} to {ratios[-1]:.2f})"
    )


if __name__ == "__main__":
    main()
