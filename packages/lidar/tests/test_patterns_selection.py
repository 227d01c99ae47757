"""Fewer rays than the device measures: every k-th, stratified."""

import math

import numpy as np
import pytest
import torch

from omnilidar import ScanPattern, avia, grid, make_selection, mid40, mid360, vlp16, xt16
from omnilidar.patterns.selection import SphereCells, _one_per_cell, field_cells

STRATEGIES = ("every_kth", "stratified")


@pytest.fixture(scope="module")
def rosette():
    return mid40()


@pytest.fixture(scope="module")
def selections(rosette):
    return {s: make_selection(rosette, 0.1, 300, s, seed=5) for s in STRATEGIES}


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_offsets_increase_within_the_frame(selections, strategy):
    selection = selections[strategy]
    offsets = selection.offsets
    assert offsets.dtype == torch.int32 and offsets.shape == (selection.num_variants, 300)
    assert offsets.min() >= 0 and offsets.max() < 10_000
    assert (offsets.diff(dim=1) > 0).all()


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_the_same_seed_gives_the_same_rays_and_another_seed_others(rosette, selections, strategy):
    again, other = (make_selection(rosette, 0.1, 300, strategy, seed=s) for s in (5, 6))
    assert torch.equal(again.offsets, selections[strategy].offsets)
    assert torch.equal(other.offsets, again.offsets) == (strategy == "every_kth")


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("make", [mid360, avia, vlp16, lambda: grid(20, 10, 90.0, 10.0)], ids=["a", "b", "c", "d"])
def test_all_points_or_one(make, strategy):
    pattern = make()
    points = pattern.points_per_frame(0.1)
    if points < 5000 or strategy == "every_kth":
        assert make_selection(pattern, 0.1, points, strategy).offsets[0].tolist() == list(range(points))
    assert make_selection(pattern, 0.1, 1, strategy).num_rays == 1


class TestVariants:
    def test_stratified_takes_the_nearest_frame_of_the_bank(self, rosette, selections):
        selection = selections["stratified"]
        step, count = selection.phase_step, selection.num_variants
        first = torch.tensor([0, step, 5 * step, step // 2 - 1, rosette.num_rows - step // 2, rosette.num_rows - step])
        assert selection.variants(first, torch.tensor([9])).tolist() == [0, 1, 5, 0, 0, count - 1]

    def test_stratified_chooses_again_where_every_frame_is_the_same_turn(self):
        pattern = xt16()
        selection = make_selection(pattern, 0.1, 50, "stratified")
        starts = pattern.num_rows // selection.phase_step
        assert selection.num_variants == 16 * starts > 16
        first = torch.tensor([0, 2 * selection.phase_step])
        variants = [selection.variants(first, torch.tensor([k])).tolist() for k in range(20)]
        assert variants == [[(k % 16) * starts, (k % 16) * starts + 2] for k in range(20)]
        assert len(selection.offsets[::starts].unique(dim=0)) == 16

    def test_phases_are_where_the_bank_begins(self, selections):
        for selection in selections.values():
            phases = selection.draw_phases(1000, torch.Generator().manual_seed(0))
            assert (phases % selection.phase_step == 0).all() and phases.max() < selection.num_rows
            assert len(phases.unique()) > 100

    @pytest.mark.parametrize("strategy", ["every_kth", "stratified"])
    @pytest.mark.parametrize("num_rays", [200, 90])
    def test_a_camera_has_no_phase(self, strategy, num_rays):
        """Its pixels keep their order and are of one instant."""
        selection = make_selection(grid(20, 10, 90.0, 10.0), 0.1, num_rays, strategy)
        assert selection.phase_step == 200 and selection.draw_phases(5).tolist() == [0] * 5


class TestStratified:
    def test_equal_solid_angles_give_equal_counts(self):
        """Frames of 2000 directions all over the sphere, 256 rays: an eighth of the sphere holds an eighth of them."""
        random = np.random.default_rng(0)
        level, azimuth = random.uniform(-1.0, 1.0, 20_000), random.uniform(0.0, 2.0 * math.pi, 20_000)
        pattern = ScanPattern.from_angles(np.arcsin(level), azimuth, 20_000.0)
        touched = field_cells(pattern, 256).index(np.arcsin(level), azimuth)
        assert abs(len(np.unique(touched)) - 256) < 15
        selection = make_selection(pattern, 0.1, 256, "stratified", seed=1)
        starts = torch.arange(selection.num_variants)[:, None] * selection.phase_step
        kept = (starts + selection.offsets) % 20_000
        share = np.stack([np.histogram(level[k], bins=8, range=(-1.0, 1.0))[0] for k in kept.numpy()])
        assert share.mean(axis=0) == pytest.approx(np.full(8, 32.0), abs=1.5)

    def test_every_cell_gives_one_before_any_gives_two(self):
        cell = np.repeat([0, 1, 2, 3], [50, 5, 2, 1])
        off_centre = np.random.default_rng(0).random(58)
        for count, given in ((4, [1, 1, 1, 1]), (7, [2, 2, 2, 1]), (9, [3, 3, 2, 1]), (40, [32, 5, 2, 1])):
            kept = _one_per_cell(cell, off_centre, count, np.random.default_rng(1))
            assert np.bincount(cell[kept]).tolist() == given
        first = _one_per_cell(cell, off_centre, 4, np.random.default_rng(1))
        assert first.tolist() == [np.flatnonzero(cell == c)[off_centre[cell == c].argmin()] for c in range(4)]

    def test_it_evens_out_where_the_device_looks_often(self):
        """All rays but 200 of 10,000 look into one hemisphere: even counts need half of them in the other."""
        random = np.random.default_rng(0)
        level = np.concatenate([random.uniform(0.0, 1.0, 9_800), random.uniform(-1.0, 0.0, 200)])
        random.shuffle(level)
        pattern = ScanPattern.from_angles(np.arcsin(level), random.uniform(0.0, 2.0 * math.pi, 10_000), 10_000.0)
        below = {
            s: (pattern.elevation[make_selection(pattern, 1.0, 200, s).offsets[0].long()] < 0.0).sum().item()
            for s in STRATEGIES
        }
        assert below["every_kth"] < 15
        assert 70 <= below["stratified"] <= 110  # some of the 200 share a cell


class TestCells:
    @pytest.mark.parametrize("edge_deg", [1.0, 2.5, 7.0, 90.0])
    def test_they_have_equal_solid_angles(self, edge_deg):
        cells = SphereCells(edge_deg)
        rings = len(cells.columns)
        level = np.sin(math.pi * (np.arange(rings + 1) / rings - 0.5))
        area = 2.0 * math.pi * np.diff(level) / cells.columns
        nominal = (math.pi / rings) ** 2
        assert area[1:-1] == pytest.approx(np.full(len(area[1:-1]), nominal), rel=0.15)

    def test_every_direction_has_a_cell(self):
        cells = SphereCells(3.0)
        random = np.random.default_rng(0)
        elevation = np.append(np.arcsin(random.uniform(-1.0, 1.0, 10_000)), [math.pi / 2.0, -math.pi / 2.0])
        index = cells.index(elevation, np.append(random.uniform(-10.0, 10.0, 10_000), [0.0, 2.0 * math.pi]))
        assert index.min() >= 0 and index.max() < cells.columns.sum()
        same = cells.index(np.array([0.1, 0.1]), np.array([1.0, 1.0 + 2.0 * math.pi]))
        assert same[0] == same[1]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: make_selection(p, 0.1, 10, "best"), r"lidar.selection='best' must be one of every_kth, stratified"),
        (lambda p: make_selection(p, 0.1, 10_001, "stratified"), r"lidar.num_rays=10001 must be in 1..10000"),
    ],
)
def test_wrong_selections_are_refused(rosette, make, message):
    with pytest.raises(ValueError, match=message):
        make(rosette)
