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

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl import types as idl
from cyclonedds.qos import Policy, Qos
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype

from sparseskin.nodes.errors import SettingsError, SparseskinError

from . import cdr

TOPIC_PREFIX = "rt"
"""Begins the DDS name of a ROS topic: /skin/taxels is rt/skin/taxels."""
BLOCK_MS = 10
"""Longest wait of a write for a reader that is behind, milliseconds; then the sample is dropped."""
MAX_DOMAIN = 232
RANGES = {"LOCALHOST": "lo", "SUBNET": "", "SYSTEM_DEFAULT": ""}
"""Interface of each range of discovery of ROS 2."""
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


def participant(domain: int | None, interface: str | None) -> tuple[DomainParticipant, str]:
    """Join a domain by one network interface, "lo" for this host alone, "" as CYCLONEDDS_URI or
    the defaults of cyclonedds have it; where None is stated, as the variables of ROS 2 have it.
    Return the participant and the place at which it listens, in words.

    Raises SettingsError if that cannot be done.
    """
    domain = _ros_domain() if domain is None else domain
    interface = _ros_interface() if interface is None else interface
    before = _udp_sockets()
    try:
        if interface and _domains.get(domain, ("",))[0] != interface:
            _domains[domain] = interface, Domain(domain, _config(interface))
        joined = DomainParticipant(domain)
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
    return joined, f"DDS domain {domain} by {by}"


def _ros_domain() -> int:
    """Domain of ROS_DOMAIN_ID, 0 where it is not set."""
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not (text.isascii() and text.isdecimal() and int(text[:4]) <= MAX_DOMAIN):
        raise SettingsError(f"ROS_DOMAIN_ID: {text[:40]!r} is outside 0..{MAX_DOMAIN}")
    return int(text)


def _ros_interface() -> str:
    """Interface of the range in which nodes of ROS 2 find each other, SUBNET where none is set.
    Source: docs.ros.org, "Improved Dynamic Discovery".
    """
    if os.environ.get("ROS_LOCALHOST_ONLY") == "1":
        return RANGES["LOCALHOST"]
    found = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "SUBNET"
    if found not in RANGES:
        raise SettingsError(
            f"ROS_AUTOMATIC_DISCOVERY_RANGE: {found[:40]!r} is not allowed (allowed: "
            f"{', '.join(RANGES)}); or state interface"
        )
    return RANGES[found]


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


def dds_name(topic: str) -> str:
    """Name on DDS of a ROS topic, /NAME."""
    if not topic.startswith("/") or len(topic) < 2:
        raise SparseskinError(f"{topic!r}: a topic of ROS begins with /")
    return TOPIC_PREFIX + topic
