"""Timing, memory, reports and the command of the LiDAR benchmark, at tiny sizes."""

import importlib.util
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import pytest
import torch
import warp as wp

from benchmarks.lidar_benchmark import timing
from benchmarks.lidar_benchmark.compare import Bar, Options, compare_peers, compare_terrain
from benchmarks.lidar_benchmark.features import measure_features
from benchmarks.lidar_benchmark.memory import buffer_bytes, buffer_sizes
from benchmarks.lidar_benchmark.ours import feature_cases, mid360_scan
from benchmarks.lidar_benchmark.paper import measure_appendix, measure_table
from benchmarks.lidar_benchmark.peers import BATCH_RAY, ONE_MESH, PEERS
from benchmarks.lidar_benchmark.report import Table, machine, write
from benchmarks.lidar_benchmark.run import ArgumentError, RunOptions, written
from benchmarks.lidar_benchmark.scaling import growth, measure_scaling, plot_scaling, sweeps
from benchmarks.lidar_benchmark.scenes import obstacle_scene, terrain_scene
from benchmarks.lidar_benchmark.timing import Timing, paired_ratio, paired_timings
from omniperception import lidar

ROOT = Path(__file__).parents[2]
TINY = Options(num_envs=2, num_rays=50, num_bodies=8, num_frames=2, rounds=2, num_samples=100)


class Clock:
    """A clock that only work moves."""

    def __init__(self):
        self.now = 0.0

    def work(self, seconds):
        def cast(frame):
            self.now += seconds

        return cast


def test_ratios_are_of_the_same_round(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(timing.time, "perf_counter", lambda: clock.now)
    monkeypatch.setattr(timing.time, "process_time", lambda: 2.0 * clock.now)
    timings = paired_timings({"ours": clock.work(0.01), "other": clock.work(0.03)}, rounds=3)
    assert timings["ours"].wall_s == pytest.approx([0.01] * 3) and timings["ours"].median_cpu_s == pytest.approx(0.02)
    assert paired_ratio(timings["other"], timings["ours"]).median == pytest.approx(3.0)


def test_a_bar_is_held_against_the_fastest_of_its_rivals():
    seconds = {
        "ours": [1, 2, 1],
        "a": [4, 8, 4.1],
        "a, 2 threads": [2.5, 5, 3],
        "b": [9, 18, 9],
        "ours, else": [2, 4, 2],
    }
    timings = {name: Timing(wall, wall) for name, wall in seconds.items()}
    verdict = Bar(3.0, ("a",)).verdict(timings)
    assert verdict.startswith(
        "bar: ours >= 3x the fastest of a: NOT MET, 2.50x a, 2 threads (rounds 2.50 to 3.00; by CPU time 3.00x)"
    )
    assert ": MET, 2.50x" in Bar(2.0, ("a", "b")).verdict(timings)
    assert ": MET, 4.50x b" in Bar(2.0, ("b",), "ours, else").verdict(timings)
    assert "not measured" in Bar(2.0, ("c",)).verdict(timings)


def test_shared_buffers_count_once():
    @dataclass
    class Holder:
        first: torch.Tensor
        second: list
        array: wp.array

    wp.init()
    tensor = torch.zeros(10, dtype=torch.float32)
    other = torch.zeros(3, dtype=torch.float64)
    holder = Holder(tensor, [tensor[2:], {"x": other}], wp.from_torch(tensor))
    assert buffer_bytes(holder, tensor) == 40 + 24


def test_memory_per_environment_holds_the_ranges_and_poses_at_least():
    scene = obstacle_scene(mid360_scan(1, 100), num_bodies=8, num_frames=1)
    more = obstacle_scene(mid360_scan(1, 200), num_bodies=8, num_frames=1)
    (each, shared), (each_more, shared_more) = buffer_sizes(scene), buffer_sizes(more)
    assert each >= 100 * 4 + 9 * 7 * 4 and shared == pytest.approx(shared_more, rel=1e-3)
    assert each_more - each >= 100 * 4


def test_memory_shared_by_all_environments_holds_the_triangles():
    """Nine floats of a triangle and its share of a tree; a height field is a float for two triangles."""
    (_, coarse), (_, fine) = (
        buffer_sizes(terrain_scene(mid360_scan(1, 10), cells=n), terrain="mesh") for n in (10, 30)
    )
    assert 9 * 4 * 1600 < fine - coarse < 20 * 4 * 1600
    field = buffer_sizes(terrain_scene(mid360_scan(1, 10), cells=30), terrain="height field")[1]
    assert field < fine - 9 * 4 * 1500


def test_peers_are_compared_with_errors_and_verdicts():
    peers = [peer for peer in PEERS if peer.name in (BATCH_RAY, ONE_MESH)]
    smooth, jump, static = compare_peers(TINY, peers=peers)
    names = [row[0] for row in smooth.rows]
    assert names == ["ours", BATCH_RAY, ONE_MESH, f"{ONE_MESH}, 2 threads"] and [r[0] for r in jump.rows] == names
    assert [row[0] for row in static.rows] == ["ours", ONE_MESH, f"{ONE_MESH}, 2 threads"]
    ours = dict(zip(smooth.columns, smooth.rows[0], strict=True))
    assert ours["times slower than ours"] == 1.0 and ours["largest error"] < 1e-4 and ours["hit/miss wrong, %"] == 0.0
    assert sum(note.startswith("bar:") for note in smooth.notes) == 2
    assert "Embree (embreex): not measured" in static.notes[-1]


def test_the_terrain_is_compared():
    (table,) = compare_terrain(TINY, cells=10, peers=[peer for peer in PEERS if peer.name == ONE_MESH])
    assert "200 triangles" in table.title


def test_scaling_is_measured_and_plotted(tmp_path):
    pytest.importorskip("matplotlib")
    chosen = sweeps(quick=True)
    table = measure_scaling(TINY, chosen, rivals=())
    assert {row[0] for row in table.rows} >= {"rays", "environments", "bodies per environment"}
    plot_scaling(table, chosen, tmp_path / "scaling.png", "here")
    assert (tmp_path / "scaling.png").stat().st_size > 10_000


def test_growth_is_the_exponent():
    rows = [("bodies", n, "ours", 0, 0, float(n) ** 0.5, 0, 0, 1) for n in (10, 100, 400)]
    table = Table("t", "t", ("a",) * 9, rows)
    assert growth(table, "bodies", 100) == pytest.approx(0.5)


def test_the_paper_is_repeated():
    appendix = measure_appendix(TINY, scale=0.02, rivals=(BATCH_RAY,))
    assert [row[0] for row in appendix.rows] == ["ours", BATCH_RAY, "the paper's, on its machines"]
    assert all(row[4] > 0.0 for row in appendix.rows)
    table = measure_table(TINY, max_rays=1)
    assert table.rows == [] and table.notes[-1].startswith("no CUDA device")


def test_features_are_measured_beside_the_bare_scan():
    (table,) = measure_features(TINY, chosen=["output points_s", "mask noise"])
    bare = dict(zip(table.columns, table.rows[0], strict=True))
    assert bare["CPU time over the bare scan's"] == 1.0 and [row[0] for row in table.rows[3:]] == [
        "output points_s",
        "mask noise",
    ]
    assert all(row[-1] > 0 for row in table.rows)


@pytest.mark.parametrize(
    ("name", "size"),
    [("points_s", 12), ("normals_w", 12), ("shape_id", 4), ("intensity", 4), ("valid", 1), ("directions_s", 12)],
)
def test_an_output_adds_its_own_bytes_and_no_others(name, size):
    scene = obstacle_scene(mid360_scan(1, 100), num_bodies=8, num_frames=1)
    bare, _ = buffer_sizes(scene)
    assert buffer_sizes(scene, outputs=("ranges", name))[0] - bare == 100 * size


def test_motion_distortion_holds_poses_only_when_it_is_on():
    scene = obstacle_scene(mid360_scan(1, 100), num_bodies=8, num_frames=1)
    bare, _ = buffer_sizes(scene)
    assert buffer_sizes(scene, motion_segments=0)[0] == bare < buffer_sizes(scene, motion_segments=1)[0]


def test_every_feature_of_the_sensor_is_measured():
    cases = feature_cases()
    assert {f"output {name}" for name in lidar.OUTPUTS} - {"output ranges"} <= set(cases)
    noises = {type(noise) for case in cases.values() for noise in case.get("noise", ())}
    assert noises == set(get_args(lidar.Noise))


def test_results_are_written_with_machine_and_versions(tmp_path):
    table = Table("speed", "how fast", ("name", "ms"), [("ours", 1.5), ("none", float("nan"))], ["a note"])
    write(table, machine(2, "cpu"), tmp_path)
    content = json.loads((tmp_path / "speed.json").read_text())
    assert content["rows"] == [{"name": "ours", "ms": 1.5}, {"name": "none", "ms": None}]
    assert content["machine"]["threads"] == 2 and content["machine"]["libraries"]["warp-lang"]
    assert (tmp_path / "speed.csv").read_text().startswith("name,ms,date,cpu,threads\nours,1.5,")
    assert "| ours | 1.5 |" in written(tmp_path) and "a note" in written(tmp_path)
    with pytest.raises(ArgumentError, match="holds no results yet"):
        written(tmp_path / "empty")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"rounds": 0}, "repeats=0"),
        ({"size": "huge"}, "size=huge must be one of full, small"),
        ({"motions": ("fly",)}, "motions=fly must be out of"),
    ],
)
def test_wrong_arguments_are_named(wrong, message):
    with pytest.raises(ArgumentError, match=message):
        RunOptions(**wrong)


@pytest.fixture
def command(monkeypatch, capsys):
    """Runs the script in this process: (exit code, standard output, standard error)."""
    path = ROOT / "scripts" / "benchmark_lidar.py"
    spec = importlib.util.spec_from_file_location("benchmark_lidar", path)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", [str(path), *arguments])
        code = 0
        try:
            script.main()
        except SystemExit as end:
            code = end.code
        return code, *capsys.readouterr()

    return run


@pytest.mark.slow
def test_the_command_measures_and_prints_its_table(command, tmp_path):
    code, output, _ = command("what=features", "size=small", "repeats=1", f"out={tmp_path}")
    assert code == 0 and "CPU time over the bare scan's" in output and (tmp_path / "features.csv").exists()
    assert "CPU time over the bare scan's" in command("what=table", f"out={tmp_path}")[1]


@pytest.mark.parametrize("argument", ["what=nothing", "speed=3", "repeats=many", "motions=fly"])
def test_the_command_says_what_is_wrong_in_one_line(command, argument):
    code, _, error = command(argument)
    assert code == 2 and error.startswith("error: ") and error.count("\n") == 1
