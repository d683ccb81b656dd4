"""Tables of a launch file as settings: one reader of types, ranges and unknown keys for all."""

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

from sparseskin.messages.errors import MessageError
from sparseskin.messages.topics import check_name
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.settings import Settings

Table = dict[str, Any]
"""A table of TOML: its values by their keys."""
Place = tuple[str, ...]
"""Keys that lead to a value, from the outermost table on."""
Fault = Callable[[Place, str], None]
"""Called with the place and the text of each error."""


def read_table(
    table: object,
    place: Place,
    fault: Fault,
    *defaults: Settings,
    more: bool = False,
) -> tuple[list[Any], Table]:
    """The settings `defaults` with the values that a table states; with `more`, the values of other
    keys too, which are refused otherwise.
    """
    settings = list(defaults)
    index_of_key: dict[str, int] = {}
    for index, default in enumerate(defaults):
        index_of_key |= {field.name: index for field in fields(default)}
    of_other_keys: Table = {}
    if not isinstance(table, dict):
        fault(place, f"expected a table [{'.'.join(place)}]")
        return settings, of_other_keys
    for key, value in table.items():
        if key not in index_of_key:
            of_other_keys[key] = value
            if not more:
                fault((*place, key), f"unknown key{did_you_mean(key, index_of_key)}")
            continue
        index = index_of_key[key]
        try:
            # One key at a time, so that each fault is reported with its place.
            settings[index] = replace(settings[index], **{key: value})
        except SettingsError as error:
            fault((*place, key), str(error).removeprefix(f"{key}: "))
    return settings, of_other_keys


def read_tables(
    tree: Mapping[str, Any], kind: str, most: int, fault: Fault
) -> dict[str, Table]:
    """The tables [KIND.NAME] whose names are allowed, `most` at most."""
    tables = tree.get(kind, {})
    if not isinstance(tables, dict):
        fault((kind,), f"expected tables [{kind}.NAME]")
        return {}
    if len(tables) > most:
        fault((kind,), f"{len(tables)} {kind}; at most {most} are allowed")
        return {}
    good = {}
    for name, table in tables.items():
        if not isinstance(table, dict):
            fault((kind, name), f"expected a table [{kind}.{name}]")
            continue
        reason = bad_name(name)
        if reason:
            fault((kind, name), reason)
            continue
        # A copy: --set and hosts change it, and the tree stays as it was read.
        good[name] = dict(table)
    return good


def bad_name(name: object) -> str:
    """Why a text cannot name a node, a host or a key; "" if it can."""
    try:
        check_name("name", name)
    except MessageError as error:
        return str(error).removeprefix("name: ")
    return ""
