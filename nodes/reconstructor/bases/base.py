"""The interface of bases Psi, their registry, and `make_basis`."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np

from sparseskin.messages.fields import MAX_SIDE
from sparseskin.messages.ranges import is_whole
from sparseskin.nodes import extensions
from sparseskin.nodes.arguments import checked
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.lookup import find_class
from sparseskin.nodes.numerics.arrays import Floats, each_frame

BASES = extensions.Registry(
    extensions.BASES,
    {
        "haar": "sparseskin.nodes.reconstructor.bases.haar:HaarBasis",
        "identity": "sparseskin.nodes.reconstructor.bases.base:IdentityBasis",
    },
)
"""Class of each basis."""
_INTERFACE = ("n_rows", "n_cols", "analysis", "synthesis")


class Basis(ABC):
    """An orthonormal basis Psi on a grid: image = Psi theta, theta = Psi^T image.

    An instance owns its work arrays: use one per thread.

    Parameters
    ----------
    n_rows, n_cols : int
        Size of the grid of taxels, each at least 1.

    Raises
    ------
    SolverError
        If the grid is empty.
    """

    #: Its registered name, for messages.
    label: str = ""

    def __init__(self, n_rows: int, n_cols: int) -> None:
        is_grid = is_whole(n_rows, 1, MAX_SIDE) and is_whole(n_cols, 1, MAX_SIDE)
        if not is_grid:
            raise SolverError(
                f"basis: {n_rows!r} x {n_cols!r} is no grid; allowed: whole numbers "
                f"1..{MAX_SIDE}"
            )
        self.n_rows = int(n_rows)
        self.n_cols = int(n_cols)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.label}: {self.n_rows} x {self.n_cols}>"

    def analysis(self, image: Floats) -> Floats:
        """Return the coefficients theta = Psi^T image.

        Parameters
        ----------
        image : ndarray of float32, shape (n_rows, n_cols) or (k, n_rows, n_cols)
            Forces, newtons; or k such frames.

        Returns
        -------
        ndarray of float32, of the same shape
            Coefficients, newtons. A frame gives the same bits alone and in a batch.

        Raises
        ------
        SolverError
            If image has another shape.
        """
        return self._each(self._analysis, "image", image)

    def synthesis(self, coefficients: Floats) -> Floats:
        """Return the image Psi theta, forces in newtons.

        Shapes and Raises as in `analysis`; coefficients are laid out as it returns them.
        """
        return self._each(self._synthesis, "coefficients", coefficients)

    @abstractmethod
    def _analysis(self, image: Floats, out: Floats) -> None:
        """Write Psi^T image to out; both flat, contiguous, float32."""

    @abstractmethod
    def _synthesis(self, coefficients: Floats, out: Floats) -> None:
        """Write Psi theta to out; both flat, contiguous, float32."""

    def _each(
        self, apply: Callable[[Floats, Floats], None], name: str, given: Floats
    ) -> Floats:
        shape = (self.n_rows, self.n_cols)

        def flat(argument: Floats, result: Floats) -> None:
            apply(argument.reshape(-1), result.reshape(-1))

        return each_frame(flat, given, (shape, shape), f"basis: {name}", SolverError)


class IdentityBasis(Basis):
    """Psi = I: the forces themselves are taken to be sparse."""

    def _analysis(self, image: Floats, out: Floats) -> None:
        np.copyto(out, image)

    def _synthesis(self, coefficients: Floats, out: Floats) -> None:
        np.copyto(out, coefficients)


def find_basis(name: str) -> Callable[..., Any]:
    """Return the callable that makes a basis of n_rows, n_cols; Raises as in `make_basis`."""
    return find_class("basis", name, BASES, SolverError)


@checked(SolverError)
def make_basis(name: str, n_rows: int, n_cols: int) -> Basis:
    """Make a basis by name.

    Parameters
    ----------
    name : str
        "haar"; "identity"; or "module:Class" for your own: called with the keywords n_rows, n_cols,
        it must offer what `Basis` does.
    n_rows, n_cols : int
        Size of the grid of taxels.

    Raises
    ------
    SolverError
        If the name is unknown, the grid is empty, or a class of your own is not a basis.
    """
    cls = find_basis(name)
    try:
        instance = cls(n_rows=n_rows, n_cols=n_cols)
    except TypeError as cause:
        raise SolverError(
            f'basis "{name}" does not take n_rows, n_cols: {cause}'
        ) from cause
    missing = [member for member in _INTERFACE if not hasattr(instance, member)]
    if missing:
        raise SolverError(f'basis "{name}" is no basis: it lacks {", ".join(missing)}')
    basis: Basis = instance
    # One of the user's own, that is no `Basis`, need not have a label.
    if getattr(basis, "label", None) == "":
        basis.label = name
    return basis
