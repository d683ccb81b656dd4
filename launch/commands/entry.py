"""The entry point of the command: nothing a user does to it ends in a traceback."""

from __future__ import annotations

import os
import sys


def main() -> int:
    """Run the command; return its exit code."""
    try:
        if sys.argv[1:2] == ["study"]:
            # Read as numpy is imported: the times that a study reports are those of one core.
            os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
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


if __name__ == "__main__":
    sys.exit(main())
