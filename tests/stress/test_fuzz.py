"""Hostile bytes on the inputs of nodes: counted, and no node ends.

At full size 200,000 messages to each node; `SPARSESKIN_FUZZ_MESSAGES` states another number.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stress import messages as fuzz_nodes
from stress.messages import (
    HOSTILE_RUN,
    SOUND_RUN,
    ends,
    hostile_messages,
    hostile_subscription,
    sound_messages,
)

from sparseskin.messages import decode, encode
from sparseskin.messages.wire import received
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.host import NodeHost
from sparseskin.nodes.node import Context
from sparseskin.nodes.registry import make_settings, node_class, node_types

N_MESSAGES = int(os.environ.get("SPARSESKIN_FUZZ_MESSAGES", "2000"))
GROWTH_BYTES = 500
"""Bound on the growth of memory, bytes a message."""


def host_of(type_name: str, tmp_path: Path, lines: list[str]) -> NodeHost:
    """A node as its process makes it, without process and sockets."""
    values = fuzz_nodes.settings_of(type_name, tmp_path)
    cls = node_class(type_name)
    context = Context(type_name, ManualClock(), lines.append)
    topics = fuzz_nodes.topics_of(type_name, sound_messages(SOUND_RUN, 1))
    return NodeHost(cls(make_settings(cls, values), context), SOUND_RUN, lines.append, topics)


@pytest.mark.parametrize("type_name", fuzz_nodes.TYPES)
def test_hostile_messages_end_no_node(type_name: str, tmp_path: Path) -> None:
    lines: list[str] = []
    host = host_of(type_name, tmp_path, lines)
    list(host.start())
    rng = np.random.default_rng(5)
    for buffer in hostile_messages(host.inputs, N_MESSAGES, rng):
        # As `Reader.receive` does.
        list(host.receive_bytes(*received(buffer)))
        host.idle()
    refused = host.counts.refused
    assert sum(refused.values()) > N_MESSAGES / 2
    assert {"truncated", "malformed", "bad field"} <= refused.keys()
    assert not host.failure
    # Each reason is logged the 1st, 10th, 100th ... time only.
    assert len(lines) <= 10 + sum(len(str(n)) for n in refused.values())
    # It still does its work: the sound frames are received, and results published.
    sound = sound_messages(SOUND_RUN, fuzz_nodes.N_SOUND)
    for message in (*sound, *ends(host.streams, SOUND_RUN, fuzz_nodes.N_SOUND)):
        if message.topic in host.inputs:
            list(host.receive_bytes(*encode(message)))
    assert min(host.counts.inputs[t].received for t in host.streams) >= fuzz_nodes.N_SOUND
    if type_name in ("compressor", "reconstructor"):
        assert sum(host.counts.published.values()) > fuzz_nodes.N_SOUND
        assert host.finished
    host.close()


def test_settings_of_any_value_are_accepted_or_refused() -> None:
    rng = np.random.default_rng(5)
    values: list[Any] = [None, True, -1, 1e400, 10**400, float("nan"), "", "x" * 5000, [], {}]
    for type_name in node_types():
        cls = node_class(type_name)
        for setting in cls.Settings.described():
            for value in (*values, rng.bytes(8).hex()):
                with contextlib.suppress(SparseskinError):
                    make_settings(cls, {setting["key"]: value})


@pytest.mark.slow  # real processes, tens of thousands of messages each
@pytest.mark.parametrize("type_name", fuzz_nodes.TYPES)
def test_hostile_messages_and_subscriptions_end_no_process(
    type_name: str, full: bool, note: Any
) -> None:
    n_messages = max(N_MESSAGES, 200_000 if full else 30_000)
    found = fuzz_nodes.measure({"type": type_name, "n": n_messages, "seed": 5})
    note(node=type_name, messages=n_messages, **found)
    assert found["alive"]
    assert sum(found["refused"].values()) > n_messages / 2
    # A leak grows in each tenth of the messages. A late import, a cache that fills, and memory
    # that is returned to the system change some of them only, so that the median is without them.
    growths_mb = np.diff(found["memory_mb"])
    assert len(growths_mb) == fuzz_nodes.N_PARTS - 1
    assert 1e6 * np.median(growths_mb) < GROWTH_BYTES * n_messages / fuzz_nodes.N_PARTS
    assert found["received"] >= fuzz_nodes.N_SOUND
    if type_name in ("compressor", "reconstructor"):
        assert found["published"] > fuzz_nodes.N_SOUND


def test_the_messages_that_are_mutated_are_sound_and_of_every_kind() -> None:
    messages = sound_messages(HOSTILE_RUN, 2)
    schemas = {"skin", "phi", "solver", "taxels", "truth", "measurements", "reconstruction"}
    assert {message.schema for message in messages} == schemas
    for message in messages:
        topic, payload = encode(message)
        assert decode(topic, payload).run_id == HOSTILE_RUN


def test_one_seed_gives_the_same_hostile_messages() -> None:
    topics = ["/skin/taxels", "/skin/skin"]
    first, second = (
        list(hostile_messages(topics, 50, np.random.default_rng(seed))) for seed in (3, 4)
    )
    again = list(hostile_messages(topics, 50, np.random.default_rng(3)))
    # The stamps of sound messages are of the time at which they are made.
    assert [len(buffer) for buffer in first] == [len(buffer) for buffer in again]
    assert first != second
    assert hostile_subscription(np.random.default_rng(1)) == hostile_subscription(
        np.random.default_rng(1)
    )
