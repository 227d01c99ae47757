"""Trains a policy: compose the configuration, assemble what it needs, learn. `run=<dir>` resumes a run, and so does a
command line whose run directory holds checkpoints of the same configuration."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from omniperception import build, config
from omniperception.build import build_runner
from omniperception.learning import (
    CheckpointError,
    RolloutTooSmall,
    TrainingDiverged,
    distributed,
    latest_checkpoint,
    list_checkpoints,
)
from omniperception.plan import describe


def learn(run: build.RunConfig, run_dir: Path, resume: bool) -> None:
    """Trains a run to its end in `run_dir`; of several processes the first one tells how it goes."""
    runner = build_runner(run, run_dir)
    if resume:
        runner.load(str(latest_checkpoint(run_dir)))
        tell(f"resuming {run_dir} after {runner.current_learning_iteration} iterations")
    else:
        for name in run.init:
            runner.start_from(config.find_run(name, "init"))
        tell(f"run directory: {run_dir}")
    plan = describe(run, runner)
    if distributed.rank() == 0:
        plan.save(run_dir)
    tell(plan.summary())
    runner.learn(max(run.ppo.max_iterations - runner.current_learning_iteration, 0), init_at_random_ep_len=not resume)
    tell(f"{runner.stop_reason}: {runner.current_learning_iteration} iterations; python play.py run={run_dir}")
    distributed.disconnect()


def tell(text: str) -> None:
    if distributed.rank() == 0:
        print(text)


@hydra.main(config_path="conf", config_name="config", version_base="1.3")
def train(composed: DictConfig) -> None:
    with config.one_line_errors(CheckpointError, RolloutTooSmall, TrainingDiverged):
        run = build.assemble(composed)
        distributed.connect(run.env.sim.torch_device)
        run_dir = distributed.of_first(Path(os.path.relpath(HydraConfig.get().runtime.output_dir)))
        begun = distributed.of_first(config.is_begun(run_dir, run.composed) and bool(list_checkpoints(run_dir)))
        if distributed.rank() == 0:
            config.save(run.composed, run_dir)
        learn(run, run_dir, resume=begun)


def resume(name: str, overrides: list[str]) -> None:
    run_dir = config.find_run(name)
    learn(build.assemble(config.load(run_dir, overrides)), run_dir, resume=True)


def main() -> None:
    arguments = sys.argv[1:]
    if any(a.startswith("-") and a not in ("-m", "--multirun") for a in arguments):
        train()  # Hydra's own flags: --help, --cfg job, --info
        return
    with config.one_line_errors(CheckpointError, RolloutTooSmall, TrainingDiverged):
        own, overrides = config.split_arguments(arguments, {"run": ""})
        if own["run"]:
            resume(own["run"], overrides)
            return
        build.check(overrides)
    train()


if __name__ == "__main__":
    main()
