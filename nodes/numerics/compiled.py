"""Compiled loops, where numba is installed: when they are used, and how they are compiled.

A class that is made of compiled loops imports `kernels`, and with it numba, at its top. The
module that chooses between it and its numpy twin imports it only where `use_compiled` is true.
"""

import fcntl
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from importlib.machinery import PathFinder
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from typing import Any, TypeVar

from sparseskin.nodes.errors import SettingsError, SparseskinError, not_installed
from sparseskin.nodes.files import check_private
from sparseskin.nodes.lookup import did_you_mean, one_line

FAST = ("auto", "on", "off")
ENVIRONMENT = "SPARSESKIN_FAST"
"""Environment variable that replaces "auto": "off" for numpy alone."""

NOT_INSTALLED = (
    f"compiled loops: none, several times slower; {not_installed('numba', 'fast')}"
)
NOT_IMPORTED = "compiled loops: numba cannot be imported; numpy is used"
BLAS = "scipy.linalg.cython_blas"
"""Module through which compiled loops call BLAS."""
COMPILING = "compiled loops: compiling, once for this installation; a minute, more where it is busy"

Count = Callable[[int, int], None]
"""Receives the number of loops that are compiled, and that of all."""
Function = TypeVar("Function", bound=Callable[..., Any])


def check_fast(fast: str) -> str:
    """Return "on" (always), "off" (never), or "auto" where numba is to be used if it can be: where
    it is installed, unless the environment has SPARSESKIN_FAST=off. Raises SettingsError if it is
    another word, in the environment too, or "on" without numba.
    """
    name = "fast"
    if fast == "auto" and ENVIRONMENT in os.environ:
        name = ENVIRONMENT
        fast = os.environ[ENVIRONMENT]
    if not isinstance(fast, str) or fast not in FAST:
        raise SettingsError(
            f"{name}: {fast!r} is not known{did_you_mean(str(fast), FAST)}; allowed: "
            f"{', '.join(FAST)}"
        )
    installed = fast == "off" or find_spec("numba") is not None
    if fast == "on" and not installed:
        raise SettingsError(f"{name}: 'on': {not_installed('numba', 'fast')}")
    return fast if installed else "off"


def use_compiled(fast: str) -> bool:
    """True if compiled loops are to be used; numba is then imported. Raises as `check_fast`, also
    if it is "on" and importing numba fails: each numba needs certain versions of numpy.
    """
    checked = check_fast(fast)
    if checked == "off":
        return False
    try:
        import_module("numba")
    except ImportError as error:
        if checked == "on":
            raise SettingsError(
                f"fast: importing numba failed: {one_line(error)}"
            ) from error
        return False
    return True


def ready(
    *loops: Callable[..., Any],
    log: Callable[[str], None] | None = None,
    count: Count = lambda done, of: None,
) -> None:
    """Compile loops for their types, or read them from disk; they then accept no other types.

    Processes that do so at one time do it one after the other, and the first compiles. The loops
    are made by `compiled` with signatures; `log` and `count` are as in `compile_loops`.
    """
    if all(loop.signatures for loop in loops):  # type: ignore[attr-defined]
        return

    def begin() -> None:
        count(0, len(missing))

    _load_blas()
    with ExitStack() as stack:
        stack.enter_context(_alone(loops[0]))
        # Another thread may have compiled them while this one waited.
        missing = [loop for loop in loops if not loop.signatures]  # type: ignore[attr-defined]
        begun_s = [] if log is None else stack.enter_context(_progress(log, begin))
        for k, loop in enumerate(missing, 1):
            for signature in _SIGNATURES[loop]:
                loop.compile(signature)  # type: ignore[attr-defined]
            # Other types are an error of the caller: no frame is to wait for a compiler.
            loop.disable_compile()  # type: ignore[attr-defined]
            if begun_s:
                count(k, len(missing))


def entry_point(loop: Callable[..., Any]) -> Callable[..., Any]:
    """The compiled function of a loop that is `ready`, without a check of its arguments' types,
    which takes several times as long as to pass them where they are NamedTuples.
    """
    (result,) = loop.overloads.values()  # type: ignore[attr-defined]
    entry: Callable[..., Any] = result.entry_point
    return entry


def _load_blas() -> None:
    """Load the BLAS of compiled loops by itself.

    Its package, which numba would import as a whole, takes a quarter of the time in which compiled
    loops are read from disk. Who needs the package imports it as ever.
    """
    if BLAS in sys.modules:
        return
    scipy = import_module("scipy")
    folders = [os.path.join(folder, "linalg") for folder in scipy.__path__]
    spec = PathFinder.find_spec(BLAS, folders)
    if spec is None or spec.loader is None:
        # Of another layout: numba imports it with its package.
        return
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.modules[BLAS] = module


@contextmanager
def _alone(loop: Callable[..., Any]) -> Iterator[None]:
    """Hold a lock on the file of a loop."""
    with Path(loop.__code__.co_filename).open() as file:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


@contextmanager
def _progress(
    log: Callable[[str], None], begin: Callable[[], None]
) -> Iterator[list[float]]:
    """Log when compiling begins and ends; loops that are read from disk are not compiled. Yields
    a list, which holds the time at which it began, once it has.
    """
    event = import_module("numba.core.event")
    begins_s: list[float] = []

    class Listener(event.Listener):  # type: ignore[name-defined, misc]
        def on_start(self, _: Any) -> None:
            if not begins_s:
                log(COMPILING)
                begin()
                begins_s.append(time.perf_counter())

        def on_end(self, _: Any) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        yield begins_s
    if begins_s:
        log(f"compiled loops: ready after {time.perf_counter() - begins_s[0]:.0f} s")


_SIGNATURES: dict[Callable[..., Any], tuple[Any, ...]] = {}


def compiled(
    *signatures: Any, sums_in_any_order: bool = False
) -> Callable[[Function], Function]:
    """Return the decorator of a loop that `ready` compiles for these signatures.

    The compiled code is stored beside the module, in the user's cache folder where that folder
    is read-only, or in NUMBA_CACHE_DIR where it is set; with none of these, in a private folder for
    temporary files; without that it is compiled anew in each process.

    Signatures are numba's, void(float32[::1], int64), or tuples of the arguments' types; none: for
    use within compiled functions of the same file. With `sums_in_any_order` a sum over a vector may
    be computed in the fastest order: the same bits on one machine. Everything else is rounded as it
    is written.
    """
    numba = import_module("numba")
    # As in numpy a quotient by 0 raises nothing, which costs a choice in each loop.
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    if sums_in_any_order:
        options["fastmath"] = {"reassoc"}

    def decorate(function: Function) -> Function:
        if not signatures:
            inner: Function = numba.njit(**options)(function)
            return inner
        dispatcher = _stored(function, options)
        if dispatcher is None:
            _store_temporarily()
            dispatcher = _stored(function, options) or numba.njit(**options)(function)
        _SIGNATURES[dispatcher] = signatures
        return dispatcher

    return decorate


def _stored(function: Function, options: Mapping[str, Any]) -> Function | None:
    """A function whose compiled code is stored; None where there is no place for it."""
    try:
        loop: Function = import_module("numba").njit(cache=True, **options)(function)
    # numba has no class of its own for it.
    except RuntimeError as error:
        if "cannot cache" not in str(error):
            raise
        return None
    return loop


def _store_temporarily() -> None:
    """Store compiled code in a folder for temporary files that no other user may enter, if there is
    one: what is read from it is executed.
    """
    import tempfile

    folder = Path(tempfile.gettempdir()) / f"sparseskin-{os.geteuid()}"
    with suppress(OSError, SparseskinError):
        folder.mkdir(mode=0o700, exist_ok=True)
        check_private(folder)
        import_module("numba").config.CACHE_DIR = str(folder / "compiled")
