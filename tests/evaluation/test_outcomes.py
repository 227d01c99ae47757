"""Rates and figures of hand-made trials, as numbers, as files and as tables."""

import json
import multiprocessing
from dataclasses import replace

import pytest
import torch

from omniperception.config import ConfigError
from omniperception.env.metrics import OUTCOMES
from omniperception.evaluation.report.pages import VIEWS
from omniperception.evaluation.report.records import Record, merge, read, write
from omniperception.evaluation.report.tables import difference, table
from omniperception.evaluation.trials.outcomes import Episodes
from omniperception.evaluation.trials.statistics import quantiles
from omnirobot.common.files import lock

# outcome, contacts, first contact (s), length (s)
TRIALS = [
    ("goal", 0, float("inf"), 10.0),
    ("goal", 2, 3.0, 14.0),  # touched, went on and arrived
    ("goal", 0, float("inf"), 12.0),
    ("fall", 0, float("inf"), 4.0),
    ("fall", 1, 5.0, 5.0),  # fell over what it touched
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
        impulse=2.0 * torch.tensor(contacts, dtype=torch.float64),
        first_contact_s=torch.tensor(first, dtype=torch.float64),
        clearance=clearance,
        energy=300.0 * ones,
        path=5.0 * ones,
        free_time_s=8.0 * ones if has_goal else None,
        velocity_error=0.1 * ones,
        free_velocity_error=None,
        free_s=None,
        yaw_rate_error=0.2 * ones,
        has_goal=has_goal,
        weight=150.0,
        us_per_env_step={"policy": 3.25},
    )


def record(policy="run", run="runs/a", seed=5, **changes):
    return Record(
        policy=policy,
        world="corridor",
        terrain="own",
        condition="ideal",
        condition_version=1,
        split="dev",
        run=run,
        weights="0f",
        seed=seed,
        facts={"date": "2026-11-22", "commit": "abc", "trials": len(TRIALS)},
        episodes=replace(episodes(), **changes),
    )


def cells(text):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]


def test_rates_by_hand():
    got = {name: rate["rate"] for name, rate in episodes().summary()["rates"].items()}
    assert next(iter(got)) == "untouched"
    assert got == {
        "untouched": 2 / 8,
        "success": 3 / 8,
        "collision": 3 / 8,
        "fall": 2 / 8,
        "time_out": 2 / 8,
        "diverged": 1 / 8,
    }


def test_without_a_goal_who_stays_to_the_end_succeeds():
    summary = episodes(has_goal=False).summary()
    assert summary["success_means"] == "time limit reached" and summary["time_over_free_time"] is None
    assert summary["rates"]["success"]["count"] == 2 and summary["rates"]["untouched"]["count"] == 1
    assert "time_out" not in summary["rates"]


def test_figures_by_hand():
    summary = episodes(clearance=torch.linspace(0, 0.7, 8)).summary()
    assert summary["time_over_free_time"]["median"] == 12.0 / 8.0  # of the three that arrived: 10, 12 and 14 s
    assert summary["touches_per_100_m"] == pytest.approx(100 * 6 / 40)  # six touches on eight ways of 5 m
    assert summary["touched_impulse_n_s"]["median"] == 4.0  # of 2, 4 and 6 N s
    assert summary["cost_of_transport"] == pytest.approx(300 / (150 * 5))
    assert summary["clearance_m"]["median"] == pytest.approx(0.35)
    assert episodes().summary()["clearance_m"] is None


def test_quantiles_by_hand():
    got = quantiles(torch.arange(21).double())
    assert got == pytest.approx({"mean": 10.0, "p05": 1.0, "median": 10.0, "p95": 19.0})
    assert quantiles(torch.zeros(0)) is None and quantiles(None) is None


@pytest.mark.parametrize("name", ["trials.json", "trials.json.gz"])
def test_files_hold_every_trial(tmp_path, name):
    """What is infinite or not a number is null in the file, and comes back as it was."""
    path, clearance = tmp_path / name, torch.linspace(0, 0.7, 8).double()
    blank = torch.full((8,), torch.nan, dtype=torch.float64)
    before = record(clearance=clearance, free_velocity_error=blank, free_s=0 * blank)
    write(path, [before])
    (after,) = read(path)
    assert after.key == before.key and after.facts == before.facts and after.seed == 5
    for field in ("outcome", "contacts", "first_contact_s", "length_s", "impulse", "free_time_s"):
        assert torch.equal(getattr(after.episodes, field), getattr(before.episodes, field)), field
    torch.testing.assert_close(after.episodes.clearance, clearance, atol=1e-5, rtol=0)
    assert after.episodes.free_velocity_error.isnan().all() and after.episodes.has_goal
    first = path.read_bytes()
    write(path, [after])
    assert path.read_bytes() == first


def test_a_result_replaces_the_earlier_one_of_the_same(tmp_path):
    path = tmp_path / "all.json"
    merge(path, [record(), record(policy="blind")])
    merge(path, [record(contacts=torch.zeros(8, dtype=torch.int64))])
    run, blind = read(path)
    assert (run.policy, blind.policy) == ("run", "blind")
    assert run.episodes.contacts.sum() == 0 and blind.episodes.contacts.sum() == 6


def test_what_another_process_adds_meanwhile_is_kept(tmp_path):
    path = tmp_path / "all.json"
    merge(path, [record()])
    with multiprocessing.get_context("spawn").Pool(1) as other:
        other.apply(read, (path,))  # it has started
        with lock(tmp_path):
            added = other.apply_async(merge, (path, [record(policy="blind")]))
            with pytest.raises(multiprocessing.TimeoutError):
                added.get(timeout=0.5)
            write(path, [record(), record(policy="oracle")])
        added.get()
    assert [one.policy for one in read(path)] == ["run", "oracle", "blind"]


def test_a_file_that_is_none_is_refused_in_one_line(tmp_path):
    (tmp_path / "a.json").write_text("[]")
    (tmp_path / "b.json").write_text(json.dumps({"format": 99, "records": []}))
    write(tmp_path / "d.json.gz", [record()])
    whole = (tmp_path / "d.json.gz").read_bytes()
    (tmp_path / "d.json.gz").write_bytes(whole[: len(whole) // 2])
    none = dict.fromkeys(("a.json", "c.json", "d.json.gz"), "holds no results")
    for name, message in {**none, "b.json": "has format 99"}.items():
        with pytest.raises(ConfigError, match=message):
            read(tmp_path / name)


def test_a_table_has_a_row_for_each_policy_and_the_difference_trial_by_trial():
    never = torch.zeros(8, dtype=torch.int64)
    text = table([record(contacts=never), record(policy="histogram")])
    head, _, run, paired, histogram = cells(text)
    assert head[:4] == ["world", "policy", "reached, untouched, %", "reached, %"]
    assert run[:3] == ["corridor", "run", "37.5 [13.7, 69.4]"] and histogram[2] == "25.0 [7.1, 59.1]"
    assert paired[1] == "run: difference to histogram" and paired[2].startswith("+12.5 [")
    assert "8 trials" in text and "ideal (version 1)" in text and len({len(row) for row in cells(text)}) == 1


def test_the_difference_over_all_worlds_is_that_of_their_trials():
    """Two worlds of 8 trials each: 1 more untouched in one of them, as many in the other. Of some worlds alone it would
    stand beside means over all of them."""
    never = torch.zeros(8, dtype=torch.int64)
    here = [record(contacts=never), record(policy="histogram")]
    there = [replace(one, world="moving") for one in (record(), record(policy="histogram"))]
    rows = {row[1]: row for row in cells(table([*here, *there])) if row[0] == "mean of 2"}
    assert list(rows) == ["run", "run: difference to histogram", "histogram"]
    pooled = rows["run: difference to histogram"][2]
    assert pooled.startswith("+6.2 [") and pooled != cells(table(here))[3][2]
    changed = replace(there[1], facts=there[1].facts | {"overrides": ["obstacles=mixed"]})
    walks = replace(changed, facts=changed.facts | {"walker": "b"})
    assert difference([changed], [walks]).startswith("+0.0")
    for other in (replace(there[1], seed=6), replace(there[1], run="b"), replace(there[1], split="test"), changed):
        assert difference(there[:1], [other]) == "not the same trials"
    rows = {row[1]: row for row in cells(table([*here, there[0]])) if row[0].startswith("mean")}
    assert rows["run: difference to histogram"][2] == "not the same trials"


@pytest.mark.parametrize("other", [{"split": "test"}, {"facts": {"overrides": ["a=1"]}}, {"facts": {"walker": "b"}}])
def test_two_results_of_a_run_are_no_two_trainings(other):
    """A table of all figures, and one by policy."""
    first = record()
    second = replace(first, **other | {"facts": first.facts | other.get("facts", {})})
    for render in (table, VIEWS["policies"]):
        with pytest.raises(ConfigError, match="is there twice"):
            render([first, second])
