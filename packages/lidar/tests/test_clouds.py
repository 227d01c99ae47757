"""Point clouds in files: round trips, files written by hand or by other programs' rules, and one-line errors."""

import struct
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from omnilidar import (
    Lidar,
    LidarConfig,
    LidarFrame,
    RayScene,
    Shape,
    ShapeKind,
    read_points,
    read_scans,
    vlp16,
    write_points,
    write_scans,
)
from omnilidar.clouds import table_of
from omnilidar.clouds.pointcloud2 import message_from_table

NEEDS = {".pcd": "pypcd4", ".ply": None, ".las": "laspy", ".npz": None, ".mcap": "mcap_ros2"}
OUTPUTS = ("ranges", "valid", "points_w", "points_s", "normals_w", "intensity", "class_id", "time_s", "row")


@pytest.fixture(params=NEEDS)
def suffix(request):
    if NEEDS[request.param]:
        pytest.importorskip(NEEDS[request.param])
    return request.param


@pytest.fixture(scope="module")
def frame():
    """Two environments; a box ahead, so that some rays hit and most do not."""
    box = Shape(ShapeKind.BOX, (0.3, 0.3, 0.5), pos=(2.0, 0.0, 0.0), class_id=7)
    scene = RayScene([box], num_envs=2, num_bodies=0)
    lidar = Lidar(LidarConfig(num_rays=400), vlp16(), scene, mount_body=-1, outputs=OUTPUTS)
    return lidar.cast(0.1)


def a_table(count=6, frame="lidar_link", time_s=1234.5):
    rng = np.random.default_rng(1)
    columns = {axis: rng.normal(size=count).astype(np.float32) for axis in "xyz"}
    columns |= {"intensity": rng.random(count).astype(np.float32), "ring": np.arange(count, dtype=np.uint16)}
    columns["z"][2] = np.nan
    return table_of(columns, frame, time_s)


def test_a_frame_comes_back_as_it_was(frame, suffix, tmp_path):
    frame.save(tmp_path / f"scan{suffix}", env=1, time_s=0.1)
    back = LidarFrame.load(tmp_path / f"scan{suffix}")
    assert {name for name in vars(back) if getattr(back, name) is not None} == set(OUTPUTS)
    for name in OUTPUTS:
        was, now = getattr(frame, name)[1:], getattr(back, name)
        assert now.dtype == was.dtype and now.shape == was.shape
        exact = not (suffix == ".las" and name == "points_w")
        torch.testing.assert_close(now, was, rtol=0.0, atol=0.0 if exact else 0.6e-4, equal_nan=True)
    assert 0.0 < frame.valid.float().mean() < 0.5  # misses are among them


def test_a_table_keeps_its_frame_and_time(suffix, tmp_path):
    table = a_table()
    write_points(tmp_path / f"a{suffix}", table)
    back = read_points(tmp_path / f"a{suffix}")
    assert (back.frame, back.time_s) == ("lidar_link", 1234.5)
    assert set(back.names) == set(table.names) and len(back) == len(table)
    np.testing.assert_array_equal(back.points["ring"], np.arange(6))
    assert np.isnan(back.xyz).any(axis=1).tolist() == [False, False, True, False, False, False]


@pytest.mark.parametrize("frame", ["", "lidar link  2", "-front-", "rückwärts 3.5"])
def test_any_name_of_a_frame_comes_back(suffix, frame, tmp_path):
    if suffix == ".las" and not frame.isascii():
        pytest.skip("LAS knows ASCII only")
    write_points(tmp_path / f"a{suffix}", a_table(frame=frame))
    back = read_points(tmp_path / f"a{suffix}")
    assert (back.frame, back.time_s) == (frame, 1234.5)


@pytest.mark.parametrize("times", [np.array([7.0, 8.0, 9.0]), np.full(3, 7.0)])
def test_a_column_named_as_the_formats_time_and_a_time_of_numpys(suffix, times, tmp_path):
    columns = {axis: np.arange(3, dtype=np.float32) for axis in "xyz"} | {"gps_time": times}
    write_points(tmp_path / f"a{suffix}", table_of(columns, "lidar", np.float64(2.5)))
    back = read_points(tmp_path / f"a{suffix}")
    assert (back.frame, back.time_s) == ("lidar", 2.5)
    np.testing.assert_array_equal(back.points["gps_time"], times)


@pytest.mark.parametrize("away", [0.0, 4.5e6])
def test_points_in_the_coordinates_of_a_survey_come_back(suffix, away, tmp_path):
    """Northings of UTM reach 10,000 km."""
    columns = {axis: np.array([away - 1.25, np.nan, away + 700.5]) for axis in "xyz"}
    write_points(tmp_path / f"a{suffix}", table_of(columns))
    np.testing.assert_allclose(read_points(tmp_path / f"a{suffix}").points["x"], columns["x"], rtol=0.0, atol=1e-4)


def test_a_cloud_too_wide_for_las_and_a_time_before_zero_are_refused(tmp_path):
    pytest.importorskip("laspy")
    pytest.importorskip("mcap_ros2")
    wide = table_of({axis: np.array([0.0, 5e5]) for axis in "xyz"})
    with pytest.raises(ValueError, match="within 429 km"):
        write_points(tmp_path / "a.las", wide)
    for name in ("a" * 33, "rückwärts"):
        with pytest.raises(ValueError, match="at most 32 ASCII characters"):
            write_points(tmp_path / "a.las", a_table(frame=name))
    with pytest.raises(ValueError, match="time_s=-0.5"):
        write_points(tmp_path / "a.mcap", a_table(time_s=-0.5))
    with pytest.raises(ValueError, match="one line"):
        a_table(frame="two\nlines")


def test_a_binary_ply_is_what_its_description_says(tmp_path):
    columns = {"x": [1.0], "y": [-2.0], "z": [0.5], "ring": np.array([3], np.uint8)}
    table = table_of({name: np.asarray(a, None if name == "ring" else np.float32) for name, a in columns.items()})
    write_points(tmp_path / "a.ply", table)
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    assert body == struct.pack("<fffB", 1.0, -2.0, 0.5, 3)
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert lines[3:] == ["element vertex 1", *(f"property float {a}" for a in "xyz"), "property uchar ring"]


def test_a_pointcloud2_has_the_layout_of_its_description():
    columns = {"x": np.float32([1.0]), "y": np.float32([2.0]), "z": np.float32([3.0]), "ring": np.uint16([9])}
    message = message_from_table(table_of(columns, "lidar", 7.25))
    assert message["data"] == struct.pack("<fffH", 1.0, 2.0, 3.0, 9)
    assert [(f["name"], f["offset"], f["datatype"]) for f in message["fields"]] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
        ("ring", 12, 4),
    ]
    assert message["header"] == {"stamp": {"sec": 7, "nanosec": 250_000_000}, "frame_id": "lidar"}
    assert (message["point_step"], message["row_step"], message["width"], message["is_dense"]) == (14, 14, 1, True)


def test_a_stamp_just_below_a_second_is_that_second():
    message = message_from_table(table_of(dict.fromkeys("xyz", np.float32([1.0])), "lidar", 1.9999999999))
    assert message["header"]["stamp"] == {"sec": 2, "nanosec": 0}


def test_a_recording_holds_many_frames(tmp_path):
    pytest.importorskip("mcap_ros2")
    tables = [table_of({a: np.full(k, k, np.float32) for a in "xyz"}, "lidar", 0.1 * k) for k in range(4)]
    write_scans(tmp_path / "run.mcap", tables)
    found = list(read_scans(tmp_path / "run.mcap"))
    assert [table.time_s for table in found] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert [table.xyz[:, 0].tolist() for table in found] == [[], [1.0], [2.0, 2.0], [3.0, 3.0, 3.0]]
    assert read_points(tmp_path / "run.mcap", index=2).xyz[0, 0] == 2.0
    with pytest.raises(ValueError, match="holds no frame number 4"):
        read_points(tmp_path / "run.mcap", index=4)
    with pytest.raises(ValueError, match=r"has topics /points .* /other is none of them"):
        read_points(tmp_path / "run.mcap", topic="/other")
    with pytest.raises(ValueError, match="MCAP keeps times from 0"):
        write_scans(tmp_path / "run.mcap", [tables[0], replace(tables[0], time_s=-1.0)])
    assert len(list(read_scans(tmp_path / "run.mcap"))) == 4  # what was there stays
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


PLY = "ply\nformat ascii 1.0\nelement vertex 2\n"
XYZ = "".join(f"property int {axis}\n" for axis in "xyz")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.xyz", "1 2 3", "point clouds are read as .pcd, .ply"),
        ("a.ply", f"{PLY}{XYZ}end_header\n", "ends before its first point, 2 were expected"),
        ("a.ply", f"{PLY}property int\nend_header\n1\n2\n", "its header has 'property int'; known types: char"),
        ("a.npz", "", "a.npz is broken, or no .npz file"),
        ("a.ply", f"{PLY}property int x\nend_header\n1\n2\n", "need columns x, y and z"),
    ],
)
def test_what_cannot_be_read_is_one_line(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=message) as error:
        read_points(tmp_path / name)
    assert "\n" not in str(error.value)


def test_files_that_are_not_there_or_hold_one_frame(tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist"):
        read_points(tmp_path / "none.ply")
    with pytest.raises(ValueError, match=r"holds one frame and 2 were given; write them to \.mcap"):
        write_scans(tmp_path / "a.ply", [a_table(), a_table()])
    with pytest.raises(ValueError, match=r"written as \.pcd, \.ply, \.las, \.npz, \.mcap"):
        write_points(tmp_path / "a.bag", a_table())


@pytest.mark.parametrize("suffix", [suffix for suffix, library in NEEDS.items() if library])
def test_a_missing_library_names_its_extra(monkeypatch, suffix, tmp_path):
    for name in [name for name in sys.modules if name.partition(".")[0] == NEEDS[suffix]]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, NEEDS[suffix], None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'omnilidar\[clouds\]'"):
        write_points(tmp_path / f"a{suffix}", a_table())


def test_recordings_are_written_without_the_package_that_reads_them(monkeypatch, tmp_path):
    pytest.importorskip("mcap_ros2", reason="extra clouds")
    for name in [name for name in sys.modules if name.partition(".")[0] == "omnirobot"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "omnirobot", None)
    write_points(tmp_path / "a.mcap", a_table())
    with pytest.raises(ModuleNotFoundError, match=r"needs omnirobot: pip install 'packages/robot\[recordings\]'"):
        read_points(tmp_path / "a.mcap")


def test_frames_that_cannot_be_saved_or_loaded(frame, tmp_path):
    with pytest.raises(ValueError, match=r"env=2 must be in 0\.\.1"):
        frame.save(tmp_path / "a.ply", env=2)
    with pytest.raises(ValueError, match="must be one of the frame's points: points_w, points_s"):
        frame.save(tmp_path / "a.ply", points="points_b")
    with pytest.raises(ValueError, match="none, so cast with outputs="):
        LidarFrame(ranges=frame.ranges).save(tmp_path / "a.ply")
    write_points(tmp_path / "foreign.ply", a_table())
    with pytest.raises(ValueError, match="does not say what x, y, z are"):
        LidarFrame.load(tmp_path / "foreign.ply")
    with pytest.raises(ValueError, match=r"columns that no LidarFrame has \(ring\)"):
        LidarFrame.load(tmp_path / "foreign.ply", points="points_s")
