"""JSON Schema of a message's msgpack map, with which recordings describe it to other programs."""

from __future__ import annotations

from typing import Any

from sparseskin.messages.base import Message, omitted_fields, wire_fields
from sparseskin.messages.fields import Each, FieldKind, Flag, Integer, Names, Real, Text, Words

_DIALECT = "https://json-schema.org/draft/2020-12/schema"
_TYPES: dict[type[FieldKind], str] = {
    Integer: "integer",
    Real: "number",
    Flag: "boolean",
    Text: "string",
    Names: "string",
    Each: "array",
    Words: "string",
}
"""JSON types of fields; an array is a map of dtype, shape, order, data and step, an object."""


def json_schema(cls: type[Message], version: int) -> dict[str, Any]:
    """Describe the msgpack map of a version of a message class as a JSON Schema: its fields and
    their types.
    """
    properties: dict[str, Any] = {"schema": {"const": cls.schema}, "version": {"const": version}}
    for name, kind in wire_fields(cls).items():
        json_type = _TYPES.get(type(kind), "object")
        is_optional = getattr(kind, "optional", False)
        properties[name] = {"type": [json_type, "null"] if is_optional else json_type}
    return {
        "$schema": _DIALECT,
        "title": f"sparseskin/{cls.schema}",
        "description": " ".join((cls.__doc__ or "").partition("\n\n")[0].split()),
        "type": "object",
        "properties": properties,
        "required": [name for name in properties if name not in omitted_fields(cls)],
        "additionalProperties": False,
    }
