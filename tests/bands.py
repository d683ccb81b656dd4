"""Parts of the true forces that the published uncertainties hold."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sparseskin.messages.skin import CONTACT_FRACTION
from sparseskin.nodes.reconstructor.estimates.resultant import Estimate, ResultantEstimator
from sparseskin.nodes.reconstructor.estimates.uncertainty import Uncertainty
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.studies.evaluate import in_contact, make_method
from sparseskin.studies.frames import Take

DEVIATIONS = 1.645
"""Half width of a band in standard deviations: that of a normal distribution that holds 90 %."""
HELD = ("touched", "untouched", "total", "row", "col")


def held_of(take: Take, ratio: float, rows: str, seed: int) -> dict[str, float | None]:
    """Reconstruct frames by "skin" with its standard deviations, and count what bands hold.

    `rows`: "fixed" or "rotating"; `seed`: of Phi.

    Returns
    -------
    dict
        By name in `HELD`, the part of all contact frames' bands that hold the truth, 0..1; None
        where there was none.
    """
    shape = take.mask.shape
    method = make_method(PRESETS["skin"], shape, ratio, seed, rows=rows)
    first = method.phi
    uncertainty = Uncertainty(take.mask, first.ratio, "skin", rows)
    resultant = ResultantEstimator(first, method.solver.taxels, shape)
    held: dict[str, list[float]] = {name: [] for name in HELD}
    for truth, taxels in (pair for part in take.parts() for pair in part):
        phi, y = method.phi, method.measure(taxels)
        estimate = resultant.estimate(phi, y)
        forces = method.solve(y).forces
        fitted = phi.forward(forces.reshape(-1))
        residual = math.sqrt(float(np.mean(np.square(fitted - y, dtype=np.float64))))
        sd = uncertainty.update(forces, residual)
        resultant.learn(phi, y, forces.reshape(-1), fitted, method.solver.bias)
        resultant.prepare(method.phi)
        if in_contact(truth, take.f_max):
            inside = np.abs(forces - truth) <= DEVIATIONS * sd
            _count(held, truth, inside, estimate, CONTACT_FRACTION * take.f_max)
    return {name: float(np.mean(values)) if values else None for name, values in held.items()}


def _count(
    held: dict[str, list[float]], truth: Any, inside: Any, estimate: Estimate, touched_n: float
) -> None:
    held["touched"].append(float(inside[truth > touched_n].mean()))
    held["untouched"].append(float(inside[truth == 0].mean()))
    total = float(truth.sum(dtype=np.float64))
    held["total"].append(abs(estimate.total - total) <= DEVIATIONS * estimate.total_sd)
    if estimate.centre is None or estimate.centre_sd is None:
        return
    places = np.indices(truth.shape, dtype=np.float64)
    for name, place, middle, deviation in zip(
        ("row", "col"), places, estimate.centre, estimate.centre_sd, strict=True
    ):
        centre = float((place * truth).sum()) / total
        held[name].append(abs(middle - centre) <= DEVIATIONS * deviation)
