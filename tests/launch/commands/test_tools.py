"""Tools beside a graph: `play --open` and its page; a graph that is secured with keys."""

import contextlib
import re
import signal

from conftest import Program, free_port, note_of_graph, wait_until
from processes import LOOP

from sparseskin.nodes.network.keys import make_key_files
from sparseskin.nodes.recorder.bag.reader import BagReader

GRAPH = """\
hosts.edge = {{ address = "127.0.0.1", base_port = {edge_port} }}
hosts.desk.address = "127.0.0.1"
security.keys = "keys"
[nodes]
sensor = {{ type = "sensor", source = "loop:path_40", rate_hz = 50, host = "edge" }}
compressor = {{ type = "compressor", host = "edge" }}
reconstructor = {{ type = "reconstructor", host = "edge" }}
recorder = {{ type = "recorder", out = "desk.mcap", topics = ["/skin/taxels"], host = "desk" }}
"""
N_BYTES = 50_000


def test_every_tool_beside_a_secured_graph_is_served(tmp_path):
    for name in ("edge", "desk"):
        make_key_files(name, tmp_path / "keys")
        (tmp_path / name).mkdir()
    (tmp_path / "loop.py").write_text(LOOP)
    (tmp_path / "graph.toml").write_text(GRAPH.format(edge_port=min(free_port(), 65000)))
    with contextlib.ExitStack() as stack:

        def start(host, *arguments):
            return stack.enter_context(Program(*arguments, cwd=tmp_path / host))

        for part in [start(h, "launch", "../graph.toml", "--host", h) for h in ("edge", "desk")]:
            part.wait_for("[launch] ready")
        note_of_graph(tmp_path / "edge/graphs")
        code, out, _ = start("edge", "topic", "echo", "/skin/taxels", "-n", "3").finish()
        assert (code, out.count("---\n")) == (0, 3)
        monitor = start("edge", "monitor", "--text")
        monitor.wait_for("[launch] ready")
        recorded = start("edge", "record", "/skin/measurements", "/skin/phi", "--out", "a.mcap")
        path = tmp_path / "edge/a.mcap.part"
        wait_until(lambda: path.exists() and path.stat().st_size > N_BYTES, "a recording")
        for program in (recorded, monitor):
            program.process.send_signal(signal.SIGINT)
        assert recorded.finish()[0] == 0
        with BagReader(path.with_suffix("")) as bag:
            assert bag.topics["/skin/phi"].n_messages == 1
            assert bag.topics["/skin/measurements"].n_messages > 0
        code, out, _ = monitor.finish()
        assert code == 0
        assert re.search(r"reconstructed [1-9]", out)
