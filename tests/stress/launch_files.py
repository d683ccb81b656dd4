"""Mutated launch files: each fault is one line, and no file is too much for the checker."""

from __future__ import annotations

import contextlib
import io
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.launch.commands.cli import main
from sparseskin.launch.launchfile.load import BUNDLED, bundled_names
from sparseskin.nodes.lookup import one_line

NAME = "fuzzed.toml"
ALLOWED_CODES = (0, 2)
WORTHLESS = (
    *("0", "-1", "1e400", "nan", "-inf", "true", '""', '"\\u0000"', "[]", "{}", "[[[[1]]]]"),
    *("9" * 400, '"' + "x" * 5000 + '"', '"on-failure"', "1979-05-27", "0x_", "'''"),
    *('"scene:path_40"', '"file:/dev/null"', '"file:/"', '"a.b:c"', '"::"', '"/skin/taxels"'),
)
#: Most mutations leave it TOML, so that what is checked after that is reached.
_WEIGHTS = (0.08, 0.04, 0.04, 0.4, 0.35, 0.03, 0.02, 0.01, 0.03)
_OF_SETTINGS = (3, 4)


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Check mutated launch files, `launch FILE --dry-run` each.

    `point`: n: how many files. seed.

    Returns
    -------
    dict
        codes: how often each exit code came. faulty: what was not as it has to be, each with the
        file's text, 5 at most. n_faulty. longest_ms: the longest check. n_lines: lines of errors.
    """
    rng = np.random.default_rng(point["seed"])
    texts = [(BUNDLED / f"{name}.toml").read_bytes() for name in bundled_names()]
    codes: Counter[str] = Counter()
    faulty: list[str] = []
    longest_s, n_lines, n_faulty = 0.0, 0, 0
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for _ in range(point["n"]):
            text = mutated(texts[rng.integers(len(texts))], texts, rng)
            Path(NAME).write_bytes(text)
            began_s = time.perf_counter()
            code, lines, fault = checked()
            longest_s = max(longest_s, time.perf_counter() - began_s)
            codes[str(code)] += 1
            n_lines += len(lines)
            if fault:
                n_faulty += 1
                faulty = [*faulty, f"{fault}\n{text!r}"][:5]
    return {
        "codes": dict(codes),
        "n_lines": n_lines,
        "n_faulty": n_faulty,
        "faulty": faulty,
        "longest_ms": round(1e3 * longest_s, 1),
    }


def checked() -> tuple[int | None, list[str], str]:
    """Check the file `NAME`: the exit code, the lines of stderr, and the fault of the checker:
    an exception, another exit code, no line for an error, a line that does not name the file.
    """
    out, err = io.StringIO(), io.StringIO()
    code = None
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(["launch", NAME, "--dry-run"])
    except BaseException as error:
        return code, [], f"raised {one_line(error)}"
    lines = err.getvalue().splitlines()
    unnamed = [line for line in lines if not line.startswith(NAME)]
    if code not in ALLOWED_CODES:
        return code, lines, f"exit code {code}"
    if bool(lines) != bool(code):
        return code, lines, f"exit code {code} with {len(lines)} lines"
    if unnamed:
        return code, lines, f"a line that does not name the file: {unnamed[0][:200]}"
    return code, lines, ""


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
