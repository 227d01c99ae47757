"""The study of real recordings, against simulated ones whose errors are known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks import real_scans
from omnilidar import (
    DEVICES,
    GaussianNoise,
    Lidar,
    LidarConfig,
    RayScene,
    Shape,
    ShapeKind,
    read_points,
    vlp16,
    write_points,
)
from omnilidar.clouds import table_of
from omnilidar.patterns.mid360_series import MEASURED, mid360_model


@pytest.fixture(scope="module")
def frame_file(tmp_path_factory):
    """Half a frame of the measured Mid-360 that began somewhere, one point lost, every seventh ray a miss."""
    rows = mid360_model(MEASURED).directions_s[41_000:51_000].numpy() * 2.0
    rows[::7] = 0.0
    rows = np.delete(rows.astype(np.float32), 6001, axis=0)
    path = tmp_path_factory.mktemp("frames") / "frame.ply"
    write_points(path, table_of(dict(zip("xyz", rows.T, strict=True))))
    return path


@pytest.fixture(scope="module")
def room():
    """A frame of a VLP-16 in a room of 8 x 6 m with a post before a wall; range noise of 2 cm."""
    walls = [
        Shape(ShapeKind.BOX, (0.05, 3.0, 3.0), pos=(4.05, 0.0, 0.0)),
        Shape(ShapeKind.BOX, (0.05, 3.0, 3.0), pos=(-4.05, 0.0, 0.0)),
        Shape(ShapeKind.BOX, (4.0, 0.05, 3.0), pos=(0.0, 3.05, 0.0)),
        Shape(ShapeKind.CYLINDER, (0.1, 2.0), pos=(2.0, 0.0, 0.0)),
    ]
    scene = RayScene(walls, num_envs=1, num_bodies=0)
    pattern = vlp16()
    count = pattern.points_per_frame(0.1)
    config = LidarConfig(num_rays=count, min_range=0.5)
    lidar = Lidar(config, pattern, scene, -1, noise=[GaussianNoise(0.02)], outputs=("points_s", "ranges"))
    frame = lidar.cast(0.1)
    xyz = torch.nan_to_num(frame.points_s[0]).numpy()
    return real_scans.frame_of(table_of(dict(zip("xyz", xyz.T, strict=True))), pattern), pattern, frame.ranges[0]


def test_counts_sense_and_channels(room):
    frame, pattern, ranges = room
    rows = {row["figure"]: row for row in real_scans.summary(frame, DEVICES["vlp16"], pattern)}
    assert rows["rows of the frame"]["recording"] == rows["rows of the frame"]["preset"] == len(ranges)
    assert rows["returns"]["recording"] == int(ranges.isfinite().sum())
    assert rows["misses, %"]["recording"] == pytest.approx(100.0 * float(ranges.isinf().float().mean()))
    turn = rows["azimuth from shot to shot of a laser, deg"]
    assert turn["recording"] == pytest.approx(-360.0 * 10.0 * 55.296e-6, abs=0.01)
    assert turn["preset"] == pytest.approx(turn["recording"], abs=1e-3)
    assert rows["elevation off the nearest laser's, mean, deg"]["recording"] < 1e-3


def test_a_spinning_sensor_is_on_its_grid_and_off_it_by_what_was_added(room):
    frame, pattern, _ = room
    mean, most = (row["recording"] for row in real_scans.against_grid(frame, pattern))
    assert mean < most < 2e-3
    tilted = replace(frame, elevation=frame.elevation + 0.1)
    mean, _ = (row["recording"] for row in real_scans.against_grid(tilted, pattern))
    assert mean == pytest.approx(0.1, abs=2e-3)


def test_the_place_in_the_pattern_is_found_around_a_lost_point(frame_file):
    """The frame of the fixture, which begins at ray 41,000, turned about z by 25 degrees."""
    rows, pattern = read_points(frame_file).xyz, DEVICES["mid360_measured"].pattern()
    cos, sin = math.cos(math.radians(25.0)), math.sin(math.radians(25.0))
    turned = rows @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    frame = real_scans.frame_of(table_of(dict(zip("xyz", turned.astype(np.float32).T, strict=True))), pattern)
    found = {row["figure"]: row["recording"] for row in real_scans.against_order(frame, pattern)}
    assert found["the frame begins at this time of the pattern, s"] == pytest.approx(41_000 / 2e5, abs=1e-9)
    assert found["and is turned about z by, deg"] == pytest.approx(25.0, abs=1e-3)
    assert found["direction off the preset's, mean, deg"] < 0.05
    other = real_scans.against_order(frame, DEVICES["mid360"].pattern())
    assert other[0]["recording"] > 20.0  # a device that turns the other way
    whole = replace(frame, seen=np.ones_like(frame.seen))
    assert real_scans.against_order(whole, pattern) == []


def test_noise_on_walls_is_found_again(room):
    frame, *_ = room
    cells = [v for row in real_scans.on_planes(frame) for key, v in row.items() if key != "range from, m" and v]
    assert len(cells) > 3 and np.median(cells) == pytest.approx(20.0, rel=0.1)  # mm


def test_rays_by_elevation_add_up(room):
    frame, pattern, ranges = room
    rows = real_scans.by_elevation(frame, DEVICES["vlp16"], pattern)
    assert sum(row["returns"] for row in rows) == int(ranges.isfinite().sum())
    assert sum(row["rays of the recording"] for row in rows) == len(ranges)
    assert sum(row["rays of the preset"] for row in rows) == pytest.approx(len(ranges))


def test_a_ghost_between_two_surfaces_is_counted():
    azimuth = np.radians(np.arange(-10.0, 10.0, 0.2))
    ranges = np.where(azimuth < 0.0, 2.0, 4.0)
    ranges[50] = 3.0  # between both
    xyz = ranges[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(100)], axis=1)
    table = table_of({**dict(zip("xyz", xyz.T, strict=True)), "ring": np.zeros(100, np.uint8)})
    (found,) = real_scans.at_edges(real_scans.frame_of(table, vlp16()), vlp16())
    assert found["returns between both surfaces"] == 1 and found["edges"] == 3


def test_the_command_reads_a_file_and_writes_tables(frame_file, tmp_path, capsys):
    real_scans.command([f"file={frame_file}", "device=mid360_measured", f"out={tmp_path}"])
    said = capsys.readouterr().out
    assert "rays by elevation" in said and (tmp_path / "summary.csv").is_file()
    with pytest.raises(SystemExit):
        real_scans.command([f"file={frame_file}", "device=mid360", "frame=3", f"out={tmp_path}"])
    assert "holds no frame number 3" in capsys.readouterr().err
