"""Hostile messages: sound ones, mutated; and the sound ones to follow."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from sparseskin.messages import End, Message, encode
from sparseskin.messages.topics import split_topic
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.node import Node
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.sensor.node import Sensor
from sparseskin.nodes.settings import Settings

SIDE = 8
HOSTILE_RUN = "00000000000000aa"
SOUND_RUN = "00000000000000bb"
MAX_RANDOM_BYTES = 300


class _Endless:
    """Frames of true forces on a small skin, for a sensor."""

    delivers = "truth"

    def __iter__(self) -> Iterator[tuple[int, Any]]:
        stamp_ns = 0
        while True:
            stamp_ns += 1_000_000
            yield stamp_ns, np.linspace(0, 1, SIDE * SIDE, dtype=np.float32).reshape(SIDE, SIDE)


def small_skin() -> _Endless:
    """The driver `sparseskin.studies.fuzz_messages:small_skin`."""
    return _Endless()


class _Tap(Node[Settings]):
    """Keeps all messages of a graph."""

    def __init__(self, settings: Settings, context: Any) -> None:
        super().__init__(settings, context)
        self.kept: list[Message] = []

    @classmethod
    def inputs(cls, settings: Settings) -> tuple[str, ...]:
        return ("*",)

    def step(self, message: Message) -> Iterable[Message]:
        self.kept.append(message)
        return ()


def sound_messages(run_id: str, n_frames: int) -> list[Message]:
    """All that a graph of one small patch sends in some frames, as one publisher's run."""
    bus = Bus(
        {
            "sensor": (Sensor, Sensor.Settings(source=f"{__name__}:small_skin")),
            "compressor": (Compressor, Compressor.Settings()),
            "reconstructor": (Reconstructor, Reconstructor.Settings()),
            "tap": (_Tap, Settings()),
        }
    )
    bus.run(n_frames)
    tap = bus.hosts["tap"].node
    assert isinstance(tap, _Tap)
    return [message.published(run_id, message.seq) for message in tap.kept]


def ends(topics: Iterable[str], run_id: str, n_messages: int) -> list[End]:
    """The end of each topic."""
    return [
        End(
            stamp_ns=1,
            patch=split_topic(topic)[0],
            run_id=run_id,
            of=split_topic(topic)[1],
            n_messages=n_messages,
        )
        for topic in topics
    ]


def hostile_parts(
    topics: Sequence[str], n: int, rng: np.random.Generator
) -> Iterator[tuple[bytes, ...]]:
    """`n` random or mutated messages under the topics that a node listens to."""
    sound = sound_messages(HOSTILE_RUN, 1)
    good = [encode(message) for message in sound if message.topic in topics]
    for _ in range(n):
        topic, payload = good[rng.integers(len(good))]
        match rng.integers(6):
            case 0:
                yield topic, rng.bytes(int(rng.integers(0, MAX_RANDOM_BYTES)))
            case 1:
                yield topic, payload[: rng.integers(len(payload))]
            case 2:
                yield topic, good[rng.integers(len(good))][1] + rng.bytes(int(rng.integers(1, 9)))
            case 3:
                yield (topic, payload, b"one part too many")
            case 4:
                yield topic, good[rng.integers(len(good))][1]  # sound, but perhaps not here
            case _:
                mutated = bytearray(payload)
                for place in rng.integers(len(mutated), size=rng.integers(1, 6)):
                    mutated[place] = rng.integers(256)
                yield topic, bytes(mutated)


def hostile_subscription(rng: np.random.Generator) -> bytes:
    """What a reader can send to a writer: a subscription, an answer that nobody asked for, or
    anything else.
    """
    what = rng.bytes(int(rng.integers(0, MAX_RANDOM_BYTES)))
    return (b"", b"\0", b"\x01", b"\x01@", b"\x01@probe#node:", b"\0@")[rng.integers(6)] + what
