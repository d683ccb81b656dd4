"""Launch files: TOML, read and checked whole before any process starts."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sparseskin.nodes.arguments import checked
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.lookup import did_you_mean, search_in
from sparseskin.nodes.registry import node_class
from sparseskin.nodes.toml import MAX_CHARS, parse_toml

from . import BUNDLED as BUNDLED
from . import bundled_names as bundled_names
from .check import Checker, one_line_of
from .spec import LaunchError as LaunchError
from .spec import LaunchFile as LaunchFile
from .spec import NodeSpec
from .tables import Table

_TOML_PLACE = re.compile(r" \(at line (\d+), column (\d+)\)$")


def single_node(name: str, type_name: str, values: Table) -> LaunchFile:
    """A graph of one node, as commands make it; its inputs are joined to another graph.
    Raises SparseskinError if a setting is not allowed.
    """
    cls = node_class(type_name)
    settings = cls.Settings.from_mapping(values)
    # With what depends on this host, as a file that exists already.
    settings.check()
    spec = NodeSpec(name, type_name, cls, values, settings)
    return LaunchFile(name, "", "ipc", {name: spec}, [])


def find_launch_file(name: str) -> Path:
    """The file behind NAME or FILE.toml.
    Raises LaunchError if there is none.
    """
    path = Path(name)
    if path.suffix == ".toml" or len(path.parts) > 1:
        if not path.is_file():
            problem = "no such launch file"
            if path.exists():
                # A pipe would be waited for.
                problem = "is no regular file"
            raise LaunchError([f"{name}: {problem}"])
        return path
    if name not in bundled_names():
        if path.suffix:
            raise LaunchError([f"{name}: no such file"])
        hint = did_you_mean(name, bundled_names())
        raise LaunchError([f"{name}: no launch file of that name{hint}"])
    return BUNDLED / f"{name}.toml"


@checked(SparseskinError)
def load(
    name: str, overrides: Sequence[str] = (), record: str | None = None
) -> LaunchFile:
    """Read and check a launch file; modules that it names are searched in its folder too.

    Parameters
    ----------
    name : str
        Name of a bundled launch file, or a path that ends in .toml.
    overrides : sequence of str
        "NODE.KEY=VALUE", or "graph.KEY=VALUE" for a key of the table [graph], each; VALUE is TOML,
        or else a text as it stands.
    record : str, optional
        File into which a recorder, added to the nodes, writes all topics.

    Raises
    ------
    LaunchError
        With every error that was found, one line each.
    """
    if isinstance(overrides, str):
        raise LaunchError(
            [f'settings: expected a list, as ["{overrides}"], not a text']
        )
    path = find_launch_file(name)
    title = path.name
    folder = ""
    if path.parent != BUNDLED:
        title = str(path)
        folder = str(path.resolve().parent)
    try:
        # No further than what shows that it is too long.
        with path.open(encoding="utf-8") as file:
            text = file.read(MAX_CHARS + 1)
        tree = parse_toml(text)
    except (OSError, ValueError) as error:
        raise LaunchError([_unreadable(title, error)]) from error
    if folder:
        search_in(folder)
    checker = Checker(title, text, tree, path.stem, path.parent)
    launch = checker.check(overrides, record)
    return replace(launch, folder=folder)


def _unreadable(shown: str, error: Exception) -> str:
    """The line for a file that is no TOML, with the place where the parser names one."""
    text = one_line_of(error)
    place = _TOML_PLACE.search(text)
    if place is None:
        return f"{shown}: not a TOML file: {text}"
    # The line is part of the place, as editors read it.
    line, column = place.groups()
    return f"{shown}:{line}: not TOML: {text[: place.start()]}, column {column}"


def load_tables(
    name: str, tables: dict[str, Table], overrides: Sequence[str] = ()
) -> LaunchFile:
    """Check a launch file that a program made: its tables [nodes.NAME].
    Raises SparseskinError with the first error that was found.
    """
    # A text too, which a recording keeps; JSON values of these are TOML as well.
    lines = []
    for node, table in tables.items():
        lines.append(f"[nodes.{node}]\n")
        lines += [f"{key} = {json.dumps(value)}\n" for key, value in table.items()]
    checker = Checker(name, "".join(lines), {"nodes": tables}, name)
    try:
        return checker.check(overrides, None)
    except LaunchError as error:
        raise SparseskinError(error.lines[0]) from error
