"""Latency of an exported policy on one core, from sensor readings to joint targets, preprocessing included.

python scripts/benchmark_inference.py run=latest [steps=5000] [out=<folder of the exported policy>]

The readings are recorded in the run's own environment, in which the policy drives one robot; then they are timed. A
frame comes with every fifth control step or so, and costs sampling: steps with and without one are apart. Cases:
    as trained      the points that training kept of each frame
    thinned         the device's whole frame, of which the runtime keeps what training kept
    whole frame     the device's whole frame, all of it sampled
Writes latency.json beside the exported policy.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from dataclasses import replace
from pathlib import Path

import torch

from omniperception import build, config
from omniperception.common.provenance import provenance
from omniperception.deploy import DeployError, ExportedPolicy
from omniperception.deploy.export import FOLDER
from omniperception.deploy.latency import PERCENTILES, Latency, Reading, measure
from omniperception.env.env import OmniEnv
from omniperception.evaluation.exported import record

ARGUMENTS = {"run": "latest", "steps": "5000", "out": ""}
RECORDED = 250
"""Control steps that are recorded."""


def readings_of(run_dir: Path, policy: ExportedPolicy, whole_frames: bool) -> list[Reading]:
    """Recorded in an environment of the run with one robot and all obstacles."""
    run = build.assemble(config.load(run_dir, ["num_envs=1"]))
    return record(OmniEnv(replace(run.env, initial_obstacle_level=1.0)), policy, RECORDED, whole_frames)


def cases(run_dir: Path, policy: ExportedPolicy) -> dict[str, list[Reading]]:
    """What is timed, by name."""
    recorded = {"as trained": readings_of(run_dir, policy, whole_frames=False)}
    described = policy.description
    if described.perception is None:
        return recorded
    whole = readings_of(run_dir, policy, whole_frames=True)
    recorded["thinned"] = whole
    if described.perception.sampler["kind"] != "raw":
        recorded["whole frame"] = whole
    return recorded


class Thinning:
    """A policy that keeps of every frame what training kept; that is timed, too."""

    def __init__(self, policy: ExportedPolicy) -> None:
        self._policy, self.reset = policy, policy.reset

    def step(self, state, command, points) -> None:
        self._policy.step(state, command, None if points is None else self._policy.thin(points))


def use_one_core() -> str:
    """Keeps this process to one core where the system can; says so."""
    torch.set_num_threads(1)
    if not hasattr(os, "sched_setaffinity"):
        return "one thread"
    core = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {core})
    return f"core {core} alone"


def line(case: str, points: int, kind: str, figures: dict[str, float]) -> str:
    times = "".join(f"{figures[f'p{p}_ms']:9.3f}" for p in PERCENTILES)
    return f"{case:<13}{points:>8}  {kind.replace('_', ' '):<14}{figures['steps']:>7}{times}{figures['max_ms']:9.3f}"


def benchmark(run_dir: Path, folder: Path, steps: int) -> None:
    policy = ExportedPolicy.load(folder)
    timed = cases(run_dir, policy)
    where = use_one_core()
    results = {}
    headings = "".join(f"{f'p{p}':>9}" for p in PERCENTILES)
    print(f"{policy.description.provenance.get('checkpoint')}, {platform.machine()}, {where}, milliseconds")
    print(f"{'case':<13}{'points':>8}  {'step':<14}{'n':>7}{headings}{'max':>9}")
    for case, readings in timed.items():
        latency: Latency = measure(Thinning(policy) if case == "thinned" else policy, readings, steps)
        points = max((len(r.points) for r in readings if r.points is not None), default=0)
        results[case] = {"points": points, **latency.summary()}
        for kind, figures in latency.summary().items():
            print(line(case, points, kind, figures))
    report = {"cases": results, "where": where, **provenance("cpu")}
    (folder / "latency.json").write_text(json.dumps(report, indent=2) + "\n")
    print(f"wrote {folder / 'latency.json'}")


def main() -> None:
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(__doc__)
        return
    with config.one_line_errors(DeployError):
        own, overrides = config.split_arguments(sys.argv[1:], ARGUMENTS)
        if overrides:
            raise config.ConfigError(f"{overrides[0]} is unknown; known: {', '.join(ARGUMENTS)}")
        run_dir = config.find_run(own["run"])
        folder = Path(own["out"]) if own["out"] else run_dir / FOLDER
        benchmark(run_dir, folder, config.positive("steps", own["steps"], int))


if __name__ == "__main__":
    main()
