"""What several tests of the LiDAR need: a cube, rays from arrays, rows of frames, rotations, a crowd of shapes."""

import numpy as np
import torch

from omnilidar import RayScene, Shape, make_selection
from omnilidar import ShapeKind as K

CUBE = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
CUBE_FACES = np.array(
    [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
     (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
)  # fmt: skip
CLOSED_SIZES = {
    K.BOX: (0.3, 0.2, 0.5),
    K.SPHERE: (0.4,),
    K.CYLINDER: (0.2, 0.6),
    K.CAPSULE: (0.1, 0.5),
    K.ELLIPSOID: (0.2, 0.4, 0.6),
}
"""A size of each closed analytic shape, metres."""


def cast(scene, origins, directions, **options):
    """General rays from anything that makes an array."""
    rays = [torch.from_numpy(np.array(v, np.float64)).reshape(scene.num_envs, -1, 3) for v in (origins, directions)]
    return scene.cast(*rays, **options)


def one(shapes, origin, direction, **options):
    """Range of one ray through fixed shapes."""
    return float(cast(RayScene(shapes, 1, 0), origin, direction, **options).ranges)


def clock(num_envs, time):
    return torch.full((num_envs,), time, dtype=torch.float64)


def select_rows(pattern, time, period_s, num_rays, phase_rows=0, selection=None, frame=0):
    """(num_envs, num_rays) table rows of frames number `frame` that end at (num_envs,) s; without a selection every
    k-th."""
    selection = selection or make_selection(pattern, period_s, num_rays)
    first = pattern.first_rows(time, period_s, phase_rows)
    variants = selection.variants(first, torch.as_tensor(frame))
    return (first[:, None] + selection.offsets[variants]).remainder(pattern.num_rows)


def rotate(quat, vectors):
    """Vectors (..., 3) turned by unit quaternions (..., 4)."""
    quat = quat.to(vectors.dtype)
    w, xyz = quat[..., :1], quat[..., 1:].expand(vectors.shape)
    across = 2.0 * torch.linalg.cross(xyz, vectors)
    return vectors + w * across + torch.linalg.cross(xyz, across)


def turn(quat, points):
    """NumPy points (N, 3) turned by a unit quaternion, in float64."""
    return rotate(torch.as_tensor(quat, dtype=torch.float64), torch.as_tensor(points, dtype=torch.float64)).numpy()


def multiply(a, b):
    """Hamilton product of quaternions (..., 4)."""
    w, v = a[..., :1], a[..., 1:]
    s, u = b[..., :1], b[..., 1:]
    return torch.cat([w * s - (v * u).sum(-1, keepdim=True), w * u + s * v + torch.linalg.cross(v, u)], -1)


def random_quats(generator, *shape):
    return torch.nn.functional.normalize(torch.randn(*shape, 4, generator=generator), dim=-1)


def closed_shapes(count, first_body=0, **options):
    """Closed analytic shapes in turn, each on a body of its own."""
    kinds = list(CLOSED_SIZES)
    return [Shape(kinds[i % 5], CLOSED_SIZES[kinds[i % 5]], body=first_body + i, **options) for i in range(count)]
