"""Results tables in Markdown pages, rendered from files of results between two comments.

<!-- table: before -->                                          all figures, of docs/lab/data/before.json(.gz)
<!-- table: before view=policies condition=robot split=test --> untouched: a row for each world
<!-- table: before view=worlds policy=run -->                   the same with a column for each condition
<!-- table: before view=conditions policy=run,blind -->         untouched and falls: a row for each policy
<!-- table: avoider,robots view=trained condition=robot -->     the same: a row for each run, a column for each policy
<!-- table: avoider,ppo view=trainings condition=robot -->      the same: a row for each world, a column for a training
<!-- table: gait view=walking -->                              figures of a gait: a row for each ground
<!-- table: gait view=levels -->                               the same, all kinds of ground together
<!-- table: gait,robots view=runs -->                          the same, a row for each run
<!-- table: end_to_end view=study -->                          results of a study: a row for each training and policy
<!-- end -->
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from omniperception.common.tables import markdown
from omniperception.config import ConfigError, suggest
from omniperception.evaluation.report.gaits import level_table, run_table, walking_table
from omniperception.evaluation.report.records import Record, read, training_of
from omniperception.evaluation.report.studies import study_table
from omniperception.evaluation.report.tables import check_apart, grouped, headline, rate_cell, table, without_constants
from omnirobot.common.shell import command_line

_BLOCK = re.compile(r"^<!-- table: (?P<what>[^\n]*?) -->\n(?P<body>.*?)^<!-- end -->$", re.DOTALL | re.MULTILINE)
_BEGIN = re.compile(r"^<!-- table:", re.MULTILINE)
"""Comments count at the beginning of a line; within one they are talked about."""
_FILTERS = ("policy", "world", "terrain", "condition", "split", "run")


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
        wanted, there = value.split(","), {str(getattr(record, key)): None for record in records}
        if unknown := [one for one in wanted if one not in there]:
            raise ConfigError(
                f"<!-- table: {what} -->: {key}={unknown[0]} shows nothing; {suggest(unknown[0], tuple(there))}"
            )
        records = [record for record in records if getattr(record, key) in wanted]
    if not records:
        raise ConfigError(f"<!-- table: {what} --> shows nothing: no result in {name} is like that")
    return f"<!-- table: {what} -->\n\n{VIEWS[view](records).strip()}\n\n{source(records)}\n\n<!-- end -->"


def data_file(name: str, data: Path) -> Path:
    """The file of a name: compressed, or not."""
    found = [path for suffix in (".json.gz", ".json") if (path := data / f"{name}{suffix}").is_file()]
    if not found:
        line = command_line("evaluate", f"out={data / name}.json.gz")
        raise ConfigError(f"{data} has no {name}.json.gz and no {name}.json; what writes it: {line}")
    return found[0]


def by_policy(records: Sequence[Record]) -> str:
    """How often each policy arrived untouched: a row for each world."""
    return _by_world(records, "policy", ("world", "terrain", "condition"))


def by_world(records: Sequence[Record]) -> str:
    """How often it was arrived untouched under each condition: a row for each world."""
    return _by_world(records, "condition", ("world", "terrain", "policy"))


def _by_world(records: Sequence[Record], column: str, keys: Sequence[str]) -> str:
    columns = [name for (name,) in grouped(records, column)]
    if column == "condition":
        columns.sort()  # ideal, paper, robot
    rows = []
    for key, here in sorted(grouped(records, *keys).items()):
        cells = [_untouched([record for record in here if getattr(record, column) == name]) for name in columns]
        rows.append([*key, *cells])
    return _titled(records, "reached, untouched and without a fall, %", list(keys), columns, rows)


def by_condition(records: Sequence[Record]) -> str:
    """How often each policy arrived untouched, and how often it fell, in the trials of all worlds.

    Raises:
        ConfigError: policies or runs were in different worlds, or under one condition in others than under another.
    """
    _check_same_worlds(records, "policy", "run", "condition")
    return _over_worlds(records, "policy", "condition", sorted({record.condition for record in records}))


def by_run(records: Sequence[Record]) -> str:
    """The same of each run: a column for each policy.

    Raises:
        ConfigError: runs were in different worlds, or under different conditions.
    """
    _check_same_worlds(records, "run", "policy")
    return _over_worlds(records, "run", "policy", [policy for (policy,) in grouped(records, "policy")])


def by_training(records: Sequence[Record]) -> str:
    """How often each training, its seeds together, arrived untouched: a row for each world, and one for all of them.

    A run in a folder seed<n> is one of the training that the folder above it names, any other its own.
    """
    trainings = list(dict.fromkeys(training_of(record.run) for record in records))
    rows = []
    for key, here in sorted(grouped(records, "terrain", "condition", "policy").items()):
        of_each = [[record for record in here if training_of(record.run) == training] for training in trainings]
        worlds = sorted({record.world for record in here})
        for world in worlds:
            rows.append([world, *key, *(_untouched([r for r in theirs if r.world == world]) for theirs in of_each)])
        everywhere = [
            theirs if all({r.world for r in own} == set(worlds) for own in grouped(theirs, "run").values()) else []
            for theirs in of_each
        ]
        if len(worlds) > 1:
            rows.append([f"all {len(worlds)}", *key, *(_untouched(theirs) for theirs in everywhere)])
    keys = ["world", "terrain", "condition", "policy"]
    return _titled(records, "reached, untouched and without a fall, %", keys, trainings, rows)


def _check_same_worlds(records: Sequence[Record], *keys: str) -> None:
    """Refuses to put all worlds of these groups together where one group was in others."""
    groups = grouped(records, *keys).items()
    apart = "condition" in keys
    worlds = {
        key: {record.place if apart else f"{record.place} ({record.condition})" for record in theirs}
        for key, theirs in groups
    }
    (first, most), *others = worlds.items()
    for key, found in others:
        if found != most:
            raise ConfigError(
                f"{' '.join(key)} and {' '.join(first)} were not in the same worlds (only one of them in"
                f" {', '.join(sorted(found ^ most))}); filter for what all have: world=... terrain=... condition=..."
            )


def _over_worlds(records: Sequence[Record], row: str, column: str, columns: list[str]) -> str:
    rows = []
    for (name,), theirs in grouped(records, row).items():
        cells = []
        for there in columns:
            found = [record for record in theirs if getattr(record, column) == there]
            by_seed = [[r.episodes.happened() for r in own] for own in grouped(found, "run").values()]
            rates = (
                rate_cell([torch.cat([one[figure] for one in own]) for own in by_seed])
                for figure in ("untouched", "fall")
            )
            cells.append(" / ".join(rates) if found else "–")
        rows.append([name, *cells])
    worlds = len({record.place for record in records})
    what = f"reached, untouched and without a fall / falls, %, over {worlds} worlds"
    heading = "run directory" if row == "run" else row  # a policy is called run
    return _titled(records, what, [heading], columns, rows, apart=row == "run")


VIEWS: dict[str, Callable[[Sequence[Record]], str]] = {
    "all": table,
    "policies": by_policy,
    "worlds": by_world,
    "conditions": by_condition,
    "trained": by_run,
    "trainings": by_training,
    "walking": walking_table,
    "levels": level_table,
    "runs": run_table,
    "study": study_table,
}


def source(records: Sequence[Record]) -> str:
    """Where the numbers come from: commands, commits, dates, seeds, machine."""
    facts = [record.facts for record in records]
    commands = sorted({fact["command"] for fact in facts})
    commits = sorted({(fact["commit"] or "no checkout")[:12] + _changed(fact["commit"]) for fact in facts})
    dates = sorted({fact["date"][:10] for fact in facts})
    machines = sorted({f"{fact['machine']['cpu']}, {fact['machine']['device']}" for fact in facts})
    seeds = sorted({record.seed for record in records})
    shown = ", ".join(map(str, seeds)) if len(seeds) <= 3 else f"{len(seeds)} seeds in the file"
    lines = [f"    {command}" for command in commands]
    return "\n".join(
        [*lines, "", f"{', '.join(dates)}; commit {', '.join(commits)}; seeds: {shown}; {'; '.join(machines)}."]
    )


def _changed(commit: str | None) -> str:
    return " with changes" if commit and "+" in commit else ""


def _untouched(records: Sequence[Record]) -> str:
    by_run = grouped(records, "run").values()
    return rate_cell([torch.cat([record.episodes.clean for record in run]) for run in by_run]) if records else "–"


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
