"""Results on the screen, in the README and in files, with what they were measured on."""

from __future__ import annotations

import csv
import json
import math
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

LIBRARIES = (
    "torch",
    "warp-lang",
    "numpy",
    "mujoco",
    "mujoco-core",
    "mujoco-lidar",
    "taichi",
    "jax",
    "newton",
    "mujoco-warp",
    "embreex",
    "open3d",
)


@dataclass
class Table:
    """Named columns and rows of numbers or text.

    Attributes:
        name: File name of the table, without ending.
        title: What it shows.
        columns: Headings with units.
        rows: One value per column.
        notes: Lines below it: conditions, bars and whether they are met.
        brief: The columns that the README shows; all of them if empty.
        details: What else the JSON file holds.
    """

    name: str
    title: str
    columns: Sequence[str]
    rows: list[Sequence[object]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    brief: Sequence[str] = ()
    details: dict[str, object] = field(default_factory=dict)

    def markdown(self, brief: bool = False) -> str:
        """The table for people, with its brief columns or all of them."""
        kept = [k for k, c in enumerate(self.columns) if c in self.brief or not (brief and self.brief)]
        rows = [self.columns, *([_show(value) for value in row] for row in self.rows)]
        cells = [[row[k] for k in kept] for row in rows]
        widths = [max(len(row[k]) for row in cells) for k in range(len(kept))]
        lines = ["| " + " | ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) + " |" for row in cells]
        lines.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
        return "\n".join([f"{self.title}\n", *lines, *(["", *self.notes] if self.notes else [])])


def machine(num_threads: int, device: str) -> dict[str, object]:
    """What the measurements were made on, and what it was doing besides."""
    installed = {}
    for library in LIBRARIES:
        try:
            installed[library] = metadata.version(library)
        except metadata.PackageNotFoundError:
            continue
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "cpu": cpu_model(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "threads": num_threads,
        "device": device_name(device),
        "load_at_start": round(load, 2),
        "python": platform.python_version(),
        "libraries": installed,
    }


def machine_line(about: dict) -> str:
    """One line to stand below a table."""
    libraries = ", ".join(f"{name} {version}" for name, version in about["libraries"].items())
    where = about["cpu"] if about["device"] == "cpu" else f"{about['device']} and {about['cpu']}"
    return (
        f"Measured on {where}, {about['cores']} cores, {about['threads']} threads, load {about['load_at_start']} at "
        f"the start, {about['date'][:10]}; Python {about['python']}, {libraries}."
    )


def cpu_model() -> str:
    """The processor's name, with its family where the name does not tell."""
    facts = {}
    if Path("/proc/cpuinfo").exists():
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            key, _, value = line.partition(":")
            facts.setdefault(key.strip(), value.strip())
    name = facts.get("model name") or platform.processor() or platform.machine()
    return f"{name} (family {facts['cpu family']} model {facts['model']})" if "cpu family" in facts else name


def device_name(device: str) -> str:
    if not device.startswith("cuda"):
        return device
    import torch

    return torch.cuda.get_device_name(device)


def write(table: Table, about: dict, folder: Path) -> None:
    """The table as CSV, with its notes and the machine as JSON, and its brief form as markdown for the README."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / f"{table.name}.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*table.columns, "date", "cpu", "threads"])
        writer.writerows([*row, about["date"], about["cpu"], about["threads"]] for row in table.rows)
    rows = [dict(zip(table.columns, map(_json_value, row), strict=True)) for row in table.rows]
    content = {"title": table.title, "machine": about, "rows": rows, "notes": table.notes, **table.details}
    (folder / f"{table.name}.json").write_text(json.dumps(content, indent=1) + "\n")
    (folder / f"{table.name}.md").write_text(f"{table.markdown(brief=True)}\n\n{machine_line(about)}\n")


def _json_value(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _show(value: object) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if not isinstance(value, float):
        return str(value)
    if value == 0.0:
        return "0"
    if abs(value) < 1e-2 or abs(value) >= 1e6:
        return f"{value:.1e}"
    return f"{value:,.0f}" if abs(value) >= 100.0 else f"{value:.3g}"
