"""Log lines of the nodes of a run: with name and time on the terminal, and in files."""

import io
import json
import os
import pwd
import re
import sys
from pathlib import Path

import pytest

from sparseskin.launch.launchfile.load import LaunchError
from sparseskin.launch.run import run_log
from sparseskin.launch.run.run_log import RunLog, time_text
from sparseskin.launch.run.terminal import Terminal
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.files import state_folder

NOW_S = 1_700_000_000.125


def test_each_node_has_a_file_and_each_line_its_time(tmp_path):
    log = RunLog(tmp_path / "logs", "drag", NOW_S)
    for line in (
        "[sensor] hot",
        "[my.node-2] a [b] c",
        "no name",
        "[sensor] cold",
        "[x/y] odd",
    ):
        log.write(line, NOW_S)
    log.close()
    assert re.fullmatch(r"drag-\d{8}-\d{6}-" + str(os.getpid()), log.folder.name)
    found = {
        path.name: path.read_text().splitlines() for path in log.folder.glob("*.log")
    }
    assert found.keys() == {"sensor.log", "my.node-2.log", "launch.log"}
    assert [line.split(" ", 2)[2] for line in found["sensor.log"]] == ["hot", "cold"]
    assert [line.split(" ", 2)[2] for line in found["launch.log"]] == [
        "no name",
        "[x/y] odd",
    ]
    assert found["sensor.log"][0].split()[1] == time_text(NOW_S)
    assert time_text(NOW_S).endswith(".125")


def test_what_a_node_prints_cannot_act_on_terminal_or_log(tmp_path, capsys):
    log = RunLog(tmp_path / "logs", "drag", NOW_S)
    terminal = Terminal(log, lambda: NOW_S)
    foreign = "\x1b]0;title\x07 \r \x9b2J \u202ehidden\u2028"
    terminal.log(f"[sensor] {foreign}")
    terminal.record(f"[sensor] {foreign}")
    terminal._next_s = 0.0
    terminal.status(f"first {foreign}\nsecond")
    log.close()
    lines = [*capsys.readouterr().err.split("\n"), *(log.folder / "sensor.log").open()]
    assert len(lines) == 6
    assert all(line.rstrip("\n").isprintable() for line in lines)
    assert sum(r"\x1b]0;title\x07" in line for line in lines) == 4


def test_a_status_is_drawn_where_its_text_changes_and_leaves_out_what_does_not_fit(
    monkeypatch,
):
    screen = io.StringIO()
    monkeypatch.setattr(screen, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("COLUMNS", "20")
    terminal = Terminal()
    for line in ("one | two", "one | two", "first part | second | third", "x" * 30):
        terminal.status(line)
    assert screen.getvalue().split("\r\x1b[J") == [
        "one | two",
        "first part | second",
        "x" * 19,
    ]


def test_a_full_file_makes_room_and_one_before_it_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(run_log, "MAX_FILE_BYTES", 1000)
    log = RunLog(tmp_path, "drag", NOW_S)
    for k in range(500):
        log.write(f"[sensor] line {k}", NOW_S)
    log.close()
    sizes = {path.name: path.stat().st_size for path in log.folder.glob("*.log*")}
    assert sizes.keys() == {"sensor.log", "sensor.log.1"}
    assert max(sizes.values()) < 1100
    assert "line 499" in "".join(path.read_text() for path in log.folder.iterdir())


def test_only_the_newest_runs_are_kept_in_the_default_folder(tmp_path):
    for k in range(3):
        (tmp_path / f"drag-{k}").mkdir()
        os.utime(tmp_path / f"drag-{k}", (k, k))
    RunLog(tmp_path, "stated", NOW_S).close()
    assert len(list(tmp_path.iterdir())) == 4
    (tmp_path / "link").symlink_to(tmp_path / "drag-2")
    os.utime(tmp_path / "link", (0, 0), follow_symlinks=False)
    log = RunLog(tmp_path, "drag", NOW_S, n_kept=3)
    names = {path.name for path in tmp_path.iterdir() if not path.is_symlink()}
    assert names >= {"drag-2", log.folder.name}
    assert not names & {"drag-0", "drag-1"}


@pytest.mark.parametrize("n_runs", [1, 3, 6])
@pytest.mark.parametrize("n_kept", [1, 3, 5])
def test_as_many_runs_are_kept_as_stated_the_new_one_included(tmp_path, n_runs, n_kept):
    for k in range(n_runs):
        (tmp_path / f"drag-{k}").mkdir()
        os.utime(tmp_path / f"drag-{k}", (k, k))
    log = RunLog(tmp_path, "drag", NOW_S, n_kept=n_kept)
    log.close()
    newest = [f"drag-{k}" for k in range(n_runs)][::-1][: n_kept - 1]
    assert {path.name for path in tmp_path.iterdir()} == {log.folder.name, *newest}


def test_a_log_that_is_closed_may_be_closed_again(tmp_path):
    log = RunLog(tmp_path, "drag", NOW_S)
    log.close()
    log.close()
    assert log.error == ""


def test_a_line_of_several_lines_stays_with_its_node(tmp_path):
    log = RunLog(tmp_path, "drag", NOW_S)
    log.write("[sensor] one\ntwo", NOW_S)
    log.close()
    assert (log.folder / "sensor.log").read_text().endswith(" one\ntwo\n")


def test_lines_stay_in_the_folder_of_the_run_whatever_is_put_in_its_place(tmp_path):
    log = RunLog(tmp_path / "logs", "drag", NOW_S)
    kept = tmp_path / "kept"
    log.folder.rename(kept)
    log.folder.mkdir()
    (tmp_path / "profile").write_text("mine\n")
    (log.folder / "sensor.log").symlink_to(tmp_path / "profile")
    log.write("[sensor] hot", NOW_S)
    log.close()
    assert (log.error, (tmp_path / "profile").read_text()) == ("", "mine\n")
    assert (kept / "sensor.log").read_text().endswith(" hot\n")


def test_a_folder_that_cannot_be_made_or_that_another_has_put_there_is_refused(
    tmp_path,
):
    assert RunLog(tmp_path, "drag", NOW_S).folder.stat().st_mode & 0o077 == 0
    with pytest.raises(LaunchError, match="File exists"):
        RunLog(tmp_path, "drag", NOW_S)
    (tmp_path / "file").touch()
    with pytest.raises(LaunchError, match=r"log_dir: .*/file: Not a directory"):
        RunLog(tmp_path / "file", "drag", NOW_S)


def test_a_full_disk_keeps_neither_table_nor_summary_back(start, mount_disk, tmp_path):
    disk = mount_disk("64k")
    (tmp_path / "wordy.py").write_text(
        "import time\nimport numpy as np\ndef frames():\n"
        "    for k in range(40):\n"
        "        print('word ' * 1000)\n"
        "        time.sleep(0.02)\n"
        "        yield k, np.ones((8, 8))\n"
    )
    program = start(
        *(
            "launch",
            "replay",
            "--set",
            "sensor.source=wordy:frames",
            "--summary",
            "summary.json",
        ),
        *("--set", f"graph.log_dir={disk}", "--set", "monitor.page=false"),
    )
    stdout, stderr = program.ended()
    assert "no more logs: " in stderr
    assert "sensed 40, reconstructed 40" in stdout
    assert json.loads((tmp_path / "summary.json").read_text())["patches"]


def test_folders_are_the_users_own_and_without_a_home_directory_the_remedy_is_named(
    monkeypatch,
):
    def unknown(*_):
        raise KeyError("uid not found")

    monkeypatch.setattr(pwd, "getpwuid", unknown)
    monkeypatch.setenv("XDG_STATE_HOME", "/s")
    assert state_folder() == Path("/s/sparseskin")
    monkeypatch.setenv("XDG_STATE_HOME", "relative")
    monkeypatch.setenv("HOME", "/h")
    assert state_folder() == Path("/h/.local/state/sparseskin")
    monkeypatch.delenv("HOME")
    with pytest.raises(
        SparseskinError, match="no home directory is known; set XDG_STATE_HOME"
    ):
        state_folder()


def test_a_run_that_fails_reports_where_its_logs_are(start, tmp_path):
    (tmp_path / "broken.py").write_text(
        "import numpy as np\ndef frames():\n    for k in range(9): yield k, np.zeros((8, 8))\n"
        "    print('a word')\n    1 / 0\n"
    )
    program = start(
        *("launch", "replay", "--set", "sensor.source=broken:frames"),
        *("--set", "graph.log_dir=logs", "--set", "monitor.page=false"),
    )
    stdout, stderr = program.ended(2)
    assert "sensed 9, reconstructed 9, lost 0" in stdout
    (folder,) = (tmp_path / "logs").iterdir()
    assert f"logs of the nodes: logs/{folder.name}\n" in stderr
    lines = (folder / "sensor.log").read_text().splitlines()
    said, failure, *trace = (line.split(" ", 2)[2] for line in lines)
    text = (
        "error: broken:frames: the driver failed: ZeroDivisionError: division by zero"
    )
    assert (said, failure) == ("a word", f"{text} (broken.py:5)")
    assert trace[0] == "Traceback (most recent call last):"
    assert any(line.endswith('broken.py", line 5, in frames') for line in trace)
    assert all(re.match(r"\d\d:\d\d:\d\d\.\d{3} \[sensor\] ", line) for line in stderr.splitlines()
               if "[sensor]" in line)  # fmt: skip
