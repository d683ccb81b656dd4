"""Topics of ROS 2 on DDS by cyclonedds, with messages whose CDR is ready made.

`cyclonedds` writes and reads sequences byte by byte in Python: 1 ms for 16 kB. Its types here state
the members of a message to DDS, as it asks for, and carry its bytes as they are.
"""

import contextlib
import functools
import os
import socket
import types
from collections.abc import Iterable
from dataclasses import dataclass
from threading import Event, Thread
from typing import Any
from uuid import UUID
from xml.sax.saxutils import quoteattr

import numpy as np
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
from .endpoints import Reader, Writer

NODES = "rmw_dds_common/msg/ParticipantEntitiesInfo"
"""Type of the messages by which participants of ROS 2 state their nodes, of Jazzy and later."""
NODES_HASH = "RIHS01_91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e"
"""Hash of that type in rmw_dds_common, whose char is a uint8; that of rosbags differs."""
ANNOUNCE_S = 0.2
"""Time between two looks whether the nodes of ROS 2 have changed, seconds; chosen."""
TOPIC_PREFIX = "rt"
"""Begins the DDS name of a ROS topic: /skin/taxels is rt/skin/taxels."""
BLOCK_MS = 10
"""Longest wait of a write for a reader that is behind, milliseconds; then the sample is dropped."""
BATCH = 256
WHC_HIGH = "16 MB"
"""Unacknowledged bytes of a writer beyond which a write waits: far more than any history here."""


@functools.cache
def message_type(kind: str) -> type[Any]:
    """Type of a message such as "sensor_msgs/msg/Image", with the members by which DDS joins the
    ends of a topic. The bytes of `ready` messages are written as they are, and kept when received.
    """
    package, _, name = kind.split("/")
    # Members are needed for the type information by which DDS matches both ends.
    members = {member: _member(form) for member, form in cdr.types().fielddefs[kind][1]}
    # The name of a type in DDS, as the middleware of ROS 2 builds it.
    form = {"typename": f"{package}::msg::dds_::{name}_"}
    body = {"__annotations__": members, "__module__": __name__}
    new = types.new_class(
        name, (IdlStruct,), form, lambda namespace: namespace.update(body)
    )
    message: type[Any] = dataclass(new)
    # In place of the Python serialiser of cyclonedds, which takes 1 ms for 16 kB.
    message.serialize = lambda self, *_, **__: self.cdr
    message.deserialize = classmethod(
        lambda cls, data, *_, **__: ready(cls, bytes(data))
    )
    return message


def ready(cls: type[Any], data: bytes) -> Any:
    """A message of a `message_type` of ready made CDR, its encapsulation header included."""
    # The members stay empty: only the bytes are used.
    message = object.__new__(cls)
    message.cdr = data
    return message


def _member(form: Any) -> Any:
    """Type of cyclonedds of a member, by its form in a definition of rosbags."""
    node, detail = form
    if node in (Nodetype.SEQUENCE, Nodetype.ARRAY):
        list_type: Any = idl.sequence if node == Nodetype.SEQUENCE else idl.array
        entry, length = detail
        if not length:
            # A sequence without a limit.
            return list_type[_member(entry)]
        return list_type[_member(entry), length]
    if node == Nodetype.NAME:
        return message_type(detail)
    return {"string": str, "bool": bool}.get(detail[0]) or getattr(idl, detail[0])


_domains: dict[int, tuple[str, Domain]] = {}
"""Domains that this process has configured, and their interfaces: it can do so once each."""


class Member:
    """A participant in a domain; `where` it listens, in words."""

    def __init__(self, domain: int, interface: str, name: str) -> None:
        # The sockets of this participant are those that come with it.
        sockets_before = _udp_sockets()
        try:
            if interface and _domains.get(domain, ("",))[0] != interface:
                _domains[domain] = (interface, Domain(domain, _config(interface)))
            # Nodes of ROS 2 ignore a participant that names no enclave.
            enclave = Qos(Policy.Userdata(b"enclave=/;"))
            self.participant = DomainParticipant(domain, enclave)
            address_of = _udp_sockets()
            for fd in sockets_before:
                address_of.pop(fd, None)
            if interface == "lo":
                _bind_to_loopback(address_of)
        except (DDSException, OSError) as error:
            network = interface or "any interface"
            reason = getattr(error, "msg", "") or error
            raise SettingsError(
                f"interface: cannot join DDS domain {domain} by {network}: {reason}"
            ) from error

        addresses = sorted({*address_of.values()} - {"0.0.0.0"})
        by = interface or ", ".join(addresses) or "the interface of CYCLONEDDS_URI"
        self.where = f"DDS domain {domain} by {by}"
        self._discovered = BuiltinDataReader(
            self.participant, BuiltinTopicDcpsPublication
        )
        self._publications: dict[str, tuple[str, bool]] = {}

        # The node and its endpoints are announced beside it.
        topic = Topic(self.participant, "ros_discovery_info", message_type(NODES))
        qos = Qos(Policy.Durability.TransientLocal, _hash_of(NODES), base=quality(1))
        self._nodes = DataWriter(self.participant, topic, qos=qos)
        self._writers = list[UUID]()
        self._readers = list[UUID]()
        self._left = Event()
        self._announcing = Thread(
            target=self._announce,
            args=(name,),
            daemon=True,
        )
        self._announcing.start()

    def writer(self, topic: str, kind: str, depth: int, reliable: bool) -> Writer:
        """A writer of messages of a type, as "sensor_msgs/msg/Image", with its hash for ROS 2."""
        qos = Qos(_hash_of(kind), base=quality(depth, reliable))
        writer = DataWriter(self.participant, self._topic(topic, kind), qos=qos)
        self._writers.append(writer.guid)

        def write(data: bytes) -> bool:
            try:
                writer.write(ready(writer.topic.data_type, data))
            except DDSException:
                return False
            return True

        return Writer(writer.get_matched_subscriptions, write)

    def reader(self, topic: str, kind: str, depth: int, reliable: bool) -> Reader:
        """A reader of these messages."""
        qos = Qos(_hash_of(kind), base=quality(depth, reliable))
        reader: Any = DataReader(self.participant, self._topic(topic, kind), qos=qos)
        self._readers.append(reader.guid)
        waiting = WaitSet(self.participant)
        # Whatever comes wakes the reader; samples without data are dropped below.
        anything = SampleState.Any | ViewState.Any | InstanceState.Any
        waiting.attach(ReadCondition(reader, anything))

        def take(wait_s: float, n: int) -> list[bytes]:
            # Returns at once where samples wait already.
            waiting.wait(duration(seconds=wait_s))
            # A sample without bytes notes that its writer is gone.
            payloads = (getattr(sample, "cdr", None) for sample in reader.take(N=n))
            return [data for data in payloads if data is not None]

        return Reader(take, lambda: reader.get_sample_lost_status().total_count)

    def publications(self) -> dict[str, tuple[str, bool]]:
        """Type of the messages on each topic, and True if they are sent reliably."""
        # Each publication is reported once: those found before are kept.
        for publication in self._discovered.take(N=BATCH):
            name = getattr(publication, "topic_name", "")
            type_name = getattr(publication, "type_name", "")
            # Topics of DDS alone, and services, have other names.
            if name.startswith(f"{TOPIC_PREFIX}/"):
                reliable = Policy.Reliability.BestEffort not in publication.qos
                # package::msg::dds_::Name_ is package/msg/Name.
                kind = type_name.replace("::dds_::", "::").replace("::", "/")
                topic = name.removeprefix(TOPIC_PREFIX)
                self._publications[topic] = (kind.removesuffix("_"), reliable)
        return self._publications

    def close(self) -> None:
        """Leave the domain."""
        # The announcing thread writes by the participant: it ends first.
        self._left.set()
        self._announcing.join()
        del self.participant, self._discovered, self._nodes

    def _topic(self, topic: str, kind: str) -> Topic[Any]:
        return Topic(self.participant, TOPIC_PREFIX + topic, message_type(kind))

    def _announce(self, name: str) -> None:
        """State the node and its endpoints to nodes of Jazzy and later, each time that these or
        those change. In Humble, whose readers state no hash, that message has another form.
        """
        writer = self._nodes
        announced = None

        def gids(guids: list[UUID]) -> list[Any]:
            return [(np.frombuffer(guid.bytes, np.uint8),) for guid in guids]

        def are_of_jazzy(readers: Any) -> bool:
            for reader in readers:
                of_reader = writer.get_matched_subscription_data(reader)
                # Its hash is that of the form which Jazzy introduced.
                if of_reader and _hash_of(NODES) in of_reader.qos:
                    return True
            return False

        def announcement(reader_guids: list[UUID], writer_guids: list[UUID]) -> Any:
            # A participant is one node here, in the root namespace.
            (gid,) = gids([self.participant.guid])
            node = ("/", name, gids(reader_guids), gids(writer_guids))
            data = cdr.encoded(NODES, gid=gid, node_entities_info_seq=[node])
            return ready(writer.topic.data_type, data)

        while not self._left.wait(ANNOUNCE_S):
            # A reader may leave meanwhile.
            with contextlib.suppress(DDSException):
                readers = writer.get_matched_subscriptions()
                state = (readers, [*self._readers], [*self._writers])
                if state != announced and are_of_jazzy(readers):
                    writer.write(announcement(*state[1:]))
                    announced = state


def _bind_to_loopback(descriptors: Iterable[int]) -> None:
    """Bind sockets to the loopback interface: cyclonedds 11 binds what it receives by to all
    interfaces, whichever is stated.
    """
    for fd in descriptors:
        # A copy of the descriptor is closed here, and the socket stays open.
        with socket.socket(fileno=os.dup(fd)) as copy:
            copy.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")


def _udp_sockets() -> dict[int, str]:
    """IPv4 addresses of the UDP sockets of this process, by their file descriptors."""
    addresses = {}
    for name in os.listdir("/proc/self/fd"):
        # A file may be closed meanwhile.
        with contextlib.suppress(OSError):
            if not os.readlink(f"/proc/self/fd/{name}").startswith("socket:"):
                continue
            # A copy: to close it must not close the socket itself.
            with socket.socket(fileno=os.dup(int(name))) as copy:
                if (copy.family, copy.type) == (socket.AF_INET, socket.SOCK_DGRAM):
                    addresses[int(name)] = copy.getsockname()[0]
    return addresses


def _config(interface: str) -> str:
    """Configuration of a domain. Multicast does not work on the loopback interface of Linux, so
    there participants look for each other by number.
    """
    # On other interfaces participants find each other by multicast.
    peers = ""
    multicast = "default"
    if interface == "lo":
        peers = '<Peers><Peer Address="127.0.0.1"/></Peers>'
        multicast = "false"
    return (
        f"<CycloneDDS><Domain Id='any'><General><Interfaces><NetworkInterface "
        f"name={quoteattr(interface)}/></Interfaces>"
        f"<AllowMulticast>{multicast}</AllowMulticast></General>"
        f"<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>{peers}</Discovery>"
        f"<Internal><Watermarks><WhcHigh>{WHC_HIGH}</WhcHigh></Watermarks></Internal>"
        "</Domain></CycloneDDS>"
    )


def _hash_of(kind: str) -> Any:
    """Hash of a type of messages, as nodes of Jazzy and later state it for a writer or reader."""
    # rosbags computes the hash of every other type as ROS 2 does.
    hash_text = NODES_HASH if kind == NODES else cdr.types().hash_rihs01(kind)
    return Policy.Userdata(f"typehash={hash_text};".encode())


def quality(depth: int, reliable: bool = True) -> Qos:
    """Quality of service: the last `depth` samples are kept, in the CDR that ROS 2 uses."""
    reliability: Any = Policy.Reliability.BestEffort
    if reliable:
        reliability = Policy.Reliability.Reliable(duration(milliseconds=BLOCK_MS))
    return Qos(
        reliability,
        # A slow reader loses the oldest samples, and never blocks the graph for long.
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
