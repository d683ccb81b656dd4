"""Mutated launch files: one line an error, exit code 2, and never a traceback.

At full size 20,000 files; `SPARSESKIN_FUZZ_FILES` states another number.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.launch.launchfile.load import BUNDLED, bundled_names

NAME = "fuzzed.toml"
N_FILES = int(os.environ.get("SPARSESKIN_FUZZ_FILES", "0"))
WORTHLESS = (
    *("0", "-1", "1e400", "nan", "-inf", "true", '""', '"\\u0000"', "[]", "{}", "[[[[1]]]]"),
    *("9" * 400, '"' + "x" * 5000 + '"', '"on-failure"', "1979-05-27", "0x_", "'''"),
    *('"scene:path_40"', '"file:/dev/null"', '"file:/"', '"a.b:c"', '"::"', '"/skin/taxels"'),
)
#: Most mutations leave it TOML, so that what is checked after that is reached.
_WEIGHTS = (0.08, 0.04, 0.04, 0.4, 0.35, 0.03, 0.02, 0.01, 0.03)
_OF_SETTINGS = (3, 4)


def test_every_fault_of_a_launch_file_is_a_line_that_names_it(
    full: bool,
    note: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    n_files = N_FILES or (20_000 if full else 300)
    rng = np.random.default_rng(7)
    texts = [(BUNDLED / f"{name}.toml").read_bytes() for name in bundled_names()]
    codes: Counter[int] = Counter()
    longest_s, n_lines = 0.0, 0
    for _ in range(n_files):
        text = mutated(texts[rng.integers(len(texts))], texts, rng)
        Path(NAME).write_bytes(text)
        began_s = time.perf_counter()
        code = main(["launch", NAME, "--dry-run"])
        longest_s = max(longest_s, time.perf_counter() - began_s)
        lines = capsys.readouterr().err.splitlines()
        assert bool(lines) == bool(code), text
        assert all(line.startswith(NAME) for line in lines), (lines, text)
        codes[code] += 1
        n_lines += len(lines)
    note(files=n_files, **{f"code {k}": n for k, n in codes.items()}, longest_ms=1e3 * longest_s)
    assert codes.keys() == {0, 2}
    assert n_lines > codes[2]


def mutated(text: bytes, others: list[bytes], rng: np.random.Generator) -> bytes:
    """A launch file after one to three random mutations."""
    for _ in range(rng.integers(1, 4)):
        lines = text.split(b"\n")
        what = rng.choice(len(_WEIGHTS), p=_WEIGHTS)
        settings = [k for k, line in enumerate(lines) if b"=" in line]
        if what in _OF_SETTINGS and settings:
            at = settings[rng.integers(len(settings))]
        else:
            at = int(rng.integers(len(lines)))
        key, equals, value = lines[at].partition(b"=")
        match what:
            case 0:
                del lines[at]
            case 1:
                lines.insert(at, lines[rng.integers(len(lines))])
            case 2:
                other = others[rng.integers(len(others))].split(b"\n")
                lines.insert(at, other[rng.integers(len(other))])
            case 3 if equals:
                worthless = WORTHLESS[rng.integers(len(WORTHLESS))]
                lines[at] = key + b"= " + worthless.encode()
            case 4 if equals and len(key) > 2:
                place = int(rng.integers(len(key) - 1))
                lines[at] = key[:place] + key[place + 1 :] + equals + value
            case 5:
                lines[at] = lines[at][: rng.integers(len(lines[at]) + 1)]
            case 6:
                lines[at] += rng.bytes(int(rng.integers(1, 20)))
            case 7:
                depth = int(rng.integers(1, 3000))
                lines[at] = b"deep = " + b"[" * depth + b"]" * depth
            case _:
                changed = bytearray(lines[at] or b"#")
                changed[rng.integers(len(changed))] = rng.integers(256)
                lines[at] = bytes(changed)
        text = b"\n".join(lines)
    return text
