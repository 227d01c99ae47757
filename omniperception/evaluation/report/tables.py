"""Tables of evaluated trials."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import torch

from omniperception.common.tables import markdown
from omniperception.config import ConfigError
from omniperception.evaluation.report.records import Record
from omniperception.evaluation.trials.outcomes import Episodes
from omniperception.evaluation.trials.statistics import paired_difference, pooled, quantiles

REFERENCE = "histogram"
"""Policy that the others' differences are taken to: the best known without learning."""
COLUMNS = {
    "untouched": "reached, untouched, %",
    "success": "reached, %",
    "touches": "touches / 100 m",
    "impulse": "impulse of a touched trial, N s",
    "time": "time / free time",
    "clearance": "least clearance, m",
    "fall": "falls, %",
    "time_out": "time-outs, %",
    "diverged": "diverged, %",
}
"""Figures of a policy and their headings."""


def grouped(records: Iterable[Record], *names: str) -> dict[tuple, list[Record]]:
    """Records by some of their attributes, in the order of their first appearance."""
    groups: dict[tuple, list[Record]] = {}
    for record in records:
        groups.setdefault(tuple(getattr(record, name) for name in names), []).append(record)
    return groups


def without_constants(
    keys: Sequence[str], columns: Sequence[str], rows: Sequence[Sequence[str]]
) -> tuple[list[str], list[list[str]]]:
    """Headings and rows, which begin with keys, without the keys that are the same everywhere but the first."""
    kept = [k for k in range(len(keys)) if k == 0 or len({row[k] for row in rows}) > 1]
    return [keys[k] for k in kept] + list(columns), [[row[k] for k in kept] + list(row[len(keys) :]) for row in rows]


def check_apart(records: Iterable[Record]) -> None:
    """Refuses to show two results of one run as if they were of two trainings.

    Raises:
        ConfigError: two are of the same run, policy and world.
    """
    for _, same in grouped(records, "run", "policy", "condition", "world", "terrain").items():
        if len(same) > 1:
            kinds = [" ".join([f"split={record.split}", *record.changes]) for record in same[:2]]
            raise ConfigError(
                f"{same[0].run}, {same[0].policy}, {same[0].place} is there twice, with {kinds[0]} and with {kinds[1]};"
                " a table shows one of them, so keep them in files of their own"
            )


def table(records: Sequence[Record]) -> str:
    """All figures: a row for each world and policy, runs of several training seeds together.

    With REFERENCE among the policies, each other one has a row with the difference in the first column, trial by trial;
    the last rows are means over the worlds, and that difference over the trials of all of them.

    Raises:
        ConfigError: see `check_apart`.
    """
    check_apart(records)
    keys = ["world", *(key for key in ("terrain", "condition") if len({getattr(r, key) for r in records}) > 1)]
    rows = []

    def add(where: list[str], policy: str, cells: Iterable[str], ours: list[Record], theirs: list[Record]) -> None:
        rows.append([*where, policy, *cells])
        if theirs and policy != REFERENCE:
            rows.append([*where, f"{policy}: difference to {REFERENCE}", difference(ours, theirs)])

    for _, here in grouped(records, "world", "terrain", "condition").items():
        by_policy = {policy: of_one for (policy,), of_one in grouped(here, "policy").items()}
        for policy, seeds in by_policy.items():
            cells = figures([record.episodes for record in seeds]).values()
            add([getattr(here[0], key) for key in keys], policy, cells, seeds, by_policy.get(REFERENCE, []))
    if len({(record.world, record.terrain) for record in records}) > 1:
        for (condition, policy), ours in grouped(records, "condition", "policy").items():
            named = {"world": f"mean of {len({(r.world, r.terrain) for r in ours})}", "condition": condition}
            reference = [one for one in records if (one.condition, one.policy) == (condition, REFERENCE)]
            add([named.get(key, "") for key in keys], policy, mean_figures(ours), ours, reference)
    columns = [*keys, "policy", *COLUMNS.values()]
    return f"{headline(records)}\n\n{markdown(columns, [row + [''] * (len(columns) - len(row)) for row in rows])}\n"


def headline(records: Sequence[Record], apart: bool = False) -> str:
    """What all rows of a table share; `apart`: each run has rows of its own."""
    trials = sorted({len(record.episodes) for record in records})
    conditions = sorted({f"{r.condition} (version {r.condition_version})" for r in records if r.condition_version})
    seeds = len({record.run for record in records})
    parts = [
        f"split {', '.join(sorted({record.split for record in records}))}",
        f"condition {', '.join(conditions) or 'none'}",
        f"{' or '.join(map(str, trials))} trials" + (f" of each of {seeds} runs" if seeds > 1 else ""),
        "rates with 95 % intervals" + (" (least to most of the runs)" if seeds > 1 and not apart else ""),
    ]
    return "; ".join(parts)


def figures(seeds: Sequence[Episodes]) -> dict[str, str]:
    """The cells of COLUMNS for a policy; `seeds` are the trials of each training seed."""
    happened = [episodes.happened() for episodes in seeds]

    def share(name: str) -> str:
        return rate_cell([by_name[name] for by_name in happened]) if name in happened[0] else "–"

    return {
        "untouched": share("untouched"),
        "success": share("success"),
        "touches": f"{_mean([episodes.touches_per_100_m for episodes in seeds]):.2f}",
        "impulse": _spread([episodes.touched_impulse for episodes in seeds], digits=0),
        "time": _spread([episodes.time_ratio for episodes in seeds]),
        "clearance": _spread([episodes.clearance for episodes in seeds]),
        **{name: share(name) for name in ("fall", "time_out", "diverged")},
    }


def mean_figures(records: Sequence[Record]) -> list[str]:
    """Means over worlds of the cells of COLUMNS; no interval, because worlds are no sample of anything."""
    by_world = list(grouped(records, "world", "terrain").values())

    def mean(name: str) -> str:
        happened = [[h[name] for r in here if name in (h := r.episodes.happened())] for here in by_world]
        rates = [_mean([float(one.double().mean()) for one in there]) for there in happened if there]
        return f"{100 * _mean(rates):.1f}" if rates else "–"

    touches = _mean([_mean([record.episodes.touches_per_100_m for record in here]) for here in by_world])
    rest = [mean(name) for name in ("fall", "time_out", "diverged")]
    return [mean("untouched"), mean("success"), f"{touches:.2f}", "", "", "", *rest]


def difference(ours: Sequence[Record], theirs: Sequence[Record]) -> str:
    """Difference of the first column between two policies on the same trials, in percentage points."""
    pairs = {_trials(record): record for record in theirs}
    if any(_trials(record) not in pairs for record in ours):
        return "not the same trials"
    matched = [(record, pairs[_trials(record)]) for record in ours]
    clean, reference = (torch.cat([pair[k].episodes.clean for pair in matched]) for k in (0, 1))
    found = paired_difference(clean, reference)
    return f"{100 * found['difference']:+.1f} [{100 * found['low']:+.1f}, {100 * found['high']:+.1f}]"


def _trials(record: Record) -> tuple:
    """What trials follow from, whoever acts in them."""
    names = ("run", "world", "terrain", "condition", "split", "seed")
    return (*(getattr(record, name) for name in names), *record.facts.get("overrides", ()), len(record.episodes))


def rate_cell(by_seed: Sequence[torch.Tensor]) -> str:
    """A rate in percent with its interval, and the range of several seeds."""
    rate = pooled(by_seed)
    spread = f" ({100 * rate['least']:.1f} to {100 * rate['most']:.1f})" if rate["seeds"] > 1 else ""
    return f"{100 * rate['rate']:.1f} [{100 * rate['low']:.1f}, {100 * rate['high']:.1f}]{spread}"


def progress_line(record: Record) -> str:
    """One line about what has just been measured."""
    us = record.episodes.us_per_env_step
    named = ", ".join([record.place, record.policy, record.run, *record.facts.get("overrides", ())])
    return f"{named}: untouched {rate_cell([record.episodes.clean])} %, {sum(us.values()):.0f} us per environment step"


def summary_table(summary: Mapping) -> str:
    """The figures of `Episodes.summary` below each other."""
    rows = [
        (name.replace("_", " "), f"{100 * rate['rate']:.1f} % [{100 * rate['low']:.1f}, {100 * rate['high']:.1f}]")
        for name, rate in summary["rates"].items()
    ]
    for key, label in _FIGURES.items():
        if (value := summary[key]) is not None:
            text = "{median:.2f} [{p05:.2f}, {p95:.2f}]".format(**value) if isinstance(value, dict) else f"{value:.3f}"
            rows.append((label, text))
    return f"{summary['trials']} trials, success: {summary['success_means']}\n\n{markdown(['', 'run'], rows)}\n"


def times_line(summary: Mapping) -> str:
    """Wall time of one control step of one environment, by stage."""
    times = sorted(summary["us_per_env_step"].items(), key=lambda item: -item[1])
    return "  time per environment step: " + ", ".join(f"{name} {spent:.1f}" for name, spent in times) + " us"


_FIGURES = {
    "time_over_free_time": "time over the free time",
    "clearance_m": "least clearance (m)",
    "touched_impulse_n_s": "impulse of a touched trial (N s)",
    "energy_j": "energy (J)",
    "touches_per_100_m": "touches per 100 m",
    "cost_of_transport": "cost of transport",
    "velocity_error_m_s": "velocity error (m/s)",
    "free_velocity_error_m_s": "velocity error, nothing near (m/s)",
    "yaw_rate_error_rad_s": "yaw rate error (rad/s)",
    "mean_length_s": "length of a trial (s)",
}


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else float("nan")


def _spread(values: Sequence[torch.Tensor | None], digits: int = 2) -> str:
    """Median with the 5 % to 95 % quantiles of all trials."""
    there = [value for value in values if value is not None]
    found = quantiles(torch.cat(there)) if there else None
    return "–" if found is None else "{median:.{0}f} [{p05:.{0}f}, {p95:.{0}f}]".format(digits, **found)
