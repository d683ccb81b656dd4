"""Links between nodes: each topic has one writer, and each reader needs a writer."""

import fnmatch
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from .errors import SettingsError
from .lookup import did_you_mean
from .node import Node

NodeSpecs = Mapping[str, tuple[type[Node[Any]], Any]]
"""Node class and settings, by node name."""


@dataclass(frozen=True)
class Link:
    """One topic, its writer and one of its readers."""

    topic: str
    writer: str
    reader: str


def join(nodes: NodeSpecs) -> list[Link]:
    """Return all links of a graph, in the order of its nodes.

    SettingsError if two nodes write one topic, or a node reads a topic that none writes.
    """
    writers: dict[str, str] = {}
    for name, (cls, settings) in nodes.items():
        for topic in cls.outputs(settings):
            if topic in writers:
                raise SettingsError(
                    f"{name}: writes {topic}, which {writers[topic]} writes too"
                )
            writers[topic] = name

    # All writers are known now: the order of nodes in a file does not matter.
    links = []
    for name, (cls, settings) in nodes.items():
        topics = []
        for pattern in cls.inputs(settings):
            topics += _matching(name, pattern, writers)
        # Not `_matching`: it is no fault if nobody writes these.
        topics += [t for t in cls.optional_inputs(settings) if t in writers]
        links += [Link(topic, writers[topic], name) for topic in topics]
    return links


def _matching(name: str, pattern: str, writers: Mapping[str, str]) -> list[str]:
    """Written topics that an input of the node `name` reads, or SettingsError if there is none."""
    if pattern in writers:
        return [pattern]
    if "*" not in pattern:
        hint = _hint(pattern, writers)
        raise SettingsError(f"{name}: reads {pattern}, which no node writes{hint}")
    topics = fnmatch.filter(writers, pattern)
    if not topics:
        raise SettingsError(f"{name}: reads {pattern}, which matches no written topic")
    return topics


def _hint(topic: str, writers: Mapping[str, str]) -> str:
    """What may have been meant: topics of the same schema, or else all that are written."""
    schema = topic.rpartition("/")[2]
    same_schema = [t for t in writers if t.endswith(f"/{schema}")]
    # Mostly the name of the patch is another one there.
    if same_schema:
        return did_you_mean(topic, same_schema)
    return f" (written: {', '.join(sorted(writers))})"
