"""Warm-up of slices of a recording: a pass that begins anew beside one that ran all the time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from bags import skin_state
from stress.graphs import FULL

from sparseskin.launch.offline.plan import LEAST_FRAMES, WARM_UP
from sparseskin.messages import Reconstruction, SkinState, Taxels
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.node import Context
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.faults.taxels import MEASURED
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.frames import first_contact, scene_frames

#: Warm-ups that are compared, frames.
WARM_UPS = (0, 8, 16, 32, 64, 128, 256, 512)
BEFORE = 100
"""Frames before the first contact of a scene. Chosen."""
#: Scenes, and every how many frames of them; small, and at full size.
SOURCES = (("path_40", 10),)
FULL_SOURCES = (
    *(("drag_wrench_40", 1), ("drag_wrench_40", 3), ("path_40", 1), ("path_40", 10)),
    *(("lift_wrench_40", 2), ("drag_wrench_64", 8)),
)


def seams(
    scene: str, every: int, ratio: int, n_frames: int, n_seams: int, longest: int
) -> dict[int, list[float]]:
    """Reconstruct frames in one pass, and again from some frames on; compare the frames of both.

    Returns by warm-up the RMS difference over the taxels at each seam, in standard deviations of
    the noise of an untouched taxel.
    """
    begin = max(0, first_contact(scene, 0) - BEFORE * every)
    frames = scene_frames(scene, 0, begin, begin + n_frames * every, every)
    taxels = np.array([readings for _, readings in frames])
    noise = NoiseModel.for_range(2.5)
    skin = skin_state(
        n_rows=taxels.shape[1],
        n_cols=taxels.shape[2],
        mask=None,
        sigma_mid=noise.sigma_mid,
        sigma_end=noise.sigma_end,
    )
    through = np.array(list(_reconstructed(skin, taxels, ratio)))
    n_subsets = int(np.ceil(ratio))
    firsts = np.linspace(n_subsets, n_frames - longest - 1, n_seams).astype(int)
    found: dict[int, list[float]] = {w: [] for w in WARM_UPS if w <= longest}
    for first in firsts - firsts % n_subsets:
        again = list(_reconstructed(skin, taxels[first : first + longest + 1], ratio))
        for w, values in found.items():
            values.append(_rms(again[w] - through[first + w]) / skin.sigma_end)
    return found


def _reconstructed(skin: SkinState, taxels: Floats, ratio: float) -> Iterator[Floats]:
    """The frames of a compressor and a reconstructor, as `reprocess` runs them."""
    clock = ManualClock(1)
    edge = Compressor(Compressor.Settings(ratio=ratio), Context("edge", clock, lambda line: None))
    host = Reconstructor(Reconstructor.Settings(), Context("host", clock, lambda line: None))
    (phi,) = edge.step(skin)
    for state in (skin, phi):
        list(host.step(state))
    for k, forces in enumerate(taxels):
        (measured,) = edge.step(Taxels(stamp_ns=k + 1, patch="skin", forces=forces))
        (made,) = (m for m in host.step(measured) if isinstance(m, Reconstruction))
        yield made.forces[0].copy()


def _rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(x, dtype=np.float64))))


@pytest.mark.parametrize("ratio", (3, 8) if FULL else (3,))
def test_differences_fall_with_the_warm_up(ratio: int, full: bool, note: Any) -> None:
    sizes = (1100, 24, 512) if full else (90, 2, 32)
    runs = [seams(*of, ratio, *sizes) for of in (FULL_SOURCES if full else SOURCES)]
    pooled = {w: np.concatenate([rms[w] for rms in runs]) for w in runs[0]}
    for name, values in pooled.items():
        median, most = (round(float(q), 3) for q in np.quantile(values, (0.5, 0.99)))
        below = float(np.mean(values < 0.1))
        note(**{"warm-up": name, "ratio": ratio, "median": median, "99 %": most}, below=below)
    if full:
        assert np.median(pooled[WARM_UP]) < 0.1
    else:
        assert max(pooled[32]) < 0.5 * min(pooled[0])


def test_the_warm_up_is_one_that_is_measured_and_longer_than_the_watch_for_taxels() -> None:
    assert WARM_UP in WARM_UPS
    assert WARM_UP > MEASURED
    assert LEAST_FRAMES >= 20 * WARM_UP
