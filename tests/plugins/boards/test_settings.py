"""Settings of boards: queries, profiles, faults, lists, and the page on boards."""

import argparse
import contextlib
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
from conftest import PATIENCE_S, wait_until
from damaged import refusal
from hypothesis import given
from hypothesis import strategies as st
from processes import COMMAND

from sparseskin.launch.commands.cli import main
from sparseskin.launch.commands.completion import candidates
from sparseskin.launch.launchfile.load import LaunchError, load
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.network.keys import make_key_files
from sparseskin.nodes.sensor.sources import find_address
from sparseskin.plugins.boards.framing import Frame
from sparseskin.plugins.boards.readings import DTYPES, Decoder
from sparseskin.plugins.boards.serial_port import serial_devices
from sparseskin.plugins.boards.settings import BoardSettings, profile_names
from sparseskin.plugins.boards.source import describe_board

PLAIN = "n_rows=2&n_cols=3&start=AA55"


def serial(query, **stated):
    return describe_board(f"serial:/dev/ttyUSB0?{query}", **stated)


class TestProfiles:
    def test_every_profile_is_complete_with_rows_and_columns_which_go_before_its_own(
        self,
    ):
        for name in profile_names():
            board = serial(f"profile={name}&n_rows=40&n_cols=5")
            assert board.skin.shape == (40, 5)
            assert board.framing.is_whole(
                board.framing.encode(bytes(board.framing.payload_bytes))
            )

    def test_a_file_of_ones_own_is_read(self, tmp_path):
        path = tmp_path / "own.toml"
        path.write_text(
            'about = "mine"\nstart = "A5"\nn_rows = 2\nn_cols = 3\nrow_order = [1, 0]\n'
            'scale = 0.5\nunit = "N"\npitch_mm = 4\nbitrate = 500000\n'
        )
        board = serial(f"profile={path}")
        assert board.skin.shape == (2, 3)
        assert board.skin.unit == "N"
        assert board.skin.f_max == 127.5
        assert board.skin.pitch_m == pytest.approx(0.004)
        assert board.decode(bytes([0, 1, 2, 3, 4, 5])).tolist() == [
            [1.5, 2, 2.5],
            [0, 0.5, 1],
        ]

    @pytest.mark.parametrize(
        ("text", "fault"),
        [
            ("n_rows = 2\nbaudd = 9600", "baudd: unknown key (did you mean 'baud'?)"),
            ("\x00", "no TOML"),
        ],
    )
    def test_a_fault_of_a_file_is_one_line(self, tmp_path, text, fault):
        path = tmp_path / "own.toml"
        path.write_text(text)
        shown = refusal(lambda: serial(f"profile={path}"), SourceError)
        assert fault in shown
        assert str(path) in shown

    @given(raw=st.binary(max_size=80))
    def test_no_file_is_a_crash(self, tmp_path_factory, raw):
        path = tmp_path_factory.getbasetemp() / "any.toml"
        path.write_bytes(raw)
        with contextlib.suppress(SourceError):
            serial(f"profile={path}")


FAULTS = [
    ("serial:/dev/ttyUSB0?profile=flexitac_16x23", "did you mean 'flexitac_16x32'?"),
    (
        f"serial:/dev/ttyUSB0?{PLAIN}&bauds=1",
        "bauds: unknown key (did you mean 'baud'?)",
    ),
    (f"serial:/dev/ttyUSB0?{PLAIN}&baud=0", "baud: 0 is outside"),
    (f"serial:/dev/ttyUSB0?{PLAIN}&n_rows=3", "n_rows is stated twice"),
    (f"serial:/dev/ttyUSB0?{PLAIN}&baud", "'baud' is no KEY=VALUE"),
    (f"serial:/dev/ttyUSB0?{PLAIN}&row_order=0,0", "each of 0..1 once"),
    (f"serial:/dev/ttyUSB0?{PLAIN}&row_order=a,b", "each of 0..1 once"),
    (f"serial:/dev/ttyUSB0?{PLAIN}&zero=255", "leaves no range"),
    (f"serial:/dev/ttyUSB0?{PLAIN}&dtype=float32", "f_max is not stated"),
    (f"serial:/dev/ttyUSB0?{PLAIN}", "there is no device /dev/ttyUSB0"),
    ("serial:/dev/ttyUSB0?profile=numbered", "n_rows is not stated; add n_rows=NUMBER"),
    ("serial:/dev/ttyUSB0?n_rows=2&n_cols=3&start=A", "pairs of hexadecimal digits"),
    ("serial:/dev/ttyUSB0?n_rows=4096&n_cols=4096&start=AA", "at most 1048576"),
    ("udp:5005?n_rows=2&n_cols=3&bind=here", "bind: 'here' is no IPv4 address"),
    ("can:can9?n_rows=2&n_cols=4&ids=0x10", "there is no CAN interface can9"),
    ("can:can9?n_rows=4&n_cols=4&ids=0x10", "index=u8"),
    (
        "can:can9?n_rows=4&n_cols=4&ids=0x10-0x12",
        "3 ids, but a frame of 16 bytes has 2 chunks",
    ),
    ("can:can9?n_rows=4&n_cols=4&ids=0x10,0x10", "an id occurs twice"),
    ("can:can9?n_rows=4&n_cols=4&ids=0x20000000", "the largest extended id"),
    ("serail:/dev/ttyUSB0", "did you mean 'serial'?"),
    (f"serial:/dev/ttyUSB0?{PLAIN}&stamp=u32", "stamp_at: is not stated"),
    (
        f"serial:/dev/ttyUSB0?{PLAIN}&stamp=u32&stamp_at=2&skip=3",
        "stamp_at: 2; allowed are the 4",
    ),
    (
        f"serial:/dev/ttyUSB0?{PLAIN}&stamp=u16&stamp_at=9&after=2",
        "stamp_at: 9; allowed are the 2",
    ),
    (
        f"serial:/dev/ttyUSB0?{PLAIN}&stamp=sequence",
        "frames have no number; add sequence=u16",
    ),
    (f"serial:/dev/ttyUSB0?{PLAIN}&piece=3", "goes with first=u16"),
    (f"serial:/dev/ttyUSB0?{PLAIN}&piece=7&first=u8&first_at=0", "at most 6"),
    (f"serial:/dev/ttyUSB0?{PLAIN}&length=u8&length_at=2&skip=1", "needs a CRC"),
    (
        "serial:/dev/ttyUSB0?n_rows=2&n_cols=3&start=??AA",
        "the first byte has to be stated",
    ),
    ("can:can9?n_rows=4&n_cols=4&ids=0x10&piece=3", "piece: unknown key"),
]


@pytest.mark.parametrize(("source", "fault"), FAULTS)
def test_a_fault_of_a_source_is_one_line_that_names_it(source, fault):
    pytest.importorskip("serial")
    pytest.importorskip("can")
    assert fault in refusal(lambda: find_address(source).check(), SourceError)


def test_a_missing_package_is_one_line_with_its_extra(monkeypatch):
    # As if it were not installed.
    for name in ("serial", "can"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(SourceError, match=r"pip install 'sparseskin\[serial\]'"):
        find_address(f"serial:/dev/null?{PLAIN}").check()
    with pytest.raises(SourceError, match=r"pip install 'sparseskin\[can\]'"):
        find_address("can:can0?n_rows=2&n_cols=3&ids=0x10&interface=virtual").check()


def test_properties_may_be_stated_by_the_sensor_instead():
    board = serial("start=AA", n_rows=2, n_cols=3, unit="N", f_max=4.0)
    assert board.skin.shape == (2, 3)
    assert board.skin.unit == "N"
    assert board.skin.f_max == 4.0
    for stated in ({"n_rows": 3}, {"f_max": 5.0}, {"unit": "kPa"}):
        with pytest.raises(SourceError, match="is stated, but the"):
            serial(f"{PLAIN}&f_max=4&unit=N", **stated)


class TestReadings:
    @given(
        dtype=st.sampled_from(DTYPES),
        byte_order=st.sampled_from(["little", "big"]),
        order=st.sampled_from(["rows", "columns"]),
        rows=st.permutations(range(3)),
        cols=st.permutations(range(4)),
        seed=st.integers(0, 99),
    )
    def test_each_count_comes_to_its_taxel(
        self, dtype, byte_order, order, rows, cols, seed
    ):
        orders = {
            "row_order": ",".join(map(str, rows)),
            "col_order": ",".join(map(str, cols)),
        }
        settings = BoardSettings(n_rows=3, n_cols=4, order=order, **orders)
        decoder = Decoder(dtype, byte_order, settings.places(), scale=0.25, zero=3)
        counts = np.random.default_rng(seed).integers(0, 100, (3, 4))
        kind = np.dtype(dtype).newbyteorder("<" if byte_order == "little" else ">")
        sent = bytearray()
        outer, inner = (3, 4) if order == "rows" else (4, 3)
        for k in range(outer):
            for j in range(inner):
                row, col = (k, j) if order == "rows" else (j, k)
                sent += np.array(counts[rows[row], cols[col]], kind).tobytes()
        readings = decoder(bytes(sent))
        assert readings.dtype == np.float32
        np.testing.assert_array_equal(readings, (counts - 3) * 0.25)


def test_sources_lists_profiles_with_a_line_on_each(capsys):
    assert main(["sources", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert "flexitac_16x32" in [one["name"] for one in found["profiles"]]
    assert all(one["about"] for one in found["profiles"])


KEYS = ("col_order", "checksum", "checksum_from", "confirm")
"""Keys of a board that begin with c."""


@pytest.mark.parametrize(
    ("begun", "found"),
    [
        ("udp:5005?profile=nu", ["udp:5005?profile=numbered"]),
        ("serial:d?bau", ["serial:d?baud="]),
        ("udp:1?n_rows=2&c", [f"udp:1?n_rows=2&{key}=" for key in KEYS]),
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
            env={
                **os.environ,
                "TERM": "xterm-256color",
                "COLUMNS": "300",
                "LINES": "24",
            },
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
    assert (
        text.index("\x1b[?1049h")
        < text.rindex("\x1b[?25h\x1b[?1049l")
        < text.rindex("frames;")
    )


TWO_HOSTS = """
hosts.edge.address = "192.168.1.10"
hosts.desk.address = "192.168.1.20"
security.keys = "keys"
[nodes]
sensor = { type = "sensor", source = "serial:/dev/none?profile=flexitac_16x32", host = "edge" }
compressor = { type = "compressor", host = "edge" }
reconstructor = { type = "reconstructor", host = "desk" }
"""


def test_a_board_of_another_host_need_not_be_here_but_is_described_rightly(
    tmp_path, monkeypatch
):
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
    found = re.search(
        rf"^```{language}\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL
    )
    assert found
    return found[1]


def test_the_profile_and_the_firmware_of_the_page_on_boards_send_what_they_state(
    tmp_path,
):
    path = tmp_path / "my_board.toml"
    path.write_text(fenced("ini"), encoding="utf-8")
    board = describe_board(f"serial:/dev/ttyUSB0?profile={path}")
    assert board.skin.shape == (12, 8)
    assert board.skin.f_max == 4095.0
    numbered = describe_board("serial:/dev/ttyUSB0?profile=numbered&n_rows=8&n_cols=8")
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
