"""The LiDAR benchmark: its scenes, every adapter against exact ranges, and each of its studies at tiny size."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

import omnilidar as lidar
from benchmarks.harness.table import Table
from benchmarks.harness.timing import Timing
from benchmarks.lidar.baselines import BASELINES, BATCH_RAY, EMBREE, ONE_MESH, OPEN3D
from benchmarks.lidar.compare import Options, Target, compare_baselines, compare_terrain, measure_features
from benchmarks.lidar.methods import Checker, Entry, NotForThisScene, SplitMethod, build_all, true_ranges
from benchmarks.lidar.ours import OURS, Ours, buffer_sizes, feature_cases, mid360_scan, terrain_entries
from benchmarks.lidar.paper import measure_appendix, measure_table
from benchmarks.lidar.scaling import growth, measure_scaling, plot_scaling, sweeps
from benchmarks.lidar.scenes import SPEED, environment_mesh, obstacle_scene, spinning_scan, terrain_scene

SCAN = spinning_scan(3, channels=4, columns=8)
TINY = Options(num_envs=2, num_rays=50, num_bodies=8, num_frames=2, rounds=2, num_samples=100)
NUM_ENVS, NUM_RAYS = 3, 200
TRIANGLES = (EMBREE, OPEN3D, ONE_MESH)
ENTRIES = {entry.name: entry for entry in (OURS, *BASELINES)}
ROOT = Path(__file__).resolve().parents[2]
REQUIRED = {
    re.match(r"[\w.-]+", line).group()
    for file in ROOT.glob("requirements*.txt")
    for line in file.read_text().splitlines()
    if line and not line.startswith("#")
}
"""What `make setup` installs."""


def needs_its_package(entry):
    """A parameter, skipped with what to install where a baseline that `make setup` does not bring is missing."""
    optional = not set(entry.package.split()) <= REQUIRED
    skip = pytest.mark.skipif(optional and bool(entry.missing()), reason=f"pip install {entry.package}")
    return pytest.param(entry, marks=skip, id=entry.name)


def methods_of(entry, scene):
    methods, skipped = build_all([entry], scene, 2, "cpu")
    assert methods, skipped
    return methods


# ---- scenes ----------------------------------------------------------------------------------------------------------


def test_a_smooth_scene_moves_at_its_speed_and_closes_its_circle():
    scene = obstacle_scene(SCAN, num_bodies=8, num_frames=16, motion="smooth")
    around = np.concatenate([scene.positions, scene.positions[:1]]).astype(float)
    steps = np.linalg.norm(np.diff(around, axis=0), axis=-1)
    chord = 2.0 * math.sin(math.pi / 16) / (2.0 * math.pi / 16)  # of the arc of one frame
    assert steps == pytest.approx(SPEED * SCAN.period_s * chord, rel=1e-4)


def test_a_jumping_scene_differs_in_each_frame_and_a_static_one_does_not():
    jump = obstacle_scene(SCAN, num_bodies=8, num_frames=3, motion="jump")
    assert np.linalg.norm(jump.positions[1] - jump.positions[0], axis=-1).mean() > 2.0
    static = obstacle_scene(SCAN, num_bodies=8, num_frames=3, motion="static")
    assert not static.moving and (static.positions[0] == static.positions[2]).all()


def test_some_environments_of_a_scene_have_the_same_rays_and_poses():
    scene = obstacle_scene(mid360_scan(3, 20), num_bodies=4, num_frames=2)
    part, repeated = scene.environments(1, 3), scene.repeated(4)
    assert (part.directions_w(1) == scene.directions_w(1)[1:]).all() and (part.quats == scene.quats[:, 1:]).all()
    assert repeated.num_envs == 4 and (repeated.directions_w(1) == scene.directions_w(1)[:1]).all()


def test_a_terrain_scene_stands_above_its_ground():
    scene = terrain_scene(SCAN, cells=20, cell=0.5, num_frames=2)
    down = np.array([[0.0, 0.0, -1.0]])
    heights = np.concatenate(true_ranges(scene, 0, [(env, down) for env in range(scene.num_envs)]))
    assert ((heights > 0.3) & (heights < 0.8)).all()
    vertices, faces = environment_mesh(scene, 0, 0)
    assert len(faces) == 2 * 20 * 20 and faces.max() == len(vertices) - 1


# ---- methods ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("entry", [needs_its_package(entry) for entry in ENTRIES.values()])
def test_ranges_are_those_of_mj_ray(entry):
    motion = "static" if entry.name == EMBREE else "jump"
    scene = obstacle_scene(mid360_scan(NUM_ENVS, NUM_RAYS), num_bodies=20, num_frames=2, motion=motion)
    for variant, method in methods_of(entry, scene).items():
        method.cast(0)  # what this frame leaves behind must not show in the next
        found = Checker(1, NUM_ENVS * NUM_RAYS).errors(method)
        assert method.ranges()[np.isfinite(method.ranges())].max() <= scene.max_range
        if entry.name in TRIANGLES:  # 16-sided shapes: some silhouettes and curved sides differ
            assert found.median < 1e-5 and found.p99 < 0.02 and found.disagree < 1.0, variant
        else:
            assert found.largest < 1e-4 and found.gross == 0.0 and found.disagree == 0.0, variant


@pytest.mark.parametrize(
    "entry", [needs_its_package(entry) for entry in (*terrain_entries(), *(ENTRIES[name] for name in TRIANGLES))]
)
def test_ranges_on_a_terrain_are_those_of_its_triangles(entry):
    scene = terrain_scene(mid360_scan(NUM_ENVS, NUM_RAYS), cells=20, cell=0.5, num_frames=2)
    for variant, method in methods_of(entry, scene).items():
        found = Checker(1, NUM_ENVS * NUM_RAYS).errors(method)
        assert found.p99 < 2e-5 and found.largest < 1e-3 and found.disagree == 0.0, variant


def test_a_shifted_pose_and_another_frame_are_found():
    scene = obstacle_scene(mid360_scan(NUM_ENVS, NUM_RAYS), num_bodies=20, num_frames=2, motion="jump")
    shifted = Ours(replace(scene, sensor_pos=scene.sensor_pos + np.float32(1e-3)), 1, "cpu")
    shifted.scene = scene
    assert Checker(1, 600).errors(shifted).median > 1e-4
    late = Ours(scene, 1, "cpu")
    late.cast = lambda frame: Ours.cast(late, frame + 1)
    assert Checker(1, 600).errors(late).gross > 10.0


def test_ours_casts_the_rays_of_the_scene():
    scene = obstacle_scene(mid360_scan(NUM_ENVS, NUM_RAYS), num_bodies=4, num_frames=3)
    ours = Ours(scene, 1, "cpu", outputs=("ranges", "directions_s"))
    for frame in (0, 2):
        ours.cast(frame)
        assert (ours.frame.directions_s == torch.from_numpy(scene.scan.directions_s(frame))).all()


def test_splitting_over_threads_changes_nothing():
    scene = obstacle_scene(mid360_scan(5, 50), num_bodies=8, num_frames=2)
    split, whole = SplitMethod(OURS.build, scene, 2, "cpu"), OURS.build(scene, 1, "cpu")
    split.cast(1), whole.cast(1)
    assert (split.ranges() == whole.ranges()).all()


def test_a_baseline_that_is_missing_or_fails_is_named_and_left_out():
    def fails(scene, num_threads, device):
        raise RuntimeError("no such thing\nsecond line")

    def unfit(scene, num_threads, device):
        raise NotForThisScene("stands still")

    entries = [
        Entry("absent", fails, modules=("no_such_module",), package="absent-package"),
        Entry("failing", fails),
        Entry("unfit", unfit),
        Entry("gpu only", fails, devices=("cuda",)),
    ]
    methods, skipped = build_all(entries, obstacle_scene(mid360_scan(1, 10), 0, 1), 1, "cpu")
    assert methods == {}
    assert skipped == {
        "absent": "not installed (no_such_module): pip install absent-package",
        "failing": "fails: RuntimeError: no such thing",
        "unfit": "stands still",
        "gpu only": "does not run on cpu",
    }


# ---- memory ----------------------------------------------------------------------------------------------------------


def test_memory_per_environment_holds_the_ranges_and_poses_at_least():
    scene, more = (obstacle_scene(mid360_scan(1, n), num_bodies=8, num_frames=1) for n in (100, 200))
    (per_env, shared), (per_env_more, shared_more) = buffer_sizes(scene), buffer_sizes(more)
    assert per_env >= 100 * 4 + 9 * 7 * 4 and shared == pytest.approx(shared_more, rel=1e-3)
    assert per_env_more - per_env >= 100 * 4


def test_memory_shared_by_all_environments_holds_the_triangles():
    """Nine floats of a triangle, its share of a tree, and the host's arrays; a field has a float for two."""
    scenes = [terrain_scene(mid360_scan(1, 10), cells=n) for n in (10, 30)]
    coarse, fine = (buffer_sizes(scene, terrain="mesh")[1] for scene in scenes)
    assert 9 * 4 * 1600 < fine - coarse < 30 * 4 * 1600
    field = buffer_sizes(scenes[1], terrain="height field")[1]
    assert field < fine - 9 * 4 * 1500


@pytest.mark.parametrize(
    ("name", "size"),
    [("points_s", 12), ("normals_w", 12), ("shape_id", 4), ("intensity", 4), ("valid", 1), ("directions_s", 12)],
)
def test_an_output_adds_its_own_bytes_and_no_others(name, size):
    scene = obstacle_scene(mid360_scan(1, 100), num_bodies=8, num_frames=1)
    bare, _ = buffer_sizes(scene)
    assert buffer_sizes(scene, outputs=("ranges", name))[0] - bare == 100 * size


# ---- studies ---------------------------------------------------------------------------------------------------------


def test_a_target_is_held_against_the_fastest_of_its_rivals():
    seconds = {"ours": [1, 2, 1], "ours, else": [2, 4, 2]}
    seconds |= {"a": [4, 8, 4.1], "a, 2 threads": [2.5, 5, 3], "b": [9, 18, 9]}
    timings = {name: Timing(wall, wall) for name, wall in seconds.items()}
    verdict = Target(3.0, ("a",)).verdict(timings)
    assert verdict == (
        "target: ours >= 3x a: NOT MET, 2.50x a, 2 threads (rounds 2.50 (2.50 to 3.00); by CPU time 3.00x)"
    )
    assert ": MET, 2.50x" in Target(2.0, ("a", "b")).verdict(timings)
    assert ": MET, 4.50x b" in Target(2.0, ("b",), "ours, else").verdict(timings)
    assert "not measured" in Target(2.0, ("c",)).verdict(timings)


def test_baselines_are_compared_with_errors_and_verdicts():
    baselines = [baseline for baseline in BASELINES if baseline.name in (BATCH_RAY, ONE_MESH)]
    smooth, static = compare_baselines(TINY, ("smooth", "static"), baselines)
    assert smooth.column("method") == ["ours", BATCH_RAY, ONE_MESH, f"{ONE_MESH}, 2 threads"]
    assert static.column("method") == ["ours", ONE_MESH, f"{ONE_MESH}, 2 threads"]
    assert max(smooth.column("largest error")[:2]) < 1e-4 < smooth.column("largest error")[2]
    assert max(smooth.column("hit/miss wrong, %")[:2]) == 0.0
    assert sum(note.startswith("target:") for note in smooth.notes) == 2
    assert "Embree (embreex): not measured" in static.notes[-1]
    (terrain,) = compare_terrain(
        TINY, cells=10, baselines=[baseline for baseline in baselines if baseline.name == ONE_MESH]
    )
    assert "200 triangles" in terrain.title and max(terrain.column("largest error")) < 1e-4


def test_scaling_is_measured_and_plotted(tmp_path):
    chosen = sweeps(quick=True)[1:3]
    table = measure_scaling(TINY, chosen, rivals=())
    assert set(table.column("sweep")) == {"environments", "bodies per environment"}
    memory = {row[:2]: row[6] for row in table.rows}
    assert memory["environments", 1] == memory["environments", 3]
    assert memory["bodies per environment", 0] < memory["bodies per environment", 8]
    plot_scaling(table, chosen, tmp_path / "scaling.png", "here")
    assert (tmp_path / "scaling.png").stat().st_size > 10_000


def test_growth_is_the_exponent():
    rows = [("bodies", n, "ours", 0, 0, float(n) ** 0.5, 0, 0, 1) for n in (10, 100, 400)]
    table = Table("t", "t", ("a",) * 9, rows)
    assert growth(table, "bodies", 100) == pytest.approx(0.5)


def test_the_paper_is_repeated():
    appendix = measure_appendix(TINY, scale=0.02, rivals=(BATCH_RAY,))
    assert appendix.column("method") == ["ours", BATCH_RAY, "the paper's, on its machines"]
    assert max(appendix.column("largest error")[:2]) < 1e-4 and min(appendix.column("preparation, %")) > 0.0
    table = measure_table(TINY, max_rays=1)
    assert table.rows == [] and table.notes[-1].startswith("no CUDA device")


def test_features_are_measured_beside_the_bare_scan():
    (table,) = measure_features(TINY, chosen=["output points_s", "mask noise"])
    assert table.column("feature")[3:] == ["output points_s", "mask noise"]
    sizes = dict(zip(table.column("feature"), table.column("bytes per environment"), strict=True))
    bare = sizes["bare: ranges, obstacles and sensor moving"]
    assert sizes["output points_s"] == bare + 12 * TINY.num_rays and sizes["nothing moves"] == bare
    assert sizes["no bodies, only the ground"] < bare


def test_every_feature_of_the_sensor_is_measured():
    cases = feature_cases()
    assert {f"output {name}" for name in lidar.OUTPUTS} - {"output ranges"} <= set(cases)
    noises = {type(noise) for case in cases.values() for noise in case.get("noise", ())}
    assert noises == set(get_args(lidar.Noise))


@pytest.mark.parametrize("name", ["motion distortion, 1 pieces", "motion distortion, 5 pieces", "all outputs"])
def test_a_feature_of_the_sensor_is_cast_frame_after_frame(name):
    scene = obstacle_scene(mid360_scan(2, 40), 3, 4, "smooth")
    bare, ours = Ours(scene, 1, "cpu"), Ours(scene, 1, "cpu", **feature_cases()[name])
    for frame in range(3):
        bare.cast(frame)
        ours.cast(frame)
        assert np.isfinite(ours.ranges()).mean() == pytest.approx(np.isfinite(bare.ranges()).mean(), abs=0.1)
