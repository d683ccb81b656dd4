"""A bridge observes: whatever becomes of it, the graph runs as without it."""

import json
import os
import signal

import pytest
from conftest import note_of_graph, wait_until

from sparseskin.launch.attach.client import describe
from sparseskin.launch.run.running import choose_graph
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.network.sockets import Reader, Writer, make_context
from sparseskin.plugins.bridges.base import BridgeSettings


def test_a_writer_waits_for_the_presence_of_an_observer_but_not_for_its_answers(tmp_path):
    context = make_context()
    try:
        endpoint = f"ipc://{tmp_path / 'w'}"
        writer = Writer(context, endpoint, "sensor")
        readers = [
            Reader(context, "solver", [endpoint], ["/skin/taxels"]),
            Reader(context, "bridge", [endpoint], ["/skin/taxels"], observes=True),
        ]
        while writer.present != {"solver", "bridge"}:
            writer.socket.poll(100)
            writer.serve_subscriptions()
        ask = writer.ask()
        assert writer.awaits(ask)
        note = None
        while note is None:
            note = readers[0].receive()
        readers[0].answer(note[1])
        while writer.awaits(ask):
            writer.socket.poll(100)
            writer.serve_subscriptions()
        assert readers[1].receive() is None
    finally:
        context.destroy(linger=0)


def test_a_stopped_bridge_holds_up_no_source_that_follows_its_readers(start, tmp_path, monkeypatch):
    pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
    (tmp_path / "observed.toml").write_text(
        """
[nodes]
sensor = { type = "sensor", source = "scene:path_40", rate_hz = 0 }
compressor.type = "compressor"
reconstructor = { type = "reconstructor", iterations = 1 }
monitor = { type = "monitor", page = false }
fox = { type = "foxglove", port = 0 }
"""
    )
    graph = start("launch", "observed.toml", "--frames", "1200", "--summary", "out.json")
    graph.wait_for("ready")
    os.kill(graph.pid_of("fox"), signal.SIGSTOP)
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(graph.notes))
    note_of_graph(graph.notes)
    found = choose_graph(None)

    def sensor_has_ended():
        return ("sensor", "ended") in {
            (n["name"], n["condition"]) for n in describe(found)["nodes"]
        }

    wait_until(sensor_has_ended, "the end of the sensor")
    os.kill(graph.pid_of("fox"), signal.SIGCONT)
    assert graph.finish()[0] == 0
    summary = json.loads((tmp_path / "out.json").read_text())
    assert summary["patches"]["skin"]["frames"]["reconstructed"] == 1200
    fox = summary["nodes"]["fox"]
    # Of each topic: what was sent, or dropped by the bridge, or by the queue of its writer.
    for topic in ("/skin/taxels", "/skin/truth", "/skin/reconstruction"):
        assert fox["received"][topic] + fox["lost"][topic] == 1200
    streams = sum(fox["received"][topic] for topic in fox["received"] if topic != "/skin/skin")
    assert fox["bridge"]["sent"] + fox["bridge"]["dropped"] == streams


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ({"maps": ["taxel"]}, "did you mean 'taxels'"),
        ({"maps": []}, "at least one"),
        ({"depth": 0}, "depth: 0 is outside 1..1000"),
    ],
)
def test_settings_that_make_no_sense_are_refused(values, fault):
    with pytest.raises(SettingsError, match=fault):
        BridgeSettings.from_mapping(values)
