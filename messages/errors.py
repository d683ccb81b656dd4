"""Why a message is refused. Each class is one reason, so that counters can name it."""

from __future__ import annotations

from typing import ClassVar


class MessageError(ValueError):
    """A message that cannot be built, encoded or decoded; the text says what and why."""

    reason: ClassVar[str] = "refused"


class MalformedError(MessageError):
    """The bytes are not one msgpack map with the fields its schema names."""

    reason = "malformed"


class TruncatedError(MalformedError):
    """The bytes end before the message does."""

    reason = "truncated"


class OversizedError(MessageError):
    """The message, a text or an array is larger than the wire form allows."""

    reason = "oversized"


class UnknownSchemaError(MessageError):
    """No message of that schema name is known here."""

    reason = "unknown schema"


class VersionError(MessageError):
    """The schema is known, but not in that version."""

    reason = "wrong version"


class ShapeError(MessageError):
    """An array has the wrong dtype, number of dimensions, shape or number of bytes."""

    reason = "wrong shape"


class NotFiniteError(MessageError):
    """An array or number holds NaN or infinity: a fault of whoever made it."""

    reason = "not finite"


class FieldError(MessageError):
    """A field has the wrong type or a value out of its range."""

    reason = "bad field"
