"""Obstacles from raw clouds by geometry: synthetic clouds of known worlds, and simulated frames beside their labels."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from worlds import HEIGHT, LEVEL, MOUNT, PAPER, box, cloud, cylinder, plane, quaternion

from omnilidar import Lidar
from omniperception import build, config
from omniperception.common.sectors import sector_of
from omniperception.env.env import OmniEnv
from omniperception.env.state import MEASURED_CLOUD
from omniperception.perception import Attitude
from omniperception.perception.geometry import (
    NUM_SECTORS,
    GeometryConfig,
    Standing,
    by_sector,
    nearest_obstacles,
)
from omniperception.scene.rays import HitClass

AVOIDER = Path(__file__).resolve().parents[2] / "pretrained/avoider"
CONFIG = GeometryConfig()


def obstacles(*surfaces, **given):
    return nearest_obstacles(*cloud(*surfaces, **given), Standing(CONFIG))


def toward(x, y):
    """The sector of a place."""
    return int(sector_of(torch.tensor([x, y]), NUM_SECTORS))


def standing(*surfaces, config=CONFIG, **given):
    """Returns that count as standing on the ground."""
    _, height = Standing(config)(*cloud(*surfaces, **given))
    return int((height < config.headroom).sum())


class TestGround:
    @pytest.mark.parametrize("attitude", [LEVEL, (0.05, -0.1, 1.0), (-0.1, 0.05, -2.5)])
    @pytest.mark.parametrize("gradient", [(0.0, 0.0), (0.36, 0.0), (-0.2, 0.3)])  # up to 20 degrees
    def test_a_plane_is_no_obstacle(self, attitude, gradient):
        assert standing(plane(gradient), attitude=attitude, **PAPER) <= 2  # of 4000

    def test_a_device_s_own_noise_lifts_what_lies_steeply_below(self):
        """By 2 cm along the ray, so that some of 4000 returns stand 5 cm above the ground."""
        given = {"sigma": 0.02, **PAPER}
        assert standing(plane(), config=replace(CONFIG, lift=0.0), **given) > 8
        assert standing(plane(), **given) <= 2

    def test_heights_are_above_the_ground_below(self):
        rays = cloud(plane((0.2, 0.1)), box((1.0, -1.0, 0.0), (1.5, 1.0, 1.0)))
        points, height = Standing(CONFIG)(*rays)
        counts = height.isfinite() & (points[..., :2].norm(dim=-1) < 3.0)
        true = points[..., 2] + HEIGHT - points[..., :2] @ torch.tensor([0.2, 0.1])
        assert (height - true)[counts].abs().max() < 0.05 and (true[counts] > 0.3).any()
        points_b = rays[0][..., None] * rays[1] + torch.tensor(MOUNT, dtype=torch.float32)
        torch.testing.assert_close(points[counts], points_b[counts], atol=1e-5, rtol=0.0)

    def test_a_bias_of_the_attitude_is_no_obstacle(self):
        ranges, directions, given = cloud(plane(), **PAPER)
        tilted = replace(given, base_quat=torch.tensor([quaternion(0.03, -0.03, 0.0)]))
        assert nearest_obstacles(ranges, directions, tilted, Standing(CONFIG)).distance.isinf().all()

    def test_low_steps_are_ground_and_high_ones_are_not(self):
        low = obstacles(plane(), box((1.0, -3.0, -1.0), (6.0, 3.0, 0.04)))
        assert low.distance.isinf().all()
        high = obstacles(plane(), box((1.0, -3.0, -1.0), (6.0, 3.0, 0.2)))
        torch.testing.assert_close(high.distance[0, toward(1.0, 0.01)], torch.tensor(1.0), atol=0.06, rtol=0.0)

    def test_nothing_seen_is_nothing_found(self):
        def void(origin, rays):
            return np.full(len(rays), np.inf)

        assert obstacles(void).distance.isinf().all()


class TestObstacles:
    @pytest.mark.parametrize("attitude", [LEVEL, (0.1, -0.1, 2.0)])
    @pytest.mark.parametrize("given", [{}, PAPER])
    def test_a_box_of_a_hand_s_breadth(self, attitude, given):
        found = obstacles(plane(), box((1.0, -0.2, 0.0), (1.4, 0.2, 0.1)), attitude=attitude, **given)
        sectors = [toward(1.0, y) for y in (-0.13, 0.0, 0.13)]
        there = found.place[0, sectors, 0]
        assert abs(there.median() - 1.0) < 0.12 and there.min() > 0.9 and there.max() < 1.25  # its lid begins at 1 m
        elsewhere = torch.ones(NUM_SECTORS, dtype=torch.bool)
        elsewhere[toward(1.0, -0.25) - 1 : toward(1.0, 0.25) + 2] = False
        assert found.distance[0, elsewhere].isinf().all()

    @pytest.mark.parametrize("given", [{}, PAPER])
    @pytest.mark.parametrize(("x", "y"), [(1.2, 0.8), (0.2, -1.5), (-1.6, 0.4)])
    def test_a_pole(self, x, y, given):
        found = obstacles(plane(), cylinder(x, y, 0.05, 1.5), **given)
        distance = found.distance[0, toward(x, y)]
        assert abs(distance - (math.hypot(x, y) - 0.05)) < 0.12 * math.hypot(x, y) / 1.5
        assert found.distance.isfinite().sum() <= 3

    def test_a_bar_counts_where_the_robot_does_not_pass_below(self):
        def bar(bottom):
            return obstacles(plane(), box((1.2, -0.5, bottom), (1.3, 0.5, bottom + 0.08)), **PAPER)

        assert bar(0.5).distance.isinf().all()
        torch.testing.assert_close(bar(0.25).place[0, toward(1.2, 0.01), 0], torch.tensor(1.2), atol=0.08, rtol=0.0)

    def test_the_nearest_of_two(self):
        found = obstacles(plane(), cylinder(1.0, 0.0, 0.05, 1.0), box((2.0, -3.0, 0.0), (2.1, 3.0, 1.0)), **PAPER)
        ahead, beside = found.distance[0, toward(1.0, 0.0)], found.place[0, toward(2.0, 1.0), 0]
        assert abs(ahead - 0.95) < 0.1 and abs(beside - 2.0) < 0.12

    def test_own_body_is_none(self):
        legs = [cylinder(x, y, 0.04, 0.3) for x in (-0.2, 0.19) for y in (-0.14, 0.14)]
        assert obstacles(plane(), *legs, **PAPER).distance.isinf().all()

    def test_what_is_next_to_the_sensor_counts_where_it_hides_the_rest(self):
        wall = box((0.5, -0.5, 0.0), (0.6, 0.5, 1.0))  # 0.21 m ahead
        found = obstacles(plane(), wall, **PAPER)
        assert 0.35 < found.place[0, toward(0.5, 0.01), 0] < 0.55  # noise in front of it, which its own surface joins
        assert obstacles(plane(), noise=0.1, masked=0.3).distance.isinf().all()

    def test_heading_does_not_matter(self):
        scene = plane(), cylinder(1.2, 0.8, 0.1, 1.0), box((1.0, -1.0, 0.0), (1.2, -0.5, 0.3))
        ahead, turned = (obstacles(*scene, attitude=(0.05, 0.1, yaw)) for yaw in (0.0, 2.1))
        torch.testing.assert_close(ahead.place, turned.place, atol=1e-3, rtol=0.0)
        assert ahead.distance.isfinite().sum() > 5


class TestBySector:
    def test_is_the_mean_of_the_nearest_surface(self):
        places = torch.tensor([[[1.0, 0.5], [1.1, 0.5], [2.0, 0.5], [-1.0, -1.0]]])
        found = by_sector(places, torch.tensor([[True, True, True, False]]), num_sectors=4)
        assert found.distance.isfinite().tolist() == [[False, False, True, False]]  # sector 2 is that of x, y > 0
        torch.testing.assert_close(found.place[0, 2], torch.tensor([1.05, 0.5]))
        torch.testing.assert_close(found.distance[0, 2], torch.tensor(math.hypot(1.05, 0.5)))

    def test_environments_do_not_mix(self):
        places, counts = torch.randn(3, 50, 2), torch.rand(3, 50) < 0.5
        whole = by_sector(places, counts)
        alone = by_sector(places[1:2], counts[1:2])
        assert torch.equal(whole.distance[1:2], alone.distance) and torch.equal(whole.place[1:2], alone.place)


@pytest.mark.parametrize(("scenario", "recall"), [("small", 0.95), ("aerial", 0.95), ("rod", 0.8)])
def test_simulated_frames_agree_with_their_labels(scenario, recall):
    """Sectors with an obstacle within 3 m that a ray hits below the headroom: found at 0.85 to 1.15 of its distance,
    there or beside, where range noise along a ray from the head may put it; and how many of the other sectors report
    one."""
    run = build.assemble(config.load(AVOIDER, [f"scenario={scenario}", "num_envs=8", "seed=5", "lidar.num_rays=4000"]))
    env = OmniEnv(replace(run.env, extra_requirements=(MEASURED_CLOUD,), skip_curricula=True))
    sensor, outputs = run.env.lidar, ("ranges", "true_ranges", "directions_s", "class_id")
    lidar = Lidar(
        sensor,
        sensor.scan_pattern(),
        env.sensing.scene,
        mount_body=env.sensing.base,
        noise=run.env.lidar_noise,
        seed=1,
        outputs=outputs,
    )
    found, missed, false, free = 0, 0, 0, 0
    for time in range(20):  # the robots stand; the scan pattern goes on
        frame = lidar.cast(torch.full((8,), 0.1 * time, dtype=torch.float64))
        kinematics = env.state.kinematics
        attitude = Attitude(kinematics.base_quat_w, sensor.mount_pos, sensor.quat)
        told = nearest_obstacles(frame.ranges, frame.directions_s, attitude, Standing(CONFIG)).distance
        hit = (frame.class_id == HitClass.OBSTACLE) & frame.true_ranges.isfinite()
        true = labelled(torch.where(hit, frame.true_ranges, math.inf), frame.directions_s, attitude, HEIGHT)
        counts = true < 3.0
        beside = torch.stack([told.roll(k, 1) for k in (-1, 0, 1)])
        right = counts & ((beside > 0.85 * true - 0.05) & (beside < 1.15 * true + 0.05)).any(0)
        found, missed = found + int(right.sum()), missed + int((counts & ~right).sum())
        lone = torch.stack([true.roll(k, 1) for k in (-1, 0, 1)]).amin(0) >= 3.0
        free, false = free + int(lone.sum()), false + int((lone & (told < 2.5)).sum())
    assert found > 200 and found / (found + missed) > recall
    assert false / free < 0.002


def labelled(ranges, directions, attitude, height):
    """(n, S) horizontal distance to the nearest of the points by sector, without those above the headroom; in NumPy."""
    quats, mount = attitude.base_quat.double().numpy(), np.array(attitude.mount_quat)
    nearest = np.full((len(ranges), NUM_SECTORS), np.inf)
    for env, (distance, rays) in enumerate(zip(ranges.double().numpy(), directions.double().numpy(), strict=True)):
        kept = np.isfinite(distance)
        points = turned(mount, distance[kept, None] * rays[kept]) + np.array(attitude.mount_pos)
        points = turned(quats[env], points)
        w, x, y, z = quats[env]
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        low = points[:, 2] + height < CONFIG.headroom
        bearing = np.remainder(np.arctan2(points[low, 1], points[low, 0]) - yaw + np.pi, 2 * np.pi)
        sector = (bearing * NUM_SECTORS / (2 * np.pi)).astype(int) % NUM_SECTORS
        np.minimum.at(nearest[env], sector, np.hypot(points[low, 0], points[low, 1]))
    return torch.tensor(nearest, dtype=torch.float32)


def turned(quat, vectors):
    """Vectors (k, 3) turned by a quaternion (w, x, y, z)."""
    w, u = quat[0], quat[1:]
    return vectors + 2 * w * np.cross(u, vectors) + 2 * np.cross(u, np.cross(u, vectors))
