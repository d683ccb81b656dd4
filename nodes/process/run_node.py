"""The process of one node: `python -m sparseskin.nodes.process.run_node NAME`.

The launcher writes a configuration to its stdin, then commands: "connect" (endpoints of the
writers), "start" (all nodes are ready), "stop".
"""

import gc
import os
import select
import sys


def main() -> int:
    """Entry point of a node process."""
    gc.disable()  # until the node has started: what is imported stays anyway
    import zmq

    from sparseskin.nodes.errors import SparseskinError
    from sparseskin.nodes.lookup import one_line, trace_of

    from .control import Control, watch_parent
    from .runner import EXIT_CRASH, EXIT_USAGE, POLL_MS, Runner

    control = Control()
    watch_parent(os.getppid())
    try:
        while not (commands := control.commands()):
            if control.closed:
                return 0
            select.select([control.connection], [], [], POLL_MS / 1000)
        Runner(control, commands[0]).run()
    except SparseskinError as error:
        control.emit("error", text=str(error), code=EXIT_USAGE, trace=trace_of(error))
        return EXIT_USAGE
    except zmq.ZMQError as error:
        # The error names the address, which may be that for other hosts.
        text = f"cannot bind: {error}; allowed: a free port of an address that this host has"
        control.emit("error", text=text, code=EXIT_USAGE)
        return EXIT_USAGE
    except Exception as error:
        if os.environ.get("SPARSESKIN_TRACEBACK"):
            raise
        control.emit("error", text=one_line(error), code=EXIT_CRASH, trace=trace_of(error))
        return EXIT_CRASH
    return 0


if __name__ == "__main__":
    sys.exit(main())
