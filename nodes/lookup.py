"""Names in launch files: registered ones, or a user's own as "module:attribute"."""

import difflib
import importlib
import importlib.util
import os
import sys
import traceback
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from typing import Any

from .errors import SparseskinError

_SEARCHED: list[str] = []
"""Folders of launch files in which modules are searched; as `sys.path`, of the whole process."""


def search_in(folder: str) -> None:
    """Search modules that are not installed in a folder too, as in that of a script."""
    if folder not in _SEARCHED:
        _SEARCHED.append(folder)


def search_here(module: str) -> str:
    """Search a module that is not installed in the folders of `search_in` and in the current
    directory; return these folders, for an error.

    They are searched last, and from then on, so that the module finds those beside it and none
    that is installed is hidden. For any other module they are not searched: with a file `numba.py`,
    whoever can write to a folder would have code run by all who start a graph there without numba.
    """
    current = os.getcwd()
    folders = list(dict.fromkeys([*_SEARCHED, current]))
    if not _is_installed(module.partition(".")[0]):
        on_path = {folder or current for folder in sys.path}
        sys.path += [folder for folder in folders if folder not in on_path]
    return " or ".join(folders)


def _is_installed(package: str) -> bool:
    if package in sys.modules:
        return True
    # A folder alone, without a file, has a spec, too, but no origin.
    with suppress(ImportError, ValueError):
        module_spec = importlib.util.find_spec(package)
        return module_spec is not None and module_spec.origin is not None
    return False


def suggestion(word: str, known: Iterable[str]) -> str:
    """Hint for a word that is like a known one: ' (did you mean 'iterations'?)'; "" for others."""

    def likeness(name: str) -> tuple[float, int]:
        ratio = difflib.SequenceMatcher(None, name, word).ratio()
        # Of two that are as near, the one with more letters in place.
        return ratio, sum(map(str.__eq__, name, word))

    matches = difflib.get_close_matches(word, known)
    near = max(matches, key=likeness, default="")
    if not near:
        return ""
    return f" (did you mean '{near}'?)"


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Hint for an unknown word: as `suggestion`, else the list of known ones."""
    names = sorted(known)
    # An empty list would read as if something were wrong here.
    if not names:
        return ""
    return suggestion(word, names) or f" (known: {', '.join(names)})"


def nearest_of(word: str, allowed: Collection[str]) -> str:
    """Hint for a value: ' (did you mean 'skin'?); allowed: paper, skin'."""
    return f"{suggestion(word, allowed)}; allowed: {', '.join(allowed)}"


MAX_TEXT = 400
"""Characters of an exception's text in one line at most."""
MAX_TRACE = 20_000
"""Characters of a traceback at most: of an endless recursion, its end."""
_NOT_THE_USERS = {"sparseskin", "numpy", "numba", *sys.stdlib_module_names}


def one_line(error: BaseException) -> str:
    """Type and text of an exception, and the line of the user's code that raised it, if any."""
    line = type(error).__name__
    # Its own lines become one.
    words = str(error)[:MAX_TEXT].split()
    text = " ".join(words)
    if text:
        line += f": {text}"

    # The innermost frame of the user's own code: below it are libraries.
    prefix = os.path.join(os.getcwd(), "")
    place = ""
    for frame, number in traceback.walk_tb(error.__traceback__):
        module = str(frame.f_globals.get("__name__"))
        package, _, _ = module.partition(".")
        if package not in _NOT_THE_USERS:
            file = frame.f_code.co_filename.removeprefix(prefix)
            place = f" ({file}:{number})"
    return line + place


def trace_of(error: BaseException) -> str:
    """The traceback of an error for a log file; "" where its text says all there is to say."""
    if isinstance(error, SparseskinError) and error.__cause__ is None:
        return ""
    return "".join(traceback.format_exception(error))[-MAX_TRACE:]


def find_callable(target: str, error: type[SparseskinError]) -> Callable[..., Any]:
    """Import "module:attribute" and return that callable; raise `error` if that fails.

    A module that is not installed is searched as by `search_here`.
    """
    module_name, colon, attribute = target.partition(":")
    names = module_name.split(".") + attribute.split(".")
    if not colon or not all(name.isidentifier() for name in names):
        raise error(f"{target[:80]!r}: expected module:callable, e.g. my_skin:frames")

    # A file may have been written since this process looked last.
    searched = search_here(module_name)
    importlib.invalidate_caches()
    try:
        target_object: Any = importlib.import_module(module_name)
    except ModuleNotFoundError as cause:
        if is_missing(module_name, cause):
            raise error(
                f"{target}: there is no module {cause.name!r}, installed or in {searched}"
            ) from cause
        raise error(f"{target}: importing it failed: {one_line(cause)}") from cause
    # SystemExit: a module that calls sys.exit() when imported.
    except (Exception, SystemExit) as cause:
        raise error(f"{target}: importing it failed: {one_line(cause)}") from cause

    for part in attribute.split("."):
        if not hasattr(target_object, part):
            hint = suggestion(part, dir(target_object))
            raise error(f"{target}: {module_name} has no {attribute!r}{hint}")
        target_object = getattr(target_object, part)
    if not callable(target_object):
        raise error(
            f"{target}: is {type(target_object).__name__}, which cannot be called"
        )
    function: Callable[..., Any] = target_object
    return function


def is_missing(module: str, cause: ModuleNotFoundError) -> bool:
    """True if an import failed as there is no such module; False if it imports another that is not
    there.
    """
    # With the dots: a module "skin" is not the package of "skin_driver".
    return cause.name is not None and f"{module}.".startswith(f"{cause.name}.")


def find_class(
    what: str, name: str, registered: Mapping[str, str], error: type[SparseskinError]
) -> Callable[..., Any]:
    """Return the class of a registered name, or of "module:Class"; raise `error` if there is none.

    `what` is its kind in the user's words; `registered` maps names to "module:Class".
    """
    if ":" in name:
        return find_callable(name, error)
    if name not in registered:
        hint = did_you_mean(name, registered)
        raise error(
            f'{what} "{name}" is not known{hint}; or "module:Class" for your own'
        )
    return find_callable(registered[name], error)
