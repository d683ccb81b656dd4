"""Messages of a topic as text or JSON: of an array its shape, its extent and its first elements."""

from __future__ import annotations

import json
import re
import sys
from typing import Any

import numpy as np

from sparseskin.launch.run.running import RunningGraph
from sparseskin.messages import Message, MessageError, decode
from sparseskin.messages.base import wire_fields
from sparseskin.messages.quantised import Quantised
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import did_you_mean

from .formats import formatted
from .stream import EXIT_NOTHING, PATIENCE_S, Losses, TopicStream, quiet_reason
from .text import flowing, width, wrapped

INDENT = "    "
"""Start of the further lines of a field."""
N_FIRST = 6
"""Number of elements of an array in its summary."""
MAX_HZ = 10.0
"""Messages a second that are printed for a person by default."""
_FIELD = re.compile(r"(\w+)(?:\[(\d{1,7}(?:,\d{1,7})*)\])?")


def plain(value: Any, full: bool) -> Any:
    """A field's value for JSON; an array as a map of its dtype, its shape and `data` in full, else
    min, mean, max and the first elements.
    """
    if not isinstance(value, np.ndarray):
        return value.item() if isinstance(value, np.generic) else value
    summary: dict[str, Any] = {"dtype": _dtype(value), "shape": list(value.shape)}
    if full:
        return summary | {"data": value.tolist()}
    numbers = value.astype(np.float64)
    summary |= {"min": float(numbers.min()), "mean": float(numbers.mean())}
    return summary | {"max": float(numbers.max()), "first": value.ravel()[:N_FIRST].tolist()}


def text(value: Any, full: bool) -> str:
    """A field's value as text, on one line but for an array in full."""
    if value is None or isinstance(value, bool):
        return {None: "none", True: "true", False: "false"}[value]
    if not isinstance(value, np.ndarray):
        return flowing(str(value))
    shape = " x ".join(map(str, value.shape))
    if full:
        lines = np.array2string(
            value,
            threshold=sys.maxsize,
            max_line_width=width() - len(INDENT),
            precision=4,
            suppress_small=True,
        )
        return f"{_dtype(value)}, {shape}\n{lines}"
    if value.dtype.kind == "b":
        return f"{_dtype(value)}, {shape}: {int(value.sum())} of {value.size} true"
    numbers = value.astype(np.float64)
    first = " ".join(f"{number:.4g}" for number in numbers.ravel()[:N_FIRST])
    more = " ..." if value.size > N_FIRST else ""
    return (
        f"{_dtype(value)}, {shape}: min {numbers.min():.4g}, mean {numbers.mean():.4g}, "
        f"max {numbers.max():.4g} [{first}{more}]"
    )


class FieldPath:
    """One field of a message, or one element of an array: "forces", "forces[12,7]".
    Raises SettingsError if the message has no such field, or the path is not of that form.
    """

    def __init__(self, path: str, cls: type[Message]) -> None:
        match = _FIELD.fullmatch(path)
        if match is None:
            raise SettingsError(f"--field {path}: expected FIELD or FIELD[I,J]")
        self._path, self._name = path, match[1]
        self._index = tuple(int(k) for k in match[2].split(",")) if match[2] else None
        if self._name not in wire_fields(cls):
            hint = did_you_mean(self._name, wire_fields(cls))
            raise SettingsError(f"--field {path}: {cls.schema} has no such field{hint}")

    def of(self, message: Message) -> Any:
        """The value in a message.
        Raises SettingsError if there is no such element.
        """
        value = getattr(message, self._name)
        if self._index is None:
            return value
        shape = getattr(value, "shape", ())
        inside = len(shape) == len(self._index) and all(
            k < side for k, side in zip(self._index, shape, strict=True)
        )
        if not inside:
            sides = " x ".join(map(str, shape)) or "no array"
            raise SettingsError(f"--field {self._path}: {self._name} is {sides}")
        return value[self._index]


def _dtype(value: Any) -> str:
    bits = f" of {value.bits} bits" if isinstance(value, Quantised) else ""
    return f"{value.dtype}{bits}"


class _Printer:
    """Prints messages, at most `max_hz` a second; 0: all."""

    def __init__(self, max_hz: float, field: FieldPath | None, in_json: bool, full: bool) -> None:
        self._period_ns = round(1e9 / max_hz) if max_hz else 0
        self.patience_s = min(PATIENCE_S, self._period_ns / 1e9 or PATIENCE_S)
        self._field, self._in_json, self._full = field, in_json, full
        self._due_ns = 0
        self.shown = self.skipped = 0
        self._skipped_since = 0

    def wants(self, stamp_ns: int) -> bool:
        """True if a message of that stamp is printed; it is counted otherwise."""
        # Stamps go back where a recording is played again.
        if not self._due_ns - self._period_ns <= stamp_ns < self._due_ns:
            self._due_ns = stamp_ns + self._period_ns
            return True
        self.skipped += 1
        self._skipped_since += 1
        return False

    def print(self, message: Message) -> None:
        names = list(wire_fields(type(message)))
        if self._in_json and self._field is not None:
            line = json.dumps(plain(self._field.of(message), self._full))
        elif self._in_json:
            values = {name: plain(getattr(message, name), self._full) for name in names}
            line = json.dumps(formatted("topic-echo", {"topic": message.topic, **values}))
        elif self._field is not None:
            line = text(self._field.of(message), self._full)
        else:
            more = f" ({self._skipped_since} not shown)" if self._skipped_since else ""
            rows = [f"---{more}"]
            for name in names:
                first, *rest = text(getattr(message, name), self._full).split("\n")
                rows += [*wrapped(f"{name}: ", first, INDENT), *(INDENT + one for one in rest)]
            line = "\n".join(rows)
        print(line, flush=True)
        self.shown += 1
        self._skipped_since = 0


def echo(
    graph: RunningGraph,
    topic: str,
    *,
    n: int | None,
    duration_s: float | None,
    max_hz: float | None,
    field: FieldPath | None,
    in_json: bool,
    full: bool,
) -> int:
    """Print the messages of a topic until `n` are printed, `duration_s` seconds are over or its
    stream ends; return the exit code. `max_hz` messages a second at most; 0: all; None: `MAX_HZ`
    for a person who asked for no number. `full`: all elements of arrays.
    """
    if max_hz is None:
        max_hz = 0.0 if in_json or n is not None else MAX_HZ
    printer, losses = _Printer(max_hz, field, in_json, full), Losses()
    ended = False
    with TopicStream(graph, topic, printer.patience_s if n is None else 0.0) as stream:
        for arrival in stream.arrivals(duration_s):
            losses.add(arrival)
            ended = arrival.ends
            if not ended and printer.wants(arrival.stamp_ns):
                try:
                    printer.print(decode(arrival.topic, arrival.payload))
                except MessageError as error:
                    print(f"{topic}: {printable(str(error))}", file=sys.stderr)
            if ended or printer.shown == n:
                break
    if ended:
        print(f"{topic}: the stream has ended", file=sys.stderr)
    if not printer.shown:
        print(f"{topic}: no message came{quiet_reason(graph, topic)}", file=sys.stderr)
        return EXIT_NOTHING
    if n is None:
        counts = f"{printer.shown} shown, {printer.skipped} not shown, {losses.n} lost"
        print(f"{topic}: {counts}", file=sys.stderr)
    return 0
