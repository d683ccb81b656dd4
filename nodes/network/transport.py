"""Interface of a transport, which carries messages from writers to readers.

There are two: ZeroMQ (`zeromq`), which reaches observers and other hosts, and a direct link, one
stream socket from node to node of a host (`direct`). A subscription is the same note on both:
b"\\x01" and a topic, or b"\\x00" and a topic for its end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

Parts = Sequence[Any]
"""Topic, head and arrays of a message, as `messages.wire.wire_parts` returns them."""
Send = Callable[[Parts], None]
JOINS, LEAVES = b"\x01", b"\x00"
PRESENCE = b"@"
"""Begins the topics by which writers and readers know each other."""


class Outlet(Protocol):
    """Sending side of a transport."""

    def wants(self, topic: bytes) -> bool:
        """True if a reader has subscribed to a topic."""

    def send(self, parts: Parts, frame: bool = False) -> None:
        """Send a message to the subscribers of its topic, without waiting. What a slow one does not
        take waits for it, up to a bound; beyond it messages are dropped, frames first.
        """

    def note(self) -> tuple[bytes, Send] | None:
        """Next waiting subscription, and how to send to its reader; None if none waits."""


class Inlet(Protocol):
    """Receiving side of a transport."""

    def subscribe(self, topic: bytes) -> None:
        """Subscribe to a topic of all writers, connected or not."""

    def unsubscribe(self, topic: bytes) -> None:
        """End a subscription."""

    def receive(self) -> Sequence[bytes] | None:
        """Parts of the next waiting message; None if none waits."""
