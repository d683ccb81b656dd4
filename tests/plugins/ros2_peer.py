"""Another DDS process: subscribes to or publishes messages of ROS 2 with plain types of cyclonedds,
which it writes and reads by itself: python ros2_peer.py read|write TOPIC KIND N.
"""

import itertools
import json
import sys
import time
from dataclasses import dataclass

import numpy as np
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float32, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


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
class Field(IdlStruct, typename="sensor_msgs::msg::dds_::PointField_"):
    name: str
    offset: uint32
    datatype: uint8
    count: uint32


@dataclass
class Points(IdlStruct, typename="sensor_msgs::msg::dds_::PointCloud2_"):
    header: Header
    height: uint32
    width: uint32
    fields: sequence[Field]
    is_bigendian: bool
    point_step: uint32
    row_step: uint32
    data: sequence[uint8]
    is_dense: bool


@dataclass
class Dimension(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayDimension_"):
    label: str
    size: uint32
    stride: uint32


@dataclass
class Layout(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayLayout_"):
    dim: sequence[Dimension]
    data_offset: uint32


@dataclass
class Array(IdlStruct, typename="std_msgs::msg::dds_::Float32MultiArray_"):
    layout: Layout
    data: sequence[float32]


@dataclass
class Taxel(IdlStruct, typename="maker_msgs::msg::dds_::Taxel_"):
    x: float32
    y: float32
    z: float32


@dataclass
class Module(IdlStruct, typename="maker_msgs::msg::dds_::Module_"):
    place: uint8
    taxels: sequence[Taxel]


@dataclass
class Skin(IdlStruct, typename="maker_msgs::msg::dds_::Skin_"):
    header: Header
    modules: sequence[Module]


KINDS = {"image": Image, "points": Points, "array": Array, "skin": Skin}
LOOPBACK = (
    "<CycloneDDS><Domain Id='any'><General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery>"
    "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>"
    "<Peers><Peer Address='127.0.0.1'/></Peers></Discovery></Domain></CycloneDDS>"
)


def forces(k: int) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    """Frame k of what is published here: whole 64ths, so that float32 holds them."""
    return (np.random.default_rng(k).integers(0, 160, (6, 9)) / 64).astype(np.float32)


def main(action: str, name: str, kind: str, n: int, domain: int) -> None:
    _domain = Domain(domain, LOOPBACK)
    member = DomainParticipant(domain)
    topic = Topic(member, f"rt{name}", KINDS[kind])
    keep = Policy.History.KeepLast(1000)
    reliable = Policy.Reliability.Reliable(duration(seconds=10))
    as_ros = Policy.DataRepresentation(use_cdrv0_representation=True)
    if action == "read":
        reader = DataReader(member, topic, qos=Qos(reliable, keep, as_ros))
        # That the writer knows this reader does not say that this reader knows the writer, and what
        # it sends before is not for a reader of DDS that keeps no history.
        while not reader.get_matched_publications():
            time.sleep(0.01)
        print("MATCHED", flush=True)
        samples = reader.take_iter(timeout=duration(seconds=60))
        for sample in itertools.islice(samples, n):
            print(json.dumps(shown(sample)), flush=True)
        return
    writer = DataWriter(member, topic, qos=Qos(reliable, keep, as_ros))
    while not writer.get_matched_subscriptions():
        time.sleep(0.01)
    for k in range(n):
        made = forces(k)
        header = Header(Time(100, 1 + k), "peer")
        if kind == "image":
            writer.write(Image(header, 6, 9, "32FC1", 0, 36, list(made.tobytes())))
        elif kind == "skin":
            taxels = [Taxel(-1.0, 2.0, z) for z in made.ravel().tolist()]
            writer.write(Skin(header, [Module(7, taxels)]))
        else:
            dims = [Dimension("rows", 6, 54), Dimension("cols", 9, 9)]
            writer.write(Array(Layout(dims, 0), made.ravel().tolist()))
    print("WRITTEN", flush=True)
    sys.stdin.read()  # reliable: what is not yet read stays here


def shown(sample: object) -> dict[str, object]:
    if isinstance(sample, Image):
        head = sample.header
        values = np.frombuffer(bytes(sample.data), "<f4")
        assert sample.encoding == "32FC1"
        assert sample.step == 4 * sample.width
        return {
            "stamp_ns": head.stamp.sec * 10**9 + head.stamp.nanosec, "frame_id": head.frame_id,
            "shape": [sample.height, sample.width], "values": values.tolist(),
        }  # fmt: skip
    if isinstance(sample, Points):
        fields = [
            ("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("force", 12, 7, 1), ("row", 16, 6, 1),
        ]  # fmt: skip
        n = len(sample.fields)
        found = [(f.name, f.offset, f.datatype, f.count) for f in sample.fields]
        assert found == fields[: max(4, n)]
        values = np.frombuffer(bytes(sample.data), "<f4").reshape(-1, n)
        assert sample.width == len(values)
        assert sample.point_step == 4 * n
        assert sample.is_dense
        rows = values[:, 4:].copy().view("<u4").ravel().tolist()
        return {"points": values[:, :4].tolist(), "rows": rows}
    return {"shape": [d.size for d in sample.layout.dim], "values": list(sample.data)}


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4]), int(sys.argv[5]))
