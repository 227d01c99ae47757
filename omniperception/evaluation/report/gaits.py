"""Tables of gaits: falls, errors against sudden commands, and what joints and feet bear."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import torch

from omniperception.common.tables import markdown
from omniperception.config import ConfigError
from omniperception.evaluation.report.records import Record
from omniperception.evaluation.report.tables import check_apart, grouped, headline, rate_cell, without_constants
from omniperception.evaluation.trials.outcomes import Episodes
from omnirobot.common.shell import command_line

EASY_LEVELS = 5
"""Levels of uneven ground that a robot is expected to pass; tables show the others apart."""
KEYS = ("world", "terrain", "ground", "condition", "policy")
"""What a row is of."""


def walking_table(records: Sequence[Record], kinds: bool = True, apart: bool = False) -> str:
    """All figures: a row for each world and ground, runs of several training seeds together.

    Args:
        records: with figures of a gait.
        kinds: whether each kind of ground has a row of its own, besides easy and hard levels.
        apart: whether each run has: of other robots, by other recipes.

    Raises:
        ConfigError: see `check_apart`.
    """
    check_apart(records)
    keys, rows = (("run",) if apart else ()) + KEYS, []
    by_run = grouped(records, "run").values() if apart else [list(records)]
    for own in by_run:
        for (world, terrain, condition, policy), seeds in grouped(
            own, "world", "terrain", "condition", "policy"
        ).items():
            by_seed = [grounds(record) for record in seeds]  # other seeds, other tiles
            for ground in dict.fromkeys(name for found in by_seed for name in found if kinds or "," not in name):
                there = zip(seeds, by_seed, strict=True)
                parts = [Part(record, found[ground]) for record, found in there if ground in found]
                cells = [
                    rate_cell([part.fell for part in parts]),
                    *(_cell([figure(part) for part in parts], digits) for figure, digits in FIGURES.values()),
                ]
                row = [world, terrain, ground, condition, policy, *cells]
                rows.append([seeds[0].run, *row] if apart else row)
    heads, rows = without_constants(keys, ("falls, %", *FIGURES), rows)
    return f"{headline(records, apart)}\n\n{markdown(heads, rows)}\n"


level_table = partial(walking_table, kinds=False)
run_table = partial(walking_table, kinds=False, apart=True)


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
        walking: (num_trials,) figures of a gait by name.
        wanted: (num_trials,) bool: which trials.
        fell: (n,) bool.
    """

    def __init__(self, record: Record, wanted: torch.Tensor) -> None:
        self._episodes: Episodes = record.episodes
        self.walking, self.wanted = _walking(record), wanted
        self.fell = (record.episodes.ended("fall") | record.episodes.ended("diverged"))[wanted]

    def mean(self, name: str, weight: torch.Tensor | None = None) -> float:
        """Mean of a figure over the trials that have it, weighted by (num_trials,) or evenly."""
        values = self.walking[name][self.wanted]
        weight = torch.ones_like(values) if weight is None else weight[self.wanted]
        there = values.isfinite() & (weight > 0)
        return float((values * weight)[there].sum() / weight[there].sum()) if bool(there.any()) else float("nan")

    def settled(self, name: str) -> float:
        """Mean over all control steps later than `commands.SETTLE_S` after a command."""
        return self.mean(name, self.walking["settled_s"])

    def share(self, name: str) -> float:
        """Mean over all control steps."""
        return self.mean(name, self._episodes.length_s)

    def cost_of_transport(self) -> float:
        energy, path = self._episodes.energy[self.wanted].sum(), self._episodes.path[self.wanted].sum()
        return float(energy / (self._episodes.weight * path))


FIGURES: dict[str, tuple[Callable[[Part], float], int]] = {
    "velocity error, m/s": (lambda part: part.settled("settled_velocity_error"), 3),
    "yaw rate error, rad/s": (lambda part: part.settled("settled_yaw_rate_error"), 3),
    "steps at a torque limit, %": (lambda part: 100 * part.share("torque_limited"), 2),
    "at a joint's stop, %": (lambda part: 100 * part.share("at_stop"), 2),
    "fastest joint, rad/s": (lambda part: float(part.walking["joint_speed"][part.wanted].max()), 1),
    "target change, rad": (lambda part: part.share("target_change"), 3),
    "foot slip, m/s": (lambda part: part.mean("foot_slip"), 3),
    "swing height, m": (lambda part: part.mean("swing_height"), 3),
    "impact / weight": (lambda part: part.mean("impact"), 2),
    "cost of transport": (Part.cost_of_transport, 2),
    "standing speed, m/s": (lambda part: part.mean("standing_speed", part.walking["standing_s"]), 3),
}
"""Figures, and the digits that are shown; falls stand before them."""


def _cell(values: list[float], digits: int) -> str:
    """Mean and range of what is a number."""
    values = [value for value in values if math.isfinite(value)]
    if not values:
        return "–"
    spread = f" ({min(values):.{digits}f} to {max(values):.{digits}f})" if len(values) > 1 else ""
    return f"{sum(values) / len(values):.{digits}f}{spread}"


def _walking(record: Record) -> dict[str, torch.Tensor]:
    walking = record.episodes.walking
    if walking is None:
        line = command_line("evaluate", f"run={record.run}", "suite=walking")
        raise ConfigError(f"{record.world}: no figures of a gait; what measures them: {line}")
    return walking
