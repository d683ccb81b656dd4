"""Find what a user names as `module:callable`."""

from __future__ import annotations

import difflib
import importlib
import os
import sys
from collections.abc import Callable
from typing import Any

from sparseskin.nodes.errors import SourceError

from .parsed import shown


def find_callable(target: str) -> Callable[..., Any]:
    """Import the module of `target` and return the callable.

    The current directory is put at the head of the module path, as `python -m` does.

    Raises
    ------
    SourceError
        If `target` is not of the form module:callable, there is no such module or attribute,
        the import fails or what is found cannot be called.
    """
    module_name, colon, attribute = target.partition(":")
    parts = [*module_name.split("."), *attribute.split(".")]
    if not colon or not all(part.isidentifier() for part in parts):
        raise SourceError(f"{shown(target)}: expected module:callable, e.g. my_skin:frames")
    here = os.getcwd()
    if here not in sys.path and "" not in sys.path:
        sys.path.insert(0, here)
    importlib.invalidate_caches()
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is not None and f"{module_name}.".startswith(f"{error.name}."):
            raise SourceError(
                f"{target}: there is no module {error.name!r}, installed or in {here}"
            ) from error
        raise SourceError(f"{target}: importing it failed: {one_line(error)}") from error
    # A module that calls sys.exit() as it is imported is no driver either.
    except (Exception, SystemExit) as error:
        raise SourceError(f"{target}: importing it failed: {one_line(error)}") from error
    found: Any = module
    for part in attribute.split("."):
        if not hasattr(found, part):
            near = difflib.get_close_matches(part, dir(found), n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise SourceError(f"{target}: {module_name} has no {attribute!r}{hint}")
        found = getattr(found, part)
    if not callable(found):
        raise SourceError(f"{target}: is {type(found).__name__}, which cannot be called")
    named: Callable[..., Any] = found
    return named


def one_line(error: BaseException) -> str:
    """An exception's type and text, its line breaks made spaces."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
