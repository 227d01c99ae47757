"""Layouts: passable by an independent search, exact covers."""

import itertools

import numpy as np
import pytest

from omniperception.scene.layouts import BarnLayout, BlocksLayout, CorridorLayout, MazeLayout
from omniperception.scene.layouts.barn import inflated, passable, rectangles, smoothed
from omniperception.scene.layouts.maze import ROUTE_PIECES

_MAZE, _SPARSE = MazeLayout(), BlocksLayout()
_HOLD = BlocksLayout(area=(-4.5, 4.5, -3.75, 3.75), stagger=0.0, jitter=1.0, free=3.0)
_BARN = BarnLayout(boxes=120, worlds=24)


def distance_to_boxes(points: np.ndarray, world: np.ndarray) -> np.ndarray:
    """Distances (m) of points (n, 2) to the nearest box of a world (K, 6)."""
    distances = []
    for x, y, yaw, half_x, half_y, _ in world[~np.isnan(world[:, 0])]:
        away = points - [x, y]
        along = np.abs(away @ [np.cos(yaw), np.sin(yaw)]) - half_x
        aside = np.abs(away @ [-np.sin(yaw), np.cos(yaw)]) - half_y
        distances.append(np.hypot(along.clip(0), aside.clip(0)))
    return np.min(distances, 0)


def leads_through(world: np.ndarray, goal: tuple[float, float], y: float, radius: float, step: float = 0.1) -> bool:
    """Whether a disc gets from the origin to the goal between -y and y, by flooding a grid of its centres."""
    xs, ys = np.arange(-0.5, goal[0] + 0.5, step), np.arange(-y, y + step / 2, step)
    places = np.stack(np.meshgrid(xs, ys, indexing="ij"), -1).reshape(-1, 2)
    free = (distance_to_boxes(places, world) > radius).reshape(len(xs), len(ys))
    cell = {
        name: (round((p[0] - xs[0]) / step), round((p[1] - ys[0]) / step))
        for name, p in (("start", (0.0, 0.0)), ("goal", goal))
    }
    reached, front = {cell["start"]}, [cell["start"]]
    while front:
        i, j = front.pop()
        for near in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if 0 <= near[0] < len(xs) and 0 <= near[1] < len(ys) and free[near] and near not in reached:
                reached.add(near)
                front.append(near)
    return free[cell["start"]] and cell["goal"] in reached


@pytest.mark.parametrize(
    ("layout", "goal", "y"),
    [
        (_MAZE, _MAZE.goal, 4.5),
        (MazeLayout(walls=32, lanes=(2, 5, 7)), _MAZE.goal, 4.5),
        (_SPARSE, (11.0, 0.0), 3.3),
        (BlocksLayout(grid=(4, 4)), (11.0, 0.0), 3.3),
    ],
)
def test_a_go2_gets_to_the_goal(layout, goal, y):
    for world in layout.table(3, 20):
        assert leads_through(world, goal, y, radius=0.4)


def test_a_barn_world_can_be_passed_between_its_walls():
    layout = BarnLayout(worlds=12)
    for world in layout.table(3, 12):
        assert leads_through(world, (layout.lead + 6.0 + 1.0, 0.0), 2.6, radius=0.35)


@pytest.mark.parametrize(
    ("layout", "goal"), [(_MAZE, _MAZE.goal), (_SPARSE, (11.0, 0.0)), (_BARN, (9.0, 0.0)), (_HOLD, (0.0, 0.0))]
)
def test_start_and_goal_are_free(layout, goal):
    ends = np.array([(0.0, 0.0), goal])
    assert min(distance_to_boxes(ends, world).min() for world in layout.table(0, 24)) > 0.5


@pytest.mark.parametrize("layout", [_MAZE, _SPARSE, _HOLD, _BARN])
def test_tables_repeat_by_seed(layout):
    table = layout.table(5, 24)
    assert table.shape == (24, layout.count, 6)
    np.testing.assert_array_equal(table, layout.table(5, 24))
    assert not np.array_equal(table, layout.table(6, 24), equal_nan=True)
    assert len({world.tobytes() for world in table}) == 24
    absent = np.isnan(table).any(-1)
    np.testing.assert_array_equal(absent, np.isnan(table).all(-1))
    assert (table[~absent][:, 3:] > 0).all()


# ---- maze ------------------------------------------------------------------------------------------------------------


def test_a_maze_has_its_walls_and_a_closed_border():
    layout = MazeLayout(columns=4, rows=3, cell=2.0, walls=5, thickness=(0.2, 0.2), height=(0.5, 1.5), depth=1.0)
    table = layout.table(0, 50)
    assert layout.count == 5 + 4 + 4  # border: 8 m in two pieces, 6 m in two, twice each
    np.testing.assert_allclose(table[:, :5, 3], 1.1)  # an edge and half a thickness
    np.testing.assert_allclose(table[:, :, 4], 0.1)
    height = 2 * table[..., 5] - layout.depth
    assert height.min() >= 0.5
    assert height.max() <= 1.5
    assert {tuple(wall[:3].round(6)) for world in table for wall in world[:5]} <= {
        *((2.0 * i + 1.0, 2.0 * j, round(np.pi / 2, 6)) for i in range(3) for j in (-1, 0, 1)),
        *((2.0 * i, 2.0 * j + 1.0, 0.0) for i in range(4) for j in (-1, 0)),
    }
    around = np.array(
        [(x, side * 3.0) for x in np.arange(-1, 7, 0.05) for side in (-1, 1)]
        + [(x, y) for y in np.arange(-3, 3, 0.05) for x in (-1.0, 7.0)]
    )
    assert distance_to_boxes(around, table[0, 5:]).max() == 0.0


@pytest.mark.parametrize("layout", [_MAZE, MazeLayout(walls=32, lanes=(2, 5, 7))])
def test_the_way_through_a_maze_is_free_and_short(layout):
    table, routes = layout.table(7, 25), layout.routes(7, 25)
    for world, route in zip(table, routes, strict=True):
        np.testing.assert_array_equal(route[[0, -1]], [(0.0, 0.0), layout.goal])
        steps = np.abs(np.diff(route, axis=0))
        assert set(steps.sum(1)) <= {2.0 / ROUTE_PIECES, 0.0}  # towards the next cell, or at the goal
        dense = np.concatenate([np.linspace(a, b, 3) for a, b in itertools.pairwise(route)])
        assert distance_to_boxes(dense, world).min() > 0.75
    lengths = np.abs(np.diff(routes, axis=1)).sum((1, 2))
    assert lengths.min() >= 18.0
    assert lengths.max() == 2.0 / ROUTE_PIECES * (routes.shape[1] - 1)
    straight = MazeLayout(columns=4, rows=3, walls=0)
    np.testing.assert_array_equal(straight.routes(0, 1)[0, ::ROUTE_PIECES], [(0, 0), (2, 0), (4, 0), (6, 0)])


def test_no_wall_stands_across_a_lane():
    layout = MazeLayout(walls=30, lanes=(4,))
    ys = np.arange(-4.0, 4.0, 0.1)
    lane = np.column_stack((np.full(len(ys), 8.0), ys))
    for world in layout.table(1, 30):
        assert distance_to_boxes(lane, world).min() > 0.7


# ---- blocks ----------------------------------------------------------------------------------------------------------


def test_clusters_are_two_boxes_that_touch():
    table = BlocksLayout(jitter=0.0, stagger=0.0).table(2, 40).reshape(40, 9, 2, 6)
    first, second = table[:, :, 0], table[:, :, 1]
    np.testing.assert_array_equal(first[..., 2], second[..., 2])
    aside = np.stack((-np.sin(first[..., 2]), np.cos(first[..., 2])), -1)
    apart = ((second[..., :2] - first[..., :2]) * aside).sum(-1)
    np.testing.assert_allclose(apart, first[..., 4] + second[..., 4], atol=1e-12)
    sides = 2 * table[..., 4]
    assert 0.08 <= sides.min() < 0.12
    assert 0.3 < sides.max() <= 0.36
    pillars = table[..., 3] / table[..., 4]
    np.testing.assert_allclose(pillars[:, :, 0], 2.0)  # two square pillars, and one or two beside them
    assert set(pillars[:, :, 1].round(9).ravel()) == {1.0, 2.0}
    np.testing.assert_allclose(first[0, :, 0] - first[0, 0, 0], np.repeat([0, 3, 6], 3), atol=0.4)


def test_clusters_near_the_origin_are_left_out():
    table = _HOLD.table(0, 50)
    present = ~np.isnan(table[..., 0])
    assert np.hypot(table[..., 0], table[..., 1])[present].min() > 3.0 - 0.5  # centres of boxes, not of clusters
    np.testing.assert_array_equal(present[:, ::2], present[:, 1::2])
    assert 0 < present.mean() < 1


# ---- barn ------------------------------------------------------------------------------------------------------------


def _drawn(*lines: str) -> np.ndarray:
    """Grid (nx, ny) of a picture: x to the right, the first line is y = 0."""
    return np.array([[character == "#" for character in line] for line in lines]).T


def test_smoothing_counts_neighbours():
    rng = np.random.default_rng(0)
    grid = rng.random((7, 9)) < 0.4
    expected = np.zeros_like(grid)
    for x in range(7):
        for y in range(9):
            around = [(x + i, y + j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
            filled = sum(not 0 <= b < 9 or (0 <= a < 7 and grid[a, b]) for a, b in around)
            expected[x, y] = filled >= 5 or (grid[x, y] and filled > 1)
    np.testing.assert_array_equal(smoothed(grid), expected)
    np.testing.assert_array_equal(smoothed(np.stack((grid, ~grid)))[0], expected)


def test_inflated_is_where_a_square_would_overlap():
    grid = np.zeros((9, 9), dtype=bool)
    grid[4, 6] = True
    expected = np.zeros_like(grid)
    expected[3:6, 5:8] = True
    expected[:, [0, -1]] = True  # beyond the sides counts as filled
    np.testing.assert_array_equal(inflated(grid, 1), expected)


def test_passable_only_where_the_square_fits():
    gap = _drawn("#####", ".....", ".....", ".....", "#####")
    narrow = _drawn("#####", "..#..", ".....", ".....", "#####")
    np.testing.assert_array_equal(passable(np.stack((gap, narrow)), 1), [True, False])
    np.testing.assert_array_equal(passable(np.stack((gap, narrow)), 0), [True, True])


@pytest.mark.parametrize("seed", range(8))
def test_rectangles_cover_exactly_the_filled_cells(seed):
    grid = smoothed(np.random.default_rng(seed).random((12, 17)) < 0.35)
    covered = np.zeros_like(grid)
    for x, y, x_end, y_end in rectangles(grid):
        covered[x:x_end, y:y_end] = True
    np.testing.assert_array_equal(covered, grid)


def test_few_rectangles():
    assert len(rectangles(_drawn("####", "####", "##..", "##.."))) == 2
    assert len(rectangles(_drawn(".#.", "###", ".#."))) == 2  # a cross: they may overlap
    assert len(rectangles(np.zeros((3, 3), dtype=bool))) == 0


def test_boxes_cover_exactly_the_automatons_cells():
    table, grids = _BARN.table(4, 24), _BARN.grids(4, 24)
    middles = (np.stack(np.mgrid[:30, :30], -1) + 0.5) * 0.2 + [1.5, -3.0]
    for world, grid in zip(table, grids, strict=True):
        inside = distance_to_boxes(middles.reshape(-1, 2), world) == 0.0
        np.testing.assert_array_equal(inside.reshape(30, 30), grid)


def test_each_setting_of_the_automaton_has_its_share_of_the_worlds():
    thin, thick = BarnLayout(fill=(0.1, 0.3), smoothing=(2,), boxes=120).grids(0, 40).reshape(2, 20, -1).mean(-1)
    assert thin.max() < thick.min()


# ---- wrong input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MazeLayout(rows=4), "odd number of rows"),
        (lambda: MazeLayout(walls=80), "in 0 to 36"),
        (lambda: MazeLayout(lanes=(10,)), "lanes"),
        (lambda: MazeLayout(thickness=(0.0, 0.1)), "thickness"),
        (lambda: BlocksLayout(grid=(0, 3)), "grid"),
        (lambda: BlocksLayout(area=(1.0, 0.0, 0.0, 1.0)), "area"),
        (lambda: BlocksLayout(jitter=-0.1), "jitter"),
        (lambda: BarnLayout(fill=(0.8,)), "fill"),
        (lambda: BarnLayout(worlds=0), "worlds=0"),
        (lambda: BarnLayout(robot=15), "robot=15"),
        (lambda: BarnLayout(boxes=1), "boxes=1"),
        (
            lambda: BarnLayout(worlds=1, fill=(0.5,), robot=14).table(1, 1),
            r"none of 32000 .*of 29 cells.*fill=0\.5 or robot=14",
        ),
    ],
)
def test_wrong_layouts_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


class TestCorridor:
    layout = CorridorLayout(width=(2.5, 7.0), length=(8.0, 16.0), margin=0.4, lead=1.0, depth=0.5)

    def test_what_is_between_the_walls_is_as_wide_and_long_as_asked_for(self):
        widths, lengths = [], []
        for world, (x_low, x_high, y_low, y_high) in zip(
            self.layout.table(3, 200), self.layout.areas(3, 200), strict=True
        ):
            left, right, back = world[:4], world[4:8], world[8]
            inner = [left[:, 1] - left[:, 4], -right[:, 1] - right[:, 4]]
            np.testing.assert_allclose(inner, inner[0][0])
            widths.append(2 * inner[0][0])
            ends = left[:, [0]] + left[:, [3]] * [-1, 1]
            np.testing.assert_allclose(ends[1:, 0], ends[:-1, 1])  # end to end
            np.testing.assert_allclose([ends[0, 0], back[0] + back[3]], -self.layout.back)
            assert back[4] >= inner[0][0]  # closed behind
            lengths.append(ends[-1, 1])
            np.testing.assert_allclose((x_low, x_high, y_high), (1.0, lengths[-1], inner[0][0] - 0.4))
            assert y_low == -y_high
            assert 0.6 + 0.5 <= 2 * world[0, 5] <= 2.0 + 0.5
        for drawn, (low, high) in ((widths, self.layout.width), (lengths, self.layout.length)):
            assert low <= min(drawn) < low + 0.1 * (high - low) and high >= max(drawn) > high - 0.1 * (high - low)
            assert np.mean(drawn) == pytest.approx((low + high) / 2, abs=0.1 * (high - low))

    def test_worlds_follow_from_the_seed_and_their_number(self):
        np.testing.assert_array_equal(self.layout.table(1, 3), self.layout.table(1, 9)[:3])
        assert not np.array_equal(self.layout.table(1, 3), self.layout.table(2, 3))

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"width": (0.5, 1.0)}, "leaves no room with margin=0.3"),
            ({"length": (1.0, 2.0)}, "must be beyond lead=1.5"),
            ({"pieces": 0}, "pieces=0 must be at least 1"),
            ({"width": (3.0, 2.0)}, r"must be \[low, high\] with 0 < low <= high"),
        ],
    )
    def test_impossible_corridors_are_refused(self, settings, message):
        with pytest.raises(ValueError, match=message):
            CorridorLayout(**settings)
