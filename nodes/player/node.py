"""The player: publishes recorded messages at their recorded times, at any rate."""

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain
from typing import Any, ClassVar

from sparseskin.messages import (
    Message,
    MessageError,
    PhiState,
    SkinState,
    Truth,
    decode,
    topic_of,
)
from sparseskin.messages.ranges import is_real
from sparseskin.messages.topics import split_topic
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.errors import RefusedError, SettingsError, SparseskinError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.node import Context, SourceNode, Tick
from sparseskin.nodes.node_host import is_latched
from sparseskin.nodes.process.control import Document
from sparseskin.nodes.recorder.bag.format import TopicInfo, span_ns
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.settings import Settings, setting

from .schedule import Schedule

LOWEST_RATE = 0.001
HIGHEST_RATE = 1000.0
"""Limits of a rate that is changed while it plays; 0, as fast as it is read, is set at the start
alone, since there is no schedule to change then."""
MAX_STAMPS = 4096
"""Frames in flight whose new stamps are kept; a later message counts as a frame of its own."""


@dataclass(frozen=True)
class PlayerSettings(Settings):
    """Settings of the player node."""

    file: str = setting("", "recording to play, NAME.mcap")
    rate: float = setting(
        1.0,
        "times the recorded speed; 0: as fast as the readers allow",
        low=0.0,
        high=1000.0,
    )
    loop: bool = setting(False, "restart at the end")
    start_s: float = setting(0.0, "seconds of the recording to skip", low=0.0, high=1e9)
    duration_s: float | None = setting(None, "seconds to play", low=0.0, high=1e9)
    paused: bool = setting(False, "wait for a command before the first frame")
    topics: tuple[str, ...] = setting((), "topics to play; all by default")
    schemas: tuple[str, ...] = setting(
        (), "schemas to play (skin, taxels, truth ...), instead of topics"
    )
    lockstep: bool = setting(
        False, "send no frame before all readers have processed the last"
    )
    keep_stamps: bool = setting(False, "keep stamps as recorded")
    wait: int = setting(
        0, "readers to wait for before the first frame", low=0, high=1000
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for schema in self.schemas:
            if schema not in SCHEMAS:
                raise SettingsError(
                    f"schemas: {schema}: no schema{did_you_mean(schema, SCHEMAS)}"
                )
        if self.schemas and self.topics:
            raise SettingsError("schemas: cannot be combined with topics")
        if self.keep_stamps and self.loop:
            raise SettingsError("keep_stamps: cannot be combined with loop")

    def check(self) -> None:
        topics = played_topics(self)
        recorded = _topics_of(self.file)
        infos = [recorded[topic] for topic in topics if topic in recorded]
        first_ns, last_ns = span_ns(infos) or (0, 0)
        length_s = (last_ns - first_ns) / 1e9
        if self.start_s > length_s:
            raise SettingsError(
                f"start_s: {self.start_s:g}: the recording lasts {length_s:.3f} s"
            )


class Player(SourceNode[PlayerSettings]):
    """Publishes recorded messages in the order in which they were recorded.

    A message is due at t0 + (stamp - first stamp) / rate; a pause moves t0. States (skin, Phi,
    solver) are published at once.
    """

    Settings = PlayerSettings
    commands: ClassVar[Mapping[str, str]] = {
        **SourceNode.commands,
        "step": "play one frame, and pause",
        "faster": "10 % faster",
        "slower": "10 % slower",
        "rate": "times the recorded speed, 0.001..1000",
        "seek": "go to a time in seconds of the played part",
    }

    def __init__(self, settings: PlayerSettings, context: Context) -> None:
        super().__init__(settings, context)

        # Not the whole file is read: what is damaged is reported as it is played.
        self._bag = BagReader(settings.file, whole=False)
        # A truth that was not recorded is left out.
        recorded = self._bag.topics
        self._topics = [topic for topic in played_topics(settings) if topic in recorded]
        if self._bag.recovered:
            print(f"{settings.file}: {self._bag.recovered}")
        if not any(info.n_messages for info in recorded.values()):
            self._bag.close()
            raise SettingsError(
                f"{settings.file}: holds no message, so there is nothing to play"
            )

        self.min_readers = settings.wait or int(settings.lockstep)
        if settings.lockstep:
            self.window = 1
        self._states = [topic for topic in self._topics if is_latched(topic)]
        self._streams = [topic for topic in self._topics if not is_latched(topic)]
        # States that change within the recording are published again after a jump.
        states = [info for topic, info in recorded.items() if is_latched(topic)]
        self._has_changes = any(info.n_messages > 1 for info in states)

        infos = [recorded[topic] for topic in self._topics]
        first_ns, last_ns = span_ns(infos) or (0, 0)
        self._start_ns = first_ns + round(settings.start_s * 1e9)
        self._stop_ns = last_ns + 1
        if settings.duration_s is not None:
            end_ns = self._start_ns + round(settings.duration_s * 1e9)
            self._stop_ns = min(self._stop_ns, end_ns)

        self._schedule = Schedule(self._start_ns, settings.rate, settings.paused)
        self._stamps: dict[int, int] = {}
        self._n_frames = 0
        # Of the stamps, in this repetition of a loop.
        self._shift_ns = 0
        self._frame_ns: int | None = None
        self._messages = self._read(self._start_ns)
        self._next: Message | None = None
        self._advance()

    @classmethod
    def outputs(cls, settings: PlayerSettings) -> tuple[str, ...]:
        return tuple(played_topics(settings))

    @classmethod
    def facts(cls, settings: PlayerSettings) -> Mapping[str, Any]:
        facts: Document = {}
        # What cannot be read is reported as it is played.
        with (
            BagReader(settings.file, whole=False) as bag,
            contextlib.suppress(SparseskinError, MessageError),
        ):
            topics = bag.topics.keys() & played_topics(settings)
            for recorded in bag.messages(filter(is_latched, topics)):
                state = decode(recorded.topic.encode(), recorded.payload)
                if isinstance(state, SkinState):
                    facts.setdefault(recorded.topic, state.skin.n_taxels)
                elif isinstance(state, PhiState):
                    facts.setdefault(recorded.topic, state.kind)
        return facts

    def start(self) -> Iterable[Message]:
        return self._states_at(self._start_ns)

    def _states_at(self, at_ns: int) -> list[Message]:
        """The states at a stamp: the last ones before it, else the first ones."""
        states: dict[str, Message] = {}
        for recorded in self._bag.messages(self._states):
            if recorded.stamp_ns <= at_ns or recorded.topic not in states:
                state = self._decoded(recorded.topic, recorded.payload)
                states[recorded.topic] = state
        return list(states.values())

    @property
    def follows_readers(self) -> bool:
        return self.settings.lockstep or self.settings.rate == 0.0

    def begin(self, now_ns: int) -> None:
        super().begin(now_ns)
        self._schedule.begin(now_ns)

    def next_tick_ns(self) -> int | None:
        if self._next is None:
            return 0
        return self._schedule.due_ns(self._next.stamp_ns)

    def tick(self, tick: Tick) -> Iterable[Message]:
        """Publish the messages of the next frame, which are consecutive in the recording."""
        if self._next is None:
            return
        frame_ns = self._next.stamp_ns
        self._frame_ns = frame_ns
        self._schedule.stepped(frame_ns)
        while self._next is not None and self._next.stamp_ns <= frame_ns:
            yield self._as_played(self._next, tick.stamp_ns)
            self._advance()
        self._n_frames += 1

    def rest(self) -> Iterable[Message]:
        """The messages of the frames played that were recorded after a later frame, as measurements
        and reconstructions are; they are looked for until each stream has passed the last frame.
        """
        frame_ns = self._frame_ns
        # Without a bound, a stream that has ended early would be waited for to the end of the file.
        behind = set(self._streams)
        for _ in range(MAX_STAMPS):
            message = self._next
            if message is None or frame_ns is None or not behind:
                return
            if message.stamp_ns <= frame_ns:
                yield self._as_played(message, self.context.clock.now_ns())
            else:
                behind.discard(message.topic)
            self._advance()

    def command(self, name: str, value: Any) -> str:
        now_ns = self.context.clock.now_ns()
        match name:
            case "step":
                self._schedule.step(now_ns)
                return "one frame"
            case "faster" | "slower":
                factor = 1.1
                if name == "slower":
                    factor = 1 / 1.1
                rate = self._schedule.rate * factor
                rate = min(max(rate, LOWEST_RATE), HIGHEST_RATE)
                return self._change_rate(rate, now_ns)
            case "rate":
                rate = _number("rate", value, LOWEST_RATE, HIGHEST_RATE)
                return self._change_rate(rate, now_ns)
            case "seek":
                length_s = (self._stop_ns - self._start_ns) / 1e9
                at_s = _number("seek", value, 0.0, length_s)
                self._seek(self._start_ns + round(at_s * 1e9), now_ns)
                return f"at {at_s:.2f} s"
        return super().command(name, value)

    @property
    def paused(self) -> bool:
        return self._schedule.paused

    def pause(self, paused: bool) -> None:
        self._schedule.toggle_pause(self.context.clock.now_ns())

    def state(self) -> Document:
        """Pause, rate, and position in recorded seconds."""
        # Stamps of a loop are shifted: the position is that within the recording.
        position_ns = self._stop_ns
        if self._next is not None:
            position_ns = min(self._next.stamp_ns - self._shift_ns, self._stop_ns)
        # Where nothing lies within the part that is to be played, it ends before it starts.
        played_ns = max(0, position_ns - self._start_ns)
        length_ns = max(0, self._stop_ns - self._start_ns)
        return {
            "paused": self.paused,
            "rate": self._schedule.rate,
            "position_s": played_ns / 1e9,
            "length_s": length_ns / 1e9,
        }

    def _change_rate(self, rate: float, now_ns: int) -> str:
        if not self._schedule.rate:
            raise RefusedError("rate: at rate 0 the readers set the pace")
        self._schedule.change_rate(rate, now_ns)
        return f"rate {rate:.3g}"

    def _seek(self, stamp_ns: int, now_ns: int) -> None:
        """Continue from another position of the recording."""
        if self.exhausted:
            raise RefusedError("seek: the recording has been played to its end")

        # Reading from there begins without the shift of a loop; a seek that fails keeps it.
        shift_ns = self._shift_ns
        messages = self._read(stamp_ns)
        message = next(messages, None)
        if message is None:
            self._shift_ns = shift_ns
            raise RefusedError("seek: no frame follows there")

        self._messages = messages
        self._next = message
        if self._has_changes:
            states = self._states_at(stamp_ns)
            # They are of the position sought, whenever they were recorded.
            states = [state.moved(stamp_ns - state.stamp_ns) for state in states]
            self._messages = chain(states[1:], [message], messages)
            self._next = states[0]
        # Frames in flight are of the part before the jump.
        self._stamps.clear()
        self._schedule.seek(stamp_ns, now_ns)

    def status(self) -> str:
        """Frames and seconds played, and the rate."""
        state = self.state()
        note = f"rate {self._schedule.rate:.3g}"
        if self.paused:
            note = "paused"
        played = f"{state['position_s']:.1f} of {state['length_s']:.1f} s"
        return f"{self._n_frames} frames: {played}, {note}"

    def report(self) -> Document:
        played = {
            "file": self.settings.file,
            "frames": self._n_frames,
        }
        return {"played": played}

    def close(self, counts: Document) -> None:
        self._bag.close()

    def _advance(self) -> None:
        self._next = next(self._messages, None)
        if self._next is None:
            self.exhausted = True

    def _read(self, from_ns: int) -> Iterator[Message]:
        """Yield all messages to play; each repetition of a loop shifts the stamps."""
        shift_ns = 0
        while self._streams:
            self._shift_ns = shift_ns
            n_read = 0
            for recorded in self._bag.messages(self._topics, from_ns, self._stop_ns):
                # These states were published before.
                latched = recorded.topic in self._states
                if latched and recorded.stamp_ns <= from_ns:
                    continue
                message = self._decoded(recorded.topic, recorded.payload)
                n_read += not latched
                if shift_ns:
                    message = message.moved(shift_ns)
                yield message
            # A loop over nothing would never yield.
            if not (self.settings.loop and n_read):
                return

            from_ns = self._start_ns
            shift_ns += self._stop_ns - self._start_ns
            if self._has_changes:
                # Those of the end are not those of the begin.
                begin_ns = self._start_ns + shift_ns
                for state in self._states_at(from_ns):
                    yield state.moved(begin_ns - state.stamp_ns)

    def _decoded(self, topic: str, payload: bytes) -> Message:
        try:
            message = decode(topic.encode(), payload)
        except MessageError as error:
            raise SparseskinError(f"{self.settings.file}: {topic}: {error}") from error
        if isinstance(message, SkinState):
            # A recording without its truth must not promise one.
            truth = topic_of(message.patch, Truth.schema)
            has_truth = message.has_truth and truth in self._topics
            # Recorded frames wait, whatever they were when they were sensed.
            message = replace(message, has_truth=has_truth, live=False)
        return message

    def _as_played(self, message: Message, now_ns: int) -> Message:
        """The message with the time of playing as its stamp, the same for all of a frame."""
        if self.settings.keep_stamps:
            return message
        # The first message of a frame sets the stamp of all; the oldest frame is forgotten.
        if message.stamp_ns not in self._stamps:
            if len(self._stamps) >= MAX_STAMPS:
                del self._stamps[next(iter(self._stamps))]
            self._stamps[message.stamp_ns] = now_ns
        played_ns = self._stamps[message.stamp_ns]
        return message.moved(played_ns - message.stamp_ns)


def _number(name: str, value: Any, low: float, high: float) -> float:
    if not is_real(value, low, high):
        raise RefusedError(
            f"{name}: {value!r} is not allowed (allowed: {low:g}..{high:g})"
        )
    return float(value)


@lru_cache(maxsize=8)
def _topics_of(file: str) -> dict[str, TopicInfo]:
    with BagReader(file, whole=False) as bag:
        return dict(bag.topics)


def played_topics(settings: PlayerSettings) -> list[str]:
    """The chosen topics of the recording; a truth among them may not have been recorded.

    Raises SparseskinError if the file cannot be opened, or lacks another topic.
    """
    if not settings.file:
        raise SettingsError("file: state the recording to play")
    recorded = _topics_of(settings.file)
    for topic in settings.topics:
        if topic not in recorded:
            # All of them: their names are too alike for a nearest one.
            names = ", ".join(sorted(recorded))
            raise SettingsError(f"topics: {topic}: not in the file (known: {names})")

    if settings.topics:
        return list(settings.topics)
    if settings.schemas:
        return _of_schemas(recorded, settings)
    return list(recorded)


def _of_schemas(recorded: Iterable[str], settings: PlayerSettings) -> list[str]:
    """Topics of the chosen schemas; the truth may be missing, as for real skins."""
    patches = dict.fromkeys(split_topic(topic)[0] for topic in recorded)
    topics = []
    for patch in patches:
        for schema in settings.schemas:
            topic = topic_of(patch, schema)
            topics.append(topic)
            if topic not in recorded and schema != Truth.schema:
                raise SettingsError(
                    f"schemas: {topic}: not in {settings.file}, which has "
                    f"{', '.join(sorted(recorded))}; record it with them"
                )
    return topics
