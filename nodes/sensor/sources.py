"""Sources by their addresses: a scene, a file, a board, a model, a ROS 2 topic, or a driver."""

from __future__ import annotations

import re
import symtable
from functools import lru_cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import (
    did_you_mean,
    is_missing,
    note_import,
    one_line,
    search_here,
)
from sparseskin.nodes.sensor.files.parsed import DEFAULT_POLICY, Policy

from .driver import open_callable
from .source import Address, Source

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

SCENE = "scene:"
FILE = "file:"
FORMS = (
    "scene:NAME, file:PATH, mujoco:MODEL.xml#SITE, serial:DEVICE, udp:PORT, can:CHANNEL, "
    "ros2:/TOPIC or module:callable"
)
KINDS = {
    "scene": "sparseskin.nodes.sensor.scenes.address:SceneAddress",
    "file": "sparseskin.nodes.sensor.files.address:FileAddress",
    "mujoco": "sparseskin.nodes.sensor.simulators.source:MujocoAddress",
    "serial": "sparseskin.nodes.sensor.boards.source:BoardAddress",
    "udp": "sparseskin.nodes.sensor.boards.source:BoardAddress",
    "can": "sparseskin.nodes.sensor.boards.source:BoardAddress",
    "ros2": "sparseskin.nodes.bridges.ros2_source:Ros2Address",
}
"""Class of the addresses of each kind, imported where one is used."""
GROUP = "sparseskin_addresses"
"""Group of entry points with which another package brings a kind: its name, and such a class."""


def find_address(source: str, **stated: Any) -> Address:
    """Return the address of a source.

    Parameters
    ----------
    source : str
        One of the forms in `FORMS`, or of a kind that another package brings.
    **stated
        What settings state of it: attributes of `Address`.

    Raises
    ------
    SourceError
        If it has none of these forms, or the package of its kind cannot be imported.
    """
    kind, colon, rest = source.partition(":")
    if not (kind and colon and rest):
        from .scenes.scenes import SCENES

        hint = f' (did you mean "{SCENE}{source}"?)' if source in SCENES else ""
        raise SourceError(f'source "{source}": expected {FORMS}{hint}')
    made: type[Address] = DriverAddress
    if kind in KINDS:
        module, _, name = KINDS[kind].partition(":")
        made = getattr(import_module(module), name)
    elif kind in offered_kinds():
        try:
            made = offered_kinds()[kind].load()
        except Exception as error:
            raise SourceError(f"{source}: importing {kind} failed: {one_line(error)}") from error
    return made(source, **stated)


@lru_cache(maxsize=1)
def offered_kinds() -> dict[str, EntryPoint]:
    """Kinds that other packages bring, by name."""
    from importlib.metadata import entry_points  # takes time, and few sources need it

    return {point.name: point for point in entry_points(group=GROUP)}


def check_source(
    source: str,
    n_rows: int | None = None,
    n_cols: int | None = None,
    unit: str | None = None,
    policy: Policy = DEFAULT_POLICY,
) -> None:
    """Check that a source exists, without opening it; of a file the begin is read. Arguments as of
    `open_source`.

    Raises
    ------
    SourceError
        As `find_address` and `Address.check`.
    """
    find_address(source, n_rows=n_rows, n_cols=n_cols, unit=unit, policy=policy).check()


class DriverAddress(Address):
    """A driver of a user's own: module:callable."""

    def check(self) -> None:
        check_module(self.source)

    def open(self) -> Source:
        self.check()
        driver = open_callable(self.source, f_max=self.f_max, unit=self.unit, raw=self.raw)
        driver.check_shape(self.n_rows, self.n_cols)
        return driver


def check_module(target: str) -> None:
    """Check that the module of a driver exists and that its source names the callable, without
    importing it; the packages that it is in are imported.

    Raises
    ------
    SourceError
        If it does not.
    """
    module, _, attribute = target.partition(":")
    package = module.rpartition(".")[0]
    note_import(package)
    here = search_here(module)
    found = None
    try:
        found = find_spec(module)
    except ModuleNotFoundError as cause:
        if not is_missing(package, cause) and cause.name != module:
            raise SourceError(f"{target}: importing {package} failed: {one_line(cause)}") from cause
    except (Exception, SystemExit) as cause:
        if package:
            raise SourceError(f"{target}: importing {package} failed: {one_line(cause)}") from cause
    if found is None:
        hint = did_you_mean(module, KINDS) if len(module) < 8 else ""
        hint = hint if "did you mean" in hint else ""
        raise SourceError(f"{target}: there is no module {module!r}, installed or in {here}{hint}")
    names = _names_of(Path(found.origin)) if found.origin else None
    if names is not None and attribute.partition(".")[0] not in names:
        near = did_you_mean(attribute, names)
        hint = near if "did you mean" in near else "; allowed: a callable of that module"
        raise SourceError(f"{target}: {module} has no {attribute!r}{hint}")


def _names_of(path: Path) -> set[str] | None:
    """Names that the source of a module binds; None where it cannot be read, or binds more than its
    statements show.
    """
    if path.name == "__init__.py":
        return None  # its modules are names of it, too
    try:
        table = symtable.symtable(path.read_bytes(), str(path), "exec")  # type: ignore[arg-type]
        source = path.read_text(encoding="utf-8")
    except (OSError, ValueError, SyntaxError):
        return None
    if re.search(r"import +\*|__getattr__|global|vars\(|setattr|exec\(|__dict__|modules", source):
        return None
    return {
        name.get_name() for name in table.get_symbols() if name.is_assigned() or name.is_imported()
    }


def open_source(
    source: str,
    *,
    seed: int,
    n_rows: int | None = None,
    n_cols: int | None = None,
    unit: str | None = None,
    f_max: float | None = None,
    policy: Policy = DEFAULT_POLICY,
    raw: bool = False,
) -> Source:
    """Open a source.

    Parameters
    ----------
    source : str
        One of the forms in `FORMS`.
    seed : int
        Seed of a scene; not used by files and drivers.
    n_rows, n_cols, unit, f_max
        Properties that a file, board or driver does not state, as in `open_file`, `describe_board`
        and `open_callable`.
    policy : Policy
        What to do with readings of a file that are not finite or below 0.
    raw : bool
        True: readings may have any sign and size, as a calibration converts them.

    Raises
    ------
    SourceError
        If the source is missing or malformed, or a setting contradicts it.
    """
    stated = {"n_rows": n_rows, "n_cols": n_cols, "unit": unit, "f_max": f_max}
    return find_address(source, seed=seed, policy=policy, raw=raw, **stated).open()
