"""What the scan command writes: pictures and a point cloud that is read back; and the scene that it shows."""

import numpy as np
import pytest

from omniperception.commands import main
from omniperception.commands.scan import pictures
from omniperception.commands.scan.ply import write_ply
from omniperception.commands.scan.room import ROOM, DemoClass, demo_scene

NUMPY_TYPES = {"float": "<f4", "uchar": "|u1", "int": "<i4"}


def read_ply(path):
    """The table of a binary .ply file, by the format's published description."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(lines[2].removeprefix("element vertex "))
    properties = [line.split()[1:] for line in lines[3:]]
    return np.frombuffer(body, [(name, NUMPY_TYPES[kind]) for kind, name in properties], count)


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
    table = read_ply(tmp_path / "scan.ply")
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
    assert set(scan.class_id) == set(DemoClass)
    housing = [demo.robot_geoms[name] for name in run.env.lidar.exclude_geoms]
    assert not np.isin(scan.shape_id, housing).any()
    assert np.linalg.norm(scan.points_w - scan.sensor_w, axis=1) == pytest.approx(scan.ranges, abs=1e-4)


def test_what_is_written_is_read_back(tmp_path):
    rng = np.random.default_rng(0)
    points, rgb = rng.normal(size=(7, 3)).astype(np.float32), rng.integers(0, 256, (7, 3), dtype=np.uint8)
    write_ply(tmp_path / "a.ply", points, rgb, class_id=np.arange(7), weight=rng.random(7))
    table = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(np.stack([table[k] for k in "xyz"], 1), points)
    np.testing.assert_array_equal(np.stack([table[k] for k in ("red", "green", "blue")], 1), rgb)
    np.testing.assert_array_equal(table["class_id"], np.arange(7))
