"""Feeds with made-up frames for tests, a clock for them, and what a page reads of their streams."""

import contextlib
import json
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bags import frame, skin_state

from sparseskin.messages import Message, SkinState
from sparseskin.nodes.monitor.live import feed as feed_module
from sparseskin.nodes.monitor.live import screen as screen_module
from sparseskin.nodes.monitor.live import stream as stream_module
from sparseskin.nodes.monitor.live.feed import Feed
from sparseskin.nodes.monitor.live.notices import Notices
from sparseskin.nodes.monitor.live.server import PageServer
from sparseskin.nodes.monitor.metrics import PatchMetrics

BEGIN_S = 1000.0


class FakeTime:
    """Stands in for the module `time` in what a monitor shows; moves only when told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = BEGIN_S
        for module in (feed_module, stream_module, screen_module):
            monkeypatch.setattr(module, "time", self)

    def monotonic(self) -> float:
        return self.now_s

    def advance(self, seconds: float) -> float:
        self.now_s += seconds
        return self.now_s


class Graph:
    """A feed, and the frames of its patches as a monitor takes them in."""

    def __init__(self, *patches: str) -> None:
        self.feed = Feed(patches or ("skin",))
        self.metrics = {patch: PatchMetrics() for patch in self.feed.patches}
        self.n = dict.fromkeys(self.feed.patches, 0)

    def take(self, message: Message) -> None:
        metrics = self.metrics[message.patch]
        self.feed.frame(
            message.patch, message, metrics.add(message), metrics.latency_ns
        )

    def skin(self, patch: str = "skin", **changes: Any) -> SkinState:
        state = skin_state(patch, **changes)
        self.take(state)
        return state

    def frame(
        self, patch: str = "skin", upto: int = 4, **estimate: Any
    ) -> list[Message]:
        """The next frame, or the first messages of it; `estimate`: error and trusted."""
        k = self.n[patch]
        self.n[patch] += 1
        messages = [
            message.published("0" * 16, k) for message in frame(k, patch)[:upto]
        ]
        if estimate:
            messages[-1] = replace(messages[-1], **estimate)
        for message in messages:
            self.take(message)
        return messages

    def summarise(self) -> None:
        summaries = {
            patch: metrics.summary() for patch, metrics in self.metrics.items()
        }
        self.feed.update(summaries=summaries)

    def answer(self, number: object = "") -> None:
        self.feed.update(answer={"id": number})

    def close(self) -> None:
        self.feed.update(closed=True)


@contextlib.contextmanager
def served(graph: Graph, page: Any) -> Iterator[None]:
    """The live page of a feed, opened in a browser."""
    server = PageServer(graph.feed, Notices(graph.feed), 0, lambda request: None)
    with contextlib.closing(server):
        # an address that differs in its hash alone loads no page
        page.get("about:blank")
        page.get(server.url)
        yield


def node_state(name: str, **changes: Any) -> dict[str, Any]:
    """One node of a graph's state, as the launcher tells it."""
    return {
        "name": name,
        "condition": "running",
        "restarts": 0,
        "refused": 0,
        "refusal": "",
        "said": "",
        "compiled": None,
        "state": {},
        "commands": {},
    } | changes


def graph_state(*nodes: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return {"name": "a_graph", "recording": None, "nodes": list(nodes)} | changes


Record = tuple[dict[str, Any], dict[str, np.ndarray[Any, Any]]]


def read_records(read: Callable[[int], bytes]) -> Iterator[Record]:
    """(header, arrays) of each record of `read`, by the description of the stream alone."""
    while counts := read(8):
        n_head, n_data = struct.unpack("<II", counts)
        header = json.loads(read(n_head))
        data, arrays = read(n_data), {}
        for name, dtype, shape in header.pop("arrays"):
            n_bytes = np.dtype(dtype).itemsize * int(np.prod(shape, dtype=np.int64))
            piece, data = data[:n_bytes], data[n_bytes:]
            assert len(piece) == n_bytes
            arrays[name] = np.frombuffer(piece, dtype).reshape(shape)
        assert data == b""
        yield header, arrays
