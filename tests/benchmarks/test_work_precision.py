"""References against closed forms, errors that grow as theory says, and that defaults of conf/ are as good as any."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.work_precision import lidar, physics, policy
from benchmarks.work_precision.__main__ import command
from benchmarks.work_precision.scene import MovingScene, Truth, dense_directions, moving_scene
from omnilidar import LidarConfig
from omniperception.commands.export import command as export
from omniperception.config import ConfigError
from omniperception.env.metrics import OUTCOMES
from omniperception.evaluation.report.records import Record, write
from omniperception.evaluation.trials.outcomes import Episodes

ROOT = Path(__file__).resolve().parents[2]


def one_cylinder(distance: float, azimuth: float) -> MovingScene:
    """A cylinder of radius 0.25 m beside a robot that stands at the origin, turned by `azimuth`."""
    at = [distance * math.cos(azimuth), distance * math.sin(azimuth), 0.8]
    zero = np.zeros((1, 1))
    return MovingScene(
        ("cylinder",), np.array([[0.25, 0.8, 0.0]]), np.array([[at]]), np.zeros((1, 1, 3)), zero, zero, np.zeros(1)
    )


def test_true_ranges_and_sectors_of_one_cylinder():
    scene, config = one_cylinder(2.0, 0.0), LidarConfig(max_range=6.0)
    truth = Truth(scene, config)
    ahead, up = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]])
    assert truth.scan(0.0, 0, ahead)[0] == pytest.approx([1.75]) and truth.scan(0.0, 0, up)[0] == [math.inf]
    sectors = truth.sectors(0.0, [dense_directions((-0.1, 0.1), 0.5)], 36, 4.0)[0]
    assert sectors[17:19] == pytest.approx([1.75, 1.75], abs=1e-3)  # the two sectors beside the x axis
    assert (sectors[:16] == 4.0).all() and (sectors[20:] == 4.0).all()


def test_the_scene_moves_smoothly(make_config):
    scene = moving_scene(make_config("obstacles=mixed").env.obstacles, 3)
    step = 1e-4
    for motion in (lambda t: scene.base(t)[0], lambda t: scene.obstacles(t)[0], lambda t: scene.base(t)[1]):
        before, now, after = (motion(0.7 + k * step) for k in (-1, 0, 1))
        assert np.abs(after - 2 * now + before).max() < 10.0 * 60.0 * step**2  # no jumps, bounded acceleration


@pytest.fixture(scope="module")
def lidar_bench(make_config):
    sizes = replace(lidar.SMALL, num_envs=4, rounds=1)
    return lidar.Bench(make_config("obstacles=mixed"), sizes)


def test_tessellations_converge_to_exact_shapes(lidar_bench):
    measured = lidar.shapes_study(lidar_bench, triangles=(8, 128, 2048))
    errors = {c.name: c.errors[lidar.RANGE] for c in measured.choices}
    assert errors["exact"] < 1e-5 < errors["2048 triangles"] < errors["128 triangles"] < errors["8 triangles"]


def test_a_sensor_that_is_mounted_elsewhere_errs(lidar_bench):
    x, y, z = lidar_bench.sensor.mount_pos
    moved = lidar.Caster(lidar_bench, mount_pos=(x, y, z + 0.01))
    assert lidar.frame_errors(lidar_bench, moved, moved.frame)[lidar.RANGE] > 5e-3


def test_stale_poses_err(lidar_bench):
    measured = lidar.staleness_study(lidar_bench, every=(1, 2, 5))
    errors = [c.errors[lidar.RANGE] for c in measured.choices]
    assert errors[0] < 1e-5 and 0.05 < errors[1] < errors[2]


def test_more_rays_err_less(lidar_bench):
    measured = lidar.rays_study(lidar_bench, counts=(500, 1000), strategies=("every_kth", "stratified"))
    errors = {c.name: c.errors[lidar.SECTOR] for c in measured.choices}
    assert errors["1000 stratified"] < errors["500 stratified"] and errors["1000 every_kth"] < errors["500 every_kth"]


def test_motion_pieces_converge_to_rays_at_their_own_times(lidar_bench):
    measured = lidar.motion_study(lidar_bench, segments=(0, 2, 10))
    off, two, ten = (c.errors["range 99 % (m)"] for c in measured.choices)
    assert off > 0.05 and ten < two / 3.0 < off / 3.0


SHORT = replace(physics.SMALL, rounds=1)


@pytest.fixture(scope="module")
def physics_bench(make_config):
    return physics.Bench(make_config("experiment=walk"), SHORT)


def test_shorter_steps_err_less(physics_bench):
    measured = physics.steps_study(physics_bench, integrators=("euler", "implicitfast", "implicit"), outside=())
    errors = {c.name: c.errors[physics.SAME] for c in measured.choices}
    assert errors["implicitfast 2 ms"] < errors["implicitfast 5 ms"] < errors["implicitfast 10 ms"]


def test_more_iterations_err_less(physics_bench):
    measured = physics.solver_study(physics_bench)
    errors = {c.name: c.errors[physics.TRUE] for c in measured.choices}
    assert errors["elliptic 10"] < errors["elliptic 1"]


def test_the_reference_is_settled_before_chaos(physics_bench):
    for trajectory in physics_bench.trajectories:
        assert physics_bench.growths[trajectory.name] < physics.GROWTH
        assert physics_bench.doubts[trajectory.name] < 1e-4  # RK4 at the same step says the same


@pytest.mark.parametrize(
    ("paths", "labels"),
    [
        (["o/study/rings/seed1", "o/study/gru/seed1"], ["rings/seed1", "gru/seed1"]),
        (["o/study/rings/seed1", "o/flat"], ["study/rings/seed1", "flat"]),
        (["o/study/rings"], ["rings"]),
        (["o/a", "o/a/a"], ["a", "a/a"]),
    ],
)
def test_runs_are_named_below_the_folder_that_they_share(tmp_path, paths, labels):
    for path in paths:
        (tmp_path / path).mkdir(parents=True, exist_ok=True)
        (tmp_path / path / "config.yaml").write_text("")
    found = [run.name for run in policy.trained_runs([str(tmp_path / path) for path in paths])]
    assert found == labels


def record(outcome: list[int], contacts: list[int], world: str = "corridor") -> Record:
    columns = ("length_s", "first_contact_s", "energy", "path", "velocity_error", "yaw_rate_error")
    plain = dict.fromkeys(columns, [1.0] * len(outcome)) | {"has_goal": True, "weight": 150.0}
    episodes = Episodes.from_columns({**plain, "outcome": outcome, "contacts": contacts})
    named = {"policy": "run", "world": world, "terrain": "own", "condition": "none", "split": "dev"}
    facts = {"date": "2026-11-22"}
    return Record(**named, condition_version=0, run="a", weights="0f", seed=1, facts=facts, episodes=episodes)


def test_policies_are_judged_by_what_evaluation_wrote(tmp_path):
    run = policy.TrainedRun(tmp_path, "run")
    with pytest.raises(ConfigError, match=r"has not been evaluated; first: .*omniperception evaluate .*run="):
        run.scenarios()
    outcome = [OUTCOMES.index(name) for name in ["goal"] * 18 + ["fall", "time_out"]]
    write(
        tmp_path / "evaluation" / "dev-ideal-corridor-own-run-20.json",
        [record(outcome, contacts=[0] * 14 + [1] * 5 + [0])],
    )
    errors = policy.rates_of(run.scenarios()["corridor"])
    assert errors[policy.FAILED] == pytest.approx(30.0) and errors["collision (%)"] == pytest.approx(25.0)
    assert errors["low (%)"] == pytest.approx(100 - 85.45, abs=0.01)  # Wilson, 14 of 20
    assert errors["high (%)"] == pytest.approx(100 - 48.10, abs=0.01)
    with pytest.raises(ConfigError, match=r"has not been exported; first: .*omniperception export .*run="):
        _ = run.exported


@pytest.mark.slow
def test_trained_policies_are_timed_as_they_were_exported(tmp_path, capsys):
    run = tmp_path / "gait"
    shutil.copytree(ROOT / "pretrained" / "gait", run)
    export([f"run={run}", "formats=onnx"])
    outcome = [OUTCOMES.index(name) for name in ("goal", "goal", "time_out", "fall")]
    write(
        run / "evaluation" / "dev-ideal-static-own-run-4.json", [record(outcome, contacts=[0, 0, 0, 0], world="static")]
    )
    command(["subject=policy", f"runs={run}", f"default={run}", "size=small", f"out={tmp_path / 'out'}"])
    assert "The default, gait, is on it, alone." in capsys.readouterr().out
    (row,) = json.loads((tmp_path / "out" / "policy" / "policy_static.json").read_text())["rows"]
    assert row[policy.FAILED] == 50.0 and row["parameters"] > 0 and 0.0 < row[policy.COST] < 1e5


def test_the_command_writes_tables_and_plot(tmp_path, capsys):
    command(["subject=lidar", "only=shapes,poses", "size=small", f"out={tmp_path}"])
    assert "The default, exact," in capsys.readouterr().out
    written = {path.name for path in (tmp_path / "lidar").iterdir()}
    assert written >= {"fronts.png", "shapes.csv", "shapes.json", "poses.csv", "poses.json"}
    content = json.loads((tmp_path / "lidar" / "shapes.json").read_text())
    assert {row["choice"] for row in content["rows"]} >= {"exact", "4096 triangles"}
