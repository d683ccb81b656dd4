"""A subscription: messages of a running graph in a loop, what was skipped, how it ends."""

import asyncio
import json
import math
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from processes import announced, note_of_graph
from publishing import TOPIC, Publisher

import sparseskin
from sparseskin.messages import Contacts, Reconstruction, Taxels
from sparseskin.nodes.network.sockets import QUEUE_FRAMES

PAGE = Path(__file__).parents[3] / "docs" / "howto" / "control_loop.md"
bursts = st.lists(st.integers(1, QUEUE_FRAMES // 4), min_size=1, max_size=4)
own_publisher = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@own_publisher
@given(sizes=bursts, newest=st.booleans())
def test_each_message_is_taken_or_counted_as_skipped(publisher, sizes, newest):
    with sparseskin.subscribe("skin/taxels", newest=newest, timeout_s=300) as frames:
        assert math.isnan(frames.age_s)
        publisher.wait_for_subscription()
        first = publisher.n
        taken = []
        for size in sizes:
            publisher.send(size)
            while not taken or taken[-1] < publisher.n - 1:
                message = next(frames)
                assert isinstance(message, Taxels)
                assert message.forces.shape == (1, 4, 4)
                assert frames.age_s >= 0
                taken.append(message.seq)
        assert taken == sorted(set(taken))
        assert len(taken) + frames.skipped == publisher.n - taken[0]
        assert frames.lost == frames.unreadable == 0
        if not newest:
            assert taken == list(range(first, publisher.n))
    publisher.wait_for_subscription()  # for its end: the next one is not taken for it


@pytest.mark.parametrize("newest", [False, True])
def test_a_loop_ends_with_the_stream_and_counts_to_its_end(publisher, newest):
    def publish():
        publisher.wait_for_subscription()
        publisher.send(20)
        publisher.end()

    with ThreadPoolExecutor(1) as pool:
        frames = sparseskin.subscribe(TOPIC, newest=newest)
        published = pool.submit(publish)
        seqs = [message.seq for message in frames]
        published.result()
    assert len(seqs) + frames.skipped == 20 - (seqs[0] if seqs else 20 - frames.skipped)
    assert newest or seqs == list(range(20))
    assert next(frames, None) is None


def test_a_loop_ends_with_its_graph(tmp_path, monkeypatch):
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path))
    gone = Publisher()
    with announced(gone.graph):
        frames = sparseskin.subscribe(TOPIC)
    assert list(frames) == []
    gone.context.destroy(linger=0)


def test_a_wait_can_be_limited_and_goes_on_afterwards(publisher):
    with sparseskin.subscribe(TOPIC, timeout_s=0) as frames:
        publisher.wait_for_subscription()
        with pytest.raises(
            TimeoutError, match=r"^/skin/taxels: no message within 0 s$"
        ):
            next(frames)
        publisher.send(1)
        message = None
        while message is None:
            try:
                message = next(frames)
            except TimeoutError:
                continue
        assert message.seq == 0


def test_malformed_messages_are_counted_and_left_out(publisher):
    with sparseskin.subscribe(TOPIC) as frames:
        publisher.wait_for_subscription()
        body = b"\x84\xa6schema\xa1x\xa6run_id\xa0\xa3seq\x00\xa8stamp_ns\x00"
        for payload in (b"", b"nonsense", body):
            publisher.writer.socket.send(TOPIC.encode() + b"\0" + payload)
        publisher.send(1)
        assert next(frames).seq == 0
        assert frames.unreadable == 3


def test_an_event_loop_runs_beside_and_ends_with_the_stream(publisher):
    ticks = []

    async def tick():
        while True:
            ticks.append(len(ticks))
            await asyncio.sleep(0)

    async def read():
        found = []
        other = asyncio.create_task(tick())
        async with sparseskin.subscribe(TOPIC) as frames:
            publish = asyncio.create_task(asyncio.to_thread(send))
            async for message in frames:
                found.append(message.seq)
            await publish
        other.cancel()
        return found

    def send():
        publisher.wait_for_subscription()
        publisher.send(30)
        publisher.end()

    assert asyncio.run(read()) == list(range(30))
    assert len(ticks) > 30


def test_a_wait_of_an_event_loop_can_be_limited(publisher):
    async def read():
        async with sparseskin.subscribe(TOPIC, timeout_s=0.001) as frames:
            await anext(frames)

    with pytest.raises(TimeoutError, match=r"within 0.001 s"):
        asyncio.run(read())


@given(
    topic=st.integers() | st.none(),
    timeout_s=st.floats(max_value=-1e-9) | st.just(math.nan) | st.text(max_size=3),
)
def test_arguments_that_are_not_allowed_are_named(topic, timeout_s):
    with pytest.raises(
        sparseskin.SparseskinError, match=r"^subscribe: topic = .*allowed: a text"
    ):
        sparseskin.subscribe(topic)
    with pytest.raises(
        sparseskin.SparseskinError, match=r"^subscribe: timeout_s = .*; allowed: 0"
    ):
        sparseskin.subscribe(TOPIC, timeout_s=timeout_s)


def test_it_states_which_graphs_and_topics_there_are(publisher):
    def refused(*arguments, **options):
        with pytest.raises(sparseskin.SparseskinError) as error:
            sparseskin.subscribe(*arguments, **options)
        return str(error.value)

    label = publisher.graph.label
    with announced(replace(publisher.graph, name="other", pid=2)):
        several = f"several graphs run; choose one with graph: {label}, other-2"
        assert refused(TOPIC) == several
        assert sparseskin.subscribe(TOPIC, graph="graph").graph == label
        hint = f"did you mean '{label}'?"
        assert (
            refused(TOPIC, graph="grap-1")
            == f"graph grap-1: no such graph runs ({hint})"
        )


def test_without_a_graph_it_states_how_to_start_one(tmp_path, monkeypatch):
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path))
    with pytest.raises(
        sparseskin.SparseskinError, match=r"^no graph runs on this host"
    ):
        sparseskin.subscribe(TOPIC)


@pytest.mark.slow
def test_forces_and_contacts_of_a_graph_in_a_loop(start, monkeypatch):
    arguments = ("path_40", "--set", "monitor.page=false", "--set", "sensor.first=1000")
    graph = start("launch", *arguments, "--set", "reconstructor.contacts=true")
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(graph.notes))
    label = json.loads(note_of_graph(graph.notes).read_text())["name"]
    with pytest.raises(
        sparseskin.SparseskinError, match=r"no such topic.*/skin/contacts"
    ):
        sparseskin.subscribe("/skin/contact", graph=label)
    with (
        sparseskin.subscribe("/skin/contacts", newest=True) as contacts,
        sparseskin.subscribe("/skin/reconstruction", graph=label) as frames,
    ):
        message = next(contacts)
        while not message.id.size:
            message = next(contacts)
        forces = next(frames)
    assert isinstance(message, Contacts)
    assert message.total.dtype == np.float32
    assert isinstance(forces, Reconstruction)
    assert forces.forces.shape == (1, 40, 40)
    assert contacts.lost == frames.skipped == 0
    n_calls = 0

    class DoneError(Exception):
        pass

    def called(*_):
        nonlocal n_calls
        n_calls += 1
        if n_calls == 20:
            raise DoneError

    (block,) = re.findall(
        r"^```py\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL
    )
    with pytest.raises(DoneError):
        exec(compile(block, PAGE.name, "exec"), {"hold": called, "act": called})
