"""Reads mesh files into float64, metres, z up: STL, OBJ and PLY by itself, what else there is with trimesh."""

import json
import math
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from .clouds.ply import read_header

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices (V, 3) float64 and triangles, their indices, (T, 3) int64."""

LARGE, SMALL, ROOM = 1000.0, 0.01, 6.0
"""Metres: what is larger or smaller than the first two is probably in another unit, in which it is like a room."""
UNITS = {
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 0.001),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 0.01),
    **dict.fromkeys(("in", "inch", "inches"), 0.0254),
    **dict.fromkeys(("ft", "foot", "feet"), 0.3048),
}
"""Metres, of the units that comments and headers name."""
_UNIT = re.compile(rb"\bunits?\b(?:\s+(?:in|is|are)\b)?\W{0,4}(\w+)", re.IGNORECASE)
_NUMBER = rb"\s+([-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|\.\d+(?:e[-+]?\d+)?|nan|inf))"
_CORNER = re.compile(rb"\bvertex" + 3 * _NUMBER + rb"(?!\S)", re.IGNORECASE)
_STL_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
AXES = {"z": ((0, 1, 2), (1, 1, 1)), "y": ((0, 2, 1), (1, -1, 1)), "x": ((1, 2, 0), (-1, -1, 1))}
"""Which coordinates become x, y, z, and their signs, by the axis that points up."""
MODELS = (".urdf", ".xml", ".usd", ".usda", ".usdc", ".usdz")
"""Files of robots and worlds, which Newton reads."""
_NOT_READ, _DRACO = ("EXT_mesh_gpu_instancing", "EXT_meshopt_compression"), "KHR_draco_mesh_compression"
"""Extensions of glTF in which a mesh may lie."""


def read_mesh(path: str | Path, scale: float = 1.0, up: str | None = None) -> Mesh:
    """Vertices in metres with z up, and triangles, of all parts of a file where its nodes place them.

    Polygons become triangles. Warns of coordinates that the file keeps too coarsely.

    Args:
        path: .stl, .obj or .ply; with the extra ``meshes`` .glb, .gltf, .dae and what else trimesh reads; with the
            extra ``newton`` a robot or a world as one of ``MODELS``.
        scale: What coordinates are multiplied by, beside the unit that the format states (COLLADA, 3MF).
        up: Axis of the file that points up, one of ``AXES``; None: the format's, see ``up_of``.

    Raises:
        FileNotFoundError: There is no such file.
        ImportError: What reads it is not installed.
        ValueError: It is no mesh, a corner is not finite, or an argument is wrong.
    """
    path = Path(path)
    if not (math.isfinite(scale) and scale > 0.0):
        raise ValueError(f"scale={scale} of mesh {path} must be above 0")
    if up not in (*AXES, None):
        raise ValueError(f"up={up} of mesh {path} must be {', '.join(AXES)}, or None for what its format says")
    own = _READERS.get(path.suffix.lower())
    if own is None:
        _import("newton" if path.suffix.lower() in MODELS else "trimesh", path)
    if not path.is_file():
        raise FileNotFoundError(f"mesh {path} does not exist")
    vertices, triangles = own(path, path.read_bytes()) if own else _by_library(path)
    if not len(triangles):
        raise ValueError(f"mesh {path} holds no triangles")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ValueError(f"mesh {path} has triangles of vertices that it does not have; it has {len(vertices)}")
    corners = vertices[triangles]
    broken = ~np.isfinite(corners).all((1, 2))
    if broken.any():
        raise ValueError(f"mesh {path} has {broken.sum()} triangles with corners that are not finite; take them out")
    in_float32 = path.suffix.lower() == ".dae" or bool((corners == corners.astype(np.float32)).all())
    if in_float32 and far_origin(scale * corners) is not None:
        said = f"mesh {path} {far_hint(scale * corners)}, and is kept in such numbers"
        warnings.warn(f"{said}: export it near its origin, or as OBJ", stacklevel=3)
    order, signs = AXES[up or up_of(path)]
    return vertices[:, order] * signs * scale, triangles


def up_of(path: str | Path) -> str:
    """Axis that points up in a file as its format says: y in glTF, COLLADA's <up_axis>, z where nothing is said."""
    suffix = Path(path).suffix.lower()
    if suffix != ".dae":
        return "y" if suffix in (".glb", ".gltf") else "z"
    try:
        said = ElementTree.parse(path).getroot().findtext("{*}asset/{*}up_axis", "Y_UP")
    except ElementTree.ParseError as error:
        raise ValueError(f"mesh {path} is not XML: {error}") from None
    return {"X_UP": "x", "Z_UP": "z"}.get(said.strip(), "y")


def unit_hint(path: str | Path, corners: np.ndarray, scale: float, key: str = "scale") -> str:
    """Which scale a mesh probably needs: for its unit, named where its format defines none, or for its size.

    Args:
        path: Of the file.
        corners: (T, 3, 3) m, as read.
        scale: With which they were read.
        key: What it is called.

    Returns:
        One line; "" where the mesh spans from SMALL to LARGE and no other unit than metres is named.
    """
    size = np.ptp(corners.reshape(-1, 3), 0)
    largest, unit = float(size.max()), _named_unit(Path(path)) if scale == 1.0 else ""
    if not unit and (SMALL <= largest <= LARGE or largest == 0.0):
        return ""
    to_a_room = min((1e-6, 1e-3, 1e-2, 1e3, 1e6), key=lambda factor: abs(math.log(largest * factor / ROOM)))
    factor = UNITS.get(unit, to_a_room)
    is_large, would_be = (" x ".join(f"{float(f'{x:.3g}'):.9g}" for x in size * by) for by in (1.0, factor))
    names = f" and names {unit} as its unit" if unit else ""
    return f"mesh {path} is {is_large} m large{names}; {key}={scale * factor:g} would make it {would_be} m"


def _named_unit(path: Path) -> str:
    if path.suffix.lower() not in _READERS:
        return ""
    with path.open("rb") as file:
        words = [word.decode("ascii", "replace").lower() for word in _UNIT.findall(file.read(4096))]
    return next((word for word in words if word in UNITS), "")


def far_origin(corners: np.ndarray) -> np.ndarray | None:
    """An origin (3,), whole metres, near corners (T, 3, 3) m that lie so far away that float32 loses millimetres.

    None where they do not, or where they are spread so widely that another origin would not help.
    """
    if not len(corners):
        return None
    low, high = (edge.astype(np.float64) for edge in (corners.min((0, 1)), corners.max((0, 1))))
    reach = np.abs((low, high)).max()
    return np.round((low + high) / 2.0) if _apart(reach) > 1e-3 and (high - low).max() < reach / 8.0 else None


def far_hint(corners: np.ndarray) -> str:
    """Where corners for which there is a ``far_origin`` lie."""
    reach = float(np.abs(corners).max())
    return f"lies {reach:.0f} m from its origin, where numbers of float32 are {_apart(reach):.2g} m apart"


def _apart(reach: float) -> float:
    return float(np.spacing(np.float32(reach)))


# --- STL, OBJ, PLY ----------------------------------------------------------------------------------------------------


def _stl(path: Path, data: bytes) -> Mesh:
    """Binary where its count of triangles fits its length, whatever its header begins with."""
    count = int.from_bytes(data[80:84], "little")
    if 0 < count * _STL_ROW.itemsize <= len(data) - 84:
        corners = np.frombuffer(data, _STL_ROW, count, 84)["corners"].astype(np.float64)
    else:
        facets, found = len(re.findall(rb"\bfacet\s+normal\b", data, re.IGNORECASE)), _CORNER.findall(data)
        if not facets and count and b"\0" in data:
            raise ValueError(f"mesh {path} ends after {max(len(data) - 84, 0) // 50} of {count} triangles")
        if len(found) != 3 * facets:
            raise ValueError(f"mesh {path} has {len(found)} corners of three numbers in {facets} facets; damaged")
        corners = np.array(found, dtype="S").astype(np.float64).reshape(-1, 3, 3)
    return corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)


def _obj(path: Path, data: bytes) -> Mesh:
    """Vertices and faces; a negative index counts back from the last vertex before its face."""
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    for line in re.sub(r"\\\r?\n", " ", data.decode("utf-8", "replace")).splitlines():
        words = line.partition("#")[0].split()
        try:
            if words[:1] == ["v"]:
                x, y, z = map(float, words[1:4])
                vertices.append([x, y, z])
            elif words[:1] == ["f"]:
                numbers = [int(word.partition("/")[0]) for word in words[1:]]
                polygons.append([k - 1 if k >= 0 else len(vertices) + k for k in numbers])
        except ValueError:
            raise ValueError(f"mesh {path}: {line.strip()!r} is neither a vertex nor a face") from None
    return _triangulated(np.array(vertices).reshape(-1, 3), polygons)


def _ply(path: Path, data: bytes) -> Mesh:
    """Elements vertex and face, text or binary, faces of any numbers of corners."""
    order, elements, body, _ = read_header(path, data)
    at, found = 0, {}
    try:
        if order == "ascii":  # as if it were binary, of float64 alone
            body = np.array(body.split(), dtype="S").astype(np.float64).tobytes()
        for element in elements:
            columns = {p.name: [p.kind] if p.length is None else [p.length, p.kind] for p in element.properties}
            if order == "ascii":
                columns = {name: [np.dtype(np.float64)] * len(kinds) for name, kinds in columns.items()}
            found[element.name], at = _ply_rows(body, at, element.count, columns)
        vertices = np.stack([found["vertex"][axis] for axis in "xyz"], -1).astype(np.float64)
        faces = found.get("face", {})
        polygons = faces.get("vertex_indices", faces.get("vertex_index", []))
    except (ValueError, KeyError, IndexError):
        raise ValueError(
            f"mesh {path} is a PLY file that is cut off, or not one of numbers x, y, z and faces"
        ) from None
    return _triangulated(vertices, polygons)


def _ply_rows(body: bytes, at: int, count: int, kinds: dict[str, list[np.dtype]]) -> tuple[dict, int]:
    """Columns by name of rows that begin ``at`` a byte, and where they end; a list has its length's kind first."""
    if not count:
        return {}, at
    probe, fields = at, list[tuple]()
    for name, (kind, *items) in kinds.items():
        size = int(np.frombuffer(body, kind, 1, probe)[0]) if items else 0
        fields += [(f"{name} size", kind), (name, items[0], (size,))] if items else [(name, kind)]
        probe += kind.itemsize + (size * items[0].itemsize if items else 0)
    row = np.dtype(fields)
    if at + count * row.itemsize <= len(body):  # all lists are as long as those of the first row, perhaps
        rows = np.frombuffer(body, row, count, at)
        if all((rows[f"{name} size"] == row[name].shape[0]).all() for name in kinds if row[name].shape):
            return {name: rows[name] for name in kinds}, at + count * row.itemsize
    columns: dict[str, list] = {name: [] for name in kinds}
    for _ in range(count):
        for name, (kind, *items) in kinds.items():
            value = np.frombuffer(body, kind, 1, at)[0]
            at += kind.itemsize
            for item in items:
                value = np.frombuffer(body, item, int(value), at)
                at += len(value) * item.itemsize
            columns[name].append(value)
    return columns, at


_READERS: dict[str, Callable[[Path, bytes], Mesh]] = {".stl": _stl, ".obj": _obj, ".ply": _ply}


# --- polygons ---------------------------------------------------------------------------------------------------------


def _triangulated(vertices: np.ndarray, polygons: Iterable[Sequence[int]]) -> Mesh:
    """Polygons as triangles that cover them: fans where all corners bend one way, else ears that are cut off."""
    alike: dict[int, list] = {}
    for polygon in polygons:
        alike.setdefault(len(polygon), []).append(polygon)
    parts = [np.empty((0, 3), np.int64)]
    for size, group in alike.items() if len(vertices) else ():
        ids = np.array(group, dtype=np.int64).reshape(-1, size)
        at = vertices.take(ids, 0, mode="clip")
        ahead = np.roll(at, -1, 1) - at
        with np.errstate(invalid="ignore"):  # what is not finite is told later
            normal = np.cross(at - at[:, :1], ahead).sum(1)
            turns = np.cross(np.roll(ahead, 1, 1), ahead)
        bends = np.einsum("mni,mi->mn", turns, normal)
        bent = (bends < -1e-9 * np.square(normal).sum(1, keepdims=True)).any(1) & (size > 3)
        parts += [ids[~bent][:, [0, k, k + 1]] for k in range(1, size - 1)]
        parts += [polygon[_ears(*pair)] for polygon, *pair in zip(ids[bent], at[bent], normal[bent], strict=True)]
    return vertices, np.concatenate(parts)


def _ears(corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Triangles (n - 2, 3) of a polygon (n, 3): corners are cut off behind which no other corner lies."""
    axis = int(np.abs(normal).argmax())
    flat = np.delete(corners, axis, 1)[:, :: 1 if (axis != 1) == (normal[axis] > 0) else -1]  # counter-clockwise

    def side(a: np.ndarray, b: np.ndarray, p: np.ndarray) -> np.ndarray:
        return (b[0] - a[0]) * (p[..., 1] - a[1]) - (b[1] - a[1]) * (p[..., 0] - a[0])

    def is_ear(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> bool:
        others = flat[left][~(flat[left][:, None] == (a, b, c)).all(-1).any(1)]
        within = (side(a, b, others) >= 0) & (side(b, c, others) >= 0) & (side(c, a, others) >= 0)
        return bool(side(a, b, c) > 0 and not within.any())

    left, found = list(range(len(flat))), []
    while len(left) > 2:
        for k in range(len(left)):
            ear = [left[k - 1], left[k], left[(k + 1) % len(left)]]
            if is_ear(*flat[ear]):
                break
        found.append(ear)
        left.remove(ear[1])
    return np.array(found)


# --- trimesh ----------------------------------------------------------------------------------------------------------


def _import(module: str, path: Path) -> None:
    try:
        import_module(module)
    except ImportError:
        line = "pip install 'omnilidar[newton]'" if module == "newton" else "pip install 'omnilidar[meshes]'"
        raise ImportError(f"reading {path} needs {module}: {line}") from None


def _by_library(path: Path) -> Mesh:
    """All parts of a scene, metres; mirrored parts keep their outsides, as glTF says."""
    if path.suffix.lower() in MODELS:
        from .newton import model_triangles

        return model_triangles(path)
    import trimesh

    suffix = path.suffix.lower()
    is_gltf = suffix in (".glb", ".gltf")
    if suffix == ".dae":
        _import("collada", path)
    try:
        refused = _not_read(path) if is_gltf else []
        mesh = None if refused else trimesh.load(path, force="mesh", process=False)
        stated = None if is_gltf else getattr(mesh, "units", None)
        unit = trimesh.units.unit_conversion(stated, "meters") if stated else 1.0
    except ModuleNotFoundError as error:
        raise ImportError(f"reading {path} needs {error.name}: pip install {error.name}") from None
    except Exception as error:  # trimesh raises whatever its parsers meet
        raise ValueError(
            f"mesh {path} cannot be read: it is damaged, or no {suffix} file that trimesh knows"
        ) from error
    if refused:
        raise ValueError(f"mesh {path} has {', '.join(refused)}, which are not read: export it as plain triangles")
    if not isinstance(mesh, trimesh.Trimesh):
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    return np.asarray(mesh.vertices, np.float64) * unit, np.asarray(mesh.faces, np.int64)


def _not_read(path: Path) -> list[str]:
    """What trimesh would leave out of a glTF file or take for something else."""
    data = path.read_bytes()
    head = json.loads(data if path.suffix.lower() == ".gltf" else data[20 : 20 + int.from_bytes(data[12:16], "little")])
    found = [name for name in head.get("extensionsUsed", ()) if name in _NOT_READ]
    if _DRACO in head.get("extensionsUsed", ()) and find_spec("DracoPy") is None:
        found.append(f"{_DRACO} (install DracoPy)")
    parts = [part for mesh in head.get("meshes", ()) for part in mesh["primitives"]]
    positions = [head["accessors"][part["attributes"]["POSITION"]] for part in parts]
    found += ["triangle fans"] if any(part.get("mode") == 6 for part in parts) else []
    return found + ["normalized or sparse positions"] * any(at.get("normalized") or "sparse" in at for at in positions)
