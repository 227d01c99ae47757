"""Every adapter of the LiDAR benchmark against mj_ray in float64, on a small scene where everything jumps."""

import numpy as np
import pytest
import torch

from benchmarks.lidar_benchmark.methods import Entry, NotForThisScene, SplitMethod, build_all
from benchmarks.lidar_benchmark.ours import OURS, Ours, mid360_scan, terrain_entries
from benchmarks.lidar_benchmark.peers import EMBREE, ONE_MESH, OPEN3D, PEERS
from benchmarks.lidar_benchmark.reference import Checker
from benchmarks.lidar_benchmark.scenes import obstacle_scene, terrain_scene

NUM_ENVS, NUM_RAYS = 3, 200
TRIANGLES = (EMBREE, OPEN3D, ONE_MESH)
ENTRIES = {entry.name: entry for entry in (OURS, *PEERS)}


def methods_of(entry, scene, num_threads=2):
    if missing := entry.missing():
        pytest.skip(f"{', '.join(missing)} not installed")
    methods, skipped = build_all([entry], scene, num_threads, "cpu")
    if any(error in skipped.get(entry.name, "") for error in ("ImportError", "ModuleNotFoundError")):
        pytest.skip(skipped[entry.name])
    assert methods, skipped
    return methods


@pytest.mark.parametrize("name", ENTRIES)
def test_ranges_are_those_of_mj_ray(name):
    motion = "static" if name == EMBREE else "jump"
    scene = obstacle_scene(mid360_scan(NUM_ENVS, NUM_RAYS), num_bodies=20, num_frames=2, motion=motion)
    for variant, method in methods_of(ENTRIES[name], scene).items():
        method.cast(0)  # what this frame leaves behind must not show in the next
        found = Checker(1, NUM_ENVS * NUM_RAYS).errors(method)
        if name in TRIANGLES:  # 16-sided shapes: some silhouettes and curved sides differ
            assert found.median < 1e-5 and found.p99 < 0.02 and found.disagree < 1.0, variant
        else:
            assert found.largest < 1e-4 and found.gross == 0.0 and found.disagree == 0.0, variant


@pytest.mark.parametrize("entry", [*terrain_entries(), *(ENTRIES[name] for name in TRIANGLES)], ids=lambda e: e.name)
def test_ranges_on_a_terrain_are_those_of_its_triangles(entry):
    scene = terrain_scene(mid360_scan(NUM_ENVS, NUM_RAYS), cells=20, cell=0.5, num_frames=2)
    for variant, method in methods_of(entry, scene).items():
        found = Checker(1, NUM_ENVS * NUM_RAYS).errors(method)
        assert found.p99 < 2e-5 and found.largest < 1e-3 and found.disagree == 0.0, variant


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


def test_a_peer_that_is_missing_or_fails_is_named_and_left_out():
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


def test_ranges_beyond_the_reach_are_misses():
    scene = obstacle_scene(mid360_scan(2, NUM_RAYS), num_bodies=20, num_frames=1)
    for name, entry in ENTRIES.items():
        if name.startswith(("ours", "mujoco.batch", "paper")):
            method = entry.build(scene, 1, "cpu")
            method.cast(0)
            ranges = method.ranges()
            assert ranges[np.isfinite(ranges)].max() <= scene.max_range
