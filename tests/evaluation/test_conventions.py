"""Rates and their two conventions of collision, on hand-made episodes."""

import csv

import pytest
import torch

from omniperception.env.metrics import OUTCOMES
from omniperception.evaluation.episodes import Episodes
from omniperception.evaluation.report import table, write_trials
from omniperception.evaluation.statistics import quantiles

# outcome, contacts, first contact (s), length (s)
TRIALS = [
    ("goal", 0, float("inf"), 10.0),
    ("goal", 2, 3.0, 14.0),  # touched, went on and arrived: a success only where trials go on
    ("goal", 0, float("inf"), 12.0),
    ("fall", 0, float("inf"), 4.0),
    ("fall", 1, 5.0, 5.0),  # fell over what it touched: ended by the contact
    ("time_out", 0, float("inf"), 30.0),
    ("time_out", 3, 29.0, 30.0),
    ("diverged", 0, float("inf"), 1.0),
]


def episodes(has_goal=True, clearance=None):
    outcome, contacts, first, length = zip(*TRIALS, strict=True)
    count = len(TRIALS)
    ones = torch.ones(count, dtype=torch.float64)
    return Episodes(
        length_s=torch.tensor(length, dtype=torch.float64),
        outcome=torch.tensor([OUTCOMES.index(name) for name in outcome]),
        contacts=torch.tensor(contacts),
        first_contact_s=torch.tensor(first, dtype=torch.float64),
        clearance=clearance,
        energy=300.0 * ones,
        path=5.0 * ones,
        velocity_error=0.1 * ones,
        free_velocity_error=None,
        free_s=None,
        yaw_rate_error=0.2 * ones,
        has_goal=has_goal,
        weight=150.0,
        per_env=2,
        us_per_env_step={},
    )


def rates(summary, group):
    return {name: value["rate"] for name, value in summary[group].items()}


def test_counting_lets_a_touched_trial_succeed():
    got = rates(episodes().summary(), "rates")
    assert got == {
        "success": 3 / 8,
        "success_untouched": 2 / 8,
        "collision": 3 / 8,
        "fall": 2 / 8,
        "time_out": 2 / 8,
        "diverged": 1 / 8,
    }
    assert sum(got.values()) > 1  # as in the paper


def test_ending_at_the_first_contact_is_exclusive():
    got = rates(episodes().summary(), "rates_to_first_contact")
    assert got == {"success": 2 / 8, "collision": 3 / 8, "fall": 1 / 8, "time_out": 1 / 8, "diverged": 1 / 8}
    assert sum(got.values()) == 1


def test_without_a_goal_the_time_limit_is_the_success():
    summary = episodes(has_goal=False).summary()
    assert summary["success_means"] == "time limit reached" and summary["time_to_goal_s"] is None
    assert summary["rates"]["success"]["count"] == 2 and summary["rates"]["success_untouched"]["count"] == 1
    assert summary["rates_to_first_contact"]["success"]["count"] == 1
    assert "time_out" not in summary["rates_to_first_contact"]


def test_time_to_goal_counts_successes_and_energy_everything():
    summary = episodes().summary()
    assert summary["time_to_goal_s"]["median"] == 12.0 and summary["time_to_goal_s"]["mean"] == pytest.approx(12.0)
    assert summary["cost_of_transport"] == pytest.approx(300 / (150 * 5))
    assert summary["power_w"] == pytest.approx(8 * 300 / sum(trial[3] for trial in TRIALS))
    assert summary["clearance_m"] is None


def test_quantiles_by_hand():
    got = quantiles(torch.arange(21).double())
    assert got == pytest.approx({"mean": 10.0, "p05": 1.0, "median": 10.0, "p95": 19.0})
    assert quantiles(torch.zeros(0)) is None and quantiles(None) is None


def test_the_table_has_a_column_for_each_policy():
    clearance = torch.linspace(0, 0.7, 8)
    summary = episodes(clearance=clearance).summary()
    title, head, rows = table({"run": summary, "blind": summary}).strip().split("\n", 2)
    assert title == "8 episodes, success: goal reached"
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in (head + rows).splitlines()]
    assert cells[0] == ["", "run", "blind"]
    by_name = {name: values for name, *values in cells[2:]}
    assert by_name["success"] == ["37.5 % [13.7, 69.4]"] * 2
    assert by_name["least clearance (m)"] == ["0.35 [0.04, 0.66]"] * 2


def test_trials_are_lines_of_a_table(tmp_path):
    write_trials(tmp_path / "trials.csv", {"run": episodes()})
    with open(tmp_path / "trials.csv") as file:
        rows = list(csv.DictReader(file))
    assert [(r["environment"], r["trial"]) for r in rows[:3]] == [("0", "0"), ("0", "1"), ("1", "0")]
    assert [r["outcome"] for r in rows] == [
        "success",
        "success, touched",
        "success",
        "fall",
        "fall",
        "time out",
        "time out",
        "diverged",
    ]
    assert rows[1]["first_contact_s"] == "3.0" and rows[0]["first_contact_s"] == "" and rows[0]["clearance_m"] == ""
