"""Readers that a secured graph does not let in: what they get, and how soon the log names them."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from sparseskin.nodes.keys import KeyPair, make_key_files, read_key_pair
from sparseskin.nodes.sockets import Reader, make_context

from .faults_signals import graph_text
from .graph_probe import Probe
from .graph_run import GraphRun, wait_until

TOPIC = "/skin/taxels"
GET_S = 1.0
"""How long a reader that was named goes on waiting for a message."""
_SECURITY = """
[security]
keys = "keys"
key = "edge"
"""
#: What the log says of each.
_KINDS = {
    "an unlisted key": "its key is that of lab, and not on the list",
    "a wrong key of the host": "it has a wrong key for this host",
    "no key": "it uses no key",
}


def turned_away(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Readers with a key that is not on the list, with a wrong key of the host, and with none; one
    that has the key of the graph reads on all the while.
    """
    for name in ("edge", "lab"):
        make_key_files(name, folder / "keys")
    edge, lab = (read_key_pair(folder / f"keys/{name}.key") for name in ("edge", "lab"))
    keys = dict(zip(_KINDS, ((lab, edge.public), (edge, lab.public), (None, "")), strict=True))
    text = graph_text('transport = "tcp"') + _SECURITY
    named_s, n_got = {}, 0
    with GraphRun(folder, text) as graph:
        endpoint = graph.note()["nodes"]["sensor"]["endpoint"]
        with Probe(graph, ("taxels", "reconstruction")) as probe:
            probe.wait_for_fresh(probe.clock.now_ns())
            began_ns, others = probe.clock.now_ns(), dict(graph.nodes())
            for kind, (own, server_key) in keys.items():
                named_s[kind], got = _knock(graph, endpoint, own, server_key, _KINDS[kind])
                n_got += got
            lost, n_sensed = probe.lost(began_ns)
            stopped = graph.stopped(others)
        graph.end()
        left = graph.left()
    times = ", ".join(f"{kind} {seconds:.2f} s" for kind, seconds in named_s.items())
    return {
        "recover_s": [],
        "lost": lost,
        "of": n_sensed,
        "stopped": stopped,
        "left": left,
        "told": f"{n_got} messages came to them; named after: {times}",
    }


def _knock(
    graph: GraphRun, endpoint: str, own: KeyPair | None, server_key: str, words: str
) -> tuple[float, int]:
    """Listen to a node without the right to; seconds until its log says so, and what came."""
    context = make_context()
    try:
        reader = Reader(context, "stranger", (), [TOPIC], present=False, keys=own)
        reader.connect(endpoint, server_key)

        def is_named() -> bool:
            return any("turned away" in line and words in line for line in graph.said)

        seconds = wait_until(is_named, f"the log to say {words!r}")
        time.sleep(GET_S)
        n_got = 0
        while reader.receive() is not None:
            n_got += 1
        return seconds, n_got
    finally:
        context.destroy(linger=0)
