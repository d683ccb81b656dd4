"""Run the tests of solvers and operators in plain numpy, once for kernels of OpenBLAS that this
host can run. The whole test run takes the compiled loops, which call no BLAS.

OpenBLAS chooses its kernel by the processor; OPENBLAS_CORETYPE makes it take another. A name that
it does not know, or whose instructions the processor lacks, makes it fall back, so the kernel is
read from what OpenBLAS reports. The kernel that it takes by itself is used where there is no other.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys

CANDIDATES = ("Nehalem", "Haswell", "SkylakeX")
"""One of each width of vector: SSE, AVX2, AVX-512."""
N_EXAMPLES = 10
"""Examples of each property: rounding depends on the kernel, and hardly on the example."""
TESTS = (
    "tests/nodes/compressor/phi",
    "tests/nodes/reconstructor/bases",
    "tests/nodes/reconstructor/skin",
    "tests/nodes/reconstructor/solvers",
)
IGNORED = (
    *("*/phi/test_a*.py", "*/phi/test_stored.py", "*/skin/test_adaptive_skin.py"),
    "*/solvers/test_finite.py",
)
"""Tests of the choice of rows, which call no BLAS, and those whose bounds
are far beyond rounding."""


def kernel_of(name: str | None) -> str | None:
    """Kernel that OpenBLAS takes when asked for `name`; None if it does not run here."""
    environment = {**os.environ, "OPENBLAS_VERBOSE": "2"}
    environment.pop("OPENBLAS_CORETYPE", None)
    if name is not None:
        environment["OPENBLAS_CORETYPE"] = name
    code = "import numpy as np; a = np.ones((40, 40), np.float32); assert (a @ a == 40).all()"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    found = re.findall(r"^Core: (\w+)", done.stdout + done.stderr, flags=re.MULTILINE)
    return found[-1] if done.returncode == 0 and found else None


def main() -> int:
    own = kernel_of(None)
    names = {kernel_of(name): name for name in reversed(CANDIDATES)}
    names = {
        kernel: name for kernel, name in names.items() if kernel not in (None, own)
    }
    for kernel, name in (names or {own: ""}).items():
        print(f"OpenBLAS kernel {kernel} (OPENBLAS_CORETYPE={name})", flush=True)
        pytest = [sys.executable, "-m", "pytest", "-q", "-n", "auto", "-m", "not slow"]
        done = subprocess.run(
            [*pytest, *(f"--ignore-glob={glob}" for glob in IGNORED), *TESTS],
            env={
                **os.environ,
                **({"OPENBLAS_CORETYPE": name} if name else {}),
                "SPARSESKIN_EXAMPLES": str(N_EXAMPLES),
                "SPARSESKIN_FAST": "off",
            },
            check=False,
        )
        if done.returncode:
            return done.returncode
    return 0


if __name__ == "__main__":
    sys.exit(main())
