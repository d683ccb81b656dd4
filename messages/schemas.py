"""All schemas of messages, and the class of one that was received."""

from .base import Message
from .contacts import Contacts
from .errors import UnknownSchemaError, VersionError
from .frames import Measurements, Reconstruction, Taxels, Truth
from .labels import Labels
from .state import Calibration, End, PhiState, SkinState, SolverState

_CLASSES: tuple[type[Message], ...] = (
    *(SkinState, Calibration, Truth, Taxels, PhiState, Measurements),
    *(SolverState, Reconstruction, Contacts, Labels, End),
)
SCHEMAS: dict[str, type[Message]] = {cls.schema: cls for cls in _CLASSES}
"""Message classes by schema name."""


def class_of(body: dict[object, object]) -> type[Message]:
    """Class of a message, by the schema and version in its map, or MessageError."""
    # Any object may stand here: the message has not been checked.
    name = body.get("schema")
    if not isinstance(name, str) or name not in SCHEMAS:
        raise UnknownSchemaError(
            f"schema {str(name)[:64]!r} (known: {', '.join(SCHEMAS)})"
        )

    cls = SCHEMAS[name]
    version = body.get("version")
    if type(version) is not int or version != cls.version:
        raise VersionError(
            f"{name}: version {str(version)[:20]}, this program reads {cls.version}"
        )
    return cls
