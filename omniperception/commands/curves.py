"""Draws learning curves from the TensorBoard files of runs: the mean over seeds, and how far they lie apart.

    curves runs=outputs/2026-01-31
    curves runs=sweep/1,sweep/2,other tags=Metrics/velocity_error,Train/mean_reward out=curves.png

Runs whose configurations differ by the seed (or the logger) alone make one line.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omniperception import config
from omniperception.evaluation.report.curves import curves_of, draw_curves
from omnirobot.common.cli import PICTURES, Command, argument

TAGS = ("Train/mean_reward", "Metrics/velocity_error")


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command's own arguments."""

    runs: tuple[Path, ...] = argument((config.OUTPUTS,), "run directories, or folders that hold some, at any depth")
    tags: tuple[str, ...] = argument(TAGS, "scalars, a panel each")
    smooth: int = argument(20, "iterations of the running mean", least=1)
    out: Path = argument(Path("outputs/curves.png"), "picture that is written", suffixes=PICTURES)


def main(arguments: Arguments) -> None:
    """Reads the runs and writes the picture."""
    runs = []
    for folder in arguments.runs:
        if not (found := config.find_runs(folder)):
            raise config.ConfigError(f"runs={folder} is no run directory and holds none")
        runs += found
    curves = curves_of(list(dict.fromkeys(runs)), arguments.tags)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    draw_curves(arguments.out, curves, arguments.smooth)
    for tag, shown in curves.items():
        for curve in shown:
            last = curve.smoothed(arguments.smooth)[:, -1]
            spread = f", {last.min():.3g} to {last.max():.3g}" if len(last) > 1 else ""
            print(f"{tag}, {curve.label}: {last.mean():.3g} (n = {len(last)}{spread}) at iteration {curve.steps[-1]}")
    print(f"wrote {arguments.out}")


command = Command(main, Arguments, __doc__)
