"""Others on the robot's network: another cyclonedds, other names of a type, other settings, and nobody."""

import json
import os
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("cyclonedds", reason="extra robot")

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.topic import Topic
from messages_by_hand import LIVOX, point_cloud2

from omnirobot.runtime import DeployError
from omnirobot.wire import dds, lidar
from omnirobot.wire.dds import CUSTOM_MSG, LOW_CMD_TOPIC, LOW_STATE_TOPIC, POINT_CLOUD2, REQUEST, Network
from omnirobot.wire.lidar import LidarSource
from omnirobot.wire.messages import LOW_CMD, LOW_STATE, Struct, low_cmd, sealed

PEER = Path(__file__).with_name("old_peer.py")
OLD = os.environ.get("CYCLONEDDS_0_10_PYTHON", "")
"""A Python in which cyclonedds 0.10.2 is installed: `pip install cyclonedds==0.10.2`, for Python 3.10 at most."""
needs_old = pytest.mark.skipif(not OLD, reason="CYCLONEDDS_0_10_PYTHON names no Python with cyclonedds 0.10.2")
PEERS = [pytest.param(OLD, marks=needs_old, id="0.10"), pytest.param(sys.executable, id="this one")]


def identifier(kind, octet="byte"):
    """The hash over a type's description by which others know it."""
    described = dds._type(kind, octet)
    described.__idl__.populate()
    return bytes(described.__idl__.get_type_id().value).hex()


def test_types_are_described_as_cyclonedds_0_10_describes_unitrees():
    """What cyclonedds 0.10.2 itself gives for unitree_sdk2_python's classes; the last is what 11 gives for one."""
    assert identifier(LOW_STATE) == "08f239c471d3a27e67e7c7723184"
    assert identifier(LOW_CMD) == "52cc8eb0d427d692aa2b20a90540"
    assert identifier(REQUEST) == "c47a4429fcbf539486498753c48f"
    assert identifier(LOW_STATE, "uint8") == "ef1819d05896c24741d6dbde9167"


def as_json(kind):
    return [kind.name, [[n, as_json(k) if isinstance(k, Struct) else k, length] for n, k, length in kind.fields]]


def peer(python, what, kind, topic, domain):
    words = [python, str(PEER), what, topic, str(domain)]
    started = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    started.stdin.write(json.dumps(as_json(kind)))
    started.stdin.close()
    return started


def until(step, seconds=20.0):
    """What a step gives first that is something."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if got := step():
            return got
        time.sleep(0.02)
    return None


@pytest.mark.parametrize("python", PEERS)
def test_states_of_a_peer_that_says_uint8_are_read(python):
    """Of cyclonedds 0.10, which means `byte` by it, and of 11, which does not."""
    reader = Network(domain=201).reader(LOW_STATE_TOPIC, LOW_STATE)
    started = peer(python, "write", LOW_STATE, LOW_STATE_TOPIC, 201)
    assert LOW_STATE.from_cdr(until(reader.take)[-1])["tick"] == 123
    assert started.poll() is None  # it lives
    started.kill()
    started.wait()


@pytest.mark.parametrize("python", PEERS)
@pytest.mark.parametrize("kind", ["state", "command"])
def test_a_peer_that_says_uint8_reads_what_is_written(python, kind):
    network, command = Network(domain=202), low_cmd()
    command["motor_cmd"]["q"][3] = 1.5
    if kind == "state":
        state = LOW_STATE.zeros()
        state["tick"] = 123
        writer, data = network.writer(LOW_STATE_TOPIC, LOW_STATE), LOW_STATE.to_cdr(sealed(state))
        started = peer(python, "read", LOW_STATE, LOW_STATE_TOPIC, 202)
    else:
        writer, data = network.writer(LOW_CMD_TOPIC, LOW_CMD), LOW_CMD.to_cdr(sealed(command))
        started = peer(python, "read", LOW_CMD, LOW_CMD_TOPIC, 202)
    until(lambda: writer.write(data) or started.poll() is not None)
    assert started.wait(30.0) == 0 and started.stdout.read().strip() == {"state": "123", "command": "1.5"}[kind]


def test_uint8_is_said_only_while_somebody_does():
    """What 0.10 does not survive."""
    network = Network(domain=203)
    reader = network.reader(LOW_STATE_TOPIC, LOW_STATE)
    other = DomainParticipant(203)
    writer = DataWriter(other, Topic(other, LOW_STATE_TOPIC, dds._type(LOW_STATE, "uint8")))
    assert until(lambda: reader.take() or list(reader._others.spoken_to()))
    del writer
    assert until(lambda: reader.take() or not list(reader._others.spoken_to()))


ONE_POINT = struct.pack("<iII", 12, 7, 4) + b"imu\0" + struct.pack("<QIB3xI", 5 * 10**9, 1, 0, 1)
ONE_POINT = b"\0\1\0\0" + ONE_POINT + struct.pack("<IfffBBBx", 480, 1.0, 2.0, 3.0, 9, 0, 1)


@pytest.mark.parametrize("package", ["livox_ros_driver2", "livox_ros_driver", "livox_interfaces"])
def test_livoxs_message_is_read_under_each_of_its_names(package):
    network = Network(domain=204)
    source = lidar._Topic(LidarSource(kind="CustomMsg"), network)
    writer = network.writer("rt/livox/lidar", f"{package}.msg.dds_.CustomMsg_")
    (points,) = until(lambda: writer.write(ONE_POINT) or source.read()[:1])
    assert points.points.tolist() == [[1.0, 2.0, 3.0]] and points.times_ns.tolist() == [5 * 10**9 + 480]


def why(reader):
    """What is known once somebody has been found."""
    return until(lambda: reader.take() or (reader.why_silent() if reader._others._there else None))


def test_a_topic_of_another_type_is_named_with_what_reads_it():
    network = Network(domain=205)
    source = lidar._Topic(LidarSource(kind="PointCloud2"), network)
    writer = network.writer("rt/livox/lidar", CUSTOM_MSG)
    assert why(source._reader) and source.why_silent() == (
        "rt/livox/lidar is written as livox_ros_driver2::msg::dds_::CustomMsg_,"
        " sensor_msgs::msg::dds_::PointCloud2_ was expected; points=CustomMsg reads it"
    )
    del writer


def test_a_topic_that_nobody_writes_and_one_whose_writer_is_silent_are_named():
    network = Network(domain=206)
    reader = network.reader(LOW_STATE_TOPIC, LOW_STATE)
    assert reader.why_silent() == "nobody writes rt/lowstate at interface=lo domain=206"
    writer = network.writer(LOW_STATE_TOPIC, LOW_STATE)
    assert why(reader) == "who writes rt/lowstate sends nothing"
    del writer


NEWER_CDR = Policy.DataRepresentation(use_cdrv0_representation=False, use_xcdrv2_representation=True)


@pytest.mark.parametrize("other", ["layout", "partition", "newer CDR"])
def test_a_writer_that_does_not_fit_is_named(other):
    network = Network(domain=207)
    reader, participant = network.reader(LOW_STATE_TOPIC, LOW_STATE), network.participant
    if other == "layout":
        shorter = Struct(LOW_STATE.name, LOW_STATE.fields[:-1])
        writer = network.writer(LOW_STATE_TOPIC, shorter)
    else:
        settings = Qos(NEWER_CDR) if other == "newer CDR" else None
        publisher = Publisher(participant, qos=Qos(Policy.Partition(["elsewhere"])) if settings is None else None)
        writer = DataWriter(publisher, Topic(participant, LOW_STATE_TOPIC, dds._type(LOW_STATE)), qos=settings)
    expected = "another layout of unitree_go::msg::dds_::LowState_ or other settings (QoS, CDR 2)"
    assert why(reader) == f"who writes rt/lowstate has {expected}"
    del writer


def test_an_interface_that_is_none_is_named():
    with pytest.raises(DeployError, match="interface=eth9: one of this machine's was expected, .*lo"):
        Network("eth9")


@pytest.mark.parametrize(
    "policies",
    [(Policy.Reliability.BestEffort,), (Policy.Reliability.Reliable(10**9), Policy.Durability.TransientLocal)],
    ids=["best effort", "transient local"],
)
def test_states_with_other_settings_are_read(policies):
    network = Network(domain=208)
    reader, described = network.reader(LOW_STATE_TOPIC, LOW_STATE), dds._type(LOW_STATE)
    topic = Topic(network.participant, LOW_STATE_TOPIC, described)
    writer = DataWriter(network.participant, topic, qos=Qos(*policies))
    state, sample = LOW_STATE.zeros(), object.__new__(described)
    state["tick"] = 77
    sample.cdr = LOW_STATE.to_cdr(sealed(state))
    (data, *_) = until(lambda: writer.write(sample) or reader.take())
    assert LOW_STATE.from_cdr(data)["tick"] == 77


def test_a_drivers_cloud_of_a_peer_that_says_uint8_is_read():
    """A message of 200,000 bytes of points, as long as ten packets' worth of fragments."""
    network = Network(domain=209)
    source = lidar._Topic(LidarSource(kind="PointCloud2"), network)
    other = DomainParticipant(209)
    described = dds._type(POINT_CLOUD2, "uint8")
    writer, sample = DataWriter(other, Topic(other, "rt/livox/lidar", described)), object.__new__(described)
    rows = b"".join(struct.pack("<ffffBBd", k, 2.0, 3.0, 9.0, 0, 1, 5e9 + k) for k in range(8000))
    sample.cdr = point_cloud2(LIVOX, rows, 8000)
    (points,) = until(lambda: writer.write(sample) or source.read()[:1])
    assert points.points[:, 0].tolist() == list(range(8000))
