"""Definitions of messages in the packages of ROS 2 that are installed on this host."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError
from sparseskin.plugins.bridges.cdr import types

PREFIXES = "AMENT_PREFIX_PATH"
"""Variable of a terminal of ROS 2 with the folders of its packages."""
MAX_TYPES = 1000


def learn(kind: str) -> None:
    """Add a type, and those of its members, to the types of ROS 2 that are known, if it is none of
    them. Raises SourceError if it is not installed, or its definition cannot be read.
    """
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import get_types_from_msg

    store = types()
    new_types: dict[str, Any] = {}
    waiting = [kind]
    while waiting:
        name = waiting.pop()
        if name in store.fielddefs or name in new_types or len(new_types) > MAX_TYPES:
            continue

        text = _text(name)
        try:
            types_of_text = get_types_from_msg(text, name)
        except Exception as error:
            # Of its parser, at any text.
            raise SourceError(
                f"the definition of {printable(name)} cannot be read"
            ) from error
        new_types |= types_of_text

        # The types of its members, and of the entries of its lists.
        _, members = types_of_text[name]
        for _, entry in members:
            node, detail = entry
            nested: Any = entry
            if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                nested = detail[0]
            if nested[0] == Nodetype.NAME:
                waiting.append(nested[1])

    if new_types:
        store.register(new_types)


def _text(kind: str) -> str:
    """The definition of a type, as its package has it."""
    package, _, name = kind.partition("/msg/")
    prefixes: list[str] = []
    if package.isidentifier() and name.isidentifier():
        prefixes = os.environ.get(PREFIXES, "").split(os.pathsep)
    for prefix in prefixes:
        path = Path(prefix) / "share" / package / "msg" / f"{name}.msg"
        if prefix and path.is_file():
            return path.read_text("utf-8", "replace")
    hint = f"source the setup.bash of its package, which sets {PREFIXES}"
    raise SourceError(f"the definition of {printable(kind[:80])} is not known; {hint}")
