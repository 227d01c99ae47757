"""Topics over CycloneDDS: bytes in and out, with the types that others expect to find on them.

cyclonedds brings the network and the description of the types; what is in a sample stays bytes, which `messages` and
`clouds` read at once, where cyclonedds would build a Python object for each of its hundreds of fields.

Who describes a type otherwise is not heard, though the bytes are the same. Cyclone DDS up to 0.10 (a Go2's, and
unitree_sdk2_python's) says `byte` where 11 says `uint8`, and ends with a segmentation fault when it is told of the
latter. So `byte` is said here; `uint8`, or the name of another package that holds Livox's CustomMsg, only beside it and
while somebody at the topic says so.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable
from functools import cache
from typing import TYPE_CHECKING, Any

from omnirobot.runtime.description import DeployError
from omnirobot.wire.messages import Struct

if TYPE_CHECKING:
    from cyclonedds.domain import DomainParticipant

POINT_CLOUD2 = "sensor_msgs.msg.dds_.PointCloud2_"
_LIVOX_PACKAGES = ("livox_ros_driver2", "livox_ros_driver", "livox_interfaces")
_CUSTOM_MSGS = tuple(f"{package}.msg.dds_.CustomMsg_" for package in _LIVOX_PACKAGES)
CUSTOM_MSG = _CUSTOM_MSGS[0]
REQUEST, RESPONSE = "unitree_api.msg.dds_.Request_", "unitree_api.msg.dds_.Response_"
LOW_CMD_TOPIC, LOW_STATE_TOPIC = "rt/lowcmd", "rt/lowstate"
_OCTETS = ("byte", "uint8")

_LOOPBACK = """<CycloneDDS><Domain Id="any"><General>
  <Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast>
</General><Discovery>
  <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>40</MaxAutoParticipantIndex>
  <Peers><Peer address="127.0.0.1"/></Peers>
</Discovery></Domain></CycloneDDS>"""
_NETWORK = """<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface name="{}"/></Interfaces></General>
</Domain></CycloneDDS>"""


class Network:
    """A participant of a DDS domain.

    Attributes:
        interface: network interface; "lo": this machine alone, without multicast.
        domain: 0 on a robot.
        participant: cyclonedds' own.
    """

    def __init__(self, interface: str = "lo", domain: int = 0) -> None:
        from cyclonedds.core import DDSException
        from cyclonedds.domain import Domain, DomainParticipant

        self.interface, self.domain = interface, domain
        there = [name for _, name in socket.if_nameindex()]
        if interface not in there:
            raise DeployError(f"interface={interface}: one of this machine's was expected, {', '.join(there)}")
        try:
            self._domain = Domain(domain, _LOOPBACK if interface == "lo" else _NETWORK.format(interface))
            self.participant: DomainParticipant = DomainParticipant(domain)
        except DDSException:
            raise DeployError(f"interface={interface}: CycloneDDS cannot use it; is it up, with an address?") from None

    def reader(self, topic: str, kind: Struct | str, depth: int = 1) -> Reader:
        """What others write on a topic; kind: its type."""
        return Reader(self, topic, kind, depth)

    def writer(self, topic: str, kind: Struct | str) -> Writer:
        """A topic to write on."""
        return Writer(self, topic, kind)


class Reader:
    """The newest samples of a topic, best effort."""

    def __init__(self, network: Network, topic: str, kind: Struct | str, depth: int) -> None:
        from cyclonedds.builtin import BuiltinTopicDcpsPublication
        from cyclonedds.core import Policy, Qos
        from cyclonedds.sub import DataReader

        older_cdr = Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False)
        qos = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(depth), older_cdr)
        self._depth = depth
        self._reader, self._others = _ends(network, topic, kind, DataReader, qos, BuiltinTopicDcpsPublication)

    def take(self) -> list[bytes]:
        """CDR of the samples that have come since the call before, oldest first, `depth` at most of each writer."""
        readers = (self._reader, *self._others.spoken_to())
        samples = [sample for reader in readers for sample in reader.take(N=self._depth)]
        return [sample.cdr for sample in samples if hasattr(sample, "cdr")]

    def why_silent(self) -> str:
        """What is known of who writes the topic, of which nothing comes."""
        readers = (self._reader, *self._others.spoken_to())
        return self._others.what_is_there(any(reader.get_matched_publications() for reader in readers))


class Writer:
    """Samples to a topic.

    Attributes:
        unsent: samples so far that DDS did not take, because a reader is behind or the network is gone.
    """

    def __init__(self, network: Network, topic: str, kind: Struct | str) -> None:
        from cyclonedds.builtin import BuiltinTopicDcpsSubscription
        from cyclonedds.core import Policy, Qos
        from cyclonedds.pub import DataWriter
        from cyclonedds.util import duration

        self.unsent = 0
        qos = Qos(Policy.Reliability.Reliable(duration(milliseconds=1)), Policy.History.KeepLast(1))
        self._writer, self._others = _ends(network, topic, kind, DataWriter, qos, BuiltinTopicDcpsSubscription)

    def write(self, cdr: bytes) -> None:
        """One sample; the next one matters more than one that cannot be sent."""
        from cyclonedds.core import DDSException

        for writer in (self._writer, *self._others.spoken_to()):
            sample: Any = object.__new__(writer.topic.data_type)
            sample.cdr = cdr
            try:
                writer.write(sample)
            except DDSException:
                self.unsent += 1


def _ends(network: Network, topic: str, kind: Struct | str, end: Any, qos: Any, opposite: Any) -> tuple[Any, _Others]:
    """An end of a topic, and those for others who describe its type otherwise.

    Args:
        end: DataReader or DataWriter; qos: of it; opposite: the builtin topic that tells of those at the other end.
    """
    from cyclonedds.builtin import BuiltinDataReader
    from cyclonedds.topic import Topic

    participant = network.participant  # it ends with its last reference, and its ends with it

    def make(described: Any) -> Any:
        return end(participant, Topic(participant, topic, described), qos=qos)

    return make(_type(kind)), _Others(network, topic, kind, make, BuiltinDataReader(participant, opposite))


class _Others:
    """Who is at the other end of a topic, and an end for each who describes its type otherwise than we do."""

    def __init__(self, network: Network, topic: str, kind: Struct | str, make: Callable, found: Any) -> None:
        """Args: make: an end of a type; found: tells of the others."""
        self._network, self._topic, self._kind, self._make, self._found = network, topic, kind, make, found
        self._there: dict[Any, tuple[str, Any]] = {}
        self._made: dict[Any, Any] = {}

    def spoken_to(self) -> Iterable[Any]:
        """The ends that are needed now, beside the usual one."""
        from cyclonedds.core import InstanceState

        found = self._found.take(N=64)
        for other in found:
            if other.sample_info.instance_state != InstanceState.Alive:
                self._there.pop(other.key, None)
            elif other.topic_name == self._topic:
                self._there[other.key] = (other.type_name, other.type_id)
        if found:
            described = {_as_described(self._kind, *other) for other in self._there.values()}
            self._made = {one: self._made.get(one) or self._make(one) for one in described - {None, _type(self._kind)}}
        return self._made.values()

    def what_is_there(self, is_matched: bool) -> str:
        """In words; is_matched: whether DDS has found that one of the others fits."""
        if not self._there:
            return f"nobody writes {self._topic} at interface={self._network.interface} domain={self._network.domain}"
        if is_matched:
            return f"who writes {self._topic} sends nothing"
        expected = _names(self._kind)[0].replace(".", "::")
        names = sorted({name for name, _ in self._there.values()})
        if any(name.replace("::", ".") in _names(self._kind) for name in names):
            return f"who writes {self._topic} has another layout of {expected} or other settings (QoS, CDR 2)"
        return f"{self._topic} is written as {', '.join(names)}, {expected} was expected"


def _names(kind: Struct | str) -> tuple[str, ...]:
    """Names that a type goes by, ours first."""
    return _CUSTOM_MSGS if kind == CUSTOM_MSG else (kind.name if isinstance(kind, Struct) else kind,)


def _as_described(kind: Struct | str, name: str, type_id: Any) -> Any:
    """cyclonedds' class of a type as somebody describes it, by its name and what he says of its fields, or None."""
    name = name.replace("::", ".")
    if name not in _names(kind):
        return None
    for octet in _OCTETS:
        described = _type(kind if isinstance(kind, Struct) else name, octet)
        if type_id is None or described.__idl__.get_type_id() == type_id:
            return described
    return None


@cache
def _type(kind: Struct | str, octet: str = _OCTETS[0]) -> Any:
    """cyclonedds' class of a type, whose samples keep their bytes; octet: what it calls an unsigned byte."""
    made = _of_struct(kind, octet) if isinstance(kind, Struct) else _variable(octet)[kind]

    def deserialize(cls: type, data: bytes, *_: Any, **__: Any) -> Any:
        sample: Any = object.__new__(cls)
        sample.cdr = data
        return sample

    made.serialize = lambda self, *_, **__: self.cdr
    made.deserialize = classmethod(deserialize)
    return made


@cache
def _of_struct(kind: Struct, octet: str) -> Any:
    types = _idl_types()
    names = {"u2": "uint16", "u4": "uint32", "i2": "int16", "i4": "int32", "f4": "float32"}

    def annotation(field: str | Struct, length: int) -> Any:
        one = _of_struct(field, octet) if isinstance(field, Struct) else getattr(types, names.get(field, octet))
        return types.array[one, length] if length else one

    return _make(kind.name, {name: annotation(field, length) for name, field, length in kind.fields})


def _idl_types() -> Any:
    """cyclonedds' `types`, whose arrays and sequences of a type are annotations that it reads itself."""
    from cyclonedds.idl import types

    return types


def _make(name: str, fields: dict[str, Any]) -> Any:
    """An IDL type that others may not extend: @final, as Unitree's and ROS 2's are."""
    from cyclonedds.idl import annotations, make_idl_struct

    made = make_idl_struct(name.rpartition(".")[2], name, fields)
    return annotations.final(annotations.autoid("sequential")(made))


@cache
def _variable(octet: str) -> dict[str, Any]:
    """Types of variable size: ROS 2's clouds, and requests to the robot's services."""
    types = _idl_types()
    byte = getattr(types, octet)
    stamp = _make("builtin_interfaces.msg.dds_.Time_", {"sec": types.int32, "nanosec": types.uint32})
    header = _make("std_msgs.msg.dds_.Header_", {"stamp": stamp, "frame_id": str})
    u32, f32 = types.uint32, types.float32
    field_types = {"name": str, "offset": u32, "datatype": byte, "count": u32}
    fields = types.sequence[_make("sensor_msgs.msg.dds_.PointField_", field_types)]
    cloud = {"header": header, "height": u32, "width": u32, "fields": fields, "is_bigendian": bool}
    cloud |= {"point_step": u32, "row_step": u32, "data": types.sequence[byte], "is_dense": bool}
    point_types = {"offset_time": u32, "x": f32, "y": f32, "z": f32, "reflectivity": byte, "tag": byte, "line": byte}
    custom = {"header": header, "timebase": types.uint64, "point_num": u32}
    custom |= {"lidar_id": byte, "rsvd": types.array[byte, 3]}
    made = {POINT_CLOUD2: _make(POINT_CLOUD2, cloud)}
    for name in _CUSTOM_MSGS:
        point = _make(name.replace("CustomMsg_", "CustomPoint_"), point_types)
        made[name] = _make(name, custom | {"points": types.sequence[point]})
    identity = _make("unitree_api.msg.dds_.RequestIdentity_", {"id": types.int64, "api_id": types.int64})
    lease = _make("unitree_api.msg.dds_.RequestLease_", {"id": types.int64})
    policy = _make("unitree_api.msg.dds_.RequestPolicy_", {"priority": types.int32, "noreply": bool})
    status = _make("unitree_api.msg.dds_.ResponseStatus_", {"code": types.int32})
    asked_types = {"identity": identity, "lease": lease, "policy": policy}
    asked = _make("unitree_api.msg.dds_.RequestHeader_", asked_types)
    answered = _make("unitree_api.msg.dds_.ResponseHeader_", {"identity": identity, "status": status})
    binary = types.sequence[byte]
    made[REQUEST] = _make(REQUEST, {"header": asked, "parameter": str, "binary": binary})
    made[RESPONSE] = _make(RESPONSE, {"header": answered, "data": str, "binary": binary})
    return made
