"""Livox scanners: prism optics against Snell's law, closed forms against the manufacturer's tables."""

import importlib.util
import math

import numpy as np
import pytest
import torch

from omnilidar import LIVOX, hap, mid360, mid360_measured
from omnilidar.patterns.risley import RisleyScanner, Wedge

needs_table = pytest.mark.skipif(
    importlib.util.find_spec("mujoco_lidar") is None, reason="the extra 'tables' is not installed"
)


@pytest.fixture(scope="module")
def models():
    return {name: make() for name, make in LIVOX.items()}


def test_a_thin_wedge_bends_light_by_n_minus_one_times_its_angle():
    """To first order, towards its thick side: away from the inclined normal at the exit, towards it at the entry."""
    for flat_first, sign in ((True, -1.0), (False, 1.0)):
        scanner = RisleyScanner((Wedge(1.5, 0.1, 60.0, 0.0, flat_first),))
        at_start, quarter_later = scanner.directions(np.array([0.0, 0.25]), np.zeros(2))
        bend = sign * math.radians(0.5 * 0.1)
        assert at_start == pytest.approx([1.0, bend, 0.0], abs=1e-6)
        assert quarter_later == pytest.approx([1.0, 0.0, bend], abs=1e-6)


def test_a_wedge_bends_light_as_a_prism_in_its_plane():
    """Flat face first: sin(out) = n sin(wedge), measured from the inclined face's normal."""
    n, wedge = 1.8144, math.radians(18.0)
    (ray,) = RisleyScanner((Wedge(n, 18.0, 0.0, 180.0, True),)).directions(np.zeros(1), np.zeros(1))
    out = math.asin(n * math.sin(wedge)) - wedge
    assert ray == pytest.approx([math.cos(out), math.sin(out), 0.0], abs=1e-12)


def test_the_haps_inner_field_is_scanned_more_finely(models):
    """Across 20 deg of azimuth a laser's steps grow as its clock slows down from 550,002 to 424,998 shots/s."""
    x, y, z = models["hap"].directions_s.T
    azimuth, level = torch.rad2deg(torch.atan2(y, x)), torch.rad2deg(torch.asin(z)).abs() < 3.0
    step = (azimuth[6:] - azimuth[:-6]).abs()
    azimuth, level = azimuth[6:].abs(), level[6:]
    inner = step[level & (azimuth > 16.0) & (azimuth < 19.0)].median()
    outer = step[level & (azimuth > 21.0) & (azimuth < 24.0)].median()
    assert (outer / inner).item() == pytest.approx(550_002 / 424_998, rel=0.05)


def angle_to_table(model, table, slack_rows=0):
    """Mean and largest angle from rows of the table to the model's same rows, degrees; 10,000 rows, evenly placed.

    With `slack_rows`, to the nearest of the model's rows that are at most so many before or after: for a model whose
    order of firing drifts from the table's.
    """
    last = min(model.num_rows, table.num_rows) - 1 - slack_rows
    rows = torch.linspace(slack_rows, last, 10_000 if slack_rows == 0 else 1_000, dtype=torch.float64).round().long()
    near = rows[:, None] + torch.arange(-slack_rows, slack_rows + 1)
    gap = model.directions_s[near].double() - table.directions_s[rows, None].double()
    chord = torch.linalg.vector_norm(gap, dim=2).amin(dim=1)
    angle = torch.rad2deg(2.0 * torch.asin((chord / 2.0).clamp(max=1.0)))
    return float(angle.mean()), float(angle.max())


@needs_table
@pytest.mark.parametrize("name", LIVOX)
def test_models_agree_with_the_tables_row_by_row(models, name):
    """But for the order of some shots of the HAP."""
    largest_mean, largest_angle = {"mid360": (0.02, 0.1), "hap": (0.001, math.inf)}.get(name, (0.0005, 0.001))
    mean, largest = angle_to_table(models[name], LIVOX[name]("table"), slack_rows=1000 if name == "hap" else 0)
    assert mean < largest_mean and largest < largest_angle


@needs_table
def test_tables_have_the_devices_rate():
    table = mid360("table")
    assert table.num_rows == 800_000 and table.points_per_second == 200_000.0 and table.rows_per_shot == 4
    assert hap("table").num_rows == 1_048_575


def test_a_missing_table_names_the_extra(monkeypatch):
    def absent(name):
        raise ModuleNotFoundError(name)

    monkeypatch.setattr("omnilidar.patterns.livox.files", absent)
    for make in LIVOX.values():
        with pytest.raises(ModuleNotFoundError, match=r"pip install 'omnilidar\[tables\]'"):
            make("table")
        with pytest.raises(ValueError, match=r"lidar.pattern.source='tabel' must be 'model' or 'table'"):
            make("tabel")


def test_the_measured_mid360_turns_the_other_way_and_sweeps_as_a_sine(models):
    """Against hand-computed numbers of the mechanism: 181 turns per second, a sine that spends long at its ends."""
    table, one = models["mid360"], mid360_measured()
    for pattern, sense in ((table, -1.0), (one, 1.0)):
        step = torch.rad2deg(pattern.azimuth[4::4] - pattern.azimuth[:-4:4])
        assert sense * ((step + 180.0) % 360.0 - 180.0).median() > 1.2
    turned = torch.rad2deg(torch.diff(one.azimuth[::4]))
    turned = torch.where(turned < -180.0, turned + 360.0, turned).double()
    assert turned.sum().item() / 360.0 == pytest.approx(4.0 * 181.033, abs=0.3)
    high, low = one.elevation.rad2deg().max().item(), one.elevation.rad2deg().min().item()
    assert (low, high) == pytest.approx((-7.0, 52.5), abs=0.4)
    middle = [((p.elevation.rad2deg() - 20.0).abs() < 5.0).float().mean().item() for p in (table, one)]
    assert middle[1] < 0.9 * middle[0]  # a triangle is as long in the middle as at its ends
