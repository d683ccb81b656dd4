"""A node with the bookkeeping that every node needs.

Published messages are numbered; gaps, repeats and refusals of received ones are counted; the end
of a stream is passed on.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from sparseskin.messages import End, Message, MessageError, decode
from sparseskin.messages.topics import split_topic
from sparseskin.messages.wire import SCHEMAS, Payload

from .errors import RefusedError, SparseskinError
from .lookup import one_line
from .node import Node, SourceNode, Tick
from .process.control import COUNTED

Log = Callable[[str], None]


def is_latched(topic: str) -> bool:
    """True if a topic carries state rather than a stream."""
    return SCHEMAS[split_topic(topic)[1]].latched


@dataclass
class TopicCount:
    """Counters of the messages of a topic, over all runs of its publisher: `n_of_earlier_runs`, and
    `expected`, the next number in its present run. A `late` reader counts from its first message.
    """

    late: bool = False
    run_id: str = ""
    n_of_earlier_runs: int = 0
    expected: int = 0
    received: int = 0
    lost: int = 0
    skipped: int = 0
    ended: bool = False

    @property
    def total(self) -> int:
        """Number of messages sent, as far as it is known."""
        return self.n_of_earlier_runs + self.expected

    def admit(self, message: Message) -> bool:
        """Count a message; False for one received before (a latched topic repeats)."""
        self._enter(message.run_id)
        # What was sent before a late reader came is neither sent to it nor lost.
        if self.late and not self.received:
            self.n_of_earlier_runs = -message.seq
            self.expected = message.seq
        if message.seq < self.expected:
            return False

        # Of a state only the last one holds: a gap is no loss.
        if not message.latched:
            self.lost += message.seq - self.expected
        self.received += 1
        self.expected = message.seq + 1
        return True

    def end(self, run_id: str, n_messages: int) -> None:
        """Count the messages missing at the end of the stream, as its publisher counted them."""
        self._enter(run_id)
        # A late reader of nothing came after the last message.
        if self.received or not self.late:
            self.lost += max(0, n_messages - self.expected)
        self.expected = max(self.expected, n_messages)
        self.ended = True

    def _enter(self, run_id: str) -> None:
        if run_id != self.run_id:
            self.n_of_earlier_runs += self.expected
            self.run_id = run_id
            self.expected = 0
            self.ended = False


@dataclass
class Counts:
    """All counters of a node; `refused` by reason; `errors` that it raised at messages."""

    inputs: dict[str, TopicCount] = field(default_factory=dict)
    published: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    errors: int = 0

    def as_dict(self) -> dict[str, Any]:
        """Counters as plain data, for status lines and summaries."""
        counts: dict[str, Any] = {}
        for name in COUNTED:
            counts[name] = {}
            for topic, count in self.inputs.items():
                counts[name][topic] = getattr(count, name)
        counts["published"] = dict(self.published)
        counts["refused"] = dict(self.refused)
        if self.errors:
            counts["errors"] = self.errors
        return counts


class NodeHost:
    """Runs a node's logic, independent of the transport. `run_id`, 16 hex digits, is new for each
    run of the node; its `inputs` are by default those that it states.

    Of a node that joins a running graph (`late`), and of `late_inputs`, such as those of another
    host, messages before the first are not lost.
    """

    def __init__(
        self,
        node: Node[Any],
        run_id: str,
        log: Log,
        inputs: Iterable[str] | None = None,
        late: bool = False,
        late_inputs: Collection[str] = (),
    ) -> None:
        if inputs is None:
            inputs = node.inputs(node.settings)
        self.node = node
        self.is_source = isinstance(node, SourceNode)
        # Most nodes have nothing to do between messages, and are not asked.
        self._works_between = type(node).idle is not Node.idle
        self.run_id = run_id
        self.inputs = tuple(inputs)
        self.outputs = node.outputs(node.settings)
        self.counts = Counts()
        for topic in self.inputs:
            self.counts.inputs[topic] = TopicCount(late or topic in late_inputs)
        self.streams = [topic for topic in self.inputs if not is_latched(topic)]

        # Set by who runs the host: called with an error to log, and with each message's number.
        self.raised: Callable[[Exception], None] = lambda error: None
        self.published: Callable[[str, int], None] = lambda topic, n: None
        self.finished = False
        self.ends: list[End] = []
        self.failure = ""
        self.refusal = ""
        self._log = log
        self._last_stamp_ns = 0

    def start(self) -> Iterator[Message]:
        """Messages of the node before its first step."""
        return map(self._numbered, self.node.start())

    def tick(self, tick: Tick) -> Iterator[Message]:
        """Let a source acquire one frame; a source that fails ends its stream."""
        assert isinstance(self.node, SourceNode)
        try:
            for message in self.node.acquire(tick):
                yield self._numbered(message)
        except SparseskinError as error:
            self.failure = str(error)
            self._log(f"error: {error}")
            self.raised(error)
        if self.node.exhausted or self.failure:
            yield from self.finish(tick.stamp_ns)

    def receive_bytes(
        self, topic: bytes, payload: Payload, overtaken: bool = False
    ) -> Iterable[Message]:
        """Decode and process one message; one that cannot be decoded is counted.

        An overtaken one is counted and skipped, unless it ends its stream. The node works while
        what follows is iterated over.
        """
        try:
            message = decode(topic, payload)
        except MessageError as error:
            self._refuse(error.reason, str(error))
            return ()
        return self.receive(message, overtaken)

    def receive(self, message: Message, overtaken: bool = False) -> Iterable[Message]:
        """Process one message; one that the node refuses is counted, and the node continues."""
        topic = message.topic
        count = self.counts.inputs.get(topic)
        if count is None:
            self._refuse("unknown topic", f"{topic}: not an input of this node")
            return ()

        # Stamps of several patches come in any order; the End has the last of all.
        self._last_stamp_ns = max(self._last_stamp_ns, message.stamp_ns)
        if isinstance(message, End):
            # It is sent again, for readers that have missed it.
            if count.ended:
                return ()
            return self._end(count, message)
        if not count.admit(message):
            return ()

        if overtaken:
            count.skipped += 1
            self.node.overtaken(message)
            return ()
        return self._guarded(self.node.step, message)

    def _end(self, count: TopicCount, end: End) -> Iterator[Message]:
        """Process the end of an input."""
        count.end(end.run_id, end.n_messages)
        yield from self._guarded(self.node.ended, end.topic, end.n_messages)
        # States have no end.
        inputs = self.counts.inputs
        if all(inputs[topic].ended for topic in self.streams):
            yield from self.finish(self._last_stamp_ns)

    def change(self, changes: Mapping[str, Any]) -> list[Message]:
        """Change settings between two frames, or raise SparseskinError; return what follows."""
        # Not guarded: whoever asked for the change reads the error.
        settings = self.node.settings.changed(changes)
        messages = self.node.change(settings)
        return [self._numbered(message) for message in messages]

    def finish(self, stamp_ns: int) -> Iterator[Message]:
        """End the stream: one End on each output topic, once."""
        if self.finished:
            return
        self.finished = True
        self.ends = list(self._ends(stamp_ns))
        yield from self.ends

    def finish_frames(self, stamp_ns: int) -> Iterator[Message]:
        """End the stream of a source after all messages of the frames it has acquired."""
        if isinstance(self.node, SourceNode) and not self.finished:
            yield from self._guarded(self.node.rest)
        yield from self.finish(stamp_ns)

    def _ends(self, stamp_ns: int) -> Iterator[End]:
        for topic in self.outputs:
            # A state remains valid after the end of the stream.
            if is_latched(topic):
                continue
            patch, schema = split_topic(topic)
            n = self.counts.published[topic]
            yield End(
                stamp_ns=stamp_ns,
                patch=patch,
                run_id=self.run_id,
                seq=n,
                of=schema,
                n_messages=n,
            )

    def idle(self) -> None:
        """Let the node do its periodic work."""
        if self._works_between:
            self._do(self.node.idle)

    def close(self) -> None:
        """Let the node finish its files and devices."""
        counts = self.counts.as_dict()
        self._do(lambda: self.node.close(counts))

    def _do(self, action: Callable[[], None]) -> None:
        try:
            action()
        except SparseskinError as error:
            self.failure = self.failure or str(error)
            self._refuse("failed", str(error))

    def _guarded(
        self, method: Callable[..., Iterable[Message]], *args: Any
    ) -> Iterator[Message]:
        """Publish what a method yields; an exception is counted and ends no node."""
        try:
            for message in method(*args):
                yield self._numbered(message)
        except RefusedError as error:
            self._refuse("refused", str(error))
        except MessageError as error:
            self._refuse(error.reason, f"not published: {error}")
            self._count_error(error)
        # The node cannot do what its settings ask for; no later message changes that.
        except SparseskinError as error:
            self.failure = self.failure or str(error)
            self._refuse("failed", str(error))
        # A user's own solver may raise anything.
        except Exception as error:
            self._refuse("failed", one_line(error))
            self._count_error(error)

    def _numbered(self, message: Message) -> Message:
        """Count a message that the node publishes, and give it its number."""
        # Before it is sent: should this process be killed, none was sent that is not counted.
        topic = message.topic
        seq = self.counts.published[topic]
        self.counts.published[topic] = seq + 1
        self.published(topic, seq + 1)
        return message.published(self.run_id, seq)

    def _count_error(self, error: Exception) -> None:
        self.counts.errors += 1
        if is_due(self.counts.errors):
            self.raised(error)

    def _refuse(self, reason: str, text: str) -> None:
        """Count a refusal and log some of them."""
        self.counts.refused[reason] += 1
        self.refusal = f"{reason}: {text}"
        log_some(self._log, self.refusal, self.counts.refused[reason])


def is_due(times: int) -> bool:
    """True the 1st, 10th, 100th ... time."""
    return str(times).strip("0") == "1"


def log_some(log: Log, line: str, times: int) -> None:
    """Log a repeated line the 1st, 10th, 100th ... time, so that a flood stays readable."""
    if not is_due(times):
        return
    if times > 1:
        line += f" ({times} times)"
    log(line)
