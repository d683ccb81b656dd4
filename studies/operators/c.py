"""Iterations of two solvers in C: a lower bound for the time of compiled loops."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

SOURCE = Path(__file__).with_name("floor.c")
#: Parts of -ffast-math for loops, without its start-up code, which makes the whole process flush
#: subnormal numbers to 0. Without -ffinite-math-only the largest of two numbers is no single
#: instruction, and the loops of `skin` are no lower bound: 21 us in place of 9 at 64 x 64.
LOOPS = (
    *("-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fassociative-math"),
    "-ffinite-math-only",
)
FLAGS = ("-O3", "-march=native", *LOOPS, "-shared", "-fPIC")
_COMPILERS = ("cc", "gcc", "clang")


def c_compiler() -> str | None:
    """Path of a C compiler, where there is one."""
    return next((path for name in _COMPILERS if (path := shutil.which(name))), None)


class CFloor:
    """Iterations of FISTA and of `skin` in C, on random vectors; N must be divisible by 64.

    Parameters
    ----------
    n : int
        Number of taxels.
    levels : int
        Halvings of the Haar basis for FISTA.

    Raises
    ------
    OSError, subprocess.CalledProcessError
        If there is no compiler, or it fails.
    """

    def __init__(self, n: int, levels: int) -> None:
        compiler = c_compiler()
        if compiler is None:
            raise OSError("no C compiler is installed")
        with TemporaryDirectory() as folder:
            library = Path(folder) / "floor.so"
            command = [compiler, *FLAGS, str(SOURCE), "-o", str(library), "-lm"]
            subprocess.run(command, check=True, capture_output=True, timeout=120)
            self._library = ctypes.CDLL(str(library))
        rng = np.random.default_rng(0)
        #: Inputs and outputs of the iterations, float32 and uint32, of shape (n,).
        self.vectors: list[npt.NDArray[Any]] = []

        def pointer(vector: npt.NDArray[Any]) -> Any:
            self.vectors.append(vector)
            return vector.ctypes.data_as(ctypes.c_void_p)

        def random(k: int) -> list[Any]:
            return [pointer(rng.random(n, dtype=np.float32)) for _ in range(k)]

        def places(k: int) -> list[Any]:
            return [pointer(rng.permutation(n).astype(np.uint32)) for _ in range(k)]

        number, size, depth = ctypes.c_float, ctypes.c_long(n), ctypes.c_long(levels)
        # Weights, kept rows and measured rows that let nothing grow.
        weights, keep, measured = (
            pointer(np.full(n, value, np.float32)) for value in (4.0**-levels, 1 / 32, 32**-0.5)
        )
        fista = (*random(2), number(0.5), weights, *random(3), *places(1), keep, *random(1))
        skin = (*random(5), *places(2), *random(2), measured, number(0.03), number(0.01))
        self.fista = partial(self._library.fista, *fista, size, depth)
        """Do one iteration of FISTA."""
        self.skin = partial(self._library.skin, *skin, size)
        """Do one iteration of `skin`."""
