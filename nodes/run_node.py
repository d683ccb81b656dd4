"""The process of one node: `python -m sparseskin.nodes.run_node NAME`.

The launcher writes a configuration on its stdin, then commands: "connect" (where the writers
are), "start" (all nodes are ready), "stop".
"""

from __future__ import annotations

import os
import sys

import zmq

from .control import Control, watch_parent
from .errors import SparseskinError
from .lookup import one_line
from .runner import EXIT_CRASH, EXIT_USAGE, POLL_MS, Runner


def main() -> int:
    """Entry point of a node process."""
    control = Control()
    watch_parent()
    try:
        while not (commands := control.commands()):
            if control.closed:
                return 0
            _wait_for_input(control.fd)
        Runner(control, commands[0]).run()
    except SparseskinError as error:
        control.emit("error", text=str(error), code=EXIT_USAGE)
        return EXIT_USAGE
    except zmq.ZMQError as error:
        # The error names the address, which may be the one for other hosts.
        text = f"cannot bind: {error}; allowed: a free port of an address that this host has"
        control.emit("error", text=text, code=EXIT_USAGE)
        return EXIT_USAGE
    except Exception as error:
        if os.environ.get("SPARSESKIN_TRACEBACK"):
            raise
        control.emit("error", text=one_line(error), code=EXIT_CRASH)
        return EXIT_CRASH
    return 0


def _wait_for_input(fd: int) -> None:
    poller = zmq.Poller()
    poller.register(fd, zmq.POLLIN)
    poller.poll(POLL_MS)


if __name__ == "__main__":
    sys.exit(main())
