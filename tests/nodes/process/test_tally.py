"""What a node has counted when it is killed."""

import os
import signal

from sparseskin.nodes.process.tally import Tally


def test_what_a_killed_process_has_counted_is_there_to_the_last_message():
    tally = Tally(["/skin/taxels", "/skin/truth", "/skin/skin"])
    child = os.fork()
    if not child:
        own = Tally(["/skin/taxels", "/skin/truth", "/skin/skin"], tally.fd)
        for n in range(1, 1001):
            own.set("/skin/truth", n)
        own.set("/skin/skin", 1)
        own.set("/skin/other", 5)
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert tally.close() == {"/skin/truth": 1000, "/skin/skin": 1}
