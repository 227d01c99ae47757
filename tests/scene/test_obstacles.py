"""Where obstacles are placed and how they move."""

import math

import pytest
import torch
from fields import make_field

from omniperception.scene import ApproachConfig, ObstacleGroup, ObstaclesConfig
from omniperception.scene.obstacle_field import PARKED_HEIGHT
from omniperception.scene.obstacles import ObstacleCurriculumConfig


def field_of(num_envs=2000, seed=0, speed=(0.0, 1.0), **settings):
    groups = {
        "post": ObstacleGroup("cylinder", 3, [[0.1, 0.4], [0.5, 0.9]], speed),
        "crate": ObstacleGroup("box", 2, [[0.1, 0.4], [0.1, 0.4], [0.1, 0.5]], speed),
    }
    return make_field(ObstaclesConfig(groups, **settings), num_envs, seed)


def reset(field, robot_xy):
    """Distance (m) of every obstacle's edge from the robot."""
    field.reset(torch.arange(len(robot_xy)), robot_xy)
    return (field.pos_w[..., :2] - robot_xy[:, None]).norm(dim=-1) - field.radius


@pytest.mark.parametrize(
    ("boundary", "area", "some"),
    [
        ("wrap", (-5.0, 5.0, -1.0, 1.0), True),  # beyond an edge it would enter on the other side
        ("wrap", (-0.4, 0.4, -0.4, 0.4), False),
        ("bounce", (-0.4, 0.4, -0.4, 0.4), False),
    ],
)
def test_what_finds_no_place_that_keeps_the_clearance_is_not_there(boundary, area, some):
    field = field_of(64, area=area, boundary=boundary, clearance=0.8)
    robot = torch.zeros(64, 2)
    field.reset(torch.arange(64), robot)
    assert bool(field.root_active.any()) == some
    for _ in range(2):
        edge = field.root_pos_w[..., :2].norm(dim=-1) - field.root_radius
        assert bool((edge >= 0.8 - 1e-6)[field.root_active].all())
        field.root_velocity_w.zero_()
        field.advance(0.02, robot)


@pytest.mark.parametrize("boundary", ["bounce", "wrap"])
@pytest.mark.parametrize("where", ["centre", "anywhere", "corner"])
@pytest.mark.parametrize("seed", range(3))
def test_never_on_the_robot_at_a_reset(boundary, where, seed):
    field = field_of(seed=seed, area=(-2.0, 2.0, -1.5, 1.5), boundary=boundary, clearance=0.8)
    generator = torch.Generator().manual_seed(seed)
    robot_xy = (torch.rand(2000, 2, generator=generator) * 2 - 1) * torch.tensor([2.0, 1.5])
    robot_xy = {"centre": 0 * robot_xy, "anywhere": robot_xy, "corner": 0 * robot_xy + torch.tensor([2.0, -1.5])}[where]
    assert reset(field, robot_xy).min() >= 0.8 - 1e-6
    if boundary == "bounce":
        assert (field.pos_w[..., :2].abs() <= torch.tensor([2.0, 1.5])).all()


def test_a_reset_fills_the_area_the_speeds_and_the_headings_evenly_and_upright():
    field = field_of(area=(-5.0, 3.0, -1.0, 7.0), boundary="bounce", clearance=0.1, speed=(0.5, 1.5))
    reset(field, torch.full((2000, 2), 100.0))
    xy = field.pos_w[..., :2].flatten(0, 1)
    torch.testing.assert_close(xy.mean(0), torch.tensor([-1.0, 3.0], dtype=torch.float64), atol=0.1, rtol=0)
    expected = torch.full((2,), 8 / math.sqrt(12), dtype=torch.float64)
    torch.testing.assert_close(xy.std(0), expected, atol=0.05, rtol=0)
    speed = field.velocity_w.norm(dim=-1)
    assert 0.5 <= speed.min() < 0.51 and 1.49 < speed.max() <= 1.5
    assert field.velocity_w.mean((0, 1)).norm() < 0.03
    assert torch.equal(field.pos_w[..., 2], torch.cat((field.size[:, :3, 1], field.size[:, 3:, 2]), 1))
    assert (field.quat_w[..., 1:3] == 0).all()
    torch.testing.assert_close(field.quat_w.norm(dim=-1), torch.ones(2000, 5, dtype=torch.float64))


@pytest.mark.parametrize("speed", [1.0, 60.0])
def test_bounce_keeps_them_inside_at_their_speed(speed):
    field = field_of(200, speed=(speed, speed), area=(-1.0, 2.0, -1.5, 1.5), boundary="bounce")
    robot = torch.full((200, 2), 50.0)
    reset(field, robot)
    turned = torch.zeros(200, 5, dtype=torch.bool)
    for _ in range(400):
        before = field.velocity_w.clone()
        field.advance(0.005, robot)
        turned |= (before != field.velocity_w).any(-1)
        from_centre = (field.pos_w[..., :2] - torch.tensor([0.5, 0.0])).abs()
        assert (from_centre <= 1.5).all()
    assert turned.float().mean() > 0.3
    torch.testing.assert_close(field.velocity_w.norm(dim=-1), torch.full((200, 5), speed).double())


def test_bounce_by_hand():
    field = field_of(1, area=(-1.0, 1.0, -1.0, 1.0), boundary="bounce")
    field.pos_w[0, 0], field.velocity_w[0, 0] = torch.tensor([0.9, 0.0, 0.5]), torch.tensor([2.0, -1.0])
    field.advance(0.1, torch.zeros(1, 2))
    assert field.pos_w[0, 0].tolist() == pytest.approx([0.9, -0.1, 0.5])  # 1.1 is reflected at 1
    assert field.velocity_w[0, 0].tolist() == [-2.0, -1.0]


def test_wrap_keeps_them_in_the_square_around_the_robot():
    field = field_of(200, area=(-3.0, 3.0, -2.0, 2.0), boundary="wrap", clearance=0.5)
    robot = torch.zeros(200, 2)
    reset(field, robot)
    for _ in range(200):
        robot = robot + torch.tensor([0.05, -0.02])
        field.advance(0.02, robot)
        offset = field.pos_w[..., :2] - robot[:, None]
        assert (offset.abs() <= torch.tensor([3.0, 2.0]) + 1e-5).all()


class TestCurriculum:
    def test_level_rises_only_below_the_error(self):
        field = field_of(2, curriculum=ObstacleCurriculumConfig(0.2, max_velocity_error=0.3, rise=0.1))
        levels = [field.level]
        for error in (0.29, 0.19, 0.3, 0.29, *[0.1] * 20):  # 0.29 is good enough to go on, not to start
            field.follow(error, 1.0)
            levels.append(field.level)
        assert levels[:5] == pytest.approx([0.0, 0.0, 0.1, 0.1, 0.2]) and levels[-1] == 1.0

    def test_level_is_the_share_of_active_obstacles_and_of_their_speed(self):
        field = field_of(speed=(1.0, 1.0), curriculum=ObstacleCurriculumConfig())
        field.level = 0.4
        reset(field, torch.zeros(2000, 2))
        assert field.active.float().mean().item() == pytest.approx(0.4, abs=0.02)
        speed = field.velocity_w.norm(dim=-1)
        torch.testing.assert_close(speed[field.active], torch.full_like(speed[field.active], 0.4))
        assert (speed[~field.active] == 0).all()
        assert (field.pos_w[..., 2][~field.active] == PARKED_HEIGHT).all()
        assert (field.pos_w[..., 2][field.active] > 0).all()


class TestSizes:
    def test_every_environment_draws_its_own_evenly_from_the_ranges_at_every_reset(self):
        field = field_of()
        reset(field, torch.zeros(2000, 2))
        post, crate = field.size[:, :3], field.size[:, 3:]
        for sizes, low, high in ((post[..., 0], 0.1, 0.4), (post[..., 1], 0.5, 0.9), (crate[..., 2], 0.1, 0.5)):
            assert low <= sizes.min() < low + 0.002 and high - 0.002 < sizes.max() <= high
            assert sizes.mean().item() == pytest.approx((low + high) / 2, abs=0.01)
            assert len(sizes.unique()) > 0.99 * sizes.numel()
        assert not post[..., 2].any()
        before = field.size.clone()
        reset(field, torch.zeros(2000, 2))
        assert (field.size != before)[..., 0].all()

    def test_what_depends_on_them_by_hand(self):
        kinds = {
            "box": ([[0.3, 0.3], [0.4, 0.4], [0.2, 0.2]], (0.3, 0.4), 0.5, 0.2),
            "cylinder": ([[0.3, 0.3], [0.7, 0.7]], (0.3, -1.0), 0.3, 0.7),
            "sphere": ([[0.3, 0.3]], (0.3, -1.0), 0.3, 0.3),
            "capsule": ([[0.3, 0.3], [0.7, 0.7]], (0.3, -1.0), 0.3, 1.0),
        }
        config = ObstaclesConfig({kind: ObstacleGroup(kind, 1, size) for kind, (size, *_) in kinds.items()})
        field = make_field(config, 1)
        reset(field, torch.zeros(1, 2))
        for k, (_, outline, radius, half_height) in enumerate(kinds.values()):
            assert field.outline[0, k].tolist() == pytest.approx(outline)
            assert field.radius[0, k].item() == pytest.approx(radius)
            assert field.pos_w[0, k, 2].item() == pytest.approx(half_height) == field.half_height[0, k].item()
        assert field.varying == ()

    def test_a_reset_of_one_environment_leaves_the_others_bit_identical(self):
        field = field_of(4, spacing=0.3)
        reset(field, torch.zeros(4, 2))
        names = ("pos_w", "quat_w", "velocity_w", "active", "size", "outline", "radius", "half_height")
        before = {name: getattr(field, name).clone() for name in names}
        field.reset(torch.tensor([2]), torch.zeros(1, 2))
        for name in names:
            assert torch.equal(getattr(field, name)[[0, 1, 3]], before[name][[0, 1, 3]]), name
        assert not torch.equal(field.size[2], before["size"][2])

    def test_a_loaded_state_goes_on_bit_identically(self):
        field, other = field_of(3), field_of(3, seed=9)
        reset(field, torch.zeros(3, 2))
        reset(other, torch.zeros(3, 2))
        other.load_state_dict(field.state_dict())
        other.pos_w.copy_(field.pos_w)  # the simulator's
        other.quat_w.copy_(field.quat_w)
        assert torch.equal(other.radius, field.radius) and torch.equal(other.outline, field.outline)
        for one in (field, other):
            one.travel(0.005, 4, torch.zeros(3, 2))
        assert torch.equal(other.pos_w, field.pos_w)


def test_fixed_poses_hold_in_every_environment_whatever_moves_around_them():
    groups = {
        "wall": ObstacleGroup(
            "box", 2, [[0.1, 0.2], [1.0, 1.0], [0.5, 0.5]], poses=[[9.0, 2.0, 90.0], [0.0, 0.0, 0.0]]
        ),
        "post": ObstacleGroup("cylinder", 1, [[0.1, 0.1], [0.5, 0.5]], [1.0, 1.0]),
    }
    for boundary in ("bounce", "wrap"):
        config = ObstaclesConfig(groups, boundary=boundary, spacing=0.5, curriculum=ObstacleCurriculumConfig())
        field = make_field(config, 50)
        reset(field, torch.zeros(50, 2))  # one stands on the robot: it is there all the same
        for _ in range(20):
            field.travel(0.1, 3, torch.full((50, 2), 3.0))
        assert field.active[:, :2].all() and not field.active[:, 2].any()
        expected = torch.tensor([[9.0, 2.0, 0.5], [0.0, 0.0, 0.5]]).double()
        assert torch.equal(field.pos_w[:, :2], expected.expand(50, 2, 3))
        torch.testing.assert_close(field.yaw[:, :2], torch.tensor([math.pi / 2, 0.0]).double().expand(50, 2))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"size": [[0.1, 0.2]]}, "has 2 size ranges"),
        ({"size": [[0.2, 0.1], [0.5, 0.5]]}, "0 < low <= high"),
        ({"speed": [1.0, 1.0], "poses": [[0.0, 0.0, 0.0]]}, "fixed poses or a layout stands"),
        ({"approach": ApproachConfig(0.2, [3.0, 4.0])}, "approaches must be positive"),
    ],
)
def test_wrong_groups_are_refused(settings, message):
    good = {"kind": "cylinder", "count": 1, "size": [[0.1, 0.2], [0.5, 0.6]]}
    with pytest.raises(ValueError, match=message):
        ObstacleGroup(**{**good, **settings})


def test_a_wall_may_reach_into_the_ground():
    wall = ObstacleGroup("box", 1, [[1.0, 1.0], [0.1, 0.1], [0.8, 0.8]], poses=[[3.0, 0.0, 90.0]], bottom=[-0.6, -0.6])
    field = make_field(ObstaclesConfig({"wall": wall}), 2)
    reset(field, torch.zeros(2, 2))
    assert field.pos_w[:, 0].tolist() == [pytest.approx([3.0, 0.0, 0.2])] * 2  # 1 m of 1.6 m stands out
    assert field.bottom_above_ground()[:, 0].tolist() == pytest.approx([-0.6] * 2)
