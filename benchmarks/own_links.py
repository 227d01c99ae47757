"""What a robot's own links take of its LiDAR's scan, from a robot's file with meshes.

    python -m benchmarks.own_links file=g1.xml body=torso_link pos=0.0003,0,0.4284 rpy=3.14159,0.0511,0 \\
        through=head_link 'joints=*_elbow_joint:0.6,*_shoulder_pitch_joint:0.2'
    python -m benchmarks.own_links file=go2.xml body=base pos=0.28945,0,-0.046825 rpy=0,-2.8782,3.14 \\
        through=head_upper,head_lower 'joints=*_thigh_joint:0.9,*_calf_joint:-1.5'

The robot stands in the first keyframe of its file, or with all joints at zero but for `joints`, in a room of 8 x 8 x
3 m, its lowest point on the floor. Rays hit what the file draws: geoms that do not collide where it has such, else
all. They are cast twice, with the robot and without it, by the same device at the same time, one whole frame.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.harness.table import Table, about, report
from omniperception.cli import Command, argument
from omniperception.common.figures import new_figure
from omniperception.config import ConfigError
from omniperception.lidar import DEVICES, Lidar, LidarConfig, MujocoScene

HALF, HEIGHT = 4.0, 3.0
"""Of the room, metres."""
BANDS_DEG = (-8.0, 2.0, 12.0, 22.0, 32.0, 42.0, 54.0)
OUTPUTS = ("ranges", "points_w", "shape_id", "elevation")


@dataclass(frozen=True)
class Scans:
    """One frame of a sensor on a robot, and of the same sensor without the robot.

    Attributes:
        points_w: m, NaN for a miss, with the robot, (N, 3).
        elevation_deg: In the sensor frame, (N,).
        ranges: m, inf for a miss, with the robot, (N,).
        alone: Likewise without it, (N,).
        link: Name of the robot's link that a ray hits, empty for the room and for a miss, (N,).
        sensor_w: m, (3,).
        outline_w: Vertices of the robot's meshes, m, (V, 3).
    """

    points_w: np.ndarray
    elevation_deg: np.ndarray
    ranges: np.ndarray
    alone: np.ndarray
    link: np.ndarray
    sensor_w: np.ndarray
    outline_w: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    file: Path = argument(doc="the robot's MJCF, with a free base")
    body: str = argument(doc="link that carries the sensor")
    pos: tuple[float, ...] = argument(doc="where in the link, m")
    rpy: tuple[float, ...] = argument((0.0, 0.0, 0.0), "its orientation there, rad")
    through: tuple[str, ...] = argument((), "geoms or meshes that rays pass through: the sensor's housing")
    joints: tuple[str, ...] = argument((), "joints that are not at zero, as name:rad; * stands for any letters")
    device: str = argument("mid360", "sensor", choices=tuple(DEVICES))
    out: Path | None = argument(None, "folder of the results; null: outputs/own_links/<file>")


def in_a_room(file: Path, joints: Sequence[str] = ()) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The robot of a file in the room."""
    if not file.is_file():
        raise FileNotFoundError(f"file={file} does not exist; give the MJCF of a robot")
    spec = mujoco.MjSpec.from_file(str(file))
    walls = {
        "floor": ((HALF, HALF, 0.05), (0.0, 0.0, -0.05)),
        "ceiling": ((HALF, HALF, 0.05), (0.0, 0.0, HEIGHT + 0.05)),
        **{f"wall{s:+d}x": ((0.05, HALF, HEIGHT / 2), (s * (HALF + 0.05), 0.0, HEIGHT / 2)) for s in (-1, 1)},
        **{f"wall{s:+d}y": ((HALF, 0.05, HEIGHT / 2), (0.0, s * (HALF + 0.05), HEIGHT / 2)) for s in (-1, 1)},
    }
    for name, (size, pos) in walls.items():
        spec.worldbody.add_geom(name=f"room_{name}", type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=pos)
    model = spec.compile()
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    if model.njnt == 0 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        raise ConfigError(f"file={file} has no free base as its first joint, so the robot cannot be put on the floor")
    data.qpos[:2] = 0.0
    for given in joints:
        _bend(model, data, given)
    mujoco.mj_kinematics(model, data)
    data.qpos[2] -= min(_lowest(model, data, k) for k in drawn(model))
    mujoco.mj_kinematics(model, data)
    return model, data


def _bend(model: mujoco.MjModel, data: mujoco.MjData, given: str) -> None:
    pattern, _, angle = given.rpartition(":")
    names = [model.joint(k).name for k in range(model.njnt)]
    meant = fnmatch.filter(names, pattern)
    try:
        value = float(angle)
    except ValueError:
        meant = []
    if not meant:
        raise ConfigError(f"joints={given} must be name:rad of a joint; known: {', '.join(filter(None, names))}")
    for name in meant:
        data.qpos[model.joint(name).qposadr[0]] = value


def drawn(model: mujoco.MjModel) -> list[int]:
    """The robot's geoms that rays hit."""
    own = [k for k in range(model.ngeom) if model.geom_bodyid[k] != 0]
    visual = [k for k in own if model.geom_contype[k] == 0 and model.geom_conaffinity[k] == 0]
    return visual or own


def _lowest(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Height of a geom's lowest point: of a mesh its vertices', else its bounding box's, which is never higher."""
    turn = data.geom_xmat[geom].reshape(3, 3)
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        corners = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        return float((corners @ turn[2]).min() + data.geom_xpos[geom][2])
    middle, half = model.geom_aabb[geom][:3], model.geom_aabb[geom][3:]
    return float(data.geom_xpos[geom][2] + turn[2] @ middle - np.abs(turn[2]) @ half)


def scans(given: Arguments) -> Scans:
    """Casts the frame with the robot and without it."""
    model, data = in_a_room(given.file, given.joints)
    names = [model.body(k).name for k in range(model.nbody)]
    if given.body not in names[1:]:
        raise ConfigError(f"body={given.body} is no link of {given.file.name}; known: {', '.join(names[1:])}")
    room = [k for k in range(model.ngeom) if model.geom(k).name.startswith("room_")]
    parts = [k for k in drawn(model) if not _names(model, k) & set(given.through)]
    passed = set().union(*(_names(model, k) for k in range(model.ngeom)))
    unknown = [name for name in given.through if name not in passed]
    if unknown:
        raise ConfigError(f"through={unknown[0]} is neither a geom nor a mesh of {given.file.name}")
    spec = DEVICES[given.device]
    pattern = spec.pattern()
    config = LidarConfig(
        pattern.points_per_frame(spec.period_s),
        spec.period_s,
        spec.min_range,
        spec.max_range,
        _three("pos", given.pos),
        _three("rpy", given.rpy),
    )
    casts = []
    for geoms in (room + parts, room):
        scene = MujocoScene(model, geoms=[*geoms, *_carrier(model, given.body, geoms)], num_threads=2)
        scene.copy_data(data)
        carrier = scene.body_names.index(given.body)
        hidden = range(len(geoms), len(scene.shapes))
        lidar = Lidar(config, pattern, scene, carrier, hidden, outputs=OUTPUTS)
        casts.append((lidar.cast(spec.period_s), scene))
    (frame, scene), (empty, _) = casts
    owner = np.array([names[model.geom_bodyid[k]] if k not in room else "" for k in scene.geom_ids] + [""])
    at = data.body(given.body)
    return Scans(
        frame.points_w[0].numpy(),
        np.degrees(frame.elevation[0].numpy()),
        frame.ranges[0].numpy(),
        empty.ranges[0].numpy(),
        owner[frame.shape_id[0].numpy()],
        at.xpos + at.xmat.reshape(3, 3) @ np.array(given.pos),
        _outline(model, data),
    )


def _outline(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    parts = [np.zeros((0, 3))]
    for k in drawn(model):
        if model.geom_type[k] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.geom_dataid[k]
            first = model.mesh_vertadr[mesh]
            corners = model.mesh_vert[first : first + model.mesh_vertnum[mesh] : 5]
            parts.append(data.geom_xpos[k] + corners @ data.geom_xmat[k].reshape(3, 3).T)
    return np.concatenate(parts)


def _carrier(model: mujoco.MjModel, body: str, geoms: Sequence[int]) -> list[int]:
    """A geom of the carrying link, unseen, so that its pose is known where none of its geoms is cast."""
    own = [k for k in range(model.ngeom) if model.geom_bodyid[k] == model.body(body).id]
    if any(k in geoms for k in own):
        return []
    if not own:
        raise ConfigError(f"body={body} has no geom; name a link that has one")
    return own[:1]


def _names(model: mujoco.MjModel, geom: int) -> set[str]:
    mesh = int(model.geom_dataid[geom]) if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH else -1
    return {model.geom(geom).name, model.mesh(mesh).name if mesh >= 0 else ""} - {""}


def _three(name: str, values: tuple[float, ...]) -> tuple[float, float, float]:
    if len(values) != 3:
        raise ConfigError(f"{name}={','.join(map(str, values))} must be three numbers")
    return values[0], values[1], values[2]


def by_link(found: Scans) -> list[dict]:
    """Rays that each link takes, and from where."""
    rows = []
    for name in sorted(set(found.link) - {""}, key=lambda name: -int((found.link == name).sum())):
        k = found.link == name
        rows.append(
            {
                "link": name,
                "rays": int(k.sum()),
                "%": 100.0 * float(k.mean()),
                "nearest, m": float(found.ranges[k].min()),
            }
        )
    return rows


def by_elevation(found: Scans) -> list[dict]:
    """Returns of the room for each band, without the robot and with it."""
    rows = []
    for low, high in pairwise(BANDS_DEG):
        k = (found.elevation_deg >= low) & (found.elevation_deg < high)
        before, own = k & np.isfinite(found.alone), k & (found.link != "")
        after = k & np.isfinite(found.ranges) & (found.link == "")
        rows.append(
            {
                "elevation in the sensor frame from, deg": low,
                "rays": int(k.sum()),
                "returns of the room without the robot": int(before.sum()),
                "with it": int(after.sum()),
                "on own links, %": 100.0 * float(own.sum() / max(k.sum(), 1)),
            }
        )
    return rows


def draw(found: Scans, name: str, path: Path) -> None:
    """The scan near the robot from the front and from above: the robot's vertices, hits on its links, and the room."""
    own = found.link != ""
    figure = new_figure(9.0, 4.6)
    left, right = figure.subplots(1, 2)
    for axis, (a, b) in ((left, (1, 2)), (right, (0, 1))):
        for points, size, colour, label in (
            (found.points_w[~own & np.isfinite(found.ranges)], 0.5, "#8aa6c1", "room"),
            (found.outline_w, 0.1, "#bbbbbb", "the robot's meshes"),
            (found.points_w[own], 1.5, "#c8452f", "on own links"),
        ):
            count = "" if points is found.outline_w else f", {len(points):,} points"
            axis.scatter(*points[:, [a, b]].T, s=size, c=colour, label=label + count if len(points) else None)
        axis.plot(*found.sensor_w[[a, b]], "k^", ms=5)
        axis.set_aspect("equal")
        axis.set_xlim(-2.5, 2.5)
        axis.set_ylim((-2.5, 2.5) if b == 1 else (-0.1, 2.5))
        axis.set_xlabel(f"{'xyz'[a]} (m)", fontsize=8)
        axis.set_ylabel(f"{'xyz'[b]} (m)", fontsize=8)
        axis.tick_params(labelsize=7)
    left.set_title(f"{name}: across; sensor: black", fontsize=9)
    right.set_title("from above", fontsize=9)
    left.legend(fontsize=7, loc="upper left", bbox_to_anchor=(0.0, -0.25))
    for handle in left.get_legend().legend_handles:
        handle.set_sizes([12.0])
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def main(given: Arguments) -> None:
    """Casts, prints, draws."""
    found = scans(given)
    out = given.out or Path("outputs/own_links") / given.file.stem
    own = found.link != ""
    hidden = own & np.isfinite(found.alone)
    notes = [f"{100.0 * own.mean():.1f} % of the rays end on own links; {hidden.sum():,} would have met the room"]
    title = f"{given.device} on {given.file.stem}"
    tables = [
        Table.of("links", f"{title}: rays that own links take", by_link(found), notes),
        Table.of("elevation", f"{title}: returns with and without own links", by_elevation(found)),
    ]
    report([table for table in tables if table.rows], about(2), out)
    draw(found, title, out / "own_links.png")
    print(f"wrote {out / 'own_links.png'}")


command = Command(main, Arguments, __doc__, errors=(ValueError, FileNotFoundError))

if __name__ == "__main__":
    command()
