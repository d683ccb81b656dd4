"""Readers of files whose libraries fail on damaged ones, each call in a process of its own.

For a few changed bytes HDF5's library enters endless loops, and SciPy's reader of .mat ends the
process; a MuJoCo model of a few lines takes any time and memory. So they run in a child whose time
and memory are bounded: `python -m sparseskin.nodes.sensor.files.isolated TARGET NAME MOST_BYTES`.
"""

from __future__ import annotations

import io
import os
import resource
import signal
import subprocess
import sys
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import find_callable
from sparseskin.nodes.numerics.array_files import MAX_GROWN_BYTES, MAX_GROWTH

START_S, BYTES_PER_S = 60.0, 1e7
"""Time that a child has, in s: to start, and by size; chosen, far above what it takes (1 s of the
processor for a small .mat), as a host may be loaded."""
_OTHER_BYTES = 1 << 31
"""Memory that a child may have besides twice the arrays, for interpreter and libraries; chosen."""
_REFUSED = 3
"""Exit status of a child that printed why it refuses the file."""


def in_child(target: str, name: str, n_bytes: int) -> dict[str, npt.NDArray[Any]]:
    """Arrays of a file of `n_bytes`, by a function "module:callable" of this package: of `name` and
    the most bytes of the arrays, it returns arrays by name, or raises SourceError. `name` is the
    path of the file, and what else the function reads from it.

    Raises
    ------
    SourceError
        If the function does, or its process fails or takes too long.
    """
    most = max(MAX_GROWN_BYTES, MAX_GROWTH * n_bytes)
    # -P: no module of the current directory is imported.
    command = [sys.executable, "-P", "-m", __name__, target, name, str(most)]
    limit_s = START_S + n_bytes / BYTES_PER_S
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        raise SourceError(
            f"{name}: not read within {limit_s:.0f} s; a damaged or huge file?"
        ) from None
    if done.returncode == _REFUSED:
        # The last line: the library may have printed before.
        raise SourceError(done.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2])
    if done.returncode:
        how = _ended(done.returncode)
        raise SourceError(f"{name}: its reader {how}; a damaged or huge file?")
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as held:
        return {key: held[key] for key in held}


def _ended(status: int) -> str:
    """The end of a process, in words."""
    if status >= 0:
        return f"failed (status {status})"
    try:
        return f"was ended by {signal.Signals(-status).name}"
    except ValueError:
        return f"was ended by signal {-status}"


def main(target: str, name: str, most: int) -> int:
    """The child: read a file and write its arrays as .npz to standard output."""
    limit = 2 * most + _OTHER_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # A library that writes to standard output must not write among the arrays.
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)
        try:
            arrays = find_callable(target, SourceError)(name, most)
        except SourceError as error:
            print(error, file=sys.stderr)
            return _REFUSED
        except MemoryError:
            print(f"{name}: needs more memory than is allowed to its reader", file=sys.stderr)
            return _REFUSED
        plain = {key: array for key, array in arrays.items() if not array.dtype.hasobject}
        np.savez(out, **plain)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], int(sys.argv[3])))
