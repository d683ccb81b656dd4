"""The entry point of the command: nothing a user does to it ends in a traceback.

All modules but those that Python has imported already are imported in `main`, which handles a
Ctrl-C; one before that, while Python itself starts, is Python's to report.
"""

from __future__ import annotations

import os
import sys


def main() -> int:
    """Run the command; return its exit code."""
    try:
        open_standard_files()
        keep_bytecode()
        # Read as numpy is imported: small products of matrices wait for threads, and the times that
        # a study reports are those of one core.
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
            os.environ.setdefault(name, "1")
        # Imported here, so that a Ctrl-C during the import is handled like any other.
        from .cli import complete
        from .cli import main as run

        code = complete() if "_ARGCOMPLETE" in os.environ else run()
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        return 130
    except OSError as error:
        # stdout is closed or full; the rest of its buffer must not be written again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        if not isinstance(error, BrokenPipeError) and sys.stderr is not None:
            print(f"sparseskin: {error.strerror}", file=sys.stderr)
        return 1


def open_standard_files() -> None:
    """Open /dev/null in place of each of stdin, stdout and stderr that is closed, since the next
    file to be opened would get its number.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    for name, number, mode in (("stdin", 0, "r"), ("stdout", 1, "w"), ("stderr", 2, "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, closefd=False))


def keep_bytecode() -> None:
    """Store bytecode in the user's cache folder, for this process and those that it starts, where
    modules have none and PYTHONDONTWRITEBYTECODE keeps them from getting any.

    Each process of a graph would compile the same hundreds of modules again, for 1 to 2 s.
    """
    if not sys.dont_write_bytecode or sys.pycache_prefix:
        return
    import importlib.util

    stored = [
        spec.cached
        for name in ("numpy", "sparseskin.launch.commands.cli")
        if (spec := importlib.util.find_spec(name))
    ]
    if all(path and os.path.exists(path) for path in stored):
        return
    from sparseskin.nodes.errors import SparseskinError
    from sparseskin.nodes.files import check_private, user_folder

    try:
        folder = user_folder("cache") / "bytecode"
        for made in (folder.parent, folder):
            made.mkdir(mode=0o700, parents=True, exist_ok=True)
            check_private(made)  # what is in it is run
    except (OSError, SparseskinError):
        return
    sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"] = str(folder)
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False


if __name__ == "__main__":
    sys.exit(main())
