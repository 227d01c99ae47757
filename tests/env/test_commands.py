"""Velocity and goal commands."""

import math

import pytest
import torch

from omniperception.common.random import EnvRandom
from omniperception.common.rotations import yaw_quat
from omniperception.env.kinematics import Kinematics
from omniperception.env.mdp.commands import (
    GoalCommandConfig,
    SpawnConfig,
    VelocityCommandConfig,
)
from omniperception.env.mdp.curriculum import CurriculumConfig
from omnirobot.common.errors import ConfigError

N = 4000


def velocity_command(**settings):
    ranges = {"lin_vel_x": (-0.5, 1.0), "lin_vel_y": (-0.3, 0.3), "ang_vel_z": (0.2, 0.8)}
    times = {"resample_s": (1.0, 1.0), "standing": 0.0}
    config = VelocityCommandConfig(**{**ranges, **times, "spawn": SpawnConfig(), **settings})
    command = config.build(N, torch.device("cpu"), EnvRandom(0, N))
    command.reset(torch.arange(N), None)
    return command


def test_commands_fill_their_ranges_and_some_stand():
    value = velocity_command().value
    low, high = torch.tensor([-0.5, -0.3, 0.2]), torch.tensor([1.0, 0.3, 0.8])
    assert (value >= low).all() and (value <= high).all()
    torch.testing.assert_close(value.amin(0), low, atol=0.01, rtol=0)
    torch.testing.assert_close(value.amax(0), high, atol=0.01, rtol=0)
    torch.testing.assert_close(value.mean(0), (low + high) / 2, atol=0.03, rtol=0)
    value = velocity_command(standing=0.3).value
    assert (value == 0).all(1).float().mean().item() == pytest.approx(0.3, abs=0.03)
    assert ((value == 0).all(1) | (value != 0).all(1)).all()


def test_resampled_after_its_time_and_not_before():
    command = velocity_command()
    first = command.value.clone()
    for _ in range(49):
        command.advance(0.02, None)
    assert torch.equal(command.value, first)
    command.advance(0.02 + 1e-4, None)
    assert (command.value != first).any(1).all()


def test_a_reset_draws_for_those_environments_only():
    command = velocity_command()
    first = command.value.clone()
    command.advance(0.5, None)
    command.reset(torch.tensor([3, 5]), None)
    changed = (command.value != first).any(1).nonzero().flatten()
    assert changed.tolist() == [3, 5]
    command.advance(0.51, None)
    assert torch.equal(command.time_left[[3, 5]], torch.full((2,), 1.0 - 0.51))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"lin_vel_x": (1.0, -1.0)}, r"commands\.lin_vel_x=\[1\.0, -1\.0\]"),
        ({"resample_s": (0.0, 1.0)}, r"commands\.resample_s"),
        ({"standing": 1.5}, r"commands\.standing"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        velocity_command(**settings)


def robots(positions, yaws):
    n = len(positions)
    qpos = torch.zeros(n, 19)
    qpos[:, :2] = torch.tensor(positions)
    qpos[:, 3:7] = yaw_quat(torch.tensor(yaws))
    return Kinematics(qpos, torch.zeros(n, 18))


class TestGoal:
    line = GoalCommandConfig((10.0, 10.0), (0.0, 0.0), None, 0.8, 2.0, 1.0, SpawnConfig())
    box = GoalCommandConfig([6.0, 7.5], [-1.5, 1.5], 0.5, 0.8, 2.0, 1.0, SpawnConfig())
    point = GoalCommandConfig((3.0, 3.0), (4.0, 4.0), 0.5, 0.8, 2.0, 1.0, SpawnConfig())

    def command(self, positions, yaws, config=line):
        kinematics = robots(positions, yaws)
        n, device = len(positions), torch.device("cpu")
        command = config.build(n, device, EnvRandom(0, n, device))
        command.reset(torch.arange(len(positions)), kinematics)
        return command.value, command.reached(kinematics, 0.0)

    def test_points_to_the_goal_in_the_base_frame(self):
        value, _ = self.command([[0.0, 0.0], [0.0, 0.0], [0.0, 11.0]], [0.0, math.pi / 2, 0.0])
        assert value[0].tolist() == pytest.approx([0.8, 0, 0], abs=1e-6)
        assert value[1].tolist() == pytest.approx([0, -0.8, -1.0], abs=1e-6)  # goal to its right, turns right
        down = 0.8 * math.sqrt(0.5)  # the aim lies 1 m beyond the line: 11 m ahead and 11 m aside
        assert value[2].tolist() == pytest.approx([down, -down, -1.0], abs=1e-6)

    def test_yaw_rate_is_proportional_and_takes_the_short_way(self):
        value, _ = self.command([[0.0, 0.0]] * 3, [0.1, 3.1, -3.1])
        assert value[:, 2].tolist() == pytest.approx([-0.2, -1.0, 1.0], abs=1e-6)

    def test_speed_is_kept_everywhere_and_the_line_is_reached_behind_it(self):
        value, reached = self.command([[9.99, 3.0], [10.01, -1.0], [-20.0, 0.5]], [0.3, -2.0, 1.0])
        torch.testing.assert_close(value[:, :2].norm(dim=1), torch.full((3,), 0.8))
        assert reached.tolist() == [False, True, False]

    def test_a_point_is_aimed_at_and_reached_within_its_radius(self):
        value, reached = self.command(
            [[0.0, 0.0], [3.0, 9.0], [3.3, 4.39], [3.3, 4.41]], [0.0, 0.0, 0.0, 0.0], self.point
        )
        assert value[0].tolist() == pytest.approx([0.48, 0.64, 1.0], abs=1e-6)  # 3-4-5
        assert value[1, :2].tolist() == pytest.approx([0.0, -0.8], abs=1e-6)
        assert reached.tolist() == [False, False, True, False]

    def test_goals_fill_their_box_and_change_with_the_episode(self):
        kinematics = robots([[0.0, 0.0]] * N, [0.0] * N)
        command = self.box.build(N, torch.device("cpu"), EnvRandom(0, N))
        command.reset(torch.arange(N), kinematics)
        goal = command.goal_w.clone()
        torch.testing.assert_close(goal.amin(0), torch.tensor([6.0, -1.5]), atol=0.01, rtol=0)
        torch.testing.assert_close(goal.amax(0), torch.tensor([7.5, 1.5]), atol=0.01, rtol=0)
        torch.testing.assert_close(goal.mean(0), torch.tensor([6.75, 0.0]), atol=0.05, rtol=0)
        command.reset(torch.tensor([2]), kinematics)
        assert (command.goal_w != goal).any(1).nonzero().flatten().tolist() == [2]

    def test_a_saved_goal_goes_on(self):
        kinematics = robots([[0.0, 0.0]] * 3, [0.0] * 3)
        first, second = (self.box.build(3, torch.device("cpu"), EnvRandom(seed, 3)) for seed in (1, 2))
        for command in (first, second):
            command.reset(torch.arange(3), kinematics)
        assert not torch.equal(first.goal_w, second.goal_w)
        second.load_state_dict(first.state_dict())
        second.advance(0.02, kinematics)
        assert torch.equal(first.goal_w, second.goal_w) and torch.equal(first.value, second.value)

    def test_a_place_to_hold_is_reached_late_and_approached_slowly(self):
        config = GoalCommandConfig(
            (0.0, 0.0), (0.0, 0.0), 0.5, 0.8, 2.0, 1.0, SpawnConfig(), slow_within=1.0, hold_s=0.05
        )
        kinematics = robots([[-0.25, 0.0], [-0.6, 0.0], [0.0, 3.0]], [0.0, 0.5, -math.pi / 2])
        command = config.build(3, torch.device("cpu"), EnvRandom(0, 3))
        command.reset(torch.arange(3), kinematics)
        assert command.value[0].tolist() == pytest.approx([0.2, 0.0, 0.0], abs=1e-6)
        assert command.value[1, 2].item() == pytest.approx(0.6 * -1.0)  # 2 * 0.5 rad, at 0.6 of 1 m
        assert command.value[2].tolist() == pytest.approx([0.8, 0.0, 0.0], abs=1e-6)
        for time_s, expected in ((0.02, False), (0.04, False), (0.06, True)):
            assert command.reached(kinematics, torch.full((3,), time_s)).tolist() == [expected, False, False]

    def test_a_place_is_held_for_as_many_steps_as_its_time_takes(self, make_env):
        """1 s of steps of 0.02 s, in an episode that is as long."""
        given = ("commands.goal_x=[0,0]", "commands.goal_y=[0,0]", "commands.radius=50", "commands.hold_s=1.0")
        env = make_env("scenario=hold", *given, "terminations.episode_length_s=1.0", num_envs=2)
        steps = 0
        while not bool(env.done.any()):
            env.step(torch.zeros(2, env.num_actions))
            steps += 1
        assert steps == 50 and bool(env.outcomes["goal"].all())

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            (([10.0, 10.0], [0.0, 0.0], None, 0.0), r"commands\.speed=0"),
            (([7.0, 6.0], [0.0, 0.0], None, 1.0), r"commands\.goal_x=\[7\.0, 6\.0\]"),
            (([7.0, 7.0], [0.0, 0.0], 0.0, 1.0), r"commands\.radius=0"),
            (([7.0, 7.0], [0.0, 0.0], 0.5, [0.0, 1.0]), r"commands\.speed=\[0\.0, 1\.0\] must be positive"),
            (
                ([7.0, 7.0], [0.0, 0.0], 0.5, [1.3, 0.7]),
                r"commands\.speed=\[1\.3, 0\.7\] must be positive or \[low",
            ),
        ],
    )
    def test_wrong_settings_are_refused(self, settings, message):
        with pytest.raises(ValueError, match=message):
            GoalCommandConfig(*settings, 2.0, 1.0, SpawnConfig())

    def test_a_speed_is_drawn_for_each_way_and_lasts(self):
        n, device = 400, torch.device("cpu")
        settings = ((10.0, 10.0), (-2.0, 2.0), 0.5)
        drawn, plain, narrow = (
            GoalCommandConfig(*settings, speed, 2.0, 1.0, SpawnConfig()).build(n, device, EnvRandom(3, n, device))
            for speed in ([0.7, 1.3], 1.1, [1.1, 1.1])
        )
        here, everybody = robots([[0.0, 0.0]] * n, [0.0] * n), torch.arange(n)
        for command in (drawn, plain, narrow):
            command.reset(everybody, here)
        speeds = drawn.value[:, :2].norm(dim=1)
        assert 0.7 <= speeds.min() < 0.71 and 1.29 < speeds.max() <= 1.3
        assert speeds.mean() == pytest.approx(1.0, abs=0.03)
        drawn.advance(0.02, robots([[1.0, 0.0]] * n, [0.5] * n))
        torch.testing.assert_close(drawn.value[:, :2].norm(dim=1), speeds)
        assert torch.equal(plain.value, narrow.value) and torch.equal(plain.goal_w, drawn.goal_w)
        saved, before = drawn.state_dict(), drawn.value.clone()
        drawn.reset(everybody[:10], here)
        assert not torch.equal(drawn.speed, saved["speed"]) and torch.equal(drawn.speed[10:], saved["speed"][10:])
        drawn.load_state_dict(saved)
        assert torch.equal(drawn.value, before) and torch.equal(drawn.speed, saved["speed"])

    def test_a_place_ahead_on_the_route_is_aimed_at(self):
        """Along an L and around a hairpin, in steps of 0.5 m, 1.5 m ahead."""
        config = GoalCommandConfig((4.0, 4.0), (0.0, 0.0), 0.5, 1.0, 2.0, 1.0, SpawnConfig(), route_ahead=1.5)
        command = config.build(2, torch.device("cpu"), EnvRandom(0, 2))
        start = robots([[0.0, 0.0], [0.0, 0.0]], [0.0, 0.0])
        command.reset(torch.arange(2), start)
        up = [[0.0, y] for y in (0.0, 0.5, 1.0, 1.5, 2.0)]
        bend = torch.tensor(up + [[x, 2.0] for x in (0.5, 1.0, 1.5, 2.0)] + 5 * [[2.0, 2.0]])
        down = [[0.5, y] for y in (2.0, 1.5, 1.0, 0.5, 0.0, -0.5, -1.0)]
        hairpin = torch.tensor(up + down + 2 * [[0.5, -1.0]])
        command.follow(torch.arange(2), torch.stack((bend, hairpin)), start)
        assert command.way(start).tolist() == pytest.approx([4.0, 5.5])
        steps = [  # places of the two robots, and what each aims at
            ((0.0, 0.0), (0.0, 1.5), (0.0, 0.2), (0.0, 1.5)),
            ((0.0, 1.0), (0.5, 2.0), (0.0, 0.9), (0.5, 2.0)),
            ((0.3, 1.6), (1.0, 2.0), (0.45, 1.0), (0.5, 2.0)),  # beside the way back, which is farther along the route
            ((0.0, 0.0), (1.0, 2.0), (0.0, 1.9), (0.5, 1.0)),  # going back does not undo
            ((1.3, 2.2), (2.0, 2.0), (0.6, 1.6), (0.5, 0.0)),
        ]
        for at, aim, at_other, aim_other in steps:
            where = robots([list(at), list(at_other)], [0.0, 0.0])
            for _ in range(3):
                command.advance(0.02, where)
            way = torch.tensor([aim, aim_other]) - torch.tensor([at, at_other])
            torch.testing.assert_close(command.value[:, :2], way / way.norm(dim=1, keepdim=True), atol=1e-6, rtol=0)
        restored = config.build(2, torch.device("cpu"), EnvRandom(0, 2))
        restored.load_state_dict(command.state_dict())
        restored.advance(0.02, where)
        command.advance(0.02, where)
        assert torch.equal(restored.value, command.value) and restored.way(where).equal(command.way(where))
        command.reset(torch.tensor([0]), start)
        command.follow(torch.tensor([0]), bend[None], start)
        assert command.value[0, :2].tolist() == pytest.approx([0.0, 1.0], abs=1e-6)

    @pytest.mark.parametrize(("radius", "ahead"), [(0.5, 0.0), (None, 3.0)])
    def test_a_route_needs_a_way_ahead_and_a_place(self, radius, ahead):
        with pytest.raises(ValueError, match=r"commands\.route_ahead"):
            GoalCommandConfig((4.0, 4.0), (0.0, 0.0), radius, 1.0, 2.0, 1.0, SpawnConfig(), route_ahead=ahead)

    @pytest.mark.parametrize(
        ("overrides", "message"),
        [
            (("scenario=static", "+commands.route_ahead=3"), "leads through a maze"),
            (("scenario=maze", "+obstacles.groups.wall.layout.cell=1.5"), r"goal is \[13.5, 13.5\] and \[0, 0\]"),
        ],
    )
    def test_routes_that_lead_elsewhere_are_refused(self, make_config, overrides, message):
        with pytest.raises(ConfigError, match=message):
            make_config(*overrides)

    def test_a_line_cannot_be_held(self):
        with pytest.raises(ValueError, match=r"commands\.hold_s=3"):
            GoalCommandConfig((1.0, 1.0), (0.0, 0.0), None, 1.0, 2.0, 1.0, SpawnConfig(), hold_s=3.0)


def test_robots_start_where_the_preset_says(make_env):
    env = make_env("commands=corridor", "obstacles=corridor", blind=True, num_envs=200)
    pos = env.sim.qpos
    assert (pos[:, 0] == -0.5).all() and (env.state.kinematics.yaw.abs() < 1e-6).all()
    assert pos[:, 1].min() < -0.45 and pos[:, 1].max() > 0.45 and pos[:, 1].abs().max() <= 0.5
    assert torch.equal(pos[:, 2], torch.full((200,), 0.33, dtype=torch.float32).double())


def test_times_between_draws_fill_their_range():
    time_left = velocity_command(resample_s=(1.0, 5.0)).time_left
    assert time_left.min() >= 1.0 and time_left.max() <= 5.0
    assert time_left.mean().item() == pytest.approx(3.0, abs=0.1)


def test_a_command_is_settled_half_a_second_after_its_draw():
    command = velocity_command()
    settled = []
    for _ in range(8):  # drawn again after 1 s
        settled.append(bool(command.settled.all()))
        command.advance(0.125 + 2**-20, None)
        settled.append(bool(command.settled.all()))
        command.advance(0.125, None)
    assert settled == 2 * (4 * [False] + 4 * [True])


def test_the_curriculum_widens_the_ranges_while_robots_walk_well():
    curriculum = CurriculumConfig(start=0.3, max_velocity_error=0.2, rise=0.1)
    command = velocity_command(curriculum=curriculum)
    low, high = torch.tensor([-0.5, -0.3, 0.2]), torch.tensor([1.0, 0.3, 0.8])
    assert (command.value >= 0.3 * low).all() and (command.value <= 0.3 * high).all()
    torch.testing.assert_close(command.value.amax(0), 0.3 * high, atol=0.01, rtol=0)
    command.curriculum.follow(0.21, 1.0)
    assert command.curriculum.level == 0.3  # never below its start
    for error in (0.19, 0.19, 0.19, 0.21):
        command.curriculum.follow(error, 1.0)
    assert command.curriculum.level == pytest.approx(0.5)
    other = velocity_command(curriculum=curriculum)
    other.load_state_dict(command.state_dict())
    assert other.curriculum.level == command.curriculum.level
    command.curriculum.follow(0.0, 100.0)
    assert command.curriculum.level == 1.0
    command.reset(torch.arange(N), None)
    torch.testing.assert_close(command.value.amax(0), high, atol=0.02, rtol=0)
