"""The bridge to ROS 2, and ROS 2 as a source: against another process that has DDS alone."""

import json
import os
import re
import socket
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed")
from bags import skin_state
from conftest import wait_until
from cyclonedds.domain import DomainParticipant
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from exported import contacts
from ros2_peer import forces

from sparseskin.messages import Taxels
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SettingsError, SourceError
from sparseskin.nodes.node import Context
from sparseskin.nodes.sensor.layout.layout import Layout
from sparseskin.nodes.sensor.sources import find_address, open_source
from sparseskin.plugins.bridges import cdr, dds, topics
from sparseskin.plugins.bridges.frames import MessageReader
from sparseskin.plugins.bridges.messages.definitions import Definitions
from sparseskin.plugins.bridges.ros2 import OF_CONTACTS, Ros2Bridge, Ros2Settings
from sparseskin.plugins.bridges.ros2_source import Ros2Address, TopicFrames, frames

PEER = Path(__file__).parents[1] / "ros2_peer.py"
DOMAIN = 100 + hash(sys.executable + str(Path.cwd())) % 100
"""Not that of another test run on this host."""
MASK = np.ones((6, 9), bool)
MASK[2, 3] = MASK[5, 8] = False


@pytest.fixture(autouse=True)
def this_host_alone(monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.delenv("ROS_LOCALHOST_ONLY", raising=False)


@contextmanager
def peer(action, topic, kind, n):
    """The other process; it ends by itself, so that no reader of it is left."""
    words = [sys.executable, str(PEER), action, topic, kind, str(n), str(DOMAIN)]
    with subprocess.Popen(words, stdin=-1, stdout=-1, text=True) as process:
        yield process.stdout


def frame(k):
    made = forces(k)
    made[~MASK] = 0
    stamp_ns = 1_700_000_000_999_999_990 + k  # over the border of a second
    return Taxels(stamp_ns=stamp_ns, patch="skin", forces=made)


def sent(messages, kind, topic, **of_skin):
    """What the other process received of these messages, of a skin with these properties, too."""
    bridge = Ros2Bridge(
        Ros2Settings(domain=DOMAIN, messages=(kind,), history=1000),
        Context("ros2", ManualClock(0)),
    )
    list(bridge.start())
    skin = skin_state(n_rows=6, n_cols=9, pitch_m=0.25, mask=MASK, **of_skin)
    writer = bridge._writers[f"{kind} /skin/taxels"]
    with peer("read", topic, kind, len(messages)) as lines:
        assert lines.readline() == "MATCHED\n"
        wait_until(writer.readers, "the reader")
        for message in (skin, *messages):
            list(bridge.step(message))
        assert bridge.n_dropped == 0
        for _ in messages:
            yield json.loads(lines.readline())
    bridge.close({})


def test_images_arrive_in_another_process_each_with_its_pixels_and_stamp():
    messages = [frame(k) for k in range(200)]
    for message, got in zip(
        messages, sent(list(messages), "image", "/skin/taxels"), strict=True
    ):
        assert got["stamp_ns"] == message.stamp_ns
        assert got["frame_id"] == "skin"
        assert got["shape"] == [6, 9]
        assert got["values"] == message.forces.ravel().tolist()


@pytest.mark.parametrize("of_file", [False, True])
def test_points_are_the_taxels_that_exist_with_their_place_and_row(of_file):
    at_rows, at_cols = np.nonzero(MASK)
    places = np.stack([0.25 * at_cols, 0.25 * at_rows, 0 * at_rows], axis=1)
    of_skin = {}
    if of_file:
        places = np.random.default_rng(0).normal(size=places.shape).astype(np.float32)
        order = np.random.default_rng(1).permutation(len(places)).astype(np.int32)
        order[0] = 2**31 - 1
        points = np.concatenate(
            [places, np.tile(np.float32([0, 0, 1]), (len(places), 1))], axis=1
        )
        of_skin = {"points": points, "point_rows": order}
    (got,) = sent([frame(3)], "points", "/skin/taxels/points", **of_skin)
    assert got["points"] == np.column_stack([places, frame(3).forces[0][MASK]]).tolist()
    assert got["rows"] == (order.tolist() if of_file else [])


def test_arrays_have_rows_and_columns():
    (got,) = sent([frame(4)], "array", "/skin/taxels/array")
    assert got == {"shape": [6, 9], "values": frame(4).forces.ravel().tolist()}


def test_contacts_are_published_as_wrench_markers_and_array():
    settings = Ros2Settings(domain=DOMAIN, messages=tuple(OF_CONTACTS))
    bridge = Ros2Bridge(settings, Context("ros2", ManualClock(0)))
    skin = skin_state()
    sent = contacts(5)
    list(bridge.start())
    readers = {}
    for kind, (ending, of, _) in OF_CONTACTS.items():
        readers[kind] = bridge._member.reader(f"/skin/contacts{ending}", of, 10, True)
        wait_until(bridge._writers[f"{kind} /skin/contacts"].readers, kind)
    for message in (skin, sent):
        list(bridge.step(message))
    for kind, (_, _, make) in OF_CONTACTS.items():
        # DDS pads to 4 bytes
        assert readers[kind].take(60, 1)[0].startswith(make(sent, skin))
    bridge.close({})


@pytest.mark.parametrize("kind", ["image", "array"])
def test_a_topic_of_another_process_is_a_source(kind):
    n = 300
    with peer("write", f"/peer/{kind}", kind, n):
        source = open_source(f"ros2:/peer/{kind}?domain={DOMAIN}&timeout_s=60", seed=0)
        assert source.skin.shape == (6, 9)
        for k, (_, got) in zip(range(n), source, strict=False):
            assert np.array_equal(got, forces(k)), k
        source.close()


@contextmanager
def installed(folder, monkeypatch):
    """A package of ROS 2 with the messages of a maker of skins."""
    share = folder / "share" / "maker_msgs" / "msg"
    share.mkdir(parents=True)
    (share / "Skin.msg").write_text("std_msgs/Header header\nModule[] modules\n")
    (share / "Module.msg").write_text("uint8 place\nTaxel[] taxels\n")
    (share / "Taxel.msg").write_text("float32 x\nfloat32 y\nfloat32 z\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{folder}")
    yield


def test_a_message_of_an_installed_package_is_a_source_by_its_field(
    tmp_path, monkeypatch
):
    layout = Layout(n_rows=6, n_cols=9, field="modules[0].taxels[].z")
    with installed(tmp_path, monkeypatch), peer("write", "/peer/skin", "skin", 20):
        source = f"ros2:/peer/skin?domain={DOMAIN}&timeout_s=60"
        opened = Ros2Address(source, layout).open()
        assert opened.skin.shape == (6, 9)
        for k, (_, got) in zip(range(20), opened, strict=False):
            assert np.array_equal(got, forces(k)), k
        opened.close()


def test_a_topic_whose_fields_or_shape_are_not_stated_names_them():
    raw = cdr.image((3, 4), "left", forces(0))
    other = cdr.image((3, 5), "right", forces(1))
    read = TopicFrames("ros2:/a", cdr.IMAGE, Layout())
    stamp_ns, frame = read.frame(raw)
    assert stamp_ns == 3_000_000_004
    assert np.array_equal(frame, forces(0))
    assert read.frame(raw) is None
    assert read.n_refused == 1
    assert read.why == "a stamp that is not after the one before it"
    with pytest.raises(
        SourceError, match="several frames: 'left', 'right'; state frame_id"
    ):
        read.frame(other)
    right = TopicFrames("ros2:/a", cdr.IMAGE, Layout(frame_id="right", order="rows"))
    assert right.frame(raw) is None
    assert np.array_equal(right.frame(other)[1], forces(1))
    joints = "sensor_msgs/msg/JointState"
    numbers = dict.fromkeys(("position", "velocity", "effort"), np.ones(2))
    state = cdr.encoded(joints, header=((1, 2), "arm"), name=["a"], **numbers)
    with pytest.raises(
        SourceError, match=r"3 fields of numbers: position\[\] .2., velocity"
    ):
        TopicFrames("ros2:/a", joints, Layout()).frame(state)
    with pytest.raises(
        SourceError, match=r"maker_msgs/msg/None is not known; source the setup\.bash"
    ):
        TopicFrames("ros2:/a", "maker_msgs/msg/None", Layout())
    with pytest.raises(SourceError, match="in which shape is not stated"):
        TopicFrames("ros2:/a", joints, Layout(field="effort")).frame(state)


def test_a_topic_that_nobody_publishes_is_one_line():
    with pytest.raises(
        SourceError, match=r"ros2:/none: nobody publishes there on DDS domain"
    ):
        next(frames(f"ros2:/none?domain={DOMAIN}&timeout_s=0.3"))


@pytest.mark.parametrize(
    ("source", "fault"),
    [
        ("ros2:tactile", "begins with /"),
        ("ros2:/a?domian=3", "did you mean 'domain'"),
        ("ros2:/a?domain=300", "outside 0..232"),
    ],
)
def test_a_malformed_source_is_refused_before_any_node_starts(source, fault):
    with pytest.raises(SourceError, match=fault):
        find_address(source).check()


def test_an_interface_that_is_not_there_is_one_line():
    with pytest.raises(SettingsError, match="cannot join DDS domain"):
        topics.join(DOMAIN + 31, "nowhere0", "test")


def test_by_lo_no_packet_of_another_host_is_received():
    before = dds._udp_sockets()
    member = topics.join(DOMAIN + 32, None, "test")
    assert member.where == f"DDS domain {DOMAIN + 32} by lo"
    made = dds._udp_sockets().keys() - before.keys()
    assert made
    for fd in made:
        with socket.socket(fileno=os.dup(fd)) as one:
            device = one.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16)
        assert device.strip(b"\0") == b"lo"


@pytest.mark.parametrize("hashes", [1, 0])
def test_nodes_that_state_hashes_read_the_name_and_its_topics(hashes):
    member = topics.join(DOMAIN + 33, None, "ros2-1")
    other = DomainParticipant(DOMAIN + 33)
    topic = Topic(other, "ros_discovery_info", dds.message_type(dds.NODES))
    stated = Policy.Durability.TransientLocal, *[dds._hash_of(dds.NODES)] * hashes
    reader = DataReader(other, topic, qos=Qos(*stated, base=dds.quality(10)))
    member.writer("/a", cdr.ARRAY, 1, True)
    wait_until(member._nodes.get_matched_subscriptions, "the reader")
    for n in (1, 2) if hashes else ():
        held = []
        wait_until(lambda: held.extend(reader.take(1)) or held, "the node")  # noqa: B023
        (info,) = (
            cdr.types().deserialize_cdr(held[0].cdr, dds.NODES).node_entities_info_seq
        )
        assert info.node_name == "sparseskin_ros2_1"
        assert len(info.writer_gid_seq) == n
        member.writer("/b", cdr.ARRAY, 1, True)
    member.close()
    assert not [one for one in reader.take(10) if hasattr(one, "cdr")]


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({}, r"by (?!lo$)"),
        ({"RANGE": "SUBNET"}, r"by (?!lo$)"),
        ({"RANGE": "SUBNET", "ONLY": "1"}, "by lo$"),
        (
            {"RANGE": "OFF"},
            r"'OFF' is not allowed \(allowed: LOCALHOST, SUBNET, SYSTEM_DEFAULT",
        ),
        ({"ID": "233"}, r"ROS_DOMAIN_ID: '233' is outside 0\.\.232"),
    ],
)
def test_domain_and_range_are_those_of_ros_2(variables, expected, monkeypatch):
    names = {"RANGE": "ROS_AUTOMATIC_DISCOVERY_RANGE", "ONLY": "ROS_LOCALHOST_ONLY"}
    # a process can configure each once
    monkeypatch.setattr(dds, "Domain", lambda *_: None)
    monkeypatch.delenv(names["RANGE"])
    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN + 30))
    for key, value in variables.items():
        monkeypatch.setenv(names.get(key, "ROS_DOMAIN_ID"), value)
    try:
        where = topics.join(None, None, "test").where
    except SettingsError as error:
        where = str(error)
    else:
        assert where.startswith(f"DDS domain {DOMAIN + 30} by ")
    assert re.search(expected, where)


IMAGE = cdr.image((3, 4), "skin", forces(0))
ARRAY = cdr.array(forces(0))
CLOUD = cdr.cloud((3, 4), "skin", {"x": forces(1).ravel(), "force": forces(0).ravel()})


@given(st.binary(max_size=200), st.booleans(), st.data())
def test_what_is_written_is_read_and_hostile_bytes_are_refused_or_read(
    data, begins, draw
):
    for whole, kind in ((IMAGE, cdr.IMAGE), (ARRAY, cdr.ARRAY), (CLOUD, cdr.CLOUD)):
        read = MessageReader(Definitions(), kind, Layout()).read_frame
        received = read(whole)
        assert np.array_equal(received.numbers.values.ravel(), forces(0).ravel())
        assert received.time == (None if kind == cdr.ARRAY else 3_000_000_004)
        mutated = bytearray(whole)
        at = draw.draw(st.integers(0, len(whole) - 1))
        mutated[at : at + len(data)] = data
        for one in (
            bytes(mutated),
            data if not begins else IMAGE[:4] + data,
            whole[:at],
        ):
            try:
                numbers = read(one).numbers
            except SourceError:
                continue
            assert numbers.values.size > 0
            assert numbers.values.shape == tuple(axis.size for axis in numbers.axes)
