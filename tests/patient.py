"""Run `sparseskin` with time limits that a busy host does not exceed: python patient.py ARGUMENTS.

The limits on the start and the end of nodes and on their answers are for a user who waits. Tests
that state these limits run the command itself.
"""

import os
import sys

from sparseskin.launch.attach import client
from sparseskin.launch.commands import entry, topic
from sparseskin.launch.run import controls, fleet, launcher

LONG_S = 240.0

if __name__ == "__main__":
    sys.path[0] = os.getcwd()  # as for `python -m`
    fleet.START_S = launcher.START_S = LONG_S
    fleet.GRACE_S = launcher.DRAIN_S = LONG_S
    controls.PATIENCE_S = LONG_S
    client.PATIENCE_S = LONG_S
    # A command of the lowest weight may wait for a processor longer than any limit.
    topic.give_way = lambda: None
    sys.exit(entry.main())
