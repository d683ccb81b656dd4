"""Kinds of export of a bag, by name."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sparseskin.nodes.extensions import EXPORTS, added, load
from sparseskin.nodes.recorder.bag.format import BagError


@dataclass(frozen=True)
class Export:
    """A kind of export."""

    ending: str  # end of the default name of its output
    #: "module:function", imported when it is used: write(bag, out, topics, **options), of a
    #: `BagReader`, a path and topics (None: all with frames), returns the paths written. It raises
    #: BagError.
    target: str
    #: Options of its own: metavar and help of each, and its type, as in argparse; by default a
    #: whole number, 1 or more.
    options: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    several: bool = False  # `bag` is a list of them


_HERE = __name__.rpartition(".")[0]
OWN = {
    "npz": Export(".npz", f"{_HERE}.npz:export_npz"),
    "csv": Export("_csv", f"{_HERE}.csv:export_csv"),
    "skin": Export(".toml", f"{_HERE}.skin:export_skin"),
}
"""Exports of the core."""


def export_names() -> list[str]:
    """Exports of the core, then those of plug-ins."""
    return [*OWN, *added(EXPORTS, OWN)]


def find_export(name: str) -> Export:
    """The export of a name in `export_names`; raises BagError if its plug-in cannot be imported."""
    if name in OWN:
        return OWN[name]
    export: Export = load(EXPORTS, name, BagError, f"--to {name}")
    return export
