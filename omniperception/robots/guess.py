"""A preset for a robot from its file: what the file says, what its geometry tells, and what has to be guessed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from omniperception.env.mirror import joint_twins
from omniperception.robots.body import Body
from omniperception.robots.gains import REACH, SAG, Gains, gains_of, mass_matrix
from omniperception.robots.pose import BENT, Foot, feet_of, first_pose, standing_pose
from omniperception.robots.stand import Stance, flat_world, stand
from omniperception.scene import RobotConfig
from omniperception.scene.robot_file import FRAME, compile_robot, drop_unseen, parse, read_robot, weighs_as_water
from omniperception.schema import make
from omnirobot.common.cli import argument

SURE, LIKELY, GUESSED = "sure", "likely", "guess"
_POSES = ("home", "stand", "standing", "default", "init")
"""Names of keyframes that are standing poses."""
_LIDARS = ("livox", "mid360", "lidar", "velodyne", "ouster", "hesai")
_SAMPLES = 1500
"""Random poses in which pairs of links are looked for that can touch."""
_STIFFER = (1.0, 1.5, 2.0, 3.0)
"""Factors on the gains, until the robot stands."""
_PACE, _RISE = 2.5, 0.2
"""Hz of the Go2's trot, at a base height of 0.33 m: others step as much slower as legs are longer (the same Froude
number); and how high feet rise as a share of the base's height, ..."""
_MOST_RISE = 0.1
"""... at most so much (m)."""
_ON_TWO, _ON_MORE = (1.0, 0.45, 0.2, 0.15, 1.0), (1.6, 1.1, 0.55, 0.85, 1.5)
"""On two feet and on more: how high feet are lifted on the spot; fastest ahead, back and aside, as a share of the root
of g times the base's height; and rad/s. The G1's and the Go2's."""
_SWING, _SWAY = 0.12, 0.06
"""Room (m) around the default pose that a robot takes while it walks, beside and above it; the Go2's, rounded."""

_FALL = 0.45
"""Share of the base's height below which it has fallen; the Go2's: 0.15 of 0.33 m."""


@dataclass(frozen=True)
class Finding:
    """How a value of the preset was found.

    Attributes:
        key: of the preset.
        how_sure: SURE (the file says so), LIKELY (its geometry tells) or GUESSED.
        why: in a few words.
    """

    key: str
    how_sure: str
    why: str


@dataclass(frozen=True)
class Guess:
    """A preset and what is known about it.

    Attributes:
        preset: of `conf/robot`, plain data.
        findings: how each of its values was found.
        standing: how the robot stands with it.
        notes: what else is to be known.
    """

    preset: Mapping[str, object]
    findings: tuple[Finding, ...]
    standing: Stance
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Options:
    """What the user can say about a preset."""

    joints: tuple[str, ...] = argument((), "actuated joints; none given: those with an actuator in the file, or all")
    frequency: float = argument(2.0, "of a joint, with what hangs on it, as a spring (Hz)", positive=True)
    damping_ratio: float = argument(0.5, "of that spring; 1 is critical", positive=True)
    self_collision: bool = argument(True, "whether links that can touch each other do")
    lidar: str | None = argument(None, "link that carries the LiDAR; null: the highest of no leg or arm")


def guess(file: Path, written: str, options: Options = Options()) -> Guess:
    """The preset of the robot in a file.

    Args:
        file: MJCF or URDF.
        written: how the preset names it.
        options: of the user.

    Raises:
        ValueError: one line that says what is wrong with the file or the options.
    """
    raw, spec = parse(file), read_robot(file)
    drop_unseen(spec, None)
    body = Body(compile_robot(spec, file))
    if not body.touchable:
        raise ValueError(
            f"robot.file={file}: no geom collides (contype=0 conaffinity=0 for all), so that nothing carries the robot;"
            " give its feet geoms that collide"
        )
    joints, by_joint = _actuated(body, raw, file, options)
    pose, by_pose = _start(body, raw)
    body.place(pose)
    feet = feet_of(body)
    if not feet:
        raise ValueError(f"robot.file={file}: no link below the base {body.model.body(body.base).name} can be touched")
    if by_pose.how_sure == GUESSED:
        pose = standing_pose(body, pose, feet)
    twins, notes = _twins(body)
    if twins is not None:
        pose = _symmetric(pose, body, *twins)
    pose = {joint: round(float(np.clip(angle, *body.limits(joint))), 3) for joint, angle in pose.items()}
    body.place(pose)
    return _stiffened_until_standing(
        _Draft(body, raw, file, written, options, joints, feet, pose, twins), (by_joint, by_pose), notes
    )


@dataclass(frozen=True)
class _Draft:
    """What a preset is made of."""

    body: Body
    raw: mujoco.MjSpec
    file: Path
    written: str
    options: Options
    joints: list[int]
    feet: list[Foot]
    pose: dict[int, float]
    twins: tuple[np.ndarray, np.ndarray] | None


def _stiffened_until_standing(draft: _Draft, findings: tuple[Finding, ...], notes: list[str]) -> Guess:
    """The preset with the softest of some gains with which the robot stands."""
    body = draft.body
    gains = gains_of(body, draft.raw, draft.joints, draft.feet, draft.options.frequency, draft.options.damping_ratio)
    fixed, found = _described(draft, gains)
    for factor in _STIFFER:
        preset = fixed | _numbers(draft, gains, factor)
        standing, _ = stand(flat_world(make(RobotConfig, preset, "robot", ())))
        if standing.steady:
            break
    if factor > 1:
        notes.append(f"gains are {factor:g} times as stiff as asked for, because the robot did not stand with less")
    if not standing.steady:
        notes.append(
            f"THE ROBOT DOES NOT STAND: after 2 s its base is at {standing.height:.2f} m, inclined by"
            f" {np.degrees(standing.tilt):.0f} deg; give another default_joint_pos, larger gains or torque limits"
        )
    return Guess(preset, (*findings, *found), standing, tuple(notes))


# --- joints and pose --------------------------------------------------------------------------------------------------


def _actuated(body: Body, raw: mujoco.MjSpec, file: Path, options: Options) -> tuple[list[int], Finding]:
    names = {body.name(joint): joint for joint in body.joints}
    if options.joints:
        unknown = sorted(set(options.joints) - names.keys())
        if unknown:
            raise ValueError(f"joints={','.join(unknown)} are no hinges or slides of {file}; known: {', '.join(names)}")
        return [names[name] for name in options.joints], Finding("joints", SURE, "as asked for")
    driven = [actuator.target for actuator in raw.actuators if actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT]
    chosen = [names[name] for name in dict.fromkeys(driven) if name in names]
    if chosen:
        passive = len(names) - len(chosen)
        return chosen, Finding("joints", SURE, f"those with an actuator in the file; {passive} passive")
    following = {joined.name1 for joined in raw.equalities if joined.type == mujoco.mjtEq.mjEQ_JOINT}
    free = [joint for name, joint in names.items() if name not in following]
    if not free:
        raise ValueError(f"robot.file={file} has no hinge or slide that could be driven")
    some = f", {len(names) - len(free)} follow others (<mimic>, <equality>)" if len(free) < len(names) else ""
    return free, Finding("joints", LIKELY, f"all hinges and slides; the file has no actuators{some}")


def _start(body: Body, raw: mujoco.MjSpec) -> tuple[dict[int, float], Finding]:
    """A keyframe that stands, or a pose from which to look for one."""
    for key in raw.keys:
        if key.name.lower() in _POSES and len(key.qpos) == body.model.nq:
            angles = {joint: float(key.qpos[body.model.jnt_qposadr[joint]]) for joint in body.joints}
            return angles, Finding("default_joint_pos", SURE, f"the file's keyframe {key.name}")
    why = (
        f"legs at {100 * BENT[True]:.0f} % ({100 * BENT[False]:.0f} % of two feet) of their length, feet below the"
        " centre of mass"
    )
    return first_pose(body), Finding("default_joint_pos", GUESSED, why)


def _twins(body: Body) -> tuple[tuple[np.ndarray, np.ndarray] | None, list[str]]:
    """Mirror image of each joint, if the robot has one, and how well its masses are mirrored."""
    names = [body.name(joint) for joint in body.joints]
    try:
        index, sign = joint_twins(body.model, body.model.body(body.base).name, names)
    except ValueError:
        return None, ["the robot is not its own mirror image, left for right: train with ppo.symmetry=false"]
    error = mirror_error(body, index, sign)
    pairs = sum(int(k != j) for j, k in enumerate(index)) // 2
    return (index, sign), [
        f"left-right symmetry: {pairs} pairs of joints; mass matrices of mirrored poses differ by {100 * error:.1f} %"
        + (": ppo.symmetry=true is worth it" if error < 0.1 else ": ppo.symmetry=true would teach what is not so")
    ]


def mirror_error(body: Body, index: np.ndarray, sign: np.ndarray, poses: int = 20) -> float:
    """Largest difference of the mass matrices of a pose and its mirror image, among joints, relative to the largest."""
    model, data, rng = body.model, body.data, np.random.default_rng(0)
    dofs = model.jnt_dofadr[body.joints]
    worst = 0.0
    for _ in range(poses):
        q = np.array([rng.uniform(*body.limits(joint)) for joint in body.joints])
        both = []
        for angles in (q, q[index] * sign):
            body.place(dict(zip(body.joints, angles.tolist(), strict=True)))
            both.append(mass_matrix(model, data)[np.ix_(dofs, dofs)])
        image = both[1][np.ix_(index, index)] * np.outer(sign, sign)
        worst = max(worst, float(np.abs(both[0] - image).max() / np.abs(both[0]).max()))
    return worst


def _symmetric(pose: dict[int, float], body: Body, index: np.ndarray, sign: np.ndarray) -> dict[int, float]:
    """The mean of a pose and its mirror image."""
    q = np.array([pose[joint] for joint in body.joints])
    return dict(zip(body.joints, ((q + sign * q[index]) / 2).tolist(), strict=True))


# --- the preset -------------------------------------------------------------------------------------------------------


def _described(draft: _Draft, gains: Gains) -> tuple[dict[str, object], list[Finding]]:
    """All of the preset but its numbers by joint."""
    body, model = draft.body, draft.body.model
    soles = {foot.link: [model.geom(geom).name for geom in body.soles(foot.link)] for foot in draft.feet}
    feet: list[object] = [names[0] if len(names) == 1 else names for names in soles.values()]
    carrying = {name for names in soles.values() for name in names}
    others = [model.geom(geom).name for geom in body.touchable if model.geom(geom).name not in carrying]
    height = float(-body.ground())
    places = np.abs([foot.place(body)[:2] for foot in draft.feet]).mean(0)
    edges = [np.abs(body.bounds(body.geoms(foot.link))).max(0)[:2] for foot in draft.feet]
    gait = _gait(draft, height)
    low, high = body.bounds(body.touchable)
    length, width = (high - low)[:2]
    pairs = self_collisions(body, draft.pose) if draft.options.self_collision else []
    mounts, by_mount = _mounts(draft)
    preset: dict[str, object] = {
        "file": draft.written,
        "base": model.body(body.base).name,
        "joints": [body.name(joint) for joint in draft.joints],
        "default_joint_pos": {body.name(joint): draft.pose[joint] for joint in _posed(draft)},
        "base_height": round(height, 3),
        "min_base_height": round(_FALL * height, 3),
        "footprint": [round(float(places[0]), 2), round(float(places[1]), 2)],
        "footing": round(float(np.linalg.norm(np.max(edges, 0))) + 0.05, 2),
        "outline": [round(_SWING + float(reach), 2) for reach in (-low[0], high[0], max(-low[1], high[1]))],
        "height": round(height + float(high[2]) + _SWAY, 2),
        "radius": round(0.5 * float(width), 2),
        "half_length": round(0.5 * max(float(length - width), 0.0), 2),
        "foot_geoms": feet,
        "gait": gait,
        "penalized_geoms": others,
        "self_collision": [list(pair) for pair in pairs],
        "mounts": mounts,
    }
    named = all("foot" in name.lower() or "toe" in name.lower() for name in carrying)
    limits = f"{int(gains.said.sum())} of {len(gains.said)} are the file's; the others from weight and length"
    rate, ratio = draft.options.frequency, draft.options.damping_ratio
    findings = [
        Finding("base", SURE, "the body with the free joint"),
        _on_masses(draft),
        Finding("foot_geoms", SURE if named else LIKELY, f"what reaches down as far as the lowest; {len(feet)} feet"),
        Finding("penalized_geoms", LIKELY, "all other geoms that collide"),
        Finding("base_height", LIKELY, "the lowest point of the default pose"),
        Finding("min_base_height", GUESSED, f"{100 * _FALL:.0f} % of base_height"),
        Finding("footprint, footing", LIKELY, "where the feet are"),
        Finding("outline", GUESSED, f"what collides, in the default pose, and {_SWING:g} m"),
        Finding("height", GUESSED, f"likewise, and {_SWAY:g} m"),
        Finding("radius, half_length", GUESSED, "half of its width; half of what it is longer than wide"),
        Finding(
            "gait",
            GUESSED,
            "feet beside and behind each other in turn, as fast as legs are long; so are its velocities",
        ),
        Finding("torque_limits", SURE if gains.said.all() else GUESSED, limits),
        Finding("kp, kv", GUESSED, f"springs of {rate:g} Hz, damping ratio {ratio:g}, or sag under {SAG:g} rad"),
        Finding("action_scale", GUESSED, f"{REACH:g} torque limit / kp"),
        Finding("armature", *((SURE, "the file's") if gains.armature is None else (GUESSED, "from the torque limits"))),
        _on_self_collision(draft, pairs),
        by_mount,
    ]
    return preset, findings


def _gait(draft: _Draft, height: float) -> dict[str, object]:
    """A rhythm in which feet beside and behind each other step in turn: a walk on two, a trot on four, tripods on six.

    Args:
        draft: the preset so far, its body in the default pose.
        height: of the base (m).
    """
    body = draft.body
    places = np.array([foot.place(body) for foot in draft.feet])
    centre = float(np.mean([body.data.geom_xpos[body.soles(foot.link), 2].mean() for foot in draft.feet]))
    left = places[:, 1] > 0
    before = [int(((left == left[k]) & (places[:, 0] > place[0] + 0.01)).sum()) for k, place in enumerate(places)]
    offsets = [0.5 * ((rank + (not is_left)) % 2) for rank, is_left in zip(before, left, strict=True)]
    return {
        "frequency": round(_PACE * float(np.sqrt(0.33 / height)), 1),
        "offsets": offsets,
        "duty": 0.5,
        "foot_height": round(height + centre + min(_RISE * height, _MOST_RISE), 3),
        **_pace(len(places), height),
    }


def _pace(feet: int, height: float) -> dict[str, object]:
    """How fast a robot shall walk: with the root of its height, as its legs' pendulum."""
    lift, ahead, back, aside, turn = _ON_TWO if feet <= 2 else _ON_MORE
    natural = float(np.sqrt(9.81 * height))
    x = [-round(back * natural, 1), round(ahead * natural, 1)]
    y = round(aside * natural, 1)
    return {"lift": lift, "lin_vel_x": x, "lin_vel_y": [-y, y], "ang_vel_z": [-turn, turn]}


def _on_masses(draft: _Draft) -> Finding:
    spec = read_robot(draft.file)
    guessed = [link.name for link in spec.bodies if any(weighs_as_water(spec, geom) for geom in link.geoms)]
    if not guessed:
        return Finding("masses", SURE, "the file's")
    spec.compiler.fusestatic = False  # or some links are gone
    model = compile_robot(spec, draft.file)
    masses = ", ".join(f"{name} {model.body(name).mass[0]:.3g} kg" for name in guessed)
    return Finding("masses", GUESSED, f"without <inertial> the volume times 1000 kg/m3, of water: {masses}")


def _on_self_collision(draft: _Draft, pairs: list[tuple[str, str]]) -> Finding:
    if not draft.options.self_collision:
        return Finding("self_collision", SURE, "none, as asked for: links pass through each other")
    return Finding(
        "self_collision",
        LIKELY,
        f"{len(pairs)} pairs of links touch in {_SAMPLES} random poses, not in the default one",
    )


def _posed(draft: _Draft) -> list[int]:
    """Joints of the default pose: the actuated ones, and passive ones that are not at 0."""
    passive = [joint for joint in draft.body.joints if joint not in draft.joints and draft.pose[joint] != 0]
    return [*draft.joints, *passive]


def _numbers(draft: _Draft, gains: Gains, factor: float) -> dict[str, object]:
    """Numbers by joint, the same for mirror images; one number where all are the same."""
    kp = factor * gains.kp
    values = {
        "kp": kp,
        "kv": np.sqrt(factor) * gains.kv,
        "torque_limits": gains.torque_limits,
        "action_scale": gains.action_scale / factor,
        "armature": gains.armature,
    }
    found: dict[str, object] = {}
    for key, value in values.items():
        if value is None:
            continue
        rounded = [float(f"{x:.3g}") for x in _mirrored_mean(draft, value)]
        names = [draft.body.name(joint) for joint in draft.joints]
        found[key] = rounded[0] if len(set(rounded)) == 1 else dict(zip(names, rounded, strict=True))
    return found


def _mirrored_mean(draft: _Draft, values: np.ndarray) -> list[float]:
    by_joint = dict(zip(draft.joints, values.tolist(), strict=True))
    if draft.twins is None:
        return list(by_joint.values())
    twin = {joint: draft.body.joints[k] for joint, k in zip(draft.body.joints, draft.twins[0], strict=True)}
    return [(value + by_joint.get(twin[joint], value)) / 2 for joint, value in by_joint.items()]


def self_collisions(body: Body, pose: dict[int, float]) -> list[tuple[str, str]]:
    """Pairs of links, as the file lets them collide, that touch in random poses and not in `pose`, by name."""
    rng = np.random.default_rng(0)
    body.place(pose)
    always = _touching(body)
    found: dict[tuple[int, int], int] = {}
    for _ in range(_SAMPLES):
        body.place({joint: rng.uniform(*body.limits(joint)) for joint in body.joints})
        for pair in _touching(body) - always:
            found[pair] = found.get(pair, 0) + 1
    name = body.model.body
    return [(name(a).name, name(b).name) for a, b in sorted(found)]


def _touching(body: Body) -> set[tuple[int, int]]:
    mujoco.mj_collision(body.model, body.data)
    links = body.model.body_weldid[body.model.geom_bodyid[body.data.contact.geom]]
    return {(int(min(pair)), int(max(pair))) for pair in links}


# --- places for a LiDAR -----------------------------------------------------------------------------------------------


def _mounts(draft: _Draft) -> tuple[dict[str, object], Finding]:
    """Places by the names that the presets of LiDARs ask for, on the link that carries them."""
    body, model = draft.body, draft.body.model
    link, frame, why = _lidar_link(draft)
    geoms = body.geoms(link)
    low, high = body.bounds(geoms, link) if geoms else (np.full(3, -0.05), np.full(3, 0.05))
    middle, deep = float((low[0] + high[0]) / 2), float((low[2] + high[2]) / 2)
    front, top = float(high[0]), float(high[2])
    names = [model.geom(geom).name for geom in body.touchable]
    carrier = model.body(link).name
    on = {} if link == int(model.body_weldid[body.base]) else {"body": carrier}

    def at(x: float, z: float, **more: object) -> dict[str, object]:
        return {"pos": [round(x, 4), 0.0, round(z, 4)], **more, **on}

    mounts: dict[str, object] = {
        "head": at(front + 0.04, deep, rpy=[0.0, -2.8782, 3.14]),
        "forehead": at(front, top + 0.04, rpy=[0.0, 0.349066, 0.0]),
        "front": at(0.8 * front, top + 0.06),
        "back": at(middle, top + 0.06),
        "above": at(middle, top + 0.4, exclude_geoms=names),
    }
    if frame is not None:
        housing = [geom.name for link in read_robot(draft.file).bodies if link.name == frame for geom in link.geoms]
        mounts["head"] = {"pos": [0.0, 0.0, 0.0], "body": frame} | ({"exclude_geoms": housing} if housing else {})
    return mounts, Finding("mounts", SURE if frame or draft.options.lidar else GUESSED, why)


def _lidar_link(draft: _Draft) -> tuple[int, str | None, str]:
    """The link that carries the LiDAR, a frame of the file that is a LiDAR's, and why."""
    body, model, wanted = draft.body, draft.body.model, draft.options.lidar
    if wanted is not None:
        known = [link.name for link in draft.raw.bodies[1:]]
        if wanted not in known:
            raise ValueError(f"lidar={wanted} is no link of {draft.file}; known: {', '.join(known)}")
        carrier = _carrier(body, wanted)
        if model.body(carrier).name == wanted:
            return carrier, None, f"around {wanted}, as asked for"
        return carrier, wanted, f"head is {wanted}, as asked for; the others around {model.body(carrier).name}"
    for link in draft.raw.bodies:
        if any(word in link.name.lower() for word in _LIDARS):
            carrier = _carrier(body, link.name)
            return (
                carrier,
                link.name,
                f"head is the file's frame {link.name}; the others around {model.body(carrier).name}",
            )
    legs = {link for foot in draft.feet for link in body.above(foot.link)[:-1]}
    free = [geom for geom in body.touchable if body.link(geom) not in legs and body.link(geom) not in body.ends()]
    free = free or [geom for geom in body.touchable if body.link(geom) == int(model.body_weldid[body.base])]
    link = body.link(max(free, key=lambda geom: body.bounds([geom])[1][2])) if free else body.base
    return link, None, f"around {model.body(link).name}, the highest link of no leg or arm"


def _carrier(body: Body, link: str) -> int:
    """The moving link that a link of the file belongs to, which may have been fused into it."""
    named = mujoco.mj_name2id(body.model, mujoco.mjtObj.mjOBJ_BODY, link)
    if named < 1:
        named = int(body.model.site_bodyid[body.model.site(FRAME + link).id])
    return int(body.model.body_weldid[named])
