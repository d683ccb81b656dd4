"""The command line as plain data, for the completion of a shell: commands, options, and of what
kind each value is.
"""

from __future__ import annotations

import argparse
from typing import Any

from sparseskin.messages.base import wire_fields
from sparseskin.messages.wire import SCHEMAS

from .completion_words import FILES
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
    "DIR": "folder",
    **dict.fromkeys(("FILE", "BAG", "NEW", "PATH", "F.mcap", "OUT.json", "OUT.mcap"), "file"),
}
"""What the values of an argument are, by its metavar; of others nothing is offered."""


def whole_tree(parser: argparse.ArgumentParser) -> dict[str, Any]:
    """The tree of a whole command line, and with it `fields`: those of the messages of each
    schema.
    """
    fields = {schema: list(wire_fields(cls)) for schema, cls in SCHEMAS.items()}
    return {**command_tree(parser), "fields": fields}


def command_tree(parser: argparse.ArgumentParser) -> dict[str, Any]:
    """Of a parser: `commands` (name: tree), `options` (name: kind of value, or "" for none), and
    `arguments` (kinds of the positionals, the last one repeated where "..." follows it). A kind
    is one of `KINDS`, or a list of words.
    """
    tree: dict[str, Any] = {"commands": {}, "options": {}, "arguments": []}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                tree["commands"][name] = command_tree(inner)
        elif action.option_strings:
            kind = "" if action.nargs == 0 else _kind(action)
            tree["options"] |= dict.fromkeys(action.option_strings, kind)
        else:
            tree["arguments"].append(_kind(action))
            if action.nargs in ("*", "+"):
                tree["arguments"].append("...")
    return tree


def _kind(action: argparse.Action) -> str | list[str]:
    if action.choices is not None:
        return [str(choice) for choice in action.choices]
    if "--graph" in action.option_strings:
        return "graph"
    if action.metavar == "F.mcap|NAME":
        return [*SCENARIOS, FILES]
    return KINDS.get(str(action.metavar), [])
