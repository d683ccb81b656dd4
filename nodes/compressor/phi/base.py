"""The measurement matrix Phi: the interface of all kinds, and `make_phi` by name."""

import hashlib
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np

from sparseskin.messages.fields import MAX_SIDE
from sparseskin.messages.frames import FINGERPRINT_PATTERN
from sparseskin.messages.ranges import is_whole
from sparseskin.nodes import extensions
from sparseskin.nodes.arguments import checked
from sparseskin.nodes.errors import PhiError
from sparseskin.nodes.lookup import find_callable, find_class
from sparseskin.nodes.numerics.arrays import (
    AnyArray,
    Bytes,
    Doubles,
    Floats,
    Indices,
    Mask,
    each_frame,
)

KINDS = extensions.Registry(
    extensions.PHIS,
    {
        "sbhe": "sparseskin.nodes.compressor.phi.sbhe:SbhePhi",
        "full": "sparseskin.nodes.compressor.phi.identity:FullPhi",
        "subsample": "sparseskin.nodes.compressor.phi.identity:SubsamplePhi",
        "gaussian": "sparseskin.nodes.compressor.phi.gaussian:GaussianPhi",
        "row_local": "sparseskin.nodes.compressor.phi.row_local:RowLocalPhi",
    },
)
"""Class of each kind."""
MAX_SUBSETS = 64
"""Largest number of row subsets. Chosen: a row that is measured less often than every 64 frames
adds as good as nothing."""
UNREAD = 0.01
"""Largest part of the rows that is in none of the row subsets. Chosen: with one more subset, each
row waits longer, and errors are larger."""
MAX_TAXELS = MAX_SIDE**2
"""Number of taxels of the largest skin."""
LOCAL = "local:"
STORED = "file:"
"""Prefixes of kinds with a parameter: the side of a neighbourhood, and a path."""
_WITH_PARAMETER = {
    LOCAL: "sparseskin.nodes.compressor.phi.sbhe:local_class",
    STORED: "sparseskin.nodes.compressor.phi.stored:stored_class",
}
BLOCK = 256
"""Size of the Hadamard blocks where none is stated: of sums in software, which need no wires.
Fitted on five recordings (`sparseskin study accuracy`); 1024 is no better."""
RULES = RANDOM, SUMS = 1, 3
"""Rules by which the rows of "sbhe" are chosen, see `SbhePhi`; a message states which."""
_INTERFACE = (
    *("kind", "n", "m", "ratio", "lipschitz", "fingerprint"),
    *("forward", "adjoint", "dense", "describe"),
)
Code = Bytes
"""Bits that state which rows of a matrix a frame reads."""


class BlockLayout(NamedTuple):
    """Where a block Hadamard transform has the taxels and the measurements of a matrix, whose rows
    are some of its rows, of length 1.
    """

    sizes: list[int]  # of the blocks
    permutation: Indices  # taxel of each column
    rows: Indices  # row of each measurement
    blocks: Indices | None
    """Block of each measurement; None where blocks are single taxels."""


class Phi(ABC):
    """A measurement matrix: y = Phi x, m numbers for the n forces of a patch.

    An instance owns its work arrays: use one per thread.

    Parameters
    ----------
    n : int
        Number of taxels, at least 1.
    m : int
        Number of measurements, 1..n.
    seed : int
        Seed of the random choices, at least 0.
    block : int
        Size of the Hadamard blocks, a power of two; kinds without blocks only keep it.

    Attributes
    ----------
    kind : str
        The name that `make_phi` knows it by.
    default_block : int
        `block` where none is stated, of a kind.
    rule : int
        Rule by which the rows were chosen; 3 for a kind that has only one.
    has_rules : bool
        True if the constructor takes `rule`.
    fingerprint : str
        16 hexadecimal characters that identify the matrix: a hash of its entries, not of the
        seed, so that two machines with different generators notice.
    lipschitz : float
        Largest eigenvalue of Phi Phi^T; 1 for orthonormal rows.
    choice : str
        Field of `Measurements` that states the rows of a frame, of a kind that chooses them anew in
        each: "places" or "nodes"; "" for others.
    solvers : mapping of str to str
        Solvers that invert a kind with a `choice`, as "module:Class", by the name that settings
        state.
    samples : bool
        True if each measurement is one taxel, and the others are not read.

    Raises PhiError if a parameter is of the wrong type or out of its range.
    """

    kind: str
    default_block: ClassVar[int] = BLOCK
    rule: int = SUMS
    #: Rows and columns of the frames that it measures, where they are known.
    grid: tuple[int, int] | None = None
    #: Why the readings of each frame that `sparseskin.compress` measured last are not trusted,
    #: words of `Reason`; "" where they are.
    reasons: tuple[str, ...] = ()
    has_rules: ClassVar[bool] = False
    choice: ClassVar[str] = ""
    solvers: ClassVar[Mapping[str, str]] = MappingProxyType({})
    samples: ClassVar[bool] = False

    def __init__(self, n: int, m: int, seed: int, block: int = BLOCK) -> None:
        self.check_size(n, m, seed, block)
        self.n = int(n)
        self.m = int(m)
        self.seed = int(seed)
        self.block = int(block)
        self.fingerprint = ""

    def __repr__(self) -> str:
        name = type(self).__name__
        return (
            f"<{name} {self.kind}: m = {self.m} of {self.n} taxels, seed {self.seed}>"
        )

    @classmethod
    def check_size(cls, n: int, m: int, seed: int, block: int) -> None:
        """Raise PhiError if a parameter is not allowed, before any matrix is made."""
        check_parameters(n, m, seed, block)

    @property
    def ratio(self) -> float:
        """Compression ratio n / m."""
        return self.n / self.m

    @property
    def lipschitz(self) -> float:
        """Largest eigenvalue of Phi Phi^T: 1, the rows being orthonormal."""
        return 1.0

    def forward(self, x: Floats) -> Floats:
        """Return y = Phi x: newtons, float32 (m,), of forces of the existing taxels in row-major
        order, float32 (n,); or (k, m) of k such frames. A frame gives the same bits alone and in a
        batch. Raises PhiError if x has another shape or type.
        """
        shapes = (self.n,), (self.m,)
        return each_frame(self._forward, x, shapes, f"{self.kind}: x", PhiError)

    def adjoint(self, y: Floats) -> Floats:
        """Return x = Phi^T y, as `forward`, with y and x of m and n numbers a frame."""
        shapes = (self.m,), (self.n,)
        return each_frame(self._adjoint, y, shapes, f"{self.kind}: y", PhiError)

    def compile_loops(self) -> None:  # noqa: B027
        """Measure by compiled loops from now on, of the same bits, where the kind has some; needs
        numba.
        """

    def block_layout(self) -> BlockLayout | None:
        """Return the layout by which a solver may apply the matrix; None if there is none. A
        subclass may have changed what the operators do, and has none unless it says so.
        """
        return None

    def measure(self, x: Floats) -> tuple[Floats, Code | None]:
        """Return the measurements of a frame, float32 (m,), of forces x, float32 (n,); and, of a
        kind with a `choice`, the code of the rows that were chosen for it.
        """
        return self.forward(x), None

    def follow(self, code: Code) -> None:  # noqa: B027
        """Use the rows of a frame by their code, of a kind with a `choice`. Raises PhiError if it
        is malformed.
        """

    def forget(self) -> None:  # noqa: B027
        """Forget the frames that rows were chosen by."""

    @property
    def most_code_bytes(self) -> int:
        """Largest number of bytes of a code; 0 without a `choice`."""
        return 0

    def state_noise(self, sigma_end: float, f_max: float, clipped: bool = True) -> None:  # noqa: B027
        """State the standard deviation of an untouched taxel's noise, 0 if not known, f_max, and
        whether that noise is clipped at 0, for a kind that chooses its rows by what is touched.
        """

    def lay_out(self, exists: Mask) -> None:
        """State the grid of the taxels, bool (n_rows, n_cols), True where one exists, by which some
        kinds arrange their rows. Raises PhiError if they are not n, or the kind does not allow it.
        """
        # A mask of another skin would put each measurement on other taxels.
        n = np.count_nonzero(exists)
        if n != self.n:
            raise PhiError(f"{self.kind}: n = {self.n}, but {n} taxels exist")
        self._lay_out(exists)

    def _lay_out(self, exists: Mask) -> None:  # noqa: B027
        """Arrange the rows by the grid, where the kind depends on it."""

    def dense(self) -> Doubles:
        """Return the explicit matrix, float64, shape (m, n): by default row by row by `adjoint`."""
        # Phi^T of the i-th unit vector is row i.
        rows = self.adjoint(np.eye(self.m, dtype=np.float32))
        return rows.astype(np.float64)

    def describe(self) -> dict[str, Any]:
        """Return the arguments of `make_phi` that make it again."""
        names = ("kind", "n", "m", "seed", "block", "rule")
        return {name: getattr(self, name) for name in names}

    @abstractmethod
    def _forward(self, x: Floats, out: Floats) -> None:
        """Write Phi x to out, one frame; both contiguous float32 of the right length."""

    @abstractmethod
    def _adjoint(self, y: Floats, out: Floats) -> None:
        """Write Phi^T y to out, one frame; both contiguous float32 of the right length."""


def phi_fact(phi: object, name: str) -> Any:
    """An attribute of a matrix or its class; that of `Phi` for a user's own without it."""
    return getattr(phi, name, getattr(Phi, name))


def block_layout(phi: object) -> BlockLayout | None:
    """As the method of `Phi`, of a user's own too."""
    # Of a class that only has the interface nothing is known but its operators.
    if isinstance(phi, Phi):
        return phi.block_layout()
    return None


def follow(phi: Phi, **codes: Code | None) -> None:
    """Set the rows of a frame by what came with its measurements, by field of `Measurements`.

    Raises PhiError if the code is absent, of another kind, or malformed.
    """
    # Rows that the wrong matrix reads would invent forces.
    choice = phi_fact(phi, "choice")
    for field, code in codes.items():
        if field != choice and code is not None:
            raise PhiError(
                f"{phi.kind}: measurements with {field}; allowed: a phi that chooses "
                "its rows by them"
            )
    if not choice:
        return

    code = codes.get(choice)
    if code is None:
        raise PhiError(
            f"{phi.kind}: the measurements come without the {choice} of their rows"
        )
    phi.follow(code)


def phi_class(kind: str) -> Callable[..., Any]:
    """The class of a kind, as `make_phi` takes it. Raises PhiError if there is none."""
    prefix, colon, parameter = kind.partition(":")
    # "module:Class" of a user's own has a colon, too, and another word before it.
    home = _WITH_PARAMETER.get(prefix + colon)
    if home is None:
        return find_class("phi", kind, KINDS, PhiError)

    # Imported only where it is named: a file of matrices needs scipy, which loads slowly.
    cls: Callable[..., Any] = find_callable(home, PhiError)(parameter)
    return cls


def is_built_in(kind: str) -> bool:
    """True for a kind that a message may name: one of the core or of an installed plug-in, which
    opens no file and imports no other module.
    """
    return kind in KINDS or kind.startswith(LOCAL)


def check_parameters(n: int, m: int, seed: int, block: int) -> None:
    """Raise PhiError, naming the parameter, its value and what is allowed."""
    # Types first: the ranges compare numbers.
    for name, value in (("n", n), ("m", m), ("seed", seed), ("block", block)):
        if not is_whole(value):
            raise PhiError(
                f"phi: {name} = {value!r} is not allowed; allowed: a whole number"
            )

    # A power of two has one bit set.
    is_power = block >= 1 and not block & (block - 1)
    for name, value, is_allowed, allowed in (
        ("n", n, 1 <= n <= MAX_TAXELS, f"1..{MAX_TAXELS} taxels"),
        ("m", m, 1 <= m <= n, f"1..{n} (n = {n} taxels)"),
        ("seed", seed, seed >= 0, "0 or more"),
        ("block", block, is_power, "a power of two (1, 2, 4 ..)"),
    ):
        if not is_allowed:
            raise PhiError(f"phi: {name} = {value} is not allowed; allowed: {allowed}")


def fingerprint_of(kind: str, n: int, m: int, block: int, *arrays: AnyArray) -> str:
    """The first 16 hexadecimal characters of the SHA-256 over the parts of a matrix: integers as
    little-endian int32, floats as little-endian float32, to be the same on every machine.
    """
    # Type and shape first: other arrays with the same bytes are another matrix.
    digest = hashlib.sha256(f"{kind} {n} {m} {block}".encode())
    for array in arrays:
        # Indices have 32 bits on some machines and 64 on others.
        wire = "<f4" if array.dtype.kind == "f" else "<i4"
        digest.update(f" {wire} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array, dtype=wire).tobytes())
    return digest.hexdigest()[:16]


def block_of(kind: str, block: int | None) -> int:
    """Size of the Hadamard blocks: the stated one, or that of the kind; PhiError as `phi_class`."""
    if block is not None:
        return block
    # A class of the user's own need not have one.
    return getattr(phi_class(kind), "default_block", BLOCK)


@checked(PhiError)
def make_phi(
    kind: str, n: int, m: int, seed: int, block: int | None = None, rule: int = SUMS
) -> Phi:
    """Make a measurement matrix by name.

    Parameters
    ----------
    kind : str
        "sbhe" (scrambled block Hadamard, the paper's), "full" (every taxel), "subsample"
        (single taxels), "gaussian" (dense), "row_local" (columns of a row summed), "local:SIDE"
        (sbhe within neighbourhoods of SIDE x SIDE taxels), "file:PHI.npz" (a sparse matrix, or a
        stack of matrices); that of a plug-in: "acts" (single taxels, chosen anew in each frame),
        "adaptive" (rows of a quad tree, chosen anew in each frame); or "module:Class" for your own,
        with the constructor and the interface of `Phi`.
    n, m, seed : int
        As in `Phi`.
    block : int, optional
        As in `Phi`; by default 256, and 32 of "local:SIDE", whose sums are those of wires.
    rule : int
        Rule by which the rows are chosen, as in `SbhePhi`: 3, or 1 for the paper's. Kinds that have
        no choice of rules take no notice.

    Raises
    ------
    PhiError
        If the kind is unknown, a parameter is not allowed, or a class of your own is not a Phi.
    """
    cls = phi_class(kind)
    block = block_of(kind, block)
    check_parameters(n, m, seed, block)
    if rule not in RULES:
        allowed = ", ".join(map(str, RULES))
        raise PhiError(f"phi: rule = {rule!r} is not allowed; allowed: {allowed}")

    # A class of the user's own need not take a rule.
    parameters = {"n": n, "m": m, "seed": seed, "block": block}
    if rule != SUMS and getattr(cls, "has_rules", False):
        parameters["rule"] = rule
    try:
        phi = cls(**parameters)
    except TypeError as cause:
        raise PhiError(
            f'phi "{kind}" does not take n, m, seed, block: {cause}'
        ) from cause
    _check_made(kind, phi, n, m)
    # It has the interface, and need not be a subclass.
    matrix: Phi = phi
    return matrix


def _check_made(kind: str, phi: Any, n: int, m: int) -> None:
    """Raise PhiError unless an object, of a class of the user's own, is a Phi of m x n."""
    # All of it at once: who writes a class would else meet its names one by one.
    missing = [name for name in _INTERFACE if not hasattr(phi, name)]
    if missing:
        raise PhiError(
            f'phi "{kind}" is no measurement matrix: it lacks {", ".join(missing)}'
        )
    if (phi.n, phi.m) != (n, m):
        raise PhiError(
            f'phi "{kind}" has n = {phi.n}, m = {phi.m}; expected n = {n}, m = {m}'
        )
    # Messages carry it: one of another form would be refused there, frame by frame.
    fingerprint = str(phi.fingerprint)
    if not re.fullmatch(FINGERPRINT_PATTERN, fingerprint):
        expected = "16 hexadecimal digits, as fingerprint_of makes them"
        fault = f"fingerprint = {ascii(fingerprint)[:40]}"
        raise PhiError(f'phi "{kind}" has {fault}; expected {expected}')
