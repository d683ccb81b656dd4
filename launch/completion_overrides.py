"""What `--set NODE.KEY=VALUE` may become: the nodes of a launch file, their settings, their values.

Nothing of the user's own is imported for it: of a type `module:Class` no settings are offered.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

OF_RECORDINGS = {"compressor": "compressor", "reconstructor": "reconstructor"}
"""The nodes, and their types, where no launch file but recordings are named."""


def override_words(
    types: Mapping[str, str], settings: Mapping[str, Mapping[str, Sequence[str]]], begun: str
) -> list[str]:
    """Words that begin like the one being typed, as far as the next "." or "=".

    Parameters
    ----------
    types : mapping of str to str
        Type of each node, by its name.
    settings : mapping of str to mapping
        Of each type, its settings, and words that each may be.
    begun : str
        What has been typed.
    """
    node, dot, rest = begun.partition(".")
    if not dot:
        return [f"{name}." for name in types]
    keys = settings.get(types.get(node, ""), {})
    key, equals, _ = rest.partition("=")
    if not equals:
        return [f"{node}.{name}=" for name in keys]
    return [f"{node}.{key}={value}" for value in keys.get(key, ())]


def node_types(name: str) -> dict[str, str]:
    """Type of each node of a launch file, by its name; none where there is no such file."""
    path = Path(name).expanduser()
    if path.suffix != ".toml" and len(path.parts) < 2:
        path = Path(__file__).parent / f"{name}.toml"
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8")).get("nodes", {})
        return {name: str(table.get("type", "")) for name, table in tables.items()}
    except (OSError, ValueError, RecursionError, AttributeError):
        return {}  # there is time to say so when the command is run
