"""A hundred subscribers that never read: `python -m sparseskin.studies.faults_stalled N ENDPOINT`.

They subscribe to all that an endpoint publishes; then the whole process stops itself, so that not
even ZeroMQ's own threads take anything in.
"""

from __future__ import annotations

import os
import signal
import sys
import time

import zmq

from sparseskin.nodes.sockets import make_context

CONNECT_S = 1.0


def main(arguments: list[str]) -> int:
    """Connect, say so, and stop."""
    context = make_context()
    context.set(zmq.MAX_SOCKETS, 4096)
    sockets = []
    for _ in range(int(arguments[0])):
        stalled = context.socket(zmq.SUB)
        stalled.setsockopt(zmq.RCVHWM, 1)
        stalled.subscribe(b"")
        stalled.connect(arguments[1])
        sockets.append(stalled)
    time.sleep(CONNECT_S)  # connecting goes on in a thread of ZeroMQ's that must not stop before
    print("stalled", flush=True)
    os.kill(os.getpid(), signal.SIGSTOP)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
