"""The shape of a MuJoCo model's skin, found in a process of its own.

A model of a few lines may take any time and memory, or end the process. So it is loaded in a child
whose time and memory are bounded: `python -m sparseskin.plugins.simulators.source MODEL#SITE`.
"""

from __future__ import annotations

import signal
import subprocess
import sys

from sparseskin.nodes.errors import SourceError

START_S, BYTES_PER_S = 60.0, 1e7
"""Time that a child has, in s: to start, and by size; chosen, far above what it takes on an idle
host."""
MAX_BYTES = 1 << 32
"""Memory that a child may have, interpreter and libraries included; chosen."""
REFUSED = 3
"""Exit status of a child that printed why it refuses the model."""


def shape_in_child(address: str, n_bytes: int) -> tuple[int, int]:
    """Rows and columns of the skin of a model MODEL#SITE, a file of `n_bytes`, whose first state is
    computed. Raises SourceError if the model is refused, or the process fails or takes too long.
    """
    # -P: no module of the current directory is imported.
    command = [sys.executable, "-P", "-m", f"{__package__}.source", address]
    limit_s = START_S + n_bytes / BYTES_PER_S
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        raise SourceError(
            f"{address}: not read within {limit_s:.0f} s; a damaged or huge file?"
        ) from None
    # The last lines: MuJoCo may have printed before.
    if done.returncode == REFUSED:
        raise SourceError(done.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2])
    if done.returncode:
        how = f"failed (status {done.returncode})"
        if done.returncode < 0:
            how = f"was ended by {signal.Signals(-done.returncode).name}"
        raise SourceError(f"{address}: its reader {how}; a damaged or huge file?")
    n_rows, n_cols = map(int, done.stdout.split()[-2:])
    return n_rows, n_cols
