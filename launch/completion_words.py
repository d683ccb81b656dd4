"""What a shell may complete a word to: `sparseskin __complete`, which a completion script calls.

Its standard input is the tree of commands that the script holds, its arguments are the words so
far. Nothing heavy is imported here: it is waited for at every press of the key.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sparseskin.nodes.errors import SparseskinError

from .completion_overrides import OF_RECORDINGS, node_types, override_words
from .inspection import describe_node
from .running import RunningGraph, choose_graph, running_graphs

Kind = str | list[str]

FILES = ":files"
FOLDERS = ":folders"
"""Told in place of words where the shell itself is to offer files, or folders."""


def main() -> int:
    """Print one word a line."""
    tree = json.load(sys.stdin)
    for word in complete(tree, sys.argv[2:]):
        print(word)
    return 0


def complete(tree: dict[str, Any], words: Sequence[str]) -> list[str]:
    """What the last word may become.

    Parameters
    ----------
    tree : dict
        From `sparseskin.launch.command_tree.whole_tree`.
    words : sequence of str
        The words after the name of the program, up to the one that is being typed, "" for one
        that has not begun; cut at "=" and ":", as bash does, or not.

    Returns
    -------
    list of str
        Words in place of the last one, which bash has cut or nobody has.
    """
    joined, head = joined_words(words or [""])
    return [word.removeprefix(head) for word in _complete(tree, joined)]


def joined_words(words: Sequence[str]) -> tuple[list[str], str]:
    """Words as they were typed, where bash has made marks, "=" and ":", words of their own; and
    the part of the last one that is no longer the one that bash completes.
    """
    joined: list[str] = []
    head, after_mark = "", False
    for word in words:
        is_mark = bool(word) and not word.strip("=:")
        if joined and (is_mark or after_mark):
            head = joined[-1] + (word if is_mark else "")
            joined[-1] += word
        else:
            head = ""
            joined.append(word)
        after_mark = is_mark
    return joined, head


def _complete(tree: dict[str, Any], words: Sequence[str]) -> list[str]:
    *before, last = words
    fields: dict[str, list[str]] = tree["fields"]
    settings: dict[str, dict[str, list[str]]] = tree["settings"]
    values: list[str] = []
    graph_name: str | None = None
    option = ""
    for word in before:
        name, equals, value = word.partition("=")
        if option or (equals and _takes_value(tree, name)):
            graph_name = (value or word) if "--graph" in (option, name) else graph_name
            option = ""
        elif _takes_value(tree, word):
            option = word
        elif word in tree["commands"]:
            tree = tree["commands"][word]
        elif not word.startswith("-"):
            values.append(word)
    prefix = ""
    if option:
        kind = tree["options"][option]
    elif "=" in last and _takes_value(tree, last.partition("=")[0]):
        name, equals, last = last.partition("=")
        kind, prefix = tree["options"][name], name + equals
    elif last.startswith("-"):
        return _fitting(tree["options"], last)
    elif tree["commands"]:
        return _fitting(tree["commands"], last)
    else:
        kind = _kind_at(tree["arguments"], len(values))
    if kind == "override":
        of_launch = tree["arguments"][:1] == ["launch"]
        types = node_types(values[0] if values else "") if of_launch else OF_RECORDINGS
        found = override_words(types, settings, last)
        return [prefix + word for word in _fitting(found, last)]
    if kind == "field":
        schema = values[0].rpartition("/")[2] if values else ""
        kind = fields.get(schema, [])
    to_set = "value" in tree["arguments"]
    try:
        found = _words_of(kind, values, to_set, lambda: choose_graph(graph_name))
    except SparseskinError:
        return []  # no graph runs, or it is not said which: there is nothing to offer
    return [word if word.startswith(":") else prefix + word for word in _fitting(found, last)]


def _takes_value(tree: dict[str, Any], option: str) -> bool:
    return bool(tree["options"].get(option, "") != "")


def _kind_at(kinds: Sequence[Kind], index: int) -> Kind:
    """Kind of the positional argument of that number."""
    if kinds[-1:] == ["..."] and index >= len(kinds) - 2:
        if kinds[-2] == "key-value":
            return "key" if (index - len(kinds)) % 2 == 0 else "value"
        return kinds[-2]
    return kinds[index] if index < len(kinds) else []


def _words_of(
    kind: Kind, values: Sequence[str], to_set: bool, graph: Callable[[], RunningGraph]
) -> list[str]:
    if isinstance(kind, list):
        return kind
    match kind:
        case "node":
            return list(graph().nodes)
        case "topic":
            return list(graph().writers())
        case "graph":
            graphs = running_graphs()
            names = [one.name for one in graphs]
            return [one.name if names.count(one.name) == 1 else one.label for one in graphs]
        case "key":
            settings = _settings(graph(), values)
            return [entry["key"] for entry in settings if entry["live"] or not to_set]
        case "value":
            found = [e for e in _settings(graph(), values) if e["key"] == values[-1]]
            return offered_values(found[0]) if found else []
        case "launch":
            return [*sorted(path.stem for path in Path(__file__).parent.glob("*.toml")), FILES]
    return [FOLDERS if kind == "folder" else FILES]


def _settings(graph: RunningGraph, values: Sequence[str]) -> list[dict[str, Any]]:
    """The settings of the node that was named."""
    settings: list[dict[str, Any]] = describe_node(graph, values[0])["settings"]
    return settings


def offered_values(entry: Mapping[str, Any]) -> list[str]:
    """Words that a described setting may be."""
    words = [*entry["choices"], *entry["known"]]
    if entry["type"] == "bool":
        words += ["true", "false"]
    return words + ["none"] * ("None" in entry["type"])


def _fitting(words: Iterable[str], begun: str) -> list[str]:
    return [word for word in words if word.startswith((begun, ":"))]
