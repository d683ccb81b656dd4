"""The reader in C++, examples/cpp/sparseskin.hpp, against the messages of Python."""

import json
import math
import shutil
import subprocess
import uuid
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from message_strategies import contacts, forces, made, several, with_sd
from processes import note_of_graph, wait_until

from sparseskin.launch.commands.cli import main
from sparseskin.messages import Contacts, End, Reconstruction
from sparseskin.messages.wire import wire_bytes
from sparseskin.nodes.network.sockets import Writer, make_context
from sparseskin.nodes.reconstructor.contact_tracks import NOTHING

HERE = Path(__file__).parent
HEADER = HERE.parents[2] / "examples" / "cpp"
CHECKED = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
STRICT = (
    "-std=c++17",
    "-O1",
    "-Wall",
    "-Wextra",
    "-Wpedantic",
    "-Werror",
    f"-I{HEADER}",
)
RUN_ID = "0123456789abcdef"


def lack():
    """Why the header cannot be compiled here; "" if it can."""
    if shutil.which("g++") is None:
        return "g++ is not installed"
    words = ["g++", "-E", "-x", "c++", "-"]
    text = b"#include <zmq.h>\n"
    done = subprocess.run(words, input=text, capture_output=True, check=False)
    return "zmq.h is not installed (Debian: libzmq3-dev)" if done.returncode else ""


pytestmark = [
    pytest.mark.skipif(bool(lack()), reason=lack() or "compiled"),
    pytest.mark.slow,
]


def compiled(source, folder, *options):
    program = folder / source.stem
    words = ["g++", *STRICT, *options, str(source), "-o", str(program), "-lzmq"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return program


@pytest.fixture(scope="module")
def dump(tmp_path_factory):
    return compiled(HERE / "cpp" / "dump.cpp", tmp_path_factory.mktemp("cpp"), *CHECKED)


LAST_NS = 2**62
"""Stamp of a message after which the lines of those before it are there."""


def sentinel(schema):
    head = {"stamp_ns": LAST_NS, "patch": "skin", "done_ns": 0}
    if schema == Contacts.schema:
        return Contacts(**head, **NOTHING)
    frame = {"forces": np.zeros((1, 1), np.float32), "phi": "0" * 16}
    return Reconstruction(**head, **frame, iterations=1, residual=0.0, solve_ns=1)


class Reading:
    """A program that reads what a writer sends."""

    def __init__(self, writer, process, schema):
        self._writer = writer
        self._process = process
        self._schema = schema
        self._last = wire_bytes(sentinel(schema))

    def exchange(self, buffers):
        """Send buffers; the messages that the program reads in them."""
        for buffer in (*buffers, self._last):
            self.send(buffer)
        read = []
        while True:
            line = self._process.stdout.readline()
            assert line, self._process.stderr.read()
            read.append(json.loads(line))
            if read[-1]["stamp_ns"] == LAST_NS:
                return read[:-1]

    def send(self, buffer):
        self._writer.socket.send(buffer)

    def finish(self, n_sent):
        """End the stream: the messages that are left, and what was missed."""
        end = End(stamp_ns=1, patch="skin", of=self._schema, n_messages=n_sent)
        self.send(wire_bytes(end.published(RUN_ID, n_sent)))
        stdout, stderr = self._process.communicate()
        assert stderr == ""
        assert self._process.returncode == 0
        *read, missed = map(json.loads, stdout.splitlines())
        return read, missed


@contextmanager
def reading(program, schema, how="all"):
    context = make_context()
    writer = Writer(context, f"ipc://@sparseskin-{uuid.uuid4().hex}")
    words = [program, writer.endpoint, f"/skin/{schema}", how]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(words, text=True, **pipes) as process:
        try:
            wait_until(lambda: bool(writer.socket.poll(0)), "the subscription")
            writer.serve_subscriptions()
            yield Reading(writer, process, schema)
        finally:
            process.kill()
    context.destroy(linger=0)


@pytest.fixture(scope="module")
def readings(dump):
    """A program for each schema that is read."""
    with (
        reading(dump, Reconstruction.schema) as frames,
        reading(dump, Contacts.schema) as contacts,
    ):
        found = {Reconstruction.schema: frames, Contacts.schema: contacts}
        yield found
        for each in found.values():
            assert each.finish(0)[0] == []


def plain(value):
    """Numbers of an array as JSON has them, one after the other; NaN: None."""
    found = np.asarray(value, dtype=np.float64).ravel().tolist()
    return [None if math.isnan(number) else number for number in found]


def head(message):
    fields = {
        key: getattr(message, key) for key in ("stamp_ns", "patch", "run_id", "seq")
    }
    return {**fields, "patches": list(message.patches), "done_ns": message.done_ns}


def as_reconstruction(message):
    keys = (
        "iterations",
        "residual",
        "solve_ns",
        "error",
        "trusted",
        "unchanged",
        "reason",
    )
    return {
        **head(message),
        "shape": list(message.forces.shape),
        "forces": plain(message.forces),
        "sd": [] if message.sd is None else plain(message.sd),
        "phi": message.phi,
        "skipped": message.skipped,
        "quiet": message.quiet,
        **{key: list(getattr(message, key)) for key in keys},
    }


def as_contacts(message):
    rows = []
    for k in range(message.id.size):
        totals = message.total[k], message.total_sd[k], message.peak[k]
        row = {
            "id": int(message.id[k]),
            "total": plain(totals),
            "area": int(message.area[k]),
        }
        row["patch"] = 0 if message.patch_of is None else int(message.patch_of[k])
        for name in ("centre", "centre_sd", "velocity"):
            row[name] = plain(getattr(message, name)[k])
        for name in ("place_mm", "place_sd_mm", "velocity_mm_s", "normal"):
            known = getattr(message, name)
            row[name] = [None] * 3 if known is None else plain(known[k])
        (row["age_s"],) = plain(message.age_s[k])
        row["area_mm2"] = (
            None if message.area_mm2 is None else float(message.area_mm2[k])
        )
        row |= {name: bool(getattr(message, name)[k]) for name in ("over", "sliding")}
        rows.append(row)
    events = [] if message.events is None else message.events.tolist()
    return {
        **head(message),
        "trusted": list(message.trusted),
        "contacts": rows,
        "events": events,
    }


frames = st.one_of(
    made(Reconstruction, forces=forces(2)),
    with_sd(),
    several().filter(lambda message: isinstance(message, Reconstruction)),
)
streams = st.one_of(
    st.lists(frames, min_size=1, max_size=8),
    st.lists(contacts(), min_size=1, max_size=8),
)


def numbered(messages):
    """Messages of one topic, as they are published."""
    return [
        replace(message, patch="skin").published(RUN_ID, k)
        for k, message in enumerate(messages)
    ]


@given(stream=streams)
def test_it_reads_what_was_sent(readings, stream):
    messages = numbered(stream)
    schema = messages[0].schema
    expected = as_contacts if schema == Contacts.schema else as_reconstruction
    read = readings[schema].exchange(map(wire_bytes, messages))
    assert read == [expected(message) for message in messages]


@given(stream=streams, data=st.data())
def test_hostile_bytes_are_left_out_and_nothing_beyond_a_message_is_read(
    readings, stream, data
):
    messages = numbered(stream)
    n_topic = len(messages[0].topic) + 1
    buffers = []
    for message in messages:
        buffer = bytearray(wire_bytes(message))
        for _ in range(data.draw(st.integers(0, 6))):
            place = data.draw(st.integers(n_topic, len(buffer) - 1))
            buffer[place] = data.draw(st.integers(0, 255))
        cut = data.draw(st.integers(n_topic, len(buffer)) | st.just(len(buffer)))
        buffers.append(bytes(buffer[:cut]))
    read = readings[messages[0].schema].exchange(buffers)
    assert len(read) <= len(messages)


@pytest.mark.parametrize("how", ["all", "newest"])
def test_messages_that_were_not_read_are_counted(dump, how):
    schema = Contacts.schema
    n = 300
    sent = [k for k in range(n) if how == "newest" or k % 7]
    with reading(dump, schema, how) as program:
        for k in sent:
            program.send(wire_bytes(sentinel(schema).published(RUN_ID, k)))
        read, missed = program.finish(n)
    seqs = [each["seq"] for each in read]
    assert how == "newest" or seqs == sent
    assert seqs == sorted(set(seqs))
    n_missed = n - seqs[0] - len(seqs) if seqs else 0
    assert missed == {"missed": n_missed, "unreadable": 0, "why": ""}


def test_a_message_of_another_version_is_refused_by_name(dump):
    schema = Contacts.schema
    buffer = wire_bytes(sentinel(schema)).replace(
        b"\xa7version\x02", b"\xa7version\x03"
    )
    with reading(dump, schema) as program:
        program.send(buffer)
        read, missed = program.finish(0)
    why = "contacts: version 3; this reader knows 2"
    assert read == []
    assert missed == {"missed": 0, "unreadable": 1, "why": why}


def test_the_example_prints_the_contacts_of_a_graph(
    start, tmp_path, monkeypatch, capsys
):
    program = compiled(HEADER / "contacts.cpp", tmp_path)
    settings = (
        "reconstructor.contacts=true",
        "monitor.page=false",
        "sensor.first=1000",
    )
    sets = [word for setting in settings for word in ("--set", setting)]
    graph = start("launch", "path_40", *sets)
    note_of_graph(graph.notes)
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(graph.notes))
    assert main(["topic", "info", "/skin/contacts", "--json"]) == 0
    info = json.loads(capsys.readouterr().out)
    words = [program, info["address"], str(info["clock_offset_ns"])]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        line = ""
        while not line.startswith(("contact ", "not trusted")):
            line = process.stdout.readline()
            assert line
        process.kill()


def test_without_an_address_it_states_its_usage(tmp_path):
    program = compiled(HEADER / "contacts.cpp", tmp_path)
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.endswith("ADDRESS OFFSET_NS\n")
    refused = subprocess.run(
        [program, "nowhere", "0"], capture_output=True, text=True, check=False
    )
    assert refused.returncode == 1
    assert refused.stderr == "nowhere: Invalid argument\n"
