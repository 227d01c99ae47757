"""What an exported policy refuses, limits and stops for; numbers worked out by hand."""

import json
import logging
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("onnxruntime", reason="extra deploy")
pytest.importorskip("onnx", reason="extra export")

from omnirobot.runtime import DeployError, Description, ExportedPolicy, RobotState, SafetyConfig, SafetyStop
from omnirobot.runtime.description import Group, Joints, Lidar, Perception, Term
from omnirobot.runtime.go2 import MOTORS
from omnirobot.runtime.runtime import DEFAULT_SAFETY
from omnirobot.runtime.safety import LidarStatus, Safety

POSE = [0.0, 0.8, -1.5] * 4
LIMITS = {"lower": [-1.0, -1.5, -2.7] * 4, "upper": [1.0, 3.4, -0.8] * 4}
UPRIGHT = [1.0, 0.0, 0.0, 0.0]
CLOUD = np.tile([2.0, 0.0, 0.5], (100, 1))
"""A frame of 100 hits."""


def description(**changes):
    """Of a policy that sees: 100 of 500 points every 0.1 s, at 50 Hz."""
    terms = [("joint_pos_offset", 12), ("joint_vel", 12), ("projected_gravity", 3), ("command", 3)]
    given = {
        "control_period_s": 0.02,
        "joints": Joints(MOTORS, POSE, 0.25, 100.0, 25.0, 0.6, [20.0] * 12, **LIMITS),
        "observations": (Group("all", 1, tuple(Term(*term) for term in terms)),),
        "command": {"lin_vel_x": [-0.5, 1.0], "lin_vel_y": [-0.5, 0.5], "ang_vel_z": [-1.0, 1.0]},
        "lidar": Lidar(0.1, [0.0] * 3, UPRIGHT, 0.1, 6.0, 100, 500, 5),
        "perception": Perception(2, 100, {"kind": "raw", "num_points": 100, "max_range": 6.0}),
    }
    return Description(**{**given, **changes})


class Network:
    """In place of an onnxruntime session: gives the same actions always, and keeps what it was fed."""

    def __init__(self, described, actions):
        self.actions, self.fed, self._shapes = np.asarray(actions, np.float32), {}, described.inputs

    def get_inputs(self):
        return [type("Input", (), {"name": n, "shape": ["batch", *s]}) for n, s in self._shapes.items()]

    def run(self, names, feed):
        self.fed = feed
        return [self.actions[None]]


def policy(actions=(0.0,) * 12, safety=DEFAULT_SAFETY, **changes):
    described = description(**changes)
    return ExportedPolicy(described, Network(described, actions), safety)


def state(**changes):
    return RobotState(
        **{"joint_pos": POSE, "joint_vel": [0.0] * 12, "base_quat": UPRIGHT, "base_ang_vel": [0.0] * 3, **changes}
    )


def fed_command(robot):
    return robot._session.fed["observations"][0, 27:30].tolist()


def test_targets_stay_within_the_limits_of_the_joints_and_their_rate():
    """Action 8 asks for 0.8 + 2 rad of a thigh and for -1.5 + 2 of a calf, whose limit is -0.8."""
    robot = policy([8.0] * 12, SafetyConfig(target_rate=25.0))
    assert robot.step(state(), [0.0] * 3, CLOUD).tolist() == pytest.approx([0.5, 1.3, -1.0] * 4)
    assert robot.step(state(), [0.0] * 3).tolist() == pytest.approx([1.0, 1.8, -0.8] * 4)
    assert robot.step(state(), [0.0] * 3).tolist() == pytest.approx([1.0, 2.3, -0.8] * 4)
    assert robot.action.tolist() == [8.0] * 12  # what the next observation holds is what training's would
    assert policy([8.0] * 12, None).step(state(), [0.0] * 3, CLOUD).tolist() == pytest.approx([2.0, 2.8, 0.5] * 4)


def test_a_command_stays_within_the_ranges_of_training(caplog):
    robot = policy()
    with caplog.at_level(logging.INFO):
        robot.step(state(), [10.0, -3.0, 0.2], CLOUD)
        robot.step(state(), [10.0, -3.0, 0.2], CLOUD)
    assert fed_command(robot) == pytest.approx([1.0, -0.5, 0.2])
    assert len(caplog.records) == 1 and "is beyond training's" in caplog.text


def test_to_stand_is_allowed_where_training_always_walked():
    """A range of 0.3 to 1 m/s: 0 stays 0, and so does what is slower than training's."""
    ranges = {"lin_vel_x": [0.3, 1.0], "lin_vel_y": [-0.5, -0.2], "ang_vel_z": [0.0, 0.0]}
    robot = policy(command=ranges)
    for given, expected in (
        ([0.0] * 3, [0.0] * 3),
        ([-0.1, 0.1, 0.1], [0.0] * 3),
        ([2.0, -2.0, 0.0], [1.0, -0.5, 0.0]),
    ):
        robot.step(state(), given, CLOUD)
        assert fed_command(robot) == pytest.approx(expected)


@pytest.mark.parametrize("bad", [None, np.zeros((100, 3)), CLOUD[:4], np.full((100, 3), np.nan), CLOUD * 10])
def test_without_good_frames_the_robot_slows_down_and_stands_blind(bad, caplog):
    """No frame, misses, 4 of 100 hits, nan, and hits beyond the range: after 0.35 s the command falls within 0.3 s."""
    robot = policy()
    robot.step(state(), [1.0, 0.0, 0.0], CLOUD)
    seen = robot.frames.copy()
    speeds = []
    with caplog.at_level(logging.WARNING):
        for step in range(1, 40):
            robot.step(state(), [1.0, 0.0, 0.0], bad if step % 5 == 0 else None)
            speeds.append(fed_command(robot)[0])
    assert speeds[:16] == [1.0] * 16  # up to 0.34 s
    assert speeds[17:32] == pytest.approx([1 - k / 15 for k in range(1, 16)], abs=1e-6) and speeds[32:] == [0.0] * 7
    assert robot.safety.lidar_status is LidarStatus.STOPPED and robot._session.fed["frame_count"].tolist() == [[0]]
    assert "slowing down" in caplog.text and "standing" in caplog.text
    assert np.array_equal(robot.frames[-1], seen[-1])  # nothing was taken for free space
    robot.step(state(), [1.0, 0.0, 0.0], CLOUD)
    assert fed_command(robot)[0] == pytest.approx(1 / 15) and robot._session.fed["frame_count"][0, 0] > 0
    for _ in range(14):
        robot.step(state(), [1.0, 0.0, 0.0])
    assert fed_command(robot)[0] == pytest.approx(1.0) and robot.safety.lidar_status is LidarStatus.FRESH


def test_points_nearer_than_the_sensor_of_training_measures_are_misses():
    """Its least is 0.1 m: 0.1 m stays, 0.0999 m is a miss; a frame of such points alone is none."""
    robot = policy()
    cloud = CLOUD.copy()
    cloud[:2] = [[0.1, 0.0, 0.0], [0.0999, 0.0, 0.0]]
    cloud[2] = np.nan
    robot.add_frame(cloud, UPRIGHT)
    assert robot.frames[-1, :4] * 6.0 == pytest.approx(np.array([[0.1, 0, 0], [0, 0, 0], [0, 0, 0], CLOUD[3]]))
    robot.add_frame(CLOUD * 0.04, UPRIGHT)
    assert robot.safety.counts["frames refused"] == 1


def test_a_robot_that_never_sees_anything_stands():
    robot = policy()
    for _ in range(50):
        robot.step(state(), [1.0, 0.0, 0.0])
    assert fed_command(robot) == [0.0] * 3


def test_a_robot_that_awaits_its_first_frame_stands():
    """However long none comes, or only an empty one; then its speed grows within 0.3 s, 15 steps."""
    robot = policy()
    robot.safety.await_frame()
    for cloud in [None] * 10 + [CLOUD[:4]] + [None] * 40:
        robot.step(state(), [1.0, 0.0, 0.0], cloud)
        assert fed_command(robot) == [0.0] * 3 and robot.safety.lidar_status is LidarStatus.STOPPED
    for step in range(1, 16):
        robot.step(state(), [1.0, 0.0, 0.0], CLOUD if step % 5 == 1 else None)
        assert fed_command(robot)[0] == pytest.approx(step / 15)
    blind = policy(lidar=None, perception=None)
    blind.safety.await_frame()
    blind.step(state(), [1.0, 0.0, 0.0])
    assert fed_command(blind) == [1.0, 0.0, 0.0]


def rolled(degrees):
    half = np.radians(degrees) / 2
    return [float(np.cos(half)), float(np.sin(half)), 0.0, 0.0]


BENT = [*POSE[:2], -3.0, *POSE[3:]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"base_quat": rolled(51)}, "the base leans by 51 degrees, 50 are allowed"),
        ({"base_quat": rolled(180)}, "leans by 180"),
        ({"base_quat": [float("nan")] * 4}, "base_quat: finite numbers were expected"),
        ({"base_ang_vel": [0.0, float("nan"), 0.0]}, "base_ang_vel: finite numbers"),
        ({"base_lin_vel": [float("inf"), 0.0, 0.0]}, "base_lin_vel: finite numbers"),
        ({"other": {"bumper": [float("nan")]}}, "bumper: finite numbers"),
        ({"base_quat": [0.0] * 4}, "base_quat: a unit quaternion .* was expected"),
        ({"joint_pos": BENT}, r"FR_calf_joint is at -3.00 rad, 0.30 beyond its limit"),
        ({"joint_vel": [0.0] * 11 + [60.0]}, "RL_calf_joint turns at 60 rad/s"),
        ({"joint_torque": [float("inf")] * 12}, "joint_torque: 12 finite numbers"),
        ({"joint_torque": [1.0] * 3}, "joint_torque: 12 finite numbers"),
        ({"joint_torque": [1.0]}, "joint_torque: 12 finite numbers"),
    ],
)
def test_a_state_that_is_none_to_walk_in_stops(change, message):
    robot = policy()
    with pytest.raises(SafetyStop, match=message):
        robot.step(state(**change), [0.0] * 3, CLOUD)
    assert robot._session.fed == {}  # before the network was asked
    robot.step(state(base_quat=rolled(49)), [0.0] * 3, CLOUD)


def test_numbers_that_are_none_stop():
    with pytest.raises(SafetyStop, match="targets are not finite"):
        policy([float("nan")] * 12).step(state(), [0.0] * 3, CLOUD)
    with pytest.raises(SafetyStop, match="command: 3 finite numbers were expected"):
        policy().step(state(), [float("nan"), 0.0, 0.0], CLOUD)


def test_a_joint_that_gives_its_whole_torque_for_long_stops():
    robot = policy()
    strained = state(joint_torque=[0.0] * 11 + [-20.0])
    for step in range(25):
        robot.step(strained, [0.0] * 3, CLOUD if step % 5 == 0 else None)
    with pytest.raises(SafetyStop, match="RL_calf_joint has given -20.0 N m for 0.5 s"):
        robot.step(strained, [0.0] * 3)
    robot.reset()
    robot.step(strained, [0.0] * 3)


def test_limits_must_be_above_zero():
    with pytest.raises(DeployError, match="safety.slow_down_s=0: a number above 0 was expected"):
        SafetyConfig(slow_down_s=0)


def test_a_blind_policy_needs_no_frames():
    robot = policy(lidar=None, perception=None)
    for _ in range(60):
        robot.step(state(), [1.0, 0.0, 0.0])
    assert fed_command(robot) == [1.0, 0.0, 0.0] and isinstance(robot.safety, Safety)


class TestThinning:
    """A frame of 500 points, 0.2 ms apart, of which training saw every fifth."""

    points = np.stack((np.arange(500.0) + 1.0, np.zeros(500), np.zeros(500)), 1)
    times = np.arange(500) * 2e-4

    def test_a_whole_frame_is_thinned_by_number(self):
        assert policy().subsample(self.points)[:, 0].tolist() == [1.0 + 5 * k for k in range(100)]

    def test_misses_that_a_driver_left_out_are_zeros_in_their_place(self):
        hit = np.arange(500) % 7 != 0
        kept = policy().subsample(self.points[hit], self.times[hit])[:, 0]
        assert kept.tolist() == [0.0 if 5 * k % 7 == 0 else 1.0 + 5 * k for k in range(100)]

    def test_the_order_of_rows_does_not_matter_and_points_of_other_frames_do_not_count(self):
        order = np.random.default_rng(0).permutation(500)
        assert np.array_equal(
            policy().subsample(self.points[order], self.times[order]), policy().subsample(self.points)
        )
        assert (
            not policy().subsample(self.points, self.times + 0.1).any()
            and not policy().subsample(self.points, self.times - 0.2).any()
        )

    def test_rows_are_no_numbers_where_misses_are_left_out(self):
        with pytest.raises(
            DeployError, match=r"a whole frame of 500 was expected, 400 given.*subsample\(points, offsets_s\)"
        ):
            policy().subsample(self.points[:400])

    def test_other_selections_are_spread_over_the_frame_and_its_lasers(self):
        """Of 32 lasers that fire together, 20 times a frame; one of each 6.4 points."""
        robot = policy(lidar=Lidar(0.1, [0.0] * 3, UPRIGHT, 0.1, 6.0, 100, 640, None))
        lasers, shots = np.arange(640) % 32, np.arange(640) // 32
        points = np.stack((1.0 + np.arange(640), lasers, shots), 1)
        kept = robot.subsample(points)
        assert np.unique(kept[:, 1]).size > 28 and np.unique(kept[:, 2]).size == 20
        part = np.searchsorted(np.arange(101) * 640 // 100, kept[:, 0] - 1, "right") - 1
        assert part.tolist() == list(range(100))
        assert np.array_equal(
            robot.subsample(points, shots * 0.1 / 20), kept
        )  # those that fire together in their order


def test_the_fingerprint_covers_what_the_network_depends_on(tmp_path):
    described = description()
    described.write(tmp_path)
    assert Description.read(tmp_path).fingerprint == described.fingerprint
    assert description(provenance={"run": "x"}, files={"onnx": "p"}).fingerprint == described.fingerprint
    content = json.loads((tmp_path / "policy.json").read_text())
    content["joints"]["kp"] = 26.0
    (tmp_path / "policy.json").write_text(json.dumps(content))
    assert Description.read(tmp_path).fingerprint != described.fingerprint


@pytest.mark.slow
def test_the_published_policy_stands_half_a_second_after_it_slows_down(tmp_path):
    """In MuJoCo, commanded 1 m/s and a turn, blindfolded after 2 s of frames; and it neither falls nor walks on."""
    from omniperception import build, config
    from omniperception.deploy.export import export
    from omniperception.env.env import OmniEnv
    from omniperception.evaluation.trials.exported import raw_points, robot_states

    run_dir = Path(__file__).resolve().parents[2] / "pretrained" / "avoider"
    export(run_dir, tmp_path, ("onnx",))
    env = OmniEnv(
        build.assemble(config.load(run_dir, ["num_envs=1", "scenario=static", "condition=ideal", "seed=3"])).env
    )
    robot, tick, speeds = ExportedPolicy.load(tmp_path), 0, []
    for step in range(250):
        fresh = env.sensing.tick != tick and step < 100
        tick = env.sensing.tick
        state = robot_states(env)[0]
        robot.step(state, [1.0, 0.0, 0.5], raw_points(env.sensing.frame)[0] if fresh else None)
        speeds.append(float(np.linalg.norm(state.base_lin_vel)))
        env.step(torch.from_numpy(robot.action[None]))
    blind_from = 100 + 18  # the last frame's age is 0.35 s
    assert np.mean(speeds[50:100]) > 0.5
    assert np.mean(speeds[blind_from + 25 : blind_from + 50]) < 0.15 and np.mean(speeds[200:]) < 0.1
    assert not env.done.any() and robot.safety.lidar_status is LidarStatus.STOPPED


class TestFramesInPart:
    """A sensor with rays in all directions, 6 degrees apart; ground, or what stands on it, answers below the horizon.

    Four bins of elevation cover a sector.
    """

    azimuth, elevation = (grid.ravel() for grid in np.meshgrid(np.arange(-177, 180, 6), np.arange(-57, 60, 6)))
    a, e = np.radians(azimuth), np.radians(elevation)
    rays = 2.0 * np.stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), 1)

    def robot(self):
        count = len(self.rays)
        lidar = Lidar(0.1, [0.0] * 3, UPRIGHT, 0.1, 6.0, count, count, 1, (4,) * 36)
        return policy(
            lidar=lidar,
            perception=Perception(2, count, {"kind": "raw", "num_points": count, "max_range": 6.0}),
            command={"lin_vel_x": [-1.0, 1.0], "lin_vel_y": [-1.0, 1.0], "ang_vel_z": [-1.0, 1.0]},
        )

    def walk(self, robot, command, kept, frames=5):
        """Commands (steps, 3) that the network is fed while frames hold the rays that are `kept`."""
        fed = []
        for step in range(5 * frames):
            cloud = self.rays * (kept & (self.elevation < 0))[:, None]
            robot.step(state(), command, cloud if step % 5 == 0 else None)
            fed.append(fed_command(robot))
        return np.array(fed)

    def test_whole_frames_change_nothing(self, caplog):
        robot = self.robot()
        assert (self.walk(robot, [0.9, -0.4, 0.2], self.azimuth < 999) == np.float32([0.9, -0.4, 0.2])).all()
        assert not robot.safety.counts and not caplog.records

    def test_it_does_not_go_where_nobody_looked_and_says_so_once(self, caplog):
        """100 degrees ahead are lost: commands there are 0 from the second frame on, after 0.1 s; others stay."""
        robot, kept = self.robot(), abs(self.azimuth) > 45
        self.walk(robot, [1.0, 0.0, 0.5], self.azimuth < 999, 1)
        fed = self.walk(robot, [1.0, 0.0, 0.5], kept)
        assert (fed[:5, 0] == 1.0).all() and not fed[5:, 0].any() and (fed[:, 2] == 0.5).all()
        assert (self.walk(robot, [-1.0, 0.0, 0.0], kept)[:, 0] == -1.0).all()
        assert not self.walk(robot, [0.5, 0.5, 0.0], kept)[:, :2].any()
        sideways = self.walk(robot, [0.0, 1.0, 0.0], kept)[:, 1]  # 45 degrees from the last sector that is lost
        assert sideways == pytest.approx((0.8660 - 0.7071) / (0.8660 - 0.5), abs=1e-3)
        self.walk(robot, [1.0, 0.0, 0.0], self.azimuth < 999)
        assert fed_command(robot)[0] == 1.0
        self.walk(robot, [1.0, 0.0, 0.0], kept)
        assert robot.safety.counts["frames in part"] == 2
        said = [record.message for record in caplog.records]
        assert len(said) == 1 and "no points from 10 of 36 directions (ahead, ahead left, ahead right)" in said[0]

    @pytest.mark.parametrize("what", ["a narrow band", "another tenth of the circle each time"])
    def test_it_stands_where_a_tenth_of_the_points_says_little(self, what):
        robot = self.robot()
        self.walk(robot, [1.0, 0.0, 0.0], self.azimuth < 999, 1)
        for frame in range(10):
            turned = (self.azimuth - 100 * frame) % 360 < 36
            kept = abs(self.elevation + 12) < 9 if what == "a narrow band" else turned
            fed = self.walk(robot, [1.0, 0.0, 0.0], kept, 1)
            assert frame < 2 or not fed.any()

    def test_points_that_are_thin_everywhere_are_enough(self):
        robot, random = self.robot(), np.random.default_rng(0)
        for _ in range(10):
            fed = self.walk(robot, [1.0, 0.0, 0.0], random.random(len(self.azimuth)) < 0.7, 1)
        assert (fed[:, 0] == 1.0).all()
