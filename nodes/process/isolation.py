"""A file of somebody else, read by a library that it may end or occupy, in a process of its own.

The child is `python -m MODULE ARGUMENTS`, whose time and memory are bounded; its `main` returns
`child_status` of the work.
"""

import resource
import signal
import subprocess
import sys
from collections.abc import Callable

from sparseskin.nodes.errors import SourceError

START_S = 60.0
BYTES_PER_S = 1e7
"""Time that a child has, in s: to start, and by size; chosen, far above what it takes on an idle
host."""
MAX_BYTES = 1 << 32
"""Memory that a child may have, interpreter and libraries included; chosen."""
REFUSED = 3
"""Exit status of a child that printed why it refuses the file."""


def output_of(module: str, name: str, n_bytes: int) -> bytes:
    """What a child prints that reads the file `name` of `n_bytes`.
    Raises SourceError if the file is refused, or the process fails or takes too long.
    """
    # -P: no module of the current directory is imported.
    command = [sys.executable, "-P", "-m", module, name]
    limit_s = START_S + n_bytes / BYTES_PER_S
    try:
        done = subprocess.run(
            command, input=b"", capture_output=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        raise SourceError(
            f"{name}: not read within {limit_s:.0f} s; a damaged or huge file?"
        ) from None
    # The last line: a library may have printed before.
    if done.returncode == REFUSED:
        lines = done.stderr.decode("utf-8", "replace").strip()
        raise SourceError(lines.rpartition("\n")[2])
    if done.returncode:
        how = f"failed (status {done.returncode})"
        if done.returncode < 0:
            how = f"was ended by {signal.Signals(-done.returncode).name}"
        raise SourceError(f"{name}: its reader {how}; a damaged or huge file?")
    return done.stdout


def child_status(name: str, work: Callable[[], None]) -> int:
    """Do the work of a child, which prints; the exit status. `name` is that of the file."""
    # A damaged file may crash the library again and again: no cores fill the disk.
    resource.setrlimit(resource.RLIMIT_AS, (MAX_BYTES, MAX_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        work()
    except SourceError as error:
        print(error, file=sys.stderr)
    except MemoryError:
        print(
            f"{name}: needs more memory than is allowed to its reader", file=sys.stderr
        )
    else:
        return 0
    return REFUSED
