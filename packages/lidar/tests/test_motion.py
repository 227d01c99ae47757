"""Motion within a frame: closed forms in float64, and each ray against a scene that stands still at its time."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from lidar_helpers import closed_shapes, multiply, random_quats, rotate

from omnilidar import GaussianNoise, Lidar, LidarConfig, RayScene, ScanPattern, Shape, ShapeKind, mid360

K = ShapeKind
PERIOD = 0.1
NUM_RAYS = 2000
UPRIGHT = torch.tensor([1.0, 0.0, 0.0, 0.0])
WALL_QUAT = (math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0)  # turns a plane's normal, +z, to -x


def yaw_quat(angle):
    return torch.tensor([math.cos(angle / 2.0), 0.0, 0.0, math.sin(angle / 2.0)])


def fan(spread_deg=40.0, elevation_deg=20.0):
    """One sweep per frame from right to left ahead of the sensor, with a little elevation."""
    across = np.linspace(-1.0, 1.0, NUM_RAYS)
    elevation = math.radians(elevation_deg) * np.sin(9.0 * across)
    return ScanPattern.from_angles(elevation, math.radians(spread_deg) * across, NUM_RAYS / PERIOD)


def sweep(scene, start, end, segments=1, pattern=None, **options):
    """The frame of a sensor on body 0 while the poses go from ``start`` to ``end``; poses are (pos, quat)."""
    outputs = ("ranges", "shape_id", "directions_s", "time_s", "points_s", "points_w", "normals_w")
    config = LidarConfig(NUM_RAYS, PERIOD, 0.0, 50.0, motion_segments=segments, **options)
    lidar = Lidar(config, pattern or fan(), scene, 0, outputs=outputs)
    lidar.phase_rows.zero_()
    poses = [start, *([end] if segments == 1 else end)]
    for moment, (pos, quat) in enumerate(poses):
        set_poses(scene, (pos, quat))
        if moment < segments:
            lidar.record_poses()
    return lidar.cast(torch.full((scene.num_envs,), PERIOD, dtype=torch.float64))


def wall_scene(distance=5.0):
    return RayScene([Shape(K.PLANE, pos=(distance, 0.0, 0.0), quat=WALL_QUAT)], 1, 1, num_threads=2)


def test_a_fast_turn_bends_a_straight_wall():
    """Yaw rate 10 rad/s: a ray of azimuth phi at time t hits the wall at 5 m / (cos(theta) cos(phi + 10 t))."""
    at = torch.zeros(1, 1, 3)
    frame = sweep(wall_scene(), (at, yaw_quat(-0.5)), (at, yaw_quat(0.5)))
    theta, phi = angles(frame)
    yaw = -0.5 + 10.0 * frame.time_s.double()
    expected = 5.0 / (torch.cos(theta) * torch.cos(phi + yaw))
    torch.testing.assert_close(frame.ranges.double(), expected, rtol=3e-6, atol=1e-5)
    depth = frame.points_s[..., 0]
    assert depth.max() - depth.min() > 0.5  # a sensor that turns sees the wall bent,
    torch.testing.assert_close(frame.points_w[..., 0], torch.full((1, NUM_RAYS), 5.0), rtol=0.0, atol=1e-4)
    normal = torch.tensor([-1.0, 0.0, 0.0]).expand(1, NUM_RAYS, 3)
    torch.testing.assert_close(frame.normals_w, normal, atol=1e-5, rtol=0.0)


@pytest.mark.parametrize("velocity", [(3.0, 0.0, 0.0), (0.0, 8.0, 0.0), (-2.0, 3.0, 1.0)])
def test_driving_along_or_towards_a_wall(velocity):
    """An oblique wall through (5, 0, 0) with normal (-cos a, -sin a, 0): range = n.(w - p(t)) / n.d."""
    slant = 0.5
    quat = (yaw_quat(slant)[:, None] * torch.tensor([[WALL_QUAT[0], WALL_QUAT[2]]])).double()
    quat = (quat[0, 0], -quat[3, 1], quat[0, 1], quat[3, 0])  # yaw after the turn about y
    scene = RayScene([Shape(K.PLANE, pos=(5.0, 0.0, 0.0), quat=tuple(map(float, quat)))], 1, 1, num_threads=2)
    step = PERIOD * torch.tensor(velocity)
    frame = sweep(scene, (torch.zeros(1, 1, 3), UPRIGHT), (step.expand(1, 1, 3), UPRIGHT))
    normal = torch.tensor([-math.cos(slant), -math.sin(slant), 0.0], dtype=torch.float64)
    at = frame.time_s.double()[..., None] * torch.tensor(velocity, dtype=torch.float64)
    to_wall = torch.tensor([5.0, 0.0, 0.0], dtype=torch.float64) - at
    expected = (to_wall @ normal) / (frame.directions_s.double() @ normal)
    torch.testing.assert_close(frame.ranges.double(), expected, rtol=1e-5, atol=1e-5)


def test_a_sphere_on_a_turning_arm_moves_on_a_circle():
    """Arm of 2 m around (6, 0, 0), half a turn within the frame: interpolated along the arc, not along its chord."""
    scene = RayScene([Shape(K.SPHERE, (0.6,), body=1, pos=(2.0, 0.0, 0.0))], 1, 2, num_threads=2)
    pos = torch.tensor([[[0.0, 0.0, 0.0], [6.0, 0.0, 0.0]]])
    turn = 0.999 * math.pi
    quats = [torch.stack([UPRIGHT, yaw_quat(a)])[None] for a in (math.pi / 2, math.pi / 2 + turn)]
    frame = sweep(scene, (pos, quats[0]), (pos, quats[1]))
    angle = math.pi / 2 + turn * frame.time_s[0].double() / PERIOD
    centre = torch.stack([6.0 + 2.0 * angle.cos(), 2.0 * angle.sin(), torch.zeros_like(angle)], -1)
    d = frame.directions_s[0].double()
    along = (d * centre).sum(-1)
    disc = 0.36 - (centre - along[:, None] * d).square().sum(-1)
    expected = torch.where(disc >= 0.0, along - disc.clamp(min=0.0).sqrt(), math.inf)
    clear = disc.abs() > 1e-4
    assert (disc > 1e-4).sum() > 20
    torch.testing.assert_close(frame.ranges[0].double()[clear], expected[clear], rtol=1e-5, atol=1e-4)


def crowd(num_envs, num_bodies, seed=0):
    shapes = [replace(shape, pos=(0.3 * (i % 3), 0.0, 0.2)) for i, shape in enumerate(closed_shapes(num_bodies, 1))]
    shapes += [Shape(K.PLANE, pos=(0.0, 0.0, -1.0)), Shape(K.BOX, (1.0, 1.0, 1.0), pos=(4.0, 1.0, 0.0))]
    return RayScene(shapes, num_envs, num_bodies + 1, num_threads=2)


def random_poses(scene, generator, spread=3.0):
    pos = spread * torch.randn(scene.body_pos.shape, generator=generator)
    return pos, random_quats(generator, *scene.body_quat.shape[:2])


@pytest.mark.parametrize("num_bodies", [5, 40])
@pytest.mark.parametrize("segments", [1, 3])
def test_without_motion_a_frame_is_the_static_one(num_bodies, segments):
    scene = crowd(4, num_bodies)
    set_poses(scene, random_poses(scene, torch.Generator().manual_seed(1)))
    outputs = ("ranges", "shape_id", "normals_w", "points_w")
    mount = {"mount_pos": (0.2, 0.1, 0.0), "mount_rpy": (0.3, 0.2, 0.1)}
    still = Lidar(LidarConfig(NUM_RAYS, max_range=20.0, **mount), mid360(), scene, 0, outputs=outputs)
    config = LidarConfig(NUM_RAYS, max_range=20.0, motion_segments=segments, **mount)
    moving = Lidar(config, mid360(), scene, 0, outputs=outputs)
    time = torch.full((4,), 0.3, dtype=torch.float64)
    first, second = still.cast(time), moving.cast(time)
    assert torch.equal(first.shape_id, second.shape_id)
    torch.testing.assert_close(first.ranges, second.ranges, rtol=3e-7, atol=3e-7)
    hit = first.shape_id >= 0
    torch.testing.assert_close(first.normals_w[hit], second.normals_w[hit], atol=1e-5, rtol=0.0)
    torch.testing.assert_close(first.points_w[hit], second.points_w[hit], atol=1e-4, rtol=0.0)


def slerp(first, second, fraction):
    """Textbook formula in float64; quaternions (..., 4), fraction (..., 1)."""
    first, second = first.double(), second.double()
    dot = (first * second).sum(-1, keepdim=True)
    second, dot = torch.where(dot < 0.0, -second, second), dot.abs().clamp(max=1.0)
    angle = dot.acos().clamp(min=1e-9)
    mixed = ((1.0 - fraction) * angle).sin() * first + (fraction * angle).sin() * second
    return torch.nn.functional.normalize(mixed, dim=-1)


@pytest.mark.parametrize("segments", [1, 2, 3])
@pytest.mark.parametrize("turn", [0.2, 2.5])
@pytest.mark.parametrize("num_bodies", [6, 40])
def test_each_ray_sees_the_scene_of_its_own_time(segments, turn, num_bodies):
    """Poses at every ray's time by textbook formulas; each ray alone in a scene that stands still there."""
    generator = torch.Generator().manual_seed(segments)
    scene = crowd(1, num_bodies)
    keys = moves(scene, generator, segments + 1, turn)
    end = keys[1] if segments == 1 else keys[1:]
    frame = sweep(scene, keys[0], end, segments, fan(175.0, 80.0), mount_pos=(0.3, 0.0, 0.1))
    at = (frame.time_s[0].double() / PERIOD * segments).clamp(max=segments)
    piece = at.long().clamp(max=segments - 1)
    fraction = (at - piece)[:, None, None]
    pos = torch.stack([key[0][0] for key in keys]).double()
    quat = torch.stack([key[1][0] for key in keys]).double()
    still = RayScene(scene.shapes, NUM_RAYS, num_bodies + 1, num_threads=2)
    still.body_pos.copy_(pos[piece] + fraction * (pos[piece + 1] - pos[piece]))
    still.body_quat.copy_(slerp(quat[piece], quat[piece + 1], fraction))
    carrier_pos, carrier_quat = still.body_pos[:, :1].double(), still.body_quat[:, :1].double()
    origins = carrier_pos + rotate(carrier_quat, torch.tensor([0.3, 0.0, 0.1]).double().expand(NUM_RAYS, 1, 3))
    directions = rotate(carrier_quat, frame.directions_s[0][:, None].double())
    hits = still.cast(origins.float(), directions.float(), 50.0)
    same = frame.shape_id[0] == hits.shape_id[:, 0]
    assert same.float().mean() > 0.997
    close = torch.isclose(frame.ranges[0], hits.ranges[:, 0], rtol=1e-4, atol=1e-4)
    assert close[same].float().mean() > 0.997
    assert frame.ranges.isfinite().float().mean() > 0.1


def test_a_body_that_jumps_does_not_sweep():
    """A jump by 8 m within the frame: as if it had been there all along; a step by 0.4 m is a motion."""
    scene = RayScene([Shape(K.SPHERE, (0.5,), body=1)], 2, 2, num_threads=2)
    start = torch.tensor([[[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]]]).repeat(2, 1, 1)
    end = start.clone()
    end[0, 1, 0], end[1, 1, 0] = 12.0, 4.4
    swept = sweep(scene, (start, UPRIGHT), (end, UPRIGHT), motion_jump=1.0)
    scene.body_pos.copy_(end)
    still = Lidar(LidarConfig(NUM_RAYS, PERIOD, 0.0, 50.0), fan(), scene, 0)
    still.phase_rows.zero_()
    ranges = still.cast(torch.full((2,), PERIOD, dtype=torch.float64)).ranges
    torch.testing.assert_close(swept.ranges[0], ranges[0], rtol=1e-6, atol=1e-6)
    assert not torch.allclose(swept.ranges[1], ranges[1], atol=0.05)


def test_a_reset_forgets_the_motion_of_its_environment_only():
    scene = RayScene(wall_scene().shapes, 2, 1, num_threads=2)
    lidar = Lidar(LidarConfig(NUM_RAYS, PERIOD, 0.0, 50.0, motion_segments=1), fan(), scene, 0)
    still = Lidar(LidarConfig(NUM_RAYS, PERIOD, 0.0, 50.0), fan(), scene, 0)
    lidar.phase_rows.zero_()
    still.phase_rows.zero_()
    now = torch.full((2,), PERIOD, dtype=torch.float64)
    for which in (None, torch.tensor([1]), torch.tensor([1, 1])):
        scene.body_quat[:, 0] = yaw_quat(-0.5)
        lidar.cast(now)
        scene.body_quat[:, 0] = yaw_quat(0.5)
        if which is not None:
            lidar.reset(which)
        ranges, flat = lidar.cast(now).ranges, still.cast(now).ranges
        bent = [not torch.allclose(ranges[env], flat[env], rtol=1e-5) for env in (0, 1)]
        assert bent == [True, which is None]


def moves(scene, generator, count, turn=0.3):
    """Poses at ``count`` moments, each a little farther than the last one."""
    keys = [random_poses(scene, generator, 2.0)]
    keys[0][0][:, 0] = 0.0
    for _ in range(count - 1):
        pos, quat = random_poses(scene, generator, 0.3)
        nudge = torch.nn.functional.normalize(torch.cat([torch.ones_like(quat[..., :1]), turn * quat[..., 1:]], -1))
        keys.append((keys[-1][0] + pos, torch.nn.functional.normalize(multiply(keys[-1][1], nudge), dim=-1)))
    return keys


def set_poses(scene, key):
    scene.body_pos.copy_(key[0])
    scene.body_quat.copy_(key[1])


def test_frames_share_the_moment_between_them():
    """Three frames of two segments in a row: each is the one that is cast alone from its own three moments."""
    scene = crowd(2, 6)
    keys = moves(scene, torch.Generator().manual_seed(4), 7)
    lidar = Lidar(LidarConfig(NUM_RAYS, PERIOD, 0.0, 50.0, motion_segments=2), fan(), scene, 0)
    lidar.phase_rows.zero_()
    set_poses(scene, keys[0])
    lidar.record_poses()
    for k in range(3):
        set_poses(scene, keys[2 * k + 1])
        lidar.record_poses()
        set_poses(scene, keys[2 * k + 2])
        ranges = lidar.cast((k + 1) * PERIOD).ranges.clone()
        alone = sweep(scene, keys[2 * k], keys[2 * k + 1 : 2 * k + 3], 2)
        assert torch.equal(ranges, alone.ranges)


def test_a_sensor_that_goes_on_from_a_saved_state_casts_the_same():
    config = LidarConfig(NUM_RAYS, PERIOD, 0.0, 50.0, motion_segments=3)
    scenes = crowd(2, 6), crowd(2, 6)
    first, second = (Lidar(config, fan(), scene, 0, noise=[GaussianNoise()]) for scene in scenes)
    keys = moves(scenes[0], torch.Generator().manual_seed(4), 7)
    for moment, key in enumerate(keys):
        for lidar in (first, second)[: 1 if moment < 4 else 2]:
            set_poses(lidar.scene, key)
            if moment in (3, 6):
                lidar.cast(moment / 3 * PERIOD)
            else:
                lidar.record_poses()
        if moment == 3:
            first.reset(torch.tensor([1]))
            second.load_state_dict(first.state_dict())
    assert torch.equal(first.frame.ranges, second.frame.ranges)


def test_missing_moments_are_refused():
    lidar = Lidar(LidarConfig(NUM_RAYS, PERIOD, motion_segments=3), fan(), wall_scene(), 0)
    lidar.cast(PERIOD)  # the very first frame has none
    lidar.record_poses()
    with pytest.raises(ValueError, match=r"motion_segments=3 needs record_poses\(\) 2 times, .* got 1"):
        lidar.cast(2 * PERIOD)
    lidar.record_poses()
    lidar.cast(2 * PERIOD)


@pytest.mark.parametrize("what", ["pos", "quat"])
def test_a_body_without_a_pose_is_not_there_until_it_has_one_again(what):
    scene = RayScene([Shape(K.SPHERE, (0.5,), body=1)], 1, 2, num_threads=2)
    scene.body_pos[0, 1, 0] = 4.0
    lidar = Lidar(LidarConfig(NUM_RAYS, PERIOD, 0.0, 50.0, motion_segments=1), fan(), scene, 0)
    now = torch.full((1,), PERIOD, dtype=torch.float64)
    pose, value = {"pos": (scene.body_pos, (4.0, 0.0, 0.0)), "quat": (scene.body_quat, (1.0, 0.0, 0.0, 0.0))}[what]
    assert lidar.cast(now).ranges.isfinite().any()
    pose[0, 1, 0] = math.nan
    assert not lidar.cast(now).ranges.isfinite().any() and not lidar.cast(now).ranges.isfinite().any()
    pose[0, 1] = torch.tensor(value)
    assert lidar.cast(now).ranges.isfinite().any()
    pose[0, 0, 0] = math.inf  # a sensor without a pose sees nothing
    assert not lidar.cast(now).ranges.isfinite().any()


def angles(frame):
    d = frame.directions_s.double()
    return torch.asin(d[..., 2]), torch.atan2(d[..., 1], d[..., 0])
