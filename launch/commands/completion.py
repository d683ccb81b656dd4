"""The command `sparseskin completion`, and what the words of a command line can become.

Shells, quoting and options are those of argcomplete; here are the values: launch files, settings,
recordings, and nodes, topics and parameters of the graph that runs as the key is pressed.
"""

import argparse
import glob
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparseskin.launch.launchfile import BUNDLED, bundled_names
from sparseskin.nodes import extensions
from sparseskin.nodes.errors import SparseskinError

if TYPE_CHECKING:
    from sparseskin.launch.run.running import RunningGraph

# Imports of one kind of value stand where it is offered: a key is pressed, and a person waits.
# Commands, options, files and names of a graph come without numpy, settings and sources with it.
FILES = ("FILE", "NEW", "PATH", "OUT.json", "F.mcap", "G.mcap", "REC.mcap", "B.npz")
FOLDERS = ("DIR", "D")
"""Metavars of arguments that are files, and folders."""
GRAPH = "graph"
"""Table of a launch file whose keys `launch --set` changes as it does those of a node."""
REPROCESSED = {"compressor": "compressor", "reconstructor": "reconstructor"}
"""Nodes, and their types, that `reprocess` runs."""

Words = Mapping[str, str]
"""Candidates, and what each means; "" if the word is enough."""


def configure(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Print a script with which a shell completes commands, options, launch files and the\n"
        "settings of their nodes, studies, and the nodes, topics and settings of the running graph."
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = (
        "bash: add to ~/.bashrc       source <(sparseskin completion bash)\n"
        "zsh:  add to ~/.zshrc        source <(sparseskin completion zsh)\n"
        "fish: add to config.fish     sparseskin completion fish | source"
    )
    parser.add_argument("shell", choices=("bash", "zsh", "fish"), help="which shell")
    parser.set_defaults(run=_print)


def _print(arguments: argparse.Namespace) -> int:
    from argcomplete.shell_integration import shellcode

    # No fallback to file names: where a file is expected, `candidates` offers them.
    # Without a space: behind "sensor." a key follows.
    options = ["-o", "nospace"]
    print(shellcode(["sparseskin"], False, arguments.shell, options))
    return 0


def candidates(
    *, prefix: str, action: argparse.Action, parsed_args: argparse.Namespace, **_: Any
) -> Words:
    """Values of an argument that begin with what has been typed; its metavar names their kind."""
    try:
        # No word is offered where an error would be printed into the prompt.
        words = _values(prefix, str(action.metavar), parsed_args)
    except SparseskinError:
        # No graph runs, or it is not clear which is meant.
        return {}
    return {word: about for word, about in words.items() if word.startswith(prefix)}


def _values(prefix: str, metavar: str, typed: argparse.Namespace) -> Words:
    match metavar:
        case "NODE":
            return {name: node.type_name for name, node in _graph(typed).nodes.items()}
        case "TOPIC":
            return _graph(typed).writers()
        case "NAME|PID":
            from sparseskin.launch.run.running import running_graphs

            return _bare(_labels(running_graphs()))
        case "KEY" | "VALUE":
            return _parameters(metavar, typed)
        case "FIELD":
            from sparseskin.messages.base import wire_fields
            from sparseskin.messages.wire import SCHEMAS

            schema = (typed.topic or "").rpartition("/")[2]
            if schema not in SCHEMAS:
                return {}
            return _bare(wire_fields(SCHEMAS[schema]))
        case "NODE.KEY=VALUE":
            if "name" not in typed:
                return _overrides(prefix, REPROCESSED)
            types = node_types(typed.name or "")
            if not types:
                return {}
            return _overrides(prefix, {GRAPH: f"[{GRAPH}]"} | types)
        case "SOURCE":
            return sources(prefix)
        case "NAME|FILE":
            return _bare(bundled_names()) | _paths(prefix, folders_only=False)
    if metavar in FILES or metavar in FOLDERS:
        return _paths(prefix, folders_only=metavar in FOLDERS)
    return {}


def _bare(words: Any) -> dict[str, str]:
    return dict.fromkeys(words, "")


def _labels(graphs: Sequence["RunningGraph"]) -> list[str]:
    """Names of graphs; of those of one name the labels."""
    names = [graph.name for graph in graphs]
    labels = []
    for graph in graphs:
        is_unique = names.count(graph.name) == 1
        label = graph.label
        if is_unique:
            label = graph.name
        labels.append(label)
    return labels


def _graph(typed: argparse.Namespace) -> "RunningGraph":
    from sparseskin.launch.run.running import choose_graph

    return choose_graph(getattr(typed, "graph", None))


def _parameters(metavar: str, typed: argparse.Namespace) -> Words:
    """Parameters of a node of the running graph, those that can be set for `param set`; values."""
    from sparseskin.launch.attach.client import describe_node

    # Only live settings can be set; all can be read.
    entries = describe_node(_graph(typed), typed.node)["settings"]
    is_set = "value" in typed
    if metavar == "KEY":
        return {
            entry["key"]: entry["doc"]
            for entry in entries
            if entry["live"] or not is_set
        }

    words: list[str] = []
    for entry in entries:
        if entry["key"] == typed.key:
            words += offered_values(entry)
    return _bare(words)


def offered_values(entry: Mapping[str, Any]) -> list[str]:
    """Values of a described setting, as far as they can be listed."""
    words = [*entry["choices"], *entry["known"]]
    if entry["type"] == "bool":
        words += ["true", "false"]
    if "None" in entry["type"]:
        words.append("none")
    return words


def _overrides(prefix: str, types: Mapping[str, str]) -> Words:
    """Of NODE.KEY=VALUE the nodes, or the keys of the only node that fits, or the values."""
    # What has been typed decides what comes next: node, key or value.
    node, dot, setting = prefix.partition(".")
    if dot:
        fitting = [name for name in types if name == node]
    else:
        fitting = [name for name in types if name.startswith(node)]
    # Of several the shell shows the names; of one it goes on to its keys.
    if len(fitting) != 1:
        return {f"{name}.": types[name] for name in fitting}

    name = fitting[0]
    # No graph runs yet: these are the declared ones.
    entries = declared_settings(types[name])
    key, equals, value = setting.partition("=")
    if not equals:
        return {f"{name}.{entry['key']}=": entry["doc"] for entry in entries}
    if types[name] == "sensor" and key == "source":
        return {
            f"{name}.source={word}": about for word, about in sources(value).items()
        }
    values: list[str] = []
    for entry in entries:
        if entry["key"] == key:
            values += offered_values(entry)
    return _bare(f"{name}.{key}={word}" for word in values)


def sources(prefix: str) -> Words:
    """Sources that begin with what has been typed: kinds, then scenes, files, and what a plug-in
    offers of its kind.
    """
    from sparseskin.nodes.sensor.scenes.scenes import SCENES

    # The kind of a source decides what may follow it.
    kind, colon, address = prefix.partition(":")
    offers = extensions.offered(extensions.ADDRESSES)
    if not colon:
        return _bare(f"{name}:" for name in ("scene", "file", *offers))
    if kind == "scene":
        return _bare(f"scene:{name}" for name in SCENES)
    if kind == "file":
        return _bare(f"file:{path}" for path in _paths(address, folders_only=False))
    if kind in offers:
        plugin = extensions.load(extensions.ADDRESSES, kind, SparseskinError)
        return dict(plugin.completions(prefix))
    return {}


def declared_settings(type_name: str) -> list[Mapping[str, Any]]:
    """Descriptions of the settings of a type of node, or of the table "[graph]"; none of a user's
    own type, whose code a key press does not run.
    """
    from sparseskin.nodes import registry

    if type_name == f"[{GRAPH}]":
        from sparseskin.launch.launchfile.check import GRAPH_TABLES

        return [entry for cls in GRAPH_TABLES for entry in cls.described()]
    target = registry.NODE_TYPES.get(type_name, "")
    if not target.startswith("sparseskin."):
        return []
    settings = registry.node_class(type_name).Settings
    described: list[Mapping[str, Any]] = settings.described()
    return described


def node_types(name: str) -> dict[str, str]:
    """Type of each node of a launch file, by its name; none where it cannot be read."""
    import tomllib

    try:
        # A bundled launch file, or one that is named by its path.
        path = Path(name).expanduser()
        if path.suffix != ".toml" and len(path.parts) < 2:
            path = BUNDLED / f"{name}.toml"
        launch = tomllib.loads(path.read_text(encoding="utf-8"))
        tables = launch.get("nodes", {})
        return {name: str(table.get("type", "")) for name, table in tables.items()}
    except (OSError, ValueError, RuntimeError, AttributeError):
        # The command names the fault when it is run.
        return {}


def _paths(prefix: str, folders_only: bool) -> dict[str, str]:
    """Files and folders that begin with a path as it was typed; a folder ends in "/"."""
    folder, slash, begun = prefix.rpartition("/")
    # What was typed stays as it is, "~" too.
    typed = folder + slash
    place = Path(os.path.expanduser(typed))
    words = []
    for name in sorted(glob.glob(f"{glob.escape(begun)}*", root_dir=place)):
        if (place / name).is_dir():
            words.append(f"{typed}{name}/")
        elif not folders_only:
            words.append(f"{typed}{name}")
    return _bare(words)
