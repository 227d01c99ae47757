"""Range noise: statistics, reproducibility, and what it must not touch."""

import math

import pytest
import torch

from omniperception.lidar import (
    DistanceNoise,
    Lidar,
    LidarConfig,
    MaskNoise,
    RayScene,
    Shape,
    ShapeKind,
    mid360,
)

SPHERE = Shape(ShapeKind.SPHERE, (2.0,), body=0)
NOW = torch.full((4,), 0.1, dtype=torch.float64)


@pytest.fixture(scope="module")
def pattern():
    return mid360()


def make(pattern, *noise, seed=1, radius=2.0, threads=2, **options):
    scene = RayScene([Shape(ShapeKind.SPHERE, (radius,), body=0)], 4, 1, num_threads=threads)
    return Lidar(LidarConfig(5000, **options), pattern, scene, -1, noise=noise, seed=seed)


def test_mask_replaces_its_share_of_the_hits(pattern):
    frame = make(pattern, MaskNoise(0.1, 0.0, 0.3)).cast(NOW)
    masked = frame.ranges[frame.ranges != frame.true_ranges]
    share = masked.numel() / frame.ranges.numel()
    assert share == pytest.approx(0.1, abs=4.0 * math.sqrt(0.1 * 0.9 / 20_000))
    assert masked.min() >= 0.0 and masked.max() <= 0.3
    assert masked.mean() == pytest.approx(0.15, abs=4.0 * 0.3 / math.sqrt(12 * 2000))
    assert (masked < 0.1).any()  # below the minimum range: the mask may


def test_distance_noise_is_relative_and_uniform(pattern):
    frame = make(pattern, DistanceNoise(0.1)).cast(NOW)
    error = frame.ranges / frame.true_ranges - 1.0
    assert error.abs().max() <= 0.1 + 1e-6
    assert error.mean() == pytest.approx(0.0, abs=4.0 * 0.1 / math.sqrt(3 * 20_000))
    assert error.std() == pytest.approx(0.1 / math.sqrt(3.0), rel=0.03)


def test_same_seed_same_noise_whatever_the_threads(pattern):
    noise = (MaskNoise(), DistanceNoise())
    first, same = make(pattern, *noise, threads=1), make(pattern, *reversed(noise), threads=2)
    other = make(pattern, *noise, seed=2)
    frames = [lidar.cast(NOW).ranges.clone() for lidar in (first, same, other)]
    assert torch.equal(frames[0], frames[1])
    assert not torch.equal(frames[0], frames[2])
    assert not torch.equal(frames[0], first.cast(NOW).ranges)  # the next frame draws anew
    assert torch.equal(first.frame.ranges, same.cast(NOW).ranges)


def test_environments_frames_and_rays_draw_independently(pattern):
    lidar = make(pattern, DistanceNoise(0.1))
    errors = torch.cat([(lidar.cast(NOW).ranges / lidar.frame.true_ranges - 1.0) for _ in range(2)])
    correlation = torch.corrcoef(errors) - torch.eye(8)
    assert correlation.abs().max() < 5.0 / math.sqrt(5000)
    neighbours = torch.corrcoef(torch.stack([errors[:, :-1].flatten(), errors[:, 1:].flatten()]))
    assert neighbours[0, 1].abs() < 0.03


def test_misses_stay_misses_and_truth_stays_true(pattern):
    lidar = make(pattern, MaskNoise(1.0), DistanceNoise())
    lidar.scene.body_pos[1, 0, 2] = -1000.0
    frame = lidar.cast(NOW)
    assert (frame.ranges[1] == math.inf).all() and (frame.true_ranges[1] == math.inf).all()
    assert (frame.ranges[0] <= 0.3).all()
    assert torch.allclose(frame.true_ranges[0], torch.tensor(2.0), atol=1e-5)


def test_distance_noise_respects_the_sensors_limits(pattern):
    near = make(pattern, DistanceNoise(0.5), radius=0.105).cast(NOW).ranges
    assert (near == math.inf).any() and near.min() >= 0.1
    far = make(pattern, DistanceNoise(0.5), max_range=2.1).cast(NOW).ranges
    assert far.max() == pytest.approx(2.1)


def test_without_noise_there_is_neither_kernel_nor_copy(pattern):
    lidar = make(pattern)
    assert lidar.cast(NOW).ranges is lidar.frame.true_ranges
    assert int(lidar.frame_count) == 0


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: MaskNoise(1.5), "mask.ratio=1.5"),
        (lambda: MaskNoise(0.1, 0.3, 0.2), "low <= high"),
        (lambda: DistanceNoise(-0.1), "distance.ratio=-0.1"),
    ],
)
def test_wrong_noise_is_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_two_of_a_kind_are_refused(pattern):
    with pytest.raises(ValueError, match="more than one MaskNoise"):
        make(pattern, MaskNoise(), MaskNoise())
