"""Names of policies and splits, and settings of an evaluation. Command lines read them before PyTorch is loaded."""

from dataclasses import dataclass
from pathlib import Path

from omnirobot.common.cli import RESULTS, argument, trust

BASELINES = {
    "blind": "the run's policy as it acts before its first frame: it never has one",
    "stop": "the gait follows V_cmd, which falls to zero while the raw noisy cloud has something near ahead",
    "histogram": "the gait follows V_cmd + V_avoid, V_avoid by the run's avoidance controller from the raw noisy cloud"
    " by geometry: nearest return by sector, ground removed, velocities from successive frames, nothing learned",
    "ground_truth": "the gait follows what the run's navigation policy asks for, given the true places and velocities"
    " of all obstacles",
    "oracle": "the gait follows V_cmd + V_avoid, V_avoid by the run's avoidance controller from the true places and"
    " velocities of all obstacles",
}
"""Policies to compare with; the gait is the run's own, which then sees nothing, or that of another run."""

DRIVEN = ("stop", "histogram", "ground_truth", "oracle")
"""Those that drive a gait by its command."""

POLICIES = {
    "run": "the run's policy",
    **BASELINES,
    "exported": "the run's exported policy on what a robot measures: onnxruntime",
}
"""Policies to evaluate; the gait is the run's own, which then sees nothing, or that of `walker`."""

SPLITS = ("dev", "test")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What a command line says of an evaluation as `suite.Evaluation` takes it."""

    split: str = argument("dev", "obstacles and seeds for choosing, or for reporting", choices=SPLITS)
    condition: str | None = argument("ideal", "preset of conf/condition; null: the run's own randomization")
    trials: int = argument(250, "trials of each policy in each world", least=1)
    num_envs: int = argument(64, "environments at a time in each process", least=1)
    jobs: int | None = argument(
        None, "worlds at a time, in a process of one thread each; null: as many as cores, 1 on a GPU", least=1
    )
    plots: bool = argument(False, "whether the worlds are drawn from above, with the ways")
    again: bool = argument(False, "whether to measure again what has been measured before")
    out: Path | None = argument(None, "file that the results are added to, for tables", suffixes=RESULTS)
    log: Path | None = argument(None, "where split=test is noted; null: docs/lab/evaluations.jsonl of the checkout")
    trust: tuple[str, ...] = trust()
