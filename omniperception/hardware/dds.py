"""Topics over CycloneDDS: bytes in and out, with the types that others expect to find on them.

cyclonedds brings the network and the description of the types; what is in a sample stays bytes, which `messages` and
`clouds` read at once, where cyclonedds would build a Python object for each of its hundreds of fields.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from omniperception.deploy.description import DeployError
from omniperception.hardware.messages import Struct

if TYPE_CHECKING:
    from cyclonedds.domain import DomainParticipant

POINT_CLOUD2 = "sensor_msgs.msg.dds_.PointCloud2_"
CUSTOM_MSG = "livox_ros_driver2.msg.dds_.CustomMsg_"
REQUEST, RESPONSE = "unitree_api.msg.dds_.Request_", "unitree_api.msg.dds_.Response_"
LOW_CMD_TOPIC, LOW_STATE_TOPIC = "rt/lowcmd", "rt/lowstate"

_LOOPBACK = """<CycloneDDS><Domain Id="any"><General>
  <Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast>
</General><Discovery>
  <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>40</MaxAutoParticipantIndex>
  <Peers><Peer address="127.0.0.1"/></Peers>
</Discovery></Domain></CycloneDDS>"""
_NETWORK = """<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface name="{}"/></Interfaces></General>
</Domain></CycloneDDS>"""


def _library() -> None:
    try:
        import cyclonedds  # noqa: F401
    except ImportError:
        raise DeployError("talking to a robot needs cyclonedds: pip install 'omniperception[robot]'") from None


class Network:
    """A participant of a DDS domain.

    Attributes:
        interface: network interface; "lo": this machine alone, without multicast.
        participant: cyclonedds' own.
    """

    def __init__(self, interface: str = "lo", domain: int = 0) -> None:
        """Args: interface: network interface; domain: 0 on a robot."""
        _library()
        from cyclonedds.core import DDSException
        from cyclonedds.domain import Domain, DomainParticipant

        self.interface = interface
        try:
            self._domain = Domain(domain, _LOOPBACK if interface == "lo" else _NETWORK.format(interface))
            self.participant: DomainParticipant = DomainParticipant(domain)
        except DDSException as error:
            raise DeployError(f"interface={interface}: CycloneDDS cannot use it ({error})") from None

    def reader(self, topic: str, kind: Struct | str, depth: int = 1) -> Reader:
        """What others write on a topic; kind: its type."""
        return Reader(self, topic, kind, depth)

    def writer(self, topic: str, kind: Struct | str) -> Writer:
        """A topic to write on."""
        return Writer(self, topic, kind)


class Reader:
    """The newest samples of a topic, best effort."""

    def __init__(self, network: Network, topic: str, kind: Struct | str, depth: int) -> None:
        from cyclonedds.core import Policy, Qos
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        self._network, self._depth = (
            network,
            depth,
        )  # a participant ends with its last reference, and its readers with it
        participant = network.participant
        qos = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(depth))
        self._reader = DataReader(participant, Topic(participant, topic, _type(kind)), qos=qos)

    def take(self) -> list[bytes]:
        """CDR of the samples that have come since the call before, oldest first, `depth` at most."""
        samples = self._reader.take(N=self._depth)
        return [sample.cdr for sample in samples if hasattr(sample, "cdr")]


class Writer:
    """Samples to a topic.

    Attributes:
        unsent: samples so far that DDS did not take, because a reader is behind or the network is gone.
    """

    def __init__(self, network: Network, topic: str, kind: Struct | str) -> None:
        from cyclonedds.core import Policy, Qos
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic
        from cyclonedds.util import duration

        self._network, self._type, self.unsent = network, _type(kind), 0
        participant = network.participant
        qos = Qos(Policy.Reliability.Reliable(duration(milliseconds=1)), Policy.History.KeepLast(1))
        self._writer = DataWriter(participant, Topic(participant, topic, self._type), qos=qos)

    def write(self, cdr: bytes) -> None:
        """One sample; the next one matters more than one that cannot be sent."""
        from cyclonedds.core import DDSException

        sample: Any = object.__new__(self._type)
        sample.cdr = cdr
        try:
            self._writer.write(sample)
        except DDSException:
            self.unsent += 1


@cache
def _type(kind: Struct | str) -> Any:
    """cyclonedds' class of a type, whose samples keep their bytes."""
    made = _of_struct(kind) if isinstance(kind, Struct) else _variable()[kind]

    def deserialize(cls: type, data: bytes, *_: Any, **__: Any) -> Any:
        sample: Any = object.__new__(cls)
        sample.cdr = data
        return sample

    made.serialize = lambda self, *_, **__: self.cdr
    made.deserialize = classmethod(deserialize)
    return made


@cache
def _of_struct(kind: Struct) -> Any:
    types = _idl_types()
    scalars = {
        "u1": types.uint8,
        "u2": types.uint16,
        "u4": types.uint32,
        "i2": types.int16,
        "i4": types.int32,
        "f4": types.float32,
    }

    def annotation(field: str | Struct, length: int) -> Any:
        one = _of_struct(field) if isinstance(field, Struct) else scalars[field]
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
def _variable() -> dict[str, Any]:
    """Types of variable size: ROS 2's clouds, and requests to the robot's services."""
    types = _idl_types()
    stamp = _make("builtin_interfaces.msg.dds_.Time_", {"sec": types.int32, "nanosec": types.uint32})
    header = _make("std_msgs.msg.dds_.Header_", {"stamp": stamp, "frame_id": str})
    field_types = {"name": str, "offset": types.uint32, "datatype": types.uint8, "count": types.uint32}
    field = _make("sensor_msgs.msg.dds_.PointField_", field_types)
    cloud = {
        "header": header,
        "height": types.uint32,
        "width": types.uint32,
        "fields": types.sequence[field],
        "is_bigendian": bool,
        "point_step": types.uint32,
        "row_step": types.uint32,
        "data": types.sequence[types.uint8],
        "is_dense": bool,
    }
    point_types = {"offset_time": types.uint32, "x": types.float32, "y": types.float32, "z": types.float32}
    point_types |= {"reflectivity": types.uint8, "tag": types.uint8, "line": types.uint8}
    point = _make("livox_ros_driver2.msg.dds_.CustomPoint_", point_types)
    custom = {
        "header": header,
        "timebase": types.uint64,
        "point_num": types.uint32,
        "lidar_id": types.uint8,
        "rsvd": types.array[types.uint8, 3],
        "points": types.sequence[point],
    }
    made = {POINT_CLOUD2: _make(POINT_CLOUD2, cloud), CUSTOM_MSG: _make(CUSTOM_MSG, custom)}
    identity = _make("unitree_api.msg.dds_.RequestIdentity_", {"id": types.int64, "api_id": types.int64})
    lease = _make("unitree_api.msg.dds_.RequestLease_", {"id": types.int64})
    policy = _make("unitree_api.msg.dds_.RequestPolicy_", {"priority": types.int32, "noreply": bool})
    status = _make("unitree_api.msg.dds_.ResponseStatus_", {"code": types.int32})
    asked_types = {"identity": identity, "lease": lease, "policy": policy}
    asked = _make("unitree_api.msg.dds_.RequestHeader_", asked_types)
    answered = _make("unitree_api.msg.dds_.ResponseHeader_", {"identity": identity, "status": status})
    binary = types.sequence[types.uint8]
    made[REQUEST] = _make(REQUEST, {"header": asked, "parameter": str, "binary": binary})
    made[RESPONSE] = _make(RESPONSE, {"header": answered, "data": str, "binary": binary})
    return made


__all__ = [
    "CUSTOM_MSG",
    "LOW_CMD_TOPIC",
    "LOW_STATE_TOPIC",
    "POINT_CLOUD2",
    "REQUEST",
    "RESPONSE",
    "Network",
]
