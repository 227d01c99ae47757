"""The accuracy report finds nothing to complain about, and complains where there is something."""

import mujoco
import numpy as np

from benchmarks.lidar_accuracy import Case, compare, is_explained, leaks, random_model, random_state

BOX = Case("box", (mujoco.mjtGeom.mjGEOM_BOX,))


def test_no_ray_leaves_a_closed_room():
    found = leaks(2000, seed=1)
    assert [name for name, *_ in found] == ["mesh", "deformable", "hfield", "box"]
    assert all(rays >= 2000 and escaped == 0 for _, rays, escaped in found)


def test_a_wrong_range_is_counted(monkeypatch):
    assert compare(BOX, 500, seed=0, rays_per_scene=250).share_within == 1.0
    monkeypatch.setattr("benchmarks.lidar_accuracy.RELATIVE", 0.0)
    monkeypatch.setattr("benchmarks.lidar_accuracy.ABSOLUTE", 1e-12)
    strict = compare(BOX, 500, seed=0, rays_per_scene=250)
    assert strict.rays == 500 and strict.unexplained > 0.9 * strict.hits and len(strict.examples) == 5


def test_only_a_ray_next_to_a_silhouette_is_explained():
    rng = np.random.default_rng(0)
    model = random_model(BOX, rng)
    data = random_state(BOX, model, rng)
    origin = np.array([0.0, 0.0, 5.0])
    corners = model.geom_size[0] * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = corners @ data.geom_xmat[0].reshape(3, 3).T + data.geom_xpos[0]
    to_corner = corners[corners[:, 0].argmax()] - origin  # the rightmost one is on the outline, near enough
    outline = to_corner / np.linalg.norm(to_corner)
    to_middle = (data.geom_xpos[0] - origin) / np.linalg.norm(data.geom_xpos[0] - origin)
    assert is_explained(model, data, origin, outline, 1e-5)
    assert not is_explained(model, data, origin, to_middle, 1e-5)
