"""A writer of a graph that does not run, for readers of its topics."""

import time
import uuid

import numpy as np
from processes import wait_until

from sparseskin.launch.run.running import RunningGraph, RunningNode
from sparseskin.messages import End, Taxels
from sparseskin.nodes.network.gate import Gate
from sparseskin.nodes.network.keys import read_key_pair
from sparseskin.nodes.network.sockets import Writer, make_context

TOPIC = "/skin/taxels"
RUN_ID = "0123456789abcdef"


class Publisher:
    """A writer of taxels, and the note of its graph; with a key file, it asks for that key."""

    def __init__(self, key_file=None):
        self.context = make_context()
        pair = read_key_pair(key_file) if key_file else None
        key = pair.public if pair else ""
        self.gate = Gate(self.context, pair, {key: "own"}, {}, print) if pair else None
        endpoint = f"ipc://@sparseskin-{uuid.uuid4().hex}"
        self.writer = Writer(self.context, endpoint, "sensor", gate=self.gate)
        nodes = {"sensor": RunningNode("sensor", self.writer.endpoint, [TOPIC], key)}
        offset_ns = time.time_ns() - time.monotonic_ns()
        self.graph = RunningGraph("graph", 1, offset_ns, "", nodes, str(key_file or ""))
        self.n = 0

    def send(self, n, n_rows=4, period_ns=0):
        """Send `n` messages, stamped by the clock, or with a period from 1 s on."""
        forces = np.zeros((n_rows, 4), dtype=np.float32)
        for k in range(n):
            stamp_ns = 10**9 + k * period_ns if period_ns else time.time_ns()
            message = Taxels(stamp_ns=stamp_ns, patch="skin", forces=forces)
            self.writer.send(message.published(RUN_ID, self.n))
            self.n += 1

    def end(self):
        end = End(stamp_ns=1, patch="skin", of="taxels", n_messages=self.n)
        self.writer.send(end.published(RUN_ID, self.n))

    def wait_for_subscription(self):
        def there():
            if self.gate is not None:
                self.gate.serve()
            return bool(self.writer.socket.poll(0))

        wait_until(there, "the subscription")
        self.writer.serve_subscriptions()
