"""Where obstacles are placed and how they move."""

import math

import pytest
import torch

from omniperception.common.random import EnvRandom
from omniperception.scene import ObstacleField, ObstacleGroup, ObstaclesConfig
from omniperception.scene.obstacle_field import PARKED_HEIGHT
from omniperception.scene.obstacles import ApproachConfig, CurriculumConfig


def field_of(num_envs=2000, seed=0, speed=(0.0, 1.0), **settings):
    groups = {
        "post": ObstacleGroup("cylinder", 3, [[0.1, 0.4], [0.5, 0.9]], speed),
        "crate": ObstacleGroup("box", 2, [[0.1, 0.4], [0.1, 0.4], [0.1, 0.5]], speed),
    }
    config = ObstaclesConfig(groups, **settings)
    pos, quat = (torch.zeros(num_envs, 5, n, dtype=torch.float64) for n in (3, 4))
    return ObstacleField(config, pos, quat, EnvRandom(seed, num_envs))


def reset(field, robot_xy):
    """Distance (m) of every obstacle's edge from the robot."""
    field.reset(torch.arange(len(robot_xy)), robot_xy)
    return (field.pos_w[..., :2] - robot_xy[:, None]).norm(dim=-1) - field.radius


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
    heights = torch.tensor([slot.half_height for slot in field.config.slots()], dtype=torch.float64)
    assert torch.equal(field.pos_w[..., 2], heights.expand(2000, 5))
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
        field = field_of(2, curriculum=CurriculumConfig(0.2, max_velocity_error=0.3, rise=0.1))
        levels = [field.level]
        for error in (0.29, 0.19, 0.3, 0.29, *[0.1] * 20):  # 0.29 is good enough to go on, not to start
            field.raise_level(error, 1.0)
            levels.append(field.level)
        assert levels[:5] == pytest.approx([0.0, 0.0, 0.1, 0.1, 0.2]) and levels[-1] == 1.0

    def test_without_a_curriculum_everything_is_there(self):
        field = field_of(2)
        field.raise_level(0.0, 100.0)
        assert field.level == 1.0
        reset(field, torch.zeros(2, 2))
        assert field.active.all()

    def test_level_is_the_share_of_active_obstacles_and_of_their_speed(self):
        field = field_of(speed=(1.0, 1.0), curriculum=CurriculumConfig())
        field.level = 0.4
        reset(field, torch.zeros(2000, 2))
        assert field.active.float().mean().item() == pytest.approx(0.4, abs=0.02)
        speed = field.velocity_w.norm(dim=-1)
        torch.testing.assert_close(speed[field.active], torch.full_like(speed[field.active], 0.4))
        assert (speed[~field.active] == 0).all()
        assert (field.pos_w[..., 2][~field.active] == PARKED_HEIGHT).all()
        assert (field.pos_w[..., 2][field.active] > 0).all()


def test_slots_are_the_same_every_time_and_another_seed_differs():
    config = field_of(1).config
    assert config.slots() == config.slots()
    other = field_of(1, shape_seed=1).config
    assert [s.size for s in other.slots()] != [s.size for s in config.slots()]
    for slot, radius in zip(config.slots(), field_of(1).radius.tolist(), strict=True):
        footprint = slot.size[0] if slot.kind == "cylinder" else math.hypot(slot.size[0], slot.size[1])
        assert radius == pytest.approx(footprint)
        low, high = (0.5, 0.9) if slot.kind == "cylinder" else (0.1, 0.5)
        assert 0.1 <= slot.size[0] <= 0.4 and low <= slot.half_height <= high


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "cone"}, "kind=cone is unknown"),
        ({"count": 0}, "count=0"),
        ({"size": [[0.1, 0.2]]}, "has 2 size ranges"),
        ({"size": [[0.2, 0.1], [0.5, 0.5]]}, "0 < low <= high"),
        ({"speed": (-1.0, 1.0)}, "speed="),
        ({"poses": [[0.0, 0.0]]}, "poses must be 1 triples"),
        ({"bottom": [0.5, 0.4]}, r"bottom=\[0\.5, 0\.4\]"),
        ({"bottom": [-0.1, 0.4]}, "below the ground"),
        ({"bottom": [0.1, 0.4], "poses": [[0.0, 0.0, 0.0]]}, "leave out bottom"),
        ({"heading_deg": [90.0]}, "heading_deg"),
        ({"yaw_deg": [30.0, -30.0]}, "yaw_deg"),
        ({"area": [0.0, 1.0, 1.0]}, "a group's area"),
        ({"approach": ApproachConfig(0.2, [3.0, 4.0])}, "approaches must be positive"),
    ],
)
def test_wrong_groups_are_refused(settings, message):
    good = {"kind": "cylinder", "count": 1, "size": [[0.1, 0.2], [0.5, 0.6]]}
    with pytest.raises(ValueError, match=message):
        ObstacleGroup(**{**good, **settings})
