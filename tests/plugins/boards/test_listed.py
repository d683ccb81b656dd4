"""Boards in lists and completions, and those of the page on boards."""

import argparse
import json
import os
import pty
import re
import select
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from board_lines import a_line, flexitac
from conftest import COMMAND, PATIENCE_S, wait_until

from sparseskin.launch.commands.cli import main
from sparseskin.launch.commands.completion import candidates
from sparseskin.launch.launchfile.load import LaunchError, load
from sparseskin.nodes.network.keys import make_key_files
from sparseskin.plugins.boards.framing import Frame
from sparseskin.plugins.boards.serial_port import serial_devices
from sparseskin.plugins.boards.source import describe_board


def test_sources_lists_profiles_with_a_line_on_each(capsys):
    assert main(["sources", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert "flexitac_16x32" in [one["name"] for one in found["profiles"]]
    assert all(one["about"] for one in found["profiles"])


KEYS = ("checksum", "checksum_from", "confirm", "cols", "col_order")
"""Keys of a board that begin with c."""


@pytest.mark.parametrize(
    ("begun", "found"),
    [
        ("udp:5005?profile=nu", ["udp:5005?profile=numbered"]),
        ("serial:d?bau", ["serial:d?baud="]),
        ("udp:1?rows=2&c", [f"udp:1?rows=2&{key}=" for key in KEYS]),
        ("no:d?", []),
    ],
)
def test_addresses_are_completed(begun, found):
    action = argparse.Action([], "", metavar="SOURCE")
    offered = candidates(prefix=begun, action=action, parsed_args=argparse.Namespace())
    assert list(offered) == found


def test_scope_draws_in_a_terminal_and_leaves_it_as_it_was(tmp_path):
    pytest.importorskip("serial")
    screen, terminal = pty.openpty()
    with a_line(tmp_path) as line:
        name = f"serial:{line.device}?profile=flexitac_16x32"
        process = subprocess.Popen(
            [sys.executable, *COMMAND, "scope", name],
            stdin=terminal,
            stdout=terminal,
            stderr=terminal,
            env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "300", "LINES": "24"},
        )
        os.close(terminal)
        line.sending(flexitac(k % 160) for k in range(10**9))
        shown = bytearray()

        def read():
            if select.select([screen], [], [], 0.05)[0]:
                try:
                    shown.extend(os.read(screen, 65536))
                except OSError:  # the other end is closed
                    return

        def has_drawn():
            read()
            return shown.count(b"\x1b[H") >= 3 and "▀".encode() in shown

        def has_ended():
            read()
            return process.poll() is not None and b"frames; min" in shown

        try:
            wait_until(has_drawn, "three pictures")
            os.write(screen, b"q")
            wait_until(has_ended, "its end")
            assert process.wait(timeout=PATIENCE_S) == 0
        finally:
            process.kill()
            process.wait()
            os.close(screen)
    text = shown.decode()
    assert "16 x 32 taxels, 0..255 raw" in text
    # The other screen and the hidden cursor are left again, and the summary stands on the first.
    assert text.index("\x1b[?1049h") < text.rindex("\x1b[?25h\x1b[?1049l") < text.rindex("frames;")


TWO_HOSTS = """
hosts.edge.address = "192.168.1.10"
hosts.desk.address = "192.168.1.20"
security.keys = "keys"
[nodes]
sensor = { type = "sensor", source = "serial:/dev/none?profile=flexitac_16x32", host = "edge" }
compressor = { type = "compressor", host = "edge" }
reconstructor = { type = "reconstructor", host = "desk" }
"""


def test_a_board_of_another_host_need_not_be_here_but_is_described_rightly(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("edge", "desk"):
        make_key_files(name, tmp_path / "keys")
    Path("f.toml").write_text(TWO_HOSTS)
    assert load("f.toml").nodes["sensor"].settings.source.startswith("serial:")
    Path("f.toml").write_text(TWO_HOSTS.replace("16x32", "16x23"))
    with pytest.raises(LaunchError, match=r"did you mean 'flexitac_16x32'\?"):
        load("f.toml").part(None)


def test_a_port_of_usb_is_listed_by_its_lasting_name(tmp_path):
    (tmp_path / "serial" / "by-id").mkdir(parents=True)
    for name in ("ttyUSB0", "ttyUSB1", "ttyACM0"):
        (tmp_path / name).touch()
    lasting = tmp_path / "serial" / "by-id" / "usb-Palm_0042"
    lasting.symlink_to("../../ttyUSB1")
    found = serial_devices(tmp_path)
    assert found == {
        str(tmp_path / "ttyACM0"): str(tmp_path / "ttyACM0"),
        str(tmp_path / "ttyUSB0"): str(tmp_path / "ttyUSB0"),
        str(lasting): str(tmp_path / "ttyUSB1"),
    }


ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs/howto/boards.md"


def fenced(language):
    """The first fenced block of a language."""
    found = re.search(rf"^```{language}\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert found
    return found[1]


def test_the_profile_and_the_firmware_of_the_page_on_boards_send_what_they_state(tmp_path):
    path = tmp_path / "my_board.toml"
    path.write_text(fenced("ini"), encoding="utf-8")
    board = describe_board(f"serial:/dev/ttyUSB0?profile={path}")
    assert (board.skin.shape, board.skin.f_max) == ((12, 8), 4095.0)
    numbered = describe_board("serial:/dev/ttyUSB0?profile=numbered&rows=8&cols=8")
    if (compiler := shutil.which("cc")) is None:
        pytest.skip("no C compiler")
    code = (ROOT / "examples" / "numbered_firmware.c").read_text()
    main = (
        "#include <stdio.h>\nint main(void) { uint16_t r[N]; uint8_t out[6 + 2 * N];"
        " for (int k = 0; k < N; k++) r[k] = (uint16_t)(k * 1000);"
        " return fwrite(out, 1, frame(out, 513, r), stdout) == 0; }\n"
    )
    (tmp_path / "board.c").write_text(code + main, encoding="utf-8")
    subprocess.run([compiler, "-o", "board", "board.c"], cwd=tmp_path, check=True)
    sent = subprocess.run([tmp_path / "board"], capture_output=True, check=True).stdout
    readings = (np.arange(64) * 1000).astype("<u2").tobytes()
    assert numbered.framing.frame(sent, 0) == Frame(readings, 513, 0)
    assert numbered.framing.is_whole(sent)
