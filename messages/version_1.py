"""Messages of version 1, which older recordings hold, as those of today.

Frames of one patch had arrays without an axis of patches, and numbers in place of tuples. Those of
several patches had schemas of their own, NAME_batch, on topics of that name, and arrays of numbers.
"""

from typing import Any

import msgpack
import numpy as np

from .buffers import unpacked
from .errors import MalformedError
from .fields import Each
from .frames import Frames, Measurements, Reconstruction, Taxels, Truth, of_patches
from .state import End
from .topics import split_topic, topic_of

VERSION = 1
_BATCH = "_batch"
_NO_FORCES = {"dtype": "<f4", "shape": [0, 1, 1], "order": "C", "data": b""}
_FRAMES: tuple[type[Frames], ...] = (Taxels, Truth, Measurements, Reconstruction)
SCHEMAS = {name: cls for cls in _FRAMES for name in (cls.schema, cls.schema + _BATCH)}
"""Class of today of each schema of frames of version 1."""


def topic_today(topic: str) -> str:
    """Name of a recorded topic in recordings of today."""
    patch, schema = split_topic(topic)
    return topic_of(patch, SCHEMAS[schema].schema) if schema in SCHEMAS else topic


def payload_today(payload: bytes) -> bytes:
    """A payload of version 1, a map, as one of today; fields are checked when it is decoded.
    Raises MessageError if it is no map, or no message of version 1.
    """
    body = unpacked(payload, dict, len(payload))
    try:
        if body["schema"] == End.schema:
            body["of"] = SCHEMAS[body["of"]].schema
        elif body["schema"] in SCHEMAS and body["version"] == VERSION:
            body |= _frame(body)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise MalformedError(f"no message of version {VERSION}: {error}") from error
    packed: bytes = msgpack.packb(body)
    return packed


def _frame(body: dict[str, Any]) -> dict[str, Any]:
    """Fields of a frame that are others today."""
    cls = SCHEMAS[body["schema"]]
    several = cls.schema != body["schema"]
    found: dict[str, Any] = {"schema": cls.schema, "version": cls.version}
    for name, kind in of_patches(cls).items():
        if name not in body or (name == "sd" and body[name] is None):
            continue
        old = body[name]
        if isinstance(kind, Each):
            found[name] = _numbers(old) if several else [old]
        elif old is None:  # all patches are unchanged
            found[name] = _NO_FORCES
        elif not several:
            found[name] = {**old, "shape": [1, *old["shape"]]}
    if several and "error" in found:
        found["error"] = [None if one < 0 else one for one in found["error"]]
    return found


def _numbers(array: dict[str, Any]) -> list[Any]:
    """Numbers of a recorded array of one dimension."""
    if array["dtype"] not in ("|b1", "<i4", "<i8", "<f4"):
        raise ValueError(f"dtype {array['dtype']!r:.20}")
    numbers: list[Any] = np.frombuffer(array["data"], array["dtype"]).tolist()
    return numbers
