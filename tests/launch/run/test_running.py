"""Notes of running graphs, in a folder that is theirs alone: there while the graph is."""

import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
from dataclasses import asdict, replace
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from conftest import Program, note_of_graph, wait_until
from other_user import NOBODY, become_nobody, give
from processes import announced

from sparseskin.launch.commands.cli import main
from sparseskin.launch.run import running
from sparseskin.launch.run.running import (
    GraphError,
    RunningGraph,
    RunningNode,
    choose_graph,
    is_running,
    running_graphs,
    runtime_folder,
    socket_path,
    write_note,
)
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.network.network import Network
from sparseskin.nodes.network.sockets import make_context


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path / "graphs"))


def graph(name="path_40", pid=7):
    nodes = {
        "sensor": RunningNode("sensor", "ipc://@x", ["/skin/skin", "/skin/taxels"])
    }
    return RunningGraph(name, pid, 123, "[nodes]", nodes)


def test_a_graph_is_found_while_it_runs():
    assert running_graphs() == []
    with announced(graph()):
        assert running_graphs() == [graph()]
        assert (
            choose_graph(None) == choose_graph("path_40") == choose_graph("path_40-7")
        )
        assert is_running(graph())
    assert running_graphs() == []
    assert not is_running(graph())


@pytest.mark.parametrize("written", [0, 1])
def test_a_launcher_that_is_killed_as_it_writes_its_note_leaves_nothing(written):
    code = (
        "import os, pathlib, socket, sys\n"
        "from sparseskin.launch.run.running import RunningGraph, page_path, write_note\n"
        "graph = RunningGraph('dead', os.getpid(), 0, '', {})\n"
        "listener = socket.socket(socket.AF_UNIX)\n"
        "listener.bind(graph.control)\n"
        "listener.listen()\n"
        "pathlib.Path(page_path(0)).touch()\n"
        "if sys.argv[1] == '1': write_note(graph)\n"
        "pathlib.Path.replace = lambda *_: os._exit(9)\n"
        "write_note(graph)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(written)], check=False)
    assert (done.returncode, len(list(runtime_folder().iterdir()))) == (9, 3 + written)
    assert (running_graphs(), list(runtime_folder().iterdir())) == ([], [])


@pytest.mark.parametrize(("n_bytes", "is_refused"), [(88, False), (89, True)])
def test_a_path_that_leaves_no_room_for_the_name_of_a_socket_is_refused(
    monkeypatch, n_bytes, is_refused
):
    """Of the 107 bytes of a path, `/4194304.9999.sock` takes 19 at most."""
    with tempfile.TemporaryDirectory(prefix="s") as parent:
        name = "x" * (n_bytes - len(parent) - 1)
        monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", f"{parent}/{name}")
        if is_refused:
            with pytest.raises(GraphError):
                runtime_folder()
            return
        longest = runtime_folder() / "4194304.9999.sock"
        with socket.socket(socket.AF_UNIX) as served:
            served.bind(str(longest))


def test_a_note_that_is_gone_is_removed_again_without_an_error():
    write_note(graph())
    running.remove_note(graph())
    running.remove_note(graph())
    assert list(runtime_folder().iterdir()) == []


def test_each_topic_of_a_graph_has_the_name_of_its_writer():
    assert graph().writers() == {"/skin/skin": "sensor", "/skin/taxels": "sensor"}
    assert graph().label == "path_40-7"
    assert not graph().starting
    assert replace(graph(), nodes={}).starting


def test_which_of_several_graphs_has_to_be_said(tmp_path, monkeypatch, capsys):
    with pytest.raises(GraphError, match="no graph runs"):
        choose_graph(None)
    with announced(graph()), announced(graph(pid=8)), announced(graph("lift", 9)):
        with pytest.raises(
            GraphError, match=r"several graphs run.*path_40-7, path_40-8"
        ):
            choose_graph("path_40")
        assert choose_graph("lift").pid == 9
        assert choose_graph("path_40-8").pid == choose_graph("8").pid == 8
        with pytest.raises(GraphError, match="--graph lft: no such graph runs"):
            choose_graph("lft")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "sparseskin.launch.commands.observers.choose_graph", lambda *_: graph()
    )
    assert main(["record", "--out", "a.mcap"]) == 2
    assert capsys.readouterr().err == "path_40-7: has just ended\n"


def test_a_graph_that_is_starting_is_waited_for(monkeypatch, capsys):
    starting = replace(graph(), nodes={})
    with announced(starting):
        assert (running_graphs(), running_graphs(starting=True)) == ([], [starting])
        assert main(["graph", "list"]) == 0
        listed = " ".join(capsys.readouterr().out.split())
        assert listed == "GRAPH PID NODES path_40 7 (starting)"
        with monkeypatch.context() as patch:
            patch.setattr(running.time, "sleep", lambda _: write_note(graph()))
            assert choose_graph("path_40") == graph()
        assert (
            capsys.readouterr().err == "path_40-7: is starting; waiting until it runs\n"
        )
        assert running_graphs(starting=True) == [graph()]
    monkeypatch.setattr(running, "PATIENCE_S", 0.0)
    with announced(starting):
        with pytest.raises(GraphError, match="path_40-7: is still starting after 0 s"):
            choose_graph(None)
        # One that runs is not held up by another that starts.
        with announced(graph("lift", 9)):
            assert choose_graph(None).pid == 9


GRAPH = RunningGraph(
    "path_40", 7, 0, "", {"sensor": RunningNode("sensor", "ipc://x", [])}
)
TRIED = """
import json
found = []
for code in DENIED:
    try:
        exec(code)
        found.append("done")
    except Exception as error:
        found.append(type(error).__name__)
print(json.dumps(found))
"""
LONG = ("launch", "path_40", "--set", "sensor.rate_hz=20", "--set", "monitor.port=0")
"""A graph that runs for ten minutes."""
LAUNCH = ("launch", "drag_wrench_40", "--set", "monitor.page=false", "--frames", "1")


@pytest.fixture
def folder(monkeypatch):
    """A runtime folder, not yet made, in a folder that every user may enter."""
    with tempfile.TemporaryDirectory(prefix="ss-") as name:
        os.chmod(name, 0o755)
        monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", f"{name}/run")
        monkeypatch.setenv("XDG_STATE_HOME", f"{name}/state")
        yield Path(name) / "run"


@pytest.fixture
def as_nobody():
    """Run Python code as another user of the host."""
    return become_nobody()


def put_link(path):
    (path.parent / "target").mkdir(mode=0o700)
    path.symlink_to(path.parent / "target")


def open_to_all(path):
    path.mkdir()
    path.chmod(0o755)


def give_away(path):
    path.mkdir(mode=0o700)
    give(path)


@pytest.mark.parametrize(
    ("prepare", "fault"),
    [
        (put_link, "is a link"),
        (Path.touch, "File exists"),
        (open_to_all, "mode 0755 lets other users in"),
        (give_away, f"belongs to user {NOBODY}"),
    ],
    ids=["link", "file", "mode", "owner"],
)
def test_a_folder_of_others_is_refused(folder, capsys, monkeypatch, prepare, fault):
    prepare(folder)

    def no_process(*_, **__):
        raise AssertionError("a process was started")

    monkeypatch.setattr(subprocess, "Popen", no_process)
    for command in (LAUNCH, ("node", "list")):
        assert main(command) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"{folder}: {fault}")
        assert line.endswith("SPARSESKIN_RUNTIME_DIR names another")
    context = make_context()
    config = {"name": "sensor", "endpoint": f"ipc://{folder}/1.0.sock"}
    # nor does a node bind there
    with pytest.raises(SparseskinError, match=f"^{folder}: "):
        Network(context, config, lambda: 0, print)
    context.destroy(linger=0)
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(folder / ("x" * 100)))
    assert main(LAUNCH) == 2
    assert "too long for the path of a socket" in capsys.readouterr().err


def test_another_user_gets_at_nothing_of_a_running_graph(as_nobody):
    with (
        tempfile.TemporaryDirectory(prefix="ss-") as name,
        contextlib.ExitStack() as stack,
    ):
        os.chmod(name, 0o755)  # unlike folders of tests, every user may enter it
        words = (*LONG, "--set", "graph.log_dir=logs", "--record", "run.mcap")
        program = stack.enter_context(Program(*words, cwd=Path(name)))
        url = urlsplit(program.wait_for("live page: "))
        program.wait_for("[launch] ready")
        (logs,) = Path(name, "logs").iterdir()
        note = note_of_graph(Path(name, "graphs"))
        pids = list(program.survivors())
        assert len(pids) == 6
        assert (logs / "monitor.log").is_file()
        assert as_nobody(f"import os; print(os.path.isdir({name!r}))") == "True"
        denied = [
            *(f"open({str(path)!r})" for path in (logs / "monitor.log", note)),
            *(f"import os; os.listdir({str(path)!r})" for path in (logs, note.parent)),
            *(
                f"import socket as s; s.socket(s.AF_UNIX).{use}({str(path)!r})"
                for path in (*note.parent.glob("*.sock"), note.parent / "9.sock")
                for use in ("connect", "bind")
            ),
            f"open({name + '/run.mcap.part'!r}, 'r+')",
            f"import os; os.link({name + '/run.mcap.part'!r}, {name + '/mine'!r})",
            f"import os; os.rename({str(logs)!r}, {name + '/mine'!r})",
            *(
                f"open('/proc/{pid}/{what}').read()"
                for pid in pids
                for what in ("environ", "mem")
            ),
            *(f"import os; os.listdir('/proc/{pid}/fd')" for pid in pids),
            *(f"import os; os.kill({pid}, 0)" for pid in pids),
        ]
        found = json.loads(as_nobody(f"DENIED = {denied!r}\n{TRIED}"))
        assert dict(zip(denied, found, strict=True)) == dict.fromkeys(
            denied, "PermissionError"
        )
        token = url.query.removeprefix("token=")
        assert len(token) > 20
        listed = "import pathlib; print(b' '.join(p.read_bytes() for p in pathlib.Path('/proc')"
        listed += ".glob('[0-9]*/cmdline')).count(b'run_node'))"
        assert int(as_nobody(listed)) >= 5
        assert (
            as_nobody(listed.replace("run_node", f"{token[:9]}' + b'{token[9:]}"))
            == "0"
        )
        for query, status in (("", 403), (f"?{url.query}", 200)):
            ask = f"import http.client as c; p = c.HTTPConnection({url.netloc!r}); "
            ask += f"p.request('GET', '/{query}'); print(p.getresponse().status)"
            assert as_nobody(ask) == str(status)


def test_what_a_killed_graph_has_left_is_removed_by_the_next_command(
    start, tmp_path, monkeypatch
):
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setenv("BROWSER", "true")  # the program, which shows no page
    program = start(*LONG, "--open")
    program.wait_for("[launch] ready")
    folder = tmp_path / "graphs"
    (page,) = folder.glob(f"{program.process.pid}.*.html")
    assert page.stat().st_mode & 0o777 == 0o600
    assert "?token=" in page.read_text()
    assert len(list(folder.glob(f"{program.process.pid}.*.sock"))) == 4
    wait_until((folder / f"{program.process.pid}.sock").exists, "the control socket")
    program.kill_all()
    program.process.communicate()
    # The launcher's note and socket; a node that notices its end first may remove its own.
    left = {path.name for path in folder.iterdir()}
    assert {
        f"path_40-{program.process.pid}.json",
        f"{program.process.pid}.sock",
    } <= left
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(folder))

    def removed():  # a process that is being killed still holds its socket
        return running_graphs() == [] and not list(folder.iterdir())

    wait_until(removed, "the end of all nodes")


def test_what_others_wrote_stays(folder):
    runtime_folder()
    old = asdict(GRAPH)
    texts = {
        "settings.json": '{"colour": 1}',
        "path_40-7.json": json.dumps(old | {"pid": 8}),
        "broken-7.json": "{",
        "list-7.json": "[]",
        "text-7.json": '"a"',
        "deep-7.json": "[" * 100_000,
        "7.sock": "no socket",
        "7.mine.html": "no page of a graph",
        "8.page.html": "nor this",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    (folder / "elsewhere").write_text(json.dumps(old | {"name": "link"}))
    (folder / "link-7.json").symlink_to(folder / "elsewhere")
    os.mkfifo(folder / "fifo-7.json")
    with (
        socket.socket(socket.AF_UNIX) as served,
        socket.socket(socket.AF_UNIX) as named,
    ):
        served.bind(str(folder / "8.1.sock"))
        served.listen()
        named.bind(str(folder / "7.mine.sock"))
        (folder / "own-8.json").write_text(json.dumps(old | {"name": "own", "pid": 8}))
        before = {path.name for path in folder.iterdir()}
        assert (running_graphs(), {path.name for path in folder.iterdir()}) == (
            [],
            before,
        )
    assert running_graphs() == []
    assert before - {path.name for path in folder.iterdir()} == {
        "own-8.json",
        "8.1.sock",
    }
    assert all((folder / name).read_text() == text for name, text in texts.items())


def test_what_a_node_made_after_the_note_was_removed_is_removed_too(folder):
    runtime_folder()
    gone = subprocess.Popen(["true"])
    gone.wait()
    here, served = os.getpid(), f"{gone.pid}.1.sock"
    with contextlib.ExitStack() as stack:
        orphans = [f"{gone.pid}{end}" for end in (".sock", ".0.sock")]
        for name in (*orphans, served, f"{here}.0.sock"):
            made = stack.enter_context(socket.socket(socket.AF_UNIX))
            made.bind(str(folder / name))
            if name == served:
                made.listen()
        (folder / f"{gone.pid}.2.html").touch()
        (folder / "(.0.sock").touch()  # of others
        assert running_graphs() == []
        others = {"(.0.sock", f"{here}.0.sock"}
        assert {path.name for path in folder.iterdir()} == {served, *others}
    assert (running_graphs(), {path.name for path in folder.iterdir()}) == ([], others)


def test_a_graph_counts_as_running_while_no_file_can_be_opened(folder, monkeypatch):
    def full(*_, **__):
        raise OSError(24, "Too many open files")

    with announced(GRAPH), monkeypatch.context() as patch:
        patch.setattr(socket, "socket", full)
        assert is_running(GRAPH)


def test_an_environment_of_another_user_is_not_used(folder, monkeypatch):
    folder.mkdir()
    give_away(folder / "theirs")
    monkeypatch.delenv("SPARSESKIN_RUNTIME_DIR")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder / "theirs"))
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    assert runtime_folder() == folder / f"sparseskin-{os.geteuid()}"
    assert Path(GRAPH.control).parent == Path(socket_path(0)).parent == runtime_folder()
