"""The player: publishes what was recorded, when it was recorded, at any rate."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

from tqdm import tqdm

from sparseskin.messages import Message, MessageError, SkinState, Truth, decode, topic_of
from sparseskin.messages.topics import split_topic
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.errors import RefusedError, SparseskinError
from sparseskin.nodes.node import Context, SourceNode, Tick
from sparseskin.nodes.recorder.bag_reader import BagReader

from .schedule import Schedule
from .settings import PlayerSettings, renamed_topics

MAX_STAMPS = 4096
"""How many frames may be under way at once before a late message counts as a frame of its own."""


class Player(SourceNode[PlayerSettings]):
    """Publishes recorded messages in the order in which they were recorded.

    A message is due when its stamp is: at t0 + (stamp - first stamp) / rate, an absolute
    target; a pause moves t0. States (skin, Phi, solver) are published at once.
    """

    Settings = PlayerSettings

    def __init__(self, settings: PlayerSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._bag = BagReader(settings.file)
        names = renamed_topics(settings)
        self._names = {topic: new for topic, new in names.items() if topic in self._bag.topics}
        if self._bag.recovered:
            print(f"{settings.file}: {self._bag.recovered}")
        self.verbatim = settings.verbatim
        self.min_readers = settings.wait or int(settings.lockstep)
        if settings.lockstep:
            self.window = 1
        streams = [
            info for t, info in self._bag.topics.items() if t in self._names and not _latched(t)
        ]
        first_ns = min((info.first_ns for info in streams if info.n_messages), default=0)
        last_ns = max((info.last_ns for info in streams if info.n_messages), default=0)
        self._start_ns = first_ns + round(settings.start_s * 1e9)
        self._stop_ns = last_ns + 1
        if settings.duration_s is not None:
            self._stop_ns = min(self._stop_ns, self._start_ns + round(settings.duration_s * 1e9))
        self._schedule = Schedule(self._start_ns, settings.rate, settings.paused)
        self._stamps: dict[int, int] = {}
        self._n_frames = 0
        self._started_ns = 0
        self._messages = self._read()
        self._next: Message | None = None
        self._advance()

    @classmethod
    def outputs(cls, settings: PlayerSettings) -> tuple[str, ...]:
        return tuple(renamed_topics(settings).values())

    def start(self) -> Iterable[Message]:
        states = [topic for topic in self._names if _latched(topic)]
        newest = {m.topic: m for m in self._bag.messages(states)} if states else {}
        for recorded in newest.values():
            state = self._decoded(recorded.topic, recorded.payload)
            if isinstance(state, SkinState) and not self.settings.verbatim:
                truth = topic_of(split_topic(recorded.topic)[0], Truth.schema)
                state = replace(state, has_truth=state.has_truth and truth in self._names)
            yield state

    @property
    def follows_readers(self) -> bool:
        return self.settings.lockstep or self.settings.rate == 0.0

    def begin(self, now_ns: int) -> None:
        super().begin(now_ns)
        self._started_ns = now_ns
        self._schedule.begin(now_ns)

    def next_tick_ns(self) -> int | None:
        if self._next is None:
            return 0
        return self._schedule.due_ns(self._next.stamp_ns)

    def tick(self, tick: Tick) -> Iterable[Message]:
        """Publish all messages of the next frame that follow one another in the recording."""
        if self._next is None:
            return
        frame_ns = self._next.stamp_ns
        self._schedule.stepped(frame_ns)
        while self._next is not None and self._next.stamp_ns <= frame_ns:
            yield self._as_played(self._next, tick.stamp_ns)
            self._advance()
        self._n_frames += 1

    def command(self, name: str, value: Any) -> None:
        now_ns = self.context.clock.now_ns()
        match name:
            case "pause":
                self._schedule.toggle_pause(now_ns)
            case "step":
                self._schedule.step(now_ns)
            case "faster" | "slower" if self.settings.rate:
                factor = 1.1 if name == "faster" else 1 / 1.1
                self._schedule.change_rate(self._schedule.rate * factor, now_ns)
            case "faster" | "slower":
                raise RefusedError(f"{name}: at rate 0 the readers set the pace")
            case _:
                super().command(name, value)

    def status(self) -> str:
        """A progress line: recorded seconds played, of all."""
        now_ns = self.context.clock.now_ns()
        at_ns = self._next.stamp_ns if self._next is not None else self._stop_ns
        played_s = (min(at_ns, self._stop_ns) - self._start_ns) / 1e9
        note = "paused" if self._schedule.paused else f"rate {self._schedule.rate:.3g}"
        return str(
            tqdm.format_meter(
                round(max(0.0, played_s), 2),
                round(max(0.0, (self._stop_ns - self._start_ns) / 1e9), 2),
                max(1e-9, (now_ns - self._started_ns) / 1e9),
                ncols=78,
                prefix=f"{self._n_frames} frames",
                unit="s",
                postfix=note,
                bar_format="{desc}: {percentage:3.0f}% |{bar}| {n:.1f}/{total:.1f} s{postfix}",
            )
        )

    def report(self) -> dict[str, Any]:
        return {"played": {"file": self.settings.file, "frames": self._n_frames}}

    def close(self, counts: dict[str, Any]) -> None:
        self._bag.close()

    def _advance(self) -> None:
        self._next = next(self._messages, None)
        if self._next is None:
            self.exhausted = True

    def _read(self) -> Iterator[Message]:
        """All messages to play, in order; stamps move on with each round of a loop."""
        shift_ns = 0
        streams = [topic for topic in self._names if not _latched(topic)]
        while streams:
            n_read = 0
            for recorded in self._bag.messages(streams, self._start_ns, self._stop_ns):
                message = self._decoded(recorded.topic, recorded.payload)
                n_read += 1
                yield (
                    replace(message, stamp_ns=message.stamp_ns + shift_ns) if shift_ns else message
                )
            if not (self.settings.loop and n_read):
                return
            shift_ns += self._stop_ns - self._start_ns

    def _decoded(self, topic: str, payload: bytes) -> Message:
        try:
            message = decode(topic.encode(), payload)
        except MessageError as error:
            raise SparseskinError(f"{self.settings.file}: {topic}: {error}") from error
        patch = split_topic(self._names[topic])[0]
        return message if patch == message.patch else replace(message, patch=patch)

    def _as_played(self, message: Message, now_ns: int) -> Message:
        """The message with the time of playing as its stamp, one and the same for a frame."""
        if self.settings.verbatim or self.settings.keep_stamps:
            return message
        if message.stamp_ns not in self._stamps:
            if len(self._stamps) >= MAX_STAMPS:
                del self._stamps[next(iter(self._stamps))]
            self._stamps[message.stamp_ns] = now_ns
        return message.moved(self._stamps[message.stamp_ns] - message.stamp_ns)


def _latched(topic: str) -> bool:
    return SCHEMAS[split_topic(topic)[1]].latched
