"""The LiDAR: frames, phase, mounting, ranges, and parity with general rays through the same scene."""

import dataclasses
import itertools
import math
import warnings

import numpy as np
import pytest
import torch
from lidar_helpers import clock, closed_shapes, random_quats, select_rows
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from omnilidar import (
    OUTPUTS,
    GaussianNoise,
    Lidar,
    LidarConfig,
    RayScene,
    ScanPattern,
    Shape,
    ShapeKind,
    grid,
    make_selection,
    quat_from_rpy,
)

K = ShapeKind


def crowd(num_envs, seed=0, num_threads=2):
    """A plane, a carrier and one body of each closed kind per environment, in random poses."""
    closed = [dataclasses.replace(shape, class_id=1 + i % 3) for i, shape in enumerate(closed_shapes(15, 1))]
    scene = RayScene([Shape(K.PLANE), *closed], num_envs, 16, num_threads=num_threads)
    generator = torch.Generator().manual_seed(seed)
    scene.body_pos[:] = 6.0 * torch.rand(scene.body_pos.shape, generator=generator) - 3.0
    scene.body_pos[..., 2].abs_()
    scene.body_quat[:] = random_quats(generator, num_envs, 16)
    return scene


def test_every_output_is_rewritten_after_a_hit(pattern):
    scene = RayScene([Shape(K.SPHERE, (1.0,), body=0, class_id=4)], 2, 1)
    lidar = Lidar(LidarConfig(500), pattern, scene, -1, outputs=OUTPUTS)
    frame = lidar.cast(clock(2, 0.1))  # the sensor is inside the sphere
    assert torch.allclose(frame.ranges, torch.ones(2, 500), atol=1e-5) and (frame.class_id == 4).all()
    scene.body_pos[1, 0, 2] = -1000.0
    frame = lidar.cast(clock(2, 0.1))
    assert torch.isfinite(frame.ranges[0]).all()
    assert (frame.ranges[1] == math.inf).all()
    assert (frame.shape_id[1] == -1).all() and (frame.class_id[1] == -1).all() and (frame.body_id[1] == -2).all()
    assert not frame.valid[1].any() and frame.valid[0].all()
    for points in (frame.points_s, frame.points_b, frame.points_w, frame.incidence):
        assert points[0].isfinite().all() and points[1].isnan().all()
    assert (frame.normals_w[1] == 0.0).all() and (frame.intensity[1] == 0.0).all()


def test_a_surface_nearer_than_the_minimum_blocks_and_returns_nothing(pattern):
    near, far = Shape(K.SPHERE, (0.09,)), Shape(K.SPHERE, (3.0,))
    scene, outputs = RayScene([near, far], 1, 0), ("ranges", "shape_id")
    lidar = Lidar(LidarConfig(50, min_range=0.1), pattern, scene, -1, outputs=outputs)
    frame = lidar.cast(clock(1, 0.1))
    assert (frame.ranges == math.inf).all() and (frame.shape_id == -1).all()
    excluding = Lidar(LidarConfig(50, min_range=0.1), pattern, lidar.scene, -1, exclude_shapes=(0,))
    assert torch.allclose(excluding.cast(clock(1, 0.1)).ranges, torch.full((1, 50), 3.0), atol=1e-5)


@pytest.mark.parametrize(("max_range", "expected"), [(4.99, math.inf), (5.01, 5.0)])
def test_beyond_the_maximum_range_is_a_miss(max_range, expected):
    scene = RayScene([Shape(K.BOX, (0.5, 9.0, 9.0), pos=(5.5, 0.0, 0.0))], 1, 0)
    lidar = Lidar(LidarConfig(1, 1 / 30, 0.1, max_range), grid(1, 1, 10.0), scene, -1)
    assert float(lidar.cast(0.0).ranges) == pytest.approx(expected, abs=1e-5)


def test_mounting_follows_the_body():
    scene = RayScene([Shape(K.PLANE)], 1, 1)
    scene.body_pos[0, 0, 2] = 2.0
    config = LidarConfig(1, 1 / 30, 0.1, 50.0, (0.0, 0.0, 0.5), (0.0, math.radians(30.0), 0.0))
    lidar = Lidar(config, grid(1, 1, 10.0), scene, 0)
    assert float(lidar.cast(clock(1, 0.0)).ranges) == pytest.approx(2.5 / math.sin(math.radians(30.0)), rel=1e-5)
    scene.body_quat[0, 0] = torch.tensor(quat_from_rpy(0.0, math.radians(60.0), 1.0))  # nose down by 60 more
    assert float(lidar.cast(clock(1, 0.0)).ranges) == pytest.approx(2.0 + 0.5 * math.cos(math.radians(60.0)), rel=1e-5)


@pytest.mark.parametrize("num_envs", [1, 3, 7])
@pytest.mark.parametrize("num_rays", [1, 1777])
@pytest.mark.parametrize("empty", [True, False])
def test_odd_counts_give_the_same_on_any_number_of_threads(pattern, num_envs, num_rays, empty):
    frames = []
    for threads in (1, 2, 5):
        scene = RayScene([], num_envs, 1, num_threads=threads) if empty else crowd(num_envs, num_threads=threads)
        frames.append(Lidar(LidarConfig(num_rays), pattern, scene, 0, outputs=OUTPUTS).cast(clock(num_envs, 0.3)))
    for name, other in itertools.product(OUTPUTS, frames[1:]):
        assert torch.equal(getattr(frames[0], name).nan_to_num(-7.0), getattr(other, name).nan_to_num(-7.0)), name
    assert frames[0].ranges.shape == (num_envs, num_rays)


class Allocations(TorchDispatchMode):
    """Operations whose result has memory of its own, rather than that of an argument."""

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        known = {a.untyped_storage().data_ptr() for a in tree_leaves((args, kwargs)) if isinstance(a, torch.Tensor)}
        made = [a.untyped_storage().data_ptr() for a in tree_leaves(result) if isinstance(a, torch.Tensor)]
        self.found += [str(func) for pointer in made if pointer not in known]
        return result


@pytest.mark.parametrize(
    "options",
    [{}, {"selection": "stratified"}, {"motion_segments": 1}],
    ids=lambda options: "-".join(map(str, options.values())) or "plain",
)
def test_a_cast_allocates_no_tensor(pattern, options):
    scene = crowd(3)
    scene.body_quat[:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    lidar = Lidar(LidarConfig(50, **options), pattern, scene, 0, noise=(GaussianNoise(),), outputs=OUTPUTS)
    time = clock(3, 0.5)
    lidar.cast(time)
    with Allocations() as allocations:
        frame = lidar.cast(time)
    assert allocations.found == [] and frame is lidar.frame


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_range": -1}, "lidar.max_range=-1 must be > lidar.min_range=0.1"),
        ({"mount_quat": (1.0, 1.0, 0.0, 0.0)}, "lidar.mount_quat"),
        ({"mount_quat": (1.0, 0.0, 0.0, 0.0), "mount_rpy": (0.0, 0.0, 0.0)}, "both given"),
    ],
)
def test_wrong_configs_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        LidarConfig(**options)


@pytest.mark.parametrize(
    ("num_rays", "body", "options", "message"),
    [
        (30_000, 0, {}, "lidar.num_rays=30000 must be in 1..20000"),
        (
            10,
            0,
            {"outputs": ("ranges", "colour")},
            r"lidar.outputs=\['colour'\] must be names out of ranges, true_range",
        ),
    ],
)
def test_wrong_sensors_are_refused(pattern, num_rays, body, options, message):
    with pytest.raises(ValueError, match=message):
        Lidar(LidarConfig(num_rays), pattern, RayScene([], 2, 1), body, **options)


@pytest.mark.parametrize(
    ("envs_at_once", "time", "message"),
    [
        (None, torch.zeros(2), "float64"),
        (2, 0.1, "2 slices; use cast_slices, or envs_at_once=None"),
        (None, np.array([0.1, math.inf, 0.1]), "time_s=inf must be finite"),
    ],
)
def test_wrong_casts_are_refused(pattern, envs_at_once, time, message):
    with pytest.raises(ValueError, match=message):
        Lidar(LidarConfig(10), pattern, RayScene([], 3, 1), 0, envs_at_once=envs_at_once).cast(time)


@pytest.mark.parametrize(("num_rows", "stride"), [(12, 1), (12, 5), (12, 4), (12, 6), (35, 10), (7, 7), (1, 3)])
def test_a_frame_is_every_kth_row_whatever_the_table(num_rows, stride):
    """Also where the steps do not reach every row, and where a frame is longer than the table."""
    num_rays, period = 5, 5 * stride / 100.0
    angles = torch.linspace(-0.5, 0.5, num_rows).numpy()
    pattern = ScanPattern.from_angles(angles, 2.0 * angles, 100.0)
    assert pattern.stride(period, num_rays) == stride
    outputs = ("row", "directions_s", "elevation", "azimuth")
    lidar = Lidar(LidarConfig(num_rays, period), pattern, RayScene([], 20, 0), -1, outputs=outputs)
    assert num_rows < 6 or lidar.phase_rows.unique().numel() > 1  # each environment has a phase of its own
    for frame_number in range(3):
        frame = lidar.cast(clock(20, (frame_number + 1) * period))
        first = frame_number * num_rays * stride + lidar.phase_rows[:, None]
        rows = (first + stride * torch.arange(num_rays)) % num_rows
        assert torch.equal(frame.row.long(), rows)
        for name in outputs[1:]:
            assert torch.equal(getattr(frame, name), getattr(pattern, name)[rows])


def test_a_selection_reports_and_casts_its_rows(pattern):
    """Rows and directions are those of the pattern's own function, and hits are those of its directions."""
    config = LidarConfig(500, selection="stratified", max_range=10.0)
    scene = RayScene([Shape(K.SPHERE, (2.0,)), Shape(K.BOX, (0.3, 0.2, 0.4), pos=(0.9, 0.4, 0.2))], 3, 0)
    lidar = Lidar(config, pattern, scene, -1, seed=4, outputs=("ranges", "row", "directions_s"))
    bank = make_selection(pattern, 0.1, 500, "stratified", 4)
    for number, time in enumerate((0.1, 0.2, 0.3)):
        frame = lidar.cast(clock(3, time))
        rows = select_rows(pattern, clock(3, time), 0.1, 500, lidar.phase_rows, bank, number)
        assert torch.equal(frame.row.long(), rows)
        assert torch.equal(frame.directions_s, pattern.directions_s[rows])
        hits = scene.cast(torch.zeros(3, 500, 3), frame.directions_s, 10.0)
        assert torch.isclose(frame.ranges, hits.ranges, rtol=1e-4, atol=1e-4).float().mean() > 0.995


def sphere_grid():
    """Directions all over the sphere, the poles and the azimuth of 360 degrees included."""
    elevation, azimuth = torch.meshgrid(
        torch.linspace(-math.pi / 2, math.pi / 2, 46), torch.linspace(0.0, 2.0 * math.pi, 61), indexing="ij"
    )
    return ScanPattern.from_angles(elevation.flatten().numpy(), azimuth.flatten().numpy(), 46 * 61 * 10.0)


@pytest.mark.parametrize("num_bodies", [8, 60, 200])
def test_searching_many_shapes_at_once_finds_what_one_by_one_finds(num_bodies):
    """Shapes of all kinds: around the sensor, beside it, above and below it, behind one another."""
    generator = torch.Generator().manual_seed(num_bodies)
    shapes = [
        *closed_shapes(num_bodies),
        Shape(K.PLANE, pos=(0.0, 0.0, -2.0)),
        Shape(K.BOX, (5.0, 6.0, 7.0), quat=quat_from_rpy(0.1, 0.2, 0.3)),
    ]
    scene = RayScene(shapes, 8, num_bodies, num_threads=2)
    scene.body_pos[:] = 2.5 * torch.randn(scene.body_pos.shape, generator=generator)
    scene.body_pos[:, :3] = torch.tensor([[0.0, 0.0, 1.5], [0.0, 0.0, -1.5], [1.5, 0.0, 0.0]])
    scene.body_quat[:] = random_quats(generator, 8, num_bodies)
    pattern = sphere_grid()
    config = LidarConfig(pattern.num_rows, 0.1, 0.0, 20.0)
    frame = Lidar(config, pattern, scene, -1, outputs=("ranges", "shape_id", "directions_s")).cast(clock(8, 0.1))
    hits = scene.cast(torch.zeros_like(frame.directions_s), frame.directions_s, 20.0)
    assert (frame.shape_id == hits.shape_id).float().mean() > 0.9999
    same = frame.shape_id == hits.shape_id
    torch.testing.assert_close(frame.ranges[same], hits.ranges[same], rtol=2e-5, atol=2e-5)


def test_keeping_the_first_part_of_each_frame_warns():
    """Every second point would be of two lasers alone, so 10,000 of 20,000 are the first 10,000."""
    angles = torch.linspace(-0.5, 0.5, 20_000).numpy()
    pattern = ScanPattern.from_angles(angles, 2.0 * angles, 200_000.0, num_lasers=4)
    strides = {1000: 19, 2000: 9, 4000: 5, 6666: 3, 10_000: 1, 20_000: 1}
    for num_rays, stride in strides.items():
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            Lidar(LidarConfig(num_rays, 0.1), pattern, RayScene([], 1, 0), -1)
        assert pattern.stride(0.1, num_rays) == stride and len(warned) == (num_rays == 10_000)
        for warning in warned:
            assert "first 50% of each frame's 20000; num_rays=6666 or" in str(warning.message)


class TestEnvSlices:
    """Frames that come for some environments after the others'."""

    @pytest.mark.parametrize("at_once", [1, 2, 3, 4])
    def test_everything_is_what_all_at_once_give(self, pattern, at_once):
        scene, config = crowd(5), LidarConfig(num_rays=777)
        given = {"noise": [GaussianNoise()], "seed": 4, "outputs": OUTPUTS}
        whole = Lidar(config, pattern, scene, 0, **given)
        sliced = Lidar(config, pattern, scene, 0, envs_at_once=at_once, **given)
        for time in (0.1, 0.2):
            expected, seen = whole.cast(clock(5, time)), []
            for envs, frame in sliced.cast_slices(clock(5, time)):
                seen += range(envs.start, envs.stop)
                assert len(frame.ranges) == envs.stop - envs.start <= at_once
                for name in OUTPUTS:
                    torch.testing.assert_close(
                        getattr(frame, name), getattr(expected, name)[envs], rtol=0, atol=0, equal_nan=True
                    )
            assert seen == [0, 1, 2, 3, 4]
        assert sliced.frame_count.tolist() == whole.frame_count.tolist() == [2] * 5


@pytest.mark.parametrize(
    ("env_ids", "seeds", "message"),
    [
        (torch.tensor([True, False, True]), None, "env_ids must be int64"),
        (None, torch.tensor([5]), "one for each of 3"),
    ],
)
def test_wrong_resets_are_refused(pattern, env_ids, seeds, message):
    lidar = Lidar(LidarConfig(100), pattern, RayScene([Shape(K.PLANE)], 3, 1), -1)
    with pytest.raises(ValueError, match=message):
        lidar.reset(env_ids, seeds)


def test_a_reset_of_no_environment_changes_nothing(pattern):
    lidar = Lidar(
        LidarConfig(100, motion_segments=1), pattern, RayScene([Shape(K.PLANE)], 3, 1), -1, noise=[GaussianNoise()]
    )
    lidar.cast(0.1)
    before = lidar.state_dict()
    lidar.reset(torch.zeros(0, dtype=torch.int64))
    lidar.reset(torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.int64))
    torch.testing.assert_close(lidar.state_dict(), before)


def test_a_state_of_other_environments_is_refused(pattern):
    one, three = (Lidar(LidarConfig(100), pattern, RayScene([Shape(K.PLANE)], n, 1), -1) for n in (1, 3))
    with pytest.raises(ValueError, match="of 1 environments, this lidar has 3"):
        three.load_state_dict(one.state_dict())
