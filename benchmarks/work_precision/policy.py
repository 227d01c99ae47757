"""Work and precision of trained policies: how often they arrive untouched, against the time of a control step."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from benchmarks.harness.pareto import Choice, Study
from benchmarks.harness.timing import paired_timings
from omniperception import build, config
from omniperception.deploy.export import FOLDER as EXPORTED
from omniperception.env.env import OmniEnv
from omniperception.evaluation.report.records import FOLDER as EVALUATION
from omniperception.evaluation.report.records import read
from omniperception.evaluation.trials.exported import record
from omniperception.evaluation.trials.outcomes import Episodes
from omniperception.evaluation.trials.statistics import rate
from omniperception.learning import latest_checkpoint
from omniperception.learning.checkpoint import load_checkpoint
from omnirobot.common.shell import command_line
from omnirobot.runtime import ExportedPolicy

COST = "CPU time of a control step, exported (us)"
FAILED = "trials without success or with a touch (%)"
RECORDED = 50
"""Control steps whose readings are used for timing, a multiple of a frame's."""
AS_IT_STANDS = re.compile(r"dev-ideal-.*-run-(?P<trials>\d+)\.json")
"""Files of `evaluate` without overrides, a hash of which would stand before the number of trials."""


@dataclass(frozen=True)
class Sizes:
    """How often each policy is timed, in turn, and about how long at once, s."""

    rounds: int = 7
    block_s: float = 0.1


SMALL = Sizes(2, 0.002)


@dataclass(frozen=True)
class TrainedRun:
    """A run directory whose policy has been evaluated and exported.

    Attributes:
        path: The directory.
        name: What tables call it.
    """

    path: Path
    name: str

    def scenarios(self) -> dict[str, Episodes]:
        """What scripts/evaluate.py measured of the run's own policy as it stands, on split=dev, by world."""
        named = {path: AS_IT_STANDS.fullmatch(path.name) for path in (self.path / EVALUATION).glob("*.json")}
        files = sorted((int(match["trials"]), path) for path, match in named.items() if match)  # the most trials last
        found = {record.place: record.episodes for _, path in files for record in read(path)}
        if not found:
            raise config.ConfigError(
                f"runs: {self.path} has not been evaluated; first:"
                f" {command_line('evaluate', f'run={self.path}', 'scenario=all')}"
            )
        return found

    @cached_property
    def exported(self) -> ExportedPolicy:
        """What scripts/export.py wrote."""
        folder = self.path / EXPORTED
        if not folder.is_dir():
            raise config.ConfigError(
                f"runs: {self.path} has not been exported; first: {command_line('export', f'run={self.path}')}"
            )
        return ExportedPolicy.load(folder, safety=None)

    def facts(self) -> dict[str, float]:
        """Weights of the actor, and how long its training took."""
        state = load_checkpoint(latest_checkpoint(self.path), "cpu")
        weights = (v for k, v in state["actor_state_dict"].items() if "normalizer" not in k)
        return {
            "parameters": float(sum(tensor.numel() for tensor in weights)),
            "training (min)": state.get("total_time", math.nan) / 60.0,  # a published run does not tell
        }

    def stepper(self) -> Callable[[int], None]:
        """Control steps through readings recorded in an environment of the run; called with their number."""
        run = build.assemble(config.load(self.path, ["num_envs=1"]))
        env = OmniEnv(replace(run.env, skip_curricula=True))
        policy, readings = self.exported, record(env, self.exported, RECORDED, whole_frames=False)

        def step(number: int) -> None:
            reading = readings[number % RECORDED]
            policy.step(reading.state, reading.command, reading.points)

        return step


def trained_runs(names: Sequence[str]) -> list[TrainedRun]:
    """Run directories by path, named by their paths below the folder that they share."""
    paths = [config.find_run(name) for name in names]
    shared = os.path.commonpath([path.resolve().parent for path in paths]) if paths else ""
    return [TrainedRun(path, str(path.resolve().relative_to(shared))) for path in paths]


def evaluated_runs() -> list[str]:
    """All run directories under outputs/ with an evaluation and an exported policy."""
    runs = sorted(file.parent for file in config.OUTPUTS.glob(f"**/{config.CONFIG_FILE}"))
    return [str(run) for run in runs if (run / EVALUATION).is_dir() and (run / EXPORTED).is_dir()]


def measure(names: Sequence[str], sizes: Sizes, default: str = "") -> Iterator[Study]:
    """One study per scenario that some run has been evaluated in.

    Args:
        names: Run directories; all that are evaluated and exported if empty.
        sizes: How much is measured.
        default: The run directory that counts as the default, or none.
    """
    runs = trained_runs(names or evaluated_runs())
    if not runs:
        raise config.ConfigError(
            "runs= names no run, and outputs/ has none that is evaluated and exported; first:"
            f" {command_line('evaluate', 'scenario=all')}; then: {command_line('export')}"
        )
    reports, facts = {run.name: run.scenarios() for run in runs}, {run.name: run.facts() for run in runs}
    timings = paired_timings({run.name: run.stepper() for run in runs}, sizes.rounds, block_s=sizes.block_s)
    chosen = config.find_run(default).resolve() if default else None
    for scenario in sorted({name for report in reports.values() for name in report}):
        choices = [
            Choice(
                run.name,
                1e6 * timings[run.name].least_cpu_s,
                rates_of(reports[run.name][scenario]),
                run.path.resolve() == chosen,
                facts={**facts[run.name], "trials": len(reports[run.name][scenario])},
            )
            for run in runs
            if scenario in reports[run.name]
        ]
        notes = (
            "Rates by scripts/evaluate.py; low and high are the ends of Wilson's 95 % interval of the deciding rate."
            " Time: mean over control steps, least of the rounds, with and without a frame, sampling included.",
        )
        title = f"Trained policies: {scenario}"
        yield Study(f"policy_{scenario}", title, COST, FAILED, choices, 0.1, notes)


def rates_of(episodes: Episodes) -> dict[str, float]:
    """Errors, in percent, of a policy."""
    rates = {name: rate(happened) for name, happened in episodes.happened().items()}
    untouched = rates["untouched"]
    return {
        FAILED: 100.0 * (1.0 - untouched["rate"]),
        "low (%)": 100.0 * (1.0 - untouched["high"]),
        "high (%)": 100.0 * (1.0 - untouched["low"]),
        "no success (%)": 100.0 * (1.0 - rates["success"]["rate"]),
        "collision (%)": 100.0 * rates["collision"]["rate"],
        "fall (%)": 100.0 * rates["fall"]["rate"],
    }
