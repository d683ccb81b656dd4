"""Node types by name; a type is imported when it is used, so that the edge needs no solver."""

from typing import TYPE_CHECKING, Any

from . import extensions
from .errors import SettingsError
from .lookup import find_class

if TYPE_CHECKING:
    from .node import Node

NODE_TYPES = extensions.Registry(
    extensions.NODES,
    {
        "sensor": "sparseskin.nodes.sensor.node:Sensor",
        "compressor": "sparseskin.nodes.compressor.node:Compressor",
        "reconstructor": "sparseskin.nodes.reconstructor.node:Reconstructor",
        "monitor": "sparseskin.nodes.monitor.node:Monitor",
        "recorder": "sparseskin.nodes.recorder.node:Recorder",
        "player": "sparseskin.nodes.player.node:Player",
    },
)
"""Class of each type."""


def node_class(type_name: str) -> "type[Node[Any]]":
    """Return the class of a registered node type, or of "module:Class"; or raise SettingsError."""
    # With it comes numpy, which the names above do not need.
    from .node import Node

    cls = find_class("type", type_name, NODE_TYPES, SettingsError)
    if not (isinstance(cls, type) and issubclass(cls, Node)):
        raise SettingsError(
            f'type "{type_name}": not a subclass of sparseskin.nodes.node.Node'
        )
    return cls
