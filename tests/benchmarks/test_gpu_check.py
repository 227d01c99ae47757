"""The GPU's check at tiny size on a CPU, and what it says without a GPU."""

import json

import pytest

from benchmarks.gpu_check import Arguments, execute
from benchmarks.harness.table import Table


def test_a_part_that_fails_is_reported_and_the_others_run(tmp_path, monkeypatch):
    def fails(options):
        raise RuntimeError("out of order")

    def runs(options):
        return [Table("fine", "All is well", ("n",), [(1,)])]

    monkeypatch.setattr("benchmarks.gpu_check.PARTS", {"first": fails, "second": runs})
    assert not execute(Arguments(device="cpu", size="small", only=("first", "second"), out=tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())["rows"]
    assert [row["result"] for row in summary] == ["FAILED: RuntimeError: out of order", "done"]
    assert (tmp_path / "fine.csv").is_file()


def test_parts_that_would_begin_too_late_are_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.gpu_check.PARTS", {"late": None})
    assert execute(Arguments(device="cpu", size="small", only=("late",), out=tmp_path, minutes=-1.0))
    (row,) = json.loads((tmp_path / "summary.json").read_text())["rows"]
    assert row["result"].startswith("left out")


@pytest.mark.slow
def test_everything_runs_tiny_on_a_cpu(tmp_path):
    pytest.importorskip("mujoco_warp")
    assert execute(Arguments(device="cpu", size="small", out=tmp_path))
    names = {"lidar_accuracy", "step_errors", "paper_table", "paper_table_baselines", "env_stages"}
    names |= {"env_stages_whole_clouds"}
    assert names | {"training", "summary"} == {path.stem for path in tmp_path.glob("*.csv")}
    summary = json.loads((tmp_path / "summary.json").read_text())["rows"]
    results = {row["part"]: row["result"] for row in summary}
    assert {part for part, result in results.items() if result != "done"} == {"tests", "syncs"}
    assert results["tests"] == results["syncs"] == "left out: it needs a GPU"
