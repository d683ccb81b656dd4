"""Files of TOML from elsewhere, and a graph as a dry run shows it."""

import pytest
from damaged import launch_faults

from sparseskin.launch.commands.cli import main
from sparseskin.launch.commands.launch import graph_text
from sparseskin.launch.launchfile.check import MAX_ERROR, MAX_ERRORS, MAX_NODES
from sparseskin.launch.launchfile.load import load
from sparseskin.nodes.toml import MAX_CHARS


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("\n[graph]\ndescription = " + "9" * 5000, ":3: not TOML: a whole number beyond 64 bits"),
        ("[graph]\ndescription = 0x" + "f" * 5000, "graph.description: a whole number beyond 64"),
        ("".join(f"[t{k}]\n" for k in range(200_000)), f"more than {MAX_CHARS} characters"),
        ("\n[graph]\na" + ".a" * 9000 + " = 1", ":3: not TOML: a key of more than 100 parts"),
        ("a" + ".a" * 50 + " = 1", "more than 8 tables or lists in each other"),
        ("a = " + "[" * 900 + "]" * 900, "more than 8 tables or lists"),
        ("".join(f"[nodes.n{k}]\n" for k in range(3000)), f"3000 nodes; at most {MAX_NODES}"),
        ("[graph]\ntransport = 'x" + "y" * 60_000 + "'", "graph.transport: 'xyyy"),
        ("[nodes.n]\ntype = '\\u001b[2J'".replace("'", '"'), r"\x1b[2J"),
    ],
)
def test_a_hostile_file_is_refused_in_lines_that_name_the_place(tmp_path, text, line):
    path = tmp_path / "g.toml"
    path.write_text(text)
    lines = launch_faults(str(path))
    assert any(line in one for one in lines)
    assert max(map(len, lines)) < 3 * MAX_ERROR
    assert len(lines) <= MAX_ERRORS + 1


def test_of_many_errors_the_first_are_named(tmp_path):
    path = tmp_path / "g.toml"
    path.write_text("".join(f"a{k} = 1\n" for k in range(6000)))
    assert len(launch_faults(str(path))) == MAX_ERRORS + 1


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
    assert (text.count("cpus = [0, 1]"), text.count("priority = 7")) == (4, 1)
