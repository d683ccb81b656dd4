"""Frames from a topic of ROS 2: the source ros2:/TOPIC?domain=0&interface=lo."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
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
        stated: dict[str, Any] = {"f_max": self.f_max, "unit": self.unit, "raw": self.raw}
        driver = DriverSource(self.source, frames(self.source), **stated, nan=self.policy.nan)
        driver.check_shape(self.n_rows, self.n_cols)
        return driver


def frames(source: str) -> Iterator[tuple[int, npt.NDArray[np.generic]]]:
    """Yield (stamp_ns, forces) of each message: the stamp of its header, or of its arrival where it
    has none, or 0.

    Messages that are malformed, or less than 1 s older than the last one, are dropped and counted
    in the log, as are those that DDS has lost, unless read by rclpy. Raises SourceError if nothing
    is published there, or nothing comes for `timeout_s`.
    """
    topic, query = parse(source)
    member = topics.join(query.domain, query.interface, "source")
    print(f"{source}: {member.where}", file=sys.stderr, flush=True)
    kind, reliable = _publication(member, topic, query.timeout_s)
    reader = member.reader(topic, kind, HISTORY, reliable)
    counted = _Counted(source)
    last_ns = -1
    heard_s = time.monotonic()
    while True:
        messages = reader.take(WAIT_S, BATCH)
        counted.lost(reader.n_lost)
        if messages:
            heard_s = time.monotonic()
        elif time.monotonic() - heard_s > query.timeout_s:
            raise SourceError(f"{source}: nothing came for {query.timeout_s:g} s")
        for data in messages:
            try:
                received = read_frame(kind, data)
                if received.values.ndim != 2:
                    raise SourceError("a shape that is not (rows, columns)")
            except SourceError as error:
                counted.bad(str(error))
                continue
            stamp_ns = received.stamp_ns or time.monotonic_ns()
            if last_ns - RESTART_NS < stamp_ns <= last_ns:
                counted.bad("a stamp that is not after the one before it")
                continue
            last_ns = stamp_ns
            yield stamp_ns, received.values


def _publication(member: Any, topic: str, timeout_s: float) -> tuple[str, bool]:
    """Type of the messages on a topic, of `KINDS`, and True if they are sent reliably."""
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        if topic in (published := member.publications()):
            kind, reliable = published[topic]
            if kind in KINDS:
                return kind, reliable
            allowed = ", ".join(KINDS)
            raise SourceError(f"ros2:{topic}: is of type {kind[:80]}; allowed are {allowed}")
        time.sleep(0.01)
    hint = did_you_mean(topic, sorted(published)[:20]) if published else ""
    raise SourceError(
        f"ros2:{topic}: nobody publishes there on {member.where} within {timeout_s:g} s{hint}"
    )


class _Counted:
    """Counts messages that were not used, and logs them each time that their number has doubled."""

    def __init__(self, source: str) -> None:
        self._source = source
        self._n_bad = self._n_lost = self._logged = 0

    def bad(self, why: str) -> None:
        self._n_bad += 1
        self._log(why)

    def lost(self, n: int) -> None:
        self._n_lost = n
        self._log("lost on the way")

    def _log(self, why: str) -> None:
        if (total := self._n_bad + self._n_lost) > 2 * self._logged:
            self._logged = total
            counts = f"{self._n_bad} messages refused, {self._n_lost} lost"
            print(f"{self._source}: {counts}; the last: {why}", file=sys.stderr, flush=True)
