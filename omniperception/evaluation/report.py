"""Reports on evaluated episodes: a table, and one line per episode."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import torch

from omniperception.common.tables import markdown
from omniperception.evaluation.episodes import CLEARANCE_CAP, Episodes

DEFINITIONS = {
    "success": "goal reached without a fall within the time (without a goal: time limit reached); touches allowed",
    "success_untouched": "success without any contact between robot and obstacle",
    "collision": "share of trials with at least one contact; the trial goes on (counting convention)",
    "rates_to_first_contact": "as if each trial ended at its first contact: exclusive outcomes that add up to one",
    "interval": "low and high are the ends of Wilson's 95 % interval",
    "clearance_m": "smallest distance in space between any robot link and any obstacle in a trial, by true geometry, "
    f"at the end of every control step; 0 with a contact, at most {CLEARANCE_CAP:g}",
    "velocity_error_m_s": "mean over time of |horizontal velocity - commanded velocity|, avoiding included",
    "energy_j": "sum over joints and control steps of |torque * joint velocity| * control step",
    "cost_of_transport": "energy / (weight * length of the base's horizontal way), over all trials",
}
"""Meaning of the entries of a summary."""


def table(summaries: Mapping[str, dict]) -> str:
    """Summaries side by side, one column each."""
    first = next(iter(summaries.values()))
    rows = []
    for group, when in (("rates", ""), ("rates_to_first_contact", ", ending at the first contact")):
        for name in first[group]:
            rows.append(
                (name.replace("_", " ") + when, *(_rate(summary[group][name]) for summary in summaries.values()))
            )
    for parameters, shown in ((_QUANTILES, _spread), (_FIGURES, _figure)):
        for key, label, unit in parameters:
            values = [summary[key] for summary in summaries.values()]
            if any(value is not None for value in values):
                rows.append((f"{label} ({unit})" if unit else label, *map(shown, values)))
    title = f"{first['episodes']} episodes, success: {first['success_means']}"
    return f"{title}\n\n{markdown(['', *summaries], rows)}\n"


def times_line(summary: dict) -> str:
    """Wall time of one control step of one environment, by stage."""
    times = sorted(summary["us_per_env_step"].items(), key=lambda item: -item[1])
    return "  time per environment step: " + ", ".join(f"{name} {spent:.1f}" for name, spent in times) + " us"


def write_trials(path: Path, by_policy: Mapping[str, Episodes]) -> None:
    """One line per trial and policy as CSV; trial k of environment i is the same scene for every policy."""
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["policy", "environment", "trial", "outcome", *_COLUMNS])
        for policy, episodes in by_policy.items():
            columns = [_plain(getattr(episodes, name), len(episodes)) for name in _COLUMNS.values()]
            for k, (outcome, *values) in enumerate(zip(episodes.verdict, *columns, strict=True)):
                writer.writerow([policy, *divmod(k, episodes.per_env), outcome, *values])


_QUANTILES = (
    ("time_to_goal_s", "time to goal", "s"),
    ("clearance_m", "least clearance", "m"),
    ("energy_j", "energy", "J"),
)
_FIGURES = (
    ("cost_of_transport", "cost of transport", ""),
    ("velocity_error_m_s", "velocity error", "m/s"),
    ("free_velocity_error_m_s", "velocity error, nothing near", "m/s"),
    ("yaw_rate_error_rad_s", "yaw rate error", "rad/s"),
    ("contacts_per_minute", "contacts per minute", ""),
    ("mean_length_s", "episode length", "s"),
)
_COLUMNS = {
    "length_s": "length_s",
    "contacts": "contacts",
    "first_contact_s": "first_contact_s",
    "clearance_m": "clearance",
    "energy_j": "energy",
    "path_m": "path",
    "velocity_error_m_s": "velocity_error",
    "yaw_rate_error_rad_s": "yaw_rate_error",
}
"""Columns of the CSV file and the fields of Episodes they hold."""


def _rate(rate: dict) -> str:
    return f"{100 * rate['rate']:.1f} % [{100 * rate['low']:.1f}, {100 * rate['high']:.1f}]"


def _spread(spread: dict | None) -> str:
    return "" if spread is None else f"{spread['median']:.2f} [{spread['p05']:.2f}, {spread['p95']:.2f}]"


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def _plain(values: torch.Tensor | None, count: int) -> list:
    """A tensor as numbers with six digits; nothing where there is none, or where it is infinite."""
    if values is None:
        return [""] * count
    return ["" if value == float("inf") else float(f"{value:.6g}") for value in values.tolist()]
