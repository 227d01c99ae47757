"""What a URDF must hold: links and joints that make one tree, and numbers; a ValueError names what does not."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from xml.etree.ElementTree import Element

from omnirobot.common.errors import repeated, suggest

_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_OF_JOINTS = ("lower", "upper", "effort", "velocity", "damping", "friction", "multiplier", "offset")
_NUMBERS = dict.fromkeys(("xyz", "rpy", "size", "scale"), 3)
_NUMBERS |= dict.fromkeys(("radius", "length", "value", *_INERTIA, *_OF_JOINTS), 1)
"""How many numbers an attribute holds."""
_SHAPES = ("box", "cylinder", "sphere", "capsule", "mesh")
_HOLD_NUMBERS = (*_SHAPES, "origin", "mass", "inertia", "axis", "limit", "dynamics", "mimic")
_MOVING = ("revolute", "continuous", "prismatic")
_TYPES = (*_MOVING, "fixed", "floating", "planar")


def check_urdf(robot: Element, path: Path) -> None:
    """Refuses what MuJoCo takes for something else, leaves out, or calls by no name."""
    _check_expanded(robot, path)
    links, joints = robot.findall("link"), robot.findall("joint")
    for part in (*links, *joints):
        named = f"{part.tag} {part.get('name')}"
        if not part.get("name"):
            raise ValueError(f"a <{part.tag}> has no name; give it one")
        for element in part.iter():
            if element.tag in _HOLD_NUMBERS:
                _check_numbers(element, named)
        for geometry in part.findall("*/geometry"):
            if not any(shape.tag in _SHAPES for shape in geometry):
                raise ValueError(f"{named} has a <geometry> that is none of {', '.join(_SHAPES)}")
        for mesh in part.findall("*/geometry/mesh"):
            if not mesh.get("filename"):
                raise ValueError(f"{named} has a <mesh> without filename")
    for kind, parts in (("link", links), ("joint", joints)):
        if twice := repeated([str(part.get("name")) for part in parts]):
            raise ValueError(f"repeated name {twice[0]} of two {kind}s; rename one of the two")
    _check_tree({str(link.get("name")) for link in links}, joints)
    for joint in joints:
        _check_joint(joint, joints)


def expanding(path: Path) -> str:
    """What to do with a xacro file."""
    expanded = path.with_stem(f"{path.stem}_expanded") if path.suffix == ".urdf" else path.with_suffix(".urdf")
    return f"expand it: xacro {path} > {expanded}"


def _check_expanded(robot: Element, path: Path) -> None:
    """Refuses a xacro file, in which values are still to be put in."""
    for element in robot.iter():
        texts = [text for text in element.attrib.values() if "${" in text or "$(" in text]
        if texts or "xacro" in str(element.tag).rpartition("}")[0]:
            where = texts[0] if texts else f"<xacro:{str(element.tag).rpartition('}')[2]}>"
            raise ValueError(f"it is xacro, with {where} in it; {expanding(path)}")


def _check_numbers(element: Element, named: str) -> None:
    for key, count in _NUMBERS.items():
        if (text := element.get(key)) is None:
            continue
        try:
            numbers = [float(word) for word in text.split()]
        except ValueError:
            numbers = []
        endless = key in ("effort", "velocity")
        if len(numbers) != count or any(math.isnan(x) or (math.isinf(x) and not endless) for x in numbers):
            what = "a number" if count == 1 else f"{count} numbers with spaces between"
            raise ValueError(f'{named}: {key}="{text}" of <{element.tag}> must be {what}')


def _check_tree(links: set[str], joints: Iterable[Element]) -> None:
    """Every joint is between two links, and one link alone is no child."""
    children = []
    for joint in joints:
        for end in ("parent", "child"):
            found = joint.find(end)
            name = None if found is None else found.get("link")
            if name not in links:
                given = f"{end} {name}, which is no link; {suggest(name, sorted(links))}" if name else f"no {end} link"
                raise ValueError(f"joint {joint.get('name')} has {given}")
            children += [str(name)] if end == "child" else []
    if twice := repeated(children):
        raise ValueError(f"link {twice[0]} is the child of two joints, which closes a loop; take one of them out")
    roots = sorted(links - set(children))
    if not roots:
        raise ValueError("all of its links are children of joints, which closes a loop; take one of them out")
    if len(roots) > 1:
        raise ValueError(f"{' and '.join(roots)} are the children of no joint; one root was expected, so join them")


def _check_joint(joint: Element, joints: Iterable[Element]) -> None:
    name, kind, axis, mimic = joint.get("name"), joint.get("type"), joint.find("axis"), joint.find("mimic")
    if kind not in _TYPES:
        raise ValueError(f"joint {name} has type {kind}; known: {', '.join(_TYPES)}")
    parent = joint.find("parent")
    if kind == "floating" and parent is not None and parent.get("link") != "world":
        raise ValueError(f"joint {name} is floating; only the root link floats, so give it another type")
    if kind in _MOVING and axis is not None and not any(float(x) for x in axis.get("xyz", "1 0 0").split()):
        raise ValueError(f"joint {name} has an axis of length 0; give it a direction")
    if mimic is not None:
        others = [str(one.get("name")) for one in joints if one is not joint and one.get("type") in _MOVING]
        if kind not in _MOVING or mimic.get("joint") not in others:
            known = suggest(str(mimic.get("joint")), others)
            raise ValueError(f"joint {name} mimics {mimic.get('joint')}; both must turn or slide; {known}")
