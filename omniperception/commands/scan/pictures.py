"""Pictures of a LiDAR's pattern over time and of one scan of a demonstration scene, and the scan as a point cloud."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from omnilidar import Lidar, ScanPattern, write_points
from omnilidar.clouds import table_of
from omniperception.commands.scan.room import COLOURS, DemoClass, DemoScene
from omniperception.common.rotations import rotate
from omniperception.env.sensing import SensorConfig
from omnirobot.common.figures import new_figure, save_figure

DURATIONS_S = (0.1, 0.5, 1.0)
CAMERA, TARGET, FOCAL = (-4.3, -6.2, 5.0), (0.85, -0.35, 0.15), 1.34
"""The camera of the picture from outside: position and where it looks, metres, and focal length over half its width."""
TO_LIGHT = (-0.45, -0.55, 0.70)
PIXELS = (1200, 660)
OUTPUTS = ("ranges", "valid", "points_w", "class_id", "shape_id", "intensity", "row", "time_s")


@dataclass(frozen=True)
class Scan:
    """The points of a scan that hit something, P of them, and where they came from.

    Attributes:
        name: Of the sensor.
        seconds: How long it measured.
        num_rays: How many rays it cast.
        sensor_w: Where it is, metres, (3,).
        points_w: Metres, the robot standing at the origin, (P, 3).
        ranges: Metres, (P,).
        class_id: What was hit, a ``DemoClass``, (P,).
        shape_id: Which shape of the scene, (P,).
        intensity: 1 is a white wall seen perpendicularly at 10 m, (P,).
        across, along: Where in the sensor's field of view, see ``_coordinates``, (P,) each.
        labels: Names and units of these two.
        time_s: Since the scan's beginning, (P,).
    """

    name: str
    seconds: float
    num_rays: int
    sensor_w: np.ndarray
    points_w: np.ndarray
    ranges: np.ndarray
    class_id: np.ndarray
    shape_id: np.ndarray
    intensity: np.ndarray
    time_s: np.ndarray
    across: np.ndarray
    along: np.ndarray
    labels: tuple[str, str]


def take_scan(
    name: str,
    sensor: SensorConfig,
    demo: DemoScene,
    seconds: float | None = None,
    num_rays: int | None = None,
    seed: int = 0,
) -> Scan:
    """Scans the demonstration scene from the robot that stands in it.

    Args:
        name: Of the sensor.
        sensor: Its preset.
        demo: The scene.
        seconds: How long it measures; one frame if None.
        num_rays: How many of the points of that time are kept; all if None.
        seed: Of the time at which the device is, and of random choices.
    """
    seconds = seconds or sensor.period_s
    pattern = sensor.scan_pattern()
    config = replace(sensor, period_s=seconds, num_rays=num_rays or pattern.points_per_frame(seconds))
    excluded = demo.robot.built_geoms(sensor.exclude_geoms, demo.robot_geoms)
    carrier = demo.bodies[sensor.mount_body or demo.robot.base]
    lidar = Lidar(
        config,
        pattern,
        demo.scene,
        carrier,
        exclude_shapes=[demo.robot_geoms[geom] for geom in excluded],
        seed=seed,
        outputs=OUTPUTS,
        reflectivity=demo.reflectivity,
    )
    frame = lidar.cast(torch.full((1,), seconds, dtype=torch.float64))
    assert frame.valid is not None  # asked for
    hit = frame.valid[0]
    values = {key: getattr(frame, key)[0][hit].numpy() for key in OUTPUTS if key != "valid"}
    across, along, labels = _coordinates(pattern)
    rows = values.pop("row")
    at, turn = demo.scene.body_pos[0, carrier], demo.scene.body_quat[0, carrier]
    return Scan(
        name,
        seconds,
        config.num_rays,
        (at + rotate(turn[None], at.new_tensor([config.mount_pos]))[0]).numpy(),
        **values,
        across=across[rows],
        along=along[rows],
        labels=labels,
    )


def write_scan(
    scan: Scan, sensor: SensorConfig, demo: DemoScene, out: Path, colour: str = "class", suffix: str = "ply"
) -> None:
    """Writes ``pattern.png``, ``scan.png`` and the points, coloured by "class" or by "height", into ``out``."""
    draw_pattern(scan.name, sensor.scan_pattern(), out / "pattern.png")
    draw_scan(scan, demo, out / "scan.png")
    rgb = _class_colours(scan) if colour == "class" else _height_colours(scan, demo)
    points = scan.points_w + demo.origin if demo.origin.any() else scan.points_w  # float32 where it keeps millimetres
    columns = dict(zip("xyz", points.T, strict=True))
    columns |= dict(zip(("red", "green", "blue"), (255.0 * rgb).round().astype(np.uint8).T, strict=True))
    columns |= {"class_id": scan.class_id, "intensity": scan.intensity, "time_s": scan.time_s}
    write_points(out / f"scan.{suffix}", table_of(columns, "points_w"))


def summary(scan: Scan) -> str:
    """Number of points by class, in one line."""
    counts = np.bincount(scan.class_id, minlength=len(DemoClass))
    parts = ", ".join(f"{kind.name.lower()} {counts[kind]:,}" for kind in DemoClass if counts[kind])
    hits = len(scan.ranges)
    reach = f", {scan.ranges.min():.2f} to {scan.ranges.max():.2f} m" if hits else ""
    return f"{scan.name}: {hits:,} of {scan.num_rays:,} rays hit in {scan.seconds:g} s{reach}: {parts or 'nothing'}"


def draw_pattern(name: str, pattern: ScanPattern, path: Path) -> None:
    """Directions of the sensor after each of ``DURATIONS_S``; where its parallel rays start, for a height scanner."""
    across, along, labels = _coordinates(pattern)
    shape = np.ptp(across) / max(np.ptp(along), 1e-6)
    figure = new_figure(float(np.clip(3.9 * shape, 3.6, 5.2)) * len(DURATIONS_S) + 1.2, 4.6)
    axes = figure.subplots(1, len(DURATIONS_S), sharex=True, sharey=True)
    for axis, seconds in zip(axes, DURATIONS_S, strict=True):
        count = pattern.points_per_frame(seconds)
        rows = np.arange(min(count, pattern.num_rows))
        share = rows / pattern.points_per_second / seconds
        size = float(np.clip(20_000.0 / len(rows), 0.3, 9.0))
        marks = axis.scatter(
            across[rows], along[rows], s=size, c=share, cmap="viridis", vmin=0.0, vmax=1.0, linewidths=0
        )
        repeated = f" in {pattern.num_rows:,} directions" if count > pattern.num_rows else ""
        axis.set(title=f"{seconds:g} s: {count:,} points{repeated}", xlabel=labels[0])
        if np.ptp(across) < 180.0:
            axis.set_aspect("equal")
    axes[0].set_ylabel(labels[1])
    figure.colorbar(marks, ax=axes, label="time of the point / time shown", pad=0.01)
    figure.suptitle(f"{name}: scan pattern, {pattern.points_per_second:,.0f} points/s")
    save_figure(figure, path)


def _coordinates(pattern: ScanPattern) -> tuple[np.ndarray, np.ndarray, tuple[str, str]]:
    """Azimuth in [-180, 180) and elevation of each row, degrees; of parallel rays where they start, metres."""
    if pattern.origins_s is not None:
        x, y, _ = pattern.origins_s.numpy().T
        return x, y, ("start of the ray, x, m", "start of the ray, y, m")
    azimuth, elevation = (np.degrees(angle.numpy()) for angle in (pattern.azimuth, pattern.elevation))
    return (azimuth + 180.0) % 360.0 - 180.0, elevation, ("azimuth, deg", "elevation, deg")


def draw_scan(scan: Scan, demo: DemoScene, path: Path) -> None:
    """The points in the room from outside, as the sensor sees them, and from above."""
    figure = new_figure(14.0, 11.6)
    (upper,), (lower,) = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.55, 1.0))
    if demo.mesh is None:
        _draw_outside(upper.subplots(), scan, demo, _picture(demo), mark_area=60_000.0)
    else:
        _draw_points(upper.subplots(subplot_kw={"projection": "3d"}), scan)
    seen, above = lower.subplots(1, 2, width_ratios=(1.25, 1.0))
    _draw_ranges(seen, scan)
    _draw_from_above(above, scan, demo)
    figure.set_layout_engine("constrained", w_pad=0.12)
    figure.suptitle(
        f"{scan.name}: one scan of {scan.seconds:g} s, {len(scan.ranges):,} of {scan.num_rays:,} rays hit", fontsize=14
    )
    save_figure(figure, path)


def draw_comparison(scans: Sequence[Scan], demo: DemoScene, path: Path) -> None:
    """Several sensors' points in the room from outside, two beside each other."""
    rows = math.ceil(len(scans) / 2)
    figure = new_figure(14.0, 4.2 * rows)
    picture = _picture(demo) if demo.mesh is None else None
    kind = None if demo.mesh is None else {"projection": "3d"}
    panels = figure.subplots(rows, 2, squeeze=False, subplot_kw=kind).ravel()
    for axis, scan in zip(panels, scans, strict=False):
        if picture is None:
            _draw_points(axis, scan)
        else:
            _draw_outside(axis, scan, demo, picture, mark_area=16_000.0)
        axis.set_title(f"{scan.name}, {scan.seconds:g} s: {len(scan.ranges):,} of {scan.num_rays:,} rays hit")
    for axis in panels[len(scans) :]:
        axis.set_axis_off()
    save_figure(figure, path, dpi=100)


def _draw_outside(axis, scan: Scan, demo: DemoScene, picture: np.ndarray, mark_area: float) -> None:
    hidden = np.isin(scan.shape_id, demo.open_side)
    shown = ~hidden & _visible_from_camera(scan.points_w, demo)
    axis.imshow(picture, interpolation="bilinear")
    column, row = _project(scan.points_w)
    for kind in (kind for kind in DemoClass if (scan.class_id == kind).any()):
        of_kind = scan.class_id == kind
        label = f"{kind.name.lower()}: {of_kind.sum():,}"
        drawn = of_kind & shown
        axis.scatter(column[drawn], row[drawn], s=_dot(scan, mark_area), c=COLOURS[kind], linewidths=0, label=label)
    column, row = _project(scan.sensor_w[None])
    axis.plot(column, row, "*", color="red", markeredgecolor="white", markersize=11, linestyle="none", label="sensor")
    axis.set(xlim=(0, PIXELS[0]), ylim=(PIXELS[1], 0))
    axis.set_axis_off()
    legend = axis.legend(loc="upper right", title="points by what they hit", fontsize=8, title_fontsize=8)
    for handle in legend.legend_handles[:-1]:
        handle.set_sizes([30.0])
    note = f"not drawn: {hidden.sum():,} points on the ceiling and the two near walls"
    axis.text(0.01, 0.01, note, transform=axis.transAxes, fontsize=8, color="#555555")


def _draw_points(axis, scan: Scan) -> None:
    """Points by height, where no picture of the surroundings is drawn."""
    x, y, z = scan.points_w.T
    marks = axis.scatter(x, y, z, s=_dot(scan), c=z, cmap="viridis", linewidths=0)
    axis.plot(*scan.sensor_w[:, None], "*", color="red", markersize=11)
    axis.set(xlabel="x, m", ylabel="y, m", zlabel="z, m", aspect="equal")
    axis.figure.colorbar(marks, ax=axis, label="height, m", shrink=0.7)


def _draw_ranges(axis, scan: Scan) -> None:
    marks = axis.scatter(scan.across, scan.along, s=_dot(scan), c=scan.ranges, cmap="turbo", linewidths=0)
    axis.set(title="what the sensor sees", xlabel=scan.labels[0], ylabel=scan.labels[1])
    if len(scan.across) and np.ptp(scan.across) < 180.0:
        axis.set_aspect("equal", adjustable="datalim")
    axis.figure.colorbar(marks, ax=axis, label="range, m")


def _draw_from_above(axis, scan: Scan, demo: DemoScene) -> None:
    (left, right), (back, front) = demo.extent
    order = scan.points_w[:, 2].argsort()
    order = order[scan.points_w[order, 2] < demo.top - 0.01]
    points = scan.points_w[order]
    heights = {"vmin": 0.0, "vmax": 2.0} if demo.mesh is None else {}
    marks = axis.scatter(
        points[:, 0], points[:, 1], s=_dot(scan), c=points[:, 2], cmap="viridis", linewidths=0, **heights
    )
    axis.plot(*scan.sensor_w[:2], "*", color="red", markeredgecolor="white", markersize=12, label="sensor")
    axis.set(title="from above, without the highest centimetre", xlabel="x, m", ylabel="y, m")
    axis.set(xlim=(left - 0.3, right + 0.3), ylim=(back - 0.3, front + 0.3), aspect="equal")
    axis.legend(loc="lower left", fontsize=8)
    axis.figure.colorbar(marks, ax=axis, label="height, m")


def _dot(scan: Scan, area: float = 30_000.0) -> float:
    """Size of a point's mark, so that all points together cover the same area."""
    return float(np.clip(area / max(len(scan.ranges), 1), 0.4, 6.0))


def _camera() -> tuple[np.ndarray, np.ndarray]:
    """The camera's position, and its axes in rows: right, down, ahead."""
    eye = np.array(CAMERA)
    ahead = np.array(TARGET) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return eye, np.stack([right, np.cross(ahead, right), ahead])


def _project(points_w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of points in the picture, pixels."""
    eye, axes = _camera()
    right, down, ahead = ((points_w - eye) @ axes.T).T
    scale = FOCAL * PIXELS[0] / 2.0
    return PIXELS[0] / 2.0 + scale * right / ahead, PIXELS[1] / 2.0 + scale * down / ahead


def _visible_from_camera(points_w: np.ndarray, demo: DemoScene) -> np.ndarray:
    eye, _ = _camera()
    towards = torch.from_numpy(points_w - eye).float()
    origins = torch.from_numpy(eye).float().expand_as(towards)
    hits = demo.scene.cast(origins[None], towards[None], exclude_shapes=demo.open_side)
    return (hits.ranges[0] >= towards.norm(dim=1) - 0.02).numpy()


def _picture(demo: DemoScene) -> np.ndarray:
    """The room in pale colours, cast with the toolkit's own rays, (rows, columns, 3)."""
    columns, rows = PIXELS
    eye, axes = _camera()
    right, down = np.meshgrid(np.arange(columns) + 0.5 - columns / 2.0, np.arange(rows) + 0.5 - rows / 2.0)
    scale = FOCAL * columns / 2.0
    rays = np.stack([right.ravel() / scale, down.ravel() / scale, np.ones(right.size)], axis=1) @ axes
    towards = torch.from_numpy(rays).float()[None]
    origins = torch.from_numpy(eye).float().expand_as(towards)
    hits = demo.scene.cast(origins, towards, exclude_shapes=demo.open_side, normals=True)
    assert hits.normals_w is not None  # asked for
    normals, shape = hits.normals_w[0].numpy(), hits.shape_id[0].numpy()
    light = np.array(TO_LIGHT) / np.linalg.norm(TO_LIGHT)
    facing = normals * np.sign(-(normals * rays).sum(1, keepdims=True))  # a surface is lit from the side that is seen
    shade = 0.72 + 0.28 * (facing @ light).clip(-1.0, 1.0)
    kinds = np.array([*(shape.class_id for shape in demo.scene.shapes), len(DemoClass)])[shape]
    pale = 0.55 + 0.45 * np.array([_rgb(COLOURS[kind]) for kind in DemoClass])
    picture = np.concatenate([pale, np.ones((1, 3))])[kinds] * np.where(shape < 0, 1.0, shade)[:, None]
    return picture.reshape(rows, columns, 3).clip(0.0, 1.0)


def _class_colours(scan: Scan) -> np.ndarray:
    return np.array([_rgb(COLOURS[kind]) for kind in DemoClass])[scan.class_id]


def _height_colours(scan: Scan, demo: DemoScene) -> np.ndarray:
    """Blue at the robot's feet over green to red at the ceiling."""
    share = (scan.points_w[:, 2:] / max(demo.top, 1e-6)).clip(0.0, 1.0)
    hue = np.array([0.0, 2.0, 4.0]) + 4.0 * (1.0 - share)  # sixths of the colour circle from red
    return (np.abs((hue + np.array([0.0, 2.0, -2.0])) % 6.0 - 3.0) - 1.0).clip(0.0, 1.0)


def _rgb(colour: str) -> tuple[float, ...]:
    return tuple(int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5))
