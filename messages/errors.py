"""Reasons for which a message is refused; counters name them by `reason`."""

from typing import ClassVar


class MessageError(ValueError):
    """A message that cannot be built, encoded or decoded."""

    reason: ClassVar[str] = "refused"

    def __init_subclass__(cls, reason: str | None = None) -> None:
        super().__init_subclass__()
        # Without one of its own, a subclass is counted with its base.
        cls.reason = reason or cls.reason


class MalformedError(MessageError, reason="malformed"):
    """The bytes are not one msgpack map with the fields its schema names."""


class TruncatedError(MalformedError, reason="truncated"):
    """The bytes end before the message does."""


class OversizedError(MessageError, reason="oversized"):
    """The message, a text or an array is larger than the wire form allows."""


class UnknownSchemaError(MessageError, reason="unknown schema"):
    """No schema of that name is known."""


class VersionError(MessageError, reason="wrong version"):
    """The schema is known in another version only."""


class ShapeError(MessageError, reason="wrong shape"):
    """An array has the wrong dtype, number of dimensions, shape or number of bytes."""


class NotFiniteError(MessageError, reason="not finite"):
    """An array or number holds NaN or infinity: a fault of its publisher."""


class FieldError(MessageError, reason="bad field"):
    """A field has the wrong type or a value out of its range."""
