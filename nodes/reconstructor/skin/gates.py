"""Learned gates: a denoiser of tiles of 8 x 8 taxels, in plain numpy.

A tile u is denoised from the window w of 12 x 12 taxels around it. All numbers are in units of the
deviation of the noise, so that the same weights serve any range of forces:

    a = A w,  h = relu(H [l(a), |l(a)|] + h0),  [g, c] = clip(G h + g0, 0, 1)
    x = relu(c u + S (a * (g - c)))

with l(a) = 4 sign(a) ((1 + |a|)^(1/4) - 1), and the expected squared error of a taxel
e = exp(E h + e0). With c = 0 coefficients are shrunk by the gates g: Haar shrinkage is the special
case in which A and S are the Haar transform and g is a formula. With c = 1 the gates state what is
subtracted from the tile: without noise it passes as it is, whatever A and S are.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from io import BytesIO
from pathlib import Path

import numpy as np

from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Floats

from .standing_out import standing_out
from .tiles import TILE, WINDOW, inner

N_FILTERS = 128
N_HIDDEN = 64
QUIET = 0.01
"""Expected squared error of a tile in which nothing stands out. Measured: 0.003 to 0.01."""
FILE = "gates.npz"
FORMULA = "formula"


@dataclass(frozen=True, eq=False)
class Gates:
    """Weights of the denoiser, float32; k filters, h hidden units.

    Attributes
    ----------
    filters : ndarray, shape (k, 144)
        A: filters of a window.
    hidden, hidden_0 : ndarray, shape (h, 2 k) and (h,)
        H and h0.
    gates, gates_0 : ndarray, shape (k + 1, h) and (k + 1,)
        G and g0; the last row gives c.
    synthesis : ndarray, shape (64, k)
        S: the tile of gated coefficients.
    error, error_0 : ndarray, shape (1, h) and (1,)
        E and e0: logarithm of the expected squared error.
    fingerprint : str
        16 hexadecimal characters of the SHA-256 of the file.
    """

    filters: Floats
    hidden: Floats
    hidden_0: Floats
    gates: Floats
    gates_0: Floats
    synthesis: Floats
    error: Floats
    error_0: Floats
    fingerprint: str = ""

    @classmethod
    def read(cls, content: bytes, place: str) -> Gates:
        """Read weights from a .npz; `place` is named in errors.

        Raises
        ------
        SolverError
            If it is no such file, or an array is missing, of another shape or not finite.
        """
        try:
            with np.load(BytesIO(content), allow_pickle=False) as stored:
                arrays = {
                    name: np.ascontiguousarray(stored[name], np.float32)
                    for name in _shapes(0, 0)
                }
        except (OSError, ValueError, KeyError, EOFError) as error:
            raise SolverError(f"{place}: holds no gates: {error}") from error

        shapes = _shapes(len(arrays["filters"]), len(arrays["hidden_0"]))
        for name, shape in shapes.items():
            if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
                raise SolverError(
                    f"{place}: {name} has shape {arrays[name].shape}; "
                    f"expected finite numbers of shape {shape}"
                )
        return cls(**arrays, fingerprint=hashlib.sha256(content).hexdigest()[:16])

    @classmethod
    def zero(cls) -> Gates:
        """The smallest weights, all 0."""
        arrays: dict[str, Floats] = {
            name: np.zeros(shape, np.float32) for name, shape in _shapes(1, 1).items()
        }
        return cls(**arrays, fingerprint="")

    def denoise(
        self, windows: Floats, part: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Return the denoised tiles of windows of unit noise.

        Parameters
        ----------
        windows : array of float32, shape (t, 144)
        part : array of float32, shape (t,), optional
            As of `standing_out`; by default that of these windows, of strictness 1.

        Returns
        -------
        tiles : array of float32, shape (t, 64)
            At least 0.
        error : array of float32, shape (t,)
            Expected mean squared error of a taxel of each tile, in (0, 1].
        """
        tiles = np.zeros((len(windows), TILE * TILE), dtype=np.float32)
        error = np.full(len(windows), QUIET, dtype=np.float32)

        if part is None:
            part = standing_out(windows)
        is_busy = part > 0
        if is_busy.any():
            gated, expected = self.gated(windows[is_busy])
            tiles[is_busy] = part[is_busy, None] * gated
            error[is_busy] += part[is_busy] * (expected - np.float32(QUIET))
        return tiles, error

    def gated(self, windows: Floats) -> tuple[Floats, Floats]:
        """As `denoise`, also of windows in which nothing stands out of the noise."""
        a = windows @ self.filters.T
        size = 4 * (np.sqrt(np.sqrt(1 + np.abs(a))) - 1)
        levels = np.concatenate([np.copysign(size, a), size], axis=-1)
        h = (levels @ self.hidden.T + self.hidden_0).clip(0, None)
        g = (h @ self.gates.T + self.gates_0).clip(0, 1)

        passed = g[:, -1:]
        filtered = (a * (g[:, :-1] - passed)) @ self.synthesis.T
        tiles = passed * inner(windows) + filtered
        log_error = h @ self.error[0] + self.error_0
        return tiles.clip(0, None), np.exp(log_error.clip(-12, 0))


def _shapes(k: int, h: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of `Gates`."""
    return {
        "filters": (k, WINDOW * WINDOW),
        "hidden": (h, 2 * k),
        "hidden_0": (h,),
        "gates": (k + 1, h),
        "gates_0": (k + 1,),
        "synthesis": (TILE * TILE, k),
        "error": (1, h),
        "error_0": (1,),
    }


@cache
def stored_gates() -> Gates | None:
    """Weights that come with the package, what they were trained on is in the file; None if the
    file was left out.
    """
    place = files("sparseskin.nodes.reconstructor.skin").joinpath(FILE)
    return Gates.read(place.read_bytes(), FILE) if place.is_file() else None


def gates_of(setting: Gates | str | None) -> Gates | None:
    """Return the weights that the setting `gates` of `SkinSolver` names; None: none.

    Raises
    ------
    SolverError
        If it names no file of weights.
    """
    if setting is None:
        return stored_gates()
    if isinstance(setting, Gates):
        return setting
    if not isinstance(setting, str):
        allowed = f'allowed: "{FORMULA}", the path of a .npz file, Gates'
        raise SolverError(f"skin: gates = {setting!r} is not allowed; {allowed}")
    if setting == FORMULA:
        return None
    try:
        return Gates.read(Path(setting).read_bytes(), setting)
    except OSError as error:
        raise SolverError(f"skin: gates: {setting}: {error.strerror}") from error
