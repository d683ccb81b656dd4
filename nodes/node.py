"""Base of all nodes: settings in, messages in, messages out.

A node has no socket, thread or clock of its own, so that the same code runs in a process of its
own, within one program, in a test and in a study.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

from sparseskin.messages import Message

from .clock import SAME_CLOCK, Clock, ClockEstimate
from .errors import RefusedError
from .lookup import did_you_mean
from .settings import Settings

S = TypeVar("S", bound=Settings)


@dataclass(frozen=True)
class Context:
    """Environment of a node, passed by its runner."""

    name: str
    clock: Clock
    log: Callable[[str], None] = field(default=lambda line: None)
    """Receives one line of text for the graph's log."""
    ask: Callable[[dict[str, Any]], None] | None = None
    """Receives a request to a node of the graph, {id, node, command, value}, that the launcher
    passes on; the answer arrives as a command "answer". None without a launcher."""
    late: bool = False
    """True if the node joins a running graph."""
    clock_of: Callable[[str], ClockEstimate | None] = field(
        default=lambda topic: SAME_CLOCK
    )
    """Clock of the host of an input topic's writer against `clock`; None while not known."""
    page_token: str = ""
    """Random text, the same for one run of a graph, that its live pages ask for."""
    page_file: str = ""
    """Where a page that opens a live page may be written, which no other user reads; "": none."""
    count: Callable[[int, int], None] = field(default=lambda done, of: None)
    """Receives how many parts of a long start are done, and of how many."""
    live: bool = True
    """False where frames wait until the nodes are done with those before, as in a `Bus`."""

    def rng(self, seed: int) -> np.random.Generator:
        """Random generator of a seed: the same numbers wherever the node runs."""
        # Not the global generator: another node of the same process may use that.
        return np.random.default_rng(seed)


@dataclass(frozen=True)
class Tick:
    """Time and number of a frame that a source is to acquire."""

    stamp_ns: int
    index: int


class Node(Generic[S]):
    """A node: reads messages of its input topics, returns messages of its output topics.

    A subclass states its `Settings`, `inputs` and `outputs`, and implements `step`.
    """

    Settings: ClassVar[type[Any]] = Settings
    required: ClassVar[bool] = True
    """True if the graph ends when this node fails."""
    watches: ClassVar[bool] = False
    """True if the state of all nodes is sent, again and again, as a command "graph"."""
    observes: ClassVar[bool] = False
    """True if no source waits until this node has processed its frames."""
    patience_s: ClassVar[float] = 0.0
    """Time for which messages may wait, seconds, so that those of one frame are read together."""
    commands: ClassVar[Mapping[str, str]] = {}
    """Commands of the node, and the meaning of each."""

    def __init__(self, settings: S, context: Context) -> None:
        self.settings = settings
        self.context = context

    @property
    def depth(self) -> int:
        """Most messages of a stream that may wait, older ones being skipped; 0: none is."""
        return 0

    @classmethod
    def inputs(cls, settings: S) -> tuple[str, ...]:
        """Topics that the node reads; "*" matches any text."""
        return ()

    @classmethod
    def optional_inputs(cls, settings: S) -> tuple[str, ...]:
        """Topics that the node reads if some node writes them."""
        return ()

    @classmethod
    def outputs(cls, settings: S) -> tuple[str, ...]:
        """Topics that the node writes; its stream ends with an End on each."""
        return ()

    @classmethod
    def facts(cls, settings: S) -> Mapping[str, Any]:
        """What the settings alone state of output topics: of a skin its number of taxels, of a
        Phi its kind, of measurements a function that returns their number M for N taxels.
        """
        return {}

    @classmethod
    def check_inputs(cls, settings: S, facts: Mapping[str, Any]) -> None:
        """Raise SparseskinError if a setting contradicts the facts of the topics of the graph."""

    @classmethod
    def values_again(cls, settings: S, n_restarts: int) -> dict[str, Any]:
        """Settings to change when the node is restarted after its n-th failure."""
        return {}

    @classmethod
    def left_behind(cls, settings: S) -> str:
        """What a process that was killed has left, in words; "" for nothing."""
        return ""

    @classmethod
    def totals(
        cls, settings: S, report: Mapping[str, Any], counts: Iterable[Any], again: bool
    ) -> dict[str, Any]:
        """What the counters of all nodes, over all their runs, correct in the report of the node,
        in a graph in which nodes were restarted; `again`: this one was.
        """
        return {}

    @property
    def unused(self) -> tuple[str, ...]:
        """Outputs on which it publishes nothing, which only the node itself knows."""
        return ()

    def start(self) -> Iterable[Message]:
        """Messages to publish before the first step."""
        return ()

    def step(self, message: Message) -> Iterable[Message]:
        """Process one message; each message yielded is published at once.

        RefusedError if the node cannot use the message: it is counted, and the node continues.
        """
        raise NotImplementedError

    def overtaken(self, message: Message) -> None:
        """Note a message that was skipped because `depth` newer ones waited."""

    def ended(self, topic: str, n_messages: int) -> Iterable[Message]:
        """Process the end of an input topic on which `n_messages` were sent."""
        return ()

    def idle(self) -> None:
        """Do periodic work: called between messages, at least every 100 ms."""

    def close(self, counts: dict[str, Any]) -> None:
        """Finish files and devices; the last call. `counts` are those of the node's host."""

    def change(self, settings: S) -> Iterable[Message]:
        """Change settings between two frames; on SparseskinError the node keeps the old ones."""
        # A node that computes something of its settings does that first, and may fail.
        self.settings = settings
        return ()

    def command(self, name: str, value: Any) -> str:
        """Execute a command and describe the result, or raise RefusedError."""
        raise RefusedError(
            f"{self.context.name}: knows no command '{name}'{did_you_mean(name, self.commands)}"
        )

    def state(self) -> dict[str, Any]:
        """State for the operator: paused or not, rate, position."""
        return {}

    def status(self) -> str:
        """One line of status, or ""."""
        return ""

    def report(self) -> dict[str, Any]:
        """Results of the node, after its inputs have ended."""
        return {}


RATE_S = 2.0
"""Time after which the rate reached is compared with the one asked, in seconds; chosen, so that a
short delay at the start is made up for before."""
KEPT_RATE = 0.9
"""Share of the rate asked below which the sensor logs a warning."""


class SourceNode(Node[S]):
    """A node without inputs, driven by ticks."""

    rate_hz: float = 0.0
    """Ticks per second; 0: as fast as the readers process them."""
    window: int = 32
    """Largest number of unanswered ticks where the source follows its readers."""
    min_readers: int = 0
    """Number of readers to wait for before the first tick."""
    exhausted: bool = False
    """True if the last frame has been delivered."""
    acquired: bool = True
    """False if the last tick found no frame: it is not counted as one."""
    commands: ClassVar[Mapping[str, str]] = {
        "pause": "stop acquiring frames: true, false, or toggle"
    }
    _t0_ns: int = 0
    _n_ticks: int = 0
    _missed_hz: float = 0.0
    _paused: bool = False

    @property
    def follows_readers(self) -> bool:
        """True if the readers set the pace, not the clock."""
        return self.rate_hz == 0.0

    @property
    def paused(self) -> bool:
        """True if the source acquires no frames until it is resumed."""
        return self._paused

    def begin(self, now_ns: int) -> None:
        """Start the schedule now: the first tick is due after one period."""
        self._t0_ns = now_ns
        self._n_ticks = 0

    def _watch_rate(self, now_ns: int) -> None:
        """Log, once for each rate, that frames are acquired more slowly than asked."""
        passed_s = (now_ns - self._t0_ns) / 1e9
        is_logged = self.rate_hz == self._missed_hz
        if not self._t0_ns or passed_s < RATE_S or is_logged:
            return
        # Of the mean since the schedule began: one slow frame is made up for.
        reached_hz = self._n_ticks / passed_s
        if reached_hz < KEPT_RATE * self.rate_hz:
            self._missed_hz = self.rate_hz
            self.context.log(f"{self.rate_hz:g} Hz asked, {reached_hz:.1f} Hz reached")

    def next_tick_ns(self) -> int | None:
        """Time of the next tick on the graph's clock; None while paused."""
        if self.paused:
            return None
        # Always due: `window` and the readers set the pace.
        if not self.rate_hz:
            return 0
        # An absolute target: the error of one tick does not add to the next.
        elapsed_ns = (self._n_ticks + 1) * 1e9 / self.rate_hz
        return self._t0_ns + round(elapsed_ns)

    def command(self, name: str, value: Any) -> str:
        if name != "pause":
            return super().command(name, value)
        # Without a value it toggles.
        pause = value
        if value is None:
            pause = not self.paused
        if not isinstance(pause, bool):
            raise RefusedError(
                f"pause: {value!r} is not allowed (allowed: true, false)"
            )
        # Once more would begin the schedule anew.
        if pause != self.paused:
            self.pause(pause)
        return "paused" if pause else "runs"

    def pause(self, paused: bool) -> None:
        """Pause, or resume at the same rate from now."""
        # A schedule from before the pause would make up for its ticks.
        self._paused = paused
        self.begin(self.context.clock.now_ns())

    def state(self) -> dict[str, Any]:
        return {"paused": self.paused}

    def acquire(self, tick: Tick) -> Iterable[Message]:
        """Count a tick and execute it."""
        # Before the tick, which may raise: its time has passed.
        self._n_ticks += 1
        return self.tick(tick)

    def tick(self, tick: Tick) -> Iterable[Message]:
        """Acquire one frame and return its messages; set `exhausted` with the last one."""
        raise NotImplementedError

    def rest(self) -> Iterable[Message]:
        """Messages of the frames acquired so far that are still to come, where a source is ended
        after a number of frames.
        """
        return ()
