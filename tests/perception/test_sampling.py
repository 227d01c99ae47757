"""Samplers against brute force in NumPy, and on degenerate clouds."""

import itertools
import math

import numpy as np
import pytest
import torch
from clouds import MAX_RANGE, random_rays, rays_from_points, sample

from omniperception.perception import FpsSampler, PdSampler, RawSampler


def brute_force_fps(points, k):
    """Indices of exact farthest point sampling in float64 from point 0, ties to the lowest index."""
    points = np.asarray(points, dtype=np.float64)
    chosen = [0]
    while len(chosen) < min(k, len(points)):
        gap = ((points[:, None] - points[None, chosen]) ** 2).sum(-1).min(1)
        gap[chosen] = -1.0
        chosen.append(int(gap.argmax()))
    return chosen[: min(k, len(points))]


def order(theta, phi, ring_deg=2.0):
    """Stable order by (theta ring, phi)."""
    ring = np.floor((np.asarray(theta, dtype=np.float64) + np.pi / 2) / np.radians(ring_deg))
    return np.lexsort((np.asarray(phi, dtype=np.float64), ring))


PD = {"num_proximal": 16, "num_distal": 8, "max_range": MAX_RANGE, "split_deg": 10.0}


def as_set(points):
    return sorted(map(tuple, np.round(np.asarray(points, dtype=np.float64), 6).tolist()))


class TestFarthestPoints:
    @pytest.mark.parametrize("k", [1, 2, 7, 30])
    def test_equals_brute_force_on_a_lattice(self, k):
        """On small integers squared distances are exact, so ties must be broken as documented too."""
        rng = np.random.default_rng(k)
        points = rng.integers(1, 9, (60, 3)).astype(np.float32)
        _, _, theta, phi = rays_from_points(points)
        rays = (torch.ones(1, 60), torch.tensor(points)[None], theta, phi)  # range 1: points stay integers
        got = sample(FpsSampler(k, max_range=1.0), rays)[0]
        assert as_set(got) == as_set(points[brute_force_fps(points, k)])

    def test_every_pick_is_farthest(self):
        """Coverage radius of the sample equals that of the brute force."""
        ranges, directions, theta, phi = random_rays(3, 400, seed=4)
        got = sample(FpsSampler(40, max_range=MAX_RANGE), (ranges, directions, theta, phi))
        for env in range(3):
            hits = torch.isfinite(ranges[env])
            cloud = (ranges[env, hits, None] * directions[env, hits] / MAX_RANGE).double().numpy()
            chosen = cloud[brute_force_fps(cloud, 40)]
            assert as_set(got[env]) == as_set(chosen.astype(np.float32))

    def test_sorted_by_ring_then_azimuth(self):
        rays = random_rays(4, 300, seed=2)
        got = sample(FpsSampler(64, max_range=MAX_RANGE), rays).double()
        theta = torch.asin(got[..., 2] / got.norm(dim=-1))
        phi = torch.atan2(got[..., 1], got[..., 0])
        for env in range(4):
            assert (order(theta[env], phi[env]) == np.arange(64)).all()

    @pytest.mark.parametrize(("num_rays", "k"), [(40, 7), (300, 64), (1000, 256), (1000, 999)])
    def test_buckets_do_not_change_a_pick(self, num_rays, k):
        """Neither on random clouds nor with ties, duplicates and a flat cloud."""
        rng = np.random.default_rng(k)
        lattice = rng.integers(1, 6, (num_rays, 3)).astype(np.float32)  # many ties and duplicates
        flat = np.concatenate([rng.uniform(-1, 1, (num_rays, 2)), np.ones((num_rays, 1))], 1).astype(np.float32)
        _, _, theta, phi = rays_from_points(lattice)
        clouds = [torch.tensor(points)[None] for points in (lattice, flat)]
        cases = [(torch.ones(1, num_rays), cloud, theta, phi) for cloud in clouds]
        for rays in (*cases, random_rays(3, num_rays, seed=k)):
            plain, buckets = FpsSampler(k, max_range=1.0), FpsSampler(k, max_range=1.0)
            plain.buckets_from, buckets.buckets_from = 10**9, 1
            assert torch.equal(sample(plain, rays), sample(buckets, rays))

    def test_clouds_with_and_without_buckets_in_one_launch(self):
        """Environments are sampled at once, some by buckets and some not, each in its own work memory."""
        rays = random_rays(64, 1001, seed=3)
        rays[0][::3, 300:] = math.inf
        sampler, plain = FpsSampler(50, max_range=MAX_RANGE, num_threads=4), FpsSampler(50, max_range=MAX_RANGE)
        sampler.buckets_from, plain.buckets_from = 500, 10**9
        expected = sample(plain, rays)
        for _ in range(5):
            assert torch.equal(sample(sampler, rays), expected)

    def test_duplicates_are_picked_once_each(self):
        points = np.tile([[1.0, 2.0, 2.0]], (10, 1))
        got = sample(FpsSampler(4, max_range=3.0), rays_from_points(points))[0]
        assert torch.allclose(got, torch.tensor([1.0, 2.0, 2.0]) / 3.0)


class TestDegenerateClouds:
    SAMPLERS = [
        FpsSampler(5, max_range=MAX_RANGE),
        RawSampler(20, max_range=MAX_RANGE),
        PdSampler(3, 4, max_range=MAX_RANGE, split_deg=10.0),
    ]

    @pytest.mark.parametrize("empty", [math.inf, math.nan])
    @pytest.mark.parametrize("sampler", SAMPLERS, ids=lambda s: type(s).__name__)
    def test_empty_cloud_is_zero_even_after_a_full_one(self, sampler, empty):
        ranges, *rest = random_rays(3, 20, miss=0.0)
        assert (sample(sampler, (ranges, *rest)) != 0).any()
        assert (sample(sampler, (torch.full_like(ranges, empty), *rest)) == 0).all()

    def test_single_point(self):
        rays = rays_from_points([[2.0, 0.0, 2.0]])  # 45 degrees up
        near = sample(PdSampler(3, 2, max_range=4.0, split_deg=10.0), rays)[0]
        assert torch.allclose(near[0], torch.tensor([0.5, 0.0, 0.5])) and (near[1:] == 0).all()
        far = sample(PdSampler(3, 2, max_range=4.0, split_deg=60.0), rays)[0]
        assert torch.allclose(far[3], torch.tensor([0.5, 0.0, 0.5])) and (far[[0, 1, 2, 4]] == 0).all()

    def test_fewer_points_than_slots_keeps_all_sorted_then_zeros(self):
        rays = random_rays(1, 6, miss=0.0, seed=3)
        got = sample(FpsSampler(9, max_range=MAX_RANGE), rays)[0]
        cloud = (rays[0][..., None] * rays[1] / MAX_RANGE)[0].numpy()
        expected = cloud[order(rays[2][0], rays[3][0])]
        np.testing.assert_allclose(got[:6], expected, atol=1e-6)
        assert (got[6:] == 0).all()


class TestDistal:
    SPLIT = 15.0

    def test_bins_of_consecutive_points(self):
        rays = random_rays(5, 250, seed=7)
        got = sample(PdSampler(8, 16, max_range=MAX_RANGE, split_deg=self.SPLIT), rays)
        for env in range(5):
            theta, phi = (t[env].double().numpy() for t in rays[2:])
            ids = np.flatnonzero((theta <= np.radians(self.SPLIT)) & rays[0][env].isfinite().numpy())
            ids = ids[order(theta[ids], phi[ids])]
            cloud = (rays[0][env, ids, None] * rays[1][env, ids] / MAX_RANGE).numpy()
            edges = [b * len(ids) // 16 for b in range(17)]
            expected = [cloud[a:b].mean(0) for a, b in itertools.pairwise(edges)]
            np.testing.assert_allclose(got[env, 8:], expected, atol=1e-5)

    def test_partition_by_elevation(self):
        rays = random_rays(3, 300, seed=10)
        a_bin_for_each_point = PdSampler(32, 300, max_range=MAX_RANGE, split_deg=self.SPLIT)
        got = sample(a_bin_for_each_point, rays).double()
        theta = torch.rad2deg(torch.asin(got[..., 2] / got.norm(dim=-1)))
        used = theta[:, 32:].isfinite()
        assert (theta[:, :32] > self.SPLIT).all() and (theta[:, 32:][used] <= self.SPLIT).all()
        assert used.sum() == (rays[0].isfinite() & (rays[2] <= math.radians(self.SPLIT))).sum()


class TestInterface:
    def test_raw_points_in_ray_order(self):
        rays = random_rays(3, 50)
        got = sample(RawSampler(50, max_range=MAX_RANGE), rays)
        expected = torch.where(torch.isfinite(rays[0])[..., None], rays[0][..., None] * rays[1] / MAX_RANGE, 0.0)
        assert torch.allclose(got, expected, atol=1e-6)

    @pytest.mark.parametrize("num_envs", [1, 2, 7, 33])
    def test_threads_and_other_environments_do_not_change_the_result(self, num_envs):
        rays = random_rays(num_envs, 120, seed=num_envs)
        expected = sample(PdSampler(**PD), rays)
        for threads in (1, 2, 3, 5):
            assert torch.equal(sample(PdSampler(**PD, num_threads=threads), rays), expected)
        alone = sample(PdSampler(**PD), tuple(t[-1:].clone() for t in rays))
        assert torch.equal(alone, expected[-1:])

    def test_writes_into_a_slice_of_a_history(self):
        rays, sampler = random_rays(6, 120, seed=6), PdSampler(**PD)
        history = torch.full((6, 4, 24, 3), 7.0)
        sampler(*rays, history[:, -1])
        assert torch.equal(history[:, -1], sample(sampler, rays)) and (history[:, :-1] == 7.0).all()

    def test_shared_scan_expanded_over_environments(self):
        ranges, directions, theta, phi = random_rays(4, 60, seed=11)
        shared = directions[:1].expand(4, -1, -1), theta[:1].expand(4, -1), phi[:1].expand(4, -1)
        sampler = PdSampler(**PD)
        assert torch.equal(sample(sampler, (ranges, *shared)), sample(sampler, (ranges, *(t.clone() for t in shared))))

    def test_azimuth_branch_does_not_matter(self):
        ranges, directions, theta, phi = random_rays(2, 60, seed=12)
        sampler = PdSampler(**PD)
        wrapped = torch.where(phi < 0, phi + 2 * math.pi, phi)
        a, b = (sample(sampler, (ranges, directions, theta, azimuth)) for azimuth in (phi, wrapped))
        assert torch.allclose(a, b)

    def test_no_environment_leaves_the_sampler_as_it_was(self):
        rays, sampler = random_rays(2, 60, seed=13), PdSampler(2, 2, max_range=MAX_RANGE, split_deg=0.0)
        expected = sample(sampler, rays)
        assert sample(sampler, tuple(t[:0] for t in rays)).shape == (0, 4, 3)
        assert torch.equal(sample(sampler, rays), expected)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"ring_deg": 0.0}, r"ring_deg must lie in \(0\.006, 180\], got 0\.0"),
            ({"num_proximal": 0, "num_distal": 0}, "at least one point, got num_points=0"),
        ],
    )
    def test_wrong_options_are_refused(self, options, message):
        with pytest.raises(ValueError, match=message):
            PdSampler(**{"max_range": 1.0, "split_deg": 0.0, **options})

    def test_wrong_shapes_are_refused(self):
        ranges, directions, theta, phi = random_rays(2, 10)
        with pytest.raises(ValueError, match="out must have shape"):
            FpsSampler(4, max_range=1.0)(ranges, directions, theta, phi, torch.empty(2, 5, 3))
        with pytest.raises(ValueError, match="float32"):
            FpsSampler(4, max_range=1.0)(ranges, directions, theta.double(), phi, torch.empty(2, 4, 3))

    @pytest.mark.parametrize("said", [8, 12])
    def test_raw_frames_have_as_many_rays_as_was_said(self, said):
        around = torch.full((2, 16, 3), 7.0)
        with pytest.raises(ValueError, match=f"frames of {said} rays were said, got 10"):
            RawSampler(said, max_range=1.0)(*random_rays(2, 10), around[:, :said])
        assert (around == 7.0).all()
