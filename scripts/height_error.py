"""Error of a run's perceived heights on terrain and obstacles that its training has not seen.

    python scripts/height_error.py run=latest [num_envs=128] [steps=500] [overrides]

Unless overridden: terrain=mixed with another seed, robots on tiles of all difficulties, all kinds of obstacles in other
sizes. Prints root mean squared errors in cm with 95 % intervals, and writes heights.json into the run's evaluation
folder.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict

from omniperception import build, config
from omniperception.build import build_runner
from omniperception.common.provenance import provenance
from omniperception.evaluation.heights import HeightErrors, height_errors
from omniperception.evaluation.suite import FOLDER
from omniperception.learning import CheckpointError, latest_checkpoint

ARGUMENTS = {"run": "latest", "num_envs": "128", "steps": "500"}
HELD_OUT = (
    "terrain=mixed",
    "terrain.seed=1000",
    "terrain.curriculum=null",
    "obstacles=all",
    "obstacles.shape_seed=1000",
)
MEASURED = "perception.height_weight=1"
"""Whatever the last stage of the training was supervised with."""


def table(errors: HeightErrors) -> str:
    """Errors in cm, a row per predictor."""
    lines = ["| predictor | RMSE, cm | nearer than 0.3 m | 0.3 to 0.6 m | beyond |", "|---|---|---|---|---|"]
    for name, value in errors.rmse.items():
        rings = " | ".join(f"{100 * ring:.2f}" for ring in errors.by_distance[name])
        lines.append(f"| {name} | {100 * value:.2f} +- {100 * errors.half_width[name]:.2f} | {rings} |")
    return "\n".join(lines)


def main() -> None:
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(__doc__)
        return
    with config.one_line_errors(CheckpointError):
        own, overrides = config.split_arguments(sys.argv[1:], ARGUMENTS)
        run_dir = config.find_run(own["run"])
        if not config.load(run_dir).perception:
            raise config.ConfigError(f"run={own['run']} sees nothing; give a run with perception")
        num_envs, steps = (config.positive(key, own[key], int) for key in ("num_envs", "steps"))
        run = build.assemble(
            config.load(run_dir, [*HELD_OUT, MEASURED, "seed=1000", *overrides, f"num_envs={num_envs}"])
        )
        runner = build_runner(run, None)
        checkpoint = latest_checkpoint(run_dir)
        runner.load_policy(checkpoint)
        policy = runner.policy
        try:
            errors = height_errors(runner.env, policy, runner.alg.actor, steps)
        except ValueError as error:
            raise config.ConfigError(str(error)) from None
        record = {"checkpoint": checkpoint.name, "overrides": overrides, **asdict(errors), **provenance("cpu")}
        (run_dir / FOLDER).mkdir(exist_ok=True)
        (run_dir / FOLDER / "heights.json").write_text(json.dumps(record, indent=2) + "\n")
        print(f"{errors.frames} frames of {checkpoint.name}:\n{table(errors)}")


if __name__ == "__main__":
    main()
