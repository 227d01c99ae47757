"""What a real recording says of a device, beside its preset.

    python -m benchmarks.real_scans device=mid360 file=frame.pcd
    python -m benchmarks.real_scans device=os1_128 file=recording.osf

Reads whatever `read_scans` reads, and Ouster's own .osf and .pcap (with its .json) where `ouster-sdk` is installed.
Points must be in order of measurement. Misses are known only where the file keeps them, as zeros or NaN. Of planes and
edges it takes what it finds: nobody measured the scene otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path

import numpy as np

from benchmarks.harness.table import Table, about, report
from omnilidar import DEVICES, DeviceSpec, PointTable, ScanPattern, read_scans
from omnilidar.clouds import table_of
from omniperception.config import ConfigError
from omnirobot.common.cli import Command, argument

OUSTER = (".pcap", ".osf")
CHANNELS = ("ring", "channel", "line", "laser")
"""Names of the column that says which laser measured a point."""
INTENSITIES = ("intensity", "reflectivity", "signal")
ELEVATION_BANDS = 12
RANGES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 400.0)
INCIDENCES_DEG = (0.0, 20.0, 40.0, 60.0, 80.0)
PLANES, PLANE_POINTS, PLANE_RADIUS = 1500, 24, 0.06
"""Places looked at, points that a plane needs, and its radius over the range."""
FLAT = 0.02
"""Largest rms distance from a plane that counts as one, metres and share of the radius."""
SEARCHED, KEPT, BLOCK, LACKING = 300, 50, 480, 3
"""To find a frame's place in a pattern: returns compared everywhere, places looked at again with all; returns over
which no point is lacking, and how many a file may lack."""
EDGE, GHOST = 0.3, 0.1
"""A jump of the range from one return to the next but one is an edge; a ghost is so far from both, metres."""


@dataclass(frozen=True)
class Frame:
    """One frame by lasers.

    Attributes:
        xyz: Metres, (P, 3), zero for a miss.
        ranges, azimuth, elevation: m and degrees, (P,); elevation of a miss is that between its neighbours.
        seen: Whether it is a return, (P,).
        lines: Rows of each laser in order of measurement.
        intensity: As in the file, (P,), or None.
    """

    xyz: np.ndarray
    ranges: np.ndarray
    azimuth: np.ndarray
    elevation: np.ndarray
    seen: np.ndarray
    lines: tuple[np.ndarray, ...]
    intensity: np.ndarray | None


def frames(path: Path, pattern: ScanPattern, topic: str | None = None) -> Iterator[Frame]:
    """Frames of a recording."""
    for table in _ouster(path) if path.suffix in OUSTER else read_scans(path, topic):
        yield frame_of(table, pattern)


def frame_of(table: PointTable, pattern: ScanPattern) -> Frame:
    """A table of points by lasers: as a column says, else by elevation or by the order in which lasers fire."""
    xyz = np.nan_to_num(table.xyz)
    ranges = np.linalg.norm(xyz, axis=1)
    seen = ranges > 0.0
    azimuth = np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0]))
    elevation = np.degrees(np.arcsin(np.divide(xyz[:, 2], ranges, out=np.zeros(len(xyz)), where=seen)))
    named = next((name for name in CHANNELS if name in table.names), None)
    channels = channel_elevations(pattern)
    if named is not None:
        laser = np.unique(table.points[named], return_inverse=True)[1]
    elif len(channels):
        laser = np.abs(elevation[:, None] - channels).argmin(axis=1)
    else:
        laser = np.arange(len(xyz)) % pattern.num_lasers
    lines = tuple(np.flatnonzero(laser == k) for k in range(laser.max(initial=-1) + 1))
    for line in lines:
        known = line[seen[line]]
        if len(known):
            elevation[line] = np.interp(line, known, elevation[known])
    column = next((name for name in INTENSITIES if name in table.names), None)
    intensity = None if column is None else table.points[column].astype(float)
    return Frame(xyz, ranges, azimuth, elevation, seen, lines, intensity)


def channel_elevations(pattern: ScanPattern) -> np.ndarray:
    """Elevations of a spinning sensor's lasers, degrees; none for others."""
    if pattern.num_lasers < 8:
        return np.zeros(0)
    return np.degrees(np.unique(pattern.elevation[: pattern.num_lasers].numpy()))


def _ouster(path: Path) -> Iterator[PointTable]:
    """Frames of Ouster's own recordings, misses as zeros, column after column."""
    try:
        from ouster.sdk import core, open_source
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{path} needs ouster-sdk: pip install 'ouster-sdk>=1'", name=error.name) from None
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    try:
        source = open_source(str(path))
    except Exception as error:  # its errors have no common class
        need = "the sensor's .json of the same name beside it" if path.suffix == ".pcap" else "a whole recording"
        raise ValueError(f"{path} cannot be opened: {path.suffix} needs {need}") from error
    info = source.sensor_info[0]
    place = core.XYZLut(info)
    for scans in source:
        scan = scans[0]
        image, xyz = scan.field("RANGE"), place(scan)
        rows, columns = image.shape
        signal = next(
            (scan.field(name) for name in ("SIGNAL", "REFLECTIVITY") if name in scan.fields), np.zeros_like(image)
        )
        by_time = {axis: xyz[..., k].T.ravel() for k, axis in enumerate("xyz")}
        by_time |= {"intensity": signal.T.ravel().astype(np.float32)}
        yield table_of({**by_time, "ring": np.tile(np.arange(rows, dtype=np.uint16), columns)})


def summary(frame: Frame, spec: DeviceSpec, pattern: ScanPattern) -> list[dict]:
    """Counts, sense of rotation and speed, beside the preset's."""
    whole = pattern.points_per_frame(spec.period_s)
    turn, model_turn = _steps(frame), _model_steps(pattern)
    kept = bool((~frame.seen).any())
    lowest, highest = np.percentile(frame.elevation[frame.seen], (0.1, 99.9)).tolist()
    return [
        {"figure": "rows of the frame", "recording": len(frame.seen), "preset": whole},
        {"figure": "returns", "recording": int(frame.seen.sum()), "preset": None},
        {"figure": "misses, %", "recording": 100.0 * float((~frame.seen).mean()) if kept else None, "preset": None},
        {"figure": "azimuth from shot to shot of a laser, deg", "recording": turn, "preset": model_turn},
        {"figure": "lowest elevation, deg", "recording": lowest, "preset": spec.elevation_deg[0]},
        {"figure": "highest elevation, deg", "recording": highest, "preset": spec.elevation_deg[1]},
        *_channel_errors(frame, pattern),
        *(against_grid(frame, pattern) if len(channel_elevations(pattern)) else against_order(frame, pattern)),
    ]


def _steps(frame: Frame) -> float:
    """Median change of azimuth between neighbours of a line that both returned, degrees."""
    changes = []
    for line in frame.lines:
        both = frame.seen[line[1:]] & frame.seen[line[:-1]] if len(line) > 1 else np.zeros(0, bool)
        change = (np.diff(frame.azimuth[line]) + 180.0) % 360.0 - 180.0
        changes.append(change[both])
    return float(np.median(np.concatenate(changes)))


def _model_steps(pattern: ScanPattern) -> float:
    azimuth = np.degrees(pattern.azimuth.numpy()[: 4000 * pattern.num_lasers])
    change = (azimuth[pattern.num_lasers :] - azimuth[: -pattern.num_lasers] + 180.0) % 360.0 - 180.0
    return float(np.median(change))


def _channel_errors(frame: Frame, pattern: ScanPattern) -> list[dict]:
    """Elevations of a spinning sensor's lasers against the preset's."""
    channels = channel_elevations(pattern)
    if not len(channels):
        return []
    off = np.abs(frame.elevation[frame.seen][:, None] - channels).min(axis=1)
    found = [
        float(np.median(frame.elevation[line[frame.seen[line]]])) for line in frame.lines if frame.seen[line].any()
    ]
    bias = np.abs(np.array(found)[:, None] - channels).min(axis=1)
    return [
        {"figure": "lasers", "recording": len(found), "preset": len(channels)},
        {"figure": "elevation off the nearest laser's, mean, deg", "recording": float(off.mean()), "preset": 0.0},
        {"figure": "the same, 99 %", "recording": float(np.percentile(off, 99)), "preset": 0.0},
        {"figure": "a laser's median off, largest", "recording": float(bias.max()), "preset": 0.0},
    ]


def against_grid(frame: Frame, pattern: ScanPattern) -> list[dict]:
    """Directions against a spinning preset: even steps of azimuth, their start and size fitted to each laser."""
    step, channels, angles = _model_steps(pattern), channel_elevations(pattern), []
    for line in frame.lines:
        k = line[frame.seen[line]]
        if len(k) < 3:
            continue
        change = (np.diff(frame.azimuth[k]) + 180.0) % 360.0 - 180.0
        shot = np.concatenate(([0.0], np.cumsum(np.rint(change / abs(step)))))
        azimuth = np.concatenate(([0.0], np.cumsum(change)))
        aside = azimuth - np.polyval(np.polyfit(shot, azimuth, 1), shot)
        off = np.abs(frame.elevation[k][:, None] - channels).min(axis=1)
        angles.append(np.hypot(off, aside * np.cos(np.radians(frame.elevation[k]))))
    return _angle_rows(np.concatenate(angles)) if angles else []


def against_order(frame: Frame, pattern: ScanPattern) -> list[dict]:
    """Directions in order of measurement against the pattern's, from the place in it and at the yaw that fit best.

    Only of files that keep every ray: one that leaves misses out does not say which rays its points were.
    """
    if frame.seen.all():
        return []
    rows = np.flatnonzero(frame.seen)
    begin = _place_in_pattern(frame, pattern, rows)
    yaw = _yaw(frame, pattern, begin + rows, rows)
    angles = []
    for block in np.array_split(rows, max(len(rows) // BLOCK, 1)):  # from some on, a file may lack points
        tried = [_angles(frame, pattern, begin + block + lacking, block, yaw) for lacking in range(LACKING + 1)]
        angles.append(min(tried, key=np.median))
    first_s = begin / pattern.points_per_second
    return [
        *_angle_rows(np.concatenate(angles)),
        {"figure": "the frame begins at this time of the pattern, s", "recording": first_s, "preset": None},
        {"figure": "and is turned about z by, deg", "recording": yaw, "preset": 0.0},
    ]


def _angle_rows(angles: np.ndarray) -> list[dict]:
    return [
        {"figure": "direction off the preset's, mean, deg", "recording": float(angles.mean()), "preset": 0.0},
        {"figure": "the same, 99 % of the returns", "recording": float(np.percentile(angles, 99)), "preset": 0.0},
    ]


def _place_in_pattern(frame: Frame, pattern: ScanPattern, rows: np.ndarray) -> int:
    """Number of the ray with which a frame begins: by elevations, which no yaw changes, then by directions."""
    few = rows[:: max(len(rows) // SEARCHED, 1)]
    model, starts = np.degrees(pattern.elevation.numpy()), np.arange(0, len(pattern.elevation), pattern.num_lasers)
    off = np.zeros(len(starts))
    for row in few:  # bounded, so that points on another ray do not decide
        off += np.minimum(np.abs(model[(starts + row) % len(model)] - frame.elevation[row]), 10.0)
    best = starts[np.argsort(off)[:KEPT]]
    trials = [
        (_angles(frame, pattern, begin + rows, rows, _yaw(frame, pattern, begin + rows, rows)), begin) for begin in best
    ]
    return int(min(trials, key=lambda trial: float(np.median(trial[0])))[1])


def _yaw(frame: Frame, pattern: ScanPattern, rays: np.ndarray, rows: np.ndarray) -> float:
    """How far (deg) rows of a frame are turned about z from rays of a pattern: the median."""
    aside = np.radians(frame.azimuth[rows]) - pattern.azimuth.numpy()[rays % len(pattern.azimuth)]
    middle = np.angle(np.exp(1j * aside).mean())
    return float(np.degrees(middle + np.median(np.angle(np.exp(1j * (aside - middle))))))


def _angles(frame: Frame, pattern: ScanPattern, rays: np.ndarray, rows: np.ndarray, yaw: float) -> np.ndarray:
    """Between rows of a frame and rays of a pattern turned by a yaw, degrees."""
    rays = rays % len(pattern.azimuth)
    azimuth, elevation = pattern.azimuth.numpy()[rays] + np.radians(yaw), pattern.elevation.numpy()[rays]
    flat = np.cos(elevation)
    unit = np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), axis=1)
    cosine = (unit * frame.xyz[rows]).sum(axis=1) / frame.ranges[rows]
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def by_elevation(frame: Frame, spec: DeviceSpec, pattern: ScanPattern) -> list[dict]:
    """Rays and returns for each band of equal height: the preset's rays, the recording's, and how many came back."""
    low, high = spec.elevation_deg
    bands = np.linspace(low, high, ELEVATION_BANDS + 1)
    bands[[0, -1]] = -90.0, 90.0
    model = np.degrees(pattern.elevation.numpy())
    whole = pattern.points_per_frame(spec.period_s)
    kept = bool((~frame.seen).any())
    rows = []
    for start, end in pairwise(bands):
        inside = (frame.elevation >= start) & (frame.elevation < end)
        share = float(((model >= start) & (model < end)).mean())
        seen = inside & frame.seen
        edges = np.radians((max(start, low), min(end, high)))
        solid_angle = np.radians(spec.horizontal_fov_deg) * float(np.sin(edges[1]) - np.sin(edges[0]))
        rows.append(
            {
                "elevation from, deg": max(float(start), low),
                "rays of the preset": whole * share,
                "rays of the recording": int(inside.sum()),
                "per sr: preset": whole * share / solid_angle,
                "recording": inside.sum() / solid_angle,
                "returns": int(seen.sum()),
                "misses, %": 100.0 * float(1.0 - seen.sum() / max(inside.sum(), 1)) if kept else None,
                "median range, m": float(np.median(frame.ranges[seen])) if seen.any() else None,
            }
        )
    return rows


def on_planes(frame: Frame, seed: int = 0) -> list[dict]:
    """Deviation from planes along the ray, by range and incidence: robust sigma, millimetres."""
    points = frame.xyz[frame.seen]
    rng = np.random.default_rng(seed)
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for k in rng.permutation(len(points))[:PLANES]:
        reach = PLANE_RADIUS * np.linalg.norm(points[k])
        near = points[np.abs(points - points[k]).max(axis=1) < reach]
        if len(near) < PLANE_POINTS:
            continue
        middle = near.mean(axis=0)
        spread, axes = np.linalg.eigh(np.cov((near - middle).T))
        flat = np.sqrt(spread[0]) < min(FLAT, 0.25 * reach) and spread[1] > 0.05 * spread[2]
        ranges = np.linalg.norm(near, axis=1)
        cosine = np.abs(near @ axes[:, 0]) / ranges
        if flat and cosine.mean() > 0.15:
            off = (near - middle) @ axes[:, 0] / cosine
            found.append((off, ranges, np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))))
    if not found:
        return []
    off, ranges, incidence = (np.concatenate(part) for part in zip(*found, strict=True))
    rows = []
    for near_m, far_m in pairwise(RANGES):
        row: dict[str, object] = {"range from, m": near_m}
        for low, high in pairwise(INCIDENCES_DEG):
            k = (ranges >= near_m) & (ranges < far_m) & (incidence >= low) & (incidence < high)
            row[f"{low:g}-{high:g} deg"] = 1e3 * 1.4826 * float(np.median(np.abs(off[k]))) if k.sum() >= 200 else None
        rows.append(row)
    return [row for row in rows if any(value is not None for value in list(row.values())[1:])]


def at_edges(frame: Frame, pattern: ScanPattern) -> list[dict]:
    """Edges along the lines, and returns between both surfaces; only of neighbours, between which none is missing."""
    beside = 3.0 * abs(_model_steps(pattern))
    edges = ghosts = 0
    for line in frame.lines:
        r, seen = frame.ranges[line], frame.seen[line]
        if len(r) < 3:
            continue
        apart = np.abs((frame.azimuth[line[2:]] - frame.azimuth[line[:-2]] + 180.0) % 360.0 - 180.0)
        whole = seen[:-2] & seen[1:-1] & seen[2:] & (apart < beside)
        near, far = np.minimum(r[:-2], r[2:]), np.maximum(r[:-2], r[2:])
        edge = whole & (far - near > EDGE)
        edges += int(edge.sum())
        ghosts += int((edge & (r[1:-1] > near + GHOST) & (r[1:-1] < far - GHOST)).sum())
    return [{"edges": edges, "returns between both surfaces": ghosts, "share, %": 100.0 * ghosts / max(edges, 1)}]


def by_range(frame: Frame) -> list[dict]:
    """Returns and intensities for each range."""
    rows = []
    for near, far in pairwise(RANGES):
        k = frame.seen & (frame.ranges >= near) & (frame.ranges < far)
        if k.any():
            quartiles = (
                (None,) * 3 if frame.intensity is None else np.percentile(frame.intensity[k], (25, 50, 75)).tolist()
            )
            names = ("intensity 25 %", "50 %", "75 %")
            rows.append({"range from, m": near, "returns": int(k.sum()), **dict(zip(names, quartiles, strict=True))})
    return rows


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The command line."""

    device: str = argument(doc="preset to compare with", choices=tuple(DEVICES))
    file: Path = argument(doc="the recording")
    frame: int = argument(0, "which of its frames", least=0)
    topic: str | None = argument(None, "of a recording with several topics of clouds; null: its only one")
    out: Path | None = argument(None, "folder of the results; null: outputs/real_scans/<device>")


def main(given: Arguments) -> None:
    """Prints and writes the tables."""
    spec = DEVICES[given.device]
    pattern = spec.pattern()
    found = next(islice(frames(given.file, pattern, given.topic), given.frame, None), None)
    if found is None or not found.seen.any():
        raise ConfigError(f"file={given.file} holds no frame number {given.frame} with returns")
    title = f"{spec.name}, {given.file.name}"
    tables = [
        Table.of("summary", title, summary(found, spec, pattern)),
        Table.of("elevation", f"{title}: rays by elevation", by_elevation(found, spec, pattern)),
        Table.of("ranges", f"{title}: returns by range", by_range(found)),
        Table.of("edges", f"{title}: neighbours across an edge", at_edges(found, pattern)),
        Table.of("planes", f"{title}: sigma along the ray on planes, mm, by incidence", on_planes(found)),
    ]
    report([table for table in tables if table.rows], about(1), given.out or Path("outputs/real_scans") / given.device)


command = Command(main, Arguments, __doc__, errors=(ValueError, FileNotFoundError, ImportError))

if __name__ == "__main__":
    command()
