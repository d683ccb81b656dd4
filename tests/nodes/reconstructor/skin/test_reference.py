"""The fast solver computes what the reference states, in each of its forms."""

from __future__ import annotations

import math
from functools import cache
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import pytest
from pressed import noisy, with_errors

from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.compressor.phi.rotation import m_of, row_subsets
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.skin.evidence import HAAR, SMOOTH
from sparseskin.nodes.reconstructor.skin.reference import ReferenceSolver
from sparseskin.nodes.reconstructor.skin.solver import SkinSolver
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes.presses import press_frames
from sparseskin.nodes.sensor.scenes.scenes import open_scene

pytestmark = [
    pytest.mark.parametrize("fast", ["off", "on"]),
    pytest.mark.parametrize("rows", ["fixed", "rotating"]),
]


class Scene(NamedTuple):
    """A stream of readings, and the ratio N / M at which it is measured."""

    frames: list[Floats]
    mask: Mask
    ratio: int


def press(
    body: str,
    shape: tuple[int, int],
    ratio: int,
    n_frames: int = 30,
    seed: int = 0,
    mask: Mask | None = None,
    errors: dict[str, float] | None = None,
    **options: Any,
) -> Scene:
    """Noisy frames of a press; the first 10 are untouched."""
    mask = np.ones(shape, dtype=np.bool_) if mask is None else mask
    options |= {"mask": mask, "noise": NoiseModel.for_range(2.5)}
    pairs = list(press_frames(body, shape, n_frames, seed, **options))
    frames = [taxels for _, taxels in pairs]
    if errors is not None:
        frames = [*with_errors((truth for truth, _ in pairs), mask, seed, **errors)]
    return Scene(frames, mask, ratio)


def lands() -> Scene:
    """Frames of 40 x 40 taxels, 1 ms apart; the first ones are untouched."""
    box = [truth for _, truth in islice(open_scene("lift_box_40", 0), 324, 332)]
    return Scene([noisy(truth, k) for k, truth in enumerate(box)], np.ones((40, 40), np.bool_), 4)


def holes() -> Mask:
    mask = np.ones((24, 22), dtype=np.bool_)
    mask[:4, :7] = False
    mask[12, 8] = False
    return mask


#: As of a real skin: offsets, unequal gains, dead taxels.
ERRORS = {"offset": 0.05, "gain": 0.05, "dead": 0.02}
SCENES = {
    "still plate": lambda: press("plate", (24, 24), 3, speed=0.0, active=0.05),
    "plate": lambda: press("plate", (24, 20), 3, seed=1),
    "wrench": lambda: press("wrench", (24, 20), 4),
    "fingertips, holes": lambda: press("fingertips", (24, 22), 3, mask=holes(), course="sudden"),
    "box": lands,
    "dense": lambda: press("gaussian", (24, 20), 3, seed=1, active=0.5),
    "dense, errors": lambda: press("gaussian", (24, 20), 3, active=0.5, errors=ERRORS),
    "few of many": lambda: press("peg", (30, 24), 8, n_frames=13, seed=1),
    "small": lambda: press("gaussian", (8, 8), 3, active=0.4),
    "line": lambda: press("gaussian", (1, 64), 3, active=0.3),
    "small, N/8": lambda: press("peg", (8, 8), 8, active=0.4),
}


def subsets_of(scene: Scene, rows: str) -> list[Phi]:
    n = int(np.count_nonzero(scene.mask))
    return row_subsets(make_phi("sbhe", n, m_of(n, scene.ratio, rows), seed=0), rows)


class Stated(NamedTuple):
    """A frame of the reference."""

    forces: Doubles
    model: str
    trusted: bool
    error: float


@cache
def stated(name: str, rows: str, noise_sd: float) -> list[Stated]:
    scene = SCENES[name]()
    subsets = subsets_of(scene, rows)
    solver, found = ReferenceSolver(subsets, scene.mask, noise_sd=noise_sd), []
    for k, taxels in enumerate(scene.frames):
        subset = k % len(subsets)
        forces = solver.solve(subsets[subset].forward(taxels[scene.mask]), subset)
        assert solver.error is not None
        found.append(Stated(forces, solver.model, solver.trusted, solver.error))
    return found


class Distances(NamedTuple):
    """Models of the frames; distance of their forces, in the norm of the largest frame of the
    stream, and of their estimated errors, relative: 0 / 0 is 0, and others / 0 are infinite.
    """

    models: list[str]
    forces: list[float]
    errors: list[float]

    def most(self, model: str) -> float:
        """Largest distance of forces by this model."""
        pairs = zip(self.models, self.forces, strict=True)
        return max([distance for found, distance in pairs if found == model], default=0.0)


def distances(name: str, rows: str, fast: str, noise_sd: float = 0.0) -> Distances:
    """Reconstruct a stream; model and trust have to be the reference's in all of its frames."""
    if fast == "on":
        pytest.importorskip("numba")
    scene, wanted = SCENES[name](), stated(name, rows, noise_sd)
    subsets = subsets_of(scene, rows)
    basis = make_basis("haar", *scene.mask.shape)
    solver, found = SkinSolver(subsets[0], basis, scene.mask, fast=fast), Distances([], [], [])
    solver.noise_sd = noise_sd
    largest = max(float(np.linalg.norm(frame.forces)) for frame in wanted)
    for k, (taxels, frame) in enumerate(zip(scene.frames, wanted, strict=True)):
        phi = subsets[k % len(subsets)]
        solver.use(phi)
        forces = solver.solve(phi.forward(taxels[scene.mask]))
        assert (k, solver.model, solver.trusted) == (k, frame.model, frame.trusted)
        assert solver.error is not None
        found.models.append(frame.model)
        found.forces.append(float(np.linalg.norm(forces - frame.forces)) / largest)
        if frame.error:
            found.errors.append(abs(solver.error / frame.error - 1))
        else:  # no residual beyond the noise
            found.errors.append(math.inf if solver.error else 0.0)
    return found


@pytest.mark.parametrize("noise_sd", [0.0, 0.03])
def test_while_haar_alone_is_used_the_forces_differ_by_rounding(
    rows: str, fast: str, noise_sd: float
) -> None:
    found = distances("still plate", rows, fast, noise_sd)
    assert set(found.models) == {HAAR}
    assert max(found.forces) < 1e-4
    assert max(found.errors) < 1e-4


@pytest.mark.parametrize("name", ["small", "line", "small, N/8"])
def test_small_skins_differ_by_rounding(name: str, rows: str, fast: str) -> None:
    """Both forms solve the smooth model by the inverse. Of some row subsets Phi 1 is 0."""
    found = distances(name, rows, fast)
    assert set(found.models) == {SMOOTH}
    assert max(found.forces) < 1e-5
    assert max(found.errors) < 1e-4


@pytest.mark.parametrize("name", ["plate", "wrench", "fingertips, holes", "box"])
def test_sharp_contacts_are_those_of_the_reference(name: str, rows: str, fast: str) -> None:
    """Some frames begin from one of the smooth model, whose conjugate gradients end at 0.1 % of
    their right side: its forces are some 0.1 % of the reference's. In a frame or two, the error of
    some held-out measurements, less the noise, is a small difference.
    """
    found = distances(name, rows, fast)
    assert found.models.count(HAAR) > 3
    assert found.most(HAAR) < 2e-3
    assert found.most(SMOOTH) < 2e-2
    assert sorted(found.errors)[-3] < 0.1
    assert max(found.errors) < 0.5


@pytest.mark.parametrize("name", ["dense", "dense, errors"])
def test_dense_smooth_presses_are_those_of_the_reference(name: str, rows: str, fast: str) -> None:
    found = distances(name, rows, fast)
    assert found.models.count(SMOOTH) > 5
    assert max(found.forces) < 5e-2
    assert np.median(found.errors) < 0.05
    assert max(found.errors) < 0.3


def test_fewer_measurements_than_a_comparison_needs_give_the_smooth_model(
    rows: str, fast: str
) -> None:
    """Of 90 measurements of 720 taxels some are held out, and no two models are compared."""
    found = distances("few of many", rows, fast)
    assert set(found.models) == {SMOOTH}
    assert max(found.forces) < 5e-2
    assert max(found.errors) < 0.3
