"""Figures of a stability report: heat maps over gains with the analytic limit, and precision by layer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.stability.physics import INTEGRATORS, Map
from omnirobot.common.figures import new_figure


def draw_maps(maps: Sequence[Map], label: str, bounds: tuple[float, float], path: Path) -> None:
    """One panel for each integrator (rows, PD in the engine and outside) and step (columns).

    Args:
        maps: all of one kind.
        label: what the colours are.
        bounds: of the colours.
        path: of the picture.
    """
    kinds = [
        (i, o) for i in INTEGRATORS for o in (False, True) if any(m.integrator == i and m.outside == o for m in maps)
    ]
    steps = sorted({m.step_ms for m in maps})
    figure = new_figure(2.1 * len(steps) + 1.0, 1.7 * len(kinds) + 0.6)
    axes = figure.subplots(len(kinds), len(steps), sharex=True, sharey=True, squeeze=False)
    image = None
    for row, (integrator, outside) in enumerate(kinds):
        for column, step in enumerate(steps):
            axis = axes[row, column]
            found = [m for m in maps if (m.integrator, m.outside, m.step_ms) == (integrator, outside, step)]
            if found:
                image = _panel(axis, found[0], bounds)
            if row == 0:
                axis.set_title(f"{step:g} ms", fontsize=8)
            if column == 0:
                axis.set_ylabel(
                    f"{integrator}\n{'PD outside' if outside else 'PD in engine'}\nkv (N m s/rad)", fontsize=6
                )
            if row == len(kinds) - 1:
                axis.set_xlabel("kp (N m/rad)", fontsize=6)
            axis.tick_params(labelsize=5)
    figure.colorbar(image, ax=axes, shrink=0.5, label=label)
    figure.savefig(path, dpi=80)


def _panel(axis, found: Map, bounds: tuple[float, float]):
    """Colours by gains; the limit of the linearised joints as a line, what the simulator caught as crosses."""
    rows, columns = np.arange(len(found.kv)), np.arange(len(found.kp))
    image = axis.imshow(found.growth, origin="lower", aspect="auto", cmap="coolwarm", vmin=bounds[0], vmax=bounds[1])
    if found.limit is not None and found.limit.min() < 1.0 < found.limit.max():
        rows_of, columns_of = found.limit.shape
        fine = np.linspace(0, len(found.kp) - 1, columns_of), np.linspace(0, len(found.kv) - 1, rows_of)
        axis.contour(*fine, np.log(found.limit), levels=[0.0], colors="black", linewidths=1.0)
    caught = np.argwhere(found.failed)
    axis.plot(caught[:, 1], caught[:, 0], "kx", markersize=2)
    every = max(1, len(found.kp) // 4)
    axis.set_xticks(columns[::every], [f"{v:.3g}" for v in found.kp[::every]])
    axis.set_yticks(rows[::every], [f"{v:.2g}" for v in found.kv[::every]])
    return image


def draw_precision(rows: Sequence[Mapping[str, object]], path: Path) -> None:
    """Relative error of float32 by layer, of outputs and of gradients."""
    figure = new_figure(6.0, 3.2)
    axis = figure.subplots()
    places = np.arange(len(rows))
    axis.barh(places - 0.2, [row["output"] for row in rows], 0.4, label="output")
    axis.barh(places + 0.2, [row["gradient"] for row in rows], 0.4, label="gradient of the parameters")
    axis.set_yticks(places, [str(row["layer"]) for row in rows], fontsize=7)
    axis.set_xscale("log")
    axis.invert_yaxis()
    axis.axvline(np.finfo(np.float32).eps, color="black", linewidth=0.8, label="float32's step at 1")
    axis.set_xlabel("relative error of float32 against float64")
    axis.legend(fontsize=7)
    figure.savefig(path, dpi=90)
