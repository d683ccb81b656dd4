"""Seams between slices: a solver that begins anew beside one that ran all the time."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.messages import Reconstruction, SkinState, Taxels
from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.node import Context
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.real.recordings import part_of
from sparseskin.studies.scene_frames import first_contact, scene_frames

#: Warm-ups that are compared, frames.
WARM_UPS = (0, 8, 16, 32, 64, 128, 256, 512)
BEFORE = 100
"""Frames before the first contact of a scene. Chosen."""

Point = dict[str, Any]


def seams(point: Point) -> dict[str, Any]:
    """Reconstruct frames in one pass, and again from some frames on; compare the frames of both.

    Parameters
    ----------
    point : dict
        source: name of a scene, every k-th frame of which is used (every), or path of a recording;
        ratio: N / M; n_frames, n_seams, longest: frames of the pass, how often it is begun anew,
        and for how many frames then; seed.

    Returns
    -------
    dict
        sd: unit of the differences: the noise of an untouched taxel (scenes), or a hundredth of
        the RMS of the frames (recordings); rms: by warm-up the RMS difference over taxels of each
        seam, in sd; other: that of another pass with other random shifts, at the same frames.
    """
    skin, taxels = _frames(point)
    n_frames, longest, ratio = len(taxels), point["longest"], point["ratio"]
    through = np.array(list(_reconstructed(skin, taxels, ratio, 0)))
    other = np.array(list(_reconstructed(skin, taxels, ratio, 1)))
    n_subsets = int(np.ceil(ratio))
    firsts = np.linspace(n_subsets, n_frames - longest - 1, point["n_seams"]).astype(int)
    sd = skin.sigma_end or 0.01 * float(np.sqrt(np.mean(np.square(through))))
    warm_ups = [w for w in WARM_UPS if w <= longest]
    rms: dict[str, list[float]] = {str(w): [] for w in warm_ups}
    others: list[float] = []
    for first in firsts - firsts % n_subsets:
        part = list(_reconstructed(skin, taxels[first : first + longest + 1], ratio, 0))
        for w in warm_ups:
            k = first + w
            rms[str(w)].append(_rms(part[w] - through[k]) / sd)
            others.append(_rms(other[k] - through[k]) / sd)
    return {"sd": sd, "rms": rms, "other": others}


@cache
def _scene(source: str, every: int, n_frames: int, seed: int) -> Floats:
    first = max(0, first_contact(source, seed) - BEFORE * every)
    frames = scene_frames(source, seed, first, first + n_frames * every, every)
    return np.array([taxels for _, taxels in frames])


def _frames(point: Point) -> tuple[SkinState, Floats]:
    """Skin and readings of a point."""
    source = point["source"]
    sigma_mid, sigma_end, f_max, mask = 0.0, 0.0, 0.0, None
    if Path(source).suffix:
        part = part_of(source, point["n_frames"])
        taxels, mask = part.frames, part.skin.mask
        f_max = float(taxels.max())
    else:
        taxels = _scene(source, point["every"], point["n_frames"], point["seed"])
        f_max = PAPER_F_MAX_N
        noise = NoiseModel.for_range(f_max)
        sigma_mid, sigma_end = noise.sigma_mid, noise.sigma_end
    skin = SkinState(
        stamp_ns=0,
        patch="skin",
        n_rows=taxels.shape[1],
        n_cols=taxels.shape[2],
        f_max=f_max,
        unit="N",
        pitch_m=0.005,
        mask=mask,
        source=Path(source).stem,
        seed=point["seed"],
        rate_hz=100.0,
        has_truth=False,
        sigma_mid=sigma_mid,
        sigma_end=sigma_end,
    )
    return skin, taxels


def _reconstructed(skin: SkinState, taxels: Floats, ratio: float, seed: int) -> Iterator[Floats]:
    """The frames of a compressor and a reconstructor, as `reprocess` runs them."""
    clock = ManualClock(1)
    edge = Compressor(Compressor.Settings(ratio=ratio), Context("edge", clock, _quiet))
    settings = Reconstructor.Settings(options={"seed": seed})
    host = Reconstructor(settings, Context("host", clock, _quiet))
    (phi,) = edge.step(skin)
    for state in (skin, phi):
        list(host.step(state))
    for k, forces in enumerate(taxels):
        (measured,) = edge.step(Taxels(stamp_ns=k + 1, patch="skin", forces=forces))
        (made,) = (m for m in host.step(measured) if isinstance(m, Reconstruction))
        yield made.forces.copy()


def _quiet(line: str) -> None:
    """Discard a line of a node's log."""


def _rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(x, dtype=np.float64))))
