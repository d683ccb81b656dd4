"""Node types by name. A type is imported when it is asked for, so the edge needs no solver."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .errors import SettingsError
from .lookup import find_class
from .node import Node

NODE_TYPES = {
    "sensor": "sparseskin.nodes.sensor.node:Sensor",
    "compressor": "sparseskin.nodes.compressor.node:Compressor",
    "reconstructor": "sparseskin.nodes.reconstructor.node:Reconstructor",
    "monitor": "sparseskin.nodes.monitor.node:Monitor",
    "recorder": "sparseskin.nodes.recorder.node:Recorder",
    "player": "sparseskin.nodes.player.node:Player",
}


def node_class(type_name: str) -> type[Node[Any]]:
    """The class of a registered node type, or of a user's own "module:Class".

    Raises
    ------
    SettingsError
        If there is no such type (with a did-you-mean), or it is not a Node.
    """
    cls = find_class("type", type_name, NODE_TYPES, SettingsError)
    if not (isinstance(cls, type) and issubclass(cls, Node)):
        raise SettingsError(f'type "{type_name}": not a subclass of sparseskin.nodes.node.Node')
    return cls


def make_settings(cls: type[Node[Any]], values: Mapping[str, Any]) -> Any:
    """Settings of a node class from names and values.

    Raises
    ------
    SettingsError
        If a key is unknown, or a value is not allowed.
    """
    return cls.Settings.from_mapping(values)
