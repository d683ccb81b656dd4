"""What study `bases` computes: coefficients, restored scenes, and ways to sample."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.acts import ActsPhi
from sparseskin.nodes.compressor.acts_search import ActsSearch, force_threshold
from sparseskin.nodes.compressor.phi import make_phi
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.reconstructor.basis import make_basis
from sparseskin.nodes.reconstructor.learned_training import (
    KEPT_FRACTION,
    draw_windows,
    learn_atoms,
)
from sparseskin.nodes.reconstructor.presets import PRESETS
from sparseskin.nodes.reconstructor.solver import Solver, make_solver
from sparseskin.nodes.sensor.noise import NoiseModel

from .scene_frames import (
    f_max_of,
    first_contact,
    in_contact,
    n_steps_of,
    scene_frames,
    shape_of,
)

Floats = npt.NDArray[np.float32]
Point = dict[str, Any]

#: Forces are float32: below this a coefficient is the rounding of forces of 2.5 N.
ROUNDING_N = 1e-6
#: Parts of the N coefficients whose energy is looked at.
KEPT_PARTS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3)
#: The paper's, and ones from half of it to eight times it.
LAMBDAS_N = tuple(0.003125 * 2.0**k for k in range(-1, 4))
ITERATIONS = 30
TRAINING_FRAMES, TRAINING_TILE = 150, 8
#: Frames before the first contact: a solver has then seen some of an untouched skin.
BEFORE = 20
#: Solver and Phi by what the pages call them; the reading of all taxels is beside them.
SAMPLINGS = {
    "paper": ("sbhe", PRESETS["paper"]),
    "skin": ("sbhe", PRESETS["skin"]),
    "subsample": ("subsample", {"solver": "interpolation", "basis": "identity"}),
    "acts": ("acts", {"solver": "interpolation", "basis": "identity"}),
}


def spread_frames(scene: str, seed: int, n_frames: int) -> Iterator[tuple[Floats, Floats]]:
    """Yield (truth, taxels) of about n_frames frames, evenly from the first contact to the end."""
    first = first_contact(scene, seed)
    every = max(1, (n_steps_of(scene) - first) // n_frames)
    return scene_frames(scene, seed, first, None, every)


def learned(point: Point) -> dict[str, Any]:
    """Learn a basis from the true forces of some scenes.

    Parameters
    ----------
    point : dict
        scenes, seed.

    Returns
    -------
    dict
        atoms: 64 x 64, rounded to what float32 holds.
    """
    rng = np.random.default_rng(point["seed"])
    parts = []
    for scene in point["scenes"]:
        f_max = f_max_of(scene)
        frames = [t for t, _ in spread_frames(scene, point["seed"], TRAINING_FRAMES)]
        drawn = draw_windows(frames, None, TRAINING_TILE, force_threshold(0.0, f_max), rng)
        parts.append(drawn[: len(drawn) // len(point["scenes"])] * (2.5 / f_max))
    atoms = learn_atoms(np.concatenate(parts), KEPT_FRACTION * 2.5)
    return {"atoms": atoms.astype(np.float32).astype(float).tolist()}


def coefficients(point: Point) -> dict[str, Any]:
    """How many coefficients of a scene's true forces each basis needs.

    Parameters
    ----------
    point : dict
        scene, seed, n_frames; bases: what `make_basis` is asked for, by name.

    Returns
    -------
    dict
        By name: n_nonzero: mean number above rounding, over contact frames; missing: mean part of
        the energy that is not in the largest coefficients, for each of `KEPT_PARTS`; n_frames.
    """
    rows, cols = shape_of(point["scene"])
    bases = {name: make_basis(basis, rows, cols) for name, basis in point["bases"].items()}
    kept = [max(1, round(part * rows * cols)) for part in KEPT_PARTS]
    counts: dict[str, list[int]] = {name: [] for name in bases}
    missing: dict[str, list[list[float]]] = {name: [] for name in bases}
    for truth, _ in spread_frames(point["scene"], point["seed"], point["n_frames"]):
        if not in_contact(truth, f_max_of(point["scene"])):
            continue
        for name, basis in bases.items():
            sizes = np.sort(np.abs(basis.analysis(truth)).reshape(-1))[::-1].astype(np.float64)
            counts[name].append(int(np.count_nonzero(sizes > ROUNDING_N)))
            energy = np.cumsum(sizes**2)
            missing[name].append([max(0.0, 1 - float(energy[k - 1] / energy[-1])) for k in kept])
    return {
        name: {
            "n_nonzero": float(np.mean(counts[name])),
            "missing": np.mean(missing[name], axis=0).tolist(),
            "n_frames": len(counts[name]),
        }
        for name in bases
    }


def restored(point: Point) -> dict[str, Any]:
    """Restore a scene by FISTA in each basis, with each lambda.

    Parameters
    ----------
    point : dict
        scene, seed, n_frames, ratio (N / M); bases: as for `coefficients`.

    Returns
    -------
    dict
        By name: mean_db, min_db: over contact frames, one for each of `LAMBDAS_N`.
    """
    shape, f_max = shape_of(point["scene"]), f_max_of(point["scene"])
    n = shape[0] * shape[1]
    phi = make_phi("sbhe", n=n, m=n // point["ratio"], seed=point["seed"])
    solvers = {
        name: [
            make_solver(
                "fista",
                phi,
                make_basis(basis, *shape),
                iterations=ITERATIONS,
                lambda_n=lambda_n * f_max / 2.5,
            )
            for lambda_n in LAMBDAS_N
        ]
        for name, basis in point["bases"].items()
    }
    psnr: dict[str, list[list[float]]] = {name: [] for name in solvers}
    for truth, taxels in spread_frames(point["scene"], point["seed"], point["n_frames"]):
        y = phi.forward(taxels.reshape(-1))
        for name, by_lambda in solvers.items():
            found = [psnr_db(solver.solve(y) - truth, f_max) for solver in by_lambda]
            if in_contact(truth, f_max):
                psnr[name].append(found)
    return {
        name: {
            "mean_db": np.mean(of, axis=0).round(3).tolist(),
            "min_db": np.min(of, axis=0).round(3).tolist(),
        }
        for name, of in psnr.items()
    }


def sampled(point: Point) -> dict[str, Any]:
    """Restore a scene, frame after frame, from each kind of sampling.

    Parameters
    ----------
    point : dict
        scene, seed, n_frames, ratio (N / M).

    Returns
    -------
    dict
        By the names of `SAMPLINGS`, and "reading" for all taxels as they are read: mean_db,
        min_db, over contact frames.
    """
    scene, seed = point["scene"], point["seed"]
    shape, f_max = shape_of(scene), f_max_of(scene)
    noise = NoiseModel.for_range(f_max)
    restorers = {
        name: _Restorer(kind, chosen, shape, point["ratio"], seed, noise)
        for name, (kind, chosen) in SAMPLINGS.items()
    }
    psnr: dict[str, list[float]] = {name: [] for name in ("reading", *SAMPLINGS)}
    first = max(0, first_contact(scene, seed) - BEFORE)
    for truth, taxels in scene_frames(scene, seed, first, first + point["n_frames"]):
        estimates = {name: one.restored(taxels) for name, one in restorers.items()}
        if in_contact(truth, f_max):
            for name, estimate in ({"reading": taxels} | estimates).items():
                psnr[name].append(psnr_db(estimate - truth, f_max))
    return {
        name: {"mean_db": round(float(np.mean(of)), 3), "min_db": round(float(np.min(of)), 3)}
        for name, of in psnr.items()
    }


class _Restorer:
    """A compressor and a reconstructor in one."""

    def __init__(
        self,
        kind: str,
        chosen: dict[str, Any],
        shape: tuple[int, int],
        ratio: int,
        seed: int,
        noise: NoiseModel,
    ) -> None:
        n = shape[0] * shape[1]
        self._phi = make_phi(kind, n=n, m=n // ratio, seed=seed)
        settings = {k: v for k, v in chosen.items() if k not in ("solver", "basis")}
        self._solver: Solver = make_solver(
            chosen["solver"], self._phi, make_basis(chosen["basis"], *shape), **settings
        )
        threshold = force_threshold(noise.sigma_end, noise.f_max)
        self._search = ActsSearch(np.ones(shape, np.bool_), self._phi.m, threshold)

    def restored(self, taxels: Floats) -> Floats:
        x = taxels.reshape(-1)
        if isinstance(self._phi, ActsPhi):
            self._phi.choose(self._search.places(x.take))
        return self._solver.solve(self._phi.forward(x))
