"""The LiDAR's rays through a compiled model against mj_ray."""

import mujoco
import numpy as np
import torch

from omnilidar import RayScene
from omniperception.scene.rays import ray_shapes


def ray_scene(world, data):
    """The LiDAR's scene of one environment with the bodies where `data` has them."""
    shapes = ray_shapes(world)
    scene = RayScene(shapes.shapes, 1, len(shapes.bodies), num_threads=1)
    scene.body_pos[0] = torch.tensor(data.xpos[list(shapes.bodies)], dtype=torch.float32)
    scene.body_quat[0] = torch.tensor(data.xquat[list(shapes.bodies)], dtype=torch.float32)
    return scene


def assert_rays_are_those_of_mj_ray(world, data, origins, directions):
    """Casts rays (N, 3) and returns the geoms (N,) that mj_ray hits; 1 % may graze an edge and hit another."""
    origins = origins.astype(np.float32)
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    hits = ray_scene(world, data).cast(torch.tensor(origins)[None], torch.tensor(directions)[None])
    geom, expected = np.zeros(1, np.int32), []
    for o, d in zip(origins.astype(np.float64), directions.astype(np.float64), strict=True):
        expected.append((mujoco.mj_ray(world.model, data, o, d, None, 1, -1, geom), int(geom[0])))
    ranges, geoms = (np.array(x) for x in zip(*expected, strict=True))
    same = hits.shape_id[0].numpy() == geoms  # one shape per geom, in the model's order
    assert same.mean() > 0.99
    np.testing.assert_allclose(hits.ranges[0].numpy()[same], np.where(geoms < 0, np.inf, ranges)[same], atol=1e-4)
    return geoms[same]
