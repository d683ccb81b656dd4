"""What plug-ins bring, of this package or of others: entry points, by group and name.

The core imports no plug-in by its name. What it needs it looks up here, when it is asked for.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from typing import TYPE_CHECKING, Any

from .errors import SparseskinError
from .lookup import one_line

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

COMMANDS = "sparseskin_commands"
"""Commands: each a module with `HELP`, one line, and `configure(parser)`, which sets `run` as those
of `sparseskin.launch.commands` do. It is imported for every list of commands, so that its own
imports belong into `configure`."""
NODES = "sparseskin_nodes"
"""Types of nodes: each a subclass of `sparseskin.nodes.node.Node`."""
ADDRESSES = "sparseskin_addresses"
"""Kinds of sources: each a subclass of `sparseskin.nodes.sensor.source.Address`."""
DRIVERS = "sparseskin.sources"
"""Drivers that `sparseskin sources` lists: each a callable, as in the address `module:callable`."""
FILES = "sparseskin_files"
"""Formats of recordings: each a `sparseskin.nodes.sensor.files.format.Format`."""
POINTS = "sparseskin_points"
"""Skins of points, by the name `points`: a `sparseskin.nodes.sensor.points.PointSkins`."""
EXPORTS = "sparseskin_exports"
"""Kinds of export of a bag: each a `sparseskin.nodes.recorder.convert.export.Export`."""
STUDIES = "sparseskin_studies"
"""Studies: each a `sparseskin.studies.command.Study`."""
PHIS = "sparseskin_phis"
"""Kinds of measurement matrices: each a subclass of `sparseskin.nodes.compressor.phi.base.Phi`."""
BASES = "sparseskin_bases"
"""Bases: each a subclass of `sparseskin.nodes.reconstructor.bases.base.Basis`."""
SOLVERS = "sparseskin_solvers"
"""Solvers: each a subclass of `sparseskin.nodes.reconstructor.solvers.base.Solver`."""


@cache
def offered(group: str) -> "dict[str, EntryPoint]":
    """Entry points of a group by name, in alphabetical order."""
    # It takes time, and the core alone needs none.
    from importlib.metadata import entry_points

    by_name = {point.name: point for point in entry_points(group=group)}
    # The order of installed packages is that of the file system.
    return dict(sorted(by_name.items()))


def added(group: str, own: Iterable[str]) -> "dict[str, EntryPoint]":
    """Entry points of a group by name, without those that the core has itself: none replaces it."""
    points = dict(offered(group))
    for name in points.keys() & set(own):
        del points[name]
    return points


class Registry(Mapping[str, str]):
    """Class of each name, as "module:Class": those of the core, then those of plug-ins.

    Entry points are looked up where a name is none of the core's, or where all are asked for: that
    takes time, and the core alone needs none.

    Parameters
    ----------
    group : str
        Group of the entry points.
    core : mapping of str to str
        Those of the core, which no entry point replaces.
    """

    def __init__(self, group: str, core: Mapping[str, str]) -> None:
        self._group = group
        self._core = core

    def __getitem__(self, name: str) -> str:
        # The core first: no look-up, and no plug-in in its place.
        if name in self._core:
            return self._core[name]
        return offered(self._group)[name].value

    def __iter__(self) -> Iterator[str]:
        yield from self._core
        yield from added(self._group, self._core)

    def __len__(self) -> int:
        return len(self._core) + len(added(self._group, self._core))


def load(group: str, name: str, error: type[SparseskinError], where: str = "") -> Any:
    """Import what an entry point names; raise `error`, after `where`, if that fails."""
    point = offered(group)[name]
    try:
        return point.load()
    # A plug-in may raise anything.
    except Exception as cause:
        raise error(
            f"{where or name}: plug-in {point.value}: {one_line(cause)}"
        ) from cause


@cache
def loaded(group: str) -> dict[str, Any]:
    """All of a group that can be imported, by name."""
    objects = {}
    for name in offered(group):
        # One that fails stops no other; `failures` names it.
        with suppress(SparseskinError):
            objects[name] = load(group, name, SparseskinError)
    return objects


def failures(group: str) -> str:
    """The plug-ins of a group that cannot be imported, as the end of an error; "" for none."""
    names = offered(group).keys() - loaded(group).keys()
    if not names:
        return ""
    # Their modules: a name does not tell which package brings it.
    absent = sorted(offered(group)[name].value for name in names)
    return f"; cannot be imported: {', '.join(absent)}"


def forget() -> None:
    """Look entry points up anew, as after an installation."""
    offered.cache_clear()
    loaded.cache_clear()
