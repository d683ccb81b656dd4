"""Messages between the nodes: typed, versioned, with one wire form.

Each name is imported when it is first used: with most of them comes numpy, for which a program that
only prints a line must not wait.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .base import Message
    from .contacts import Contacts
    from .errors import (
        FieldError,
        MalformedError,
        MessageError,
        NotFiniteError,
        OversizedError,
        ShapeError,
        TruncatedError,
        UnknownSchemaError,
        VersionError,
    )
    from .frames import Measurements, Reconstruction, Taxels, Truth
    from .labels import Labels
    from .reasons import Reason
    from .skin import Skin
    from .state import Calibration, End, PhiState, SkinState, SolverState
    from .topics import topic_of
    from .wire import MAX_MESSAGE_BYTES, decode, encode, size_bytes

__all__ = [
    "MAX_MESSAGE_BYTES", "Calibration", "Contacts", "End", "FieldError", "Labels", "MalformedError",
    "Measurements", "Message", "MessageError", "NotFiniteError", "OversizedError", "PhiState",
    "Reason", "Reconstruction", "ShapeError", "Skin", "SkinState",
    "SolverState", "Taxels", "TruncatedError", "Truth",
    "UnknownSchemaError", "VersionError", "decode", "encode", "size_bytes", "topic_of",
]  # fmt: skip

_MODULES = (
    *("topics", "errors", "reasons", "base", "frames", "contacts", "labels"),
    *("skin", "state", "wire"),
)


def __getattr__(name: str) -> Any:
    if name in __all__:
        for module in _MODULES:
            value = vars(import_module(f".{module}", __name__)).get(name)
            if value is not None:
                # Found without this function from now on.
                globals()[name] = value
                return value
    raise AttributeError(f"module 'sparseskin.messages' has no attribute {name!r}")
