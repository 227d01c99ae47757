"""Recordings: what a run wrote is what others read of it, and a replay gives the same targets again."""

import inspect

import numpy as np
import pytest

pytest.importorskip("mcap_ros2", reason="extra robot")

from omnirobot.drive.recording import Recorder, Step, levelled, nearest_by_sector
from omnirobot.replay.bags import Topics, events
from omnirobot.runtime import DeployError
from omnirobot.runtime.description import Lidar
from omnirobot.runtime.go2 import MOTORS
from omnirobot.wire.clouds import Points
from omnirobot.wire.messages import LOW_STATE

MOUNT = {"mount_pos": (0.3, 0.0, 0.1), "mount_quat": (1.0, 0.0, 0.0, 0.0)}


class Described:
    """As much of a policy's description as a recorder reads."""

    lidar = Lidar(0.1, **MOUNT, min_range=0.1, max_range=10.0, num_rays=2, points_per_frame=2, keep_every=1)


def a_state(number):
    state = LOW_STATE.zeros()
    state["imu_state"]["quaternion"] = (0.8, 0.0, 0.6, 0.0)
    state["imu_state"]["gyroscope"] = (0.1, 0.2, 0.1 * number)
    state["motor_state"]["q"][:12] = 0.1 * np.arange(12) + number
    state["motor_state"]["dq"][:12] = -np.arange(12)
    state["motor_state"]["tau_est"][:12] = 2.0
    return state


def a_run(path, steps=3):
    """Each step: some points, then the step; the sensor's clock began at another time."""
    recorder = Recorder(path, Described)
    clouds = []
    for k in range(steps):
        times = 7 * 10**9 + k * 20_000_000 + np.arange(4, dtype=np.int64) * 4800
        clouds.append(Points(np.array([[1 + k, 2, 3], [0, 0, 0], [4, 5, 6], [7, 8, 9]], np.float32), times))
        recorder.points(100.0 + 0.02 * k, clouds[-1])
        seen = np.array([[2.0, 0.0, 0.0], [0.0, 0.0, 0.0]], np.float32) if k == 1 else None
        targets = None if k == 2 else np.arange(12) * 0.01 + k
        mode = "policy: asked for" if k else "standing: stood up"
        step = Step(100.0 + 0.02 * k, a_state(k), mode, np.array([0.5, 0.1, -0.2 * k]), seen, targets, np.ones(12))
        recorder.step(step)
    recorder.close()
    return clouds


def test_what_was_written_comes_back(tmp_path):
    clouds = a_run(tmp_path / "runs" / "a.mcap")
    found = list(events(tmp_path / "runs" / "a.mcap", Topics()))
    states = [event for event in found if event.state is not None]
    assert [round(event.time_s, 9) for event in states] == [0.0, 0.02, 0.04]
    for k, event in enumerate(states):
        for part in ("imu_state", "motor_state"):
            for name in LOW_STATE.zeros()[part].dtype.names:  # bytes between fields are anything
                np.testing.assert_array_equal(event.state[part][name], a_state(k)[part][name])
    points = [event.points for event in found if event.points is not None]
    for given, read in zip(clouds, points, strict=True):
        np.testing.assert_array_equal(given.points, read.points)
        np.testing.assert_array_equal(given.times_ns - clouds[0].times_ns[0], read.times_ns - points[0].times_ns[0])
    assert [event.mode for event in found if event.mode] == ["standing: stood up", "policy: asked for"]
    assert [event.command.tolist() for event in found if event.command is not None][2] == [0.5, 0.1, -0.4]
    assert [event.targets[1] for event in found if event.targets is not None] == pytest.approx([0.01, 1.01])


def test_nothing_is_overwritten_and_a_clock_that_jumps_is_recorded_on(tmp_path):
    """From the sensor's own clock to the world's, which together are more seconds than ROS 2 has room for."""
    a_run(tmp_path / "a.mcap")
    with pytest.raises(DeployError, match="a.mcap exists; give another name"):
        Recorder(tmp_path / "a.mcap", Described)
    recorder = Recorder(tmp_path / "b.mcap", Described)
    for k, start in enumerate((7 * 10**9, 17 * 10**17)):
        recorder.points(100.0 + k, Points(np.ones((1, 3), np.float32), np.array([start])))
    recorder.step(Step(102.0, a_state(0), "policy: asked for", np.zeros(3), None, None, np.zeros(12)))
    recorder.close()
    points = [event.points for event in events(tmp_path / "b.mcap", Topics()) if event.points is not None]
    assert points[1].times_ns[0] - points[0].times_ns[0] == 10**9


def test_a_clock_that_jumps_between_two_points_of_a_step(tmp_path):
    """By more than the four seconds that nanoseconds of 32 bits hold, and back."""
    recorder = Recorder(tmp_path / "a.mcap", Described)
    times = np.array([7 * 10**9, 7 * 10**9 + 5000, 19 * 10**9, 19 * 10**9 + 5000, 7 * 10**9 + 10_000])
    recorder.points(100.0, Points(np.arange(15, dtype=np.float32).reshape(5, 3), times))
    recorder.step(Step(100.02, a_state(0), "policy: asked for", np.zeros(3), None, None, np.zeros(12)))
    recorder.close()
    points = [event.points for event in events(tmp_path / "a.mcap", Topics()) if event.points is not None]
    np.testing.assert_array_equal(np.concatenate([p.points for p in points]), np.arange(15).reshape(5, 3))
    read = np.concatenate([p.times_ns for p in points])
    np.testing.assert_array_equal(read - read[0], [0, 5000, 0, 5000, 5000])  # the newest of each before the jump is now


def test_others_read_it(tmp_path):
    """mcap's own reader, by the definitions in the file."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    a_run(tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as file:
        decoded = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    by_topic = {channel.topic: message for _, channel, _, message in decoded}
    assert by_topic["/joint_states"].name == list(MOTORS) and by_topic["/joint_states"].effort[3] == 2.0
    assert by_topic["/command"].twist.angular.z == pytest.approx(-0.4)
    cloud = by_topic["/lidar/points"]
    assert (cloud.width, [field.name for field in cloud.fields]) == (4, ["x", "y", "z", "t"])
    ranges = np.array(by_topic["/policy/obstacles"].ranges)
    assert np.isfinite(ranges).sum() == 0  # the base is pitched by 74 degrees: the point is below the heights
    transforms = by_topic["/tf"].transforms
    assert [t.child_frame_id for t in transforms] == ["base", "lidar"] and transforms[1].transform.translation.x == 0.3


def test_points_in_the_levelled_base():
    """Pitched nose down by 60 degrees: 1.3 cos + 0.1 sin ahead, 0.1 cos - 1.3 sin upwards; heading plays no part."""
    half, point = np.sqrt(0.5), np.array([[1.0, 0.0, 0.0]])
    cos, sin = 0.5, np.sqrt(0.75)
    expected = [1.3 * cos + 0.1 * sin, 0.0, 0.1 * cos - 1.3 * sin]
    assert levelled(point, (sin, 0, 0.5, 0), **MOUNT)[0] == pytest.approx(expected)
    assert levelled(point, (half, 0, 0, half), **MOUNT)[0] == pytest.approx([1.3, 0.0, 0.1])
    near = nearest_by_sector(
        np.array([[1.7, 0.0, 0.0], [0.7, 0.01, 0.1], [0.2, 0.0, -0.3], [0.1, 0.1, 0.0]]), (1, 0, 0, 0), **MOUNT
    )
    assert near[18] == pytest.approx(np.hypot(1.0, 0.01)) and near[17] == np.inf and np.isfinite(near).sum() == 1


def a_ros_bag(
    folder, names=MOTORS, imus=("/imu",), positions=12, velocities=12, orientation_covariance=0.0, low_states=()
):
    """Written by rosbags' own serializer: 100 Hz, a cloud, a Twist, joints in another order, without efforts."""
    pytest.importorskip("rosbags", reason="extra clouds")
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    t = {kind.rpartition("/")[2]: made for kind, made in store.types.items()}
    header = t["Header"](t["Time"](5, 0), "x")
    nothing = np.zeros(9)

    def vector(x, y, z):
        return t["Vector3"](x, y, z)

    imu = t["Imu"](
        header,
        t["Quaternion"](0.0, 0.0, 0.0, 1.0),
        np.array([orientation_covariance, *nothing[1:]]),
        vector(0.1, 0.2, 0.3),
        nothing,
        vector(0, 0, 9.81),
        nothing,
    )
    angles = np.arange(12.0)[::-1][:positions].copy()
    joints = t["JointState"](header, list(names)[::-1], angles, np.zeros(velocities), np.zeros(0))
    twist = t["Twist"](vector(0.5, 0.0, 0.0), vector(0.0, 0.0, 0.2))
    rows = np.zeros(2, [("xyz", "<f4", 3), ("timestamp", "<f8")])
    rows["xyz"], rows["timestamp"] = [[1, 2, 3], [4, 5, 6]], [9e9, 9e9 + 5000]
    fields = [t["PointField"](a, 4 * k, 7, 1) for k, a in enumerate("xyz")] + [t["PointField"]("timestamp", 12, 8, 1)]
    data = np.frombuffer(rows.tobytes(), np.uint8)
    cloud = t["PointCloud2"](header, 1, 2, fields, False, 20, 40, data, True)
    version = {"version": 8} if "version" in inspect.signature(Writer.__init__).parameters else {}
    with Writer(folder, **version) as bag:

        def write(topic, message, times):
            connection = bag.add_connection(topic, message.__msgtype__, typestore=store)
            for time in times:
                bag.write(connection, time, store.serialize_cdr(message, message.__msgtype__))

        for topic in imus:
            write(topic, imu, range(0, 50_000_000, 10_000_000))
        write("/joint_states", joints, range(1, 50_000_000, 10_000_000))
        write("/cloud", cloud, [20_000_000])
        write("/cmd_vel", twist, [15_000_000])
        store.register(get_types_from_msg("uint8 unread", "unitree_go/msg/LowState"))  # only its bytes are read
        for k, topic in enumerate(low_states):
            connection = bag.add_connection(topic, "unitree_go/msg/LowState", typestore=store)
            bag.write(connection, 0, LOW_STATE.to_cdr(a_state(k)))


def test_a_bag_of_ros_2(tmp_path):
    a_ros_bag(tmp_path / "bag")
    found = list(events(tmp_path / "bag", Topics()))
    states = [event.state for event in found if event.state is not None]
    assert len(states) == 5 and states[0]["motor_state"]["q"][:12].tolist() == list(range(12))
    assert states[0]["imu_state"]["quaternion"].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert states[0]["imu_state"]["gyroscope"] == pytest.approx([0.1, 0.2, 0.3])
    (points,) = [event.points for event in found if event.points is not None]
    assert points.points.tolist() == [[1, 2, 3], [4, 5, 6]] and points.times_ns.tolist() == [
        9 * 10**9,
        9 * 10**9 + 5000,
    ]
    (command,) = [event for event in found if event.command is not None]
    assert command.command.tolist() == [0.5, 0.0, 0.2] and command.time_s == pytest.approx(0.015)


def test_the_topic_of_the_joints_is_named_where_there_are_several(tmp_path):
    """A Go2 says its state on two topics, on /lf/lowstate less often; JointState may be there besides."""

    def first(folder, **topics):
        return next(event.state for event in events(tmp_path / folder, Topics(**topics)) if event.state is not None)

    a_ros_bag(tmp_path / "one", low_states=("/lowstate",))
    a_ros_bag(tmp_path / "two", low_states=("/lowstate", "/lf/lowstate"))
    assert first("one")["motor_state"]["q"][:12] == pytest.approx(0.1 * np.arange(12))
    with pytest.raises(DeployError, match=r"several given, .*LowState are .*; name one with joints="):
        first("two")
    assert first("two", joints="/lf/lowstate")["motor_state"]["q"][:12] == pytest.approx(0.1 * np.arange(12) + 1)
    assert first("two", joints="/joint_states")["motor_state"]["q"][:12].tolist() == list(range(12))
    with pytest.raises(DeployError, match=r"/imu given, .*LowState or .*JointState are .*; name one with joints="):
        first("two", joints="/imu")


def test_bags_that_do_not_say_enough(tmp_path):
    a_ros_bag(tmp_path / "two", imus=("/imu", "/livox/imu"))
    with pytest.raises(DeployError, match=r"several given, .* are /imu, /livox/imu; name one with imu="):
        list(events(tmp_path / "two", Topics()))
    assert list(events(tmp_path / "two", Topics(imu="/imu")))
    a_ros_bag(tmp_path / "other", names=[f"leg_{k}" for k in range(12)])
    with pytest.raises(DeployError, match="joints of a Go2 were expected, FL_calf_joint"):
        list(events(tmp_path / "other", Topics()))
    for k, (lack, said) in enumerate(
        [
            ({"positions": 0}, "12 joints are named, and position has 0 numbers"),
            ({"velocities": 0}, "12 joints are named, and velocity has 0 numbers"),
            ({"velocities": 11}, "12 joints are named, and velocity has 11 numbers"),
            ({"orientation_covariance": -1.0}, "orientation_covariance of -1 says that it has none; name another"),
        ]
    ):
        a_ros_bag(tmp_path / f"lacks{k}", **lack)
        with pytest.raises(DeployError, match=said):
            list(events(tmp_path / f"lacks{k}", Topics()))
    with pytest.raises(DeployError, match="does not exist"):
        list(events(tmp_path / "none.mcap", Topics()))
    (tmp_path / "none.mcap").write_bytes(b"nothing of the kind, at some length")
    with pytest.raises(DeployError, match="is not a readable MCAP file"):
        list(events(tmp_path / "none.mcap", Topics()))
    with pytest.raises(DeployError, match="a file ending in .mcap was expected"):
        Recorder(tmp_path / "a.bag", Described)
