"""What a C compiler makes of the same iterations: the floor that compiled loops are held to."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

#: Blocks of 32 side by side; grids whose sides halve to 1 x 1 or to `rest` samples, left alone.
SOURCE = r"""
#include <math.h>
typedef float * restrict V;
typedef const float * restrict C;
typedef const unsigned * restrict I;

static void hadamard(float *v, long n) {
    long run = n / 32;
    for (; 4 * run <= n; run *= 4)
        for (long base = 0; base < n; base += 4 * run) {
            V a = v + base, b = a + run, c = b + run, d = c + run;
            for (long k = 0; k < run; k++) {
                float s = a[k] + b[k], t = c[k] + d[k], u = a[k] - b[k], w = c[k] - d[k];
                a[k] = s + t; b[k] = u + w; c[k] = s - t; d[k] = u - w;
            }
        }
    V a = v, b = v + n / 2;
    for (long k = 0; k < n / 2; k++) { float s = a[k] + b[k]; b[k] = a[k] - b[k]; a[k] = s; }
}

static void halve(float *v, long part, long levels) {
    for (; levels > 0; levels--, part /= 4) {
        long q = part / 4;
        V a = v, b = v + q, c = v + 2 * q, d = v + 3 * q;
        for (long k = 0; k < q; k++) {
            float s = a[k] + c[k], t = b[k] + d[k], u = a[k] - c[k], w = b[k] - d[k];
            a[k] = s + t; b[k] = s - t; c[k] = u + w; d[k] = u - w;
        }
    }
}

static void twice(float *v, long n, long levels) {
    for (long level = levels - 1; level >= 0; level--) {
        long q = (n >> (2 * level)) / 4;
        V a = v, b = v + q, c = v + 2 * q, d = v + 3 * q;
        for (long k = 0; k < q; k++) {
            float s = a[k] + b[k], t = a[k] - b[k], u = c[k] + d[k], w = c[k] - d[k];
            a[k] = s + u; b[k] = t + w; c[k] = s - u; d[k] = t - w;
        }
    }
}

void fista(V theta, V before, float beta, C weights2, C threshold, V z, V v, I deal, C keep,
           C measured, long n, long levels) {
    for (long k = 0; k < n; k++) z[k] = theta[k] + beta * (theta[k] - before[k]);
    twice(z, n, levels);
    for (long p = 0; p < n; p++) v[p] = z[deal[p]];
    hadamard(v, n);
    for (long p = 0; p < n; p++) v[p] = v[p] * keep[p] + measured[p];
    hadamard(v, n);
    for (long p = 0; p < n; p++) z[deal[p]] = v[p];
    halve(z, n, levels);
    for (long k = 0; k < n; k++) {
        float u = weights2[k] * z[k], t = threshold[k];
        before[k] = u - fminf(fmaxf(u, -t), t);
    }
}

void skin(V x, V z, V r, C target, V total, I to_canvas, I from_canvas, V canvas, V u, C measured,
          float threshold, float least, long n) {
    for (long p = 0; p < n; p++) u[p] = z[p];
    hadamard(u, n);
    float power = 0;
    for (long p = 0; p < n; p++) {
        r[p] = target[p] - measured[p] * u[p];
        u[p] = measured[p] * r[p];
        power += r[p] * r[p];
    }
    hadamard(u, n);
    for (long p = 0; p < n; p++) u[p] += z[p];
    float limit = fmaxf(threshold * sqrtf(power), least), l2 = limit * limit + 1e-30f, w2 = 1;
    for (long k = 0; k < n; k++) canvas[k] = u[to_canvas[k]];
    halve(canvas, n, 3);
    for (long level = 1, part = n; level <= 3; level++, part /= 4) {
        w2 /= 4;
        for (long k = level < 3 ? part / 4 : 0; k < part; k++) {
            float c = canvas[k];
            canvas[k] = c * (w2 - l2 / fmaxf(c * c, l2 / w2));
        }
    }
    twice(canvas, n, 3);
    for (long p = 0; p < n; p++) {
        float after = fmaxf(canvas[from_canvas[p]], 0);
        z[p] = after + 0.7f * (after - x[p]);
        x[p] = after;
        total[p] += after;
    }
}
"""
#: What -ffast-math allows a loop, but for its start-up code, which would make the whole process
#: flush small numbers to 0.
LOOPS = ("-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fassociative-math")
FLAGS = ("-O3", "-march=native", *LOOPS, "-shared", "-fPIC")
_COMPILERS = ("cc", "gcc", "clang")


def c_compiler() -> str | None:
    """Path of a C compiler, where there is one."""
    return next((path for name in _COMPILERS if (path := shutil.which(name))), None)


class CFloor:
    """The iterations of FISTA and of `skin` in C, on vectors of their own, N divisible by 64.

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
            source, library = Path(folder) / "floor.c", Path(folder) / "floor.so"
            source.write_text(SOURCE)
            subprocess.run(
                [compiler, *FLAGS, str(source), "-o", str(library), "-lm"],
                check=True,
                capture_output=True,
                timeout=120,
            )
            self._library = ctypes.CDLL(str(library))
        rng = np.random.default_rng(0)
        self._kept: list[npt.NDArray[Any]] = []

        def vector() -> Any:
            self._kept.append(rng.random(n, dtype=np.float32))
            return self._kept[-1].ctypes.data_as(ctypes.c_void_p)

        def places() -> Any:
            self._kept.append(rng.permutation(n).astype(np.uint32))
            return self._kept[-1].ctypes.data_as(ctypes.c_void_p)

        number, size, depth = ctypes.c_float, ctypes.c_long(n), ctypes.c_long(levels)
        weights, keep = vector(), vector()
        self._kept[-2][:], self._kept[-1][:] = 4.0**-levels, 1 / 32  # so that nothing grows
        measured = vector()
        self._kept[-1][:] = 32**-0.5
        self._fista = (
            *(vector(), vector(), number(0.5), weights, vector(), vector(), vector(), places()),
            *(keep, vector(), size, depth),
        )
        self._skin = (
            *(vector(), vector(), vector(), vector(), vector(), places(), places(), vector()),
            *(vector(), measured, number(0.03), number(0.01), size),
        )

    def fista(self) -> None:
        """Do one iteration of FISTA."""
        self._library.fista(*self._fista)

    def skin(self) -> None:
        """Do one iteration of `skin`."""
        self._library.skin(*self._skin)
