"""Reads a robot's file, MJCF or URDF, into a MuJoCo specification whose parts all have names."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from pathlib import Path

import mujoco
import numpy as np

from omniperception.scene.urdf_check import check_urdf, expanding

FRAME = "frame:"
"""Prefix of the sites that mark the frames of fixed links, which are still found when they are fused into others."""
_FREE, _HINGE, _SLIDE = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
_READABLE = (".stl", ".obj", ".msh")
ROUNDING = 1e-3
"""rad: by which a rounded angle may lie beyond the end of its range."""
_ADDED = ("actuator", "geom", "mesh", "pair", "site")
"""Kinds of elements that are added to a robot's."""
_HANDLES = {"classname", "compiler", "frame", "id", "info", "name", "parent", "plugin", "signature", "userdata"}
"""What a default class does not say of its elements; reading some of it from one ends the process."""
_PLAIN = (bool, int, float, str, np.ndarray, mujoco.MjsOrientation)
_LOOPS = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)


def read_robot(path: Path) -> mujoco.MjSpec:
    """The robot of a file; a URDF's root link floats.

    The file's own actuators, sensors, keyframes and physics options (gravity, solver, contacts disabled) are left out,
    and its main default class holds for its own elements alone, not for actuators, ground and obstacles added to them.

    Raises:
        ValueError: one line that names the file, what is wrong with which element, and what to do.
    """
    spec = parse(path)
    _check(spec, path)
    for thing in (*spec.actuators, *spec.sensors, *spec.keys):
        spec.delete(thing)
    clean = mujoco.MjSpec()
    for kind in _ADDED:
        said, usual = getattr(spec.default, kind), getattr(clean.default, kind)
        for name in (name for name in dir(usual) if not name.startswith("_") and name not in _HANDLES):
            if isinstance(value := getattr(usual, name), _PLAIN) or hasattr(value, "value"):  # of an enumeration
                setattr(said, name, value)
    spec.option = clean.option  # how physics is computed is said by `sim`, for every robot alike
    _name_all(spec)
    return spec


def parse(path: Path) -> mujoco.MjSpec:
    """Everything that a file says. A URDF's links keep their visual shapes; its fixed joints fuse them."""
    content = path.read_bytes()
    try:
        declared = content.lstrip().startswith(b"<?xml")  # after what precedes it, too
        root = ElementTree.fromstring(content.lstrip() if declared else content)
    except ElementTree.ParseError as error:
        raise ValueError(f"robot.file={path} {_no_xml(content, error, path)}") from None
    for element in root.iter():  # MuJoCo knows no namespaces
        own, _, name = str(element.tag).rpartition("}")
        element.tag = element.tag if "xacro" in own else name
    try:
        if root.tag == "robot":
            return _parse_urdf(root, path)
        _check_mjcf(root, content, path)
        spec = mujoco.MjSpec.from_file(str(path))
        _check_written_ranges(root, path)  # later, so that what is no number has been told by MuJoCo
        return spec
    except ValueError as error:
        raise _of(path, error) from None


def compile_robot(spec: mujoco.MjSpec, path: str | Path) -> mujoco.MjModel:
    """The compiled model; what MuJoCo refuses is a ValueError in one line with the file's name."""
    try:
        return spec.compile()
    except ValueError as error:
        raise _of(path, error) from None


def lock(spec: mujoco.MjSpec, angles: Mapping[str, float], path: str | Path) -> None:
    """Takes joints out of a robot, whose links stay where the joints are at these angles.

    Args:
        spec: the robot.
        angles: rad, or m of a slide, by joint.
        path: of the file, for errors.
    """
    if not angles:
        return  # nothing to compile for
    known = [joint.name for joint in spec.joints if joint.type in (_HINGE, _SLIDE)]
    for name in sorted(angles.keys() - set(known)):
        raise ValueError(
            f"robot.locked names {name}, which {path} does not have as a hinge or slide; known: {', '.join(known)}"
        )
    for equality in spec.equalities:
        for name in sorted(angles.keys() & {equality.name1, equality.name2}):
            raise ValueError(
                f"robot.locked names {name}, but in {path} {equality.name1} and {equality.name2} follow each other;"
                " take that <equality> or <mimic> out of the file"
            )
    whole = spec.copy()
    whole.compiler.fusestatic = False  # or some links are gone
    model, placed = compile_robot(whole, path), set()
    for joint in [joint for joint in spec.joints if joint.name in angles]:
        angle, body, compiled = angles[joint.name], joint.parent, model.joint(joint.name)
        low, high = compiled.range
        if compiled.limited[0] and not low - ROUNDING <= angle <= high + ROUNDING:
            raise ValueError(f"robot.locked.{joint.name}={angle:g} is outside its range in {path}, {low:g} to {high:g}")
        if body.name not in placed:  # as compiled: without frames, Euler angles and degrees
            placed.add(body.name)
            body.pos, body.quat = model.body(body.name).pos, model.body(body.name).quat
            body.alt = mujoco.MjSpec().worldbody.alt
            if body.frame is not None:
                body.set_frame(body.parent.add_frame())
        shift, turn = _motion(model, joint.name, angle)
        before = [other.name for other in body.joints].index(joint.name)
        for other in body.joints[:before]:  # they turn what this one has moved
            other.pos, other.axis = _rotated(other.pos - shift, _inverse(turn)), _rotated(other.axis, _inverse(turn))
        body.pos = body.pos + _rotated(shift, body.quat)
        mujoco.mju_mulQuat(quat := np.empty(4), body.quat, turn)
        body.quat = quat
        if len(body.joints) == 1:
            body.add_site(name=FRAME + body.name, group=5)
        spec.delete(joint)


def _motion(model: mujoco.MjModel, name: str, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """How a joint moves its link, in the link's frame: (3,) m and a quaternion."""
    joint, turn = model.joint(name), np.array((1.0, 0.0, 0.0, 0.0))
    travel = angle - float(model.qpos0[joint.qposadr[0]])
    if joint.type[0] == _SLIDE:
        return travel * joint.axis, turn
    mujoco.mju_axisAngle2Quat(turn, joint.axis, travel)
    return joint.pos - _rotated(joint.pos, turn), turn


def _rotated(vector: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """(3,) a vector turned by a quaternion."""
    turned = np.empty(3)
    mujoco.mju_rotVecQuat(turned, vector, quat)
    return turned


def _inverse(quat: np.ndarray) -> np.ndarray:
    inverse = np.empty(4)
    mujoco.mju_negQuat(inverse, quat)
    return inverse


def collides(geom: mujoco.MjsGeom) -> bool:
    """Tell whether a geom of the file is there to be touched, not only looked at."""
    return bool(geom.contype or geom.conaffinity)


def drop_unseen(spec: mujoco.MjSpec, ray_groups: Iterable[int] | None) -> None:
    """Takes out the geoms that nothing touches, no ray hits and no mass comes from, and the meshes that only they use.

    Args:
        spec: the robot.
        ray_groups: geom groups that rays can hit; None: what collides.
    """
    seen = set() if ray_groups is None else set(ray_groups)
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    for geom in list(spec.geoms):
        if not (collides(geom) or geom.group in seen or geom.name in paired or _has_mass(spec, geom)):
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in list(spec.meshes):
        if (mesh.name or Path(mesh.file).stem) not in used:
            spec.delete(mesh)


def _has_mass(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> bool:
    """Tell whether the compiler takes a body's mass from a geom of it."""
    inferred = spec.compiler.inertiafromgeom != mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    if geom.parent.explicitinertial:
        inferred = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    weightless = geom.mass == 0 or (math.isnan(geom.mass) and geom.density == 0)
    return inferred and not weightless


def weighs_as_water(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> bool:
    """Tell whether the compiler takes mass from a geom to which the file gives neither mass nor density."""
    return _has_mass(spec, geom) and math.isnan(geom.mass) and geom.density == 1000.0


def carrier(body: mujoco.MjsBody) -> str:
    """Name of the moving link that a body is fixed to, or of the body that moves."""
    while not body.joints and body.parent is not None and body.parent.name != "world":
        body = body.parent
    return body.name


def rigid_geoms(body: mujoco.MjsBody) -> list[mujoco.MjsGeom]:
    """Geoms of a body and of all that is fixed to it."""
    fixed = [child for child in body.bodies if not child.joints]
    return [*body.geoms, *(geom for child in fixed for geom in rigid_geoms(child))]


def _of(path: str | Path, error: ValueError) -> ValueError:
    """What MuJoCo says, with the file's name and what to do."""
    text = " ".join(str(error).split()).partition(" The static bodies of the spec")[0]
    if text.startswith("robot."):
        return error
    hint = next((f"; {hint}" for phrase, hint in _HINTS.items() if re.search(phrase, text, re.IGNORECASE)), "")
    text = _ELEMENT.sub(lambda at: f" ({at['name'] or '<' + (at['tag'] or '') + '>'}{at['line'] or ''})", text)
    return ValueError(f"robot.file={path}: {_HEAD.sub('', text)}{hint}")


_HEAD = re.compile("^(XML )?Error: |Schema violation: ")
_ELEMENT = re.compile(r" Element (name '(?P<name>[^']*)', id \d+|'(?P<tag>[^']*)')(?P<line>, line \d+)?")
_HINTS = {
    "mass and inertia of moving bodies": "give that link a mass and an inertia (<inertial>), or fix its joint",
    "Element 'include'": "put that file there, or take <include> out",
    "could not open|Error opening file": "put the mesh where the file says, or name another place there",
    "repeated name": "rename one of the two",
    "bad format|enough data|too much data": "give numbers, as many as belong there, with spaces between",
    "must be positive": "give it a size, or take it out",
    "inertia must": "give that link the inertia of a body, or take its <inertial> out",
}
"""What to do, by what MuJoCo says."""


def _no_xml(content: bytes, error: ElementTree.ParseError, path: Path) -> str:
    """Why a file is no XML, and what to do."""
    line, column = error.position
    if content.startswith(b"version https://git-lfs"):
        return "is a pointer of Git LFS to the file; fetch it: git lfs pull"
    if "prefix" in str(error) and b"<xacro:" in content:
        return f"is xacro; {expanding(path)}"
    if not _is_utf8(content):
        return f"is not UTF-8 (line {line}); save it as UTF-8, or have its first line say its encoding"
    ends = ": it ends too early" if "no element" in str(error) else ""
    return f"is not XML{ends} (line {line}, column {column}); give an MJCF or a URDF"


def _is_utf8(content: bytes) -> bool:
    try:
        content.decode()
    except UnicodeDecodeError:
        return False
    return True


# --- MJCF and URDF ----------------------------------------------------------------------------------------------------


def _check(spec: mujoco.MjSpec, path: Path) -> None:
    """Refuses what the simulation could only get wrong."""
    for geom in spec.worldbody.geoms:
        raise ValueError(
            f"robot.file={path}: geom {geom.name or 'without a name'} stands in the world, which terrain and obstacles"
            " make; name the robot's own file, not a scene with it"
        )
    if spec.compiler.settotalmass > 0:
        raise ValueError(
            f"robot.file={path}: <compiler settotalmass> would scale the robot by what stands around it; give its links"
            " their masses"
        )
    for tendon in spec.tendons:
        raise ValueError(
            f"robot.file={path}: tendon {tendon.name} is not supported; take it out of the file, or drive its joints"
        )
    for equality in spec.equalities:
        if equality.type in _LOOPS:
            raise ValueError(
                f"robot.file={path}: the {'weld' if equality.type == _LOOPS[1] else 'connect'} of {equality.name1} and"
                f" {equality.name2} closes a loop of links, which is not supported; take it out of the file"
            )
    for joint in spec.joints:
        low, high = joint.range
        if not (low < high or low == high == 0) or not math.isfinite(high - low):
            raise ValueError(
                f"robot.file={path}: joint {joint.name} has a range from {low:g} to {high:g}; give it a low and a high"
                " end, or take it out"
            )
    floating = [body.name for body in spec.bodies if any(joint.type == _FREE for joint in body.joints)]
    if not floating:
        roots = ", ".join(body.name for body in spec.worldbody.bodies) or "no body at all"
        raise ValueError(
            f"robot.file={path}: no body floats (bodies with a free joint: none); put <freejoint/> into the body of the"
            f" base: {roots}"
        )


def _check_mjcf(root: ElementTree.Element, content: bytes, path: Path) -> None:
    """Refuses what MuJoCo cannot read, and numbers that are none, with which it goes on."""
    if root.tag != "mujoco":
        raise ValueError(f"its root is <{root.tag}>; give an MJCF, <mujoco>, or a URDF, <robot>")
    if path.suffix != ".xml":
        raise ValueError(f"MuJoCo reads an MJCF from names that end in .xml; call it {path.stem}.xml")
    if not _is_utf8(content):
        raise ValueError("it is not UTF-8, as MuJoCo reads it; save it as UTF-8")
    for element in root.iter():
        for key, text in element.items():
            if key != "name" and "nan" in text.lower().split():
                raise ValueError(f'<{element.tag}> {element.get("name", "")} has {key}="{text}"; give numbers')


def _check_written_ranges(root: ElementTree.Element, path: Path) -> None:
    """Refuses a joint that says `range="0 0"`, which MuJoCo takes for no limit at all."""
    for world in root.iter("worldbody"):
        for joint in world.iter("joint"):
            written = joint.get("range", "").split()
            if written and all(float(end) == 0 for end in written) and joint.get("limited") != "false":
                raise ValueError(
                    f"robot.file={path}: joint {joint.get('name', 'without a name')} has a range from 0 to 0, which"
                    " MuJoCo takes for no limit; take the joint out to fix its link, or the range to let it turn"
                )


def _name_all(spec: mujoco.MjSpec) -> None:
    """Gives names to what has none, and every link that is fixed to another a site where its frame is."""
    bodies = [body for body in spec.bodies if body.name != "world"]
    _name("body", bodies)
    joints, geoms = {joint.name for joint in spec.joints}, {geom.name for geom in spec.geoms}
    for body in bodies:
        _name(f"{body.name}_joint", body.joints, joints)
        _name(f"{body.name}_geom", body.geoms, geoms)
    for body in bodies:
        if not body.joints:
            body.add_site(name=FRAME + body.name, group=5)


def _name(stem: str, things: Iterable, taken: set[str] | None = None) -> None:
    things = list(things)
    taken = {thing.name for thing in things} if taken is None else taken
    count = 0
    for thing in things:
        if not thing.name:
            while f"{stem}_{count}" in taken:
                count += 1
            thing.name = f"{stem}_{count}"
            taken.add(thing.name)


# --- URDF -------------------------------------------------------------------------------------------------------------


def _parse_urdf(robot: ElementTree.Element, path: Path) -> mujoco.MjSpec:
    """A URDF whose meshes are found, whose visual shapes stay and whose root link floats."""
    check_urdf(robot, path)
    _check_ranges(robot, path)
    _drop_unreadable_visuals(robot)
    for mesh in robot.iter("mesh"):
        mesh.set("filename", str(_mesh_file(mesh.get("filename", ""), path)))
    extension = robot.find("mujoco")
    if extension is None:
        extension = ElementTree.SubElement(robot, "mujoco")
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = ElementTree.SubElement(extension, "compiler")
    for key, value in (("strippath", "false"), ("discardvisual", "false"), ("fusestatic", "true")):
        compiler.set(key, value)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(robot, encoding="unicode"))
    for body in spec.worldbody.bodies:
        if not body.joints:
            body.add_freejoint(name=f"{body.name}_free")
    return spec


def _check_ranges(robot: ElementTree.Element, path: Path) -> None:
    """MuJoCo takes a range from 0 to 0, or of one end, for no limit at all; an end left out is 0, as URDF says."""
    for joint in robot.iter("joint"):
        if joint.get("type") not in ("revolute", "prismatic"):
            continue
        limit = joint.find("limit")
        low, high = (float(limit.get(key, 0)) if limit is not None else 0.0 for key in ("lower", "upper"))
        if limit is None or not low < high:
            raise ValueError(
                f"robot.file={path}: joint {joint.get('name')} has limits from {low:g} to {high:g}; give it a range, or"
                " make it fixed or continuous"
            )
        limit.set("lower", repr(low))
        limit.set("upper", repr(high))


def _drop_unreadable_visuals(robot: ElementTree.Element) -> None:
    """Takes out visual meshes in formats that MuJoCo does not read; they are for looks, and rays see what collides."""
    for link in robot.iter("link"):
        for visual in link.findall("visual"):
            mesh = visual.find("geometry/mesh")
            if mesh is not None and Path(mesh.get("filename", "")).suffix.lower() not in _READABLE:
                link.remove(visual)


def _mesh_file(name: str, path: Path) -> Path:
    """Where a mesh lies that a URDF names as a path, file://, package:// or model://.

    A package is looked for in the folder of the URDF and in those above it, by its name or as that folder itself.
    """
    scheme, _, rest = name.rpartition("://")
    if not scheme or scheme == "file":
        found = path.resolve().parent / rest
        candidates = [found]
    else:
        folders = path.resolve().parents
        inside = rest.partition("/")[2]
        candidates = [folder / part for folder in folders for part in (rest, inside)]
    for candidate in candidates:
        if candidate.is_file():
            if candidate.suffix.lower() not in _READABLE:
                raise ValueError(
                    f"robot.file={path}: mesh {name} is not of a format that MuJoCo reads ({', '.join(_READABLE)});"
                    " convert it"
                )
            return candidate
    raise ValueError(
        f"robot.file={path}: mesh {name} is missing; looked for {candidates[0]}"
        + (f" and in the folders above, down to {candidates[-1]}" if len(candidates) > 1 else "")
    )
