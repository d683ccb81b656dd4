"""Messages of a topic as text or JSON: of an array its shape, its extent and its first elements."""

import json
import operator
import re
import sys
from typing import Any

import numpy as np

from sparseskin.messages import Contacts, Message, MessageError, Reconstruction, decode
from sparseskin.messages.base import wire_fields
from sparseskin.messages.contacts import sum_unit
from sparseskin.messages.frames import values_alone
from sparseskin.messages.quantised import Quantised
from sparseskin.messages.reasons import sentence_of
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.process.control import Document

from .stream import PATIENCE_S, Arrival, Display, Losses
from .text import flowing, formatted, width, wrapped

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
    if isinstance(value, np.generic):
        return value.item()
    if not isinstance(value, np.ndarray):
        return value
    summary: Document = {"dtype": _dtype(value), "shape": list(value.shape)}
    if full:
        return summary | {"data": value.tolist()}
    if not value.size:
        return summary | {
            "min": None,
            "mean": None,
            "max": None,
            "first": [],
        }

    # Means of whole numbers and flags are wanted, too.
    numbers = value.astype(np.float64)
    return summary | {
        "min": float(numbers.min()),
        "mean": float(numbers.mean()),
        "max": float(numbers.max()),
        "first": value.ravel()[:N_FIRST].tolist(),
    }


def text(value: Any, full: bool) -> str:
    """A field's value as text, on one line but for an array in full."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        # As JSON and launch files write them.
        return str(value).lower()
    if not isinstance(value, np.ndarray):
        return flowing(str(value))

    # Arrays: dtype and shape, then all elements or a summary.
    shape = " x ".join(map(str, value.shape))
    head = f"{_dtype(value)}, {shape}"
    if full:
        lines = np.array2string(
            value,
            threshold=sys.maxsize,
            max_line_width=width() - len(INDENT),
            precision=4,
            suppress_small=True,
        )
        return f"{head}\n{lines}"
    if not value.size:
        return head
    if value.dtype.kind == "b":
        return f"{head}: {int(value.sum())} of {value.size} true"

    begin = value.ravel()[:N_FIRST].astype(np.float64)
    elements = [f"{number:.4g}" for number in begin]
    if value.size > N_FIRST:
        elements.append("...")
    # A summary fits in one line.
    extent = "min {min:.4g}, mean {mean:.4g}, max {max:.4g}".format(
        **plain(value, False)
    )
    return f"{head}: {extent} [{' '.join(elements)}]"


def values_of(message: Message) -> Document:
    """Fields of a message; of one patch without the axis of patches."""
    if getattr(message, "names", ()):
        return message.__dict__
    return values_alone(message)


class FieldPath:
    """One field of a message, or one element of an array: "forces", "forces[12,7]".
    Raises SettingsError if the message has no such field, or the path is not of that form.
    """

    def __init__(self, path: str, cls: type[Message]) -> None:
        match = _FIELD.fullmatch(path)
        if match is None:
            raise SettingsError(f"--field {path}: expected FIELD or FIELD[I,J]")
        self._path = path
        self._name = match[1]
        self._index: tuple[int, ...] | None = None
        if match[2]:
            self._index = tuple(int(k) for k in match[2].split(","))
        if self._name not in wire_fields(cls):
            hint = did_you_mean(self._name, wire_fields(cls))
            raise SettingsError(f"--field {path}: {cls.schema} has no such field{hint}")

    def of(self, message: Message) -> Any:
        """The value in a message.
        Raises SettingsError if there is no such element.
        """
        # A message of several patches has them as its first axis.
        value: Any = values_of(message).get(self._name)
        index = self._index
        if index is None:
            return value
        shape = getattr(value, "shape", ())
        has_sides = len(shape) == len(index)
        if not has_sides or not all(map(operator.lt, index, shape)):
            sides = " x ".join(map(str, shape)) or "no array"
            raise SettingsError(f"--field {self._path}: {self._name} is {sides}")
        return value[index]


def _contact_lines(message: Contacts, unit: str) -> Document:
    """Fields of contacts as text, a line each; forces are in `unit`, "" where it is not known."""
    lines: Document = {}
    for name, value in values_of(message).items():
        if value is not None and not isinstance(value, np.ndarray):
            lines[name] = value
    for k, number in enumerate(message.id.tolist()):
        # A contact keeps its number from frame to frame.
        label = f"contact {number}"
        if message.patch_of is not None:
            label += f" of {message.names[message.patch_of[k]]}"
        lines[label] = _contact_line(message, k, unit)
    for number, event in message.named_events:
        # A touch is of no contact yet.
        label = "event"
        if number:
            label += f" of {number}"
        lines[label] = event
    return lines


def _contact_line(message: Contacts, k: int, unit: str) -> str:
    """Contact k as text."""
    # How strong, where, how large, and since when.
    force = (
        f"{message.total[k]:.4g} ± {message.total_sd[k]:.2g} {sum_unit(unit)}".rstrip()
    )
    peak = f"peak {message.peak[k]:.3g}"
    if unit:
        peak += f" {unit}"

    centre = message.centre[k]
    sd = message.centre_sd[k]
    length = "taxels"
    if message.place_mm is not None and message.place_sd_mm is not None:
        centre = message.place_mm[k]
        sd = message.place_sd_mm[k]
        length = "mm"
        if message.normal is None:
            # Of a flat skin z is 0.
            centre = centre[:2]
            sd = sd[:2]
    coordinates = []
    for x, deviation in zip(centre, sd, strict=True):
        coordinates.append(f"{x:.4g} ± {deviation:.2g}")
    place = ", ".join(coordinates)

    size = f"{message.area[k]} taxels, {message.age_s[k]:.3g} s"
    marks = [name for name in ("over", "sliding") if getattr(message, name)[k]]
    return "; ".join([force, peak, f"at ({place}) {length}", size, *marks])


def _reason_lines(message: Reconstruction) -> dict[str, str]:
    """Each reason for which patches are not trusted, as a sentence."""
    return {f"reason {word}": sentence_of(word) for word in message.reason if word}


def _dtype(value: Any) -> str:
    if isinstance(value, Quantised):
        return f"{value.dtype} of {value.bits} bits"
    return str(value.dtype)


class Echo(Display):
    """Prints messages, at most `max_hz` a second, 0: all; None: `MAX_HZ` for a person who asked
    for no number `n`. `full`: all elements of arrays; `unit`: that of forces. Contacts with an
    event are always printed.
    """

    def __init__(
        self,
        topic: str,
        field: FieldPath | None,
        *,
        n: int | None,
        max_hz: float | None,
        in_json: bool,
        full: bool,
        unit: str = "",
    ) -> None:
        if max_hz is None:
            max_hz = 0.0
            is_for_a_person = n is None and not in_json
            if is_for_a_person:
                max_hz = MAX_HZ
        self._topic = topic
        self._field = field
        self._n = n
        self._in_json = in_json
        self._full = full
        self._unit = unit
        self._period_ns = 0
        if max_hz:
            self._period_ns = round(1e9 / max_hz)
        # A message that is to be shown must not wait longer than the next one is due.
        if self._period_ns:
            self.patience_s = min(PATIENCE_S, self._period_ns / 1e9)
        self._losses = Losses()
        self._has_events = topic.endswith(f"/{Contacts.schema}")
        self._due_ns = 0
        self._shown = 0
        self._skipped = 0
        self._skipped_since = 0

    def take(self, arrival: Arrival) -> bool:
        """Print a message; False if it is not shown."""
        # Counted before anything is left out on purpose.
        self._losses.add(arrival)
        if arrival.ends:
            return False
        # Stamps go back where a recording is played again.
        begin_ns = self._due_ns - self._period_ns
        is_early = begin_ns <= arrival.stamp_ns < self._due_ns
        # Not decoded: of a fast topic most messages are not shown.
        if is_early and not self._has_events:
            return self._skip()
        try:
            message = decode(arrival.topic, arrival.payload)
        except MessageError as error:
            print(f"{self._topic}: {printable(str(error))}", file=sys.stderr)
            return False
        if is_early and getattr(message, "events", None) is None:
            return self._skip()

        # By stamps, so that a burst of late messages is thinned out, too.
        self._due_ns = arrival.stamp_ns + self._period_ns
        print(self.text(message), flush=True)
        self._shown += 1
        self._skipped_since = 0
        return True

    def _skip(self) -> bool:
        self._skipped += 1
        self._skipped_since += 1
        return False

    def finish(self) -> None:
        """Print how many messages were shown, where no number was asked for."""
        if self._n is None:
            counts = f"{self._shown} shown, {self._skipped} not shown"
            print(f"{self._topic}: {counts}, {self._losses.n} lost", file=sys.stderr)

    def text(self, message: Message) -> str:
        """A message as it is printed."""
        full = self._full
        if self._field is not None:
            value = self._field.of(message)
            if self._in_json:
                return json.dumps(plain(value, full))
            return text(value, full)

        values = values_of(message)
        if self._in_json:
            document = {name: plain(value, full) for name, value in values.items()}
            return json.dumps(
                formatted("topic-echo", {"topic": message.topic, **document})
            )
        if isinstance(message, Contacts) and not full:
            values = _contact_lines(message, self._unit)
        if isinstance(message, Reconstruction):
            values = values | _reason_lines(message)

        # A line between messages, as YAML has it.
        rule = "---"
        if self._skipped_since:
            rule += f" ({self._skipped_since} not shown)"
        lines = [rule]
        for name, value in values.items():
            value_lines = text(value, full).split("\n")
            lines += wrapped(f"{name}: ", value_lines[0], INDENT)
            lines += [INDENT + line for line in value_lines[1:]]
        return "\n".join(lines)
