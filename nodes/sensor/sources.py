"""Sources by their addresses: a scene, a file, a driver, or of a kind that a plug-in brings."""

import os
from importlib.util import find_spec
from typing import Any, cast

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.extensions import ADDRESSES, added, failures, load, loaded
from sparseskin.nodes.lookup import (
    find_callable,
    is_missing,
    one_line,
    search_here,
    suggestion,
)

from .driver import open_callable
from .source import Address, Source

SCENE = "scene:"
FILE = "file:"
KINDS = {
    "scene": "sparseskin.nodes.sensor.scenes.address:SceneAddress",
    "file": "sparseskin.nodes.sensor.files.address:FileAddress",
    "example": "sparseskin.nodes.sensor.files.address:ExampleAddress",
}
"""Class of the addresses of each kind of the core, imported where one is used."""


def kinds() -> list[str]:
    """Kinds of the core, then those of plug-ins."""
    return [*KINDS, *added(ADDRESSES, KINDS)]


def find_kind(kind: str, where: str = "") -> type[Address]:
    """Class of the addresses of one of `kinds`. Raises SourceError, after `where`, if its plug-in
    cannot be imported.
    """
    if kind in KINDS:
        return cast("type[Address]", find_callable(KINDS[kind], SourceError))
    address: type[Address] = load(ADDRESSES, kind, SourceError, where)
    return address


def forms() -> str:
    """The forms of addresses."""
    forms_of_kinds = [find_kind(kind).form for kind in KINDS]
    # A plug-in cannot take the place of a kind of the core.
    for kind, address in loaded(ADDRESSES).items():
        if kind not in KINDS:
            forms_of_kinds.append(address.form)
    return f"{', '.join(forms_of_kinds)} or {Address.form}{failures(ADDRESSES)}"


def find_address(source: str, **stated: Any) -> Address:
    """The address of a source, one of `forms`, with what settings state of it: attributes of
    `Address`. Raises SourceError if it has none of these forms, or the plug-in of its kind is
    missing, or cannot be imported.
    """
    kind, colon, name = source.partition(":")
    if not (kind and colon and name):
        hint = _kind_hint(source)
        raise SourceError(f'source "{source}": expected {forms()}{hint}')

    # Plug-ins are looked up for what is no kind of the core.
    if kind in KINDS or kind in kinds():
        return find_kind(kind, source)(source, **stated)

    # "serial:/dev/x" of a missing plug-in is no driver: its name is no name of Python.
    if not all(part.isidentifier() for part in name.split(".")):
        raise SourceError(
            f"{source}: no plug-in for sources {kind}: is "
            f"installed{suggestion(kind, kinds())}; expected {forms()}"
        )
    return DriverAddress(source, **stated)


def _kind_hint(source: str) -> str:
    """A question whether a scene or a file is meant, where the kind is missing."""
    # Imported for this line alone: it loads the simulation.
    from .scenes.scenes import SCENES

    if source in SCENES:
        return f' (did you mean "{SCENE}{source}"?)'
    if os.path.exists(source):
        return f' (did you mean "{FILE}{source}"?)'
    return ""


class DriverAddress(Address):
    """A driver of a user's own: module:callable."""

    keys = (
        "n_rows",
        "n_cols",
        "axes",
        "order",
        "row_order",
        "col_order",
        "channel",
        "unit",
        "f_max",
        "missing",
        "nan",
        "negative",
    )

    def check(self) -> None:
        check_module(self.source)

    def open(self) -> Source:
        self.check()
        return open_callable(self)


def check_module(target: str) -> None:
    """Raise SourceError unless the module of a driver exists. It is not imported; the packages that
    it is in are.
    """
    module = target.partition(":")[0]
    package = module.rpartition(".")[0]
    # A driver may lie in the current directory, which is not on the path of a command.
    folder = search_here(module)
    spec = None
    try:
        spec = find_spec(module)
    except ModuleNotFoundError as cause:
        if not is_missing(package, cause) and cause.name != module:
            raise SourceError(
                f"{target}: importing {package} failed: {one_line(cause)}"
            ) from cause
    # A package of a user's own may do anything as it is imported.
    except (Exception, SystemExit) as cause:
        if package:
            raise SourceError(
                f"{target}: importing {package} failed: {one_line(cause)}"
            ) from cause
    if spec is not None:
        return

    # A short name may be a kind of source that was not spelled right.
    hint = ""
    if len(module) < 8:
        hint = suggestion(module, kinds())
    raise SourceError(
        f"{target}: there is no module {module!r}, installed or in {folder}{hint}"
    )


def open_source(source: str, **stated: Any) -> Source:
    """Open a source: arguments as of `find_address`. Raises SourceError if it is missing or
    malformed, or a setting contradicts it.
    """
    address = find_address(source, **stated)
    address.check()
    return address.open()
