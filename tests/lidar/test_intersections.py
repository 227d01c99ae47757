"""Ray intersections against mj_ray in float64 and against closed forms."""

import math

import mujoco
import numpy as np
import pytest
import torch

from omniperception.lidar import RayScene, Shape, ShapeKind

RELATIVE, ABSOLUTE = 1e-5, 1e-5
GRAZING = 1e-3  # hit or miss may differ where mj_ray changes its mind when the ray moves sideways by this, metres
SHALLOW = 0.05  # the tolerance grows as SHALLOW / |cos of incidence| below this: float32 cannot do better

SIZES = {
    ShapeKind.PLANE: lambda rng: (),
    ShapeKind.BOX: lambda rng: tuple(rng.uniform(0.05, 0.8, 3)),
    ShapeKind.SPHERE: lambda rng: (rng.uniform(0.05, 0.8),),
    ShapeKind.CYLINDER: lambda rng: tuple(rng.uniform(0.05, 0.8, 2)),
    ShapeKind.CAPSULE: lambda rng: tuple(rng.uniform(0.05, 0.8, 2)),
    ShapeKind.ELLIPSOID: lambda rng: tuple(rng.uniform(0.1, 0.8, 3)),
}


def random_shapes(kinds, rng, spread):
    def shape(kind):
        quat = rng.normal(size=4)
        return Shape(
            kind,
            SIZES[kind](rng),
            pos=tuple(rng.uniform(-spread, spread, 3)),
            quat=tuple(quat / np.linalg.norm(quat)),
        )

    return [shape(kind) for kind in kinds]


class Reference:
    """The same shapes as geoms of a MuJoCo model."""

    def __init__(self, shapes):
        spec = mujoco.MjSpec()
        for shape in shapes:
            size = (*shape.size, 0.0, 0.0, 0.0)[:3] if shape.kind != ShapeKind.PLANE else (0.0, 0.0, 0.01)
            geom = getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind.name}")
            spec.worldbody.add_geom(type=geom, size=size, pos=shape.pos, quat=shape.quat)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)

    def __call__(self, origin, direction):
        geom, normal = np.zeros((1, 1), np.int32), np.zeros((3, 1))
        distance = mujoco.mj_ray(
            self.model,
            self.data,
            origin.astype(np.float64),
            direction.astype(np.float64),
            None,
            1,
            -1,
            geom,
            normal,
        )
        return (math.inf if distance < 0 else distance), int(geom[0, 0]), normal[:, 0]


def unit(rng, count):
    vectors = rng.normal(size=(count, 3))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def is_grazing(reference, origin, direction, geom):
    """Whether mj_ray itself changes hit, shape or (much) distance within a sideways shift of the ray."""
    side = np.cross(direction, [1.0, 0.0, 0.0] if abs(direction[0]) < 0.7 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(direction, side)
    answers = [
        reference(origin + GRAZING * (math.cos(a) * side + math.sin(a) * other), direction)[1]
        for a in np.linspace(0.0, 2.0 * math.pi, 8, endpoint=False)
    ]
    return any(answer != geom for answer in answers)


def compare(shapes, origins, directions):
    """Share of rays that agree with mj_ray; every ray that does not must be grazing."""
    reference = Reference(shapes)
    scene = RayScene(shapes, num_envs=1, num_bodies=0)
    hits = scene.cast(torch.from_numpy(origins)[None], torch.from_numpy(directions)[None], normals=True)
    agree, same_normal = [], []
    for i, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        distance, geom, normal = reference(origin, direction / np.linalg.norm(direction.astype(np.float64)))
        ours, shape = float(hits.ranges[0, i]), int(hits.shape_id[0, i])
        if shape == geom:
            shallow = min(1.0, abs(np.dot(normal, direction)) / SHALLOW)
            close = shape < 0 or abs(ours - distance) * shallow <= RELATIVE * distance + ABSOLUTE
            if shape >= 0 and close:
                same_normal.append(abs(np.dot(hits.normals_w[0, i].numpy(), normal)) > 1.0 - 1e-3)
        else:
            close = False
            assert is_grazing(reference, origin, direction, geom), (i, ours, distance, shape, geom)
        agree.append(close)
    return np.mean(agree), np.mean(same_normal) if same_normal else 1.0


@pytest.mark.parametrize("kind", list(ShapeKind), ids=lambda kind: kind.name.lower())
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_single_shape_matches_mj_ray(kind, seed):
    rng = np.random.default_rng(seed)
    shapes = random_shapes([kind], rng, spread=1.0)
    centre = np.array(shapes[0].pos)
    outside = rng.uniform(-5.0, 5.0, (1500, 3))
    inside = centre + rng.uniform(-0.3, 0.3, (500, 3))
    origins = np.concatenate([outside, inside]).astype(np.float32)
    directions = unit(rng, len(origins))
    aimed = (centre + rng.uniform(-0.6, 0.6, (1000, 3)) - origins[:1000]).astype(np.float32)
    directions[:1000] = aimed / np.linalg.norm(aimed, axis=1, keepdims=True)
    agreement, normals = compare(shapes, origins, directions)
    assert agreement >= 0.999
    assert normals >= 0.999


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_crowded_scene_matches_mj_ray(seed):
    rng = np.random.default_rng(seed)
    shapes = random_shapes(list(ShapeKind) * 4, rng, spread=3.0)
    origins = rng.uniform(-4.0, 4.0, (2000, 3)).astype(np.float32)
    agreement, normals = compare(shapes, origins, unit(rng, len(origins)))
    assert agreement >= 0.999
    assert normals >= 0.999


def single(shape, origin, direction, **options):
    scene = RayScene([shape], num_envs=1, num_bodies=0)
    ray = [torch.tensor([[v]], dtype=torch.float32) for v in (origin, direction)]
    hits = scene.cast(*ray, **options)
    return float(hits.ranges), int(hits.shape_id)


K = ShapeKind
EIGHTH_TURN = (math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8))
CLOSED_FORMS = [
    ("plane from above", Shape(K.PLANE), (0, 0, 2), (0, 0, -1), 2.0),
    ("plane at 45 degrees", Shape(K.PLANE), (0, 0, 2), (1, 0, -1), 2.0 * math.sqrt(2.0)),
    ("plane from below", Shape(K.PLANE), (0, 0, -2), (0, 0, 1), math.inf),
    ("plane, away", Shape(K.PLANE), (0, 0, 2), (0, 0, 1), math.inf),
    ("plane, parallel", Shape(K.PLANE), (0, 0, 2), (1, 0, 0), math.inf),
    ("sphere outside", Shape(K.SPHERE, (1.0,)), (-3, 0, 0), (1, 0, 0), 2.0),
    ("sphere inside", Shape(K.SPHERE, (1.0,)), (-0.5, 0, 0), (1, 0, 0), 1.5),
    ("sphere behind", Shape(K.SPHERE, (1.0,)), (3, 0, 0), (1, 0, 0), math.inf),
    ("direction of any length", Shape(K.SPHERE, (1.0,)), (-3, 0, 0), (5, 0, 0), 2.0),
    ("box outside", Shape(K.BOX, (1.0, 2.0, 3.0)), (0, 5, 0.5), (0, -1, 0), 3.0),
    ("box inside", Shape(K.BOX, (1.0, 2.0, 3.0)), (0, 0, 0), (0, 0, 1), 3.0),
    ("box past its face", Shape(K.BOX, (1.0, 1.0, 1.0)), (1.01, -5, 0), (0, 1, 0), math.inf),
    ("cylinder side", Shape(K.CYLINDER, (0.5, 1.0)), (-2, 0, 0.9), (1, 0, 0), 1.5),
    ("cylinder top, parallel to the axis", Shape(K.CYLINDER, (0.5, 1.0)), (0.4, 0, 3), (0, 0, -1), 2.0),
    ("cylinder inside along the axis", Shape(K.CYLINDER, (0.5, 1.0)), (0, 0, 0), (0, 0, 1), 1.0),
    ("cylinder corner has no cap", Shape(K.CYLINDER, (0.5, 1.0)), (-2, 0, 1.2), (1, 0, 0), math.inf),
    ("capsule cap", Shape(K.CAPSULE, (0.5, 1.0)), (0, 0, 4), (0, 0, -1), 2.5),
    ("capsule cap sideways", Shape(K.CAPSULE, (0.5, 1.0)), (-2, 0, 1.3), (1, 0, 0), 1.6),
    ("capsule inside along the axis", Shape(K.CAPSULE, (0.5, 1.0)), (0, 0, 0), (0, 0, -1), 1.5),
    ("capsule, parallel beside it", Shape(K.CAPSULE, (0.5, 1.0)), (0.6, 0, 4), (0, 0, -1), math.inf),
    ("ellipsoid", Shape(K.ELLIPSOID, (1.0, 2.0, 3.0)), (0, 0, 5), (0, 0, -1), 2.0),
    ("ellipsoid inside", Shape(K.ELLIPSOID, (1.0, 2.0, 3.0)), (0, 0, 0), (0, 1, 0), 2.0),
    ("turned box", Shape(K.BOX, (1, 1, 1), quat=EIGHTH_TURN), (-3, 0, 0), (1, 0, 0), 3.0 - math.sqrt(2.0)),
]  # fmt: skip


@pytest.mark.parametrize(
    ("shape", "origin", "direction", "expected"),
    [c[1:] for c in CLOSED_FORMS],
    ids=[c[0] for c in CLOSED_FORMS],
)
def test_closed_forms(shape, origin, direction, expected):
    distance, shape_id = single(shape, origin, direction)
    assert distance == pytest.approx(expected, abs=2e-6)
    assert shape_id == (0 if math.isfinite(expected) else -1)


def test_max_range_and_exclusion():
    sphere = Shape(K.SPHERE, (1.0,))
    assert single(sphere, (-3, 0, 0), (1, 0, 0), max_range=1.9) == (math.inf, -1)
    assert single(sphere, (-3, 0, 0), (1, 0, 0), max_range=2.1)[1] == 0
    assert single(sphere, (-3, 0, 0), (1, 0, 0), exclude_shapes=(0,)) == (math.inf, -1)


def test_thin_and_far_shapes_keep_their_accuracy():
    rod = Shape(K.CAPSULE, (0.01, 1.0), pos=(39.0, 0.0, 0.0))
    assert single(rod, (0, 0, 0), (1, 0, 0))[0] == pytest.approx(38.99, abs=1e-4)
    assert single(rod, (0, 0.0095, 0), (1, 0, 0))[1] == 0
    assert single(rod, (0, 0.0105, 0), (1, 0, 0))[1] == -1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((K.SPHERE, (0.0,)), "must be positive"),
        ((K.BOX, (1.0, 1.0)), "must have 3 values"),
        ((K.PLANE, (1.0,)), "must have 0 values"),
        ((17, (1.0,)), "must be one of ShapeKind"),
        ((K.SPHERE, (float("nan"),)), "must be finite"),
        ((K.SPHERE, (1.0,), -2), "shape.body=-2"),
        ((K.SPHERE, (1.0,), -1, (0, 0, 0), (1, 1, 0, 0)), "unit quaternion"),
        ((K.SPHERE, (1.0,), -1, (0, 0, 0), (1, 0, 0, 0), -1), "class_id=-1"),
    ],
)
def test_wrong_shapes_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Shape(*arguments)
