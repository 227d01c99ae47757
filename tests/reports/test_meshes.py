"""Meshes as other tools write them: units, axes, nodes, winding, coordinates of maps; the truth are shapes by hand."""

import json
import struct
import sys
import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from omnilidar import HeightField, RayScene, Shape, ShapeKind, TriangleMesh, geom_shapes, read_points
from omniperception.commands import main, scan
from omniperception.commands.scan import pictures
from omniperception.commands.scan.room import DemoClass
from omniperception.config import ConfigError
from omniperception.robots.guess import GUESSED, SURE, guess
from omniperception.scene.ground import Ground
from omniperception.scene.map_terrain import HeightMapConfig, PlaceConfig, StartsConfig
from omniperception.scene.meshes import mesh_points
from omniperception.scene.obstacle_group import ObstacleGroup
from omniperception.scene.robot_file import compile_robot, read_robot

UTM = np.array([500_000.3, 5_000_000.7, 120.4])
"""m, east and north in a UTM zone, and above the sea; none of it a number of float32."""
QUADS = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
SPIDER = Path(__file__).parents[1] / "data" / "spider.urdf"


def box(x, y, z):
    """Corners (8, 3) of a box, of which QUADS are the sides, seen from outside counter-clockwise."""
    return np.array([(a, b, c) for c in z for a, b in ((x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1]))], float)


def mesh_of(*boxes):
    """Vertices and triangles, two to a side."""
    triangles = np.array([t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))])
    return np.concatenate(boxes), np.concatenate([triangles + 8 * k for k in range(len(boxes))])


HALL = mesh_of(
    box((0, 10), (0, 8), (-0.2, 0)),  # the floor
    *(box((0, 0.4), (0, 8), (0, 2.5)), box((9.6, 10), (0, 8), (0, 2.5))),
    *(box((0, 10), (0, 0.4), (0, 2.5)), box((0, 10), (7.6, 8), (0, 2.5))),
    box((2, 3), (1, 2), (0, 0.7)),  # a table, off the middle
)
CRATE = box((0, 1), (0, 2), (0, 3))
"""1 x 2 x 3 m, so that no two axes are alike."""


def obj(path, vertices, faces, more=""):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()] + ["f " + " ".join(map(str, f)) for f in faces]
    path.write_text(more + "\n".join(lines) + "\n")
    return path


def stl(path, vertices, triangles, header=b""):
    rows = [struct.pack("<12fH", 0, 0, 0, *vertices[t].ravel(), 0) for t in triangles]
    path.write_bytes(header.ljust(80, b"\0") + struct.pack("<I", len(triangles)) + b"".join(rows))
    return path


def ply(path, vertices, faces, kind):
    order, text = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}[kind], kind == "ascii"
    head = [f"ply\nformat {kind} 1.0\nelement vertex {len(vertices)}", *(f"property double {a}" for a in "xyz")]
    head += [f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"]
    if text:
        rows = [" ".join(map(repr, v)) + "\n" for v in vertices.tolist()]
        rows += [" ".join(map(str, (len(face), *face))) + "\n" for face in faces]
    else:
        rows = [struct.pack(order + "3d", *v).decode("latin1") for v in vertices]
        rows += [struct.pack(f"{order}B{len(face)}i", len(face), *face).decode("latin1") for face in faces]
    path.write_bytes(("\n".join(head) + "".join(rows)).encode("latin1"))
    return path


def glb(path, vertices, triangles, *nodes, **head):
    """A glTF of one mesh; `nodes` are as the format has them, the first of which is the scene's."""
    points, indices = np.asarray(vertices, "<f4"), np.asarray(triangles, "<u4").ravel()
    data = points.tobytes() + indices.tobytes()
    parts = (
        (0, points.nbytes, 5126, "VEC3", len(points)),
        (points.nbytes, indices.nbytes, 5125, "SCALAR", indices.size),
    )
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes or [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": [{"buffer": 0, "byteOffset": at, "byteLength": size} for at, size, *_ in parts],
        "accessors": [
            {"bufferView": k, "componentType": kind, "type": shape, "count": count}
            for k, (_, _, kind, shape, count) in enumerate(parts)
        ],
    }
    document["accessors"][0] |= {"min": points.min(0).tolist(), "max": points.max(0).tolist()}
    document |= head
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


def dae(path, nodes, asset):
    """A COLLADA file of CRATE, of quads; GEOMETRY in `nodes` is where it hangs."""
    points = " ".join(map(str, CRATE.ravel().tolist()))
    path.write_text(f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>{asset}</asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="24">{points}</float_array><technique_common>
<accessor source="#a" count="8" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<polylist count="6"><input semantic="VERTEX" source="#v" offset="0"/><vcount>4 4 4 4 4 4</vcount>
<p>{" ".join(str(k) for quad in QUADS for k in quad)}</p></polylist></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s">{nodes.replace("GEOMETRY", '<instance_geometry url="#g"/>')}</visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>""")
    return path


def bounds(mesh):
    corners = mesh.vertices[mesh.triangles]
    return [*corners.min((0, 1)), *corners.max((0, 1))]


def volume(mesh):
    """By Gauss: positive where triangles are counter-clockwise seen from outside."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles].astype(np.float64), 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


def laid(vertices):
    """Corners with z up as glTF has them, y up."""
    return np.stack((vertices[:, 0], vertices[:, 2], -vertices[:, 1]), 1)


# --- nodes, winding, axes, units --------------------------------------------------------------------------------------

MIRRORED = {
    "scale": [{"mesh": 0, "scale": [-1, 1, 1]}],
    "matrix": [{"mesh": 0, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}],
    "parent": [{"scale": [-1, 1, 1], "children": [1]}, {"mesh": 0}],
    "all three axes, turned": [{"mesh": 0, "scale": [-1, -1, -1], "rotation": [1, 0, 0, 0]}],
}


@pytest.mark.parametrize("inside_out", [False, True])
@pytest.mark.parametrize("name", MIRRORED)
def test_a_mirrored_hall_keeps_its_walls(tmp_path, name, inside_out):
    """glTF turns the winding of a mirrored node; exporters that do not know it write what becomes inside out."""
    pytest.importorskip("trimesh")
    vertices, triangles = HALL
    path = glb(tmp_path / "hall.glb", laid(vertices), triangles[:, ::-1] if inside_out else triangles, *MIRRORED[name])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        place = PlaceConfig(str(path), 0.05, ceiling=2.0)
        heights, (x, y) = place._map
    assert any("is wound inside out" in str(warning.message) for warning in said) == inside_out
    right = ((0.2, 4), 2.0), ((9.8, 4), 2.0), ((5, 0.2), 2.0), ((5, 7.8), 2.0), ((2.5, 1.5), 0.7), ((7.5, 1.5), 0.0)
    for (ahead, aside), height in right:
        assert heights[round((aside - y) / 0.05), round((-ahead - x) / 0.05)] == pytest.approx(height, abs=1e-6)
    ring = heights[20:-20, 20:-20]  # of the file, without what goes on beside it
    assert ring.shape == (161, 201) and (ring == 2.0).sum() == pytest.approx(161 * 201 - 145 * 185, abs=700)


def test_nodes_of_a_glb_carry_their_meshes(tmp_path):
    """A turn within a shift within a scale, and the same mesh twice, once as its mirror image."""
    pytest.importorskip("trimesh")
    quarter = [0, 2**-0.5, 0, 2**-0.5]  # about y
    nodes = [
        {"scale": [2, 2, 2], "children": [1, 3]},
        {"translation": [10, 0, 0], "children": [2]},
        {"mesh": 0, "rotation": quarter, "name": "crate"},
        {"mesh": 0, "scale": [1, 1, -1], "name": "crate"},
    ]
    mesh = TriangleMesh.from_file(glb(tmp_path / "crates.glb", *mesh_of(CRATE), *nodes), up="y")
    # y up: x to z's place and z to -x's; then z up: (x, -z, y)
    turned = [20.0, 0.0, 0.0, 26.0, 2.0, 4.0]
    mirror = [0.0, 0.0, 0.0, 2.0, 6.0, 4.0]
    low, high = np.minimum(turned[:3], mirror[:3]), np.maximum(turned[3:], mirror[3:])
    assert bounds(mesh) == pytest.approx([*low, *high], abs=1e-5)
    assert len(mesh.triangles) == 24 and volume(mesh) == pytest.approx(2 * 8 * 6.0, rel=1e-5)


def test_the_axis_that_points_up_is_the_formats(tmp_path, make_config):
    """A crate 3 m high in a GLB, whose y points up, as TriangleMesh, obstacle and place to scan."""
    pytest.importorskip("trimesh")
    path = glb(tmp_path / "crate.glb", laid(CRATE), mesh_of(CRATE)[1])
    assert bounds(TriangleMesh.from_file(path)) == pytest.approx([0, 0, 0, 1, 2, 3], abs=1e-6)
    assert bounds(TriangleMesh.from_file(path, up="z")) == pytest.approx([0, 0, -2, 1, 3, 0], abs=1e-6)
    assert mesh_points(str(path))[1] == pytest.approx((0.5, 1.0, 1.5))
    robot = make_config("perception=none", "observations=walk", "rewards=walk", "lidar=none").env.robot
    assert scan._surroundings(scan.Arguments(mesh=path), robot).top == pytest.approx(3.0)
    assert scan._surroundings(scan.Arguments(mesh=path, up="z"), robot).top == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(ValueError, match="up=w of mesh .* must be z, y, x"):
        TriangleMesh.from_file(path, up="w")


@pytest.mark.parametrize(
    ("asset", "expected"),
    [
        ('<unit name="centimeter" meter="0.01"/><up_axis>Z_UP</up_axis>', [0, 0, 0, 0.01, 0.02, 0.03]),
        ("<up_axis>Z_UP</up_axis>", [0, 0, 0, 1, 2, 3]),
        ('<unit meter="0.0254" name="inch"/><up_axis>Y_UP</up_axis>', [0, -0.0762, 0, 0.0254, 0, 0.0508]),
        ("", [0, -3, 0, 1, 0, 2]),  # metres and Y_UP where nothing is said
        ("<up_axis>X_UP</up_axis>", [-2, -3, 0, 0, 0, 1]),
    ],
)
def test_units_and_axes_of_collada_are_its_own(tmp_path, asset, expected):
    pytest.importorskip("collada")
    path = dae(tmp_path / "crate.dae", "<node>GEOMETRY</node>", asset)
    mesh = TriangleMesh.from_file(path)
    assert bounds(mesh) == pytest.approx(expected, abs=1e-6) and volume(mesh) > 0
    half = (np.array(expected[3:]) - expected[:3]) / 2
    assert mesh_points(str(path))[1] == pytest.approx(tuple(half), rel=1e-5)


def test_nodes_of_collada_carry_their_meshes(tmp_path):
    pytest.importorskip("collada")
    node = (
        "<node><translate>10 0 0</translate><rotate>0 0 1 90</rotate><node>"
        "<matrix>-2 0 0 0 0 2 0 0 0 0 2 5 0 0 0 1</matrix>GEOMETRY</node></node>"
    )
    path = dae(tmp_path / "crate.dae", node, '<unit meter="0.1"/><up_axis>Z_UP</up_axis>')
    mesh = TriangleMesh.from_file(path)  # x in [-2, 0] becomes y, y in [0, 4] becomes -x; decimetres
    assert bounds(mesh) == pytest.approx([0.6, -0.2, 0.5, 1.0, 0.0, 1.1], abs=1e-6)
    assert volume(mesh) == pytest.approx(8 * 6e-3, rel=1e-5)


HALF_METRES = '<unit meter="0.5"/><up_axis>Z_UP</up_axis>'


def test_a_place_in_collada_is_seen_from_above(tmp_path):
    pytest.importorskip("collada")
    path = dae(tmp_path / "crate.dae", "<node><scale>4 4 0.2</scale>GEOMETRY</node>", HALF_METRES)
    heights, first = PlaceConfig(str(path), 0.05).read()  # 2 x 4 x 0.3 m
    assert first == (0.0, 0.0) and heights.shape == (81, 41) and heights[40, 20] == pytest.approx(0.3)


def test_what_reads_collada_is_named(tmp_path, monkeypatch):
    pytest.importorskip("trimesh")
    monkeypatch.setitem(sys.modules, "collada", None)
    path = dae(tmp_path / "crate.dae", "<node>GEOMETRY</node>", "")
    with pytest.raises(ImportError, match=r"needs collada: pip install 'omnilidar\[meshes\]'"):
        TriangleMesh.from_file(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"extensionsUsed": ["EXT_mesh_gpu_instancing"]}, "EXT_mesh_gpu_instancing, which are not read"),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 6}]}]}, "triangle fans"),
        ({"nodes": 7}, "it is damaged, or no .glb file"),
    ],
)
def test_what_a_glb_holds_otherwise_is_refused(tmp_path, change, message):
    pytest.importorskip("trimesh")
    with pytest.raises(ValueError, match=message) as error:
        TriangleMesh.from_file(glb(tmp_path / "crate.glb", *mesh_of(CRATE), **change))
    assert "\n" not in str(error.value)


# --- coordinates of maps ----------------------------------------------------------------------------------------------


def sixteen(at):
    """Steps of 3 to 18 cm, 192 triangles, in float64."""
    return mesh_of(*(box((k, k + 0.5), (0, 0.2), (0, 0.03 * (k % 6 + 1))) + at for k in range(16)))


def test_a_mesh_in_coordinates_of_a_map_keeps_its_millimetres(tmp_path):
    vertices, triangles = sixteen(UTM)
    path = obj(tmp_path / "steps.obj", vertices, triangles + 1)
    with pytest.raises(
        ValueError, match=r"lies 500000\d m from its origin.* 0.5 m apart: give origin=\(500008.0, "
    ) as e:
        TriangleMesh.from_file(path)
    assert "\n" not in str(e.value)
    mesh = TriangleMesh.from_file(path, origin=UTM)
    near = TriangleMesh(*sixteen(0.0))
    assert len(mesh.triangles) == 192 and mesh.num_degenerate == 0
    np.testing.assert_allclose(mesh.vertices, near.vertices, atol=1e-6)
    np.testing.assert_allclose(mesh_points(str(path))[1], (7.75, 0.1, 0.09), atol=1e-6)


def test_vertices_far_from_their_origin_are_refused_with_what_mends_it():
    vertices, triangles = sixteen(UTM)
    with pytest.raises(
        ValueError, match=r"subtract an origin in float64 first, such as \(500008.0, 5000001.0, 120.0\)"
    ):
        TriangleMesh(vertices, triangles)
    assert len(TriangleMesh(vertices - UTM, triangles).triangles) == 192
    far = np.zeros(3), np.full(3, 4e4)  # a region of 40 km: another origin would not help
    assert len(TriangleMesh(*mesh_of(box(*np.stack(far, 1)))).triangles) == 12


def test_a_shape_far_from_the_origin_is_hit_where_it_is():
    """The mesh about its own origin, its place in float64."""
    shape = Shape(ShapeKind.MESH, asset=TriangleMesh(*mesh_of(CRATE)), pos=tuple(UTM))
    carried = Shape(ShapeKind.SPHERE, (0.5,), body=0)
    scene = RayScene([shape, carried], 1, 1, pose_dtype=torch.float64)
    scene.set_poses(np.add(UTM, [[0.5, 1.0, 6.0]]), np.array([[1.0, 0.0, 0.0, 0.0]]))
    above = np.add(UTM, [[[0.25, 0.25, 4.5], [0.5, 1.0, 8.0]]])
    ranges = scene.cast(above, np.array([[[0.0, 0.0, -1.0]] * 2])).ranges
    assert ranges[0].tolist() == pytest.approx([1.5, 1.5], abs=1e-5)
    with pytest.raises(ValueError, match=r"float32 loses 0\.\d+ m: make the scene with pose_dtype=torch.float64"):
        RayScene([carried], 1, 1).set_poses(UTM[None], np.array([[1.0, 0.0, 0.0, 0.0]]))


def test_a_place_in_coordinates_of_a_map_is_seen_from_above(tmp_path):
    vertices, triangles = HALL
    path = obj(tmp_path / "hall.obj", vertices + UTM, triangles + 1)
    near = PlaceConfig(str(obj(tmp_path / "near.obj", vertices, triangles + 1)), 0.05, ceiling=2.0)
    start = StartsConfig(inside=np.add(UTM[:2], [5.0, 4.0]).tolist())
    far = PlaceConfig(str(path), 0.05, ceiling=2.0 + UTM[2], start=start)
    np.testing.assert_allclose(far.height_map() - UTM[2], near.height_map(), atol=1e-6)
    np.testing.assert_array_equal(far.places, near.places)
    np.testing.assert_allclose(np.subtract(far._map[1], near._map[1]), UTM[:2], atol=1e-6)


def test_heights_above_the_sea_are_kept(tmp_path):
    """As float32, heights of 1000 km would be multiples of 6 cm."""
    steps = 0.01 * np.arange(60 * 80).reshape(60, 80) % 0.4
    np.save(tmp_path / "yard.npy", 1e6 + steps)
    config = HeightMapConfig(str(tmp_path / "yard.npy"), 0.1, StartsConfig(radius=0.1, step=1.0, climb=1.0))
    spec = mujoco.MjSpec()
    config.add_to(spec)
    model, place = spec.compile(), torch.zeros(1, 3)
    ground = Ground(config, model, place)
    column, row = config.places[0]
    xy = torch.tensor([[[0.0, 0.0], [0.1, 0.0], [0.0, 0.2]]])
    heights = np.pad(steps, 10, mode="edge")
    expected = heights[[row, row, row + 2], [column, column + 1, column]] - heights[row, column]
    np.testing.assert_allclose(ground.height(xy)[0], expected, atol=1e-6)
    assert float(place[0, 2]) == pytest.approx(-heights[row, column], abs=1e-6)
    with pytest.raises(ValueError, match="subtract the lowest in float64"):
        HeightField(1e6 + steps, 4.0, 3.0)


def test_a_hall_in_coordinates_of_a_map_is_scanned(tmp_path, make_config, monkeypatch):
    vertices, triangles = HALL
    path = obj(tmp_path / "hall.obj", vertices + UTM, triangles + 1)
    run = make_config("perception=none", "observations=walk", "rewards=walk", "lidar=vlp16")
    with pytest.raises(ConfigError, match=r"at=0,0,0 is 50\d+ m beside mesh=.*hall.obj, x 500000.3 to 500010.3, y"):
        scan._surroundings(scan.Arguments(mesh=path), run.env.robot)
    demo = scan._surroundings(scan.Arguments(mesh=path, at=tuple(np.add(UTM, [5, 4, 0]))), run.env.robot)
    taken = pictures.take_scan("vlp16", run.env.lidar, demo, num_rays=3000)
    monkeypatch.setattr(pictures, "draw_pattern", lambda *a: None)
    monkeypatch.setattr(pictures, "draw_scan", lambda *a: None)
    pictures.write_scan(taken, run.env.lidar, demo, tmp_path)
    table = read_points(tmp_path / "scan.ply")
    walls = table.xyz[table.points["class_id"] == DemoClass.MESH] - UTM
    inner = np.array([[0.4, 0.4, 0.0], [9.6, 7.6, np.inf]])
    on_a_face = np.abs(walls[:, None] - inner).min((1, 2)) < 1e-3
    on_the_table = (np.abs(walls - [2.5, 1.5, 0.35]) < [0.501, 0.501, 0.351]).all(1)
    assert len(walls) > 500 and (on_a_face | on_the_table).all()


def test_a_file_that_has_lost_its_millimetres_says_so(tmp_path):
    vertices, triangles = sixteen(UTM)
    path = stl(tmp_path / "steps.stl", vertices, triangles)
    with pytest.warns(UserWarning, match="is kept in such numbers: export it near its origin, or as OBJ"):
        mesh_points(str(path))


# --- units ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "said"),
    [
        (1000.0, "is 10000 x 8000 x 2700 m large; scale=0.001 would make it 10 x 8 x 2.7 m"),
        (100.0, ""),
        (300.0, "is 3000 x 2400 x 810 m large; scale=0.001 would make it 3 x 2.4 x 0.81 m"),
        (1e-4, "is 0.001 x 0.0008 x 0.00027 m large; scale=1000 would make it 1 x 0.8 x 0.27 m"),
        (1.0, ""),
    ],
)
def test_a_size_that_is_no_rooms_is_said(tmp_path, unit, said):
    vertices, triangles = HALL
    path = stl(tmp_path / "hall.stl", unit * vertices, triangles)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mesh = TriangleMesh.from_file(path)
        mesh_of_a_room = TriangleMesh.from_file(path, scale=1.0 / unit)
    assert len(mesh.triangles) == len(mesh_of_a_room.triangles) == 72
    assert len(caught) == bool(said) and all(said in str(warning.message) for warning in caught)


def test_a_hall_in_millimetres_is_said_by_scan_place_and_obstacles(tmp_path, make_config, capsys):
    vertices, triangles = HALL
    path = stl(tmp_path / "hall.stl", 1000.0 * vertices, triangles)
    robot = make_config("perception=none", "observations=walk", "rewards=walk", "lidar=none").env.robot
    scan._surroundings(scan.Arguments(mesh=path), robot)
    assert (
        "hall.stl is 10000 x 8000 x 2700 m large; scale=0.001 would make it 10 x 8 x 2.7 m" in capsys.readouterr().err
    )
    scan._surroundings(scan.Arguments(mesh=path, scale=0.001), robot)
    assert capsys.readouterr().err == ""
    with pytest.raises(ValueError, match=r"too large for terrain.cell.*terrain.scale=0.001 would make it 10 x 8 x"):
        PlaceConfig(str(path), 0.05).height_map()
    small = stl(tmp_path / "crate.stl", 1e-3 * CRATE, mesh_of(CRATE)[1])
    with pytest.warns(
        UserWarning, match=r"crate.stl is 0.001 x 0.002 x 0.003 m large; scale=1000 would make it 1 x 2 x"
    ):
        ObstacleGroup("mesh", 1, file=str(small)).sizes_of(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ObstacleGroup("mesh", 1, [[0.5, 0.5], [1.0, 1.0], [1.5, 1.5]], file=str(small)).sizes_of(0)


@pytest.mark.parametrize("comment", ["# File units = millimeters\n", "# Units: mm\n", "# units in mm\n"])
def test_a_unit_in_a_comment_is_said(tmp_path, comment):
    path = obj(tmp_path / "crate.obj", 300.0 * CRATE, mesh_of(CRATE)[1] + 1, comment)
    with pytest.warns(
        UserWarning, match=r"names (mm|millimeters) as its unit; scale=0.001 would make it 0.3 x 0.6 x 0.9"
    ):
        TriangleMesh.from_file(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        TriangleMesh.from_file(path, scale=0.001)
        TriangleMesh.from_file(obj(path, CRATE, mesh_of(CRATE)[1] + 1, "# Units: meters\n"))


@pytest.mark.parametrize("scale", [-1.0, 0.0, float("nan"), float("inf")])
def test_a_scale_is_above_0(tmp_path, scale):
    path = obj(tmp_path / "crate.obj", CRATE, mesh_of(CRATE)[1] + 1)
    with pytest.raises(ValueError, match="must be above 0"):
        TriangleMesh.from_file(path, scale=scale)
    with pytest.raises(ValueError, match=r"terrain\.scale=.* must be positive"):
        PlaceConfig(str(path), scale=scale)


# --- OBJ, STL, PLY ----------------------------------------------------------------------------------------------------


def test_negative_indices_count_back_from_their_face(tmp_path):
    """Two crates, each with its faces below its corners, as exporters write one object after another."""
    path, quads = tmp_path / "crates.obj", [[k - 8 for k in quad] for quad in QUADS]
    obj(path, CRATE, quads)
    first = path.read_text()
    obj(path, np.add(CRATE, [10.0, 0.0, 0.0]), quads, first + "o second  # of two\n")
    mesh = TriangleMesh.from_file(path)
    assert bounds(mesh) == pytest.approx([0, 0, 0, 11, 2, 3]) and volume(mesh) == pytest.approx(12.0)
    path.write_text(first.replace("\nf", "  # as some write\nvt 0 0\nf").replace("-5 ", "-5/-1/-1 \\\n"))
    assert volume(TriangleMesh.from_file(path)) == pytest.approx(6.0)
    path.write_text(first.replace("3.0", "3,0", 1))
    with pytest.raises(ValueError, match="'v 0.0 0.0 3,0' is neither a vertex nor a face"):
        TriangleMesh.from_file(path)


L_SHAPE = np.array([(2, 0), (2, 1), (1, 1), (1, 2), (0, 2), (0, 0)], float)
"""Seen from its first corner not all of it is in view."""


def prism(outline, height):
    """Corners and polygons of an upright prism, outside counter-clockwise."""
    n = len(outline)
    corners = np.concatenate([np.column_stack((outline, np.full(n, z))) for z in (0.0, height)])
    sides = [(k, (k + 1) % n, (k + 1) % n + n, k + n) for k in range(n)]
    return corners, [tuple(range(n))[::-1], tuple(range(n, 2 * n)), *sides]


@pytest.mark.parametrize("turn", range(6))
@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_polygons_with_dents_are_not_filled(tmp_path, suffix, turn):
    corners, faces = prism(np.roll(L_SHAPE, turn, 0), 1.0)
    corners = corners @ np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]])  # upright: z is x, x is y, y is z
    path = tmp_path / f"l{suffix}"
    if suffix == ".obj":
        obj(path, corners, [[k + 1 for k in face] for face in faces])
    else:
        ply(path, corners, faces, "binary_little_endian")
    mesh = TriangleMesh.from_file(path)
    assert len(mesh.triangles) == 2 * 4 + 6 * 2 and volume(mesh) == pytest.approx(3.0) and mesh.is_closed
    rng = np.random.default_rng(0)
    points = rng.uniform(0.0, 2.0, (500, 2))
    inside = (points < 1.0).any(1)
    origins = np.column_stack((np.full(500, 5.0), points))
    ranges = (
        RayScene([Shape(ShapeKind.MESH, asset=mesh)], 1, 0).cast(origins[None], np.array([[[-1.0, 0, 0]] * 500])).ranges
    )
    assert (torch.isfinite(ranges[0]).numpy() == inside).all()


def test_a_dented_polygon_of_many_corners_keeps_its_area(tmp_path):
    angle = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    outline = np.stack((np.cos(angle), np.sin(angle)), 1) * (1.0 + 0.5 * (np.arange(60) % 2))[:, None]  # a gear
    corners, faces = prism(outline, 2.0)
    mesh = TriangleMesh.from_file(obj(tmp_path / "gear.obj", corners, [[k + 1 for k in face] for face in faces]))
    x, y = outline.T
    area = (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2  # shoelace
    assert volume(mesh) == pytest.approx(2.0 * area, rel=1e-5)
    top = mesh.vertices[mesh.triangles][(mesh.vertices[mesh.triangles][..., 2] > 1.9).all(1)]
    parts = np.linalg.norm(np.cross(top[:, 1] - top[:, 0], top[:, 2] - top[:, 0]), axis=1) / 2
    assert parts.sum() == pytest.approx(area, rel=1e-5)  # without overlaps


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_files_of_quads_and_triangles(tmp_path, kind):
    a, b, *others = QUADS
    mixed = [a, *[(q[0], q[1], q[2]) for q in [b]], *[(q[0], q[2], q[3]) for q in [b]], *others]
    for faces in (list(QUADS), mixed, mesh_of(CRATE)[1].tolist()):
        mesh = TriangleMesh.from_file(ply(tmp_path / "crate.ply", CRATE, faces, kind))
        assert len(mesh.triangles) == 12 and volume(mesh) == pytest.approx(6.0)
    whole = (tmp_path / "crate.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(whole[:-5])
    with pytest.raises(ValueError, match=r"cut.ply (is a PLY file that is cut off|has triangles of vertices)"):
        TriangleMesh.from_file(tmp_path / "cut.ply")


@pytest.mark.parametrize("name", ["solid", "solid vertex normal", "solid endsolid", "solid vertex 3 facet"])
def test_text_stl_files_of_any_name(tmp_path, name):
    vertices, triangles = mesh_of(CRATE)
    lines = [name]
    for corners in vertices[triangles]:
        lines += ["facet normal 0 0 0", "  outer loop"]
        lines += [f"    vertex {x:.6e} {y:.6e} {z:.6e}" for x, y, z in corners] + ["  endloop", "endfacet"]
    (tmp_path / "crate.STL").write_text("\r\n".join([*lines, "endsolid"]))
    assert volume(TriangleMesh.from_file(tmp_path / "crate.STL")) == pytest.approx(6.0)
    (tmp_path / "comma.stl").write_text("\n".join(lines).replace("3.000000e+00", "3,0", 1))
    with pytest.raises(ValueError, match="35 corners of three numbers in 12 facets"):
        TriangleMesh.from_file(tmp_path / "comma.stl")


@pytest.mark.parametrize("header", [b"solid of a CAD program", b""])
def test_binary_stl_files_are_known_by_their_length(tmp_path, header):
    path = stl(tmp_path / "crate.stl", *mesh_of(CRATE), header)
    assert volume(TriangleMesh.from_file(path)) == pytest.approx(6.0)
    whole = path.read_bytes()
    path.write_bytes(whole + b"\0\0")  # as some programs pad
    assert volume(TriangleMesh.from_file(path)) == pytest.approx(6.0)
    path.write_bytes(whole[:-20])
    with pytest.raises(ValueError, match="crate.stl ends after 11 of 12 triangles"):
        TriangleMesh.from_file(path)


def test_corners_that_are_not_finite_name_their_file(tmp_path):
    vertices = CRATE.copy()
    vertices[3, 1] = np.nan
    for path in (
        obj(tmp_path / "a.obj", vertices, mesh_of(CRATE)[1] + 1),
        stl(tmp_path / "a.stl", vertices, mesh_of(CRATE)[1]),
        ply(tmp_path / "a.ply", vertices, mesh_of(CRATE)[1].tolist(), "ascii"),
        ply(tmp_path / "b.ply", vertices, QUADS, "binary_little_endian"),
    ):
        for read in (
            TriangleMesh.from_file,
            lambda path: PlaceConfig(str(path)).height_map(),
            lambda p: mesh_points(str(p)),
        ):
            with pytest.raises(ValueError, match=rf"{path.name} has \d triangles with corners that are not finite"):
                read(path)


@pytest.mark.parametrize("faces", [[(1, 2, 9)], [(1, 2, 0)], [(1, 2, -9)], [(1, 2, 3, 4, 90)]])
def test_vertices_that_there_are_not_are_one_line(tmp_path, faces):
    with pytest.raises(ValueError, match=r"has triangles of vertices that it does not have; it has 8$"):
        TriangleMesh.from_file(obj(tmp_path / "crate.obj", CRATE, faces))


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".glb", ".off"])
def test_what_trimesh_writes_is_read(tmp_path, suffix):
    trimesh = pytest.importorskip("trimesh")
    rng = np.random.default_rng(1)
    ball = trimesh.creation.icosphere(subdivisions=2)
    given = trimesh.Trimesh(ball.vertices * rng.uniform(0.5, 1.5, (len(ball.vertices), 1)), ball.faces, process=False)
    given.export(tmp_path / f"ball{suffix}")
    mesh = TriangleMesh.from_file(tmp_path / f"ball{suffix}", up="z")
    got, wanted = (a[np.lexsort(a.T)] for a in (mesh.vertices[mesh.triangles].mean(1), given.triangles_center))
    np.testing.assert_allclose(got, wanted, atol=1e-6)
    assert volume(mesh) == pytest.approx(given.volume, rel=1e-5)


# --- robots -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".obj", ".stl"])
@pytest.mark.parametrize("scale", [(1, 1, 1), (-1, 1, 1), (1, -1, 1), (-1, -1, -1)])
def test_mirrored_meshes_of_robots_keep_mass_and_outside(tmp_path, scale, suffix):
    """A tetrahedron of 0.1 x 0.2 x 0.3 m, whose volume is a sixth of that box's."""
    vertices, faces = np.diag([0.1, 0.2, 0.3]), np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
    vertices = np.concatenate([np.zeros((1, 3)), vertices])
    write = {".obj": lambda p: obj(p, vertices, faces + 1), ".stl": lambda p: stl(p, vertices, faces)}[suffix]
    mesh = write(tmp_path / f"leg{suffix}")
    (tmp_path / "robot.urdf").write_text(
        f'<robot name="r"><link name="base"><collision><geometry><mesh filename="{mesh.name}"'
        f' scale="{" ".join(map(str, scale))}"/></geometry></collision></link></robot>'
    )
    model = compile_robot(read_robot(tmp_path / "robot.urdf"), "robot.urdf")
    (shape,) = geom_shapes(model).shapes
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, np.array(shape.quat))
    placed = TriangleMesh(shape.asset.vertices @ turn.reshape(3, 3).T + shape.pos, shape.asset.triangles)
    ends = np.array([np.zeros(3), np.multiply(scale, [0.1, 0.2, 0.3])])
    assert bounds(placed) == pytest.approx([*ends.min(0), *ends.max(0)], abs=1e-6)
    assert volume(placed) == pytest.approx(0.001, rel=1e-4) and model.body_mass[1] == pytest.approx(1.0, rel=1e-4)


def test_a_link_without_inertia_is_among_the_guesses(tmp_path, capsys):
    """A thigh of 3 x 8 x 3 cm and six round feet of 2 cm, whose mass nobody said, are taken for water."""
    text = SPIDER.read_text()
    before, link, after = text.partition('<link name="left_front_femur">')
    path = tmp_path / "spider.urdf"
    path.write_text(before + link + after.partition("</inertial>")[2])
    main(["robot-new", str(path), f"out={tmp_path / 'robot'}"])
    (said,) = [line for line in capsys.readouterr().out.splitlines() if line.split()[:1] == ["masses"]]
    foot = 1000.0 * 4 / 3 * np.pi * 0.02**3
    assert (
        said.split()[1] == GUESSED and "left_front_femur 0.072 kg" in said and f"right_rear_foot {foot:.3g} kg" in said
    )
    assert "trunk" not in said and said.count(" kg") == 8  # one of them is the density's
    go2 = Path(__file__).parents[2] / "omniperception/scene/assets/go2.xml"
    (finding,) = [finding for finding in guess(go2, "go2.xml").findings if finding.key == "masses"]
    assert finding.how_sure == SURE
