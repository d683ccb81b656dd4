"""What every node is: settings in, messages in, messages out. No socket, no thread, no clock
of its own, so that the same code runs in a process, in one program, in a test and in a study.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

from sparseskin.messages import Message

from .clock import Clock
from .clock_offset import SAME_CLOCK, ClockEstimate
from .errors import RefusedError
from .lookup import did_you_mean
from .settings import Settings

S = TypeVar("S", bound=Settings)


@dataclass(frozen=True)
class Context:
    """What a node is given by whoever runs it.

    Attributes
    ----------
    name : str
        The node's name in its graph.
    clock : Clock
        The graph's clock.
    log : callable
        Takes one line of text for whoever watches the graph.
    ask : callable or None
        Takes a request to a node of the graph, {id, node, command, value}, for the launcher to
        pass on; the answer comes as a command "answer". None where no launcher is, so where
        nobody can sit at the controls.
    late : bool
        Whether the node joins a graph that already runs.
    clock_of : callable
        Takes a topic that the node reads; tells how far the clock of the host that writes it is
        ahead of `clock`, None while that is not known.
    """

    name: str
    clock: Clock
    log: Callable[[str], None] = field(default=lambda line: None)
    ask: Callable[[dict[str, Any]], None] | None = None
    late: bool = False
    clock_of: Callable[[str], ClockEstimate | None] = field(default=lambda topic: SAME_CLOCK)

    def rng(self, seed: int) -> np.random.Generator:
        """A random generator for a stated seed: the same numbers wherever the node runs."""
        return np.random.default_rng(seed)


@dataclass(frozen=True)
class Tick:
    """The moment at which a source is to acquire its next frame."""

    stamp_ns: int
    index: int


class Node(Generic[S]):
    """A station: consumes messages of its input topics, makes messages of its output topics.

    A subclass names its `Settings`, its `inputs` and `outputs`, and implements `step`.
    """

    Settings: ClassVar[type[Any]] = Settings
    required: ClassVar[bool] = True
    """Whether the graph ends when this node fails."""
    watches: ClassVar[bool] = False
    """Whether the launcher tells the node how all nodes are, as a command "graph"."""
    patience_s: ClassVar[float] = 0.0
    """How long its messages may wait, so that those that come together are taken in together."""
    commands: ClassVar[Mapping[str, str]] = {}
    """What the node can be told to do, and what each means."""
    verbatim: bool = False
    """Whether what the node publishes keeps the run id and number it already has."""

    def __init__(self, settings: S, context: Context) -> None:
        self.settings = settings
        self.context = context

    @property
    def depth(self) -> int:
        """How many messages of each stream may wait for the node before older ones are skipped,
        and counted; 0: none is ever skipped.
        """
        return 0

    @classmethod
    def inputs(cls, settings: S) -> tuple[str, ...]:
        """Topics that the node reads; "*" in one stands for any text."""
        return ()

    @classmethod
    def optional_inputs(cls, settings: S) -> tuple[str, ...]:
        """Topics that the node reads where some node writes them."""
        return ()

    @classmethod
    def outputs(cls, settings: S) -> tuple[str, ...]:
        """Topics that the node writes; its stream ends with an End on each."""
        return ()

    @classmethod
    def values_again(cls, settings: S, n_restarts: int) -> dict[str, Any]:
        """Settings that differ where the node is started again after its n-th failure."""
        return {}

    def start(self) -> Iterable[Message]:
        """Messages to publish before the first step: what is known of the node by then."""
        return ()

    def step(self, message: Message) -> Iterable[Message]:
        """Take one message in, give any number out, each published as soon as it is given.

        Raises
        ------
        RefusedError
            If the node cannot use the message: it is counted and the node goes on.
        """
        raise NotImplementedError

    def overtaken(self, message: Message) -> None:
        """A message was skipped, as more newer ones than `depth` waited behind it."""

    def ended(self, topic: str, n_messages: int) -> Iterable[Message]:
        """One input topic has ended after `n_messages` were sent on it."""
        return ()

    def idle(self) -> None:
        """Called between messages, at least every 100 ms."""

    def close(self, counts: dict[str, Any]) -> None:
        """The last call: finish files and devices; `counts` is what the node's host counted."""

    def change(self, settings: S) -> Iterable[Message]:
        """Take changed settings between two frames, all or none of them.

        Raises
        ------
        SparseskinError
            If the node cannot work with them; it goes on with those it has.
        """
        self.settings = settings
        return ()

    def command(self, name: str, value: Any) -> str:
        """Take a command from whoever launched the node; return what was done.

        Raises
        ------
        RefusedError
            If the node knows no such command, or cannot do it.
        """
        raise RefusedError(
            f"{self.context.name}: knows no command '{name}'{did_you_mean(name, self.commands)}"
        )

    def state(self) -> dict[str, Any]:
        """What a person at the controls has to see: paused or not, the rate, the position."""
        return {}

    def status(self) -> str:
        """One line for a person who watches; "" where there is nothing to say."""
        return ""

    def report(self) -> dict[str, Any]:
        """What the node has found, once its inputs have ended."""
        return {}


class SourceNode(Node[S]):
    """A node without inputs, driven by ticks."""

    rate_hz: float = 0.0
    """Ticks a second; 0: as fast as the readers are done with them."""
    window: int = 32
    """How many ticks may be under way, unanswered, where the source follows its readers."""
    min_readers: int = 0
    """How many readers there must be before the first tick."""
    exhausted: bool = False
    """Whether the last frame has been delivered."""
    commands: ClassVar[Mapping[str, str]] = {
        "pause": "acquire no frame until told to go on: true, false, or the other of the two"
    }
    _t0_ns: int = 0
    _n_ticks: int = 0
    _paused: bool = False

    @property
    def follows_readers(self) -> bool:
        """Whether the readers set the pace, not the clock."""
        return self.rate_hz == 0.0

    @property
    def paused(self) -> bool:
        """Whether the source waits to be told to go on."""
        return self._paused

    def begin(self, now_ns: int) -> None:
        """The graph starts now: the first tick is one period away."""
        self._t0_ns = now_ns
        self._n_ticks = 0

    def next_tick_ns(self) -> int | None:
        """When the next tick is due, on the graph's clock; None: not before a command comes."""
        if self.paused:
            return None
        if not self.rate_hz:
            return 0
        # An absolute target: an error of one tick is not carried into the next.
        return self._t0_ns + round((self._n_ticks + 1) * 1e9 / self.rate_hz)

    def command(self, name: str, value: Any) -> str:
        if name != "pause":
            return super().command(name, value)
        pause = not self.paused if value is None else value
        if not isinstance(pause, bool):
            raise RefusedError(f"pause: {value!r} is not allowed (allowed: true, false)")
        if pause != self.paused:
            self.pause(pause)
        return "paused" if pause else "runs"

    def pause(self, paused: bool) -> None:
        """Pause, or go on at the same rate from now."""
        self._paused = paused
        self.begin(self.context.clock.now_ns())

    def state(self) -> dict[str, Any]:
        return {"paused": self.paused}

    def acquire(self, tick: Tick) -> Iterable[Message]:
        """Count a tick and take it."""
        self._n_ticks += 1
        return self.tick(tick)

    def tick(self, tick: Tick) -> Iterable[Message]:
        """Acquire one frame and give its messages; set `exhausted` with the last one."""
        raise NotImplementedError
