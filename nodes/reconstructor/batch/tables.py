"""Matrices and index tables that all patches of a batch share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sparseskin.nodes.compressor.phi.hadamard import hadamard_matrix
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.numerics.arrays import Floats, Indices, Mask
from sparseskin.nodes.reconstructor.bases.shifted_haar import LEVELS, SHIFTS, TILE
from sparseskin.nodes.reconstructor.skin.clip_bias import ClipBias
from sparseskin.nodes.reconstructor.skin.evidence import HeldOut
from sparseskin.nodes.reconstructor.skin.prediction import neighbours_of
from sparseskin.nodes.reconstructor.skin.tuning import TUNING
from sparseskin.nodes.reconstructor.solvers.projection import SbheProjection

from .backend import Array, Backend


@dataclass(frozen=True)
class Subset:
    """Tables of one row subset.

    Attributes
    ----------
    spread : int64 (n,)
        Measurement of each row of W; m where it is not measured.
    measured, kept, ones : float32 (n,)
        1 for measured rows; 0 for rows held out; Phi 1.
    held : int64 (h,)
        Rows held out.
    energy : float
        Squared length of Phi 1.
    measurements : ndarray of intp, shape (h,)
        Measurements held out, on the host.
    """

    spread: Array
    measured: Array
    kept: Array
    ones: Array
    held: Array
    energy: float
    measurements: Indices


class Tables:
    """Operators of a skin on arrays of many patches, (b, n); vectors are in the order of W.

    Parameters
    ----------
    backend : Backend
    phis : sequence of SbhePhi
        Row subsets of one W.
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.
    shifts : ndarray of int64
        Numbers of the shifts, in their order.

    Attributes
    ----------
    n, m, n_held : int
        Taxels, measurements, measurements held out.
    hadamard, haar : float32 (block, block), (64, 64)
        Block of W; orthonormal Haar of a tile, a coefficient a row.
    to_canvas, from_canvas : int64 (n_shifts, n_canvas), (n_shifts, n)
        Place in a vector of each place of the tiles, n where no taxel exists; and the inverse.
    median_first : int
        First frames whose median taxel is used for the bias.
    subsets : list of Subset
    """

    def __init__(
        self, backend: Backend, phis: Sequence[SbhePhi], mask: Mask, shifts: Indices
    ) -> None:
        self.be, phi = backend, phis[0]
        self.shape = mask.shape
        self.n, self.m = phi.n, phi.m
        taxels = np.flatnonzero(mask)
        cells = taxels[phi.permutation]
        place_of_cell = np.full(mask.size, phi.n, dtype=np.int64)
        place_of_cell[cells] = np.arange(phi.n)
        places = place_of_cell.reshape(mask.shape)
        self.block = min(phi.block, phi.n)
        self._blocks(phi)
        self.full = phi.n == mask.size
        self.cells = backend.array(cells.astype(np.int64))
        self.place_of_cell = backend.array(place_of_cell)
        self.exists = backend.array(mask.astype(np.float32))
        #: Next along rows, along columns, last along rows, along columns: int64 (4 n,).
        self.neighbours = backend.array(neighbours_of(places, phi.n).reshape(-1).astype(np.int64))
        self.haar = backend.array(haar_of_tile())
        self.haar_adjoint = backend.array(haar_of_tile().T.copy())
        tables = [_canvas_of(places, phi.n, shift) for shift in SHIFTS]
        self.to_canvas = backend.array(np.stack([one for one, _ in tables]))
        self.from_canvas = backend.array(np.stack([one for _, one in tables]))
        self.n_canvas = tables[0][0].size
        self.shifts = backend.array(shifts.astype(np.int64))
        self.subsets = self._subsets(phis)
        self.median_first = max(TUNING.median_first, TUNING.median_rounds * len(self.subsets))
        self.n_held = self.subsets[0].measurements.size
        self.tests = self.n_held > 0

    def _blocks(self, phi: SbhePhi) -> None:
        """Set the matrices of W: of whole blocks, and of the rest."""
        block = self.block
        self._whole = phi.n - phi.n % block
        self.hadamard = self.be.array((hadamard_matrix(block) / np.sqrt(block)).astype(np.float32))
        rest: Floats = np.zeros((phi.n - self._whole,) * 2, dtype=np.float32)
        start = 0
        for size in phi.hadamard.sizes[self._whole // block :]:
            part = slice(start, start + size)
            rest[part, part] = hadamard_matrix(size) / np.sqrt(size)
            start += size
        self._rest = self.be.array(rest)
        self.whole_blocks = not len(rest)

    def _subsets(self, phis: Sequence[SbhePhi]) -> list[Subset]:
        projection, found = SbheProjection(phis[0]), []
        bias = ClipBias(projection, self.n)
        held_out = HeldOut(projection, self.n, self.m, one_by_one=False)
        for number, phi in enumerate(phis):
            projection.use(phi)
            bias.use(number)
            held_out.use(number)
            spread = np.full(self.n, self.m, dtype=np.int64)
            spread[phi.rows] = np.arange(self.m)
            kept = held_out.kept
            found.append(
                Subset(
                    spread=self.be.array(spread),
                    measured=self.be.array(projection.measured),
                    kept=self.be.array(kept.astype(np.float32)),
                    ones=self.be.array(bias.ones),
                    held=self.be.array(np.flatnonzero(kept == 0).astype(np.int64)),
                    energy=bias.energy,
                    measurements=held_out.measurements,
                )
            )
        return found

    def transform(self, x: Array) -> Array:
        """Return W x, of float32 (..., n): W is symmetric and orthonormal."""
        xp = self.be.xp
        if self.whole_blocks:
            return xp.reshape(xp.reshape(x, (-1, self.block)) @ self.hadamard, x.shape)
        whole = xp.reshape(x[..., : self._whole], (-1, self.block)) @ self.hadamard
        whole = xp.reshape(whole, (*x.shape[:-1], self._whole))
        return xp.concat([whole, x[..., self._whole :] @ self._rest], axis=-1)

    def rows_of(self, y: Array, subset: Subset) -> Array:
        """Return measurements, float32 (b, m), as vectors of rows, float32 (b, n)."""
        return self.be.xp.take(self.with_zero(y), subset.spread, axis=1)

    def with_zero(self, x: Array) -> Array:
        """Return vectors, float32 (b, k), with a 0 behind each."""
        return self.be.xp.concat([x, self.be.xp.zeros_like(x[:, :1])], axis=1)

    def image(self, x: Array) -> Array:
        """Return vectors of taxels, float32 (b, n), as images, float32 (b, n_rows, n_cols)."""
        x = x if self.full else self.with_zero(x)
        return self.be.xp.reshape(self.be.xp.take(x, self.place_of_cell, axis=1), (-1, *self.shape))

    def vector(self, image: Array) -> Array:
        """Return images as vectors, the inverse of `image`."""
        flat = self.be.xp.reshape(image, (image.shape[0], -1))
        return self.be.xp.take(flat, self.cells, axis=1)


def haar_of_tile() -> Floats:
    """Return the orthonormal Haar transform of a tile, float32 (64, 64), a coefficient a row."""
    images = np.eye(TILE * TILE).reshape(-1, TILE, TILE)
    side = TILE
    for _ in range(LEVELS):
        part = images[:, :side, :side]
        for axis in (1, 2):
            even, odd = (part.take(range(k, side, 2), axis) for k in (0, 1))
            part = np.concatenate([even + odd, even - odd], axis) / np.sqrt(2)
        images[:, :side, :side] = part
        side //= 2
    return np.ascontiguousarray(images.reshape(TILE * TILE, -1).T, dtype=np.float32)


def _canvas_of(places: Indices, n: int, shift: tuple[int, int]) -> tuple[Indices, Indices]:
    """Return the gathers of one shift: to the canvas, tile by tile, and back."""
    n_rows, n_cols = (-(-side // TILE) * TILE for side in places.shape)
    canvas = np.full((n_rows, n_cols), n, dtype=np.int64)
    canvas[: places.shape[0], : places.shape[1]] = places
    rolled = np.roll(canvas, shift, axis=(0, 1))
    tiles = rolled.reshape(n_rows // TILE, TILE, n_cols // TILE, TILE).transpose(0, 2, 1, 3)
    to_canvas = np.ascontiguousarray(tiles).reshape(-1)
    from_canvas = np.zeros(n + 1, dtype=np.int64)
    from_canvas[to_canvas] = np.arange(to_canvas.size)
    return to_canvas, from_canvas[:-1].copy()
