"""What a launcher tells its nodes, and what it notes of them for others to find."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

from sparseskin.nodes.graph import Link

from .launchspec import LaunchFile, NodeSpec
from .running import RunningGraph, RunningNode


def node_config(
    transport: str,
    spec: NodeSpec,
    links: Sequence[Link],
    *,
    offset_ns: int,
    max_frames: int | None,
    late: bool,
) -> dict[str, Any]:
    """The configuration of a node's process, as `sparseskin.nodes.run_node` expects it."""
    return {
        "name": spec.name,
        "type": spec.type_name,
        "settings": spec.values,
        "endpoint": _endpoint(transport, spec.name),
        "inputs": [link.topic for link in links if link.reader == spec.name],
        "readers": sorted({link.reader for link in links if link.writer == spec.name}),
        "offset_ns": offset_ns,
        "max_frames": max_frames,
        "late": late,
    }


def note_of(launch: LaunchFile, endpoints: Mapping[str, str], offset_ns: int) -> RunningGraph:
    """The note by which others find this graph and its topics."""
    nodes = {
        name: RunningNode(spec.type_name, endpoints[name], list(spec.cls.outputs(spec.settings)))
        for name, spec in launch.nodes.items()
    }
    return RunningGraph(launch.name, os.getpid(), offset_ns, launch.text, nodes)


def _endpoint(transport: str, name: str) -> str:
    if transport == "tcp":
        return "tcp://127.0.0.1:*"
    # An abstract name leaves no file behind and refuses a second bind.
    return f"ipc://@sparseskin-{os.getpid()}-{name}"
