"""Streams of measurements for the tests of the batch solver, and what solvers make of them."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.compressor.phi.rotation import m_of, row_subsets
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.batch.solver import BatchFrame, BatchSolver
from sparseskin.nodes.reconstructor.skin.evidence import SMOOTH
from sparseskin.nodes.reconstructor.skin.solver import SkinSolver
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes.presses import press_frames


class Stream(NamedTuple):
    """Measurements of one patch, each frame by the next of `phis`, and its true forces, newtons."""

    phis: list[Phi]
    mask: Mask
    y: list[Floats]
    truth: list[Floats]


@cache
def stream(
    body: str,
    ratio: int,
    rows: str,
    *,
    shape: tuple[int, int] = (32, 32),
    n_frames: int = 40,
    seed: int = 0,
    active: float = 0.1,
    course: str = "moving",
    holes: bool = False,
) -> Stream:
    """Noisy measurements of a press; the first 10 frames are untouched."""
    mask = np.ones(shape, dtype=np.bool_)
    if holes:
        mask[:4, :7] = False
        mask[12, 8] = False
    noise = NoiseModel.for_range(2.5)
    options = {"active": active, "course": course, "mask": mask, "noise": noise}
    frames = list(press_frames(body, shape, n_frames, seed, **options))  # type: ignore[arg-type]
    n = int(mask.sum())
    phis = row_subsets(make_phi("sbhe", n, m_of(n, ratio), 0), rows)
    y = [
        phis[k % len(phis)].forward(readings.reshape(shape)[mask].astype(np.float32)).copy()
        for k, (_, readings) in enumerate(frames)
    ]
    return Stream(phis, mask, y, [truth.reshape(shape) for truth, _ in frames])


class Solved(NamedTuple):
    """Results of a patch: forces, float32 (n_frames, n_rows, n_cols), newtons; and of each frame
    the iterations of Haar, 1 if the estimate is smooth, and 1 if it is trusted, int (n_frames, 3);
    estimated errors, newtons."""

    forces: Floats
    decisions: npt.NDArray[np.int64]
    errors: npt.NDArray[np.float64]


def one_by_one(known: Stream) -> Solved:
    """Solve a stream by `SkinSolver`; iterations are 0: it does not publish those of Haar."""
    solver = SkinSolver(known.phis[0], make_basis("haar", *known.mask.shape), known.mask)
    forces, decisions, errors = [], [], []
    for k, y in enumerate(known.y):
        solver.use(known.phis[k % len(known.phis)])
        forces.append(solver.solve(y).copy())
        decisions.append((0, solver.model == SMOOTH, solver.trusted))
        errors.append(np.nan if solver.error is None else solver.error)
    return Solved(np.array(forces), np.array(decisions, dtype=np.int64), np.array(errors))


def batched(streams: list[Stream], device: str = "numpy", mode: str = "fused") -> list[Solved]:
    """Solve streams of the same rows in one batch."""
    phis, mask = streams[0].phis, streams[0].mask
    solver = BatchSolver(phis, mask, len(streams), device=device, mode=mode)
    frames = [
        copied(solver.solve(np.array(y), phis[k % len(phis)]))
        for k, y in enumerate(zip(*(one.y for one in streams), strict=True))
    ]
    return [
        Solved(
            np.array([frame.forces[place] for frame in frames]),
            np.array([[f.n_steps[place], f.is_smooth[place], f.trusted[place]] for f in frames]),
            np.array([frame.error[place] for frame in frames]),
        )
        for place in range(len(streams))
    ]


def copied(frame: BatchFrame) -> BatchFrame:
    """A copy: on a GPU, a frame is valid until the next one."""
    return BatchFrame(**{name: array.copy() for name, array in vars(frame).items()})
