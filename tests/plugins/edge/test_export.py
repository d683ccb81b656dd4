"""The program of the edge: its description, the command that writes it, its bytes in C."""

import re
import shutil
import subprocess

import numpy as np
import pytest
from bags import skin_state
from damaged import refusal
from edges import STRICT, compiled, random_counts, sent
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.launch.commands.cli import main
from sparseskin.messages import Taxels
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor, CompressorSettings
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.node import Context
from sparseskin.plugins.boards.framing import FrameParser
from sparseskin.plugins.edge.description import (
    MAX_CHARS,
    EdgeDescription,
    compressed,
    framing_of,
    read_frame,
)
from sparseskin.plugins.edge.export import COPIED, export


def described(n_rows, n_cols, ratio=3, holes=False, **more):
    mask = None
    if holes:
        mask = np.random.default_rng(1).random((n_rows, n_cols)) < 0.8
        mask[0, 0] = False
    return EdgeDescription.chosen(n_rows, n_cols, ratio=ratio, mask=mask, **more)


CASES = {
    "one taxel": described(1, 1, 1, bits=16),
    "remainder of all sizes": described(5, 19, 2, bits=5, rows="rotating", seed=7),
    "masked, not square": described(12, 32, 4, holes=True, bits=10, adc_bits=16),
    "fixed, 8 bits of ADC": described(9, 7, 3, rows="fixed", adc_bits=8, bits=4),
    "block 256, many row subsets": described(
        20, 30, 40, block=256, adc_bits=16, bits=16
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_bytes_of_the_program_are_those_of_python(name, tmp_path):
    d = CASES[name]
    builtins = ("-DEDGE_NO_BUILTINS",) if d.n_cells % 2 else ()
    out = compiled(d, tmp_path, *builtins)
    frames = random_counts(d, 6 * len(d.subsets) + 12)
    assert sent(out, d, frames) == b"".join(compressed(d, frames))


def test_the_self_test_finds_its_frames_as_expected_and_a_changed_table_not(tmp_path):
    d = CASES["masked, not square"]
    out = compiled(d, tmp_path, test=True)
    test = subprocess.run(
        [out / "edge_test"], capture_output=True, text=True, check=False
    )
    n = len(d.subsets) + 6
    assert test.returncode == 0
    assert test.stdout == f"{n} of {n} test frames are as expected\n"
    changed = out / "edge_vectors.h"
    lines = changed.read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("    0x"))
    first = lines[at].split(",")[0].strip()
    lines[at] = lines[at].replace(first, f"0x{int(first.rstrip('u'), 16) ^ 1:08x}u", 1)
    changed.write_text("\n".join([*lines, ""]))
    command = ["make", "--silent", "test"]
    wrong = subprocess.run(
        command, cwd=out, capture_output=True, text=True, check=False
    )
    assert wrong.returncode != 0
    assert wrong.stdout == f"{n - 1} of {n} test frames are as expected\n"


def test_its_frames_are_the_messages_of_a_compressor_node():
    d = CASES["masked, not square"]
    made = {"rows": d.rows, "m": d.m, "bits": d.bits, "block": d.block, "seed": d.seed}
    node = Compressor(CompressorSettings(**made), Context("compressor", ManualClock(1)))
    skin = skin_state(
        n_rows=d.n_rows,
        n_cols=d.n_cols,
        f_max=float(d.full_scale),
        unit="counts",
        mask=d.exists,
    )
    list(node.step(skin))
    frames = random_counts(d, 3 * len(d.subsets) + 6)
    arrived = FrameParser(framing_of(d)).feed(b"".join(compressed(d, frames)))
    assert [one.sequence for one in arrived] == list(range(len(frames)))
    for counts, one in zip(frames, arrived, strict=True):
        (message,) = node.step(
            Taxels(
                stamp_ns=2, patch="skin", forces=(counts * d.exists).astype(np.float32)
            )
        )
        frame = read_frame(d, one.payload)
        assert frame.phi == message.phi
        assert frame.measurements(d.bits, 1.0).tobytes() == message.y.tobytes()
        assert frame.step == message.y.step


SMALL = described(4, 7, 2, bits=6, adc_bits=15)


@pytest.fixture(scope="module")
def small_program(tmp_path_factory):
    return compiled(SMALL, tmp_path_factory.mktemp("small"))


@given(data=st.data())
def test_any_frame_is_the_same_in_c(data, small_program):
    # Few different values: sums that cancel, and quotients that are ties.
    values = data.draw(st.lists(st.integers(0, 65535), min_size=1, max_size=5))
    counts = data.draw(st.lists(st.sampled_from(values), min_size=56, max_size=56))
    frames = np.array(counts, np.uint16).reshape(2, 4, 7)  # beyond full scale, too
    assert sent(small_program, SMALL, frames) == b"".join(compressed(SMALL, frames))


def test_the_sources_use_neither_the_heap_nor_floating_point(tmp_path):
    export(described(3, 5), tmp_path / "edge")
    texts = {
        name: (tmp_path / "edge" / name).read_text()
        for name in COPIED
        if name[-2:] == ".c"
    }
    assert len(texts) == 6
    for text in (texts["edge.c"], (tmp_path / "edge" / "edge_tables.c").read_text()):
        code = [
            line.partition("/*")[0] for line in text.splitlines() if "*" not in line[:3]
        ]
        words = set(" ".join(code).replace("(", " ").replace(")", " ").split())
        assert not words & {"malloc", "calloc", "free", "float", "double"}
        assert not any("<" in line and line.startswith("#include") for line in code)


STUB = """
#include <stdint.h>
#include <stdio.h>
enum { HIGH = 1, LOW = 0, OUTPUT = 1, A0 = 0 };
static unsigned n_read;
static void pinMode(int, int) {}
static void digitalWrite(int, int) {}
static int analogRead(int) { return (int)(n_read++ * 37u % 1000u); }
static struct {
    void begin(unsigned long) {}
    void write(const uint8_t *data, unsigned n) { fwrite(data, 1, n, stdout); }
} Serial;
"""
"""What the sketch uses of Arduino; a reading is 37 k modulo 1000."""


@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed")
def test_the_sketch_subtracts_the_readings_of_its_start(tmp_path):
    d = described(8, 12, adc_bits=10)
    export(d, tmp_path / "edge")
    folder = tmp_path / "edge" / "arduino"
    (folder / "Arduino.h").write_text(STUB)
    (folder / "main.cpp").write_text(
        '#include "Arduino.h"\n#include "arduino.ino"\n'
        "int main() { setup(); for (int k = 0; k < 5; k++) loop(); }\n"
    )
    for command in (
        ["gcc", *STRICT, "-c", "edge.c", "edge_tables.c"],
        ["g++", "-Wall", "-Wextra", "-Werror", "main.cpp", "edge.o", "edge_tables.o"],
    ):
        subprocess.run(command, cwd=folder, check=True)
    done = subprocess.run([folder / "a.out"], capture_output=True, check=True)
    read = (np.arange(6 * 96) * 37 % 1000).reshape(6, 8, 12)
    frames = np.maximum(read[1:] - read[0], 0).astype(np.uint16)
    assert frames.any()
    assert done.stdout == b"".join(compressed(d, frames))


@pytest.mark.skipif(
    not (shutil.which("avr-gcc") and shutil.which("simavr")),
    reason="gcc-avr, avr-libc and simavr are not installed",
)
def test_a_processor_whose_int_has_16_bits_sends_the_expected_bytes(tmp_path):
    export(described(16, 32, rows="rotating", adc_bits=10), tmp_path / "edge")
    command = ["make", "--silent", "avr"]
    done = subprocess.run(
        command, cwd=tmp_path / "edge", capture_output=True, text=True, check=True
    )
    assert "all frames as expected" in done.stdout + done.stderr


LOOP = '    __asm__ volatile("mov r3, #10000\\n1: subs r3, r3, #1\\n bne 1b" ::: "r3", "cc");\n'
"""20,001 instructions; their time is one and a half ticks each."""


@pytest.mark.skipif(
    not (shutil.which("arm-none-eabi-gcc") and shutil.which("qemu-system-arm")),
    reason="gcc-arm-none-eabi and qemu-system-arm are not installed",
)
def test_a_cortex_m4_sends_the_expected_bytes_and_its_instructions_are_counted(
    tmp_path,
):
    out = tmp_path / "edge"
    export(d := described(16, 32), out)

    def printed():
        command = ["make", "--silent", "cortex-m4"]
        done = subprocess.run(
            command, cwd=out, capture_output=True, text=True, check=True
        )
        text = done.stdout + done.stderr
        return {
            name: int(n)
            for name, n in re.findall(r"^(\w+ \w+) (\d+)$", text, re.MULTILINE)
        }

    found = printed()
    assert found["test frames"] == len(d.subsets) + 6
    assert found["wrong frames"] == 0
    # Each taxel is read at least once, in a load and a sum.
    assert 2 * d.n_taxels < found["instructions mean"] <= found["instructions most"]
    path = out / "cortex_m4" / "main.c"
    path.write_text(
        path.read_text().replace("    edge_compress(&edge, counts, frame);\n", LOOP)
    )
    # both ends are read in whole ticks
    assert 20000 <= printed()["instructions mean"] < 20010


MASK = np.array([[True, False, True], [True, True, True]])


@pytest.mark.parametrize("mask", [None, MASK])
def test_its_file_is_read_back_as_it_was_written(mask, tmp_path):
    made = EdgeDescription.chosen(
        2, 3, ratio=2, mask=mask, bits=11, block=4, seed=3, adc_bits=9
    )
    path = tmp_path / "edge.toml"
    path.write_text(made.to_toml())
    read = EdgeDescription.read(path)
    assert read.to_toml() == made.to_toml()
    assert read.phi.fingerprint == made.phi.fingerprint
    assert read.tags == made.tags
    for ratio, rows in ((1, None), (3, "fixed"), (3.5, None), (8, "rotating")):
        made = EdgeDescription.chosen(7, 9, ratio=ratio, rows=rows)
        assert (made.rows, made.m) == CompressorSettings(
            ratio=ratio, rows=rows
        ).rows_and_m(63)


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"n_rows": 0}, "n_rows: 0 is outside 1..4096"),
        (
            {"n_rows": 4096, "n_cols": 17},
            "n_rows: 69632 cells; allowed: 65536 or fewer",
        ),
        ({"block": 48}, "block: 48 is not a power of two (1, 2, 4 ...)"),
        ({"rule": 2}, "rule: 2 is not allowed; allowed: 1, 3"),
        ({"m": 13}, "m: 13 is not allowed; allowed: 1..12"),
        (
            {"rows": "rotate"},
            "rows: 'rotate' is not allowed (did you mean 'rotating'?)",
        ),
        ({"mask": ["0000"] * 3}, "mask: leaves no taxel"),
    ],
)
def test_values_that_are_not_allowed_are_refused_by_name(values, line):
    assert refusal(
        lambda: EdgeDescription(**{"n_rows": 3, "n_cols": 4, "m": 4, **values}),
        SettingsError,
    ).startswith(line)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("n_rows = 6", "n_row = 6", "n_row: unknown key (did you mean 'n_rows'?)"),
        ("version = 1", "version = 2", "version: 2 is not allowed; allowed: 1"),
        ("seed = 0", "seed = 1", "fingerprint: "),
        ("rule = 3\n", "", "rule: is missing"),
        (
            "seed = 0",
            "seed = 0\nmask = [" + '"1x1111",' * 6 + "]",
            "mask: expected texts of 0 and 1",
        ),
        ("version = 1", "version = 1 " + "#" * MAX_CHARS, "no TOML: more than "),
    ],
)
def test_a_file_that_was_changed_is_refused_with_its_place(old, new, line, tmp_path):
    path = tmp_path / "edge.toml"
    text = EdgeDescription.chosen(6, 6, ratio=3).to_toml()
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))
    assert refusal(lambda: EdgeDescription.read(path), SettingsError).startswith(
        f"{path}: {line}"
    )


EXPORT = ["edge", "export", "--n-rows", "6", "--n-cols", "8"]


def test_it_writes_the_program_of_the_stated_matrix(tmp_path, capsys):
    out = tmp_path / "edge"
    options = ["--ratio", "4", "--bits", "10", "--rows-mode", "rotating", "--seed", "5"]
    assert main([*EXPORT, *options, "--adc-bits", "14", "--out", str(out)]) == 0
    made = EdgeDescription.read(out / "edge.toml")
    stated = (
        made.n_rows,
        made.n_cols,
        made.m,
        made.bits,
        made.rows,
        made.seed,
        made.full_scale,
    )
    assert stated == (6, 8, 12, 10, "rotating", 5, 16383)
    assert (
        "12 of 48 taxels, rows rotating, 10 bits, 30 bytes a frame"
        in capsys.readouterr().out
    )
    assert "@" not in (out / "README.md").read_text()
    skin = tmp_path / "skin.toml"
    out = tmp_path / "of_skin"
    skin.write_text('n_rows = 2\nn_cols = 3\nf_max = 2.5\nmask = ["101", "111"]\n')
    assert (
        main(["edge", "export", "--skin", str(skin), "--m", "2", "--out", str(out)])
        == 0
    )
    made = EdgeDescription.read(out / "edge.toml")
    assert made.n_rows == 2
    assert made.n_cols == 3
    assert made.mask == ("101", "111")
    assert made.m == 2


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--bits", "3"], "--bits: 3 is outside 4..16"),
        (
            ["--ratio", "50"],
            "--ratio: 50 leaves no measurement of 48 taxels; allowed: 1..48",
        ),
        (
            ["--m", "4", "--ratio", "2"],
            "--m: states the number of measurements; leave out --ratio",
        ),
        (
            ["--skin", "s.toml"],
            "--skin: states rows and columns; leave out --n-rows and --n-cols",
        ),
        (["--out", "."], ".: exists already, and is not written over"),
        (["--out", "no/folder"], "no/folder: its folder does not exist"),
    ],
)
def test_bad_options_are_refused_in_one_line(
    words, line, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    out = [] if "--out" in words else ["--out", "edge"]
    assert main([*EXPORT, *words, *out]) == 2
    assert capsys.readouterr().err == f"{line}\n"
    assert list(tmp_path.iterdir()) == []
