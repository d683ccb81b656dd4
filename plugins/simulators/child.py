"""The process that reads a model, started by `isolated`: it prints rows and columns of the skin."""

from __future__ import annotations

import resource
import sys

from sparseskin.nodes.errors import SourceError

from .isolated import MAX_BYTES, REFUSED
from .source import MujocoSource


def main(address: str) -> int:
    """Print rows and columns of the skin of MODEL#SITE, or why it is refused."""
    resource.setrlimit(resource.RLIMIT_AS, (MAX_BYTES, MAX_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        print(*MujocoSource(address).pad.shape)
    except SourceError as error:
        print(error, file=sys.stderr)
        return REFUSED
    except MemoryError:
        print(f"{address}: needs more memory than is allowed to its reader", file=sys.stderr)
        return REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
