"""The process of one or several nodes: `python -m sparseskin.nodes.process.run_node NAME ...`.

The launcher writes a configuration to the channel of each node, then commands: "connect" (endpoints
of the writers), "start" (all nodes are ready), "stop". The channel of the first node is stdin; its
configuration has `channels`, descriptors of the channel and the log of each further node.
"""

import gc
import os
import sys


def main() -> int:
    """Entry point of a node process."""
    # Until the nodes have started: what is imported stays anyway.
    gc.disable()
    import zmq

    from sparseskin.nodes.errors import SparseskinError
    from sparseskin.nodes.lookup import one_line, trace_of

    from .control import Control, watch_parent
    from .loop import Loop
    from .runner import EXIT_CRASH, EXIT_USAGE

    loop = Loop(Control())
    # A launcher that was killed cannot end its nodes: they end themselves.
    watch_parent(os.getppid())
    try:
        loop.run()
    except SparseskinError as error:
        loop.control.emit(
            "error", text=str(error), code=EXIT_USAGE, trace=trace_of(error)
        )
        return EXIT_USAGE
    except zmq.ZMQError as error:
        # The error names the address, which may be that for other hosts.
        text = f"cannot bind: {error}; allowed: a free port of an address that this host has"
        loop.control.emit("error", text=text, code=EXIT_USAGE)
        return EXIT_USAGE
    except Exception as error:
        if os.environ.get("SPARSESKIN_TRACEBACK"):
            raise
        loop.control.emit(
            "error", text=one_line(error), code=EXIT_CRASH, trace=trace_of(error)
        )
        return EXIT_CRASH
    return 0


if __name__ == "__main__":
    sys.exit(main())
