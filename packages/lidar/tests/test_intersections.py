"""Ray intersections against mj_ray in float64, normals and grazing rays against closed forms."""

import math

import numpy as np
import pytest
from lidar_helpers import cast, one

from benchmarks.lidar_accuracy import cases, compare
from omnilidar import RayScene, Shape, ShapeKind

K = ShapeKind


@pytest.mark.parametrize("case", cases(), ids=lambda case: case.name)
def test_ranges_are_those_of_mj_ray(case):
    """The long version, 10^6 rays of each case, is scripts/lidar_accuracy.py."""
    tally = compare(case, num_rays=3000, seed=1, rays_per_scene=500)
    assert tally.unexplained == 0, tally.examples
    assert tally.share_within >= 0.999 and tally.hits > 200


HALF_ROOT = math.sqrt(0.5)
EIGHTH_TURN = (math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8))
NORMALS = [
    ("plane", Shape(K.PLANE), (0, 0, 2), (0.3, 0, -1), (0, 0, 1)),
    ("sphere", Shape(K.SPHERE, (1.0,)), (-3, 0, 0), (1, 0, 0), (-1, 0, 0)),
    ("sphere from inside", Shape(K.SPHERE, (1.0,)), (0, 0, 0), (1, 0, 0), (1, 0, 0)),
    ("box", Shape(K.BOX, (1, 2, 3)), (0.5, 5, 0.5), (0, -1, 0), (0, 1, 0)),
    ("turned box", Shape(K.BOX, (1, 1, 1), quat=EIGHTH_TURN), (-3, 1e-3, 0), (1, 0, 0), (-HALF_ROOT, HALF_ROOT, 0)),
    ("cylinder side", Shape(K.CYLINDER, (0.5, 1.0)), (-2, 0, 0.9), (1, 0, 0), (-1, 0, 0)),
    ("cylinder cap", Shape(K.CYLINDER, (0.5, 1.0)), (0.4, 0, 3), (0, 0, -1), (0, 0, 1)),
    ("capsule cap", Shape(K.CAPSULE, (0.5, 1.0)), (-2, 0, 1.3), (1, 0, 0), (-0.8, 0, 0.6)),
    ("ellipsoid", Shape(K.ELLIPSOID, (1.0, 2.0, 3.0)), (0, 0, 5), (0, 0, -1), (0, 0, 1)),
]  # fmt: skip


@pytest.mark.parametrize(
    ("shape", "origin", "direction", "expected"), [c[1:] for c in NORMALS], ids=[c[0] for c in NORMALS]
)
def test_normals_point_outwards(shape, origin, direction, expected):
    hits = cast(RayScene([shape], 1, 0), origin, direction, normals=True)
    np.testing.assert_allclose(hits.normals_w[0, 0].numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("height", [0.3, 3.0])
@pytest.mark.parametrize("angle", [1e-1, 1e-2, 1e-3, 1e-4])
def test_grazing_the_ground(height, angle):
    """Range is height / sin(angle), which a rounding of the plane's normal to float32 would miss by 1e-7 / angle."""
    tilt = (math.cos(0.2), math.sin(0.2), 0.0, 0.0)  # turned by 0.4 rad about x, carried along by the ray
    turn = np.array([[1, 0, 0], [0, math.cos(0.4), -math.sin(0.4)], [0, math.sin(0.4), math.cos(0.4)]])
    origin = turn @ np.array([0.0, 0.0, height])
    direction = turn @ np.array([math.cos(1.1) * math.cos(angle), math.sin(1.1) * math.cos(angle), -math.sin(angle)])
    assert one([Shape(K.PLANE, quat=tilt)], origin, direction) == pytest.approx(height / math.sin(angle), rel=2e-7)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((K.SPHERE, (0.0,)), "must be positive"),
        ((K.SPHERE, (float("nan"),)), "must be finite"),
        ((K.SPHERE, (1.0,), -1, (0, 0, 0), (1, 1, 0, 0)), "unit quaternion"),
        ((K.MESH,), "shape.asset=NoneType of a mesh must be a TriangleMesh"),
    ],
)
def test_wrong_shapes_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Shape(*arguments)
