"""Compiling of all loops before the first frame: `python -m sparseskin.nodes.numerics.warm_up` does
it at installation, and stores the bytecode of the modules that nodes import.
"""

import os
import sys
from collections.abc import Callable, Iterable
from functools import partial
from importlib import import_module
from types import ModuleType

from . import compiled

USUAL_MODULES = (
    "sparseskin.nodes.process.loop",
    "sparseskin.nodes.sensor.node",
    "sparseskin.nodes.compressor.node",
    "sparseskin.nodes.compressor.phi.sbhe",
    "sparseskin.nodes.reconstructor.node",
    "sparseskin.nodes.reconstructor.contact_tracks",
    "sparseskin.nodes.monitor.live.server",
    "sparseskin.nodes.recorder.node",
    "sparseskin.nodes.player.node",
    "sparseskin.launch.run.running",
    "sparseskin.launch.commands.entry",
)
"""Modules that the nodes of most graphs, and their launcher, import."""


def compile_loops(
    fast: str, log: Callable[[str], None], count: compiled.Count = lambda done, of: None
) -> None:
    """Compile all loops now, or read them from disk, so that no frame waits for it.

    Nothing is done where `use_compiled` is False, with Raises as there. `log` receives a line of
    text before anything is compiled, and one after it; where numba is missing or cannot be
    imported, one that says so. `count` receives the numbers of loops that are compiled and of all,
    from 0 on, if any has to be.
    """
    if compiled.use_compiled(fast):
        from . import kernels  # needs numba

        compiled.ready(*kernels.LOOPS, log=log, count=count)
    elif "off" not in (fast, os.environ.get(compiled.ENVIRONMENT)):
        is_missing = compiled.check_fast(fast) == "off"
        log(compiled.NOT_INSTALLED if is_missing else compiled.NOT_IMPORTED)


def store_bytecode(modules: Iterable[ModuleType]) -> None:
    """Store the bytecode of modules where it is missing or old, and where there is a place for it.

    Some installers store none, nor does Python with PYTHONDONTWRITEBYTECODE: each start would then
    compile all modules anew, which takes 2 s of a processor for numba alone.
    """
    import compileall

    for module in modules:
        path = getattr(module, "__file__", None)
        if path is not None and path.endswith(".py"):
            compileall.compile_file(path, quiet=2)


def main() -> None:
    """Prepare an installation for the first start of its nodes."""
    # Through a pipe, too, the first line is written before the minute that it announces.
    compile_loops("auto", partial(print, flush=True))
    for name in USUAL_MODULES:
        import_module(name)
    store_bytecode(list(sys.modules.values()))


if __name__ == "__main__":
    main()
