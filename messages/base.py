"""Fields and methods that every message has."""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Self, TypeVar, cast

import numpy as np

from .fields import Array, FieldKind, Integer, Text, wire
from .topics import MAX_NAME, NAME_PATTERN, topic_of

Made = TypeVar("Made")


@dataclass(frozen=True, kw_only=True, eq=False)
class Message:
    """A typed, immutable message; its fields are checked when it is made. Raises MessageError if
    one has the wrong type, shape or range; the subclass names the reason.
    """

    schema: ClassVar[str]
    version: ClassVar[int] = 1
    latched: ClassVar[bool] = False
    """True if a late subscriber receives the last one: a state rather than a stream."""
    times: ClassVar[tuple[str, ...]] = ("stamp_ns",)
    """Fields that are times on the graph's clock."""

    stamp_ns: int = wire(Integer())
    """Time of the acquisition (not of sending) on the graph's clock, nanoseconds. It names the
    frame: all messages that descend from one frame carry its stamp."""
    patch: str = wire(Text(MAX_NAME, NAME_PATTERN))
    run_id: str = wire(Text(16, r"([0-9a-f]{16})?"), default="")
    """16 hex digits, drawn when the publisher starts; "" until it is published."""
    seq: int = wire(Integer(), default=0)
    """0, 1, 2, ... of a publisher run and topic; a gap is a loss."""

    def __post_init__(self) -> None:
        # The dataclass is frozen: values in canonical form go to its dictionary.
        values = self.__dict__
        for name, kind in wire_fields(type(self)).items():
            values[name] = kind.check(name, values[name])
        # Last: it relies on the type of each field.
        self.validate()

    def validate(self) -> None:
        """Check fields that depend on each other; MessageError if they contradict each other."""

    @classmethod
    def assembled(cls, values: dict[str, Any]) -> Self:
        """Message of fields that were checked one by one, as by `decode`."""
        # Without `__init__`, which would check each field once more.
        message = object.__new__(cls)
        message.__dict__.update(values)
        message.validate()
        return message

    @property
    def topic(self) -> str:
        """Topic of the message."""
        return topic_of(self.patch, self.schema)

    def published(self, run_id: str, seq: int) -> Self:
        """Copy with the run id and sequence number of its publisher."""
        return self._copy(run_id=run_id, seq=seq)

    def moved(self, by_ns: int) -> Self:
        """Copy `by_ns` nanoseconds later: its stamp and all other times on the graph's clock."""
        times = {name: getattr(self, name) + by_ns for name in self.times}
        return self._copy(**times)

    def following(self, **changes: Any) -> Self:
        """Message of the same node with the fields of its next frame. Of these, arrays are checked
        as ever: those of a user's Phi or solver may be anything. The others are numbers that the
        node itself has made, which its readers check again.
        """
        for name, kind in array_fields(type(self)).items():
            # None stands in optional fields alone: a node sets no other one to it.
            if changes.get(name) is not None:
                changes[name] = kind.check(name, changes[name])
        return self._copy(**changes)

    def _copy(self, **changes: Any) -> Self:
        """Copy with valid changes: nothing is checked again."""
        # Arrays are shared: messages are not changed.
        copy = object.__new__(type(self))
        copy.__dict__.update(self.__dict__, **changes)
        return copy

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(
            _same(getattr(self, name), getattr(other, name))
            for name in wire_fields(type(self))
        )

    # Equal messages would need equal hashes, and arrays have none.
    __hash__ = None  # type: ignore[assignment]


def _same(a: Any, b: Any) -> bool:
    if not (isinstance(a, np.ndarray) and isinstance(b, np.ndarray)):
        return bool(a == b)
    if a.dtype != b.dtype or a.shape != b.shape:
        return False

    # By bytes: NaN equals itself, 0 and -0 differ.
    return a.tobytes() == b.tobytes()


def once_a_class(
    make: Callable[[type[Message]], Made],
) -> Callable[[type[Message]], Made]:
    """`functools.cache` of a function of a class: the class is hashable, its messages are not."""
    return cast(Callable[[type[Message]], Made], functools.cache(make))


@once_a_class
def wire_fields(cls: type[Message]) -> dict[str, FieldKind]:
    """Name and kind of each field of a message class, in order of declaration."""
    kinds: dict[str, FieldKind] = {}
    for field in dataclasses.fields(cls):
        kinds[field.name] = field.metadata["wire"]
    return kinds


@once_a_class
def array_fields(cls: type[Message]) -> dict[str, Array]:
    """Name and kind of the fields of a message class that are arrays."""
    kinds: dict[str, Array] = {}
    for name, kind in wire_fields(cls).items():
        if isinstance(kind, Array):
            kinds[name] = kind
    return kinds


@once_a_class
def omitted_fields(cls: type[Message]) -> dict[str, Any]:
    """Name and default of the fields that are sent only where they differ from the default."""
    defaults: dict[str, Any] = {}
    for field in dataclasses.fields(cls):
        if field.metadata["omitted"]:
            defaults[field.name] = field.default
    return defaults
