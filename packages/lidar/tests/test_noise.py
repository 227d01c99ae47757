"""Range noise: statistics, reproducibility, and what it must not touch."""

import math

import pytest
import torch

from omnilidar import (
    AngularJitter,
    DistanceNoise,
    Dropout,
    GaussianNoise,
    Lidar,
    LidarConfig,
    MaskNoise,
    MixedPixels,
    RayScene,
    Shape,
    ShapeKind,
    TabulatedNoise,
    grid,
    mid360,
)

SPHERE = Shape(ShapeKind.SPHERE, (2.0,), body=0)
NOW = torch.full((4,), 0.1, dtype=torch.float64)


def make(pattern, *noise, seed=1, radius=2.0, threads=2, **options):
    scene = RayScene([Shape(ShapeKind.SPHERE, (radius,), body=0)], 4, 1, num_threads=threads)
    outputs = ("ranges", "true_ranges")
    return Lidar(LidarConfig(5000, **options), pattern, scene, -1, noise=noise, seed=seed, outputs=outputs)


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
    error = (frame.ranges / frame.true_ranges - 1.0).flatten()
    assert error.abs().max() <= 0.1 + 1e-6
    assert kolmogorov(error, lambda x: ((x + 0.1) / 0.2).clamp(0.0, 1.0)) < 1.95


def test_same_seed_same_noise_whatever_the_threads(pattern):
    noise = (MaskNoise(), DistanceNoise())
    first, same = make(pattern, *noise, threads=1), make(pattern, *reversed(noise), threads=2)
    other = make(pattern, *noise, seed=2)
    frames = [lidar.cast(NOW).ranges.clone() for lidar in (first, same, other)]
    assert torch.equal(frames[0], frames[1])
    assert not torch.equal(frames[0], frames[2])
    assert not torch.equal(frames[0], first.cast(NOW).ranges)  # the next frame draws again
    assert torch.equal(first.frame.ranges, same.cast(NOW).ranges)


def test_environments_frames_and_rays_draw_independently(pattern):
    lidar = make(pattern, DistanceNoise(0.1))
    errors = torch.cat([(lidar.cast(NOW).ranges / lidar.frame.true_ranges - 1.0) for _ in range(2)])
    correlation = torch.corrcoef(errors) - torch.eye(8)
    assert correlation.abs().max() < 5.0 / math.sqrt(5000)
    neighbours = torch.corrcoef(torch.stack([errors[:, :-1].flatten(), errors[:, 1:].flatten()]))
    assert neighbours[0, 1].abs() < 0.03


def test_distance_noise_respects_the_sensors_limits(pattern):
    near = make(pattern, DistanceNoise(0.5), radius=0.105).cast(NOW).ranges
    assert (near == math.inf).any() and near.min() >= 0.1
    far = make(pattern, DistanceNoise(0.5), max_range=2.1).cast(NOW).ranges
    assert far.max() == pytest.approx(2.1)


def normal_cdf(x):
    return 0.5 * (1.0 + torch.erf(x / math.sqrt(2.0)))


def kolmogorov(samples, cdf):
    """Largest distance between the empirical and the given distribution, times sqrt(n); above 1.95 once in 1000."""
    ordered = samples.double().sort().values
    steps = torch.arange(len(ordered) + 1, dtype=torch.float64) / len(ordered)
    expected = cdf(ordered)
    gap = torch.maximum((steps[1:] - expected).max(), (expected - steps[:-1]).max())
    return float(gap) * math.sqrt(len(ordered))


@pytest.mark.parametrize(("sigma", "per_metre", "radius"), [(0.02, 0.0, 2.0), (0.01, 0.005, 20.0), (0.0, 0.01, 5.0)])
def test_gaussian_noise_is_normal_with_a_deviation_that_grows_with_distance(pattern, sigma, per_metre, radius):
    frame = make(pattern, GaussianNoise(sigma, per_metre), radius=radius, max_range=100.0).cast(NOW)
    error = (frame.ranges.double() - frame.true_ranges.double()).flatten() / (sigma + per_metre * radius)
    assert kolmogorov(error, normal_cdf) < 1.95
    assert error.std() == pytest.approx(1.0, abs=4.0 / math.sqrt(2 * 20_000))


@pytest.mark.parametrize(("ratio", "per_metre"), [(0.3, 0.0), (0.0, 0.05), (0.1, 0.1), (0.5, 1.0)])
def test_dropout_loses_its_share_of_the_hits(pattern, ratio, per_metre):
    frame = make(pattern, Dropout(ratio, per_metre)).cast(NOW)
    expected = min(ratio + 2.0 * per_metre, 1.0)
    lost = (frame.ranges == math.inf).float().mean()
    assert lost == pytest.approx(expected, abs=4.0 * math.sqrt(expected * (1.0 - expected) / 20_000) + 1e-9)
    kept = frame.ranges < math.inf
    assert torch.equal(frame.ranges[kept], frame.true_ranges[kept])


TABLE = TabulatedNoise((0.5, 1.0, 4.0), (0.01, 0.03), (0.6, 0.2), sigma_elsewhere=0.002)


@pytest.mark.parametrize(
    ("radius", "sigma", "lost"), [(0.4, 0.002, 0.0), (0.7, 0.01, 0.6), (2.0, 0.03, 0.2), (5.0, 0.002, 0.0)]
)
def test_tabulated_noise_is_that_of_each_range(pattern, radius, sigma, lost):
    frame = make(pattern, TABLE, radius=radius).cast(NOW)
    kept = frame.ranges < math.inf
    assert (~kept).float().mean() == pytest.approx(lost, abs=4.0 * math.sqrt(lost * (1.0 - lost) / 20_000) + 1e-9)
    error = (frame.ranges.double() - frame.true_ranges.double())[kept] / sigma
    assert kolmogorov(error, normal_cdf) < 1.95  # whether a hit is lost says nothing of its error


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (((0.5, 1.0), (0.01, 0.02), (0.1,)), "2 edges, 2 sigma and 1 dropout"),
        (((1.0, 0.5), (0.01,), (0.1,)), "must ascend"),
    ],
)
def test_a_table_that_cannot_be_is_refused(table, message):
    with pytest.raises(ValueError, match=message):
        TabulatedNoise(*table)


def test_jitter_turns_the_ray_by_a_normal_variable_along_each_axis():
    """At a wall 10 m ahead, a ray turned upwards by a small angle from 30 deg down travels farther by closed form."""
    sigma = math.radians(0.5)
    scene = RayScene([Shape(ShapeKind.PLANE)], 8, 0, num_threads=2)
    config = LidarConfig(4000, 1.0, 0.0, 1e6, (0.0, 0.0, 5.0), (0.0, math.radians(30.0), 0.0))
    lidar = Lidar(config, grid(1, 1, 1.0, 4000.0), scene, -1, noise=(AngularJitter(0.5),), seed=3)
    ranges = lidar.cast(torch.ones(8, dtype=torch.float64)).ranges.double()
    down = torch.asin(5.0 / ranges)  # the vertical component of each ray's direction
    turned = (down - math.radians(30.0)).flatten() / sigma
    assert kolmogorov(turned, normal_cdf) < 1.95 + 0.3  # to first order in sigma: second-order bias sigma tan(30) / 2
    assert turned.std() == pytest.approx(1.0, abs=0.02)
    assert torch.corrcoef(turned.reshape(8, 4000)).triu(1).abs().max() < 5.0 / math.sqrt(4000)


def test_jitter_reports_the_nominal_direction(pattern):
    """Inside a sphere around the sensor the distance does not depend on the direction: points lie on nominal rays."""
    outputs = ("ranges", "points_s", "directions_s", "row")
    scene = RayScene([SPHERE], 4, 1, num_threads=2)
    noise = (AngularJitter(2.0),)
    frame = Lidar(LidarConfig(1000), pattern, scene, -1, noise=noise, seed=1, outputs=outputs).cast(NOW)
    torch.testing.assert_close(frame.directions_s, pattern.directions_s[frame.row.long()])
    torch.testing.assert_close(frame.points_s, frame.ranges[..., None] * frame.directions_s)
    torch.testing.assert_close(frame.ranges, torch.full_like(frame.ranges, 2.0), rtol=1e-5, atol=0.0)


def edges(noise, seed=0):
    """A frame of a depth camera before a post, half-width 0.5 m at 3 m, and a wall at 8 m; nothing above 2 m."""
    post = Shape(ShapeKind.BOX, (0.01, 0.5, 2.0), pos=(3.01, 0.0, 0.0))
    wall = Shape(ShapeKind.BOX, (0.01, 20.0, 2.0), pos=(8.01, 0.0, 0.0))
    scene, config = RayScene([post, wall], 1, 0, num_threads=2), LidarConfig(160 * 120, 1 / 30, 0.0, 30.0)
    outputs = ("ranges", "true_ranges", "directions_s")
    return Lidar(config, grid(160, 120, 60.0), scene, -1, noise=(noise,), seed=seed, outputs=outputs).cast(NOW[:1])


def test_mixed_pixels_lie_between_foreground_and_background_at_edges_only():
    divergence = 1.0
    noise = MixedPixels(divergence, min_gap=1.0)
    frame = edges(noise)
    changed = frame.ranges != frame.true_ranges
    assert 50 < changed.sum() < 400
    angle = torch.atan2(frame.directions_s[..., 1], frame.directions_s[..., 0]).abs()
    to_edge = (angle - math.atan2(0.5, 3.0)).abs()
    top = (frame.directions_s[..., 2] - 2.0 / 3.02).abs()  # over the post's top only the sky is behind it
    assert (to_edge[changed] < math.radians(divergence) / 2.0 + 0.02).all() and top[changed].min() > 0.0
    depth = frame.ranges[changed] * frame.directions_s[changed][:, 0]
    assert (depth > 3.5).all() and (depth < 7.5).all()
    assert depth.mean() == pytest.approx(5.5, abs=0.1)
    assert torch.equal(frame.ranges == math.inf, frame.true_ranges == math.inf)
    assert torch.equal(edges(noise, seed=4).ranges, edges(noise, seed=9).ranges)  # a function of the scene alone


def test_a_beam_is_mixed_whichever_other_rows_are_kept():
    """Of a frame with every third row each ray measures what it does in the whole frame, from frame to frame."""
    post, wall = Shape(ShapeKind.BOX, (0.01, 0.5, 2.0), pos=(3.01, 0.0, 0.0)), Shape(ShapeKind.PLANE, pos=(0, 0, -1))
    scene = RayScene([post, wall], 2, 0, num_threads=2)
    pattern, outputs = grid(160, 120, 60.0), ("ranges", "true_ranges", "row")
    every, third = (
        Lidar(LidarConfig(count, 1 / 30, 0.0, 30.0), pattern, scene, -1, noise=[MixedPixels(1.0)], outputs=outputs)
        for count in (160 * 120, 160 * 120 // 7)
    )
    for frame in range(1, 3):
        whole, part = every.cast(frame / 30), third.cast(frame / 30)
        assert torch.equal(whole.row, torch.arange(160 * 120).expand(2, -1))
        of_row = whole.ranges.gather(1, part.row.long())
        assert torch.equal(part.ranges, of_row)
        assert (part.ranges != part.true_ranges).sum() > 10


def test_gaps_beyond_the_largest_are_two_echoes():
    frame = edges(MixedPixels(1.0, min_gap=1.0, max_gap=4.0))
    assert torch.equal(frame.ranges, frame.true_ranges)


ALL = (MaskNoise(), DistanceNoise(), GaussianNoise(), AngularJitter(), Dropout(0.1), MixedPixels())


@pytest.mark.parametrize("model", ALL, ids=lambda model: type(model).__name__)
def test_every_model_leaves_misses_and_the_truth_alone_and_repeats_with_its_seed(pattern, model):
    ranges = []
    for seed in (1, 1, 2):
        lidar = make(pattern, model, seed=seed)
        lidar.scene.body_pos[1, 0, 2] = -1000.0
        frame = lidar.cast(NOW)
        assert (frame.ranges[1] == math.inf).all() and (frame.true_ranges[1] == math.inf).all()
        torch.testing.assert_close(frame.true_ranges[0], torch.full((5000,), 2.0), rtol=0.0, atol=1e-5)
        ranges.append(frame.ranges.clone())
    assert torch.equal(ranges[0], ranges[1])
    if not isinstance(model, (MixedPixels, AngularJitter)):  # inside a sphere these two change nothing that matters
        assert not torch.equal(ranges[0], ranges[2])


def test_models_draw_independently_of_each_other(pattern):
    """Adding a model does not change what another one draws, and their draws are uncorrelated."""
    alone, together = make(pattern, GaussianNoise(0.02)), make(pattern, GaussianNoise(0.02), Dropout(0.5))
    first, second = alone.cast(NOW).ranges.clone(), together.cast(NOW).ranges
    kept = second < math.inf
    assert torch.equal(first[kept], second[kept])
    draws = torch.stack([(first - 2.0).flatten(), kept.float().flatten()])
    assert torch.corrcoef(draws)[0, 1].abs() < 5.0 / math.sqrt(20_000)


def test_a_reset_repeats_no_noise_and_a_seeded_one_that_of_its_seed(pattern):
    lidar = make(pattern, GaussianNoise(0.02))
    frames = [lidar.cast(NOW).ranges.clone() for _ in range(3)]
    lidar.reset()
    lidar.reset(torch.tensor([2]))
    frames.append(lidar.cast(NOW).ranges.clone())
    assert len({tuple(frame[2].tolist()) for frame in frames}) == 4
    untouched = make(pattern, GaussianNoise(0.02))
    assert torch.equal(frames[3], [untouched.cast(NOW).ranges.clone() for _ in range(4)][3])

    other = make(pattern, GaussianNoise(0.02), seed=7)
    lidar.reset(torch.tensor([1, 2, 3]), torch.tensor([41, 42, 41]))
    other.reset(torch.tensor([0]), torch.tensor([42]))
    seeded = [(lidar.cast(NOW).ranges.clone(), other.cast(NOW).ranges.clone()) for _ in range(2)]
    for mine, its in seeded:  # the seed alone counts, not which environment of which sensor has it
        assert torch.equal(mine[2], its[0]) and torch.equal(mine[1], mine[3]) and not torch.equal(mine[1], mine[2])
    assert not torch.equal(seeded[0][0][2], seeded[1][0][2])


def test_without_noise_there_is_neither_kernel_nor_copy(pattern):
    lidar = make(pattern)
    assert lidar.cast(NOW).ranges is lidar.frame.true_ranges


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: make(mid360(), MaskNoise(), MaskNoise()), "^noise holds more than one MaskNoise"),
        (lambda: MaskNoise(1.5), r"^noise\.mask\.ratio=1\.5"),
        (lambda: MixedPixels(0.0), "mixed.divergence_deg=0.0"),
    ],
)
def test_wrong_noise_is_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
