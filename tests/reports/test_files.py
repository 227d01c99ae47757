"""Files from other tools, as they are found: padded, packed, split, cut off, left by a killed recorder.

Files are laid out by hand, byte by byte, or written by mcap's, rosbags', pypcd4's and laspy's own writers.
"""

import bz2
import re
import sqlite3
import struct
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import real_scans
from omnilidar import read_points, read_scans, write_points
from omnilidar.clouds import table_of
from omnilidar.clouds.pointcloud2 import table_from_message
from omniperception.commands import main
from omnirobot.commands import replay as replay_bag
from omnirobot.replay.bags import Topics, events
from omnirobot.replay.recordings import Recording
from omnirobot.runtime import DeployError
from omnirobot.runtime.go2 import MOTORS

for library in ("mcap_ros2", "rosbags", "pypcd4", "laspy"):
    pytest.importorskip(library, reason="extra clouds")

CLOUD, CUSTOM, IMU, JOINTS = (
    "sensor_msgs/msg/PointCloud2",
    "livox_ros_driver2/msg/CustomMsg",
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/JointState",
)
POINTS = 40
"""Of each cloud; that of number k is at x = k + 0.01 i, y = 0.5, z = -0.25."""
CUSTOM_MSG = """\
std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
livox_ros_driver/CustomPoint[] points
================================================================================
MSG: livox_ros_driver/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""


def xyz(k, count=POINTS):
    return np.stack([k + 0.01 * np.arange(count), np.full(count, 0.5), np.full(count, -0.25)], 1).astype(np.float32)


def text(value, end=b"\0"):
    data = value.encode() + end
    return struct.pack("<I", len(data)) + data + (bytes(-len(data) % 4) if end else b"")


def cloud(k, ros1=False, span_ns=1000):
    """A PointCloud2 at k seconds, with a time t for each point."""
    rows = np.zeros(POINTS, [("xyz", "<f4", 3), ("t", "<u4")])
    rows["xyz"], rows["t"] = xyz(k), np.linspace(0, span_ns, POINTS)
    end = b"" if ros1 else b"\0"
    body = struct.pack("<III", 0, k, 0) if ros1 else struct.pack("<iI", k, 0)
    body += text("lidar", end) + struct.pack("<III", 1, POINTS, 4)
    for number, name in enumerate("xyzt"):
        body += text(name, end) + struct.pack("<IBI" if ros1 else "<IB3xI", 4 * number, 6 if name == "t" else 7, 1)
    body += struct.pack("<BII" if ros1 else "<B3xII", 0, 16, 16 * POINTS)
    return (b"" if ros1 else b"\0\1\0\0") + body + struct.pack("<I", 16 * POINTS) + rows.tobytes() + b"\1"


def custom(k, ros1=False, span_ns=1000):
    """A CustomMsg at k seconds; its base is a second later."""
    point = struct.Struct("<IfffBBB" if ros1 else "<IfffBBBx")
    times = np.linspace(0, span_ns, POINTS).astype(int)
    points = b"".join(point.pack(t, *p, i, 0, i % 4) for i, (t, p) in enumerate(zip(times, xyz(k), strict=True)))
    body = struct.pack("<III", 0, k, 0) if ros1 else struct.pack("<iI", k, 0)
    body += text("livox", b"" if ros1 else b"\0")
    body += b"" if ros1 else bytes(-len(body) % 8)
    body += struct.pack("<QI4B", (k + 1) * 10**9, POINTS, 7, 0, 0, 0) + struct.pack("<I", POINTS) + points
    return body if ros1 else b"\0\1\0\0" + body[: len(body) - 1]


def definition(kind):
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE).generate_msgdef(kind, ros_version=2)[0]


def an_mcap(path, frames=10, end=True, topics=("/points",), **options):
    """As a recorder writes it, which is killed before it has written an end; returns where each message ends."""
    from mcap.writer import Writer

    ends = []
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start("ros2")
        schema = writer.register_schema(CLOUD, "ros2msg", definition(CLOUD).encode())
        channels = [writer.register_channel(topic, "cdr", schema) for topic in topics]
        for k in range(frames):
            for channel in channels:
                writer.add_message(channel, k, cloud(k), k)
            ends.append(file.tell())
        if end:
            writer.finish()
    return ends


def a_db3(path, messages, journal="DELETE"):
    """A file of a bag of ROS 2 of (topic, type, time, data); returns the open base."""
    base = sqlite3.connect(path)
    base.execute(f"PRAGMA journal_mode={journal}")
    base.execute("PRAGMA synchronous=OFF")
    base.executescript(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
        " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,"
        " data BLOB NOT NULL); CREATE INDEX timestamp_idx ON messages (timestamp ASC);"
    )
    numbers = {}
    for topic, kind, time_ns, data in messages:
        if topic not in numbers:
            numbers[topic] = len(numbers) + 1
            base.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (numbers[topic], topic, kind))
        base.execute(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", (numbers[topic], time_ns, data)
        )
        base.commit()
    return base


def clouds_of(numbers, topic="/points"):
    return [(topic, CLOUD, k, cloud(k)) for k in numbers]


def record(data=b"", **fields):
    """Of a bag of ROS 1."""
    parts = [name.encode() + b"=" + value for name, value in fields.items()]
    head = b"".join(struct.pack("<I", len(part)) + part for part in parts)
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


def u32(*values):
    return struct.pack(f"<{len(values)}I", *values)


def a_bag_of_ros_1(messages, index_at=0, packed="none", length=None, kinds=None):
    """One chunk, without an index, of (topic, time, data); length: that its head says."""
    topics = list(dict.fromkeys(topic for topic, _, _ in messages))
    chunk = b""
    for number, topic in enumerate(topics):
        kind, about = (kinds or {}).get(topic, ("sensor_msgs/PointCloud2", "known by itself"))
        fields = {"topic": topic, "type": kind, "md5sum": "0" * 32, "message_definition": about}
        about = record(**{key: value.encode() for key, value in fields.items()})[4:-4]
        chunk += record(about, op=b"\7", conn=u32(number), topic=topic.encode())
    for topic, time_s, data in messages:
        chunk += record(data, op=b"\2", conn=u32(topics.index(topic)), time=u32(time_s, 0))
    head = record(b" " * 4027, op=b"\3", index_pos=struct.pack("<Q", index_at), conn_count=u32(0), chunk_count=u32(0))
    content = {"none": chunk, "bz2": bz2.compress(chunk)}[packed]
    chunk = record(content, op=b"\5", compression=packed.encode(), size=u32(len(chunk)))
    if length is not None:
        at = len(chunk) - len(content)
        chunk = chunk[: at - 4] + u32(length) + chunk[at:]
    return b"#ROSBAG V2.0\n" + head + chunk


def numbers_of(path, **options):
    """Which clouds are read: of each, all points are compared."""
    found = []
    for table in read_scans(path, **options):
        found.append(round(float(table.points["x"][0])))
        np.testing.assert_array_equal(table.xyz.astype(np.float32), xyz(found[-1]))
    return found


def one_line(capsys):
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1, said
    return said[0]


OUSTER = """\
# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z _ intensity t reflectivity ring _ ambient _ range _
SIZE 4 4 4 1 4 4 2 1 1 2 1 4 1
TYPE F F F U F U U U U U U U U
COUNT 1 1 1 4 1 1 1 1 0 1 0 1 15
WIDTH 2
HEIGHT 3
VIEWPOINT 0 0 0 1 0 0 0
POINTS 6
DATA {}
"""
OUSTER_NAMES = ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"]
OUSTER_ROWS = [(k + 0.5, -k, 2.0, 7.0 * k, 1000 * k, 3 * k, k, 60_000 + k, 100_000 + k) for k in range(6)]


KINDS = ("f4", "f4", "f4", "f4", "u4", "u2", "u1", "u2", "u4")


def ouster_rows():
    return b"".join(struct.pack("<fff4xfIHBHI15x", *row) for row in OUSTER_ROWS)


def literals(data):
    """Packed as LibLZF packs what never repeats: each run of up to 32 bytes behind its length less one."""
    runs = [data[at : at + 32] for at in range(0, len(data), 32)]
    packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
    return u32(len(packed), len(data)) + packed


def ouster_blocks(padding):
    columns = list(zip(*OUSTER_ROWS, strict=True))
    blocks = [np.array(c, kind).tobytes() for c, kind in zip(columns, KINDS, strict=True)]
    return literals(b"".join([*blocks[:3], b"\xff" * 24 * padding, *blocks[3:], b"\xff" * 90 * padding]))


@pytest.mark.parametrize(
    ("how", "body"),
    [
        ("binary", ouster_rows()),
        (
            "ascii",
            "".join(
                f"{x} {y} {z} 9 9 9 9 {' '.join(map(str, rest))}{' 9' * 15}\n" for x, y, z, *rest in OUSTER_ROWS
            ).encode(),
        ),
        ("binary_compressed", ouster_blocks(padding=False)),  # as PCL's own writer leaves it out
        ("binary_compressed", ouster_blocks(padding=True)),
    ],
)
def test_padding_of_a_pcd_is_no_column(tmp_path, how, body):
    (tmp_path / "a.pcd").write_bytes(OUSTER.format(how).encode() + body)
    table = read_points(tmp_path / "a.pcd")
    assert list(table.names) == OUSTER_NAMES
    assert [tuple(row) for row in table.points.tolist()] == OUSTER_ROWS
    for suffix in (".ply", ".las", ".mcap", ".npz", ".pcd"):
        write_points(tmp_path / f"b{suffix}", table)
        again = read_points(tmp_path / f"b{suffix}")
        assert set(again.names) == set(OUSTER_NAMES) and again.points["range"].tolist() == [
            100_000 + k for k in range(6)
        ]


FIELDS = "FIELDS x y z ring\nSIZE 4 8 4 2\nTYPE F F F U\n"
HEADERS = {
    "without COUNT, VIEWPOINT, VERSION, HEIGHT": f"{FIELDS}WIDTH 3\nPOINTS 3\nDATA {{}}\n",
    "version .5": f"# comment\nVERSION .5\n{FIELDS.replace('FIELDS', 'COLUMNS')}POINTS 3\nDATA {{}}\n",
    "lines of Windows": f"VERSION .7\n{FIELDS}WIDTH 3\nHEIGHT 1\nDATA {{}}\n".replace("\n", "\r\n"),
    "blanks and comments": "\n# a\nFIELDS  x y\tz ring \nSIZE 4 8 4 2\n#\nTYPE F F F U\nWIDTH 1\nHEIGHT 3\nDATA {}\n",
    "POINTS against WIDTH": f"{FIELDS}COUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 3\nDATA {{}}\n",
}


@pytest.mark.parametrize("header", HEADERS.values(), ids=HEADERS)
@pytest.mark.parametrize("how", ["ascii", "binary", "binary_compressed"])
def test_a_pcd_may_leave_lines_out(tmp_path, header, how, capsys):
    rows = [(1.5, 4_500_000.125, -3.0, 7), (float("nan"), 2.0, 1e-3, 65_535), (0.0, 0.0, 0.0, 0)]
    body = {
        "ascii": b"1.5 4500000.125 -3 7 \r\n\nnan\t2.0 1e-3 65535.0\n# none\n0 0 0 0",
        "binary": b"".join(struct.pack("<fdfH", *row) for row in rows),
        "binary_compressed": literals(
            b"".join(
                struct.pack(f"<3{kind}", *column) for kind, column in zip("fdfH", zip(*rows, strict=True), strict=True)
            )
        ),
    }
    (tmp_path / "a.PCD").write_bytes(header.format(how).encode() + body[how])
    points = read_points(tmp_path / "a.PCD").points
    assert points["y"].tolist() == [4_500_000.125, 2.0, 0.0] and points["ring"].tolist() == [7, 65_535, 0]
    np.testing.assert_array_equal(points["x"], np.float32([1.5, np.nan, 0.0]))
    assert points["y"].dtype == np.float64 and not capsys.readouterr().err


def test_a_pcd_of_another_program_packed_and_of_several_numbers(tmp_path):
    from pypcd4 import Encoding, PointCloud

    rng = np.random.default_rng(0)
    data = np.round(rng.normal(size=(3000, 3)), 1).astype(np.float32)  # repeats itself, so that it is packed
    columns = [*data.T, np.arange(3000, dtype=np.uint8) // 200]
    cloud = PointCloud.from_points(columns, ("x", "y", "z", "ring"), (np.float32,) * 3 + (np.uint8,))
    cloud.save(tmp_path / "a.pcd", encoding=Encoding.BINARY_COMPRESSED)
    assert (tmp_path / "a.pcd").stat().st_size < 25_000  # of 39,000
    table = read_points(tmp_path / "a.pcd")
    np.testing.assert_array_equal(table.xyz, data)
    np.testing.assert_array_equal(table.points["ring"], columns[3])

    head = "FIELDS x y z fpfh rgb\nSIZE 4 4 4 4 4\nTYPE F F F F F\nCOUNT 1 1 1 2 1\nWIDTH 2\nHEIGHT 1\nDATA binary\n"
    (tmp_path / "b.pcd").write_bytes(head.encode() + struct.pack("<ffffffffffff", *range(12)))
    table = read_points(tmp_path / "b.pcd")
    assert table.names == ("x", "y", "z", "fpfh__0000", "fpfh__0001", "rgb")
    assert table.points["fpfh__0001"].tolist() == [4.0, 10.0] and table.points["rgb"].tolist() == [5.0, 11.0]


@pytest.mark.parametrize("how", ["ascii", "binary", "binary_compressed"])
def test_a_pcd_that_is_cut_off_is_read_up_to_there(tmp_path, capsys, how):
    from pypcd4 import Encoding, PointCloud

    columns = [*xyz(3, 1000).T.copy(), np.random.default_rng(0).random(1000).astype(np.float32)]
    cloud = PointCloud.from_points(columns, ("x", "y", "z", "intensity"), (np.float32,) * 4)
    cloud.save(tmp_path / "whole.pcd", encoding=Encoding(how))
    whole = (tmp_path / "whole.pcd").read_bytes()
    (tmp_path / "a.pcd").write_bytes(whole[: int(0.6 * len(whole))])
    table = read_points(tmp_path / "a.pcd")
    assert 550 < len(table) < 650 or how == "binary_compressed"  # there, field after field: x, y, z are all there
    np.testing.assert_allclose(table.xyz, xyz(3, 1000)[: len(table)], atol=1e-6)
    said = one_line(capsys)
    assert f"a.pcd is cut off: read {len(table)} of 1000 points" in said
    assert ("without intensity" in said) == ("intensity" not in table.names) == (how == "binary_compressed")


@pytest.mark.parametrize(
    ("head", "message"),
    [
        (
            "FIELDS x y z\nSIZE 4 4\nTYPE F F F\nPOINTS 1\nDATA ascii\n1 2 3\n",
            "SIZE has 2 values, and there are 3 FIELDS",
        ),
        ("FIELDS x y z\nSIZE 4 4 4\nTYPE F F Q\nPOINTS 1\nDATA ascii\n1 2 3\n", "field z has TYPE Q, SIZE 4, COUNT 1"),
        ("FIELDS x y z\nSIZE 4 4 3\nTYPE F F U\nPOINTS 1\nDATA ascii\n1 2 3\n", "field z has TYPE U, SIZE 3, COUNT 1"),
        ("FIELDS x y z\nCOUNT 1 1 -1\nPOINTS 1\nDATA ascii\n1 2 3\n", "field z has TYPE F, SIZE 4, COUNT -1"),
        ("FIELDS x y x\nPOINTS 1\nDATA ascii\n1 2 3\n", "FIELDS x y x names nothing, or one thing twice"),
        ("FIELDS x y z\nPOINTS many\nDATA ascii\n1 2 3\n", "POINTS is many, a whole number was expected"),
        ("FIELDS x y z\nPOINTS 1\nDATA packed\n1 2 3\n", "DATA is 'packed', ascii, binary or binary_compressed was"),
        ("FIELDS x y z\nPOINTS 2\nDATA ascii\n1 2 3\n4 5\n", "point 1 has 2 numbers, 3 were expected: 4 5"),
        ("FIELDS x y z\nPOINTS 2\nDATA ascii\n1 2 3\n4 5,5 6\n", "y of point 1 is 5,5, float32 was expected"),
        (
            "FIELDS x y z r\nTYPE F F F U\nSIZE 4 4 4 1\nPOINTS 1\nDATA ascii\n1 2 3 256\n",
            "r of point 0 is 256, uint8 was",
        ),
        ("FIELDS x y z\nPOINTS 2\nDATA binary\n", "ends before its first point, 2 were expected"),
        ("FIELDS x y\nPOINTS 1\nDATA ascii\n1 2\n", "points need columns x, y and z; there are x, y"),
        (
            "FIELDS x y z\nPOINTS 1\nDATA binary_compressed\n\1\0\0\0\1\0\0\0\0",
            "it says 1 bytes unpacked, and 1 points",
        ),
        (
            "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n",
            "is a pointer of Git LFS, .*git lfs pull",
        ),
    ],
)
def test_a_pcd_that_cannot_be_read_says_where_and_why(tmp_path, head, message):
    (tmp_path / "a.pcd").write_bytes(head.encode("latin-1"))
    with pytest.raises(ValueError, match=message) as error:
        read_points(tmp_path / "a.pcd")
    assert "a.pcd" in str(error.value) and "\n" not in str(error.value) and "validation" not in str(error.value)


CAMERA = "ply\r\nformat {}\r\ncomment of a viewer\r\nobj_info of another\r\nelement camera 2\r\nproperty double fov\r\n"
CAMERA += "property list uchar short pose\r\nelement vertex 3\r\nproperty uchar red\r\nproperty float64 z\r\n"
CAMERA += "property list uint8 float32 uv\r\nproperty int32 x\r\nproperty float y\r\nelement face 1\r\n"
CAMERA += "property list uchar int vertex_indices\r\nend_header\r\n"


@pytest.mark.parametrize("how", ["ascii 1.0", "binary_little_endian 1.0", "binary_big_endian 1.0"])
def test_a_ply_with_other_things_before_its_vertices_and_lists_in_them(tmp_path, capsys, how):
    vertices = [(255, 0.125, [1.5, 2.5], -7, 3.5), (0, -4e6, [], 8, 0.25), (1, 0.0, [9.0], 0, 0.0)]
    if how.startswith("ascii"):
        rows = [f"{r}.0 {z} {len(uv)} {' '.join(map(str, uv))} {x} {y} " for r, z, uv, x, y in vertices]
        body = "\r\n".join(["1.5 2 3 4", "2.5 0", *rows, "3 0 1 2"]).encode()
    else:
        end = "<" if "little" in how else ">"
        body = struct.pack(f"{end}dBhh", 1.5, 2, 3, 4) + struct.pack(f"{end}dB", 2.5, 0)
        for r, z, uv, x, y in vertices:
            body += struct.pack(f"{end}BdB{len(uv)}fif", r, z, len(uv), *uv, x, y)
        body += struct.pack(f"{end}Biii", 3, 0, 1, 2)
    (tmp_path / "a.ply").write_bytes(CAMERA.format(how).encode() + body)
    points = read_points(tmp_path / "a.ply").points
    assert points.dtype.names == ("red", "z", "x", "y")
    assert points.tolist() == [(r, z, x, y) for r, z, _, x, y in vertices]
    assert "a.ply: left out, as lists are no columns: uv" in one_line(capsys)


@pytest.mark.parametrize("how", ["ascii", "binary_little_endian"])
def test_a_ply_that_is_cut_off_is_read_up_to_there(tmp_path, capsys, how):
    head = (
        f"ply\nformat {how} 1.0\nelement vertex 100\n"
        + "".join(f"property float {a}\n" for a in "xyz")
        + "end_header\n"
    )
    rows = [
        f"{x:.2f} {y} {z}\n".encode() if how == "ascii" else struct.pack("<fff", x, y, z) for x, y, z in xyz(5, 100)
    ]
    (tmp_path / "a.ply").write_bytes(head.encode() + b"".join(rows[:60]) + rows[60][:-3])
    np.testing.assert_allclose(read_points(tmp_path / "a.ply").xyz, xyz(5, 60), atol=1e-6)
    assert "a.ply is cut off: read 60 of 100 points" in one_line(capsys)


def a_las(path, count=50):
    import laspy

    header = laspy.LasHeader(version="1.2", point_format=3)
    header.scales, header.offsets = np.full(3, 1e-3), np.array([5e5, 4.5e6, 100.0])
    header.add_extra_dim(laspy.ExtraBytesParams("normal", "3f4"))
    file = laspy.LasData(header)
    file.xyz = np.arange(3.0 * count).reshape(-1, 3) / 8.0 + [5e5, 4.5e6, 100.0]
    file.intensity, file.normal = np.arange(count), np.arange(3.0 * count).reshape(-1, 3)
    file.write(path)
    return file.xyz, path.read_bytes()


def test_las_as_other_programs_leave_it(tmp_path, capsys):
    points, whole = a_las(tmp_path / "whole.las")
    start, size = struct.unpack_from("<I", whole, 96)[0], struct.unpack_from("<H", whole, 105)[0]
    table = read_points(tmp_path / "whole.las")
    np.testing.assert_allclose(table.xyz, points, atol=5e-4)
    assert table.points["normal__0002"].tolist() == [3.0 * k + 2.0 for k in range(50)] and "intensity" in table.names
    (tmp_path / "foreign.las").write_bytes(
        whole[:26] + bytes(range(200, 232)) + whole[58:]
    )  # no ASCII names its program
    assert len(read_points(tmp_path / "foreign.las")) == 50
    assert not capsys.readouterr().err
    (tmp_path / "cut.las").write_bytes(whole[: start + 30 * size + 5])
    np.testing.assert_allclose(read_points(tmp_path / "cut.las").xyz, points[:30], atol=5e-4)
    assert "cut.las is cut off: read 30 of 50 points" in one_line(capsys)
    (tmp_path / "open.las").write_bytes(whole[:107] + bytes(24) + whole[131:])  # counts are written at the end
    np.testing.assert_allclose(read_points(tmp_path / "open.las").xyz, points, atol=5e-4)
    assert "says that it has no points, as a killed program leaves it: read 50" in one_line(capsys)
    a_las(tmp_path / "none.las", count=0)
    assert len(read_points(tmp_path / "none.las")) == 0 and not capsys.readouterr().err
    (tmp_path / "head.las").write_bytes(whole[:100])
    with pytest.raises(ValueError, match="head.las is not a LAS file, or ends within its header"):
        read_points(tmp_path / "head.las")


def test_laz_works_or_names_what_it_needs(tmp_path, monkeypatch):
    import laspy

    table = table_of(dict(zip("xyz", xyz(1).T, strict=True)))
    if laspy.LazBackend.detect_available():
        write_points(tmp_path / "a.laz", table)
        np.testing.assert_allclose(read_points(tmp_path / "a.laz").xyz, xyz(1), atol=1e-4)
        monkeypatch.setattr(laspy.LazBackend, "detect_available", classmethod(lambda cls: ()))
    whole = bytearray(a_las(tmp_path / "whole.las")[1])
    whole[104] |= 0x80  # this bit says that points are packed
    (tmp_path / "b.laz").write_bytes(whole)
    for act in (lambda: read_points(tmp_path / "b.laz"), lambda: write_points(tmp_path / "b.laz", table)):
        with pytest.raises(ValueError, match="b.laz is LAZ, which needs lazrs: pip install lazrs"):
            act()


def test_a_column_whose_name_a_header_has_no_room_for(tmp_path):
    """CloudCompare's scalar fields in LAS have names of several words."""
    table = table_of({**dict(zip("xyz", xyz(1).T, strict=True)), "Original cloud index": np.zeros(POINTS, np.float32)})
    write_points(tmp_path / "a.las", table)
    for suffix in (".ply", ".pcd"):
        with pytest.raises(ValueError, match="column 'Original cloud index' has no name of one word"):
            write_points(tmp_path / f"a{suffix}", read_points(tmp_path / "a.las"))


def message(**changes):
    fields = [
        SimpleNamespace(name=name, offset=at, datatype=7, count=1) for name, at in zip("xyz", (0, 4, 8), strict=True)
    ]
    header = SimpleNamespace(stamp=SimpleNamespace(sec=3, nanosec=5), frame_id="lidar")
    rows = b"".join(struct.pack("<fff4x", *p) for p in xyz(2, 6))
    standard = {
        "height": 1,
        "width": 6,
        "fields": fields,
        "is_bigendian": False,
        "point_step": 16,
        "row_step": 96,
        "data": rows,
    }
    return SimpleNamespace(**{"header": header, **standard, **changes})


def test_pointcloud2_in_the_layouts_of_drivers():
    points = xyz(2, 6)
    plain = message()
    rows = [plain.data[:48], plain.data[48:]]
    padded = message(height=2, width=3, row_step=64, data=rows[0] + b"\xff" * 16 + rows[1])  # the last row without
    big = message(is_bigendian=True, data=b"".join(struct.pack(">fff4x", *p) for p in points))
    for given in (plain, padded, big, message(height=2, width=3, row_step=0)):
        np.testing.assert_array_equal(table_from_message(given).xyz, points)
    several = [*plain.fields, SimpleNamespace(name="normal", offset=4, datatype=7, count=2)]
    several += [
        SimpleNamespace(name="_", offset=12, datatype=2, count=4),
        SimpleNamespace(name="", offset=0, datatype=2, count=0),
    ]
    table = table_from_message(message(fields=several))
    assert table.names == ("x", "y", "z", "normal__0000", "normal__0001")
    np.testing.assert_array_equal(table.points["normal__0001"], points[:, 2])
    for wrong, said in [
        ({"data": plain.data[:-20]}, "96 bytes of 1 x 6 points were expected, 76 given"),
        ({"point_step": 8}, "field z is there twice, or ends behind the 8 bytes of a point"),
        ({"fields": [*plain.fields, SimpleNamespace(name="t", offset=0, datatype=9, count=1)]}, "field t is of type 9"),
        ({"fields": [*plain.fields, plain.fields[0]]}, "field x is there twice"),
    ]:
        with pytest.raises(ValueError, match=said):
            table_from_message(message(**wrong))


@pytest.mark.parametrize("packed", ["NONE", "LZ4", "ZSTD"])
def test_an_mcap_of_a_killed_recorder(tmp_path, capsys, packed):
    from mcap.writer import CompressionType

    options = {"chunk_size": 1500, "compression": CompressionType[packed]}
    ends = an_mcap(tmp_path / "a.mcap", 20, end=False, **options)
    written = max(k for k in range(20) if k and ends[k] > ends[k - 1]) + 1  # the last chunk was not full yet
    assert numbers_of(tmp_path / "a.mcap") == list(range(written)) and 10 < written < 20
    said = one_line(capsys)
    assert f"a.mcap is cut off after {ends[-1]} bytes, as a killed recorder leaves it; read: {written} messages" in said
    an_mcap(tmp_path / "whole.mcap", 20, **options)
    assert numbers_of(tmp_path / "whole.mcap") == list(range(20)) and not capsys.readouterr().err
    # without an end, but every chunk is there
    whole = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(whole[:-20])
    assert numbers_of(tmp_path / "a.mcap") == list(range(20)) and "read: 20 messages" in one_line(capsys)


@pytest.mark.parametrize("chunks", [True, False])
@pytest.mark.parametrize("share", [0.25, 0.6, 0.9])
def test_all_frames_before_the_cut_of_an_mcap_are_read(tmp_path, capsys, chunks, share):
    """Ten clouds of 640 bytes in one chunk, or in none: those whose last byte is there."""
    from mcap.writer import CompressionType

    an_mcap(tmp_path / "whole.mcap", 10, compression=CompressionType.NONE, use_chunking=chunks)
    whole = (tmp_path / "whole.mcap").read_bytes()
    cut = int(share * len(whole))
    ends = [whole.index(cloud(k)) + len(cloud(k)) for k in range(10)]
    (tmp_path / "cut.mcap").write_bytes(whole[:cut])
    expected = [k for k, end in enumerate(ends) if end <= cut]
    assert numbers_of(tmp_path / "cut.mcap") == expected and expected
    assert f"cut off after {cut} bytes, as a killed recorder leaves it; read: {len(expected)} messages" in one_line(
        capsys
    )
    assert read_points(tmp_path / "cut.mcap", index=len(expected) - 1).time_s == expected[-1]
    assert "read: " in one_line(capsys)  # also where only one is asked for
    with pytest.raises(ValueError, match=f"holds no frame number {len(expected)} of points"):
        read_points(tmp_path / "cut.mcap", index=len(expected))


def test_an_mcap_without_a_summary_and_one_with_damage(tmp_path, capsys):
    from mcap.writer import CompressionType, IndexType

    bare = {"repeat_channels": False, "repeat_schemas": False, "use_statistics": False, "use_summary_offsets": False}
    an_mcap(tmp_path / "bare.mcap", index_types=IndexType.NONE, **bare)
    assert numbers_of(tmp_path / "bare.mcap") == list(range(10))
    assert "has no summary, the index that a recorder writes when it ends; read: 10 messages of /points" in one_line(
        capsys
    )
    an_mcap(tmp_path / "a.mcap", chunk_size=600, compression=CompressionType.NONE)
    whole = (tmp_path / "a.mcap").read_bytes()
    at = whole.index(cloud(4)) + 300
    (tmp_path / "a.mcap").write_bytes(whole[:at] + b"\xff" + whole[at + 1 :])  # one byte of the fifth chunk
    assert numbers_of(tmp_path / "a.mcap") == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert "a.mcap has 1 damaged records, which are left out; read: 9 messages of /points" in one_line(capsys)
    end = whole.index(cloud(8)) - 40  # a full disk or a lost power supply leaves zeros
    (tmp_path / "a.mcap").write_bytes(whole[:end] + bytes(5000))
    assert numbers_of(tmp_path / "a.mcap")[:7] == list(range(7)) and "is cut off after" in one_line(capsys)


def test_recordings_that_are_none_say_so(tmp_path):
    (tmp_path / "full").mkdir()
    a_db3(tmp_path / "full" / "a.db3", clouds_of([1])).close()
    an_mcap(tmp_path / "full" / "a.mcap")
    sqlite3.connect(tmp_path / "other.db3").execute("CREATE TABLE a(b)")
    an_mcap(tmp_path / "two.mcap", topics=("/left", "/right"))
    (tmp_path / "start.mcap").write_bytes((tmp_path / "two.mcap").read_bytes()[:1000])
    a_db3(tmp_path / "none.db3", [("/velodyne", "velodyne_msgs/msg/VelodyneScan", 0, b"")]).close()
    for name, content, said in [
        ("a.mcap", b"", "a.mcap is empty"),
        ("a.mcap", b"something else", "a.mcap is not a readable MCAP file"),
        ("a.db3", b"something else", "a.db3 is not a readable bag of ROS 2"),
        ("a.bag", b"something else", "a.bag is not a readable bag of ROS 1"),
        ("a.bag", b"#ROSBAG V1.2\n", "a.bag is not a readable bag: it is older than version 2.0"),
        ("a.db3", b"version https://git-lfs.github.com/spec/v1\n", "a.db3 is a pointer of Git LFS"),
        ("a.foo.zstd", b"something else", "a.foo.zstd is no recording; .mcap, .db3"),
        ("other.db3", None, "other.db3 is not a readable bag of ROS 2: it has no tables topics and messages"),
        ("start.mcap", None, "start.mcap is cut off after 1000 bytes, as a killed .*; no message can be read"),
        ("full", None, "full has no readable metadata.yaml.* and both .db3 and .mcap files; name one of them"),
        ("two.mcap", None, "two.mcap has topics /left, /right with clouds; name one with topic="),
        (
            "none.db3",
            None,
            r"none.db3 has no topic of type .* its topics: /velodyne \(velodyne_msgs/msg/VelodyneScan\)",
        ),
    ]:
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=said) as error:
            read_points(tmp_path / name)
        assert "\n" not in str(error.value)
    assert numbers_of(tmp_path / "two.mcap", topic="/right") == list(range(10))


def test_a_bag_of_ros_2_without_metadata_and_a_file_alone(tmp_path, capsys):
    bag = tmp_path / "walk"
    bag.mkdir()
    for k in range(12):  # split: walk_10 comes behind walk_9
        a_db3(bag / f"walk_{k}.db3", clouds_of([2 * k, 2 * k + 1])).close()
    assert numbers_of(bag) == list(range(24))
    said = one_line(capsys)
    assert (
        "walk has no readable metadata.yaml, which a recorder writes when it ends; read: 24 messages of /points" in said
    )
    assert numbers_of(bag / "walk_3.db3") == [6, 7] and not capsys.readouterr().err
    names = "".join(f"    - walk_{k}.db3\n" for k in (*range(12), 12))
    head = "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n  relative_file_paths:\n"
    (bag / "metadata.yaml").write_text(head + names)
    (bag / "walk_5.db3").write_bytes(b"")
    assert numbers_of(bag) == [*range(10), *range(12, 24)]
    said = one_line(capsys)
    for part in (
        "walk lacks walk_12.db3, which its metadata.yaml names",
        "walk_5.db3 is empty",
        "read: 22 messages of",
    ):
        assert part in said
    for number, file in enumerate(sorted(bag.iterdir())):
        if file.suffix == ".db3":
            file.unlink()
            an_mcap(bag / f"{number}.mcap", 1)
    (bag / "metadata.yaml").write_text("")  # the recorder was killed while it wrote this
    assert numbers_of(bag) == [0] * 12 and "no readable metadata.yaml" in one_line(capsys)


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_a_packed_bag_of_ros_2(tmp_path, capsys, mode, plugin):
    """Written by rosbags, which compresses the file or each message."""
    from rosbags import rosbag2
    from rosbags.typesys import Stores, get_typestore

    if not hasattr(rosbag2, "StoragePlugin"):
        pytest.skip("this rosbags writes no MCAP")
    bag = rosbag2.Writer(tmp_path / "bag", version=8, storage_plugin=rosbag2.StoragePlugin[plugin])
    bag.set_compression(rosbag2.CompressionMode[mode], rosbag2.CompressionFormat.ZSTD)
    with bag:
        connection = bag.add_connection("/points", CLOUD, typestore=get_typestore(Stores.ROS2_HUMBLE))
        for k in range(5):
            bag.write(connection, k, cloud(k))
    assert numbers_of(tmp_path / "bag") == list(range(5)) and not capsys.readouterr().err
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert numbers_of(tmp_path / "bag") == list(range(5)) and "read: 5 messages of /points" in one_line(capsys)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_all_frames_before_the_cut_of_a_db3_are_read(tmp_path, capsys, share):
    """Pages lie in the file as they were written: of rows on many pages, all but the last before the cut are there."""
    a_db3(
        tmp_path / "whole.db3",
        [message for k in range(60) for message in (*clouds_of([k]), *[("/imu", IMU, k, bytes(300))] * 9)],
    )
    whole = (tmp_path / "whole.db3").read_bytes()
    (tmp_path / "cut.db3").write_bytes(whole[: int(share * len(whole))])
    read = numbers_of(tmp_path / "cut.db3")
    assert read == sorted(read) and 0.8 * share * 60 < len(read) < 60
    assert (
        f"cut.db3 is cut off or damaged, as a killed recorder leaves it; read: {len(read)} messages of /points"
        in one_line(capsys)
    )


def test_large_rows_and_numbers_of_all_lengths_in_a_db3_that_is_cut_off(tmp_path):
    """Rows of more than a page are in chains of pages; those of the last begin before the cut and end behind it."""
    times = [0, 1, 127, -5, 40_000, 2**23, 2**31, 2**40, 2**60, 3]
    lengths = [200_000 + k for k in range(len(times))]
    rows = [("/camera", "sensor_msgs/msg/Image", *row) for row in zip(times, map(bytes, lengths), strict=True)]
    a_db3(tmp_path / "a.db3", rows).close()
    content = (tmp_path / "a.db3").read_bytes()
    for cut, there in ((len(content), 10), (len(content) - 5 * 4096, 9), (len(content) // 2, 4)):
        (tmp_path / "a.db3").write_bytes(content[:cut])
        read = [(message.time_ns, len(message.data)) for message in Recording(tmp_path / "a.db3").messages()]
        assert read == list(zip(times, lengths, strict=True))[:there]


def test_what_is_still_in_the_log_of_a_db3_is_read(tmp_path):
    base = a_db3(tmp_path / "a.db3", clouds_of(range(5)), journal="WAL")
    assert (tmp_path / "a.db3-wal").stat().st_size > 0
    assert numbers_of(tmp_path / "a.db3") == list(range(5))
    base.close()


@pytest.mark.parametrize("packed", [None, "bz2", "lz4"])
def test_a_bag_of_ros_1_whole_cut_and_never_closed(tmp_path, capsys, packed):
    """Written by rosbags."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    bag = Writer(tmp_path / "whole.bag")
    bag.chunk_threshold = 1500
    if packed:
        bag.set_compression(Writer.CompressionFormat[packed.upper()])
    with bag:
        connection = bag.add_connection("/points", CLOUD, typestore=get_typestore(Stores.ROS1_NOETIC))
        for k in range(20):
            bag.write(connection, k * 10**9, cloud(k, ros1=True))
    assert numbers_of(tmp_path / "whole.bag") == list(range(20)) and not capsys.readouterr().err
    whole = (tmp_path / "whole.bag").read_bytes()
    cut = int(0.6 * len(whole))
    (tmp_path / "cut.bag").write_bytes(whole[:cut])
    read = numbers_of(tmp_path / "cut.bag")
    assert read == list(range(len(read))) and len(read) > 8
    assert f"cut.bag is cut off after {cut} bytes; read: {len(read)} messages of /points" in one_line(capsys)
    at = whole.index(b"index_pos=") + 10
    index_at = struct.unpack_from("<Q", whole, at)[0]
    (tmp_path / "open.bag.active").write_bytes(whole[:at] + bytes(8) + whole[at + 8 : index_at])
    assert numbers_of(tmp_path / "open.bag.active") == list(range(20))
    assert "has no index, as a killed recorder leaves it (rosbag reindex writes one); read: 20 messages" in one_line(
        capsys
    )


def test_a_chunk_of_a_bag_of_ros_1_that_was_never_closed(tmp_path, capsys):
    """Its head still says that it has no content; the last message is cut off."""
    given = [("/points", k, cloud(k, ros1=True)) for k in range(4)]
    for packed, length in (("none", None), ("none", 0), ("bz2", None)):
        whole = a_bag_of_ros_1(given, packed=packed, length=length)
        (tmp_path / "a.bag").write_bytes(whole if packed == "bz2" else whole[:-5])
        assert numbers_of(tmp_path / "a.bag") == [0, 1, 2, 3][: 4 if packed == "bz2" else 3]
        assert "has no index, as a killed recorder leaves it" in one_line(capsys)


PACKAGES = ["livox_ros_driver2", "livox_ros_driver", "livox_interfaces"]


@pytest.mark.parametrize("package", PACKAGES)
def test_livoxs_own_message_under_each_package(tmp_path, package, capsys):
    kind = f"{package}/msg/CustomMsg"
    a_db3(tmp_path / "a.db3", [("/livox/lidar", kind, k, custom(k)) for k in range(3)]).close()
    about = {"/livox/lidar": (f"{package}/CustomMsg", CUSTOM_MSG.replace("livox_ros_driver", package))}
    content = a_bag_of_ros_1([("/livox/lidar", k, custom(k, ros1=True)) for k in range(3)], kinds=about)
    (tmp_path / "a.bag").write_bytes(content)
    for name in ("a.db3", "a.bag"):
        assert numbers_of(tmp_path / name) == [0, 1, 2]
        table = read_points(tmp_path / name, index=2)
        assert (table.frame, table.time_s) == ("livox", 2.0)
        assert table.points["reflectivity"].tolist() == list(range(POINTS)) and table.points["line"][:5].tolist() == [
            0,
            1,
            2,
            3,
            0,
        ]
        assert table.points["offset_time"][-1] == 1000
    robot = [*state(), ("/livox/lidar", kind, 5, custom(5))]
    a_db3(tmp_path / "robot.db3", robot).close()
    (points,) = [
        event.points for event in events(tmp_path / "robot.db3", Topics(sees=True)) if event.points is not None
    ]
    np.testing.assert_array_equal(points.points, xyz(5))
    assert points.times_ns[0] == 6 * 10**9 and "points from /livox/lidar" in capsys.readouterr().err


def state():
    """Messages of a robot that stands, without points."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    t = {kind.rpartition("/")[2]: made for kind, made in store.types.items()}
    header, none, zero = t["Header"](t["Time"](5, 0), "x"), np.zeros(9), t["Vector3"](0.0, 0.0, 0.0)
    imu = t["Imu"](header, t["Quaternion"](0.0, 0.0, 0.0, 1.0), none, zero, none, zero, none)
    joints = t["JointState"](header, list(MOTORS), np.arange(12.0), np.zeros(12), np.zeros(12))
    return [
        ("/imu", IMU, 1, bytes(store.serialize_cdr(imu, IMU))),
        ("/joint_states", JOINTS, 2, bytes(store.serialize_cdr(joints, JOINTS))),
    ]


def test_a_replay_leaves_out_messages_whose_points_are_not_of_one_time(tmp_path, capsys):
    """As the live reader does: the first after a clock was set spans seconds."""
    spans = [1000, 3_000_000_000, 1000]
    robot = [("/points", CLOUD, 10 + k, cloud(k, span_ns=span)) for k, span in enumerate(spans)]
    a_db3(tmp_path / "a.db3", [*state(), *robot]).close()
    read = [event.points for event in events(tmp_path / "a.db3", Topics(sees=True)) if event.points is not None]
    assert [round(float(points.points[0, 0])) for points in read] == [0, 2]
    said = capsys.readouterr().err
    assert (
        "1 of 3 messages of /points refused, the first: a message's points span 3 s, at most 1 s was expected" in said
    )
    a_db3(tmp_path / "b.db3", [*state(), robot[1]]).close()
    with pytest.raises(
        DeployError, match=r"b.db3: 1 of 1 messages of /points refused, the first: a message's points span 3 s"
    ):
        list(events(tmp_path / "b.db3", Topics(sees=True)))


def test_a_replay_of_what_a_killed_recorder_left(tmp_path, capsys):
    messages = [*state(), *clouds_of(range(60))]
    a_db3(tmp_path / "whole.db3", messages).close()
    whole = (tmp_path / "whole.db3").read_bytes()
    (tmp_path / "cut.db3").write_bytes(whole[: int(0.6 * len(whole))])
    found = list(events(tmp_path / "cut.db3", Topics(sees=True)))
    clouds = [event.points for event in found if event.points is not None]
    assert len([event for event in found if event.state is not None]) == 1 and 25 < len(clouds) < 60
    said = [line for line in capsys.readouterr().err.splitlines() if "cut off" in line]
    assert (
        len(said) == 1
        and f"1 messages of /joint_states, 1 messages of /imu, {len(clouds)} messages of /points" in said[0]
    )


def test_a_bag_of_ros_1_is_replayed(tmp_path):
    """The state of a robot of ROS 1, written by rosbags."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    new, old = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
    with Writer(tmp_path / "a.bag") as bag:
        for topic, kind, time_ns, data in state():
            raw = new.cdr_to_ros1(data, kind)
            bag.write(bag.add_connection(topic, kind, typestore=old), time_ns, raw)
        bag.write(bag.add_connection("/points", CLOUD, typestore=old), 7, cloud(7, ros1=True))
    found = list(events(tmp_path / "a.bag", Topics(sees=True)))
    (joints,) = [event.state for event in found if event.state is not None]
    assert joints["motor_state"]["q"][:12].tolist() == list(range(12))
    (points,) = [event.points for event in found if event.points is not None]
    np.testing.assert_array_equal(points.points, xyz(7))
    assert points.times_ns.tolist()[0] == 7 * 10**9


@pytest.mark.parametrize(
    ("name", "messages", "said"),
    [
        (
            "a.db3",
            [("/scan", "velodyne_msgs/msg/VelodyneScan", 3, b"")],
            r"the policy needs points, .* /scan \(velodyne_msgs",
        ),
        ("a.db3", [("/livox", CUSTOM, 3, custom(1)[:-40])], "a.db3: 1 of 1 messages of /livox refused.*cut off"),
        ("a.db3", None, "a.db3 does not exist; an .mcap, .db3 or .bag file or the folder"),
        ("a.foo", b"1", "a.foo is no recording; .mcap, .db3, .bag, .active or the folder"),
    ],
)
def test_the_replay_command_says_what_it_cannot_read(tmp_path, capsys, monkeypatch, name, messages, said):
    seeing = SimpleNamespace(perception=object(), lidar=SimpleNamespace(period_s=0.1), control_period_s=0.02)
    policy = SimpleNamespace(description=seeing, safety=None)
    monkeypatch.setattr(replay_bag.ExportedPolicy, "load", lambda path: policy)
    monkeypatch.setattr(replay_bag, "replay", lambda policy, given, command: list(given))
    if isinstance(messages, list):
        a_db3(tmp_path / name, [*state(), *messages]).close()
    elif messages:
        (tmp_path / name).write_bytes(messages)
    with pytest.raises(SystemExit) as error:
        main(["replay-bag", str(tmp_path / name)])
    assert error.value.code == 2
    assert re.search(said, capsys.readouterr().err.splitlines()[-1])


def test_real_scans_reads_what_is_left_of_a_recording(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(real_scans, "PLANES", 5)
    a_db3(tmp_path / "a.db3", [("/livox", CUSTOM, k, custom(k + 1)) for k in range(30)]).close()
    whole = (tmp_path / "a.db3").read_bytes()
    (tmp_path / "a.db3").write_bytes(whole[: int(0.6 * len(whole))])
    real_scans.command([f"file={tmp_path / 'a.db3'}", "device=mid360", "frame=3", f"out={tmp_path}"])
    said = capsys.readouterr()
    assert "a.db3 is cut off or damaged" in said.err and (tmp_path / "summary.csv").is_file()
    with pytest.raises(SystemExit) as error:
        real_scans.command([f"file={tmp_path / 'a.db3'}", "device=mid360", "frame=29", f"out={tmp_path}"])
    assert error.value.code == 2 and "holds no frame number 29" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("suffix", "need"), [(".pcap", "the sensor's .json of the same name"), (".osf", "a whole rec")]
)
def test_real_scans_says_what_an_ousters_recording_needs(tmp_path, capsys, monkeypatch, suffix, need):
    """In place of ouster-sdk, which raises an Exception of its own and a message of several lines."""

    def refuse(path):
        raise Exception("Failed to create frame_set_source\nmore details: none")

    sdk = SimpleNamespace(core=None, open_source=refuse)
    monkeypatch.setitem(sys.modules, "ouster", SimpleNamespace(sdk=sdk))
    monkeypatch.setitem(sys.modules, "ouster.sdk", sdk)
    (tmp_path / f"a{suffix}").write_bytes(b"1")
    with pytest.raises(SystemExit) as error:
        real_scans.command([f"file={tmp_path}/a{suffix}", "device=os1_128", f"out={tmp_path}"])
    said = one_line(capsys)
    assert (
        error.value.code == 2 and f"a{suffix} cannot be opened: {suffix} needs {need}" in said and "Failed" not in said
    )
