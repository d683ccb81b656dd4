"""The newest frame of a running graph, for a program with a loop of its own."""

import time
from threading import Condition, Thread
from typing import NamedTuple, TypeVar

from sparseskin.launch.attach.stream import TopicStream
from sparseskin.launch.run.running import GraphError, choose_graph
from sparseskin.messages import (
    Contacts,
    Message,
    MessageError,
    Reconstruction,
    SkinState,
    decode,
    topic_of,
)
from sparseskin.messages.frames import Frames
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.numerics.arrays import Floats

Part = TypeVar("Part", bound=Frames)


class Latest(NamedTuple):
    """A frame: its number, from 1 on, the time of its arrival by `time.monotonic`, its skin, and
    its contacts where they are read.
    """

    number: int
    at_s: float
    skin: SkinState
    frame: Reconstruction
    contacts: Contacts | None


class LatestFrames:
    """Reads the reconstructions of a patch (of one in a batch BATCH/PATCH) of a graph, by default
    the only one that runs, in a thread, and keeps the newest, with its contacts where they are
    wanted; no node waits for it.

    Raises GraphError if there is no such graph, or it does not publish that.
    """

    def __init__(self, graph: str | None, patch: str, with_contacts: bool) -> None:
        running = choose_graph(graph)
        self._label = running.label
        self._with_contacts = with_contacts
        # A batch is published under its own name, and split here.
        patch, _, self._part = patch.partition("/")
        schemas = [SkinState.schema, Reconstruction.schema]
        if with_contacts:
            schemas.append(Contacts.schema)
        topics = [topic_of(patch, schema) for schema in schemas]
        writers = running.writers()
        for topic in topics:
            if topic not in writers:
                hint = did_you_mean(topic, writers)
                if topic.endswith(Contacts.schema):
                    hint = "; start it with reconstructor.contacts=true"
                raise GraphError(f"{self._label}: publishes no {topic}{hint}")
        self._stream = TopicStream(running, *topics)
        self._news = Condition()
        self._latest: Latest | None = None
        self._number = 0
        self._why_ended = ""
        self._skin: SkinState | None = None
        self._frame: Reconstruction | None = None
        self._held: dict[str, Floats] = {}
        # Number of the last reconstruction: one that is missing breaks the chain of references.
        self._seq = -1
        # A daemon: a program that ends without `close` is not kept alive.
        self._thread = Thread(
            target=self._read,
            name=f"frames of {self._label}",
            daemon=True,
        )
        self._thread.start()

    def newest(self, after: int = 0, timeout_s: float = 0.0) -> Latest | None:
        """The newest frame, if its number exceeds `after`; else the next one, None if it does not
        come in time. Raises GraphError once the graph has ended.
        """
        with self._news:
            # The end of the graph wakes a waiting program, too.
            is_due = self._news.wait_for(
                lambda: self._why_ended or self._number > after, timeout_s
            )
            if self._why_ended:
                raise GraphError(self._why_ended)
            return self._latest if is_due else None

    def close(self) -> None:
        """Stop reading."""
        self._stream.interrupted = True
        self._thread.join()

    def _read(self) -> None:
        why = f"{self._label}: has ended"
        try:
            for arrivals in self._stream.batches(None):
                for arrival in arrivals:
                    try:
                        self._take(decode(arrival.topic, arrival.payload))
                    except MessageError:
                        # A later one may be well-formed.
                        continue
        except GraphError as error:
            why = str(error)
        finally:
            # Whatever ended the reading, `newest` must not wait for ever.
            self._stream.close()
            with self._news:
                self._why_ended = why
                self._news.notify_all()

    def _take(self, message: Message) -> None:
        if isinstance(message, SkinState):
            self._skin = message
        elif isinstance(message, Reconstruction):
            self._check_part(message)
            # A frame that a later one refers to may be lost.
            if message.seq != self._seq + 1:
                self._held.clear()
            self._seq = message.seq
            self._frame = self._part_of(message.split(self._held))
            if not self._with_contacts:
                self._publish(None)
        elif isinstance(message, Contacts):
            # Contacts follow their frame: both are published together.
            self._publish(self._part_of(message.split()))

    def _check_part(self, message: Reconstruction) -> None:
        """Raise GraphError if a batch does not have the patch, or it has no name within one."""
        batch = message.patch
        if self._part in (message.names or ("",)):
            return
        patches = [f"{batch}/{name}" for name in message.names] or [batch]
        hint = did_you_mean(f"{batch}/{self._part}", patches)
        raise GraphError(
            f"{message.topic}: patch: {patches[0]} is one of {len(patches)}{hint}"
        )

    def _part_of(self, parts: list[Part]) -> Part | None:
        """The message of the patch that is read, of those of a batch."""
        for part in parts:
            if self._part in ("", part.patch):
                return part
        return None

    def _publish(self, contacts: Contacts | None) -> None:
        frame = self._frame
        if frame is None or self._skin is None:
            return
        # Contacts of a frame that was lost have no frame to go with.
        if contacts is not None and contacts.stamp_ns != frame.stamp_ns:
            return
        with self._news:
            self._number += 1
            self._latest = Latest(
                self._number, time.monotonic(), self._skin, frame, contacts
            )
            self._news.notify_all()
