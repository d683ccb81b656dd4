"""Readout of the rows of a resistive array by voltage dividers, as stated models."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.numerics.arrays import Doubles


def divided(driven: Doubles, everything: Doubles, load: float) -> Doubles:
    """Return the output of a divider, as a part of the supply.

    The driven columns are at the supply, the others at ground, and the row line is loaded by a
    conductance to ground: v = driven / (everything + load). It is not linear in the forces, as all
    taxels of the row load the line.

    Parameters
    ----------
    driven : ndarray of float64
        Sum of the conductances of the driven columns, a row.
    everything : ndarray of float64
        Sum of all conductances of the row; with all columns driven, both are the same.
    load : float
        Conductance of the load, above 0, in the same unit.

    Notes
    -----
    Source: Kirchhoff's current law at the row line. Undriven columns at ground carry no current
    from one row to another; left open, they would.
    """
    return np.asarray(driven / (everything + load))


def undivided(v: Doubles, v_all: Doubles, load: float) -> Doubles:
    """Return the sum of the driven conductances, from the output and that with all columns driven.

    Exact: everything = load v_all / (1 - v_all), driven = v (everything + load) = v load /
    (1 - v_all).
    """
    return np.asarray(v * load / (1.0 - v_all))


def with_crosstalk(forces: Doubles, share: float) -> Doubles:
    """Return readings in which each taxel adds a share of its signal to both neighbours in its row.

    Capacitance between column lines that run side by side couples so; `share` is the part of a
    neighbour's signal. The first and last columns have one neighbour.

    Parameters
    ----------
    forces : ndarray of float64, shape (n_rows, n_cols)
    share : float
        0 or more.
    """
    read = forces.copy()
    read[:, 1:] += share * forces[:, :-1]
    read[:, :-1] += share * forces[:, 1:]
    return read
