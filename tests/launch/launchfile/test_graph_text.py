"""A graph as text."""

from sparseskin.launch.commands.cli import main
from sparseskin.launch.commands.launch import graph_text
from sparseskin.launch.launchfile.load import load


def test_a_dry_run_shows_the_graph(capsys):
    assert main(["launch", "path_40", "--dry-run"]) == 0
    out = capsys.readouterr().out
    assert out.rstrip() == graph_text(load("path_40"))
    (line,) = (line for line in out.splitlines() if line.startswith("/skin/measurements "))
    assert line.split() == ["/skin/measurements", "compressor", "reconstructor,", "monitor"]


def test_a_graph_states_its_transport_and_how_its_nodes_are_scheduled():
    assert "\ntransport ipc\n" in graph_text(load("path_40"))
    changes = ["graph.transport=tcp", "graph.cpus=[1, 0]", "sensor.priority=7"]
    text = " ".join(graph_text(load("path_40", changes)).split())
    assert " transport tcp " in text
    assert text.count("cpus = [0, 1]") == 4
    assert text.count("priority = 7") == 1
