"""Tables of results: on the screen, and as CSV, JSON and Markdown with their provenance."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from omniperception.common import provenance, tables

LIBRARIES = (
    *provenance.LIBRARIES,
    *("mujoco", "mujoco-lidar", "taichi", "jax", "newton", "mujoco-warp", "embreex", "open3d", "fpsample"),
)


@dataclass
class Table:
    """Named columns and rows of numbers or text.

    Attributes:
        name: file name of the table, without ending.
        title: what it shows.
        columns: headings with units.
        rows: one value per column.
        notes: lines below it: conditions, targets and whether they are met.
        details: what else the JSON file holds.
    """

    name: str
    title: str
    columns: Sequence[str]
    rows: list[Sequence[object]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    details: dict[str, object] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, title: str, records: Sequence[Mapping[str, object]], notes: Iterable[str] = ()) -> Table:
        """A row per record, a column per key of any of them."""
        columns = list(dict.fromkeys(key for record in records for key in record))
        return cls(name, title, columns, [[record.get(key) for key in columns] for record in records], list(notes))

    def column(self, name: str) -> list[object]:
        """The values below a heading."""
        return [row[list(self.columns).index(name)] for row in self.rows]

    def markdown(self) -> str:
        """The table for people."""
        notes = ["", *self.notes] if self.notes else []
        return "\n".join([f"{self.title}\n", tables.markdown(self.columns, self.rows), *notes])


def about(num_threads: int, device: str = "cpu", **facts: object) -> dict:
    """Provenance of a study's results, with the versions of the libraries that are compared."""
    return provenance.provenance(device, LIBRARIES, threads=num_threads, **facts)


def machine_line(where: Mapping) -> str:
    """One line to stand below a table or in a figure."""
    machine, versions = where["machine"], ", ".join(f"{name} {version}" for name, version in where["versions"].items())
    place = machine["cpu"] if machine["device"] == "cpu" else f"{machine['device']} and {machine['cpu']}"
    return (
        f"Measured on {place}, {machine['cores']} cores, {where['threads']} threads, load {machine['load']} at the"
        f" start, {where['date'][:10]}, commit {(where['commit'] or 'unknown')[:10]}; {versions}."
    )


def write(table: Table, where: Mapping, folder: Path) -> None:
    """Writes a table as CSV, as JSON with its notes and provenance, and as Markdown."""
    folder.mkdir(parents=True, exist_ok=True)
    extra = {key: where[key] for key in ("date", "commit")} | {"cpu": where["machine"]["cpu"]}
    with (folder / f"{table.name}.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*table.columns, *extra])
        writer.writerows([*row, *extra.values()] for row in table.rows)
    rows = [dict(zip(table.columns, map(_json_value, row), strict=True)) for row in table.rows]
    content = {"title": table.title, "provenance": where, "rows": rows, "notes": table.notes, **table.details}
    (folder / f"{table.name}.json").write_text(json.dumps(content, indent=1, default=str) + "\n")
    (folder / f"{table.name}.md").write_text(f"{table.markdown()}\n\n{machine_line(where)}\n")


def report(tables: Iterable[Table], where: Mapping, folder: Path) -> list[Table]:
    """Prints and writes every table as soon as it is there."""
    done = []
    for table in tables:
        done.append(table)
        write(table, where, folder)
        print(f"{table.markdown()}\n", flush=True)
    print(f"{machine_line(where)}\nwrote {folder}")
    return done


def _json_value(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value
