"""Topics of ROS 2 on DDS by cyclonedds, with messages whose CDR is ready made.

`cyclonedds` writes and reads sequences byte by byte in Python: 1 ms for 16 kB. These types state
the members of a message to DDS, as it asks for, and carry its bytes as they are.
"""

# mypy: disable-error-code="type-arg"

from dataclasses import dataclass
from typing import Any
from xml.sax.saxutils import quoteattr

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float32, int32, sequence, uint8, uint32
from cyclonedds.qos import Policy, Qos
from cyclonedds.util import duration

from sparseskin.nodes.errors import SettingsError, SparseskinError

TOPIC_PREFIX = "rt"
"""Begins the DDS name of a ROS topic: /skin/taxels is rt/skin/taxels."""
BLOCK_MS = 10
"""Longest wait of a write for a reader that is behind, milliseconds; then the sample is dropped."""
WHC_HIGH = "16 MB"
"""Unacknowledged bytes of a writer beyond which a write waits: far more than any history here."""


def ready(cls: type[Any], cdr: bytes) -> Any:
    """A message of a type below of ready made CDR, its encapsulation header included."""
    made = object.__new__(cls)
    made.cdr = cdr
    return made


def _as_it_is(cls: type[Any]) -> type[Any]:
    """Serialise the messages of a type by the bytes they were given, and deserialise into them."""
    cls.serialize = lambda self, *_, **__: self.cdr
    cls.deserialize = classmethod(lambda cls, data, *_, **__: ready(cls, bytes(data)))
    return cls


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@_as_it_is
@dataclass
class Image(IdlStruct, typename="sensor_msgs::msg::dds_::Image_"):
    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]


@dataclass
class PointField(IdlStruct, typename="sensor_msgs::msg::dds_::PointField_"):
    name: str
    offset: uint32
    datatype: uint8
    count: uint32


@_as_it_is
@dataclass
class PointCloud2(IdlStruct, typename="sensor_msgs::msg::dds_::PointCloud2_"):
    header: Header
    height: uint32
    width: uint32
    fields: sequence[PointField]
    is_bigendian: bool
    point_step: uint32
    row_step: uint32
    data: sequence[uint8]
    is_dense: bool


@dataclass
class MultiArrayDimension(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayDimension_"):
    label: str
    size: uint32
    stride: uint32


@dataclass
class MultiArrayLayout(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayLayout_"):
    dim: sequence[MultiArrayDimension]
    data_offset: uint32


@_as_it_is
@dataclass
class Float32MultiArray(IdlStruct, typename="std_msgs::msg::dds_::Float32MultiArray_"):
    layout: MultiArrayLayout
    data: sequence[float32]


_domains: dict[int, tuple[str, Domain]] = {}
"""Domains that this process has configured, and their interfaces: it can do so once each."""


def participant(domain: int, interface: str) -> DomainParticipant:
    """Join a domain by one network interface, "lo" for this host alone; "" as CYCLONEDDS_URI or
    the defaults of cyclonedds have it.

    Raises SettingsError if that cannot be done.
    """
    try:
        if interface and _domains.get(domain, ("",))[0] != interface:
            _domains[domain] = interface, Domain(domain, _config(interface))
        return DomainParticipant(domain)
    except DDSException as error:
        raise SettingsError(
            f"interface: cannot join DDS domain {domain} by {interface or 'any interface'}: "
            f"{error.msg or error}"
        ) from error


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
