"""Settings of a reconstructor that fail: refused ones, and warnings.

The numbers come from the study `stability`.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.base import RANDOM, Phi, block_layout
from sparseskin.nodes.compressor.phi.rotation import PAPER_BLOCK
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import TINY, Mask

from .solvers.base import solver_class, solver_fact

FEW_TAXELS = 64
"""Taxels up to which sums save few bytes: 4 x 4 taxels lose 1 % of the frames of sudden contacts at
N/3 and 14 % at N/8. Chosen."""
MAX_STEP = 4.0 / 3.0
"""Largest step, in 1 / L. Derived: a gradient step diverges beyond 2 / L, and with momentum beyond
4 / (3 L)."""
N_POWER_STEPS = 30
PAD_SIDE = 8
N_PADS = 256
"""Taxels along the side of a pad, and number of pads whose measurements are compared. Chosen."""
OTHER_ROWS = (
    "preset = paper: the rows of Phi are not those of the paper; advised for its exact method: "
    "compressor.rows = paper"
)
"""Warning where preset `paper` reconstructs other rows of "sbhe"."""
MAX_PAD_SPREAD = 1.75
"""Largest spread of the energy that pads are measured with, as of `pad_spread`."""


def reconstruction_warnings(
    solver: str, basis: str, n: int, m: int, options: Mapping[str, Any]
) -> list[str]:
    """Return warnings of settings that are allowed and known to fail, one line each.

    `options` are the stated settings of the solver, lambda_n for a range of 2.5 N.
    """
    warnings = []
    cls = solver_class(solver)
    lambda_n = options.get("lambda_n")
    advised_range = solver_fact(cls, "lambdas_n")
    if advised_range is not None and lambda_n is not None:
        low, high = advised_range
        advised = f"advised: {low:g} to {high:g}"
        if lambda_n > high:
            warnings.append(
                f"lambda_n = {lambda_n:g}: forces are shrunk away (0.1 on rows of +1 and -1 is "
                f"0.003125 here); {advised}"
            )
        elif lambda_n < low:
            warnings.append(f"lambda_n = {lambda_n:g}: the noise is fitted; {advised}")
    iterations = options.get("iterations")
    n_least = solver_fact(cls, "least_iterations")
    if iterations is not None and iterations < n_least:
        warnings.append(
            f"iterations = {iterations}: {solver} takes several frames to follow a sudden contact; "
            f"advised: {n_least} or more"
        )
    if not solver_fact(cls, "uses_basis") and basis != "haar":
        advised = "haar, or a solver that uses it"
        warnings.append(
            f"basis = {basis}: {solver} does not use it; advised: {advised}"
        )
    if m < n <= FEW_TAXELS:
        warnings.append(
            f"{n} taxels: sums of so few lose contacts, and save few bytes; advised: "
            "compressor.phi = full"
        )
    if solver_fact(cls, "is_l1") and basis == "identity" and m < n:
        warnings.append(
            f"basis = identity with m = {m} of n = {n}: reconstructs no more than {m // 4} pressed "
            "taxels or so; advised: haar"
        )
    return warnings


def has_rows_of_paper(subsets: Sequence[Phi]) -> bool:
    """False for rows of "sbhe" that rotate, are spread over the blocks or are of other blocks."""
    if len(subsets) > 1:
        return False
    (phi,) = subsets
    layout = block_layout(phi)
    if layout is None or layout.blocks is None:
        return True
    return phi.block == PAPER_BLOCK and phi.rule == RANDOM


def check_lambda(solver: str, lambda_n: float, f_max: float, phi: Phi) -> None:
    """Refuse a lambda with which every frame is reconstructed as 0; lambda and f_max in one unit.

    That is so if no coefficient of Phi^T y is above lambda; the largest possible one, of a skin
    pressed all over, is L f_max sqrt(N).

    Raises
    ------
    SolverError
        If lambda_n is that or more.
    """
    largest = phi.lipschitz * f_max * math.sqrt(phi.n)
    if solver_fact(solver_class(solver), "is_l1") and lambda_n >= largest:
        raise SolverError(
            f"lambda_n = {lambda_n:g}: every frame would be 0; allowed: below {largest:g}"
        )


def options_for_range(
    solver: str, options: Mapping[str, Any], f_max: float, phi: Phi
) -> dict[str, Any]:
    """Options of a solver for a skin: lambda_n, stated for the paper's range, is scaled and checked
    as by `check_lambda`.
    """
    if "lambda_n" not in options:
        return dict(options)
    lambda_n = options["lambda_n"] * (f_max / PAPER_F_MAX_N)
    check_lambda(solver, lambda_n, f_max, phi)
    return {**options, "lambda_n": lambda_n}


def check_phi(phi: Phi, mask: Mask) -> list[str]:
    """Check operators and Lipschitz constant of a user's own phi; return warnings, one line each.

    Raises
    ------
    SolverError
        If `adjoint` is not the transpose of `forward`, or the largest eigenvalue of Phi Phi^T is
        more than 4/3 `lipschitz`: a solver would diverge, or end at wrong forces.
    """
    rng = np.random.default_rng(0)
    x = rng.standard_normal(phi.n).astype(np.float32)
    y = rng.standard_normal(phi.m).astype(np.float32)
    # Dot test: <Phi x, y> = <x, Phi^T y>. Not `>`: NaN is no such number.
    measured = phi.forward(x)
    forth = float(measured @ y)
    back = float(x @ phi.adjoint(y))
    scale = np.linalg.norm(measured) * np.linalg.norm(y)
    rounding = 1e-3 * float(scale)
    if not abs(forth - back) <= rounding:
        raise SolverError(
            f"phi {phi.kind}: adjoint is not the transpose of forward: <Phi x, y> = {forth:.6g} "
            f"but <x, Phi^T y> = {back:.6g}; allowed: equal but for rounding"
        )
    # Power method: y turns to the eigenvector of the largest eigenvalue, by which it grows.
    for _ in range(N_POWER_STEPS):
        y /= max(float(np.linalg.norm(y)), TINY)
        y = phi.forward(phi.adjoint(y))
    largest = float(np.linalg.norm(y))
    if not largest <= MAX_STEP * phi.lipschitz:
        raise SolverError(
            f"phi {phi.kind}: lipschitz says {phi.lipschitz:.4g} but the largest eigenvalue of "
            f"Phi Phi^T is {largest:.4g}, and solvers diverge; allowed: that or more"
        )
    evenness = pad_spread(phi, mask, rng)
    if evenness <= MAX_PAD_SPREAD:
        return []
    return [
        f"phi {phi.kind}: some contacts are measured far better than others (spread {evenness:.1f} "
        f"times that of a random matrix), and the others are lost; advised: taxels dealt out at "
        f"random, {MAX_PAD_SPREAD:g} or less"
    ]


def pad_spread(phi: Phi, mask: Mask, rng: np.random.Generator) -> float:
    """Return how unevenly pads of 8 x 8 taxels are measured.

    Standard deviation of ||Phi x||^2 / ||x||^2 over pads at random places, relative to its mean,
    divided by sqrt(2 / m), its value for a matrix of normal random numbers: about 1 if taxels are
    permuted at random, more if neighbours share a measurement.
    """
    sides = np.minimum(PAD_SIDE, mask.shape)
    shares = []
    n_places = np.array(mask.shape) - sides + 1
    for _ in range(N_PADS):
        row, col = rng.integers(0, n_places)
        frame = np.zeros(mask.shape, np.float32)
        frame[row : row + sides[0], col : col + sides[1]] = 1.0
        x = frame[mask]
        # A pad may lie beside the skin.
        if x.any():
            squares = np.square(phi.forward(x), dtype=np.float64)
            shares.append(float(squares.sum()) / float(x.sum()))
    mean = float(np.mean(shares))
    spread = float(np.std(shares)) / max(mean, TINY)
    return spread / math.sqrt(2.0 / phi.m)
