"""A peer in another Python with another cyclonedds, which knows nothing of this package.

    python old_peer.py read|write TOPIC DOMAIN < type.json

type.json: [name, [[field, scalar or such a type, length of an array or 0], ...]]. `write` writes samples of which the
scalar `tick` is 123, or motor_cmd[3].q is 1.5; `read` prints that of the first that comes. Both end after 20 s.
"""

import json
import sys
import time

from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import annotations, make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

LOOPBACK = """<CycloneDDS><Domain Id="any"><General>
  <Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast>
</General><Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers>
</Discovery></Domain></CycloneDDS>"""


def of(kind, octet):
    """A type, and a function that gives a sample of zeros."""
    scalars = {"u1": octet, "u2": "uint16", "u4": "uint32", "i2": "int16", "i4": "int32", "f4": "float32"}
    name, fields, zeros = kind[0], {}, {}
    for field, one, length in kind[1]:
        if isinstance(one, str):
            made, zero = getattr(types, scalars[one]), (float if one == "f4" else int)
        else:
            made, zero = of(one, octet)
        fields[field] = types.array[made, length] if length else made
        zeros[field] = (lambda zero=zero, length=length: [zero() for _ in range(length)]) if length else zero
    struct = make_idl_struct(name.rpartition(".")[2], name, fields)
    struct = annotations.final(annotations.autoid("sequential")(struct))
    return struct, lambda: struct(**{field: zero() for field, zero in zeros.items()})


def main(what, topic, domain):
    kind, zeros = of(json.load(sys.stdin), "uint8")  # as unitree_sdk2_python says, whatever the library
    domain, end = int(domain), time.monotonic() + 20.0
    _domain = Domain(domain, LOOPBACK)
    participant = DomainParticipant(domain)
    here = Topic(participant, topic, kind)
    if what == "read":
        reader = DataReader(participant, here)
        while time.monotonic() < end:
            for sample in reader.take():
                print(sample.tick if hasattr(sample, "tick") else sample.motor_cmd[3].q, flush=True)
                return
            time.sleep(0.01)
    writer, sample = DataWriter(participant, here), zeros()
    if hasattr(sample, "tick"):
        sample.tick = 123
    else:
        sample.motor_cmd[3].q = 1.5
    while time.monotonic() < end:
        writer.write(sample)
        time.sleep(0.02)


if __name__ == "__main__":
    main(*sys.argv[1:])
