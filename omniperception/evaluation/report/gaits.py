"""Tables of gaits: falls, errors against sudden commands, and what joints and feet bear."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch

from omniperception.common.tables import markdown
from omniperception.config import ConfigError
from omniperception.evaluation.report.records import Record
from omniperception.evaluation.report.tables import check_apart, grouped, headline, rate_cell, without_constants
from omniperception.evaluation.trials.outcomes import Episodes
from omnirobot.common.shell import command_line

EASY_LEVELS = 5
"""Levels of uneven ground that a robot is expected to pass; tables show the others apart."""
HEADINGS = (
    *("falls, %", "velocity error, m/s", "yaw rate error, rad/s", "steps at a torque limit, %", "at a joint's stop, %"),
    *("fastest joint, rad/s", "target change, rad", "foot slip, m/s", "swing height, m", "impact / weight"),
    *("cost of transport", "standing speed, m/s"),
)


KEYS = ("world", "terrain", "ground", "condition", "policy")
"""What a row is of."""


def walking_table(records: Sequence[Record]) -> str:
    """All figures: a row for each world and ground, runs of several training seeds together.

    Raises:
        ConfigError: see `check_apart`.
    """
    return _table(records, KEYS, _rows(records, grounds))


def level_table(records: Sequence[Record]) -> str:
    """The same with all kinds of ground together: a row for each world, and for easy and hard levels.

    Raises:
        ConfigError: see `check_apart`.
    """
    return _table(records, KEYS, _rows(records, _levels))


def run_table(records: Sequence[Record]) -> str:
    """As :func:`level_table`, each run by itself: of other robots, by other recipes.

    Raises:
        ConfigError: see `check_apart`.
    """
    rows = [[run, *row] for (run,), own in grouped(records, "run").items() for row in _rows(own, _levels)]
    return _table(records, ("run", *KEYS), rows)


def _table(records: Sequence[Record], keys: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return f"{headline(records, apart='run' in keys)}\n\n{markdown(*without_constants(keys, HEADINGS, rows))}\n"


def _levels(record: Record) -> dict[str, torch.Tensor]:
    return {name: there for name, there in grounds(record).items() if "," not in name}


def _rows(records: Sequence[Record], parts_of: Callable[[Record], dict[str, torch.Tensor]]) -> list[list[str]]:
    check_apart(records)
    rows = []
    for (world, terrain, condition, policy), seeds in grouped(
        records, "world", "terrain", "condition", "policy"
    ).items():
        by_seed = [parts_of(record) for record in seeds]  # other seeds, other tiles
        for ground in dict.fromkeys(name for found in by_seed for name in found):
            there = zip(seeds, by_seed, strict=True)
            parts = [Part(record, found[ground]) for record, found in there if ground in found]
            rows.append([world, terrain, ground, condition, policy, *figures(parts)])
    return rows


def grounds(record: Record) -> dict[str, torch.Tensor]:
    """(num_trials,) bool: trials on each part of a terrain: easy and hard levels, and each kind on both."""
    walking = _walking(record)
    everywhere = torch.ones(len(record.episodes), dtype=torch.bool)
    kinds = record.facts.get("tile_kinds")
    if kinds is None:
        return {"all": everywhere}
    level, tile = walking["level"], walking["tile"].long()
    easy = level < EASY_LEVELS
    parts = {f"levels 0 to {EASY_LEVELS - 1}": easy, f"levels {EASY_LEVELS} and above": ~easy}
    of_kind = {kind: torch.tensor([k == kind for k in kinds])[tile] for kind in dict.fromkeys(kinds)}
    parts |= {f"{kind}, levels 0 to {EASY_LEVELS - 1}": easy & there for kind, there in of_kind.items()}
    parts |= {f"{kind}, levels {EASY_LEVELS} and above": ~easy & there for kind, there in of_kind.items()}
    return {name: there for name, there in parts.items() if bool(there.any())}


class Part:
    """Some of a record's trials.

    Attributes:
        fell: (n,) bool.
    """

    def __init__(self, record: Record, wanted: torch.Tensor) -> None:
        self._episodes: Episodes = record.episodes
        self._walking, self._wanted = _walking(record), wanted
        self.fell = (record.episodes.ended("fall") | record.episodes.ended("diverged"))[wanted]

    def mean(self, name: str, weight: torch.Tensor | None = None) -> float:
        """Mean of a figure over the trials that have it, weighted by (num_trials,) or evenly."""
        values = self._walking[name][self._wanted]
        weight = torch.ones_like(values) if weight is None else weight[self._wanted]
        there = values.isfinite() & (weight > 0)
        return float((values * weight)[there].sum() / weight[there].sum()) if bool(there.any()) else float("nan")

    def settled(self, name: str) -> float:
        """Mean over all control steps later than `commands.SETTLE_S` after a command."""
        return self.mean(name, self._walking["settled_s"])

    def share(self, name: str) -> float:
        """Mean over all control steps."""
        return self.mean(name, self._episodes.length_s)

    def standing(self) -> float:
        return self.mean("standing_speed", self._walking["standing_s"])

    def largest(self, name: str) -> float:
        return float(self._walking[name][self._wanted].max())

    def cost_of_transport(self) -> float:
        energy, path = self._episodes.energy[self._wanted].sum(), self._episodes.path[self._wanted].sum()
        return float(energy / (self._episodes.weight * path))


def figures(parts: Sequence[Part]) -> list[str]:
    """The cells of HEADINGS, of one run or of several training seeds."""

    def cell(values: list[float], digits: int) -> str:
        values = [value for value in values if math.isfinite(value)]
        if not values:
            return "–"
        mean = sum(values) / len(values)
        spread = f" ({min(values):.{digits}f} to {max(values):.{digits}f})" if len(values) > 1 else ""
        return f"{mean:.{digits}f}{spread}"

    return [
        rate_cell([part.fell for part in parts]),
        cell([part.settled("settled_velocity_error") for part in parts], 3),
        cell([part.settled("settled_yaw_rate_error") for part in parts], 3),
        cell([100 * part.share("torque_limited") for part in parts], 2),
        cell([100 * part.share("at_stop") for part in parts], 2),
        cell([part.largest("joint_speed") for part in parts], 1),
        cell([part.share("target_change") for part in parts], 3),
        cell([part.mean("foot_slip") for part in parts], 3),
        cell([part.mean("swing_height") for part in parts], 3),
        cell([part.mean("impact") for part in parts], 2),
        cell([part.cost_of_transport() for part in parts], 2),
        cell([part.standing() for part in parts], 3),
    ]


def _walking(record: Record) -> dict[str, torch.Tensor]:
    walking = record.episodes.walking
    if walking is None:
        line = command_line("evaluate", f"run={record.run}", "suite=walking")
        raise ConfigError(f"{record.world}: no figures of a gait; what measures them: {line}")
    return walking
