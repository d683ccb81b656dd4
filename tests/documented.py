"""What docs/reference/json.toml documents of the JSON that commands print and write."""

import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

FIELDS = Path(__file__).parents[1] / "docs" / "reference" / "json.toml"
TYPES: dict[str, Callable[[Any], bool]] = {
    "string": lambda value: isinstance(value, str),
    "integer": lambda value: type(value) is int,
    "number": lambda value: type(value) in (int, float),
    "boolean": lambda value: isinstance(value, bool),
    "null": lambda value: value is None,
    "list": lambda value: isinstance(value, list),
    "object": lambda value: isinstance(value, dict),
    "any": lambda value: True,
}
Parts = tuple[str, ...]


def documented() -> dict[str, dict[Parts, set[str]]]:
    """Of each format its fields, as parts of their paths, and the types of each."""
    found: dict[str, dict[Parts, set[str]]] = {}
    for name, form in tomllib.loads(FIELDS.read_text(encoding="utf-8")).items():
        fields: dict[Parts, set[str]] = {("format",): {"string"}}
        for text, (types, _) in form["fields"].items():
            for path in spread(text):
                parts = tuple(path.replace("[]", ".[]").split("."))
                assert parts not in fields, (name, path)
                fields[parts] = set(types.split(" / "))
        # lists and objects that only their parts show
        for parts, kinds in list(fields.items()):
            for k in range(1, len(parts)):
                kind = "list" if parts[k] == "[]" else "object"
                fields.setdefault(parts[:k], {kind} | kinds & {"absent"})
        found[name] = fields
    return found


def spread(path: str) -> list[str]:
    """The paths that one with {a,b} stands for."""
    head, brace, tail = path.partition("{")
    names, _, rest = tail.partition("}")
    return (
        [p for name in names.split(",") for p in spread(head + name + rest)]
        if brace
        else [path]
    )


def values_of(document: Any, path: Parts = ()) -> Iterator[tuple[Parts, Any]]:
    """Each value of a document, those of lists and objects too, with its path."""
    yield path, document
    if isinstance(document, dict):
        for key, value in document.items():
            yield from values_of(value, (*path, key))
    elif isinstance(document, list):
        for value in document:
            yield from values_of(value, (*path, "[]"))


def matches(path: Parts, pattern: Parts) -> bool:
    return len(path) == len(pattern) and all(
        part == wanted or wanted.isupper()
        for part, wanted in zip(path, pattern, strict=True)
    )


def check(document: dict[str, Any]) -> None:
    """Check that a document has the documented fields, all that are not optional, and no others."""
    fields = documented()[document["format"]]
    seen = set()
    for path, value in values_of(document):
        if not path:
            continue
        found = [
            pattern
            for pattern, types in fields.items()
            if matches(path, pattern)
            or (types & {"any"} and matches(path[: len(pattern)], pattern))
        ]
        # The literal name first: `topic` is not a KEY.
        found.sort(key=lambda pattern: sum(part.isupper() for part in pattern))
        if not found:
            parents = [
                p
                for p in fields
                if len(p) > len(path) and matches(path, p[: len(path)])
            ]
            assert parents, f"{'.'.join(path)} is not documented"
            assert isinstance(value, dict | list), f"{'.'.join(path)} = {value!r}"
            continue
        seen.add(found[0])
        types = fields[found[0]]
        assert any(TYPES[name](value) for name in types - {"absent"}), (
            path,
            value,
            types,
        )
    for pattern, types in fields.items():
        inside_null = any(
            fields.get(pattern[:k], set()) & {"null", "list"}
            for k in range(1, len(pattern))
        )
        assert pattern in seen or "absent" in types or inside_null, (
            f"no {'.'.join(pattern)}"
        )
