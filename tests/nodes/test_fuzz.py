"""Hostile bytes on the inputs of real node processes: counted, and no node ends.

`SPARSESKIN_FUZZ_MESSAGES` states how many messages each node gets.
"""

from __future__ import annotations

import os

import numpy as np
import pytest

from sparseskin.messages import decode, encode
from sparseskin.studies import fuzz_nodes
from sparseskin.studies.fuzz_messages import (
    HOSTILE_RUN,
    hostile_parts,
    hostile_subscription,
    sound_messages,
)

N_MESSAGES = int(os.environ.get("SPARSESKIN_FUZZ_MESSAGES", "5000"))
GROWTH_MB = 5.0
"""What caches may take after the first tenth; a leak of 1 kB a message would show at once."""


@pytest.mark.parametrize("type_name", fuzz_nodes.TYPES)
def test_hostile_messages_and_subscriptions_end_no_node(type_name: str) -> None:
    found = fuzz_nodes.measure({"type": type_name, "n": N_MESSAGES, "seed": 5})
    assert found["alive"]
    assert sum(found["refused"].values()) > N_MESSAGES / 2
    assert {"truncated", "malformed", "bad field"} <= found["refused"].keys()
    before_mb, after_mb = found["memory_mb"]
    assert after_mb - before_mb < GROWTH_MB
    # It still does its work: the sound frames came in, and out at the other end.
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
        list(hostile_parts(topics, 50, np.random.default_rng(seed))) for seed in (3, 4)
    )
    again = list(hostile_parts(topics, 50, np.random.default_rng(3)))
    # The stamps of sound messages are of the time at which they are made.
    assert [len(parts) for parts in first] == [len(parts) for parts in again]
    assert first != second
    assert hostile_subscription(np.random.default_rng(1)) == hostile_subscription(
        np.random.default_rng(1)
    )
