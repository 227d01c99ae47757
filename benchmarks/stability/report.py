"""Tables of a stability report: rows on the console, as CSV and as JSON with the machine and the versions."""

from __future__ import annotations

import csv
import json
import os
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

Row = Mapping[str, object]
PACKAGES = ("torch", "mujoco-core", "warp-lang", "rsl-rl-lib", "numpy")


def provenance(arguments: Mapping[str, str]) -> dict[str, object]:
    """When, on what machine, with which versions and arguments."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "python": platform.python_version(),
        **{package: version(package) for package in PACKAGES},
        "arguments": dict(arguments),
    }


def write(out: Path, name: str, rows: Sequence[Row], about: Mapping[str, object]) -> None:
    """Writes `name`.csv and `name`.json into `out`."""
    out.mkdir(parents=True, exist_ok=True)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with (out / f"{name}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    (out / f"{name}.json").write_text(json.dumps({"about": dict(about), "rows": rows}, indent=1, default=str) + "\n")


def table(rows: Sequence[Row], columns: Sequence[str]) -> str:
    """Markdown."""
    lines = [columns, ["---"] * len(columns), *([_cell(row.get(column, "")) for column in columns] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "NO"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
