"""Exported edges, compiled for this computer."""

import resource
import shutil
import subprocess
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from sparseskin.plugins.edge.description import EdgeDescription
from sparseskin.plugins.edge.export import export

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1")
# The sanitizer of addresses reserves terabytes of address space.
_KINDS = ("address", "undefined")
_FROM = 0 if resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY else 1
SANITIZED = (f"-fsanitize={','.join(_KINDS[_FROM:])}", "-fno-sanitize-recover=all")


def compiled(
    described: EdgeDescription, folder: Path, *flags: str, test: bool = False
) -> Path:
    """Export an edge into a new folder and compile it, with sanitizers; self-test if wanted."""
    if shutil.which("gcc") is None:
        pytest.skip("gcc is not installed")
    out = folder / "edge"
    export(described, out)
    shared = ["gcc", *STRICT, *SANITIZED, *flags, "edge.c", "edge_tables.c"]
    programs = [["edge_stream.c"], ["edge_test.c", "edge_check.c"]]
    for sources in programs if test else programs[:1]:
        command = [*shared, *sources, "-o", sources[0].removesuffix(".c")]
        done = subprocess.run(
            command, cwd=out, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0
        assert done.stderr == ""
    return out


def as_input(described: EdgeDescription, frames: npt.NDArray[np.uint16]) -> bytes:
    """Frames of counts as `edge_stream` reads them."""
    return frames.astype(f"<u{described.count_bytes}").tobytes()


def sent(
    out: Path, described: EdgeDescription, frames: npt.NDArray[np.uint16]
) -> bytes:
    """What the program sends for frames of counts, uint16 (k, n_rows, n_cols)."""
    done = subprocess.run(
        [out / "edge_stream"],
        input=as_input(described, frames),
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0
    assert done.stderr == b""
    return done.stdout


def random_counts(
    described: EdgeDescription, n: int, seed: int = 0
) -> npt.NDArray[np.uint16]:
    """Frames of all kinds, uint16 (n, n_rows, n_cols): empty, full, few counts, sparse, dense."""
    rng = np.random.default_rng(seed)
    d = described
    frames = rng.integers(
        0, d.full_scale, (n, d.n_rows, d.n_cols), np.uint16, endpoint=True
    )
    kinds = np.arange(n) % 6
    frames[kinds == 1] = 0
    frames[kinds == 2] = d.full_scale
    frames[kinds == 3] &= 1  # small sums: quotients that are exact ties
    frames[kinds == 4] *= rng.random(frames[kinds == 4].shape) < 0.02
    return frames
