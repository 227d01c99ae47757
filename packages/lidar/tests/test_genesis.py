"""A ray scene from a Genesis scene, against Genesis's own ray caster, which casts at meshes of everything."""

import numpy as np
import pytest
import torch

from omnilidar import GenesisScene, ShapeKind

gs = pytest.importorskip("genesis")

ENVS, RAYS, REACH = 3, 4000, 15.0
ABOVE = (0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def built():
    """A scene of everything, a step after links were put somewhere, and Genesis's own ranges, inf for a miss."""
    from genesis.options.sensors.raycaster import RaycastPattern

    if gs._initialized:  # by another test of this process
        gs.destroy()
    gs.init(backend=gs.cpu, logging_level="error")
    rng = np.random.default_rng(3)
    starts, ways = rng.uniform((-4, -4, -0.6), (4, 4, 1.5), (RAYS, 3)), rng.normal(size=(RAYS, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)

    class Given(RaycastPattern):
        def _get_return_shape(self):
            return (RAYS,)

        def compute_ray_dirs(self):
            self._ray_dirs.copy_(torch.as_tensor(ways))

        def compute_ray_starts(self):
            self._ray_starts.copy_(torch.as_tensor(starts))

    scene = gs.Scene(show_viewer=False, rigid_options=gs.options.RigidOptions(gravity=(0, 0, 0)))
    morphs, euler = gs.morphs, (20.0, 30.0, 40.0)
    plane = scene.add_entity(morphs.Plane(normal=(0.1, 0.0, 1.0)), name="ground")
    scene.add_entity(morphs.Box(size=(0.4, 0.6, 0.8), pos=(2, 0, 2)), name="box")
    scene.add_entity(morphs.Box(size=(0.4, 0.6, 0.8), pos=(2, 3, 1), euler=euler, fixed=True), name="fixed")
    scene.add_entity(morphs.Sphere(radius=0.5, pos=(0, 2, 2)), name="ball")
    scene.add_entity(morphs.Cylinder(radius=0.3, height=1.0, pos=(-2, 0, 2), euler=euler), name="post")
    scene.add_entity(morphs.Mesh(file="meshes/duck.obj", scale=1.0, pos=(-2, 2, 2), euler=(90, 0, 0)), name="duck")
    kinds = {"subterrain_types": [["random_uniform_terrain"]], "n_subterrains": (1, 1)}
    sizes = {"subterrain_size": (3.0, 3.0), "horizontal_scale": 0.25, "vertical_scale": 0.02}
    scene.add_entity(morphs.Terrain(pos=(-3.0, -4.0, 0.6), **kinds, **sizes), name="terrain")
    scene.add_entity(morphs.URDF(file="urdf/go2/urdf/go2.urdf", pos=(2, -2, 1.5)), name="go2")
    scene.add_entity(morphs.Sphere(radius=0.2, pos=(0, -3, 2)), material=gs.materials.FEM.Elastic(), name="soft")
    cloth = morphs.Mesh(file="meshes/cloth.obj", pos=(6, 0, 2))
    scene.add_entity(cloth, material=gs.materials.PBD.Cloth(), name="cloth")
    own = gs.sensors.Raycaster(entity_idx=plane.idx, pos_offset=ABOVE, pattern=Given(), max_range=REACH)
    sensor = scene.add_sensor(own)
    scene.build(n_envs=ENVS)
    for entity in scene.entities:
        if entity.name in ("box", "ball", "post", "duck", "go2"):
            entity.set_pos(entity.get_pos() + 0.3 * torch.as_tensor(rng.normal(size=(ENVS, 3)), dtype=torch.float32))
            quat = torch.as_tensor(rng.normal(size=(ENVS, 4)), dtype=torch.float32)
            entity.set_quat(quat / quat.norm(dim=1, keepdim=True))
    scene.step()
    ranges = sensor.read().distances.cpu().numpy().reshape(ENVS, RAYS)
    ranges = np.where(ranges >= REACH - 1e-3, np.inf, ranges)
    return scene, starts + np.array(ABOVE), ways, ranges


def test_rays_hit_what_genesis_hits(built):
    """What is flat there and here equally, what is round there as a mesh that is inscribed to it."""
    scene, starts, ways, wanted = built
    rays = GenesisScene(scene, entities=[entity for entity in scene.entities if hasattr(entity, "links")])
    hits = rays.cast(*(np.broadcast_to(x, (ENVS, RAYS, 3)).copy() for x in (starts, ways)), max_range=REACH)
    got, shape = hits.ranges.numpy(), hits.shape_id.numpy()
    both = np.isfinite(got) & np.isfinite(wanted)
    error = np.where(both, np.abs(np.where(both, got, 0.0) - np.where(both, wanted, 0.0)), 0.0)
    kinds = np.array([int(shape.kind) for shape in rays.shapes])[shape]
    flat = both & np.isin(kinds, [int(ShapeKind.PLANE), int(ShapeKind.BOX), int(ShapeKind.MESH)])
    assert both.mean() > 0.5 and (np.isfinite(got) != np.isfinite(wanted)).mean() < 0.001
    assert error[flat].max() < 1e-4 and error.max() < 0.03
    seen = {rays.geoms[k].entity.name for k in np.unique(shape[both])}
    assert seen == {"ground", "box", "fixed", "ball", "post", "duck", "terrain", "go2"}


def test_bodies_move_and_are_found_by_name(built):
    scene, *_ = built
    rays = GenesisScene(scene)
    box = rays.link("box_baselink")
    entity = next(entity for entity in scene.entities if entity.name == "box")
    assert torch.allclose(rays.body_pos[:, box].cpu().float(), entity.get_pos().cpu(), atol=1e-6)
    with pytest.raises(ValueError, match="link 'wheel' must be one of the bodies"):
        rays.link("wheel")
    assert not any("ground" in name or "fixed" in name for name in rays.body_names)


def test_soft_bodies_are_hit_where_their_vertices_are(built):
    scene, *_ = built
    rays = GenesisScene(scene)
    down = np.array([0.0, 0.0, -1.0], np.float32)
    for name, tolerance in (("soft", 0.03), ("cloth", 0.03)):
        entity = next(entity for entity in scene.entities if entity.name == name)
        pos = entity.get_state().pos if name == "soft" else entity.get_particles_pos()
        top = pos.cpu().numpy().reshape(ENVS, -1, 3)
        above = np.stack([own[own[:, 2].argmax()] for own in top]) if name == "soft" else top.mean(1)
        start = (above + np.array([0.003, 0.003, 1.0])).astype(np.float32)[:, None]
        hits = rays.cast(start, np.broadcast_to(down, start.shape).copy(), max_range=REACH)
        k = len(rays.shapes) - (2 if name == "soft" else 1)
        assert (hits.shape_id == k).all(), name
        assert np.abs(start[:, 0, 2] - hits.ranges.numpy()[:, 0] - above[:, 2]).max() < tolerance, name


def test_entities_that_differ_between_environments_are_refused(built):
    scene = gs.Scene(show_viewer=False)
    scene.add_entity([gs.morphs.Box(size=(0.4, 0.4, 0.4)), gs.morphs.Sphere(radius=0.2)])
    scene.build(n_envs=2)
    with pytest.raises(ValueError, match="make a Genesis scene for each"):
        GenesisScene(scene)


def test_a_scene_that_is_not_built_is_refused(built):
    with pytest.raises(ValueError, match="call scene.build"):
        GenesisScene(gs.Scene(show_viewer=False))
