"""JSON Schema of a message's msgpack map, with which recordings describe it to other programs."""

from __future__ import annotations

import math
from typing import Any

from .base import Message, omitted_fields, wire_fields
from .fields import MAX_ELEMENTS, Array, Each, FieldKind, Flag, Integer, Names, Real, Samples, Text
from .topics import MAX_NAMES, MAX_PATCHES, NAME_PATTERN

_DIALECT = "https://json-schema.org/draft/2020-12/schema"


def json_schema(cls: type[Message], version: int | None = None) -> dict[str, Any]:
    """Describe the msgpack map of a message class as a JSON Schema (draft 2020-12).

    JSON has no binary type: a msgpack bin field has no "type" there, and is described in words.
    The version is by default the class's.
    """
    properties: dict[str, Any] = {
        "schema": {"const": cls.schema},
        "version": {"const": cls.version if version is None else version},
    }
    for name, kind in wire_fields(cls).items():
        properties[name] = _property(kind)
    return {
        "$schema": _DIALECT,
        "title": f"sparseskin/{cls.schema}",
        "description": " ".join((cls.__doc__ or "").partition("\n\n")[0].split()),
        "type": "object",
        "properties": properties,
        "required": [name for name in properties if name not in omitted_fields(cls)],
        "additionalProperties": False,
    }


def _property(kind: FieldKind) -> dict[str, Any]:
    if isinstance(kind, Integer):
        return {"type": "integer", "minimum": kind.low, "maximum": kind.high}
    if isinstance(kind, Real):
        number: dict[str, Any] = {"type": ["number", "null"] if kind.optional else "number"}
        if math.isfinite(kind.low):
            number["minimum"] = kind.low
        if math.isfinite(kind.high):
            number["maximum"] = kind.high
        return number
    if isinstance(kind, Flag):
        return {"type": "boolean"}
    if isinstance(kind, Text):
        return {"type": "string", "maxLength": kind.longest, "pattern": f"^(?:{kind.pattern})$"}
    if isinstance(kind, Names):
        pattern = f"^({NAME_PATTERN}( {NAME_PATTERN})*)?$"
        return {"type": "string", "maxLength": MAX_NAMES, "pattern": pattern}
    if isinstance(kind, Each):
        numbers = {"type": "array", "items": _property(kind.kind)}
        return {**numbers, "minItems": 1, "maxItems": MAX_PATCHES}
    if isinstance(kind, Samples):
        codes = _array(
            kind,
            {"type": "string", "pattern": "^int[0-9]+$"},
            "msgpack bin: for dtype intB, B bits each, the highest first and "
            "nothing between them: k + 2^(B-1) - 1 of the values k * step",
            step={"type": "number", "exclusiveMinimum": 0},
        )
        return {"oneOf": [_array(kind), codes]}
    if isinstance(kind, Array):
        return _array(kind)
    raise TypeError(f"no JSON Schema for a field of kind {type(kind).__name__}")


def _array(
    kind: Array, dtype: dict[str, str] | None = None, data: str = "", **more: dict[str, Any]
) -> dict[str, Any]:
    side = kind.longest if kind.ndim > 1 else MAX_ELEMENTS
    sides = {"type": "integer", "minimum": int(not kind.sparse), "maximum": side}
    values = (
        "msgpack bin: the elements in C order, "
        f"each as numpy's dtype {kind.dtype} in that byte order, nothing between them"
    )
    fields: dict[str, Any] = {
        "dtype": dtype or {"const": kind.dtype},
        "shape": {"type": "array", "items": sides, "minItems": kind.ndim, "maxItems": kind.ndim},
        "order": {"const": "C"},
        **more,
        "data": {"description": data or values},
    }
    return {
        "type": ["object", "null"] if kind.optional else "object",
        "properties": fields,
        "required": list(fields),
        "additionalProperties": False,
    }
