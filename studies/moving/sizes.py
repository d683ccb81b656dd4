"""Contacts on skins of all sizes: how far off a reconstruction is, and which contacts it loses."""

from __future__ import annotations

from typing import Any

import numpy as np

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.rotation import FIXED, PAPER, ROTATING
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes.presses import BODIES, SKINS, press_frames, scattered_mask
from sparseskin.studies.evaluate import Estimator, Reading, in_contact, make_method
from sparseskin.studies.real.methods import Hold, Lattice

#: Skins that the other sections do not have, by name: shape, and number of scattered taxels.
SIZES: dict[str, tuple[tuple[int, int], int | None]] = {
    **{f"{rows} x {cols}": ((rows, cols), None) for rows, cols in SKINS if rows < 40},
    "20 x 20": ((20, 20), None),
    "20 x 20, 42 taxels": ((20, 20), 42),
}
#: Parts of the skin that a body touches.
ACTIVE = (0.1, 0.3, 0.6)
N_FRAMES = 60
VANISHED = 0.9
"""Relative error from which a contact counts as vanished: 1 is that of an estimate of 0. Chosen."""

Point = dict[str, Any]


def sized(point: Point) -> dict[str, Any]:
    """Reconstruct sudden contacts of each body on a skin by each method, on the same readings.

    `point`: skin (of `SIZES`), active, ratio, seed.

    Returns
    -------
    dict
        "methods": by method median, median relative error ||x' - x|| / ||x|| of contact frames, and
        vanished, part of them in which it is `VANISHED` or more; both in %.
    """
    shape, n_scattered = SIZES[point["skin"]]
    ratio, seed = point["ratio"], point["seed"]
    mask = np.ones(shape, dtype=np.bool_)
    if n_scattered is not None:
        mask = scattered_mask(shape, n_scattered, seed)

    def estimators() -> dict[str, Estimator]:
        def method(preset: str, rows: str) -> Estimator:
            return make_method(PRESETS[preset], shape, ratio, seed, rows=rows, mask=mask)

        return {
            "raw reading": Reading(),
            "paper": method("paper", PAPER),
            "skin": method("skin", FIXED),
            f"skin, {ROTATING}": method("skin", ROTATING),
            "lattice": Lattice(mask, ratio),
            "hold": Hold(mask, ratio),
        }

    errors: dict[str, list[float]] = {}
    for body in BODIES:
        methods = estimators()
        frames = press_frames(
            *(body, shape, N_FRAMES, seed),
            course="sudden",
            active=point["active"],
            mask=mask,
            noise=NoiseModel.for_range(PAPER_F_MAX_N),
        )
        for truth, taxels in frames:
            found = {name: one.reconstruct(taxels).forces for name, one in methods.items()}
            if not in_contact(truth, PAPER_F_MAX_N):
                continue
            norm = float(np.linalg.norm(truth))
            for name, forces in found.items():
                error = float(np.linalg.norm(forces - truth)) / norm
                errors.setdefault(name, []).append(error)
    return {
        "methods": {
            name: {
                "median": 100 * float(np.median(of)),
                "vanished": 100 * float(np.mean(np.array(of) >= VANISHED)),
            }
            for name, of in errors.items()
        }
    }
