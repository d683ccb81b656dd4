"""Frames from a topic of ROS 2: the source ros2:/TOPIC?domain=0&interface=lo."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SourceError, SparseskinError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.sensor.driver import RESTART_NS, DriverSource
from sparseskin.nodes.sensor.source import Address
from sparseskin.nodes.settings import Settings, setting
from sparseskin.plugins.boards.settings import split_source, typed

from . import cdr, topics
from .frames import read_frame

WAIT_S = 0.1
HISTORY = 1000
"""Samples that wait for a sensor that is behind: one second at 1 kHz."""
BATCH = 256
KINDS = (cdr.IMAGE, cdr.ARRAY)
"""Types of messages that are frames."""


@dataclass(frozen=True)
class Ros2Query(Settings):
    """How a topic is reached: the keys of a source."""

    domain: int | None = setting(None, "DDS domain, as of the bridge", low=0, high=232)
    interface: str | None = setting(None, "network interface, as of the bridge")
    timeout_s: float = setting(10.0, "longest wait for a message, seconds", low=0, high=86400)


def parse(source: str) -> tuple[str, Ros2Query]:
    """Topic and query of a source. Raises SourceError if it is not ros2:/TOPIC?KEY=VALUE&..."""
    _, topic, query = split_source(source)
    if not topic.startswith("/") or len(topic) < 2:
        raise SourceError(f"{source}: a topic of ROS 2 begins with /, as ros2:/tactile/image")
    try:
        return topic, Ros2Query(**typed(Ros2Query, query))
    except SparseskinError as error:
        raise SourceError(f"{source}: {error}") from error


class Ros2Address(Address):
    """The address of a topic of ROS 2, whose messages are frames."""

    delivers = "taxels"
    form = "ros2:/TOPIC"

    def check(self) -> None:
        parse(self.source)
        topics.check(f"source {self.source}", SourceError)

    def open(self) -> DriverSource:
        self.check()
        return DriverSource(self, frames(self.source))


def frames(source: str) -> Iterator[tuple[int, npt.NDArray[np.generic]]]:
    """Yield (stamp_ns, forces) of each message: the stamp of its header, or of its arrival where it
    has none, or 0.

    Messages that are malformed, or less than 1 s older than the last one, are dropped and counted
    in the log, as are those that were lost on the way. Raises SourceError if nothing is published
    there, or nothing comes for `timeout_s`.
    """
    topic, query = parse(source)
    with closing(topics.join(query.domain, query.interface, "source")) as member:
        print(f"{source}: {member.where}", file=sys.stderr, flush=True)
        kind, reliable = _publication(member, topic, query.timeout_s)
        reader = member.reader(topic, kind, HISTORY, reliable)
        last_ns, n_refused, logged, why = -1, 0, 0, "none"
        heard_s = time.monotonic()
        while True:
            messages = reader.take(WAIT_S, BATCH)
            if messages:
                heard_s = time.monotonic()
            elif time.monotonic() - heard_s > query.timeout_s:
                raise SourceError(f"{source}: nothing came for {query.timeout_s:g} s")
            for data in messages:
                try:
                    received = read_frame(kind, data)
                    stamp_ns = received.stamp_ns or time.monotonic_ns()
                    if received.values.ndim != 2:
                        raise SourceError("a shape that is not (rows, columns)")
                    if last_ns - RESTART_NS < stamp_ns <= last_ns:
                        raise SourceError("a stamp that is not after the one before it")
                except SourceError as error:
                    n_refused, why = n_refused + 1, str(error)
                    continue
                last_ns = stamp_ns
                yield stamp_ns, received.values
            if (total := n_refused + reader.n_lost()) > 2 * logged:
                logged = total
                counts = (
                    f"{n_refused} messages refused, {reader.n_lost()} lost; last refusal: {why}"
                )
                print(f"{source}: {counts}", file=sys.stderr, flush=True)


def _publication(member: Any, topic: str, timeout_s: float) -> tuple[str, bool]:
    """Type of the messages on a topic, of `KINDS`, and True if they are sent reliably."""
    deadline_s, published = time.monotonic() + timeout_s, dict[str, tuple[str, bool]]()
    while time.monotonic() < deadline_s:
        published = member.publications()
        if topic in published:
            kind, reliable = published[topic]
            if kind in KINDS:
                return kind, reliable
            allowed = ", ".join(KINDS)
            raise SourceError(f"ros2:{topic}: is of type {kind[:80]}; allowed are {allowed}")
        time.sleep(0.01)
    raise SourceError(
        f"ros2:{topic}: nobody publishes there on {member.where} within {timeout_s:g} s"
        + (did_you_mean(topic, sorted(published)[:20]) if published else "")
    )
