"""The entry point of the command: nothing a user does to it ends in a traceback.

All modules but those that Python has imported already are imported in `main`, which handles a
Ctrl-C; one before that, while Python itself starts, is Python's to report.
"""

import os
import sys

EXIT_INTERRUPTED = 130
"""Exit code after a Ctrl-C: 128 + SIGINT."""


def main() -> int:
    """Run the command; return its exit code."""
    try:
        return _run()
    except KeyboardInterrupt as error:
        # `Terminated` is an interrupt, too, with an exit code of its own.
        return getattr(error, "exit_code", EXIT_INTERRUPTED)
    except OSError as error:
        # stdout is closed or full; the rest of its buffer must not be written again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        if not isinstance(error, BrokenPipeError) and sys.stderr is not None:
            print(f"sparseskin: {error.strerror}", file=sys.stderr)
        return 1


def _run() -> int:
    open_standard_files()
    # Read as numpy is imported: small products of matrices wait for threads, and the times that
    # a study reports are those of one core.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    # Imported here, so that a Ctrl-C during the import is handled like any other.
    import signal

    from sparseskin.launch.run.termination import TERMINATION, Terminated

    signal.signal(signal.SIGTERM, TERMINATION.handle)
    from .cli import complete
    from .cli import main as run

    code = complete() if "_ARGCOMPLETE" in os.environ else run()
    sys.stdout.flush()
    if TERMINATION.has_come:
        return Terminated.exit_code
    return code


def open_standard_files() -> None:
    """Open /dev/null in place of each of stdin, stdout and stderr that is closed, since the next
    file to be opened would get its number.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    # Python sets those that were closed when it started to None.
    if sys.stdin is None:
        sys.stdin = os.fdopen(0, "r", closefd=False)
    if sys.stdout is None:
        sys.stdout = os.fdopen(1, "w", closefd=False)
    if sys.stderr is None:
        sys.stderr = os.fdopen(2, "w", closefd=False)


if __name__ == "__main__":
    sys.exit(main())
