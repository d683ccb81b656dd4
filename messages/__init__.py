"""Messages between the nodes: typed, versioned, with one wire form."""

from .base import Message
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
from .frames import Measurements, Reconstruction, Resultant, Taxels, Truth
from .skin import Skin
from .state import End, PhiState, SkinState, SolverState
from .topics import topic_of
from .wire import MAX_MESSAGE_BYTES, decode, encode, size_bytes

__all__ = [
    "MAX_MESSAGE_BYTES", "End", "FieldError", "MalformedError", "Measurements", "Message",
    "MessageError", "NotFiniteError", "OversizedError", "PhiState", "Reconstruction", "Resultant",
    "ShapeError", "Skin", "SkinState", "SolverState", "Taxels", "TruncatedError", "Truth",
    "UnknownSchemaError", "VersionError", "decode", "encode", "size_bytes", "topic_of",
]  # fmt: skip
