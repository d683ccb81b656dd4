"""Topics of ROS 2 on DDS by cyclonedds, with messages whose CDR is ready made.

`cyclonedds` writes and reads sequences byte by byte in Python: 1 ms for 16 kB. Its types here state
the members of a message to DDS, as it asks for, and carry its bytes as they are.
"""

from __future__ import annotations

import functools
import os
import socket
import types
from dataclasses import dataclass
from typing import Any
from xml.sax.saxutils import quoteattr

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import (
    DDSException,
    InstanceState,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl import types as idl
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype

from sparseskin.nodes.errors import SettingsError

from . import cdr

TOPIC_PREFIX = "rt"
"""Begins the DDS name of a ROS topic: /skin/taxels is rt/skin/taxels."""
BLOCK_MS = 10
"""Longest wait of a write for a reader that is behind, milliseconds; then the sample is dropped."""
BATCH = 256
WHC_HIGH = "16 MB"
"""Unacknowledged bytes of a writer beyond which a write waits: far more than any history here."""


@functools.cache
def message_type(kind: str) -> type[Any]:
    """Type of a message such as "sensor_msgs/msg/Image", by its definition of ROS 2; the bytes of
    `ready` messages are written as they are, and received ones kept so.
    """
    made = _type_of(kind)
    made.serialize = lambda self, *_, **__: self.cdr
    made.deserialize = classmethod(lambda cls, data, *_, **__: ready(cls, bytes(data)))
    return made


def ready(cls: type[Any], data: bytes) -> Any:
    """A message of a `message_type` of ready made CDR, its encapsulation header included."""
    made = object.__new__(cls)
    made.cdr = data
    return made


@functools.cache
def _type_of(kind: str) -> type[Any]:
    """Type of cyclonedds with the members of a message, by which DDS joins readers and writers."""
    package, _, name = kind.split("/")
    members = {member: _member(form) for member, form in cdr.types().fielddefs[kind][1]}
    form = {"typename": f"{package}::msg::dds_::{name}_"}
    body = {"__annotations__": members, "__module__": __name__}
    return dataclass(types.new_class(name, (IdlStruct,), form, lambda made: made.update(body)))


def _member(form: Any) -> Any:
    """Type of cyclonedds of a member, by its form in a definition of rosbags."""
    node, of = form
    if node == Nodetype.SEQUENCE:
        sequence: Any = idl.sequence
        return sequence[_member(of[0])]
    if node == Nodetype.NAME:
        return _type_of(of)
    return {"string": str, "bool": bool}.get(of[0]) or getattr(idl, of[0])


_domains: dict[int, tuple[str, Domain]] = {}
"""Domains that this process has configured, and their interfaces: it can do so once each."""


class Member:
    """A participant in a domain; `where` it listens, in words."""

    def __init__(self, domain: int, interface: str) -> None:
        before = _udp_sockets()
        try:
            if interface and _domains.get(domain, ("",))[0] != interface:
                _domains[domain] = interface, Domain(domain, _config(interface))
            self.participant = DomainParticipant(domain)
            made = {fd: at for fd, at in _udp_sockets().items() if fd not in before}
            for fd in made if interface == "lo" else ():
                # cyclonedds 11 binds what it receives by to all interfaces, whichever is stated.
                with socket.socket(fileno=os.dup(fd)) as one:
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")
        except (DDSException, OSError) as error:
            raise SettingsError(
                f"interface: cannot join DDS domain {domain} by {interface or 'any interface'}: "
                f"{getattr(error, 'msg', '') or error}"
            ) from error
        addresses = sorted({*made.values()} - {"0.0.0.0"})
        by = interface or ", ".join(addresses) or "the interface of CYCLONEDDS_URI"
        self.where = f"DDS domain {domain} by {by}"
        self._discovered = BuiltinDataReader(self.participant, BuiltinTopicDcpsPublication)
        self._publications: dict[str, tuple[str, bool]] = {}

    def writer(self, topic: str, kind: str, depth: int, reliable: bool) -> Writer:
        """A writer of messages of a type, as "sensor_msgs/msg/Image", with its hash for ROS 2."""
        user = Policy.Userdata(f"typehash={cdr.types().hash_rihs01(kind)};".encode())
        qos = Qos(user, base=quality(depth, reliable))
        return Writer(DataWriter(self.participant, self._topic(topic, kind), qos=qos))

    def reader(self, topic: str, kind: str, depth: int, reliable: bool) -> Reader:
        """A reader of these messages."""
        qos = quality(depth, reliable)
        return Reader(DataReader(self.participant, self._topic(topic, kind), qos=qos))

    def publications(self) -> dict[str, tuple[str, bool]]:
        """Type of the messages on each topic, and True if they are sent reliably."""
        for found in self._discovered.take(N=BATCH):
            name, of = getattr(found, "topic_name", ""), getattr(found, "type_name", "")
            if name.startswith(f"{TOPIC_PREFIX}/"):
                reliable = Policy.Reliability.BestEffort not in found.qos
                kind = of.replace("::dds_::", "/").replace("::", "/").removesuffix("_")
                self._publications[name.removeprefix(TOPIC_PREFIX)] = kind, reliable
        return self._publications

    def close(self) -> None:
        """Leave the domain."""
        del self.participant, self._discovered

    def _topic(self, topic: str, kind: str) -> Topic[Any]:
        return Topic(self.participant, TOPIC_PREFIX + topic, message_type(kind))


class Writer:
    """A writer of DDS."""

    def __init__(self, writer: Any) -> None:
        self._writer = writer

    def is_read(self) -> bool:
        """True if somebody reads the topic."""
        return bool(self._writer.get_matched_subscriptions())

    def write(self, data: bytes) -> bool:
        """Publish a message in CDR; False if a reader was behind and it is dropped."""
        try:
            self._writer.write(ready(self._writer.topic.data_type, data))
        except DDSException:
            return False
        return True


class Reader:
    """A reader of DDS; `n_lost`, messages that were lost on the way."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader
        self._waiting = WaitSet(reader.participant)
        anything = SampleState.Any | ViewState.Any | InstanceState.Any
        self._waiting.attach(ReadCondition(reader, anything))

    @property
    def n_lost(self) -> int:
        return int(self._reader.get_sample_lost_status().total_count)

    def take(self, wait_s: float, n: int) -> list[bytes]:
        """At most n messages in CDR, after a wait for the first one."""
        self._waiting.wait(duration(seconds=wait_s))
        found = (getattr(sample, "cdr", None) for sample in self._reader.take(N=n))
        return [data for data in found if data is not None]  # or a note that its writer is gone


def _udp_sockets() -> dict[int, str]:
    """IPv4 addresses of the UDP sockets of this process, by their file descriptors."""
    found = {}
    for name in os.listdir("/proc/self/fd"):
        try:
            if os.readlink(f"/proc/self/fd/{name}").startswith("socket:"):
                with socket.socket(fileno=os.dup(int(name))) as one:
                    if (one.family, one.type) == (socket.AF_INET, socket.SOCK_DGRAM):
                        found[int(name)] = one.getsockname()[0]
        except OSError:
            continue  # it was closed meanwhile
    return found


def _config(interface: str) -> str:
    """Configuration of a domain. Multicast does not work on the loopback interface of Linux, so
    there participants look for each other by number.
    """
    local = interface == "lo"
    peers = '<Peers><Peer Address="127.0.0.1"/></Peers>' if local else ""
    return (
        f"<CycloneDDS><Domain Id='any'><General><Interfaces><NetworkInterface "
        f"name={quoteattr(interface)}/></Interfaces>"
        f"<AllowMulticast>{'false' if local else 'default'}</AllowMulticast></General>"
        f"<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>{peers}</Discovery>"
        f"<Internal><Watermarks><WhcHigh>{WHC_HIGH}</WhcHigh></Watermarks></Internal>"
        "</Domain></CycloneDDS>"
    )


def quality(depth: int, reliable: bool = True) -> Qos:
    """Quality of service: the last `depth` samples are kept, in the CDR that ROS 2 uses."""
    wait = duration(milliseconds=BLOCK_MS)
    return Qos(
        Policy.Reliability.Reliable(wait) if reliable else Policy.Reliability.BestEffort,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
