"""Coverage of samples against hand-made clouds, and the order of the methods."""

import torch

from benchmarks.sampling_benchmark import Row, _nearest, _strided, measure, pareto
from omniperception.lidar import LidarFrame


def frame(num_envs=3, num_rays=700):
    generator = torch.Generator().manual_seed(0)
    theta = torch.rand(num_envs, num_rays, generator=generator) * 1.2 - 0.1
    phi = torch.rand(num_envs, num_rays, generator=generator) * 6.28
    directions = torch.stack([theta.cos() * phi.cos(), theta.cos() * phi.sin(), theta.sin()], -1)
    ranges = 1.0 + 3.0 * torch.rand(num_envs, num_rays, generator=generator)
    fields = {"ranges": ranges, "directions_s": directions, "elevation": theta, "azimuth": phi}
    return LidarFrame(**{name: fields.get(name) for name in LidarFrame.__dataclass_fields__})


def test_distance_to_the_nearest_sample_ignores_empty_slots():
    cloud = torch.tensor([[1.0, 0.0, 0.0], [0.1, 0.0, 0.0], [1.0, 2.0, 0.0]])
    samples = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert torch.allclose(_nearest(cloud, samples), torch.tensor([0.0, 0.9, 2.0], dtype=torch.float64))


def test_stride_keeps_so_many_proximal_hits():
    rays = frame()
    kept = torch.isfinite(_strided(rays, 50)) & (rays.elevation > torch.pi / 9)
    assert (kept.sum(1) == 50).all()


def test_exact_covers_best_and_its_ways_agree():
    rows = {row.name: row for row in measure(frame(), 40, 5.0, 1, 1)}
    assert rows["exact"].radius_ratio == 1.0
    assert rows["exact, every point"].radius == rows["exact, by bucket"].radius == rows["exact"].radius
    assert rows["random"].radius_ratio > 1.0
    assert all(row.milliseconds > 0 for row in rows.values())


def test_pareto_front():
    rows = [Row("a", 1.0, 0, 2.0, 0), Row("b", 2.0, 0, 1.0, 0), Row("c", 2.5, 0, 1.5, 0), Row("d", 0.5, 0, 9.0, 0)]
    assert pareto(rows) == {"a", "b", "d"}
