"""Formats of the JSON that commands print and write; docs/reference/json.toml has their fields."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

VERSIONS = {
    "launch-summary": 1,
    "reprocess-summary": 1,
    "source-list": 1,
    "graph-list": 1,
    "node-list": 1,
    "node-info": 1,
    "param-list": 1,
    "param-get": 1,
    "param-set": 1,
    "topic-list": 1,
    "topic-info": 1,
    "topic-echo": 1,
    "topic-hz": 1,
    "recording-info": 1,
    "tare-result": 1,
}
"""Version of each format: 1 more where a field goes or changes its meaning; new ones may come."""


def formatted(name: str, fields: Mapping[str, Any]) -> dict[str, Any]:
    """A document of that format: "format" is "sparseskin/NAME/VERSION"."""
    return {"format": f"sparseskin/{name}/{VERSIONS[name]}", **fields}
