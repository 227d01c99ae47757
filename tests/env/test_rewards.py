"""Reward terms on numbers worked out by hand, the paper's table, and what a weight of 0 leaves out."""

import math
from types import SimpleNamespace

import pytest
import torch

from omniperception.avoidance.sector_motion import sector_bearings
from omniperception.avoidance.velocity import AvoidanceConfig, avoidance_velocity
from omniperception.env.mdp import rewards
from omniperception.env.state import Obstacles

PAPER_WEIGHTS = {
    "velocity_tracking_with_avoidance": 2.0,
    "capped_ray_distance": 1.5,
    "vertical_velocity_squared": -3e-4,
    "foot_stumble": -2e-2,
    "link_collision": -2e-2,
    "joint_limit_violation": -0.2,
    "joint_torque_squared": -1e-6,
    "joint_velocity_squared": -1e-6,
    "joint_acceleration_squared": -2.5e-7,
    "action_rate_squared": -5e-3,
    "action_acceleration_squared": -5e-3,
}
"""Table 'Reward structure for Omni-Perception'."""


def tensor(*rows):
    return torch.tensor(rows, dtype=torch.float32)


def given(**fields):
    """The documented inputs of a term: attributes of the state."""
    kinematics = SimpleNamespace(**fields.pop("kinematics", {}))
    return SimpleNamespace(kinematics=kinematics, **fields)


class TestAvoidanceVelocity:
    def velocity(self, near: dict[int, float], **settings):
        distance = torch.full((1, 36), 6.0)
        for sector, value in near.items():
            distance[0, sector] = value
        config = AvoidanceConfig(**{"num_sectors": 36, "threshold": 1.0, "alpha": 2.0, **settings})
        return avoidance_velocity(distance, config)[0]

    @pytest.mark.parametrize("sector", [0, 8, 17, 18, 35])
    def test_one_sector_pushes_away_with_exp(self, sector):
        bearing = math.radians(-180 + 10 * sector + 5)
        expected = -math.exp(-2 * 0.4) * torch.tensor([math.cos(bearing), math.sin(bearing)])
        torch.testing.assert_close(self.velocity({sector: 0.4}), expected)

    def test_front_and_left(self):
        ahead = self.velocity({17: 0.5, 18: 0.5})  # the two sectors beside straight ahead
        assert ahead.tolist() == pytest.approx([-2 * math.exp(-1) * math.cos(math.radians(5)), 0], abs=1e-6)
        left = self.velocity({26: 0.5, 27: 0.5})
        assert left[1] < -0.7 and abs(left[0]) < 1e-6

    def test_two_opposite_sectors_cancel(self):
        assert self.velocity({3: 0.3, 21: 0.3}).norm() < 1e-6
        assert self.velocity(dict.fromkeys(range(36), 0.3)).norm() < 1e-5
        unequal = self.velocity({3: 0.3, 21: 0.6}).norm().item()
        assert unequal == pytest.approx(math.exp(-0.6) - math.exp(-1.2))

    def test_threshold(self):
        assert self.velocity({5: 1.0}).norm() == 0
        assert self.velocity({5: 0.999}).norm().item() == pytest.approx(math.exp(-2 * 0.999))
        assert self.velocity({5: 1.4}, threshold=1.5).norm().item() == pytest.approx(math.exp(-2.8))

    def test_max_speed_bounds_the_sum_and_keeps_its_direction(self):
        near = {sector: 0.1 for sector in range(14, 22)}
        free, bounded = self.velocity(near), self.velocity(near, max_speed=0.5)
        assert free.norm() > 1 and bounded.norm().item() == pytest.approx(0.5)
        torch.testing.assert_close(bounded / bounded.norm(), free / free.norm())
        torch.testing.assert_close(self.velocity({5: 0.9}, max_speed=0.5), self.velocity({5: 0.9}))

    def test_bearings_turn_left_from_behind(self):
        bearings = sector_bearings(4)
        half = math.sqrt(0.5)
        expected = tensor([-half, -half], [half, -half], [half, half], [-half, half])
        torch.testing.assert_close(bearings, expected)

    @pytest.mark.parametrize("key", ["alpha", "threshold", "num_sectors", "max_speed"])
    def test_wrong_settings_are_refused(self, key):
        with pytest.raises(ValueError, match=rf"rewards\.avoidance\.{key}=0"):
            AvoidanceConfig(**{"num_sectors": 36, "threshold": 1.0, "alpha": 1.0, key: 0})


class TestTerms:
    @pytest.mark.parametrize(
        ("term", "settings", "expected"),
        [
            ("velocity_tracking_with_avoidance", {"beta": 4.0}, [1.0, math.exp(-4 * (0.04 + 0.16))]),
            ("velocity_tracking", {"beta": 2.0}, [math.exp(-0.5), math.exp(-2 * (0.04 + 0.09))]),
            ("yaw_rate_tracking", {"beta": 2.0}, [math.exp(-0.5), 1.0]),
            ("velocity_error", {}, [0.5, math.sqrt(0.04 + 0.09)]),
            ("yaw_rate_error", {}, [0.5, 0.0]),
            ("progress", {}, [0.5, 0.0]),
            ("capped_ray_distance", {"max_distance": 8.0}, [1.0, 0.25]),
            ("vertical_velocity_squared", {}, [0.25, 1.0]),
            ("roll_pitch_rate_squared", {}, [0.25, 0.0]),
            ("tilt_squared", {}, [0.36, 0.0]),
            ("foot_stumble", {"ratio": 5.0, "unit": 1.0}, [2500.0, 0.0]),
            ("foot_stumble", {"ratio": 0.0, "unit": 1.0}, [2525.0, 0.0]),
            ("foot_stumble", {"ratio": 5.0, "unit": 10.0}, [25.0, 0.0]),
            ("link_collision", {"unit": 1.0}, [26.0, 0.0]),
            ("link_collision", {"unit": 2.0}, [6.5, 0.0]),
            ("link_collision", {"unit": 2.0, "most": 4.0}, [4.0 + 0.25, 0.0]),
            ("foot_stumble", {"ratio": 5.0, "unit": 10.0, "most": 20.0}, [4.0, 0.0]),
            ("joint_limit_violation", {}, [2.0, 0.0]),
            ("joint_near_stop", {"margin": 0.25}, [0.35 + 0.35, 0.25 + 0.05]),
            ("joint_torque_squared", {}, [25.0, 0.0]),
            ("joint_torque_near_limit", {"share": 0.5}, [0.25 + 0.5, 0.0]),
            ("joint_velocity_squared", {}, [5.0, 0.0]),
            ("joint_acceleration_squared", {}, [5.0, 1.0]),
            ("default_pose_deviation", {}, [1.2**2 + 0.4**2 + 0.3**2, 0.0]),
            ("action_rate_squared", {}, [0.25 + 1.0, 0.0]),
            ("action_acceleration_squared", {}, [9.0, 1.0]),
            ("obstacle_contact", {}, [1.0, 0.0]),
            ("obstacle_impulse", {}, [30.0 / 0.02, 0.0]),
            ("obstacle_impulse", {"most": 10.0}, [10.0 / 0.02, 0.0]),
            ("alive", {}, [1.0, 1.0]),
        ],
    )
    def test_by_hand(self, term, settings, expected):
        """Two robots of three joints; three feet (the second stands) and two penalised links."""
        kinematics = {
            "base_lin_vel_yaw": tensor([0.5, 0.0], [0.2, -0.3]),
            "base_lin_vel_b": tensor([3.0, 4.0, -0.5], [0.0, 0.0, 1.0]),
            "base_ang_vel_b": tensor([0.3, -0.4, 0.1], [0.0, 0.0, 7.0]),
            "projected_gravity_b": tensor([0.6, 0.0, -0.8], [0.0, 0.0, -1.0]),
            "joint_pos": tensor([0.0, -1.1, 1.1], [1.2, -0.7, 0.8]),
            "joint_vel": tensor([1.0, -2.0, 0.0], [0.0, 0.0, 0.0]),
        }
        state = given(
            kinematics=kinematics,
            command=tensor([1.0, 0.0, 5.0], [0.0, 0.0, 5.0]),
            reference=tensor([1.0, 0.0, 0.6], [0.0, 0.0, 7.0]),
            avoidance_velocity=tensor([-0.5, 0.0], [0.0, 0.1]),
            mean_distal_range=lambda limit: tensor(limit, 0.25 * limit),
            foot_force=tensor([[30.0, 40.0, 5.0], [3.0, 4.0, -50.0], [0.0, 0.0, 0.0]], [[0.0, 0.0, 9.0]] * 3),
            link_force=tensor([[3.0, 4.0, 99.0], [0.0, 1.0, 0.0]], [[0.0, 0.0, 9.0]] * 2),
            joint_torque_limit=torch.tensor([4.0, 4.0, 4.0]),
            joint_lower=torch.full((3,), -1.0),
            joint_upper=torch.tensor([1.2, 1.0, 1.0]),
            joint_torque=tensor([3.0, -4.0, 0.0], [0.0, 0.0, 0.0]),
            joint_acc=tensor([1.0, -2.0, 0.0], [0.0, 1.0, 0.0]),
            pose=torch.tensor([1.2, -0.7, 0.8]),
            actions=(tensor([1.0, 0.0], [0.0, 0.0]), tensor([0.5, 1.0], [0.0, 0.0]), tensor([0.0, -1.0], [0.0, 1.0])),
            obstacle_contact=torch.tensor([True, False]),
            obstacle_impulse=tensor(30.0, 0.0),
            control_dt=0.02,
            num_envs=2,
            device="cpu",
        )
        assert getattr(rewards, term)(state, **settings).tolist() == pytest.approx(expected)

    @pytest.mark.parametrize(
        ("velocity", "wanted", "expected"),
        [
            ([0.0, 0.7], [0.0, 0.5], 0.5),  # no more than is asked for
            ([0.6, 0.8], [2.0, 0.0], 0.6),
            ([-0.3, 0.0], [1.0, 0.0], -0.3),
            ([0.3, -0.4], [0.6, 0.8], -0.14),
            ([0.5, 0.5], [0.0, 0.0], 0.0),
        ],
    )
    def test_progress(self, velocity, wanted, expected):
        state = given(kinematics={"base_lin_vel_yaw": tensor(velocity)}, reference=tensor([*wanted, 1.0]))
        assert rewards.progress(state).item() == pytest.approx(expected)

    def test_standing_counts_where_the_command_has_said_so_for_long_enough(self):
        joint_vel = tensor([1.0, -2.0], [1.0, -2.0], [0.0, 0.0], [1.0, -2.0])
        command = tensor([0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
        stand_s = torch.tensor([0.5, 0.0, 0.5, 0.3])
        state = given(kinematics={"joint_vel": joint_vel}, command=command, stand_s=stand_s)
        assert rewards.standing_joint_velocity_squared(state, rest_s=0.4).tolist() == [5.0, 0.0, 0.0, 0.0]

    def closing(self, pos, vel, base_vel=(0.0, 0.0), active=True, axis=(1.0, 0.0), half_sides=(0.2, -1.0)):
        state = given(
            kinematics={"base_lin_vel_yaw": tensor(base_vel)},
            obstacles=Obstacles(
                tensor([pos]),
                tensor([vel]),
                torch.tensor([0.2]),
                torch.tensor([[active]]),
                tensor([axis]),
                tensor([half_sides]),
            ),
        )
        return rewards.closing_speed(state, horizon=2.0, margin=0.5).item()

    def test_closing_speed(self):
        assert self.closing((1.0, 0.0), (-1.0, 0.0)) == pytest.approx(0.5)  # meets after 1 s of 2
        assert self.closing((1.0, 0.0), (0.0, 0.0), base_vel=(1.0, 0.0)) == pytest.approx(0.5)
        assert self.closing((1.0, 0.45), (-1.0, 0.0)) == pytest.approx(0.5 * 0.5)  # passes 0.25 m off
        assert self.closing((1.0, 0.8), (-1.0, 0.0)) == 0.0  # passes 0.6 m off
        assert self.closing((1.0, 0.0), (1.0, 0.0)) == 0.0  # goes away
        assert self.closing((3.0, 0.0), (-1.0, 0.0)) == 0.0  # beyond the horizon
        assert self.closing((1.0, 0.0), (-1.0, 0.0), active=False) == 0.0

    def test_closing_speed_towards_a_wall_is_that_towards_its_side(self):
        wall = {"axis": (0.6, 0.8), "half_sides": (3.0, 0.05)}  # its normal is (0.8, -0.6)
        ahead, normal = (0.8 * 1.05 + 0.6, -0.6 * 1.05 + 0.8), (0.8, -0.6)  # its side 1 m away, its middle 1 m along it
        assert self.closing(ahead, (0.0, 0.0), **wall) == 0.0  # stands beside it
        assert self.closing(ahead, (0.0, 0.0), base_vel=normal, **wall) == pytest.approx(0.5)  # after 1 s of 2
        assert self.closing(ahead, (0.0, 0.0), base_vel=(0.6, 0.8), **wall) == 0.0  # walks along it
        beyond = (0.8 * 1.05 + 3.3 * 0.6, -0.6 * 1.05 + 3.3 * 0.8)  # walks past its end, 0.3 m off
        assert 0.0 < self.closing(beyond, (0.0, 0.0), base_vel=normal, **wall) < 0.3
        assert self.closing((0.8 + 4.0 * 0.6, -0.6 + 4.0 * 0.8), (0.0, 0.0), base_vel=normal, **wall) == 0.0  # 1 m off


class TestFeet:
    """Two robots with two feet; the numbers are worked out by hand."""

    def test_air_time(self):
        times = SimpleNamespace(
            last_air=tensor([0.5, 0.2], [0.7, 0.0]), touched_down=torch.tensor([[True, True], [True, False]])
        )
        state = given(foot_times=times, command=tensor([0.3, 0.4, 0.0], [0.05, 0.0, 1.0]))
        got = rewards.foot_air_time(state, target=0.3, min_speed=0.1)
        assert got.tolist() == pytest.approx([0.2 - 0.1, 0.0])  # the second is commanded to stand

    def test_clearance_is_counted_above_the_ground_below_the_foot(self):
        state = given(foot_height=tensor([0.02, 0.1]), foot_vel_w=tensor([[0.3, -0.4, 9.0], [1.0, 0.0, 9.0]]))
        assert rewards.foot_clearance(state, target=0.1).item() == pytest.approx(0.08**2 * 0.5, rel=1e-4)

    def test_timing_by_the_clock(self):
        """At 2 Hz and 0.1 s the clock is at 0.2 of its period, a foot half a period later at 0.7."""
        contact = torch.tensor([[True, False], [True, True], [True, True]])
        command = tensor([0.1, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
        state = given(
            time_s=torch.tensor([0.1, 0.1, 0.1]),
            foot_contact=contact,
            command=command,
            stand_s=torch.tensor([0.0, 0.0, 0.6]),
            device="cpu",
        )
        settings = {"frequency": 2.0, "offsets": [0.0, 0.5], "duty": 0.5, "rest_s": 0.5}
        assert rewards.foot_timing(state, **settings).tolist() == [1.0, 0.5, 1.0]  # the last one stands, as it should
        assert rewards.foot_timing(state, **settings | {"duty": 0.8}).tolist() == [0.5, 1.0, 1.0]
        state.time_s = torch.tensor([0.35, 0.35, 0.35])  # half a period later
        assert rewards.foot_timing(state, **settings).tolist() == [0.0, 0.5, 1.0]
        assert rewards.foot_timing(state, **settings | {"rest_s": 1.0}).tolist() == [0.0, 0.5, 0.5]  # it steps to stop

    def test_slip_is_of_feet_in_contact(self):
        state = given(foot_vel_w=tensor([[0.3, 0.4, 5.0], [2.0, 0.0, 0.0]]), foot_contact=torch.tensor([[True, False]]))
        assert rewards.foot_slip(state).item() == pytest.approx(0.25)


class TestConfiguration:
    def test_the_papers_weights(self, make_config):
        terms = make_config("rewards=paper").env.rewards.terms
        assert {name: term.weight for name, term in terms.items()} == PAPER_WEIGHTS  # without the yaw rate

    def test_weight_zero_removes_a_term_and_what_only_it_reads(self, make_env):
        """Walking on free ground with the paper's contact terms, and without."""

        def sensors(weight):
            overrides = [f"+rewards.terms.link_collision={{weight: {weight}, unit: 1.0}}"]
            env = make_env("obstacles=none", *overrides, blind=True)
            return env.world.model.nsensor, "link_collision" in env.config.rewards.terms

        assert sensors(-0.02) == (15, True)
        assert sensors(0.0) == (0, False)

    def test_only_the_terms_with_weight_need_the_lidar(self, make_env):
        zero = "rewards.terms.velocity_tracking_with_avoidance.weight=0"
        env = make_env("perception=none", "observations=walk", zero)
        assert env.sensing is None
        env = make_env("perception=none", "observations=walk")
        assert env.sensing is not None and env.sensing.history is None

    def test_sum_of_terms_times_the_control_step(self, make_env):
        env = make_env("obstacles=none", "rewards.terms.tilt_squared=null", blind=True)
        torch.manual_seed(0)
        _, reward, _, _ = env.step(torch.randn(4, 12))
        by_hand = sum(0.02 * term.weight * term.func(env.state) for term in env.config.rewards.terms.values())
        torch.testing.assert_close(reward, by_hand)
        assert "tilt_squared" not in env.config.rewards.terms
