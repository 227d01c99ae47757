"""Depth cameras, height scanners and users' own tables."""

import numpy as np
import pytest
import torch

from omnilidar import custom, grid, height_scanner


def test_grid_is_a_pinhole_camera():
    pattern = grid(3, 3, fov_deg=90.0)
    rays = pattern.directions_s.reshape(3, 3, 3)
    assert torch.allclose(rays[1, 1], torch.tensor([1.0, 0.0, 0.0]))
    pixel = 2.0 / 3.0  # at distance 1, 90 degrees span 2
    assert torch.allclose(rays[1, 0] / rays[1, 0, 0], torch.tensor([1.0, pixel, 0.0]))
    assert torch.allclose(rays[0, 2] / rays[0, 2, 0], torch.tensor([1.0, -pixel, pixel]))
    assert pattern.points_per_frame(1.0 / 30.0) == 9 and pattern.rows_per_shot == 9


def test_height_scanner_is_a_grid_of_vertical_rays():
    pattern = height_scanner()
    assert pattern.num_rows == 17 * 11 and pattern.points_per_frame(0.02) == 187
    assert torch.equal(pattern.directions_s, torch.tensor([0.0, 0.0, -1.0]).expand(187, 3))
    origins = pattern.origins_s.reshape(17, 11, 3)
    assert torch.allclose(origins[0, 0], torch.tensor([-0.8, -0.5, 0.0]))
    assert torch.allclose(origins[0, 1], torch.tensor([-0.8, -0.4, 0.0]))
    assert torch.allclose(origins[16, 10], torch.tensor([0.8, 0.5, 0.0]))
    assert torch.allclose(origins.mean(dim=(0, 1)), torch.zeros(3), atol=1e-7)
    line = height_scanner(0.0, 0.2, 0.1)
    assert line.origins_s[:, 1].tolist() == pytest.approx([-0.1, 0.0, 0.1])


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (grid, (3, 3, 180.0), "fov_deg=180"),
        (height_scanner, (1.65, 1.0, 0.1), "size_x=1.65 must be a multiple of lidar.pattern.spacing=0.1"),
    ],
)
def test_wrong_grids_are_refused(make, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(*arguments)


ANGLES = np.array([[0.0, 10.0], [90.0, -20.0], [-90.0, 0.0], [180.0, 45.0]])


@pytest.mark.parametrize(
    ("name", "header", "rows"),
    [
        ("scan.csv", "", 4),
        ("scan.csv", "azimuth_deg,elevation_deg\n", 4),
        ("scan.csv", "\ufeff", 4),
        ("scan.csv", "\ufeffazimuth,elevation\n", 4),
        ("one.csv", "", 1),
        ("scan.npy", "", 4),
    ],
)
def test_a_users_table(tmp_path, name, header, rows):
    if name.endswith("npy"):
        np.save(tmp_path / name, np.radians(ANGLES).astype(np.float32))
    else:
        (tmp_path / name).write_text(header + "".join(f"{a},{e}\n" for a, e in ANGLES[:rows]), encoding="utf-8")
    unit, lasers = ("rad" if name.endswith("npy") else "deg"), min(rows, 2)
    pattern = custom(tmp_path / name, 40.0, unit=unit, num_lasers=lasers, rows_per_shot=lasers)
    assert torch.rad2deg(pattern.elevation).tolist() == pytest.approx([10.0, -20.0, 0.0, 45.0][:rows], abs=1e-4)
    assert torch.rad2deg(pattern.azimuth).tolist() == pytest.approx([0.0, 90.0, 270.0, 180.0][:rows], abs=1e-4)
    assert pattern.duration_s == rows / 40.0 and (pattern.num_lasers, pattern.rows_per_shot) == (lasers, lasers)


@pytest.mark.parametrize(
    ("name", "content", "unit", "message"),
    [
        ("absent.csv", None, "rad", "does not exist \\(working directory: .*\\); give a .npy or .csv file"),
        ("scan.csv", "0,0\n1,x\n", "rad", r"row 1 is \[1.0, nan\], expected two numbers"),
        ("scan.csv", "0,0\n1\n", "rad", "cannot be read as numbers"),
        ("scan.csv", "0.1O,0.2\n1,1\n2,2\n", "rad", r"row 0 is \[nan, 0.2\], expected two numbers"),
        ("scan.csv", "", "rad", "cannot be read as numbers: it is empty"),
        ("scan.csv", "Elevation,Azimuth\n0.1,0.2\n", "rad", "its columns are elevation, azimuth; azimuth, elevation"),
        ("scan.csv", "0,30\n", "rad", "elevation of 30 rad is beyond a right angle.*may have to be deg"),
        ("scan.csv", "0,0\n", "turns", "lidar.pattern.unit='turns' must be deg or rad"),
    ],
)
def test_wrong_files_are_refused_in_one_line(tmp_path, name, content, unit, message):
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=message) as error:
        custom(tmp_path / name, 10.0, unit=unit)
    assert "\n" not in str(error.value)
