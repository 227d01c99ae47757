"""The GPU's check and the memory command at tiny size on a CPU, and what they say without a GPU."""

import json
from dataclasses import replace

import pytest

from benchmarks import memory
from benchmarks.gpu_check import Arguments, execute
from benchmarks.harness.table import Table
from omniperception.build import build_runner

TINY = ("experiment=walk", "ppo.num_steps_per_env=4", "ppo.hidden_dims=[32,16]", "ppo.num_mini_batches=2")


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
    assert names | {"training", "memory", "summary"} == {path.stem for path in tmp_path.glob("*.csv")}
    summary = json.loads((tmp_path / "summary.json").read_text())["rows"]
    results = {row["part"]: row["result"] for row in summary}
    assert {part for part, result in results.items() if result != "done"} == {"tests", "syncs"}
    assert results["tests"] == results["syncs"] == "left out: it needs a GPU"


def test_memory_is_predicted_from_few_environments(make_config):
    """What is predicted for 24 environments from 4 and 8 is what a run of 24 holds."""
    run = make_config(*TINY, "num_envs=24")
    predicted = {part.name: part.total(24) for part in memory.predict(run)}
    held = memory.held_bytes(build_runner(run, None))
    for name, size in held.items():
        assert predicted[name] == pytest.approx(size, rel=0.01), name
    assert predicted["rollout"] > 24 * 4 * 33 * 4 and predicted["networks"] > 0


def test_memory_of_clouds_that_are_cast_in_parts(make_config):
    """24 environments whose clouds exist 8 at a time; the samplers' memory goes with them."""
    run = make_config("obstacles=static", "num_envs=24", "lidar.num_rays=500", "lidar.cloud_mb=0.13", *TINY[1:])
    runner = build_runner(replace(run, env=replace(run.env, full_level=True)), None)
    assert len(runner.env.sensing.lidar.env_slices) == 3
    predicted = {part.name: part.total(24) for part in memory.predict(run)}
    assert predicted["rays"] == pytest.approx(memory.held_bytes(runner)["rays"], rel=0.01)
    whole = replace(run, env=replace(run.env, lidar=replace(run.env.lidar, cloud_mb=1000.0)))
    assert predicted["rays"] < {part.name: part.total(24) for part in memory.predict(whole)}["rays"] - 16 * 500 * 60
