"""Choices by what they cost and how wrong they are: fronts, tables, words and the plot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.harness.table import Table
from omnirobot.common.figures import new_figure

AS_GOOD = 1.02
"""An error up to this factor larger counts as equal."""
AS_CHEAP = 1.05
"""A cost up to this factor larger counts as equal: clocks are no better."""


@dataclass(frozen=True)
class Choice:
    """One way of doing it.

    Attributes:
        name: What it is called in tables and plots.
        cost: What it takes, in the study's unit.
        errors: Errors by heading with unit; NaN where one does not apply.
        default: Whether the configuration chooses it.
        family: What it is one of; a family has one colour.
        facts: Further columns, such as bytes.
    """

    name: str
    cost: float
    errors: Mapping[str, float]
    default: bool = False
    family: str = ""
    facts: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Study:
    """Choices measured side by side.

    Attributes:
        name: File name of its table, without ending.
        title: What is compared, and on what.
        cost: Heading of the cost, with unit.
        error: Which of the errors decides about the front, with unit.
        choices: What was measured.
        floor: An error below this counts as none, in the unit of ``error``; also where a plot puts an error of 0.
        notes: Conditions, and the reference with its own error.
    """

    name: str
    title: str
    cost: str
    error: str
    choices: Sequence[Choice]
    floor: float
    notes: Sequence[str] = ()

    def error_of(self, choice: Choice) -> float:
        """The error that decides, at least the floor; infinite for a choice that failed."""
        error = choice.errors[self.error]
        return max(error, self.floor) if math.isfinite(error) else math.inf

    @property
    def drawn(self) -> list[Choice]:
        """Choices that did not fail."""
        return [choice for choice in self.choices if math.isfinite(self.error_of(choice))]

    @property
    def front(self) -> list[Choice]:
        """Choices that no other beats in one of cost and error and equals in the other, cheapest first."""
        kept = [choice for choice in self.drawn if not self._beaten(choice)]
        return sorted(kept, key=lambda choice: choice.cost)

    def _beaten(self, choice: Choice) -> bool:
        cost, error = choice.cost, self.error_of(choice)
        return any(
            (AS_GOOD * self.error_of(other) < error and other.cost <= AS_CHEAP * cost)
            or (AS_CHEAP * other.cost < cost and self.error_of(other) <= AS_GOOD * error)
            for other in self.choices
        )

    @property
    def default(self) -> Choice | None:
        """What the configuration chooses, if it was measured."""
        return next((choice for choice in self.choices if choice.default), None)

    def cheapest_as_good(self, choice: Choice) -> Choice:
        """The cheapest choice whose error is no larger, but for ``AS_GOOD``."""
        limit = AS_GOOD * self.error_of(choice)
        return min((other for other in self.choices if self.error_of(other) <= limit), key=lambda other: other.cost)

    def excess(self, choice: Choice) -> float:
        """How many times more a choice costs than the cheapest one that is as good; 1 if it is that one."""
        return choice.cost / self.cheapest_as_good(choice).cost

    def table(self) -> Table:
        """All choices, cheapest first."""
        errors = list(dict.fromkeys(key for choice in self.choices for key in choice.errors))
        facts = list(dict.fromkeys(key for choice in self.choices for key in choice.facts))
        front = {choice.name for choice in self.front}
        table = Table(self.name, self.title, ["choice", "default", "front", "excess", self.cost, *errors, *facts])
        for choice in sorted(self.choices, key=lambda c: c.cost):
            marks = ("default" if choice.default else "", "*" if choice.name in front else "")
            values = [choice.errors.get(key, math.nan) for key in errors]
            table.rows.append(
                [choice.name, *marks, self.excess(choice), choice.cost, *values]
                + [choice.facts.get(key, math.nan) for key in facts]
            )
        table.notes += [*self.notes, self.words()]
        table.details = {"cost": self.cost, "error": self.error, "floor": self.floor, "front": sorted(front)}
        return table

    def words(self) -> str:
        """Which choices are on the front, whether the default is, and what it trades against its neighbours there."""
        front = self.front
        said = f"Front ({self.cost} against {self.error}): {', '.join(choice.name for choice in front)}."
        default = self.default
        if default is None:
            return f"{said} The configured choice is not among those measured."
        if default not in front:
            better = [choice for choice in front if choice.cost <= AS_CHEAP * default.cost]
            better = [c for c in better if self.error_of(c) <= AS_GOOD * self.error_of(default)]
            offers = [f"{choice.name} {self._against(choice, default)}" for choice in better]
            return f"{said} The default, {default.name}, is not on it: {', '.join(offers)}."
        said += f" The default, {default.name}, is on it"
        place = front.index(default)
        trades = []
        if place:
            trades.append(f"{front[place - 1].name} {self._against(front[place - 1], default)}")
        if place + 1 < len(front):
            trades.append(f"{front[place + 1].name} {self._against(front[place + 1], default)}")
        return f"{said}; {', '.join(trades)}." if trades else f"{said}, alone."

    def _against(self, other: Choice, default: Choice) -> str:
        cost, error = other.cost / default.cost, self.error_of(other) / self.error_of(default)
        return f"costs {cost:.2g} times as much and errs {error:.2g} times as much"


def plot(studies: Sequence[Study], file: Path, about: str, columns: int = 3) -> None:
    """A panel for each study: cost against error, both logarithmic, the front drawn, the default as a star."""
    rows = -(-len(studies) // columns)
    figure = new_figure(5.2 * min(columns, len(studies)), 4.4 * rows)
    axes = figure.subplots(rows, min(columns, len(studies)), squeeze=False).ravel()
    for axis in axes[len(studies) :]:
        axis.remove()
    for study, axis in zip(studies, axes, strict=False):
        _draw(study, axis)
    figure.text(0.005, 0.002, about, fontsize=5)
    figure.get_layout_engine().set(rect=(0.0, 0.02, 1.0, 0.98))
    figure.draw_without_rendering()  # places the panels, so that what names would cover is known
    for study, axis in zip(studies, axes, strict=False):
        _name(axis, study)
    figure.savefig(file, dpi=80)


def _draw(study: Study, axis) -> None:
    from matplotlib.ticker import LogLocator

    drawn = study.drawn
    for family in dict.fromkeys(choice.family for choice in drawn):
        of = [choice for choice in drawn if choice.family == family]
        points = [c.cost for c in of], [study.error_of(c) for c in of]
        axis.plot(*points, "o", markersize=4, alpha=0.7, label=family or "choices")
    front = study.front
    axis.plot([c.cost for c in front], [study.error_of(c) for c in front], "-", color="0.4", lw=1, label="front")
    if study.default is not None and study.default in drawn:
        place = [study.default.cost], [study.error_of(study.default)]
        axis.plot(*place, "*", color="crimson", markersize=13, label=f"default: {study.default.name}")
    axis.set(xscale="log", yscale="log", xlabel=study.cost, ylabel=study.error)
    axis.margins(x=0.12, y=0.1)
    for scale in (axis.xaxis, axis.yaxis):
        scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=8))
        scale.set_major_formatter(lambda value, _: f"{value:g}")
    axis.minorticks_off()
    axis.set_title(study.title, fontsize=8, wrap=True)
    axis.grid(True, alpha=0.2)
    below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.16), "ncols": 3}
    axis.legend(fontsize=6, title=f"n = {len(drawn)} choices", title_fontsize=6, **below)


def _name(axis, study: Study) -> None:
    """Writes names of choices beside their points where there is room, those on the front first."""
    others = [choice for choice in study.drawn if choice not in study.front]
    panel, taken = axis.get_window_extent(), []
    for choice in [*study.front, *others]:
        for x, y, across, upright in ((3, 3, "left", "bottom"), (-3, -3, "right", "top"), (3, -3, "left", "top")):
            name = axis.annotate(
                choice.name,
                (choice.cost, study.error_of(choice)),
                fontsize=6,
                xytext=(x, y),
                textcoords="offset points",
                ha=across,
                va=upright,
                in_layout=False,
            )
            box = name.get_window_extent()
            if panel.x0 <= box.x0 and box.x1 <= panel.x1 and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            name.remove()
