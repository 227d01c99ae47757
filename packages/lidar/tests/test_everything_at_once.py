"""One scene with every way in which a shape can be there, and several sensors that each leave out their own housing."""

import math

import numpy as np
import pytest
import torch
from lidar_helpers import CUBE, CUBE_FACES

from omnilidar import (
    DEVICES,
    AngularJitter,
    GaussianNoise,
    HeightField,
    Lidar,
    LidarConfig,
    RayScene,
    ScanPattern,
    Shape,
    TriangleMesh,
)
from omnilidar import ShapeKind as K

AXES = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
LOWER, UPPER, CARRIED = range(3)
"""Bodies: one with a sensor at the origin, one with a sensor 3 m above it, one that carries a mesh."""


def everything():
    """Two environments: a deformable twice as wide in the second, where a ball is missing; metres."""
    cube = TriangleMesh(CUBE, CUBE_FACES)
    shapes = [
        Shape(K.SPHERE, (0.2,), body=LOWER),
        Shape(K.SPHERE, (0.2,), body=UPPER),
        Shape(K.MESH, asset=cube, body=CARRIED),
        Shape(K.DEFORMABLE, asset=cube, pos=(0.0, 6.0, 0.0)),
        Shape(K.SPHERE, (0.5,), pos=(0.0, -2.5, 0.0)),
        Shape(K.HEIGHTFIELD, pos=(0.0, 0.0, -2.0), asset=HeightField(np.full((5, 5), 0.5), 3.0, 3.0)),
        Shape(K.BOX, (0.5, 0.5, 0.5), pos=(-5.0, 0.0, 0.0)),
        Shape(K.PLANE, pos=(0.0, 0.0, -2.0)),
    ]
    scene = RayScene(shapes, num_envs=2, num_bodies=3)
    scene.set_poses(np.array([[0, 0, 0], [0, 0, 3.0], [4.0, 0, 0]]), np.tile([1.0, 0, 0, 0], (3, 1)))
    scene.update_vertices(3, torch.from_numpy(CUBE.astype(np.float32)) * torch.tensor([1.0, 2.0]).reshape(2, 1, 1))
    scene.visible[1, 4] = False
    return scene


@pytest.mark.parametrize("segments", [0, 1])
def test_each_sensor_sees_everything_but_its_own_housing(segments):
    scene = everything()
    pattern = ScanPattern.from_directions(AXES.double().numpy(), 60.0, rows_per_shot=6)
    config = LidarConfig(6, 0.1, min_range=0.0, max_range=20.0, motion_segments=segments)
    outputs = ("ranges", "shape_id", "row")
    lower, upper = (
        Lidar(config, pattern, scene, body, scene.shapes_of(body), outputs=outputs) for body in (LOWER, UPPER)
    )
    seen = lower.cast(0.1)
    assert seen.row.tolist() == [list(range(6))] * 2
    expected = [[3.0, 4.5, 5.0, 2.0, 2.8, 1.5], [3.0, 4.5, 4.0, math.inf, 2.8, 1.5]]
    torch.testing.assert_close(seen.ranges, torch.tensor(expected), rtol=1e-6, atol=1e-6)
    assert seen.shape_id.tolist() == [[2, 6, 3, 4, 1, 5], [2, 6, 3, -1, 1, 5]]
    above = upper.cast(0.1)
    torch.testing.assert_close(above.ranges[:, 5], torch.full((2,), 2.8), rtol=1e-6, atol=1e-6)
    assert above.shape_id.tolist() == [[-1, -1, -1, -1, -1, 0]] * 2


# --- conveniences ----------------------------------------------------------------------------------------------


def test_poses_of_either_quaternion_order_and_any_array():
    scene, other = (RayScene([], 2, 3, pose_dtype=torch.float64) for _ in range(2))
    rng = np.random.default_rng(0)
    pos, quat = rng.normal(size=(2, 3, 3)), rng.normal(size=(2, 3, 4))
    scene.set_poses(pos, quat)
    other.set_poses(torch.from_numpy(pos), torch.from_numpy(quat[..., [1, 2, 3, 0]]), order="xyzw")
    for scene_of in (scene, other):
        np.testing.assert_array_equal(scene_of.body_pos.numpy(), pos)
        np.testing.assert_array_equal(scene_of.body_quat.numpy(), quat)
    scene.set_poses(pos[0].astype(np.float32), quat[0])
    np.testing.assert_array_equal(scene.body_quat[1].numpy(), quat[0])
    with pytest.raises(ValueError, match=r"pos \(3, 2, 3\) must be \(2, 3, 3\) or \(3, 3\)"):
        scene.set_poses(pos.swapaxes(0, 1), quat)
    with pytest.raises(ValueError, match="order='wzyx' must be one of wxyz, xyzw"):
        scene.set_poses(pos, quat, order="wzyx")


def test_a_time_may_be_a_number_or_an_array():
    scene = RayScene([Shape(K.SPHERE, (2.0,))], 3, 0)
    pattern = ScanPattern.from_directions(np.eye(3), 30.0)
    lidar = Lidar(LidarConfig(1, 0.1), pattern, scene, -1, outputs=("row",))
    times = torch.full((3,), 0.7, dtype=torch.float64)
    rows = lidar.cast(times).row.clone()
    assert torch.equal(lidar.cast(0.7).row, rows) and torch.equal(lidar.cast(times.numpy()).row, rows)
    with pytest.raises(ValueError, match=r"time_s must be float64 \(3,\)"):
        lidar.cast(np.zeros(2))


def test_a_device_knows_its_noise():
    assert DEVICES["mid360"].noise() == (GaussianNoise(0.02), AngularJitter(0.15))
    assert DEVICES["vlp16"].noise() == (GaussianNoise(0.03),)
    assert all(isinstance(model, GaussianNoise | AngularJitter) for d in DEVICES.values() for model in d.noise())
