"""Frames from a topic of ROS 2: the source ros2:/TOPIC?domain=0&interface=lo."""

import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

from sparseskin.nodes.errors import SourceError, SparseskinError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.numerics.arrays import AnyArray
from sparseskin.nodes.sensor.driver import RESTART_NS, DriverSource
from sparseskin.nodes.sensor.layout.arrangement import Arrangement, arrange
from sparseskin.nodes.sensor.layout.layout import EMPTY, Layout, UnstatedError
from sparseskin.nodes.sensor.layout.times import NS
from sparseskin.nodes.sensor.source import Address
from sparseskin.nodes.settings import Settings, setting
from sparseskin.plugins.boards.settings import split_source, typed

from . import topics
from .frames import MessageReader, Received, Turns, choose_field
from .messages.definitions import Definitions, learn

WAIT_S = 0.1
HISTORY = 1000
"""Samples that wait for a sensor that is behind: one second at 1 kHz."""
BATCH = 256
ARRANGED = ("order", "row_order", "col_order", "channel")
"""Keys of `Layout` by which numbers are arranged."""
TIMED = ("time", "time_unit", "frame_id")


@dataclass(frozen=True)
class Ros2Query(Settings):
    """How a topic is reached: the keys of a source."""

    domain: int | None = setting(None, "DDS domain, as of the bridge", low=0, high=232)
    interface: str | None = setting(None, "network interface, as of the bridge")
    timeout_s: float = setting(
        10.0, "longest wait for a message, seconds", low=0, high=86400
    )


def parse(source: str) -> tuple[str, Ros2Query]:
    """Topic and query of a source. Raises SourceError if it is not ros2:/TOPIC?KEY=VALUE&..."""
    _, topic, query = split_source(source)
    if not topic.startswith("/") or len(topic) < 2:
        raise SourceError(
            f"{source}: a topic of ROS 2 begins with /, as ros2:/tactile/image"
        )
    try:
        return topic, Ros2Query(**typed(Ros2Query, query))
    except SparseskinError as error:
        raise SourceError(f"{source}: {error}") from error


class Ros2Address(Address):
    """The address of a topic of ROS 2, whose messages are frames."""

    delivers = "taxels"
    form = "ros2:/TOPIC"
    keys = (
        "n_rows",
        "n_cols",
        *ARRANGED,
        "field",
        *TIMED,
        "unit",
        "f_max",
        "missing",
        "nan",
    )

    def check(self) -> None:
        parse(self.source)
        topics.check(f"source {self.source}", SourceError)

    def open(self) -> DriverSource:
        self.check()
        # The frames are arranged already, by the labels of the messages, too.
        remaining = self.layout.stating({key: getattr(EMPTY, key) for key in ARRANGED})
        address = replace(self, layout=remaining)
        return DriverSource(address, frames(self.source, self.layout))


class TopicFrames:
    """Frames of the messages on a topic, which are read as those of a recording are.

    Raises SourceError if the definition of their type is not known.
    """

    def __init__(self, source: str, kind: str, layout: Layout) -> None:
        self.n_refused = 0
        #: Why the last message that was refused was.
        self.why = "none"
        self._source = source
        self._layout = layout
        learn(kind)
        self._reader = MessageReader(Definitions(), kind, layout)
        self._is_chosen = bool(layout.field)
        self._arrangement: Arrangement | None = None
        self._first: Received | None = None
        self._turns = Turns()
        self._last_ns = -1

    def frame(self, data: bytes) -> tuple[int, AnyArray] | None:
        """Stamp and frame of a message; None if it is refused. Raises SourceError if the field, the
        shape or the frame_id of the messages has to be stated.
        """
        try:
            # The field is chosen by the first message that holds any.
            if not self._is_chosen:
                self._reader.field = self._chosen_field(data)
                self._is_chosen = True
            received = self._reader.read_frame(data)
        except UnstatedError:
            raise
        except SourceError as error:
            self._refuse(str(error))
            return None

        numbers = received.numbers
        if self._first is None:
            self._arrangement = arrange(self._layout, numbers.axes, self._source)
            self._first = received
        reference = self._first
        assert self._arrangement is not None
        fault = ""
        if received.frame_id != reference.frame_id:
            fault = f"frames: {reference.frame_id!r}, {received.frame_id!r}"
        elif not self._layout.frame_id and self._turns.add(received.number):
            fault = f"skins: {reference.number!r}, {received.number!r}"
        if fault:
            fault = f"messages of several {fault}"
            raise SourceError(f"{self._source}: {fault[:120]}; state frame_id")
        if numbers.values.shape != reference.numbers.values.shape:
            self._refuse("a shape that is not that of the first one")
            return None
        if numbers.axes != reference.numbers.axes:
            self._refuse("taxels in another order than those of the first one")
            return None

        stamp_ns = self._stamp_ns(received)
        # A stamp that is far behind is that of a publisher which was started again.
        if self._last_ns - RESTART_NS < stamp_ns <= self._last_ns:
            self._refuse("a stamp that is not after the one before it")
            return None
        self._last_ns = stamp_ns
        return stamp_ns, self._arrangement.frames(numbers.values[None])[0]

    def _chosen_field(self, data: bytes) -> str:
        message = self._reader.decode(data)
        return choose_field(message, self._layout, self._source)

    def _stamp_ns(self, received: Received) -> int:
        """The time of a message, or of its arrival where it has none."""
        if received.time is None:
            return time.monotonic_ns()
        unit = self._reader.time_unit
        if not unit:
            raise SourceError(
                f"{self._source}: the unit of the times is not stated; state time_unit"
            )
        return round(received.time * NS[unit])

    def _refuse(self, why: str) -> None:
        self.n_refused += 1
        self.why = why


def frames(source: str, layout: Layout = EMPTY) -> Iterator[tuple[int, AnyArray]]:
    """Yield (stamp_ns, forces) of each message: the stamp of its header, or of its arrival where it
    has none, or 0.

    Messages that are malformed or empty, or less than 1 s older than the last one, are dropped and
    counted in the log, as are those that were lost on the way. Raises SourceError if nothing is
    published there, nothing comes for `timeout_s`, or the messages can be read in several ways.
    """
    topic, query = parse(source)
    with closing(topics.join(query.domain, query.interface, "source")) as member:
        print(f"{source}: {member.where}", file=sys.stderr, flush=True)
        kind, reliable = _publication(member, topic, query.timeout_s)
        read = TopicFrames(source, kind, layout)
        # A reader that asks for more than the writer offers is never matched with it.
        reader = member.reader(topic, kind, HISTORY, reliable)
        n_logged = 0
        heard_s = time.monotonic()
        while True:
            # Short waits: a command or a signal ends the source in between.
            messages = reader.take(WAIT_S, BATCH)
            if messages:
                heard_s = time.monotonic()
            elif time.monotonic() - heard_s > query.timeout_s:
                raise SourceError(f"{source}: nothing came for {query.timeout_s:g} s")

            for data in messages:
                stamped = read.frame(data)
                if stamped is not None:
                    yield stamped

            # Logged each time that their number has doubled.
            n_lost = reader.n_lost()
            n_dropped = read.n_refused + n_lost
            if n_dropped > 2 * n_logged:
                n_logged = n_dropped
                counts = f"{read.n_refused} messages refused, {n_lost} lost"
                print(
                    f"{source}: {counts}; last refusal: {read.why}",
                    file=sys.stderr,
                    flush=True,
                )


def _publication(member: Any, topic: str, timeout_s: float) -> tuple[str, bool]:
    """Type of the messages on a topic, and True if they are sent reliably."""
    deadline_s = time.monotonic() + timeout_s
    published: dict[str, tuple[str, bool]] = {}
    while time.monotonic() < deadline_s:
        # Discovery takes some time after a participant has joined.
        published = member.publications()
        if topic in published:
            return published[topic]
        time.sleep(0.01)

    fault = f"nobody publishes there on {member.where} within {timeout_s:g} s"
    hint = ""
    if published:
        hint = did_you_mean(topic, sorted(published)[:20])
    raise SourceError(f"ros2:{topic}: {fault}{hint}")
