"""Hostile bytes on the inputs of real node processes: counted, and no node ends."""

from __future__ import annotations

import selectors
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import zmq
from conftest import wait_until

from sparseskin.launch.launchspec import NodeSpec
from sparseskin.launch.process import NodeProcess
from sparseskin.messages import (
    End,
    Measurements,
    Message,
    PhiState,
    Reconstruction,
    SkinState,
    Taxels,
    Truth,
    encode,
)
from sparseskin.nodes.clock import wall_offset_ns
from sparseskin.nodes.compressor.phi import make_phi
from sparseskin.nodes.host import is_latched
from sparseskin.nodes.registry import make_settings, node_class
from sparseskin.nodes.sockets import Writer, make_context

N_STRINGS = 10_000
SIDE = 8
PHI = make_phi("sbhe", n=SIDE * SIDE, m=20, seed=0)


def frame_messages(run_id: str, n_frames: int) -> list[Message]:
    """What a whole graph of one patch sends in n_frames frames."""
    head = {"patch": "skin", "run_id": run_id}
    forces = np.linspace(0, 1, SIDE * SIDE, dtype=np.float32).reshape(SIDE, SIDE)
    messages: list[Message] = [
        SkinState(
            **head,
            stamp_ns=0,
            n_rows=SIDE,
            n_cols=SIDE,
            f_max=2.5,
            unit="N",
            pitch_m=0.005,
            mask=None,
            source="fuzz",
            seed=0,
            rate_hz=100.0,
            has_truth=True,
            sigma_mid=0.06,
            sigma_end=0.01,
        ),
        PhiState(
            **head,
            stamp_ns=0,
            kind="sbhe",
            n=PHI.n,
            m=PHI.m,
            block=32,
            seed=0,
            fingerprint=PHI.fingerprint,
        ),
    ]
    for seq in range(n_frames):
        origin: dict[str, Any] = {**head, "seq": seq, "stamp_ns": 1000 + seq}
        y = PHI.forward(forces.reshape(-1))
        messages += [
            Taxels(**origin, forces=forces),
            Truth(**origin, forces=forces),
            Measurements(**origin, y=y, phi=PHI.fingerprint),
            Reconstruction(
                **origin,
                forces=forces,
                phi=PHI.fingerprint,
                iterations=1,
                residual=0.0,
                solve_ns=10,
                done_ns=2000 + seq,
            ),
        ]
    return messages


def hostile_parts(topics: list[str], rng: np.random.Generator) -> Iterator[tuple[bytes, ...]]:
    """Random and mutated messages, under the topics that a node listens to."""
    messages = frame_messages("00000000000000aa", 1)
    good = [encode(message) for message in messages if message.topic in topics]
    for _ in range(N_STRINGS):
        topic, payload = good[rng.integers(len(good))]
        match rng.integers(5):
            case 0:
                yield topic, rng.bytes(int(rng.integers(0, 300)))
            case 1:
                yield topic, payload[: rng.integers(len(payload))]
            case 2:
                yield topic, good[rng.integers(len(good))][1] + rng.bytes(int(rng.integers(1, 9)))
            case 3:
                yield (topic, payload, b"one part too many")
            case _:
                mutated = bytearray(payload)
                for place in rng.integers(len(mutated), size=rng.integers(1, 6)):
                    mutated[place] = rng.integers(256)
                yield topic, bytes(mutated)


class Harness:
    """A node process whose only writer is the test."""

    def __init__(self, type_name: str) -> None:
        self.context = make_context()
        self.writer = Writer(self.context, "tcp://127.0.0.1:*")
        # With one reader it is safe to wait for it instead of dropping what it has no room for.
        self.writer.socket.setsockopt(zmq.XPUB_NODROP, 1)
        cls = node_class(type_name)
        settings = make_settings(cls, {})
        self.topics = list(cls.inputs(settings))
        self.streams = [topic for topic in self.topics if not is_latched(topic)]
        self.node = NodeProcess(
            NodeSpec(type_name, type_name, cls, {}, settings),
            {
                "name": type_name,
                "type": type_name,
                "settings": {},
                "endpoint": "tcp://127.0.0.1:*",
                "readers": [],
                "inputs": self.topics,
                "offset_ns": wall_offset_ns(),
                "max_frames": None,
            },
        )
        self.events: list[dict[str, Any]] = []
        self.selector = selectors.DefaultSelector()
        self.selector.register(self.node.pipes[0], selectors.EVENT_READ)

    def event(self, name: str) -> dict[str, Any]:
        """Wait for an event of the node."""

        def came() -> bool:
            self.selector.select(0.05)
            self.events += self.node.read()[0]
            return any(event["event"] == name for event in self.events)

        wait_until(came, f"the event {name}")
        return next(event for event in self.events if event["event"] == name)

    def join(self) -> None:
        self.event("bound")
        self.node.command("connect", endpoints=[self.writer.endpoint])
        self.event("ready")

        def present() -> bool:
            self.writer.serve_subscriptions()
            return self.node.name in self.writer.present

        wait_until(present, "the subscription")

    def close(self) -> None:
        self.node.command("stop")
        wait_until(lambda: self.node.exit_code() is not None, "the end")
        self.node.close()
        self.selector.close()
        self.context.destroy(linger=0)


@pytest.fixture
def harness() -> Iterator[Callable[[str], Harness]]:
    made: list[Harness] = []

    def make(type_name: str) -> Harness:
        made.append(Harness(type_name))
        made[-1].join()
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.mark.parametrize("type_name", ["compressor", "reconstructor", "monitor"])
def test_ten_thousand_hostile_strings_end_no_node(
    harness: Callable[[str], Harness], type_name: str
) -> None:
    under_test = harness(type_name)
    for parts in hostile_parts(under_test.topics, np.random.default_rng(5)):
        under_test.writer.socket.send_multipart(parts)
    for message in frame_messages("00000000000000bb", 10):
        under_test.writer.send(message)
    for topic in under_test.streams:
        schema = topic.rsplit("/", 1)[1]
        under_test.writer.send(
            End(stamp_ns=9999, patch="skin", run_id="0" * 14 + "bb", of=schema, n_messages=10)
        )
    counts = under_test.event("ended")["counts"]
    assert sum(counts["refused"].values()) > N_STRINGS / 2
    assert {"truncated", "malformed"} <= counts["refused"].keys()
    # It still does its work: the ten sound frames came out at the other end.
    if type_name == "compressor":
        assert counts["published"]["/skin/measurements"] >= 10
    elif type_name == "reconstructor":
        assert counts["published"]["/skin/reconstruction"] >= 10
    assert all(counts["received"][topic] >= 10 for topic in under_test.streams)
