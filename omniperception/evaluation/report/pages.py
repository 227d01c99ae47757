"""Results tables in Markdown pages, rendered from files of results between two comments (see the command tables)."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch

from omniperception.common.tables import markdown
from omniperception.config import ConfigError, suggest
from omniperception.evaluation.report.gaits import level_table, run_table, walking_table
from omniperception.evaluation.report.records import Record, read
from omniperception.evaluation.report.studies import study_table
from omniperception.evaluation.report.tables import (
    check_apart,
    grouped,
    headline,
    rate_cell,
    table,
    without_constants,
)
from omnirobot.common.shell import command_line

_BLOCK = re.compile(r"^<!-- table: (?P<what>[^\n]*?) -->\n(?P<body>.*?)^<!-- end -->$", re.DOTALL | re.MULTILINE)
_BEGIN = re.compile(r"^<!-- table:", re.MULTILINE)
"""Comments count at the beginning of a line; within one they are talked about."""
_FILTERS = ("policy", "world", "terrain", "condition", "split", "run")
_UNTOUCHED = "reached, untouched and without a fall"


def rendered(text: str, data: Path) -> str:
    """A page with its tables as the files in the folder `data` have them.

    Raises:
        ConfigError: a comment names no file, view or filter, or nothing is left to show.
    """
    if len(_BEGIN.findall(text)) != len(_BLOCK.findall(text)):
        raise ConfigError("a comment <!-- table: ... --> has no <!-- end --> after it")
    return _BLOCK.sub(lambda block: _filled(block["what"], data), text)


def _filled(what: str, data: Path) -> str:
    name, *settings = what.split()
    given = dict(setting.partition("=")[::2] for setting in settings)
    if len(given) < len(settings):
        raise ConfigError(f"<!-- table: {what} --> gives a setting twice; list its values after one another: a,b")
    view = given.pop("view", "all")
    if view not in VIEWS:
        raise ConfigError(f"<!-- table: {what} -->: view={view} is unknown; {suggest(view, tuple(VIEWS))}")
    records = [record for one in name.split(",") for record in read(data_file(one, data))]
    for key, value in given.items():
        if key not in _FILTERS:
            raise ConfigError(f"<!-- table: {what} -->: {key} is unknown; {suggest(key, _FILTERS)}")
        name = "chosen_terrain" if key == "terrain" else key
        wanted, there = value.split(","), {str(getattr(record, name)): None for record in records}
        if unknown := [one for one in wanted if one not in there]:
            raise ConfigError(
                f"<!-- table: {what} -->: {key}={unknown[0]} shows nothing; {suggest(unknown[0], tuple(there))}"
            )
        records = [record for record in records if getattr(record, name) in wanted]
    return f"<!-- table: {what} -->\n\n{VIEWS[view](records).strip()}\n\n{source(records)}\n\n<!-- end -->"


def data_file(name: str, data: Path) -> Path:
    """The file of a name: compressed, or not."""
    for suffix in (".json.gz", ".json"):
        if (path := data / f"{name}{suffix}").is_file():
            return path
    line = command_line("evaluate", f"out={data / name}.json.gz")
    raise ConfigError(f"{data} has no {name}.json.gz and no {name}.json; what writes it: {line}")


def by_world(records: Sequence[Record], column: str, keys: Sequence[str]) -> str:
    """How often it was arrived untouched: a row for each world and other keys, a column for each value of another."""
    columns = [name for (name,) in grouped(records, column)]
    if column == "condition":
        columns.sort()  # ideal, paper, robot
    rows = []
    for key, here in sorted(grouped(records, *keys).items()):
        cells = [_untouched([record for record in here if getattr(record, column) == name]) for name in columns]
        rows.append([*key, *cells])
    return _titled(records, f"{_UNTOUCHED}, %", list(keys), columns, rows)


def by_training(records: Sequence[Record]) -> str:
    """How often each training, its seeds together, arrived untouched: a row for each world, and one for all of them.

    A run in a folder seed<n> is one of the training that the folder above it names, any other its own.
    """
    trainings = [name for (name,) in grouped(records, "training")]
    keys, rows = ["terrain", "condition", "policy"], []
    for key, here in sorted(grouped(records, *keys).items()):
        of_each = [[record for record in here if record.training == training] for training in trainings]
        worlds = sorted({record.world for record in here})
        for world in worlds:
            rows.append([world, *key, *(_untouched([r for r in theirs if r.world == world]) for theirs in of_each)])
        if len(worlds) > 1:
            runs = [grouped(theirs, "run").values() for theirs in of_each]
            whole = [all({record.world for record in own} == set(worlds) for own in theirs) for theirs in runs]
            cells = [_untouched(theirs if there else []) for theirs, there in zip(of_each, whole, strict=True)]
            rows.append([f"all {len(worlds)}", *key, *cells])
    return _titled(records, f"{_UNTOUCHED}, %", ["world", *keys], trainings, rows)


def over_worlds(records: Sequence[Record], row: str, column: str) -> str:
    """How often it was arrived untouched, and how often fallen, in the trials of all worlds: of each policy or run.

    Raises:
        ConfigError: some were in other worlds, or under one condition in others than under another.
    """
    groups = grouped(records, *dict.fromkeys((row, *(["run"] if row == "policy" else []), column)))
    with_condition = column != "condition"
    worlds = {
        key: {f"{record.place} ({record.condition})" if with_condition else record.place for record in theirs}
        for key, theirs in groups.items()
    }
    (first, most), *others = worlds.items()
    for key, found in others:
        if found != most:
            raise ConfigError(
                f"{' '.join(key)} and {' '.join(first)} were not in the same worlds (only one of them in"
                f" {', '.join(sorted(found ^ most))}); filter for what all have: world=... terrain=... condition=..."
            )
    columns = [name for (name,) in grouped(records, column)]
    if column == "condition":
        columns.sort()
    rows = []
    for (name,), theirs in grouped(records, row).items():
        cells = [[record for record in theirs if getattr(record, column) == there] for there in columns]
        rows.append([name, *(" / ".join((_untouched(own), _rate(own, "fall"))) if own else "–" for own in cells)])
    what = f"{_UNTOUCHED} / falls, %, over {len({record.place for record in records})} worlds"
    heading = "run directory" if row == "run" else row  # a policy is called run
    return _titled(records, what, [heading], columns, rows, apart=row == "run")


VIEWS: dict[str, Callable[[Sequence[Record]], str]] = {
    "all": table,
    "policies": partial(by_world, column="policy", keys=("world", "terrain", "condition")),
    "worlds": partial(by_world, column="condition", keys=("world", "terrain", "policy")),
    "conditions": partial(over_worlds, row="policy", column="condition"),
    "trained": partial(over_worlds, row="run", column="policy"),
    "trainings": by_training,
    "walking": walking_table,
    "levels": level_table,
    "runs": run_table,
    "study": study_table,
}


def source(records: Sequence[Record]) -> str:
    """Where the numbers come from: commands, commits, dates, seeds, machine."""
    facts = [record.facts for record in records]
    commits = set()
    for fact in facts:
        commit, _, changes = (fact["commit"] or "no checkout").partition("+")
        commits.add(commit[:12] + (" with changes" if changes else ""))
    dates = sorted({fact["date"][:10] for fact in facts})
    machines = sorted({f"{fact['machine']['cpu']}, {fact['machine']['device']}" for fact in facts})
    seeds = sorted({record.seed for record in records})
    shown = ", ".join(map(str, seeds)) if len(seeds) <= 3 else f"{len(seeds)} seeds in the file"
    lines = [f"    {command}" for command in sorted({fact["command"] for fact in facts})]
    last = f"{', '.join(dates)}; commit {', '.join(sorted(commits))}; seeds: {shown}; {'; '.join(machines)}."
    return "\n".join([*lines, "", last])


def _rate(records: Sequence[Record], name: str) -> str:
    """How often something happened in the trials of some records, the runs' trials apart."""
    by_run = grouped(records, "run").values()
    return rate_cell([torch.cat([one.episodes.happened()[name] for one in run]) for run in by_run]) if records else "–"


def _untouched(records: Sequence[Record]) -> str:
    return _rate(records, "untouched")


def _titled(
    records: Sequence[Record],
    what: str,
    keys: list[str],
    columns: list[str],
    rows: list[list[str]],
    apart: bool = False,
) -> str:
    """A table without the columns of keys that are the same everywhere; `apart`: a row is of one run."""
    check_apart(records)
    return f"{what}; {headline(records, apart)}\n\n{markdown(*without_constants(keys, columns, rows))}"
