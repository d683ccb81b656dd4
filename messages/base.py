"""What every message has: schema, version, publisher run, sequence number, stamp and patch."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Self, TypeVar, cast

import numpy as np

from .fields import FieldKind, Integer, Text, wire
from .topics import MAX_NAME, NAME_PATTERN, topic_of

Made = TypeVar("Made")


@dataclass(frozen=True, kw_only=True, eq=False)
class Message:
    """A typed, immutable message; its fields are checked when it is made.

    Attributes
    ----------
    stamp_ns : int
        Time of the acquisition (not of sending) on the graph's clock, in nanoseconds.
        It names the frame: all messages that descend from one frame carry its stamp.
    patch : str
        The patch of skin that the message belongs to.
    run_id : str
        16 hex digits, drawn when the publisher starts; "" until it is published.
    seq : int
        0, 1, 2, ... a publisher run and topic; a gap is a loss.

    Raises
    ------
    MessageError
        One of its subclasses, if a field has the wrong type, shape or range.
    """

    schema: ClassVar[str]
    version: ClassVar[int]
    latched: ClassVar[bool] = False
    """Whether who subscribes late is still sent the last one."""
    times: ClassVar[tuple[str, ...]] = ("stamp_ns",)
    """Fields that are times on the graph's clock."""

    stamp_ns: int = wire(Integer())
    patch: str = wire(Text(MAX_NAME, NAME_PATTERN))
    run_id: str = wire(Text(16, r"([0-9a-f]{16})?"), default="")
    seq: int = wire(Integer(), default=0)

    def __post_init__(self) -> None:
        values = self.__dict__
        for name, check in checks_of(type(self)):
            values[name] = check(name, values[name])
        self.validate()

    def validate(self) -> None:
        """Check what concerns several fields at once; each is sound by itself already.

        Raises
        ------
        MessageError
            If they do not go together.
        """

    @classmethod
    def assembled(cls, values: dict[str, Any]) -> Self:
        """A message of fields that have been checked one by one, as `decode` does."""
        made = object.__new__(cls)
        made.__dict__.update(values)
        made.validate()
        return made

    @property
    def topic(self) -> str:
        """The topic on which the message travels."""
        return topic_of(self.patch, self.schema)

    def published(self, run_id: str, seq: int) -> Self:
        """The same message as publisher run `run_id` sends it with number `seq`."""
        return self._twin(run_id=run_id, seq=seq)

    def moved(self, by_ns: int) -> Self:
        """The same message `by_ns` nanoseconds later: its stamp, and any other time on the
        graph's clock that it holds.
        """
        times = {name: getattr(self, name) + by_ns for name in self.times}
        return self._twin(**times)

    def _twin(self, **changes: Any) -> Self:
        """A copy with changes that are known to be sound, so that arrays are not checked again."""
        twin = object.__new__(type(self))
        twin.__dict__.update(self.__dict__, **changes)
        return twin

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(
            _same(getattr(self, name), getattr(other, name)) for name in wire_fields(type(self))
        )

    __hash__ = None  # type: ignore[assignment]


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    return bool(a == b)


def once_a_class(make: Callable[[type[Message]], Made]) -> Callable[[type[Message]], Made]:
    """As `functools.cache`: classes are hashable, also those whose messages are not."""
    return cast(Callable[[type[Message]], Made], functools.cache(make))


@once_a_class
def wire_fields(cls: type[Message]) -> dict[str, FieldKind]:
    """Name and kind of every field of a message class, in order of declaration."""
    return {f.name: cast(FieldKind, f.metadata["wire"]) for f in dataclasses.fields(cls)}


@once_a_class
def omitted_fields(cls: type[Message]) -> dict[str, Any]:
    """Name and default of the fields that travel only where they are not their default."""
    return {f.name: f.default for f in dataclasses.fields(cls) if f.metadata["omitted"]}


@once_a_class
def checks_of(cls: type[Message]) -> tuple[tuple[str, Callable[[str, Any], Any]], ...]:
    """What is called with the name and value of every field when a message is made."""
    return tuple((name, kind.check) for name, kind in wire_fields(cls).items())
