"""Measurement matrices from a file, for hardware that exists."""

import functools
from copy import copy
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.sparse import csr_array

from sparseskin.messages.fields import MAX_ELEMENTS
from sparseskin.nodes.errors import PhiError
from sparseskin.nodes.numerics.array_files import (
    ArrayFileError,
    is_npz,
    read_npy,
    read_npz,
)
from sparseskin.nodes.numerics.arrays import AnyArray, Doubles, Floats

from .base import BLOCK, MAX_SUBSETS, Phi, fingerprint_of

MAX_FILE_BYTES = 1 << 28
"""Largest file that is read."""
MAX_ARRAY_BYTES = 1 << 29
"""Largest size of its arrays together."""
MAX_ENTRY = 1e6
"""Largest size of an entry."""
FULL_PART = 0.1
"""Part of the entries beyond which a product with the full matrix is faster (timed)."""
N_POWER_STEPS = 200
MARGIN = 1.02
"""Factor on the eigenvalue that the power method finds, which is never too large. Chosen: a solver
diverges where it is 4/3 of `lipschitz`."""
_NAMES = ("indices", "indptr", "data", "shape", "format")


class StoredPhi(Phi):
    """Phi as a file states it; the seed and the block size are not used.

    `path` is an .npz as `scipy.sparse.save_npz` writes a matrix in format "csr" of shape (m, n); or
    an .npy, or an .npz with one array, of shape (k, m, n): a stack of k matrices. Raises PhiError
    also if it is missing, too large, no such file, or not of matrices of m x n finite numbers with
    an entry in each row.
    """

    path: ClassVar[str] = ""

    @classmethod
    def check_size(cls, n: int, m: int, seed: int, block: int) -> None:
        super().check_size(n, m, seed, block)
        shape = load_matrices(cls.path)[0].shape
        if shape != (m, n):
            raise PhiError(
                f"{cls.path}: is {shape[0]} x {shape[1]}; expected m x n = {m} x {n}"
            )

    def __init__(self, n: int, m: int, seed: int, block: int = BLOCK) -> None:
        super().__init__(n, m, seed, block)
        self._keep(load_matrices(self.path)[0])

    def _keep(self, matrix: csr_array) -> None:
        """Measure by this matrix."""
        arrays = matrix.indices, matrix.indptr, matrix.data
        self.fingerprint = fingerprint_of("file", self.n, self.m, 1, *arrays)
        self._matrix = matrix
        if matrix.nnz > FULL_PART * self.m * self.n:
            self._matrix = matrix.toarray()
        self._transposed = self._matrix.T

    @cached_property
    def lipschitz(self) -> float:
        """Bound of the largest eigenvalue of Phi Phi^T, by the power method with a margin of 2 %.

        At most the product of the largest sums of sizes in a row and in a column, which is never
        too small.
        """
        # The product of two norms, in float64: rounding must not make it too small.
        sizes = abs(self._matrix)
        of_columns = sizes.sum(axis=0, dtype=float)
        of_rows = sizes.sum(axis=1, dtype=float)
        bound = float(of_rows.max()) * float(of_columns.max())

        # A random vector has a part along the largest eigenvector, which each step enlarges most.
        rng = np.random.default_rng(0)
        x = rng.standard_normal(self.n, dtype=np.float32)
        largest = 0.0
        for _ in range(N_POWER_STEPS):
            x = self._transposed @ (self._matrix @ x)
            largest = float(np.linalg.norm(x))
            x /= np.float32(largest)
        return min(MARGIN * largest, bound)

    def dense(self) -> Doubles:
        """Return the explicit matrix, float64, shape (m, n)."""
        matrix = self._matrix.astype(np.float64)
        if isinstance(matrix, np.ndarray):
            return matrix
        full: Doubles = matrix.toarray()
        return full

    def _forward(self, x: Floats, out: Floats) -> None:
        out[:] = self._matrix @ x

    def _adjoint(self, y: Floats, out: Floats) -> None:
        out[:] = self._transposed @ y


class StackedPhi(StoredPhi):
    """Phi of a file with a stack of matrices, which measure successive frames in turn."""

    def row_subsets(self) -> list[Phi]:
        """Return the matrices of the file, in order."""
        matrices = load_matrices(self.path)
        twins = [copy(self) for _ in matrices]
        for twin, matrix in zip(twins, matrices, strict=True):
            # Computed of the first matrix, and copied with it.
            vars(twin).pop("lipschitz", None)
            twin._keep(matrix)
        # A solver has one step size for all of them.
        largest = max(twin.lipschitz for twin in twins)
        for twin in twins:
            twin.lipschitz = largest
        return list(twins)


def load_matrices(path: str) -> tuple[csr_array, ...]:
    """Read and check the matrices of a file, float32 (m, n); PhiError as of `StoredPhi`."""
    try:
        # Opening a pipe would wait for its writer.
        status = Path(path).stat()
        if not Path(path).is_file():
            raise PhiError("is no file")
        if status.st_size > MAX_FILE_BYTES:
            raise PhiError(f"{status.st_size} bytes; at most {MAX_FILE_BYTES}")
        # A file that was written anew is read anew.
        state = status.st_mtime_ns, status.st_size, status.st_ino
        return _load(path, state)
    except (ArrayFileError, PhiError) as error:
        raise PhiError(f"{path}: {error}") from error
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", error)
        raise PhiError(f"{path}: cannot be read: {why}") from error


@functools.lru_cache(maxsize=4)
def _load(path: str, _of: tuple[int, int, int]) -> tuple[csr_array, ...]:
    """As `load_matrices`, of one state of the file."""
    raw = Path(path).read_bytes()
    if not is_npz(raw):
        return _checked_stack(read_npy(raw))
    arrays = read_npz(raw, _wanted, MAX_ARRAY_BYTES)
    of_scipy = arrays.keys() & set(_NAMES)
    if len(arrays) == 1 and not of_scipy:
        (stack,) = arrays.values()
        return _checked_stack(stack)
    return (_checked(arrays),)


def _wanted(names: list[str]) -> list[str]:
    """Names of the arrays to read: an only one, or those of `scipy.sparse.save_npz`."""
    if len(names) == 1:
        return names
    return [name for name in names if name in _NAMES]


def _checked_stack(stack: AnyArray) -> tuple[csr_array, ...]:
    if stack.ndim != 3 or stack.dtype.kind not in "iufb":
        raise PhiError(
            f"one array, {stack.dtype} of {stack.ndim} dimensions; expected numbers of "
            "3, (k, m, n), or a file of scipy.sparse.save_npz"
        )

    k, m, n = stack.shape
    if not (1 <= k <= MAX_SUBSETS and 1 <= m <= n <= MAX_ELEMENTS):
        raise PhiError(
            f"{k} matrices of {m} x {n}; allowed: 1..{MAX_SUBSETS} of 1 <= m <= n <= "
            f"{MAX_ELEMENTS}"
        )
    matrices = []
    for number, matrix in enumerate(stack):
        try:
            matrices.append(_finite(csr_array(_in_float32(matrix))))
        except PhiError as error:
            raise PhiError(f"matrix {number}: {error}") from error
    return tuple(matrices)


def _checked(arrays: dict[str, AnyArray]) -> csr_array:
    for name in _NAMES:
        if name not in arrays:
            raise PhiError(
                f"has no array {name}; expected a file of scipy.sparse.save_npz"
            )

    kind = arrays["format"]
    is_text = kind.shape == () and kind.dtype.kind in "SU"
    if not is_text or str(kind.astype(str)) != "csr":
        raise PhiError('format: expected "csr"; convert it by matrix.tocsr()')

    data = arrays["data"]
    for name in ("indices", "indptr", "shape"):
        numbers = arrays[name]
        if numbers.ndim != 1 or numbers.dtype.kind not in "iu":
            raise PhiError(f"{name}: expected a list of whole numbers")
    if data.ndim != 1 or data.dtype.kind not in "iufb":
        raise PhiError("data: expected a list of numbers")
    if arrays["shape"].size != 2:
        raise PhiError(f"shape: {arrays['shape'].size} numbers; expected 2")
    m, n = arrays["shape"].tolist()
    if not 1 <= m <= n <= MAX_ELEMENTS:
        raise PhiError(f"shape: {m} x {n}; allowed: 1 <= m <= n <= {MAX_ELEMENTS}")

    # A copy: the arrays are views of the bytes of the file, which cannot be written to.
    try:
        parts = _in_float32(data), arrays["indices"], arrays["indptr"]
        matrix = csr_array(parts, shape=(m, n), copy=True)
        matrix.check_format()
    except ValueError as error:
        raise PhiError(f"no matrix of {m} x {n} in format csr: {error}") from error
    return _finite(matrix)


def _in_float32(numbers: AnyArray) -> Floats:
    # What overflows becomes infinite, and is refused by `_finite`.
    with np.errstate(all="ignore"):
        return numbers.astype(np.float32)


def _finite(matrix: csr_array) -> csr_array:
    sizes = abs(matrix)
    # Not `>`: NaN is no entry, either.
    if not (sizes.data <= MAX_ENTRY).all():
        raise PhiError(f"data: expected finite numbers of at most {MAX_ENTRY:g}")
    of_rows = sizes.sum(axis=1)
    if not of_rows.all():
        raise PhiError("data: a row holds zeros alone")
    return matrix


def stored_class(path: str) -> type[StoredPhi]:
    """Return the class of a kind "file:PATH", whose file is checked; Raises as the class."""
    base = StoredPhi
    if len(load_matrices(path)) > 1:
        base = StackedPhi
    attributes = {"kind": f"file:{path}", "path": path}
    return type(base.__name__, (base,), attributes)
