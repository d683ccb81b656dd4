"""What `sparseskin bag info` says of a bag."""

from __future__ import annotations

import json
import textwrap
from typing import Any

from sparseskin.nodes.recorder.bag import TopicInfo
from sparseskin.nodes.recorder.bag_reader import BagReader

WIDTH = 80
_MAX_TOPIC = 40
_FLAT_JSON = ("phi", "versions")
_NOT_SHOWN = ("lost", "received", "published")
"""Counts that the table of topics shows already."""


def info_json(bag: BagReader) -> str:
    """Everything the table says, and the metadata in full, as JSON."""
    topics = {
        topic: {
            "schema": info.schema,
            "version": info.version,
            "n_messages": info.n_messages,
            "first_ns": info.first_ns,
            "last_ns": info.last_ns,
            "rate_hz": info.rate_hz,
        }
        for topic, info in bag.topics.items()
    }
    first_ns, last_ns = _span(bag)
    return json.dumps(
        {
            "bag": str(bag.path),
            "size_bytes": bag.path.stat().st_size,
            "recovered": bag.recovered,
            "duration_s": (last_ns - first_ns) / 1e9,
            "topics": topics,
            "counts": bag.counts,
            "metadata": bag.metadata,
        },
        indent=2,
    )


def info_table(bag: BagReader) -> str:
    """A table of at most 80 columns: the file, its topics, its metadata."""
    first_ns, last_ns = _span(bag)
    n_messages = sum(info.n_messages for info in bag.topics.values())
    lines = _entry("bag", str(bag.path))
    lines += _entry("size", f"{bag.path.stat().st_size / 1e6:.3f} MB, {n_messages} messages")
    lines += _entry("duration", f"{(last_ns - first_ns) / 1e9:.3f} s")
    lines += _entry("state", bag.recovered or "whole")
    lines += ["", *_topic_lines(bag)]
    for name, counted in (bag.counts or {}).items():
        if name not in _NOT_SHOWN and (text := _flat(_without_zeros(counted))) != "none":
            lines += _entry(name, text)
    if bag.counts is None:
        lines.append("lost messages are not known: the recorder did not get to say")
    lines.append("")
    for key, value in bag.metadata.items():
        if value:
            lines += _entry(key, _shown(key, value))
    return "\n".join(lines).rstrip()


def _topic_lines(bag: BagReader) -> list[str]:
    width = max([5, *(len(topic) for topic in bag.topics if len(topic) <= _MAX_TOPIC)])
    lost = (bag.counts or {}).get("lost")
    lines = [f"{'topic':<{width}} {'messages':>9} {'rate Hz':>9} {'seconds':>9} {'lost':>7}"]
    for topic, info in bag.topics.items():
        if len(topic) > width:
            lines.append(topic)
        n_lost = _flat(lost.get(topic, 0)) if isinstance(lost, dict) else "-"
        lines.append(f"{topic if len(topic) <= width else '':<{width}} {_row(info)} {n_lost:>7}")
    return lines


def _row(info: TopicInfo) -> str:
    seconds = (info.last_ns - info.first_ns) / 1e9
    rate = f"{info.rate_hz:.2f}" if info.rate_hz else "-"
    return f"{info.n_messages:>9} {rate:>9} {seconds:>9.3f}"


def _span(bag: BagReader) -> tuple[int, int]:
    infos = [info for info in bag.topics.values() if info.n_messages]
    if not infos:
        return 0, 0
    return min(info.first_ns for info in infos), max(info.last_ns for info in infos)


def _entry(key: str, value: str) -> list[str]:
    """`key  value`, wrapped; what a file says of itself cannot move the cursor."""
    printable = "".join(char if char.isprintable() else " " for char in value)
    return textwrap.wrap(
        " ".join(printable.split()),
        WIDTH,
        initial_indent=f"{key[:16]:<10} ",
        subsequent_indent=" " * 11,
        break_on_hyphens=False,
    ) or [key[:16]]


def _shown(key: str, value: str) -> str:
    if key in _FLAT_JSON:
        try:
            return _flat(json.loads(value))
        except (ValueError, RecursionError):
            return value
    n_lines = len(value.splitlines())
    return f"{n_lines} lines (--json shows them)" if n_lines > 1 else value


def _without_zeros(value: Any) -> Any:
    if isinstance(value, dict):
        left = {key: _without_zeros(inner) for key, inner in value.items()}
        return {key: inner for key, inner in left.items() if inner not in (0, {}, None)}
    return value


def _flat(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_flat(inner)}" for key, inner in value.items()) or "none"
    if isinstance(value, list):
        return " ".join(_flat(inner) for inner in value) or "none"
    return "none" if value is None else str(value)
