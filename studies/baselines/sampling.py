"""What a user would try first: single taxels, a filter of all taxels, and frames that are packed.

Each estimator sends the bytes that its frames state, `VALUE_BYTES` a value.
"""

from __future__ import annotations

import math
from contextlib import suppress
from functools import cache

import numpy as np
import zstandard
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay, QhullError, cKDTree

from sparseskin.nodes.numerics.arrays import Floats, Indices, Mask
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.evaluate import VALUE_BYTES, Solved

N_CODES = 255
"""Largest code of a reading in 8 bits."""
CODECS = ("zstd", "zstd of change", "touched")
NEWEST = 0.3
DEAD_ZONE_N = 0.03
JUMP_SIGMAS = 4.0
"""Of the filter of all taxels: weight of the newest reading, dead zone in newtons, and standard
deviations of its noise by which a reading differs from its mean at a jump. Chosen."""


class Filtered:
    """Estimator of all taxels: their running mean, which begins anew where a reading jumps.

    A taxel jumps where its reading is `JUMP_SIGMAS` standard deviations of the noise, which is
    known to this filter, away from the mean. Means in the dead zone are set to 0.
    """

    def __init__(self, noise: NoiseModel) -> None:
        self._noise = noise
        self._mean: Floats | None = None

    def reconstruct(self, taxels: Floats) -> Solved:
        """See `Estimator`."""
        if self._mean is None:
            self._mean = taxels.copy()
        change = taxels - self._mean
        bound = JUMP_SIGMAS * self._noise.sigma(self._mean)
        weight = np.where(np.abs(change) > bound, np.float32(1), np.float32(NEWEST))
        self._mean += weight * change
        forces = np.where(self._mean < DEAD_ZONE_N, np.float32(0), self._mean)
        return Solved(forces, n_bytes=VALUE_BYTES * taxels.size)


class Lattice:
    """Estimator that reads every k-th taxel, the same ones in each frame; linear between them.

    The taxels are those of one class of `classes`: of the largest that has not more than N / k of
    them, rounded up. Where these lie on a line, the others have the value of the nearest.
    """

    def __init__(self, mask: Mask, ratio: int) -> None:
        n_max = math.ceil(np.count_nonzero(mask) / ratio)
        allowed = []
        for cells in classes(mask, ratio):
            if 0 < cells.size <= n_max:
                allowed.append(cells)
        # A mask of few cells may have them all in one class.
        if not allowed:
            allowed = [np.flatnonzero(mask)[::ratio]]
        self._read = max(allowed, key=np.size)

        self._places = np.argwhere(np.ones_like(mask)).astype(np.float64)
        read_places = self._places[self._read]
        self._nearest = cKDTree(read_places).query(self._places)[1]
        self._mask = mask
        self._triangles: Delaunay | None = None
        # Taxels on one line have no area between them: the nearest one counts.
        with suppress(QhullError):
            self._triangles = Delaunay(read_places)
        self.n_values = self._read.size

    def reconstruct(self, taxels: Floats) -> Solved:
        """See `Estimator`."""
        values = taxels.reshape(-1)[self._read]
        filled = values[self._nearest]
        if self._triangles is not None:
            # Outside the triangles it is NaN: there the nearest one counts.
            interpolate = LinearNDInterpolator(self._triangles, values)
            within = interpolate(self._places)
            is_outside = np.isnan(within)
            filled = np.where(is_outside, filled, within).astype(np.float32)
        image = filled.reshape(taxels.shape)
        forces = np.where(self._mask, image, np.float32(0))
        return Solved(forces, n_bytes=VALUE_BYTES * self.n_values)


class Hold:
    """Estimator that reads another k-th of the taxels in each frame; each keeps its last reading.

    The classes of `classes` in turn, in an order that leaves far taxels next to each other in time.
    """

    def __init__(self, mask: Mask, ratio: int) -> None:
        self._classes = classes(mask, ratio)
        self._held = np.zeros(mask.size, dtype=np.float32)
        self._frame = 0
        self._n_bytes = VALUE_BYTES * np.count_nonzero(mask) / ratio

    def reconstruct(self, taxels: Floats) -> Solved:
        """See `Estimator`."""
        read = self._classes[self._frame % len(self._classes)]
        self._frame += 1
        self._held[read] = taxels.reshape(-1)[read]
        forces = self._held.reshape(taxels.shape).copy()
        return Solved(forces, n_bytes=self._n_bytes)


class Codec:
    """Estimator whose edge reads all taxels and sends each frame in 8 bits, packed.

    `kind` is one of `CODECS`: "zstd" packs the codes of each frame by themselves, "zstd of change"
    their differences to those of the frame before, "touched" sends codes above 0 with addresses.
    """

    def __init__(self, mask: Mask, f_max: float, kind: str) -> None:
        self._taxels = np.flatnonzero(mask)
        self._scale = np.float32(N_CODES / f_max)
        self._kind = kind
        self._packer = zstandard.ZstdCompressor(write_content_size=False)
        self._before = np.zeros(self._taxels.size, dtype=np.uint8)

    def reconstruct(self, taxels: Floats) -> Solved:
        """See `Estimator`."""
        x = taxels.reshape(-1)[self._taxels]
        scaled = np.clip(x * self._scale, 0, N_CODES)
        codes = np.rint(scaled).astype(np.uint8)
        if self._kind == "touched":
            n_touched = int(np.count_nonzero(codes))
            n_bytes = n_touched + address_bytes(codes.size, n_touched)
        else:
            sent = codes
            # Differences modulo 256: as good as signed ones, and in 8 bits.
            if self._kind == "zstd of change":
                sent = codes - self._before
            n_bytes = len(self._packer.compress(sent.tobytes()))
            self._before = codes
        forces = np.zeros(taxels.size, dtype=np.float32)
        forces[self._taxels] = codes / self._scale
        return Solved(forces.reshape(taxels.shape), n_bytes=n_bytes)


def classes(mask: Mask, k: int) -> list[Indices]:
    """Split the taxels of a grid into k lattices of equal density, each as even as can be.

    Cell (i, j) belongs to the class (i + s j) mod k, s being such that the least distance within a
    class is largest. Returns places in the flat grid, ascending; successive classes are far apart.
    """
    i, j = np.indices(mask.shape)
    slope = 1 if min(mask.shape) == 1 else _slope(k)
    number = (i + slope * j) % k
    # As the golden ratio: of few successive classes, none are neighbours.
    strides = range(max(1, round(0.382 * k)), k + 1)
    stride = next(step for step in strides if math.gcd(step, k) == 1)
    order = [turn * stride % k for turn in range(k)]
    return [np.flatnonzero(mask & (number == turn)) for turn in order]


@cache
def _slope(k: int) -> int:
    """Return s of the lattice of cells with (i + s j) mod k = 0 whose least distance is largest."""

    i, j = np.mgrid[-k : k + 1, -k : k + 1]
    squared_distance = i * i + j * j
    is_another = squared_distance > 0

    def least(s: int) -> int:
        is_of_class = (i + s * j) % k == 0
        return int(squared_distance[is_of_class & is_another].min())

    return max(range(k), key=least)


def address_bytes(n: int, m: int) -> int:
    """Bytes that state which m of n taxels are sent: a bit a taxel, or a number each."""
    number_bits = max(1, (n - 1).bit_length())
    bytes_of_bits = math.ceil(n / 8)
    bytes_of_numbers = math.ceil(m * number_bits / 8)
    return min(bytes_of_bits, bytes_of_numbers)
