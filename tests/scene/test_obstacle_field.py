"""Hanging, crossing and approaching obstacles, spacing and free paths: hand-computed cases and a separate planner."""

import math
from collections import deque

import numpy as np
import pytest
import torch
from fields import make_field

from omniperception import build, config
from omniperception.common.random import EnvRandom
from omniperception.scene import ApproachConfig, FreePathConfig, ObstacleGroup, ObstaclesConfig
from omniperception.scene.obstacle_field import PARKED_HEIGHT
from omniperception.scene.obstacle_motion import LOSE_SIGHT, passing_velocity
from omniperception.scene.placement import bent_path, distance_to_path

POST = [[0.3, 0.3], [0.5, 0.5]]


def built(groups, num_envs=500, seed=0, **settings):
    settings = {"area": (-5.0, 5.0, -4.0, 4.0), "clearance": 0.5, **settings}
    return make_field(ObstaclesConfig(groups, **settings), num_envs, seed)


def reset(field, robot=(0.0, 0.0), command=(0.0, 0.0), goal=None):
    n = field.pos_w.shape[0]
    goal = None if goal is None else torch.tensor(goal).expand(n, 2)
    env_ids, robot = torch.arange(n), torch.tensor(robot).expand(n, 2)
    field.reset(env_ids, robot, goal, lambda: torch.tensor(command).expand(n, 2))


class TestRanges:
    def test_what_hangs_has_its_lowest_point_in_the_range(self):
        field = built(
            {
                "ball": ObstacleGroup("sphere", 1, [[0.2, 0.2]], bottom=[0.3, 0.5]),
                "bar": ObstacleGroup("box", 1, [[0.05, 0.05], [0.6, 0.6], [0.04, 0.04]], bottom=[1.0, 1.0]),
                "post": ObstacleGroup("cylinder", 1, POST),
            }
        )
        reset(field)
        lowest = field.pos_w[..., 2] - torch.tensor([0.2, 0.04, 0.5])
        assert 0.3 <= lowest[:, 0].min() < 0.31 and 0.49 < lowest[:, 0].max() <= 0.5
        torch.testing.assert_close(lowest[:, 1:], torch.tensor([1.0, 0.0]).double().expand(500, 2))

    def test_headings_and_orientations_lie_in_their_ranges(self):
        field = built(
            {"post": ObstacleGroup("cylinder", 2, POST, [1.0, 1.0], heading_deg=[60, 120], yaw_deg=[-10, 30])}
        )
        reset(field)
        heading = torch.rad2deg(torch.atan2(field.velocity_w[..., 1], field.velocity_w[..., 0]))
        assert 60 <= heading.min() < 61 and 119 < heading.max() <= 120
        yaw = torch.rad2deg(2 * torch.atan2(field.quat_w[..., 3], field.quat_w[..., 0]))
        assert -10 <= yaw.min() < -9 and 29 < yaw.max() <= 30

    def test_a_group_keeps_to_its_own_area(self):
        walks = ObstacleGroup("cylinder", 1, POST, [2.0, 2.0], area=[2.0, 3.0, -1.0, 0.0])
        field = built({"own": walks, "other": ObstacleGroup("cylinder", 1, POST, [2.0, 2.0])})
        robot = torch.full((500, 2), 50.0)
        reset(field, (50.0, 50.0))
        for _ in range(100):
            field.advance(0.02, robot)
            x, y = field.pos_w[:, 0, :2].unbind(1)
            assert x.min() >= 2 and x.max() <= 3 and y.min() >= -1 and y.max() <= 0
        assert field.pos_w[:, 1, 0].min() < -4 and field.pos_w[:, 1, 0].max() > 4


class TestApproach:
    @pytest.mark.parametrize(
        ("bearing", "speed", "robot_vel", "expected"),
        [
            ((1.0, 0.0), 1.0, (0.0, 0.0), (-1.0, 0.0)),  # the robot stands
            ((1.0, 0.0), 0.5, (0.8, 0.0), (-0.5, 0.0)),  # head on: they meet at the sum of their speeds
            ((-1.0, 0.0), 1.5, (1.0, 0.0), (1.5, 0.0)),  # overtakes from behind
            ((-1.0, 0.0), 0.5, (1.0, 0.0), (0.5, 0.0)),  # cannot overtake: goes where the robot is
            ((0.0, 1.0), 1.0, (0.6, 0.0), (0.6, -0.8)),  # from the side: 3-4-5
        ],
    )
    def test_course_by_hand(self, bearing, speed, robot_vel, expected):
        bearing, robot_vel = torch.tensor(bearing), torch.tensor(robot_vel)
        got = passing_velocity(bearing, torch.tensor(4.0), torch.tensor(0.0), torch.tensor(speed), robot_vel)
        torch.testing.assert_close(got, torch.tensor(expected), atol=1e-6, rtol=0)

    def approaching(self, num_envs=400, within=0.4, speed=(1.0, 1.5)):
        approach = ApproachConfig(within, [3.0, 6.0])
        return built({"person": ObstacleGroup("cylinder", 2, POST, speed, approach=approach)}, num_envs)

    @pytest.mark.parametrize("command", [(0.0, 0.0), (0.8, 0.0), (-0.3, 0.6)])
    def test_passes_a_robot_that_keeps_its_velocity_within_the_distance(self, command):
        field, velocity = self.approaching(), torch.tensor(command)
        robot = torch.full((400, 2), 7.0)
        reset(field, (7.0, 7.0), command)
        nearest = torch.full((400, 2), torch.inf, dtype=torch.float64)
        for _ in range(3000):  # 30 s: even what comes from behind at 1 m/s arrives
            nearest = torch.minimum(nearest, (field.pos_w[..., :2] - robot[:, None]).norm(dim=-1))
            field.advance(0.01, robot)
            robot = robot + velocity * 0.01
        assert nearest.max() <= 0.4 + 1e-3
        assert nearest.mean().item() == pytest.approx(0.2, abs=0.02)  # uniform misses

    def test_comes_from_all_sides_within_the_start_distances_at_its_speed(self):
        field = self.approaching(2000)
        reset(field, (1.0, -2.0), (0.5, 0.0))
        offset = field.pos_w[..., :2] - torch.tensor([1.0, -2.0])
        distance = offset.norm(dim=-1)
        assert 3 <= distance.min() < 3.05 and 5.95 < distance.max() <= 6
        counts = torch.histc(torch.atan2(offset[..., 1], offset[..., 0]), 8, -math.pi, math.pi)
        assert counts.min() > 420 and counts.max() < 580  # 500 each
        speed = field.velocity_w.norm(dim=-1)
        assert 1.0 <= speed.min() < 1.01 and 1.49 < speed.max() <= 1.5 + 1e-9

    def test_starts_again_once_it_is_far_behind_and_not_before(self):
        field = self.approaching(3)
        robot, command = torch.zeros(3, 2), torch.zeros(3, 2)
        reset(field)
        field.pos_w[0, 1, :2] = torch.tensor([6.0 + LOSE_SIGHT + 0.01, 0.0])
        field.pos_w[1, 0, :2] = torch.tensor([0.0, 6.0 + LOSE_SIGHT - 0.01])
        pos, velocity, counter = field.pos_w.clone(), field.velocity_w.clone(), field._random.counter.clone()
        field.restart_approaching(robot, command)
        assert 3 <= field.pos_w[0, 1, :2].norm() <= 6
        changed = (field.pos_w != pos).any(-1)
        assert changed.tolist() == [[False, True], [False, False], [False, False]]
        assert field.velocity_w[0, 1].norm().item() == pytest.approx(velocity[0, 1].norm().item())
        assert (field._random.counter != counter).tolist() == [True, False, False]

    @pytest.mark.parametrize("boundary", ["bounce", "wrap"])
    def test_neither_area_nor_boundary_holds_it(self, boundary):
        approach = ApproachConfig(0.1, [3.0, 3.0])
        field = built(
            {"person": ObstacleGroup("cylinder", 1, POST, [1.0, 1.0], approach=approach)},
            20,
            area=(-0.5, 0.5, -0.5, 0.5),
            boundary=boundary,
        )
        reset(field)
        velocity = field.velocity_w.clone()
        before = field.pos_w[..., :2].clone()
        field.advance(0.1, torch.zeros(20, 2))
        torch.testing.assert_close(field.pos_w[..., :2], before + velocity * 0.1)

    def test_parked_obstacles_stay_parked(self):
        field = self.approaching(50)
        field.level = 0.0
        reset(field)
        field.restart_approaching(torch.full((50, 2), 100.0), torch.zeros(50, 2))
        assert (field.pos_w[..., 2] == PARKED_HEIGHT).all() and (field.velocity_w == 0).all()


class TestPath:
    def test_bends_by_hand(self):
        path = bent_path(torch.tensor([[0.0, 0.0]]), torch.tensor([[0.0, 6.0]]), torch.tensor([[1.0, -0.5]]))
        # going along +y, left is -x
        assert path[0].tolist() == [[0.0, 0.0], [-1.0, 2.0], [0.5, 4.0], [0.0, 6.0]]

    def test_distances_by_hand(self):
        path = torch.tensor([[[0.0, 0.0], [2.0, 0.0], [2.0, 2.0]]])
        points = torch.tensor([[[1.0, 0.5], [-3.0, 4.0], [3.0, 1.0], [2.0, 5.0], [1.5, 0.6]]])
        assert distance_to_path(points, path)[0].tolist() == pytest.approx([0.5, 5.0, 1.0, 3.0, 0.5])

    def test_without_a_bend_the_straight_way_is_free_of_what_stands_low(self):
        field = built(
            {
                "post": ObstacleGroup("cylinder", 4, POST),
                "low": ObstacleGroup("sphere", 1, [[0.3, 0.3]], bottom=[0.4, 0.4]),
                "walker": ObstacleGroup("cylinder", 1, POST, [1.0, 1.0]),
                "high": ObstacleGroup("sphere", 1, [[0.3, 0.3]], bottom=[0.5, 0.5]),
            },
            area=(1.0, 7.0, -1.5, 1.5),
            free_path=FreePathConfig(width=0.8, bend=0.0),
            headroom=0.45,
        )
        reset(field, goal=(8.0, 0.0))
        assert field.active.float().mean() > 0.999
        off = torch.where(field.active, field.pos_w[..., 1].abs(), torch.inf).amin(0)
        assert off[:5].min() >= 0.3 + 0.4 and off[5:].max() < 0.1

    def test_an_obstacle_without_a_place_is_left_out(self):
        field = built(
            {"post": ObstacleGroup("cylinder", 2, POST)},
            area=(1.0, 7.0, -0.4, 0.4),
            free_path=FreePathConfig(0.8, 0.0),
        )
        reset(field, goal=(8.0, 0.0))
        assert not field.active.any() and (field.pos_w[..., 2] == PARKED_HEIGHT).all()


def test_spacing_is_kept_between_what_stands():
    field = built(
        {
            "post": ObstacleGroup("cylinder", 3, POST),
            "crate": ObstacleGroup("box", 2, [[0.2, 0.2], [0.4, 0.4], [0.2, 0.2]]),
            "high": ObstacleGroup("sphere", 1, [[0.3, 0.3]], bottom=[2.0, 2.0]),
        },
        spacing=0.7,
    )
    reset(field, (50.0, 50.0))
    assert field.active.float().mean() > 0.999
    between = (field.pos_w[:, :, None, :2] - field.pos_w[:, None, :, :2]).norm(dim=-1)
    gap = between - field.radius[:, :, None] - field.radius[:, None]
    both = (field.active[:, :, None] & field.active[:, None]) & ~torch.eye(6, dtype=torch.bool)
    standing = both.clone()
    standing[:, 5] = standing[:, :, 5] = False
    assert gap[standing].min() >= 0.7 - 1e-9
    assert gap[both & ~standing].min() < 0.0  # what hangs overhead may be anywhere


def reachable(discs, start, goal, robot_radius, band, cell=0.04):
    """Whether a disc can go from start to goal among discs (x, y, radius) inside a band |y|: flood fill of a grid."""
    x = np.arange(-0.6, goal[0] + 0.6, cell)
    y = np.arange(-band, band + cell / 2, cell)
    free = np.ones((len(x), len(y)), dtype=bool)
    for disc_x, disc_y, radius in discs:
        free &= np.hypot(x[:, None] - disc_x, y[None] - disc_y) >= radius + robot_radius
    cells = [(int(np.abs(x - p[0]).argmin()), int(np.abs(y - p[1]).argmin())) for p in (start, goal)]
    seen, queue = np.zeros_like(free), deque([cells[0]])
    seen[cells[0]] = True
    while queue:
        i, j = queue.popleft()
        if (i, j) == cells[1]:
            return bool(free[cells[0]])
        for a, b in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if 0 <= a < len(x) and 0 <= b < len(y) and free[a, b] and not seen[a, b]:
                seen[a, b] = True
                queue.append((a, b))
    return False


class TestFeasible:
    """A path is found by somebody who does not know how it was kept free."""

    def discs(self, field, env_id):
        active = field.active[env_id]
        return torch.cat((field.pos_w[env_id, active, :2], field.radius[env_id, active, None]), 1).tolist()

    def test_every_scene_of_the_hardest_test(self):
        run = build.assemble(config.compose(["experiment=walk", "scenario=abs_hard"])).env
        count, n = run.obstacles.num_obstacles, 60
        field = make_field(run.obstacles, n, seed=7)
        uniform = EnvRandom(8, n).uniform(torch.arange(n), (4,))
        start = uniform[:, :2] * 0.2 - 0.1
        goal = uniform[:, 2:] * torch.tensor([1.5, 3.0]) + torch.tensor([6.0, -1.5])
        field.reset(torch.arange(n), start, goal)
        assert count == 8 and field.active.all() and (field.radius == 0.4).all()
        x, y = field.pos_w[..., 0], field.pos_w[..., 1]
        assert x.min() >= 1.5 and x.max() <= 7 and y.abs().max() <= 2
        assert (field.pos_w[..., :2] - start[:, None]).norm(dim=-1).min() >= 1.1
        for i in range(n):
            # half the width, less what the grid's cells take
            assert reachable(self.discs(field, i), start[i].tolist(), goal[i].tolist(), 0.35 - 0.04, 2.7), i

    def test_only_the_path_makes_a_narrow_passage_feasible(self):
        groups = {"post": ObstacleGroup("cylinder", 10, POST)}
        found = {}
        for path in (None, FreePathConfig(0.7, 0.3)):
            field = built(groups, 40, area=(1.5, 6.0, -1.0, 1.0), free_path=path)
            reset(field, goal=(7.0, 0.0))
            found[path is None] = [
                reachable(self.discs(field, i), (0.0, 0.0), (7.0, 0.0), 0.31, 1.0) for i in range(40)
            ]
        assert all(found[False]) and sum(found[True]) < 20
