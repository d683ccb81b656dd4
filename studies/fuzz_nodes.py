"""Hostile messages on the sockets of nodes that run."""

from __future__ import annotations

import shutil
import tempfile
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.nodes.registry import make_settings, node_class

from .fuzz_harness import Harness
from .fuzz_messages import (
    SOUND_RUN,
    ends,
    hostile_parts,
    hostile_subscription,
    sound_messages,
)

TYPES = ("compressor", "reconstructor", "monitor", "recorder")
N_SOUND = 10
SUBSCRIPTIONS = 0.1
"""Hostile subscriptions to what the node writes, as a part of the messages it reads."""


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Send one node hostile messages, then sound ones, and say what came of both.

    Parameters
    ----------
    point : dict
        type: the node's. n: how many hostile messages. seed.

    Returns
    -------
    dict
        refused: counts by reason. memory_mb: after a tenth of the messages, and after all.
        subscribed_mb: after hostile subscriptions over one connection, and as many over another,
        where the node writes something: what the first one took is free for the second.
        received: of the sound frames, the fewest on any topic. published: what the node made of
        them. lines: how many lines it logged. alive: whether it was there at the end.
    """
    rng = np.random.default_rng(point["seed"])
    folder = Path(tempfile.mkdtemp(prefix="sparseskin-fuzz-"))
    name = point["type"]
    sound = sound_messages(SOUND_RUN, N_SOUND)
    try:
        with Harness(name, _values(name, folder), _topics(name, sound)) as harness:
            n_tenth = point["n"] // 10
            harness.write(hostile_parts(harness.topics, n_tenth, rng))
            harness.drained()
            before_mb = harness.memory_mb()
            harness.write(hostile_parts(harness.topics, point["n"] - n_tenth, rng))
            harness.drained()
            after_mb = harness.memory_mb()
            subscribed_mb = []
            for _ in range(2 * bool(harness.node.spec.cls.outputs(harness.node.spec.settings))):
                n_notes = round(SUBSCRIPTIONS * point["n"])
                harness.subscribe(hostile_subscription(rng) for _ in range(n_notes))
                harness.drained()
                subscribed_mb.append(round(harness.memory_mb(), 2))
            harness.send(chain(sound, ends(harness.streams, SOUND_RUN, N_SOUND)))
            counts = harness.event("ended")["counts"]
            alive = harness.node.exit_code() is None
    finally:
        shutil.rmtree(folder)
    return {
        "refused": counts["refused"],
        "memory_mb": [round(before_mb, 2), round(after_mb, 2)],
        "subscribed_mb": subscribed_mb,
        "received": min(counts["received"][topic] for topic in harness.streams),
        "published": sum(counts["published"].values()),
        "alive": alive,
    }


def _values(name: str, folder: Path) -> dict[str, Any]:
    return {"out": str(folder / "fuzz.mcap")} if name == "recorder" else {}


def _topics(name: str, sound: list[Any]) -> list[str]:
    cls = node_class(name)
    topics = cls.inputs(make_settings(cls, {}))
    return list(dict.fromkeys(m.topic for m in sound)) if "*" in topics else list(topics)
