"""Frames from a topic of ROS 2: the source ros2:/TOPIC?domain=0&interface=lo."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.sensor.driver import DriverSource
from sparseskin.nodes.sensor.source import Address

from . import cdr
from .base import check_installed

SCHEME = "ros2:"
WAIT_S = 0.1
HISTORY = 1000
"""Samples that wait for a sensor that is behind: one second at 1 kHz."""
BATCH = 256
TYPES = {
    "sensor_msgs::msg::dds_::Image_": "Image",
    "std_msgs::msg::dds_::Float32MultiArray_": "Float32MultiArray",
}


@dataclass(frozen=True)
class Ros2Topic:
    """A topic of ROS 2 and how it is reached; `timeout_s` is the longest wait for a message."""

    topic: str
    domain: int = 0
    interface: str = "lo"
    timeout_s: float = 10.0


def parse(source: str) -> Ros2Topic:
    """Read the text of a source.
    Raises SourceError if it is not ros2:/TOPIC?KEY=VALUE&..., or cyclonedds is not installed.
    """
    topic, _, query = source.removeprefix(SCHEME).partition("?")
    if not topic.startswith("/") or len(topic) < 2:
        raise SourceError(f"{source}: a topic of ROS 2 begins with /, as ros2:/tactile/image")
    known = ("domain", "interface", "timeout_s")
    values: dict[str, Any] = {}
    for key, text in parse_qsl(query, keep_blank_values=True):
        if key not in known:
            raise SourceError(f"{source}: {key}: unknown key{did_you_mean(key, known)}")
        values[key] = text
    try:
        if "domain" in values:
            values["domain"] = int(values["domain"])
        if "timeout_s" in values:
            values["timeout_s"] = float(values["timeout_s"])
    except ValueError:
        raise SourceError(f"{source}: domain and timeout_s are numbers") from None
    found = Ros2Topic(topic, **values)
    if not 0 <= found.domain <= 232:
        raise SourceError(f"{source}: domain: {found.domain} is outside 0..232")
    if not 0 < found.timeout_s <= 86400:
        raise SourceError(f"{source}: timeout_s: {found.timeout_s:g} is outside 0..86400")
    return found


class Ros2Address(Address):
    """The address of a topic of ROS 2, whose messages are frames."""

    form = "ros2:/TOPIC"

    def check(self) -> None:
        parse(self.source)
        try:
            check_installed("cyclonedds", "cyclonedds", "ros2", f"source {self.source}")
        except Exception as error:
            raise SourceError(str(error)) from error

    def open(self) -> DriverSource:
        self.check()
        stated: dict[str, Any] = {"f_max": self.f_max, "unit": self.unit, "raw": self.raw}
        driver = DriverSource(self.source, frames(self.source), rate_hz=None, **stated)
        driver.check_shape(self.n_rows, self.n_cols)
        return driver


def frames(source: str) -> Iterator[tuple[int, npt.NDArray[np.generic]]]:
    """Yield (stamp_ns, forces) of each message; a stamp is that of arrival.

    Messages that are older than the last one, or malformed, are dropped and counted in the log, as
    are those that DDS has lost. Raises SourceError if nothing is published there, or nothing
    comes for `timeout_s`.
    """
    from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    from . import dds

    address = parse(source)
    member = dds.participant(address.domain, address.interface)
    type_name, reliable = _publication(member, address)
    cls = getattr(dds, TYPES[type_name])
    read = cdr.read_image if cls is dds.Image else cdr.read_array
    topic = Topic(member, dds.dds_name(address.topic), cls)
    reader = DataReader(member, topic, qos=dds.quality(HISTORY, reliable))
    waiting = WaitSet(member)
    anything = SampleState.Any | ViewState.Any | InstanceState.Any
    waiting.attach(ReadCondition(reader, anything))
    counted = _Counted(source)
    last_ns = -1
    heard_s = time.monotonic()
    while True:
        waiting.wait(duration(seconds=WAIT_S))
        samples = reader.take(N=BATCH)
        counted.lost(reader)
        if not samples and time.monotonic() - heard_s > address.timeout_s:
            raise SourceError(f"{source}: nothing came for {address.timeout_s:g} s")
        for sample in samples:
            data = getattr(sample, "cdr", None)
            if data is None:  # a note that its writer is gone
                continue
            heard_s = time.monotonic()
            try:
                received = read(data)
            except SourceError as error:
                counted.bad(str(error))
                continue
            if received.stamp_ns is not None:
                if received.stamp_ns <= last_ns:
                    counted.bad("a stamp that is not after the one before it")
                    continue
                last_ns = received.stamp_ns
            yield time.monotonic_ns(), received.values


def _publication(member: Any, address: Ros2Topic) -> tuple[str, bool]:
    """Type of what is published on a topic, and True if it is sent reliably."""
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
    from cyclonedds.qos import Policy

    wanted = "rt" + address.topic
    seen: set[str] = set()
    reader = BuiltinDataReader(member, BuiltinTopicDcpsPublication)
    deadline_s = time.monotonic() + address.timeout_s
    while time.monotonic() < deadline_s:
        for found in reader.take(N=BATCH):
            name, type_name = getattr(found, "topic_name", None), getattr(found, "type_name", "")
            if name is None:
                continue
            seen.add(name)
            if name == wanted and type_name in TYPES:
                best_effort = Policy.Reliability.BestEffort in found.qos
                return type_name, not best_effort
            if name == wanted:
                raise SourceError(
                    f"{SCHEME}{address.topic}: is of type {type_name[:80]}; allowed are "
                    f"{', '.join(TYPES.values())}"
                )
        time.sleep(0.01)
    topics = sorted(name.removeprefix("rt") for name in seen if name.startswith("rt/"))[:20]
    hint = did_you_mean(address.topic, topics) if topics else ""
    raise SourceError(
        f"{SCHEME}{address.topic}: nobody publishes there on DDS domain {address.domain} "
        f"({address.interface or 'any interface'}){hint}"
    )


class _Counted:
    """Counts messages that were not used, and logs them at 1, 3, 7 ..."""

    def __init__(self, source: str) -> None:
        self._source = source
        self._n_bad = self._n_lost = self._logged = 0

    def bad(self, why: str) -> None:
        self._n_bad += 1
        self._log(why)

    def lost(self, reader: Any) -> None:
        n_lost = int(reader.get_sample_lost_status().total_count)
        if n_lost != self._n_lost:
            self._n_lost = n_lost
            self._log("lost on the way")

    def _log(self, why: str) -> None:
        total = self._n_bad + self._n_lost
        if total > 2 * self._logged:
            self._logged = total
            print(
                f"{self._source}: {self._n_bad} messages refused, {self._n_lost} lost; "
                f"the last: {why}",
                file=sys.stderr,
                flush=True,
            )
