"""What the scan command writes: pictures and a point cloud that is read back; and the scene that it shows."""

import numpy as np
import pytest

from omnilidar import TriangleMesh, read_points
from omniperception.commands import main, scan
from omniperception.commands.scan import pictures
from omniperception.commands.scan.room import ROOM, DemoClass, demo_scene, mesh_scene


@pytest.fixture
def command(monkeypatch):
    monkeypatch.setattr(pictures, "PIXELS", (120, 66))
    monkeypatch.setattr(pictures, "DURATIONS_S", (0.02, 0.04, 0.06))
    return lambda *arguments: main(["scan", *arguments])


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["mid360", "height_scanner"])
def test_pictures_and_a_cloud_are_written(command, capsys, tmp_path, preset):
    pytest.importorskip("matplotlib")
    command(f"lidar={preset}", f"out={tmp_path}", "rays=150", "seed=3")
    assert f"{preset}: " in capsys.readouterr().out
    for name in ("pattern.png", "scan.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    table = read_points(tmp_path / "scan.ply").points
    (left, right), (back, front), top = ROOM
    assert 100 < len(table) <= 150 and set(table["class_id"]) <= set(DemoClass)
    for axis, low, high in (("x", left, right), ("y", back, front), ("z", 0.0, top)):
        assert (table[axis] > low - 1e-3).all() and (table[axis] < high + 1e-3).all()
    floor = table[table["class_id"] == DemoClass.FLOOR]
    assert len(floor) and np.abs(floor["z"]).max() < 1e-4
    assert len({tuple(row) for row in table[["red", "green", "blue"]].tolist()}) == len(set(table["class_id"]))


def test_a_scan_has_every_class_and_the_robot_sees_itself(make_config):
    run = make_config("perception=none", "observations=walk", "rewards=walk", "lidar=mid360")
    demo = demo_scene(run.env.robot)
    scan = pictures.take_scan("mid360", run.env.lidar, demo, seconds=0.5)
    assert set(scan.class_id) == set(DemoClass) - {DemoClass.MESH}
    housing = [demo.robot_geoms[name] for name in run.env.lidar.exclude_geoms]
    assert not np.isin(scan.shape_id, housing).any()
    assert np.linalg.norm(scan.points_w - scan.sensor_w, axis=1) == pytest.approx(scan.ranges, abs=1e-4)


def box_mesh(low, high):
    """A closed box, triangles counter-clockwise seen from outside."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return TriangleMesh(np.asarray(low) + corners * (np.asarray(high) - low), np.array(triangles))


def test_a_closed_mesh_knows_its_inside():
    mesh = box_mesh([0.0, 0.0, 0.0], [2.0, 1.0, 1.0])
    assert mesh.is_closed
    expected = {(1.0, 0.5, 0.5): True, (1.9, 0.99, 0.01): True, (2.1, 0.5, 0.5): False, (-9.0, 0.0, 0.0): False}
    assert {point: mesh.encloses(np.array(point)) for point in expected} == expected
    as_in_an_stl = TriangleMesh(mesh.vertices[mesh.triangles].reshape(-1, 3), np.arange(36).reshape(-1, 3))
    assert as_in_an_stl.is_closed and as_in_an_stl.encloses(np.array([1.0, 0.5, 0.5]))
    open_box = TriangleMesh(mesh.vertices, mesh.triangles[1:])
    assert not open_box.is_closed and not open_box.encloses(np.array([1.0, 0.5, 0.5]))


def test_a_scan_of_a_mesh_of_ones_own(make_config):
    """A hall of 8 x 6 x 3 m around a robot that stands 1 m from two of its walls."""
    run = make_config("perception=none", "observations=walk", "rewards=walk", "lidar=vlp16")
    demo = mesh_scene(run.env.robot, box_mesh([-4.0, -3.0, 0.0], [4.0, 3.0, 3.0]), at=(3.0, 2.0, 0.0))
    scan = pictures.take_scan("vlp16", run.env.lidar, demo)
    assert set(scan.class_id) <= {DemoClass.MESH, DemoClass.ROBOT}
    assert 0.98 * scan.num_rays < len(scan.ranges) < scan.num_rays  # the robot is nearer than the device measures
    walls = scan.points_w[scan.class_id == DemoClass.MESH]
    on_a_wall = np.abs(np.abs(walls) - [4.0, 3.0, np.inf]).min(axis=1) < 1e-4
    assert (on_a_wall | (np.abs(walls[:, 2] - 1.5) > 1.4999)).all()
    assert scan.sensor_w[:2] == pytest.approx([3.0, 2.0], abs=0.4) and demo.mesh.encloses(scan.sensor_w)


@pytest.mark.slow
def test_the_command_scans_a_mesh_file(command, capsys, tmp_path):
    pytest.importorskip("matplotlib")
    trimesh = pytest.importorskip("trimesh")
    hall = box_mesh([-4000.0, -3000.0, 0.0], [4000.0, 3000.0, 3000.0])
    trimesh.Trimesh(hall.vertices, hall.triangles).export(tmp_path / "hall.stl")
    given = (f"mesh={tmp_path / 'hall.stl'}", "scale=0.001", "at=1,0,0", "cloud=npz", "rays=300")
    command("lidar=vlp16", f"out={tmp_path}", *given)
    said = capsys.readouterr().out
    assert "hall.stl, a closed surface, and sees it from within" in said and "mesh 2" in said
    table = read_points(tmp_path / "scan.npz")
    assert 200 < len(table) <= 300 and np.abs(table.xyz).max() < 4.0 + 1e-4
    assert (tmp_path / "scan.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("mesh=none.stl",), "mesh none.stl does not exist"),
        (("mesh=broken.stl", "at=1,2"), "at=1.0,2.0 must be three numbers"),
    ],
)
def test_a_mesh_that_is_none_is_one_line(command, capsys, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.stl").write_text("nothing")
    with pytest.raises(SystemExit) as stop:
        command("lidar=vlp16", *arguments)
    error = capsys.readouterr().err
    assert stop.value.code == 2 and message in error and error.count("\n") == 1


@pytest.mark.parametrize(("given", "rays"), [(["lidar.num_rays=500"], 500), (["rays=800"], 800), ([], 20_000)])
def test_as_many_rays_are_cast_as_were_asked_for(monkeypatch, tmp_path, given, rays):
    cast = []
    monkeypatch.setattr(scan, "take_scan", lambda *a: cast.append(pictures.take_scan(*a)) or cast[-1])
    main(["scan", "lidar=mid360", f"out={tmp_path}", *given])
    assert cast[0].num_rays == rays


@pytest.mark.parametrize(
    ("overrides", "rays", "reach"),
    [
        ([], 20_000, 40.0),  # 0.1 s of 200,000 points a second, 40 m at 10 % reflectivity: the maker's figures
        (["lidar.num_rays=500", "lidar.max_range=7"], 500, 7.0),
        (["rays=800"], 800, 40.0),
    ],
)
def test_the_lab_shows_the_device_and_not_what_a_task_keeps_of_it(monkeypatch, overrides, rays, reach):
    served = {}
    monkeypatch.setattr(scan, "serve_lab", lambda room, sensors, out, options: served.update(sensors))
    main(["scan", "lidar=mid360", "viewer=web", *overrides])
    sensor = served["mid360"]()
    assert (sensor.num_rays, sensor.max_range) == (rays, reach)
