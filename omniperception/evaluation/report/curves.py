"""Learning curves of runs that differ by their seeds alone: mean over the seeds, and the range of all of them."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from omniperception import config
from omniperception.evaluation.report.records import training_of
from omnirobot.common.errors import ConfigError
from omnirobot.common.figures import new_figure, plain, save_figure

MAY_DIFFER = ("seed", "logger", config.SEARCH_PATH)
"""Keys of a configuration in which runs of one curve may differ; those in `init` may be seeds of one training."""
UNITS = {
    "velocity_error": "m/s",
    "calm_velocity_error": "m/s",
    "yaw_rate_error": "rad/s",
    "mean_reward": "sum over an episode",
    "mean_episode_length": "control steps",
}


@dataclass(frozen=True)
class Curve:
    """A recipe's scalar over its trainings.

    Attributes:
        label: the recipe.
        steps: (n,) iterations that all of its runs have.
        values: (runs, n).
    """

    label: str
    steps: np.ndarray
    values: np.ndarray

    def smoothed(self, width: int) -> np.ndarray:
        """Means (runs, n) over the last `width` iterations, over fewer at the beginning."""
        sums = np.cumsum(np.pad(self.values, ((0, 0), (1, 0))), 1)
        ends = np.arange(1, self.values.shape[1] + 1)
        begins = np.maximum(ends - width, 0)
        return (sums[:, ends] - sums[:, begins]) / (ends - begins)


def by_recipe(runs: Sequence[Path]) -> dict[str, list[Path]]:
    """Runs by what they were trained with, but for the seed; the names are their recipes, without the overrides that
    all of them have, or a run directory."""
    groups: dict[str, list[Path]] = {}
    for run in runs:
        made = OmegaConf.to_container(config.read(run))
        assert isinstance(made, dict)
        kept = {key: value for key, value in made.items() if key not in MAY_DIFFER}
        init = made.get("init") or []
        kept["init"] = [training_of(name) for name in ([init] if isinstance(init, str) else init)]
        groups.setdefault(json.dumps(kept, sort_keys=True), []).append(run)
    named: dict[str, list[Path]] = {}
    words = [_words(same[0]) for same in groups.values()]
    common = set(words[0]).intersection(*words[1:]) if len(words) > 1 else set()
    for same, own in zip(groups.values(), words, strict=True):
        label = " ".join(word for word in own if word not in common) or str(same[0])
        named[label if label not in named else f"{label} ({same[0]})"] = same
    return named


def _words(run: Path) -> list[str]:
    beside = ("seed=", "logger", "hydra.")
    return [word for word in config.read_recipe(run) if not word.startswith(beside)]


def _events(run: Path) -> Any:
    """What the TensorBoard files of a run hold."""
    from tensorboard.backend.event_processing.event_accumulator import SCALARS, EventAccumulator

    events = EventAccumulator(str(run), size_guidance={SCALARS: 0})
    events.Reload()
    return events


def curves_of(runs: Sequence[Path], tags: Sequence[str]) -> dict[str, list[Curve]]:
    """Curves of each tag.

    Raises:
        ConfigError: no run has a tag, or runs of one curve have no iteration in common.
    """
    events = {run: _events(run) for run in runs}
    known = {run: events[run].Tags()["scalars"] for run in runs}
    found: dict[str, list[Curve]] = {tag: [] for tag in tags}
    for label, group in by_recipe(runs).items():
        for tag in tags:
            having = [{e.step: e.value for e in events[run].Scalars(tag)} for run in group if tag in known[run]]
            if having:
                found[tag].append(_curve(label, having))
    for tag, curves in found.items():
        if not curves:
            there = ", ".join(sorted(set().union(*known.values()))) or "none"
            raise ConfigError(f"tags={tag}: no run has it, out of {len(runs)}; known: {there}")
    return found


def _curve(label: str, runs: Sequence[Mapping[int, float]]) -> Curve:
    steps = sorted(set(runs[0]).intersection(*runs[1:]))
    if not steps:
        raise ConfigError(f"runs of {label} have no iteration in common; draw them apart")
    return Curve(label, np.array(steps), np.array([[run[step] for step in steps] for run in runs]))


def draw_curves(path: Path, curves: Mapping[str, Sequence[Curve]], smooth: int) -> None:
    """Draws a panel for each tag: a line for the mean of a recipe's runs, a band from the least to the greatest."""
    labels = list(dict.fromkeys(curve.label for shown in curves.values() for curve in shown))
    figure = new_figure(5.2 * max(len(curves), 2), 4.2 + 0.3 * len(labels))
    lines: dict[str, Any] = {}
    for axis, (tag, shown) in zip(figure.subplots(1, len(curves), squeeze=False)[0], curves.items(), strict=True):
        for curve in shown:
            values, colour = curve.smoothed(smooth), f"C{labels.index(curve.label) % 10}"
            seeds = "one training" if len(values) == 1 else f"{len(values)} trainings"
            (line,) = axis.plot(curve.steps, values.mean(0), lw=1.5, color=colour)
            lines.setdefault("\n".join(textwrap.wrap(plain(f"{curve.label}: {seeds}"), 130)), line)
            if len(values) > 1:
                axis.fill_between(curve.steps, values.min(0), values.max(0), color=colour, alpha=0.2, lw=0)
        name = tag.rpartition("/")[2]
        unit = UNITS.get(name, "share" if name.endswith("_rate") else "")
        axis.set(xlabel="iteration", ylabel=f"{name.replace('_', ' ')} ({unit})" if unit else name.replace("_", " "))
        axis.grid(alpha=0.3)
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", fontsize=7, frameon=False)
    figure.suptitle(f"mean of the last {smooth} iterations; band: least to greatest of the trainings", fontsize=9)
    save_figure(figure, path, dpi=120)
