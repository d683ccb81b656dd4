"""Of what waits for a node that is behind, the newest frames are taken in; all are counted."""

import numpy as np
from conftest import wait_until
from zmq_contexts import context as context
from zmq_contexts import wait_for_reader

from sparseskin.messages import End, PhiState, Taxels
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.network.sockets import Reader, Writer
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.node_host import NodeHost
from sparseskin.nodes.process.backlog import Backlog
from sparseskin.nodes.settings import Settings

TAXELS, PHI = "/skin/taxels", "/skin/phi"


def taxels(seq):
    forces = np.ones((2, 2), np.float32)
    return Taxels(stamp_ns=seq, patch="skin", run_id="0" * 16, seq=seq, forces=forces)


class Tap(Node[Settings]):
    """Keeps the numbers of the frames that it is given."""

    def __init__(self):
        super().__init__(Settings(), Context("tap", ManualClock()))
        self.given = []
        self.overtaken_by_newer = []

    @classmethod
    def inputs(cls, settings):
        return (TAXELS,)

    def step(self, message):
        self.given.append(message.seq)
        return ()

    def overtaken(self, message):
        self.overtaken_by_newer.append(message.seq)


def test_what_is_skipped_on_a_socket_is_counted_and_an_end_ends(context):
    writer = Writer(context, "inproc://writer")
    reader = Reader(context, "reader", [writer.endpoint], [TAXELS, PHI])

    wait_for_reader(writer, "reader")
    for seq in (0, 1, 2, 4, 5, 6, 7):  # 3 is lost
        writer.send(taxels(seq))
    phi = PhiState(
        stamp_ns=0, patch="skin", kind="full", n=4, m=4, block=1, seed=0, fingerprint="0" * 16
    )
    writer.send(phi)
    end = End(stamp_ns=9, patch="skin", run_id="0" * 16, seq=9, of="taxels", n_messages=9)
    writer.send(end)  # and so is 8
    node = Tap()
    host = NodeHost(node, "1" * 16, print)
    backlog = Backlog(reader, frozenset([TAXELS.encode()]))
    kept = []

    def ended():
        while (waiting := backlog.take(3)) is not None:
            kept.extend(host.receive_bytes(*waiting))
        return host.finished

    wait_until(ended, "the end of the stream")
    counts = host.counts.as_dict()
    # The end is none of the three that may wait: the last ones of a stream are all taken in.
    assert (node.given, node.overtaken_by_newer) == ([5, 6, 7], [0, 1, 2, 4])
    assert (counts["received"], counts["skipped"]) == ({TAXELS: 7}, {TAXELS: 4})
    assert counts["lost"] == {TAXELS: 2}
    assert counts["refused"] == {"unknown topic": 1}  # the state was not dropped on its way
