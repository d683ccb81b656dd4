"""A node process whose only writer, and only reader, is hostile."""

from __future__ import annotations

import os
import selectors
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zmq

from sparseskin.launch.launchspec import NodeSpec
from sparseskin.launch.process import NodeProcess
from sparseskin.messages import Message, encode
from sparseskin.nodes.clock import wall_offset_ns
from sparseskin.nodes.host import is_latched
from sparseskin.nodes.registry import make_settings, node_class
from sparseskin.nodes.sockets import Writer, make_context

from .graph_run import wait_until

ANY = "tcp://127.0.0.1:*"


class Harness:
    """A node in a process of its own, joined to this program alone; to be used in a `with`.

    Parameters
    ----------
    type_name : str
        Registered node type.
    values : dict
        Its settings.
    topics : list of str
        Its input topics.

    Attributes
    ----------
    writer : Writer
        What it reads from.
    streams : list of str
        Those of its topics that are no states.
    """

    def __init__(self, type_name: str, values: dict[str, Any], topics: list[str]) -> None:
        self.context = make_context()
        self.writer = Writer(self.context, ANY)
        # With one reader it is safe to wait for it instead of dropping what it has no room for.
        self.writer.socket.setsockopt(zmq.XPUB_NODROP, 1)
        self.topics = topics
        self.streams = [topic for topic in topics if not is_latched(topic)]
        cls = node_class(type_name)
        self.node = NodeProcess(
            NodeSpec(type_name, type_name, cls, values, make_settings(cls, values)),
            {
                "name": type_name,
                "type": type_name,
                "settings": values,
                "endpoint": ANY,
                "readers": [],
                "inputs": topics,
                "offset_ns": wall_offset_ns(),
                "max_frames": None,
            },
        )
        self.events: list[dict[str, Any]] = []
        self._selector = selectors.DefaultSelector()
        self._selector.register(self.node.pipes[0], selectors.EVENT_READ)

    def __enter__(self) -> Self:
        self.event("bound")
        peers = [{"writer": "fuzzer", "endpoint": self.writer.endpoint}]
        self.node.command("connect", peers=peers)
        self.event("ready")

        def present() -> bool:
            self.writer.serve_subscriptions()
            return self.node.name in self.writer.present

        wait_until(present, "the subscription")
        return self

    def __exit__(
        self,
        _type: type[BaseException] | None,
        _error: BaseException | None,
        _traceback: TracebackType | None,
    ) -> None:
        self.node.command("stop")
        self.node.close()
        self._selector.close()
        self.context.destroy(linger=0)

    def event(self, name: str) -> dict[str, Any]:
        """Wait for an event of the node.

        Raises
        ------
        StudyError
            If it does not come.
        """

        def came() -> bool:
            self._selector.select(0.05)
            self.events += self.node.read()[0]
            return any(event["event"] == name for event in self.events)

        wait_until(came, f"the event {name} of the {self.node.name}")
        return next(event for event in self.events if event["event"] == name)

    def write(self, parts: Iterable[tuple[bytes, ...]]) -> None:
        """Publish messages as they stand; what the node says meanwhile is taken in."""
        for k, part in enumerate(parts):
            self.writer.socket.send_multipart(part)
            if k % 1000 == 0:
                self.events += self.node.read()[0]

    def send(self, messages: Iterable[Message]) -> None:
        """Publish messages of its topics."""
        self.write(encode(message) for message in messages if message.topic in self.topics)

    def subscribe(self, notes: Iterable[bytes]) -> None:
        """Send the node what a reader sends, as it stands, over one connection."""
        reader = self.context.socket(zmq.XSUB)
        reader.connect(self.event("bound")["endpoint"])
        for note in notes:
            reader.send(note)
        reader.close(linger=5000)

    def drained(self) -> None:
        """Wait until the node has taken in all that was published."""
        ask = self.writer.ask()

        def answered() -> bool:
            self.writer.serve_subscriptions()
            self.events += self.node.read()[0]
            return not self.writer.awaits(ask)

        wait_until(answered, f"the {self.node.name} to take everything in", 600.0)

    def memory_mb(self) -> float:
        """Resident memory of the node, MB."""
        pages = int(Path(f"/proc/{self.node.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
