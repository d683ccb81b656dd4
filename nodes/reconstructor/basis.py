"""The representation basis Psi: what every basis is, and how one is made by name."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.lookup import find_class

BASES = {
    "haar": "sparseskin.nodes.reconstructor.haar:HaarBasis",
    "db2": "sparseskin.nodes.reconstructor.separable:db2",
    "db4": "sparseskin.nodes.reconstructor.separable:db4",
    "sym4": "sparseskin.nodes.reconstructor.separable:sym4",
    "coif1": "sparseskin.nodes.reconstructor.separable:coif1",
    "dct": "sparseskin.nodes.reconstructor.separable:DctBasis",
    "identity": "sparseskin.nodes.reconstructor.basis:IdentityBasis",
}
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

    def __init__(self, n_rows: int, n_cols: int) -> None:
        if n_rows < 1 or n_cols < 1:
            raise SolverError(f"basis: a grid of {n_rows} x {n_cols} has no taxels")
        self.n_rows = int(n_rows)
        self.n_cols = int(n_cols)

    def analysis(self, image: Floats, out: Floats | None = None) -> Floats:
        """Return the coefficients theta = Psi^T image.

        Parameters
        ----------
        image : ndarray of float32, shape (n_rows, n_cols)
            Forces, newtons.
        out : ndarray of float32, shape (n_rows, n_cols), contiguous, optional
            Where to put the result; not the image itself.

        Returns
        -------
        ndarray of float32, shape (n_rows, n_cols)
            Coefficients, newtons.

        Raises
        ------
        SolverError
            If image or out has another shape, or out is not contiguous float32.
        """
        image, out = self._checked("image", image, out)
        self._analysis(image.reshape(-1), out.reshape(-1))
        return out

    def synthesis(self, coefficients: Floats, out: Floats | None = None) -> Floats:
        """Return the image Psi theta.

        Parameters
        ----------
        coefficients : ndarray of float32, shape (n_rows, n_cols)
            Laid out as `analysis` gives them, newtons.
        out : ndarray of float32, shape (n_rows, n_cols), contiguous, optional
            Where to put the result; not the coefficients themselves.

        Returns
        -------
        ndarray of float32, shape (n_rows, n_cols)
            Forces, newtons.

        Raises
        ------
        SolverError
            If coefficients or out has another shape, or out is not contiguous float32.
        """
        coefficients, out = self._checked("coefficients", coefficients, out)
        self._synthesis(coefficients.reshape(-1), out.reshape(-1))
        return out

    @abstractmethod
    def _analysis(self, image: Floats, out: Floats) -> None:
        """Write Psi^T image to out; both flat, contiguous, float32."""

    @abstractmethod
    def _synthesis(self, coefficients: Floats, out: Floats) -> None:
        """Write Psi theta to out; both flat, contiguous, float32."""

    def _checked(self, name: str, given: Floats, out: Floats | None) -> tuple[Floats, Floats]:
        given = np.ascontiguousarray(given, dtype=np.float32)
        shape = (self.n_rows, self.n_cols)
        if given.shape != shape:
            raise SolverError(f"basis: {name} has shape {given.shape}; expected {shape}")
        if out is None:
            out = np.empty(shape, dtype=np.float32)
        elif out.shape != shape or out.dtype != np.float32 or not out.flags.c_contiguous:
            raise SolverError(
                f"basis: out is {out.dtype} of shape {out.shape}; "
                f"expected contiguous float32 of shape {shape}"
            )
        return given, out


class IdentityBasis(Basis):
    """Psi = I: the taxels themselves are taken to be sparse."""

    def _analysis(self, image: Floats, out: Floats) -> None:
        np.copyto(out, image)

    def _synthesis(self, coefficients: Floats, out: Floats) -> None:
        np.copyto(out, coefficients)


def make_basis(name: str, n_rows: int, n_cols: int) -> Basis:
    """Make a basis by name.

    Parameters
    ----------
    name : str
        "haar"; "db2", "db4", "sym4", "coif1" (PyWavelets' names); "dct"; "identity"; or
        "module:Class" for your own: called with the keywords n_rows, n_cols, it must offer what
        `Basis` does.
    n_rows, n_cols : int
        Size of the grid of taxels.

    Raises
    ------
    SolverError
        If the name is unknown, the grid is empty, or a class of your own is not a basis.
    """
    cls = find_class("basis", name, BASES, SolverError)
    try:
        made = cls(n_rows=n_rows, n_cols=n_cols)
    except TypeError as cause:
        raise SolverError(f'basis "{name}" does not take n_rows, n_cols: {cause}') from cause
    missing = [attribute for attribute in _INTERFACE if not hasattr(made, attribute)]
    if missing:
        raise SolverError(f'basis "{name}" is no basis: it lacks {", ".join(missing)}')
    basis: Basis = made
    return basis
