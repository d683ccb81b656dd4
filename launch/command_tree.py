"""The command line as plain data, for the completion of a shell: commands, options, and of what
kind each value is.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

from sparseskin.messages.base import wire_fields
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.registry import NODE_TYPES, node_class

from .completion_words import FILES, offered_values
from .scenes_command import SCENARIOS

KINDS = {
    "NODE": "node",
    "TOPIC": "topic",
    "KEY": "key",
    "VALUE": "value",
    "FIELD": "field",
    "KEY VALUE": "key-value",
    "NAME|PID": "graph",
    "NAME|FILE.toml": "launch",
    "NODE.KEY=VALUE": "override",
    "DIR": "folder",
    **dict.fromkeys(("FILE", "BAG", "NEW", "PATH", "F.mcap", "OUT.json", "OUT.mcap"), "file"),
}
"""What the values of an argument are, by its metavar; of others nothing is offered."""


def whole_tree(
    parser: argparse.ArgumentParser, words: Mapping[str, Sequence[str]] | None = None
) -> dict[str, Any]:
    """The tree of a whole command line, and with it `fields`: those of the messages of each
    schema, and `settings`: those of each type of node, with words that each may be.

    Parameters
    ----------
    parser : ArgumentParser
        Of the whole command line.
    words : mapping of str to sequence of str, optional
        What an argument may be, by its metavar, beside `KINDS`.
    """
    fields = {schema: list(wire_fields(cls)) for schema, cls in SCHEMAS.items()}
    settings = {
        name: {e["key"]: offered_values(e) for e in node_class(name).Settings.described()}
        for name in NODE_TYPES
    }
    kinds = KINDS | {metavar: list(known) for metavar, known in (words or {}).items()}
    return {**command_tree(parser, kinds), "fields": fields, "settings": settings}


def command_tree(
    parser: argparse.ArgumentParser, kinds: Mapping[str, str | list[str]]
) -> dict[str, Any]:
    """Of a parser: `commands` (name: tree), `options` (name: kind of value, or "" for none), and
    `arguments` (kinds of the positionals, the last one repeated where "..." follows it). A kind
    is one of `kinds`, or a list of words.
    """
    tree: dict[str, Any] = {"commands": {}, "options": {}, "arguments": []}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                tree["commands"][name] = command_tree(inner, kinds)
        elif action.option_strings:
            kind = "" if action.nargs == 0 else _kind(action, kinds)
            tree["options"] |= dict.fromkeys(action.option_strings, kind)
        else:
            tree["arguments"].append(_kind(action, kinds))
            if action.nargs in ("*", "+"):
                tree["arguments"].append("...")
    return tree


def _kind(action: argparse.Action, kinds: Mapping[str, str | list[str]]) -> str | list[str]:
    if action.choices is not None:
        return [str(choice) for choice in action.choices]
    if "--graph" in action.option_strings:
        return "graph"
    if action.metavar == "F.mcap|NAME":
        return [*SCENARIOS, FILES]
    return kinds.get(str(action.metavar), [])
