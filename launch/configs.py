"""What a launcher tells its nodes, and what it notes of them for others to find."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from .launchspec import LaunchFile
from .running import RunningGraph, RunningNode


def node_config(
    launch: LaunchFile, name: str, offset_ns: int, max_frames: int | None, late: bool
) -> dict[str, Any]:
    """The configuration of a node's process, as `sparseskin.nodes.run_node` expects it."""
    spec = launch.nodes[name]
    return {
        "name": name,
        "type": spec.type_name,
        "settings": spec.values,
        "endpoint": _endpoint(launch.transport, name),
        "inputs": [link.topic for link in launch.links if link.reader == name],
        "readers": sorted({link.reader for link in launch.links if link.writer == name}),
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
