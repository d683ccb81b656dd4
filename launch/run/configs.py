"""Configurations of node processes, and the note by which others find a graph."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sparseskin.launch.launchfile.hosts import Credentials
from sparseskin.launch.launchfile.spec import LaunchFile, NodeSpec
from sparseskin.nodes.graph import Link
from sparseskin.nodes.network.keys import read_key_pair
from sparseskin.nodes.network.sockets import Peer

from .running import RunningGraph, RunningNode, page_path, socket_path

ANY_PORT = "tcp://127.0.0.1:*"


def node_config(
    launch: LaunchFile,
    spec: NodeSpec,
    links: Sequence[Link],
    *,
    joined: RunningGraph | None,
    offset_ns: int,
    max_frames: int | None,
    late: bool,
    page_token: str,
    number: int,
) -> dict[str, Any]:
    """The configuration of a node's process, as `sparseskin.nodes.process.run_node` expects it;
    `number` tells its socket from those of the other nodes.
    Raises KeyFileError if the graph that is joined asks for a key that this user may not read.
    """
    read = [link for link in links if link.reader == spec.name]
    readers = {link.reader for link in links if link.writer == spec.name}
    elsewhere = launch.elsewhere
    return {
        "name": spec.name,
        "type": spec.type_name,
        "settings": spec.values,
        "folder": launch.folder,
        **asdict(spec.scheduling),
        "endpoint": f"ipc://{socket_path(number)}" if launch.transport == "ipc" else ANY_PORT,
        "inputs": [link.topic for link in read],
        "readers": sorted(readers),
        "offset_ns": offset_ns,
        "max_frames": max_frames,
        "late": late,
        "page_token": page_token,
        "page_file": page_path(number),
        "public": spec.public,
        "distant_readers": sorted(
            name for name in readers if name in elsewhere and not elsewhere[name].cls.observes
        ),
        "distant_inputs": {
            link.topic: elsewhere[link.writer].host for link in read if link.writer in elsewhere
        },
        "security": _security(launch, joined),
    }


def peer_of(
    launch: LaunchFile,
    joined: RunningGraph | None,
    writer: str,
    endpoints: Mapping[str, str],
) -> dict[str, str]:
    """Endpoint and key of a writer, as plain data for a node that reads from it. `endpoints` are
    those of the nodes of this host; a node that is restarted binds the same one.
    """
    keys = launch.credentials
    if joined is not None:
        node = joined.nodes[writer]
        peer = Peer(writer, node.endpoint, key=node.key)
    elif writer in launch.elsewhere:
        spec = launch.elsewhere[writer]
        server = keys.servers.get(spec.host, keys.own.public) if keys else ""
        peer = Peer(writer, spec.public, spec.host, server)
    else:
        key = keys.own.public if keys else ""
        peer = Peer(writer, endpoints[writer], key=key)
    return asdict(peer)


def note_of(
    launch: LaunchFile, endpoints: Mapping[str, str], offset_ns: int, page_token: str
) -> RunningGraph:
    """The note by which others find this graph and its topics."""
    keys = launch.credentials
    public = keys.own.public if keys else ""
    nodes = {
        name: RunningNode(spec.type_name, endpoints[name], list(spec.outputs), public)
        for name, spec in launch.nodes.items()
    }
    key_file = keys.file if keys else ""
    return RunningGraph(
        launch.name, os.getpid(), offset_ns, launch.text, nodes, key_file, page_token
    )


def _security(launch: LaunchFile, joined: RunningGraph | None) -> dict[str, Any] | None:
    keys = launch.credentials
    if joined is not None and joined.key_file:
        keys = Credentials(read_key_pair(Path(joined.key_file)), joined.key_file, {}, {}, {})
    if keys is None:
        return None
    own = [keys.own.public, keys.own.secret]
    return {"own": own, "allowed": dict(keys.allowed), "known": dict(keys.known)}
