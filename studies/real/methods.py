"""The methods that study `real` compares: what each reads of a frame, sends, and makes of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import zstandard

from sparseskin.launch.launchfile.load import load
from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.acts import ActsSearch, force_threshold
from sparseskin.nodes.compressor.phi.quadtree import Quadtree
from sparseskin.nodes.compressor.phi.rotation import FIXED, PAPER, ROTATING, m_of
from sparseskin.nodes.numerics.arrays import Floats, Indices, Mask
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.reconstructor.solvers.base import estimated_error
from sparseskin.nodes.reconstructor.solvers.interpolation import (
    LineInterpolation,
    interpolated_from,
)
from sparseskin.studies.evaluate import Alone, Estimator, Method, Solved, make_method
from sparseskin.studies.scene_frames import scene_of

VALUE_BYTES = 2
"""Bytes of a value that is sent, measurement or reading. Chosen: sensors have 8 to 16 bits."""
N_CODES = 255
"""Largest code of a reading in 8 bits."""

SKIN, ROTATED, ALONE, REPLAY = "skin", "skin, rotating", "skin, alone", "replay"
ADAPTIVE = "skin, adaptive"
LATTICE, HOLD, SUBSAMPLE, ACTS = "lattice", "hold", "subsample", "acts"
SIMPLE = (LATTICE, HOLD, SUBSAMPLE, ACTS)
"""Methods that read single taxels at the edge, and need no measurement matrix."""
CODECS = ("zstd", "zstd of change", "touched")
"""Methods whose edge reads all taxels, and whose frames have a size of their own."""


@dataclass(frozen=True)
class Skin:
    """A skin whose frames are reconstructed.

    Attributes
    ----------
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.
    f_max : float
        Upper end of the range, in the recording's unit.
    """

    mask: Mask
    f_max: float

    @property
    def n(self) -> int:
        """Number of taxels that exist."""
        return int(np.count_nonzero(self.mask))


class Lattice:
    """Estimator that reads every k-th taxel, the same ones in each frame; linear between them.

    The taxels are those of one class of `classes`: of the largest that has not more than N / k of
    them, rounded up.
    """

    def __init__(self, mask: Mask, ratio: int) -> None:
        most = math.ceil(np.count_nonzero(mask) / ratio)
        allowed = [one for one in classes(mask, ratio) if 0 < one.size <= most]
        # A mask of few cells may have them all in one class.
        allowed = allowed or [np.flatnonzero(mask)[::ratio]]
        self._read = max(allowed, key=lambda one: one.size)
        self._wanted = np.setdiff1d(np.flatnonzero(mask), self._read)
        places = np.argwhere(np.ones_like(mask)).astype(np.float64)
        found = interpolated_from(places[self._read], places[self._wanted])
        self._corners, self._weights = found
        self.n_values = self._read.size

    def reconstruct(self, taxels: Floats) -> Solved:
        """See `Estimator`."""
        flat, forces = taxels.reshape(-1), np.zeros(taxels.size, dtype=np.float32)
        values = flat[self._read]
        forces[self._read] = values
        forces[self._wanted] = np.einsum("ij,ij->i", values[self._corners], self._weights)
        return Solved(forces.reshape(taxels.shape))


class Hold:
    """Estimator that reads another k-th of the taxels in each frame; each keeps its last reading.

    The classes of `classes` in turn, in an order that leaves far taxels next to each other in time.
    """

    def __init__(self, mask: Mask, ratio: int) -> None:
        self._classes = classes(mask, ratio)
        self._held = np.zeros(mask.size, dtype=np.float32)
        self._frame = 0
        self.n_values = np.count_nonzero(mask) / ratio

    def reconstruct(self, taxels: Floats) -> Solved:
        """See `Estimator`."""
        read = self._classes[self._frame % len(self._classes)]
        self._frame += 1
        self._held[read] = taxels.reshape(-1)[read]
        return Solved(self._held.reshape(taxels.shape).copy())


class Acts:
    """Estimator that chooses single taxels anew in each frame; linear between them.

    Parameters
    ----------
    skin : Skin
    m : int
        Number of taxels.
    """

    def __init__(self, skin: Skin, m: int) -> None:
        # The noise of a recorded skin is not known, as in the graph: 0.
        self._search = ActsSearch(skin.mask, m, force_threshold(0.0, skin.f_max))
        self._lines = LineInterpolation(skin.mask)
        self._taxels = np.flatnonzero(skin.mask)
        self._inside = skin.mask

    def reconstruct(self, taxels: Floats) -> Solved:
        """See `Estimator`."""
        x = taxels.reshape(-1)[self._taxels]
        read = self._search.places(x.take)
        forces = self._lines.fill(self._taxels[read], x[read]).reshape(taxels.shape)
        return Solved(np.where(self._inside, np.maximum(forces, 0), np.float32(0)))


class Codec:
    """Estimator whose edge reads all taxels and sends each frame in 8 bits, packed.

    Parameters
    ----------
    skin : Skin
    kind : str
        One of `CODECS`: "zstd" packs the codes of each frame by themselves, "zstd of change" their
        differences to those of the frame before, "touched" sends the codes above 0 with addresses.

    Attributes
    ----------
    n_bytes : int
        Size of the last frame.
    """

    def __init__(self, skin: Skin, kind: str) -> None:
        self._taxels = np.flatnonzero(skin.mask)
        self._scale = np.float32(N_CODES / skin.f_max)
        self._kind = kind
        self._packer = zstandard.ZstdCompressor(write_content_size=False)
        self._before = np.zeros(self._taxels.size, dtype=np.uint8)
        self.n_bytes = 0

    def reconstruct(self, taxels: Floats) -> Solved:
        """See `Estimator`."""
        x = taxels.reshape(-1)[self._taxels]
        codes = np.rint(np.clip(x * self._scale, 0, N_CODES)).astype(np.uint8)
        if self._kind == "touched":
            n_touched = int(np.count_nonzero(codes))
            self.n_bytes = n_touched + address_bytes(codes.size, n_touched)
        else:
            # Differences modulo 256: as good as signed ones, and in 8 bits.
            sent = codes - self._before if self._kind == "zstd of change" else codes
            self.n_bytes = len(self._packer.compress(sent.tobytes()))
            self._before = codes
        forces = np.zeros(taxels.size, dtype=np.float32)
        forces[self._taxels] = codes / self._scale
        return Solved(forces.reshape(taxels.shape))


@dataclass(frozen=True)
class Compared:
    """A method as it is compared.

    Attributes
    ----------
    estimator : Estimator
    n_values : float
        Values read at the edge and sent, a frame.
    n_bytes : callable
        Returns the size of the last frame in bytes.
    """

    estimator: Estimator
    n_values: float
    n_bytes: Callable[[], float]


def make_methods(skin: Skin, ratio: int, seed: int) -> dict[str, Callable[[], Compared]]:
    """Return by name what makes each method at a ratio N / M; codecs are at ratio 1 alone.

    The methods that read fewer values than taxels send equally many bytes; "acts" sends addresses
    too, so it has fewer values.
    """

    def sized(estimator: Estimator, n_values: float, extra_bytes: int = 0) -> Compared:
        size = VALUE_BYTES * n_values + extra_bytes
        return Compared(estimator, n_values, lambda: size)

    def solver(chosen: Mapping[str, Any], rows: str, phi: str = "sbhe") -> Compared:
        method = _method(skin, chosen, ratio, seed, rows, phi)
        return sized(method, method.phi.m)

    def adaptive() -> Compared:
        m = adaptive_values(skin, m_of(skin.n, ratio))
        # M is rounded down: a half keeps it from rounding errors.
        method = _method(skin, PRESETS["skin"], skin.n / (m + 0.5), seed, FIXED, "adaptive")
        return Compared(
            method, method.phi.m, lambda: VALUE_BYTES * method.phi.m + method.n_code_bytes
        )

    def alone() -> Compared:
        method = _method(skin, PRESETS["skin"], ratio, seed, FIXED)
        return sized(Alone(method), method.phi.m)

    def simple(made: Lattice | Hold) -> Compared:
        return sized(made, made.n_values)

    def acts() -> Compared:
        m = acts_values(skin.n, m_of(skin.n, ratio))
        return sized(Acts(skin, m), m, address_bytes(skin.n, m))

    def codec(kind: str) -> Compared:
        made = Codec(skin, kind)
        return Compared(made, skin.n, lambda: made.n_bytes)

    if ratio == 1:
        return {kind: lambda kind=kind: codec(kind) for kind in CODECS}  # type: ignore[misc]
    methods = {
        SKIN: lambda: solver(PRESETS["skin"], FIXED),
        ROTATED: lambda: solver(PRESETS["skin"], ROTATING),
        ADAPTIVE: adaptive,
        ALONE: alone,
        PAPER: lambda: solver(PRESETS["paper"], PAPER),
        LATTICE: lambda: simple(Lattice(skin.mask, ratio)),
        HOLD: lambda: simple(Hold(skin.mask, ratio)),
        SUBSAMPLE: lambda: solver({"solver": "interpolation"}, FIXED, "subsample"),
    }
    if acts_values(skin.n, m_of(skin.n, ratio)):
        methods[ACTS] = acts
    phi, rows, chosen = replay_defaults()
    if replayed() == REPLAY:
        methods[REPLAY] = lambda: solver(chosen, rows, phi)
    return methods


@cache
def replay_defaults() -> tuple[str, str, Mapping[str, Any]]:
    """Kind of Phi, rows and solver of the launch file `replay`, which a user's recording meets."""
    # Of the sensor nothing but its number of taxels is used; the file is the user's.
    scene = "path_40"
    nodes = load("replay", [f"sensor.source=scene:{scene}"]).nodes
    compressor, reconstructor = nodes["compressor"].settings, nodes["reconstructor"].settings
    rows, _ = compressor.rows_and_m(math.prod(scene_of(scene).shape))
    return compressor.phi, rows, reconstructor.chosen()


def replayed() -> str:
    """Name of the method that the launch file `replay` has by default."""
    phi, rows, chosen = replay_defaults()
    if phi == "sbhe" and chosen == PRESETS["skin"]:
        return ROTATED if rows == ROTATING else SKIN
    return REPLAY


def _method(
    skin: Skin, chosen: Mapping[str, Any], ratio: float, seed: int, rows: str, phi: str = "sbhe"
) -> Method:
    settings = dict(chosen)
    if "lambda_n" in settings:
        # Stated for the paper's range, and scaled with the skin's, as the node does.
        settings["lambda_n"] *= skin.f_max / PAPER_F_MAX_N
    return make_method(
        settings,
        skin.mask.shape,
        ratio,
        seed,
        phi=phi,
        rows=rows,
        mask=skin.mask,
        f_max_n=skin.f_max,
    )


@dataclass(frozen=True)
class Judgement:
    """A solver's estimate of the error of its last frame.

    Attributes
    ----------
    error : float or None
        Estimated RMS error of a taxel, in the recording's unit; None if it is not estimated.
    flagged : bool or None
        True if the frame is marked as not to be trusted; None without an estimate.
    """

    error: float | None = None
    flagged: bool | None = None


def judgement_of(estimator: Estimator) -> Judgement:
    """Return what the solver of a method estimates of its last frame."""
    method = estimator.method if isinstance(estimator, Alone) else estimator
    if not isinstance(method, Method):
        return Judgement()
    error, trusted = estimated_error(method.solver)
    return Judgement(error, None if error is None and trusted else not trusted)


def classes(mask: Mask, k: int) -> list[Indices]:
    """Split the taxels of a grid into k lattices of equal density, each as even as can be.

    Cell (i, j) belongs to the class (i + s j) mod k, s being such that the least distance within
    a class is largest.

    Returns
    -------
    list of ndarray of intp
        Places in the flat grid, ascending; successive classes are far from each other in number.
    """
    i, j = np.indices(mask.shape)
    number = (i + (1 if min(mask.shape) == 1 else _slope(k)) * j) % k
    # As the golden ratio: of few successive classes, none are neighbours.
    stride = next(step for step in range(max(1, round(0.382 * k)), k + 1) if math.gcd(step, k) == 1)
    order = [turn * stride % k for turn in range(k)]
    return [np.flatnonzero(mask & (number == one)) for one in order]


@cache
def _slope(k: int) -> int:
    """Return s of the lattice of cells with (i + s j) mod k = 0 whose least distance is largest."""

    def least(s: int) -> int:
        near = range(-k, k + 1)
        return min(i * i + j * j for i in near for j in near if (i or j) and (i + s * j) % k == 0)

    return max(range(k), key=least)


def address_bytes(n: int, m: int) -> int:
    """Bytes that state which m of n taxels are sent: a bit a taxel, or a number each."""
    return min(math.ceil(n / 8), math.ceil(m * max(1, (n - 1).bit_length()) / 8))


def adaptive_values(skin: Skin, m: int) -> int:
    """Number of rows that fit with the code of their choice into the bytes of m values, at least 1.

    The code is as long as it can be where all quarters of a node exist.
    """
    for k in range(m, 1, -1):
        tree = Quadtree(skin.mask, k)
        if VALUE_BYTES * k + tree.most_code_bytes(k - tree.n_tiles) <= VALUE_BYTES * m:
            return k
    return 1


def acts_values(n: int, m: int) -> int:
    """Number of values that fit with their addresses into the bytes of m values; 0 if none."""
    fits = (k for k in range(m, 0, -1) if VALUE_BYTES * k + address_bytes(n, k) <= VALUE_BYTES * m)
    return next(fits, 0)
