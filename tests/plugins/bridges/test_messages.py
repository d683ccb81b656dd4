"""Messages of ROS of any definition: what rosbags writes is read, and hostile ones are refused."""

import numpy as np
import pytest
from damaged import mutated, refusal
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("rosbags", reason="rosbags is not installed")
from drawn_messages import (
    SEPARATOR,
    STREAM_TEXT,
    definitions,
    frames_sent,
    grids,
    message_of,
    registered,
    same,
    stream_store,
    value_of,
)
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.layout.layout import Layout, UnstatedError
from sparseskin.plugins.bridges.frames import MessageReader, choose_field
from sparseskin.plugins.bridges.messages.decoding import Decoder, Message
from sparseskin.plugins.bridges.messages.definitions import Definitions
from sparseskin.plugins.bridges.messages.fields import numbers_at

KIND = "any_msgs/msg/Any"
GIANT = 2**31 - 1


def decoder(kind, text, ros=2):
    known = Definitions(ros)
    known.add(kind, text)
    return Decoder(known, kind)


@pytest.mark.parametrize("ros", [1, 2])
@given(data=st.data(), defined=definitions(), is_little=st.booleans())
def test_messages_of_any_definition_are_decoded_as_they_were_written(
    ros, data, defined, is_little
):
    kind, text = defined
    store = registered(get_typestore(Stores.EMPTY), kind, text)
    value = value_of(data.draw, store, (Nodetype.NAME, kind))
    if ros == 1:
        raw = bytes(store.serialize_ros1(value, kind))
    else:
        raw = bytes(store.serialize_cdr(value, kind, little_endian=is_little))
    read = decoder(kind, text, ros)
    assert same(read.decode(raw), value)
    refusal(lambda: read.decode(mutated(data, raw)), SourceError)
    for stop in range(len(raw)):
        refusal(lambda: read.decode(raw[:stop]), SourceError)  # noqa: B023


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("Any[] more", "nested too deep"),
        ("A a\n" + SEPARATOR + "\nMSG: any_msgs/A\nAny a", "nested too deep"),
        (f"float64[{GIANT}] x", "a list of 2147483647 entries"),
        ("Other x", "any_msgs/msg/Other is not known"),
        ("wstring x", "wstring is not known"),
        ("float32 x; import os", "Any, .msg, cannot be read"),
        ("float32[] 1x", "Any, .msg, cannot be read"),
        ("#" * (1 << 20) + "\n", "1048577 bytes"),
        ("float32 x\n" * 7000, "70000 characters, at most 65536"),
    ],
)
def test_hostile_definitions_are_refused_in_one_line(text, fault):
    line = refusal(lambda: decoder(KIND, text), SourceError)
    assert fault in line


def test_definitions_in_idl_are_read():
    taxel = "module any_msgs { module msg { struct Taxel { float z; int16 x; }; }; };\n"
    include = '// generated\n#include "any_msgs/msg/Taxel.idl"\n'
    text = (
        include
        + "module any_msgs { module msg { struct Any { sequence<any_msgs::msg::Taxel> t; }; }; };"
    )
    whole = f"{SEPARATOR}\nIDL: {KIND}\n{text}\n{SEPARATOR}\nIDL: any_msgs/msg/Taxel\n{taxel}"
    known = Definitions()
    known.add(KIND, whole, "idl")
    raw = (
        b"\0\1\0\0"
        + np.array([1], "<u4").tobytes()
        + np.array([2.5], "<f4").tobytes()
        + b"\7\0"
    )
    assert Decoder(known, KIND).decode(raw)["t"].tolist() == [(2.5, 7)]
    with pytest.raises(SourceError, match=r"\.idl, cannot be read"):
        known.add(KIND, "module {", "idl")


def test_lists_that_multiply_are_refused_before_memory_is_used():
    levels = [f"MSG: any_msgs/L{k}\nL{k + 1}[1000] a\n" for k in range(12)]
    text = SEPARATOR.join(["L0 a\n", *(f"\n{level}" for level in levels)])
    text += f"{SEPARATOR}\nMSG: any_msgs/L12\nuint8 a\n"
    assert "it has 1000 bytes" in refusal(
        lambda: decoder(KIND, text).decode(b"\0\1" + bytes(1002))
    )
    entry = decoder(
        KIND, f"Entry[] entries\n{SEPARATOR}\nMSG: any_msgs/Entry\nstring a\nfloat64 b"
    )
    huge = b"\0\1\0\0" + (2**31).to_bytes(4, "little")
    assert "longer than its message" in refusal(lambda: entry.decode(huge + bytes(50)))


def skins():
    """Two modules of three taxels with two vectors each, and a list of temperatures."""
    taxels = np.zeros(
        3, [("id", "u1"), ("moved", [("x", "f4"), ("z", "f4")]), ("force", "f4", 3)]
    )
    taxels["moved"]["z"] = [1, 2, 3]
    taxels["force"] = np.arange(9).reshape(3, 3)
    modules = [Message("any_msgs/msg/Module") for _ in range(2)]
    for k, module in enumerate(modules):
        module["gain"] = 2.5
        module["taxels"] = taxels.copy()
        module["taxels"]["force"] += 10 * k
    message = Message(KIND)
    message["modules"] = modules
    message["temperatures"] = np.arange(4.0)
    return message


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("temperatures", [0, 1, 2, 3]),
        ("temperatures[]", [0, 1, 2, 3]),
        ("temperatures[2]", [2]),
        ("modules[1].taxels[].force[2]", [12, 15, 18]),
        ("modules[].taxels[].moved.z", [1, 2, 3, 1, 2, 3]),
        ("modules[0].taxels[1].force", [3, 4, 5]),
        ("modules[].gain", [2.5, 2.5]),
    ],
)
def test_a_path_names_axes_and_entries(path, expected):
    numbers = numbers_at(skins(), path)
    assert [axis.size for axis in numbers.axes] == [len(expected)]
    assert numbers.values.tolist() == expected


def test_three_numbers_of_an_entry_are_its_channels():
    numbers = numbers_at(skins(), "modules[0].taxels[].force")
    assert [(axis.size, axis.label) for axis in numbers.axes] == [
        (3, "taxels"),
        (3, "channel"),
    ]


@pytest.mark.parametrize(
    ("path", "fault"),
    [
        ("modules", "state modules[] or modules[0]|a list of messages"),
        ("modules.taxels", "state modules[] or modules[0]"),
        ("modules[2].gain", "its list has 2 entries"),
        (
            "modules[0].taxels[].torque",
            "there is no 'torque'; allowed: id, moved, force",
        ),
        ("gain", "it has modules, temperatures"),
        ("modules[0", "allowed: names and [k] or []"),
        ("temperatures[][]", "is no list"),
    ],
)
def test_a_wrong_path_is_refused_with_what_is_there(path, fault):
    line = refusal(lambda: numbers_at(skins(), path), SourceError)
    assert any(one in line for one in fault.split("|")), line


def test_fields_that_can_be_meant_are_named_and_none_is_chosen():
    with pytest.raises(UnstatedError) as refused:
        choose_field(skins(), Layout(), "a.bag")
    fields = [option["field"] for option in refused.value.options]
    assert "temperatures[]" in fields
    assert "modules[1].taxels[].force[]" in fields
    assert (
        choose_field(skins(), Layout(n_rows=2, n_cols=2), "a.bag") == "temperatures[]"
    )
    assert (
        choose_field(skins(), Layout(field="modules[].gain"), "a.bag")
        == "modules[].gain"
    )


@pytest.mark.parametrize(("channel", "expected"), [("", "Z"), ("y", "Y"), ("2", "Z")])
def test_of_three_axes_beside_each_other_one_is_meant(channel, expected):
    pillars = np.ones(9, [(name, "f4") for name in ("id", "fX", "fY", "fZ", "dZ")])
    message = Message(KIND)
    message["pillars"] = pillars
    with pytest.raises(UnstatedError) as refused:
        choose_field(message, Layout(channel=channel), "a.bag")
    fields = [f"pillars[].f{expected}", "pillars[].dZ"]
    assert list(refused.value.options) == [{"field": field} for field in fields]


def test_times_are_those_of_a_field_of_any_unit():
    known = Definitions()
    known.add(KIND, "float64 time_ms\nbuiltin_interfaces/Time at\nfloat32[] data")
    raw = (
        b"\0\1\0\0"
        + np.array([2.5], "<f8").tobytes()
        + np.array([7, 9, 1, 5], "<u4").tobytes()
    )
    for time, expected in (
        ("", 7_000_000_009),
        ("at", 7_000_000_009),
        ("time_ms", 2.5),
    ):
        reader = MessageReader(known, KIND, Layout(field="data", time=time))
        assert reader.read_frame(raw).time == expected
        assert reader.time_unit == ("ms" if time == "time_ms" else "ns")
    with pytest.raises(SourceError, match=r"time: there is no field 'data\.x'"):
        MessageReader(known, KIND, Layout(field="data", time="data.x")).read_frame(raw)


@pytest.mark.parametrize("ros", [1, 2])
@settings(max_examples=30)
@given(data=st.data(), grid=grids())
def test_a_message_is_read_as_if_it_were_the_only_one(ros, data, grid):
    store = stream_store(ros)
    definitions = Definitions(ros)
    definitions.add("maker_msgs/msg/Stream", STREAM_TEXT)
    encode = store.serialize_ros1 if ros == 1 else store.serialize_cdr
    field = "modules[0].taxels[].z" if grid.kind == "stream" else ""
    field = "z" if grid.kind == "cloud" else field

    def reader(kind):
        return MessageReader(definitions, kind, Layout(field=field))

    readers = {}
    for sent in frames_sent(data.draw, grid):
        kind, message = message_of(store, ros, grid, sent)
        raw = bytearray(encode(message, kind))
        if data.draw(st.booleans()):
            raw[data.draw(st.integers(0, len(raw) - 1))] ^= data.draw(
                st.integers(1, 255)
            )
        results = []
        for each in (readers.setdefault(kind, reader(kind)), reader(kind)):
            text = refusal(
                lambda: results.append(each.read_frame(bytes(raw))),  # noqa: B023
                SourceError,
            )
            results += [text] if text else []
        of_stream, alone = results
        if isinstance(alone, str) or isinstance(of_stream, str):
            assert of_stream == alone
            continue
        np.testing.assert_array_equal(of_stream.numbers.values, alone.numbers.values)
        assert of_stream.numbers.axes == alone.numbers.axes
        assert of_stream[1:] == alone[1:]


def test_names_within_records_are_read_of_each_message():
    known = Definitions(1)
    known.add(
        KIND, f"Taxel[] taxels\n{SEPARATOR}\nMSG: any_msgs/Taxel\nuint32 id\nint32 z"
    )
    reader = MessageReader(known, KIND, Layout(field="taxels[].z"))
    for ids in ([2, 1, 3], [3, 1, 2]):
        pairs = np.array([(each, 10 * each) for each in ids], "<u4")
        numbers = reader.read_frame(b"\3\0\0\0" + pairs.tobytes()).numbers
        assert numbers.axes[0].names == tuple(f"taxel_{each}" for each in ids)
        assert numbers.values.tolist() == [10 * each for each in ids]
