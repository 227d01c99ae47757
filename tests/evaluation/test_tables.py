"""Tables of the docs: from outcomes of trials, and those that stand there are those of the files."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from omniperception.commands.tables import Arguments, main
from omniperception.config import ConfigError
from omniperception.evaluation.report.pages import rendered
from omniperception.evaluation.report.records import Record, read, write

from .test_outcomes import episodes

ROOT = Path(__file__).resolve().parents[2]
FACTS = {
    "date": "2026-11-22T10:00:00+00:00",
    "commit": "0123456789abcdef",
    "command": "scripts/evaluate.py suite=held_out",
    "machine": {"cpu": "a processor", "device": "cpu"},
    "trials": 8,
}


def record(policy="run", world="corridor", condition="ideal", run="a", touches=None):
    trials = episodes()
    if touches is not None:
        trials = replace(trials, contacts=torch.tensor(touches))
    named = {"policy": policy, "world": world, "terrain": "flat", "condition": condition, "split": "test"}
    return Record(**named, condition_version=1, run=run, weights="0f", seed=7, facts=FACTS, episodes=trials)


@pytest.fixture
def data(tmp_path):
    records = [record(), record("blind", touches=[1] * 8), record(world="rod"), record(condition="robot")]
    write(tmp_path / "first.json.gz", records)
    return tmp_path


def page(what: str) -> str:
    return f"# Title\n\nBefore.\n\n<!-- table: {what} -->\nold\n<!-- end -->\n\nAfter.\n"


def table_of(what: str, data: Path) -> list[list[str]]:
    lines = [line for line in rendered(page(what), data).splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]


def test_a_table_stands_between_its_comments_with_its_source(data):
    text = rendered(page("first condition=ideal"), data)
    assert text.startswith("# Title\n\nBefore.\n\n<!-- table: first condition=ideal -->\n\nsplit test")
    assert text.endswith("\n\n<!-- end -->\n\nAfter.\n") and "old" not in text
    assert "| corridor" in text and "25.0 [7.1, 59.1]" in text  # 2 of 8
    assert "    scripts/evaluate.py suite=held_out\n" in text and "commit 0123456789ab;" in text and "seeds: 7;" in text
    assert rendered(text, data) == text


def test_views(data):
    corridor = ["corridor", "25.0 [7.1, 59.1]", "0.0 [0.0, 32.4]"]  # 2 of 8 trials, and none
    policies = table_of("first view=policies condition=ideal", data)
    assert policies == [["world", "run", "blind"], policies[1], corridor, ["rod", "25.0 [7.1, 59.1]", "–"]]
    worlds = table_of("first view=worlds policy=run", data)
    assert worlds[0] == ["world", "ideal", "robot"] and worlds[3] == ["rod", "25.0 [7.1, 59.1]", "–"]
    both = table_of("first view=conditions policy=run condition=ideal", data)
    assert both[2] == ["run", "25.0 [10.2, 49.5] / 25.0 [10.2, 49.5]"]  # 4 of 16 trials in two worlds


def test_runs_of_several_files_stand_below_each_other_if_they_were_in_the_same_worlds(data):
    """Of b 4 of 8 trials arrive and are touched; two worlds together have 16."""
    others = [record(run="b"), record(run="b", world="rod"), record("oracle", run="b", touches=[1] * 8)]
    write(data / "second.json.gz", [*others, record("oracle", world="rod", run="b", touches=[1] * 8)])
    rows = table_of("first,second view=trained condition=ideal policy=run,oracle", data)
    cell = "25.0 [10.2, 49.5] / 25.0 [10.2, 49.5]"
    assert rows[0] == ["run directory", "run", "oracle"] and rows[2] == ["a", cell, "–"]
    assert rows[3][:2] == ["b", cell] and rows[3][2].startswith("0.0 [0.0, 19.4]")
    with pytest.raises(
        ConfigError, match=r"a blind and a run were not in the same worlds \(only one of them in rod \(ideal\)\)"
    ):
        rendered(page("first view=trained condition=ideal"), data)
    with pytest.raises(ConfigError, match=r"blind a ideal and run a ideal were not in the same worlds"):
        rendered(page("first view=conditions"), data)
    with pytest.raises(ConfigError, match=r"run a robot and run a ideal were not in the same worlds"):
        rendered(page("first view=conditions policy=run"), data)


def test_trainings_stand_beside_each_other_and_all_worlds_below(data):
    """Of a/seed1 2 of 8 trials arrive untouched in each world, of a/seed2 none; b and c/seed2 were in one."""
    runs = [("a/seed1", None), ("a/seed2", [1] * 8)]
    both = [record(run=run, world=world, touches=touched) for run, touched in runs for world in ("rod", "corridor")]
    write(data / "third.json.gz", [*both, record(run="b")])
    third = [record(run="c/seed1"), record(run="c/seed1", world="rod"), record(run="c/seed2")]
    write(data / "fourth.json.gz", [*both, *third])
    rows = table_of("third view=trainings", data)
    assert rows[0] == ["world", "a", "b"] and [row[0] for row in rows[2:]] == ["corridor", "rod", "all 2"]
    assert rows[2][1:] == ["12.5 [3.5, 36.0] (0.0 to 25.0)", "25.0 [7.1, 59.1]"]
    assert rows[3][2] == rows[4][2] == "–" and rows[4][1] == "12.5 [5.0, 28.1] (0.0 to 25.0)"
    assert table_of("fourth view=trainings", data)[-1] == ["all 2", "12.5 [5.0, 28.1] (0.0 to 25.0)", "–"]


def test_a_terrain_that_an_override_chose_is_told_from_another(data):
    """As `evaluate scenario=all terrain=flat` notes it; of the worlds on uneven ground no trial arrives untouched."""
    grounds = {"flat": None, "mixed_easy": [1] * 8}
    of_each = [
        replace(record(touches=touches), terrain="own", facts=FACTS | {"overrides": [f"terrain={terrain}"]})
        for terrain, touches in grounds.items()
    ]
    write(data / "third.json.gz", of_each)
    cells = [table_of(f"third view=conditions terrain={terrain}", data)[2][1] for terrain in grounds]
    assert cells[0].startswith("25.0 [7.1, 59.1]") and cells[1].startswith("0.0 [0.0, 32.4]")
    assert [one.place for one in of_each] == ["corridor", "corridor, mixed_easy"]
    with pytest.raises(ConfigError, match="terrain=own shows nothing"):
        rendered(page("third terrain=own"), data)
    with pytest.raises(ConfigError, match="is there twice, with split=test terrain=flat and with"):
        rendered(page("third view=conditions"), data)


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("second", "has no second.json.gz"),
        ("first view=pie", "view=pie is unknown"),
        ("first colour=red", "colour is unknown"),
        ("first policy=run,magic", "policy=magic shows nothing"),
        ("first policy=run policy=blind", "gives a setting twice"),
    ],
)
def test_what_cannot_be_shown_is_refused(data, what, message):
    with pytest.raises(ConfigError, match=message):
        rendered(page(what), data)
    with pytest.raises(ConfigError, match="no <!-- end -->"):
        rendered("<!-- table: first -->\nforgotten", data)


def test_a_figure_changed_by_hand_and_a_changed_file_are_found(data, capsys):
    path = data / "page.md"
    path.write_text(page("first condition=ideal"))
    given = {"pages": (data,), "data": data}
    main(Arguments(**given))
    main(Arguments(**given, check=True))
    good = path.read_text()
    path.write_text(good.replace("25.0 [7.1", "26.0 [7.1"))
    with pytest.raises(ConfigError, match=r"page\.md differ"):
        main(Arguments(**given, check=True))
    path.write_text(good)
    first = read(data / "first.json.gz")[0]
    write(
        data / "first.json.gz", [replace(first, episodes=replace(first.episodes, contacts=1 - first.episodes.contacts))]
    )
    with pytest.raises(ConfigError, match=r"page\.md differ"):
        main(Arguments(**given, check=True))


def test_the_tables_of_the_docs_are_those_of_the_files():
    pages = (ROOT / "README.md", ROOT / "docs")
    main(Arguments(pages=pages, data=ROOT / "docs" / "lab" / "data", check=True))


def test_every_result_on_the_test_split_is_noted():
    """By its weights: a study names its runs from its own folder."""
    names = ("weights", "policy", "world", "terrain", "condition", "condition_version", "seed", "commit")
    lab = ROOT / "docs" / "lab"
    lines = [json.loads(line) for line in (lab / "evaluations.jsonl").read_text().splitlines()]
    for line in lines:
        line["commit"] += "+changes" if line.get("changes") else ""
    noted = {tuple(line[name] for name in names) for line in lines}
    for path in (lab / "data").iterdir():
        for record in read(path):
            plain = record.plain()
            if record.split == "test":
                assert tuple(plain[name] for name in names) in noted, record.key
