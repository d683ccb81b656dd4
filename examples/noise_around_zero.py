"""A skin whose noise lies around 0: half of it clipped at 0, or kept.

python examples/noise_around_zero.py
"""

from itertools import islice

import numpy as np

import sparseskin
from sparseskin.nodes.sensor.calibration.chain import Chain
from sparseskin.nodes.sensor.calibration.description import SkinDescription
from sparseskin.nodes.sensor.scenes.scenes import open_scene

NOISE_N = 0.0141
FRAMES = slice(2000, 2150)


def main() -> None:
    scene = open_scene("drag_wrench_40", seed=0)
    truth = np.stack([forces for _, forces in islice(scene, FRAMES.start, FRAMES.stop)])
    raw = truth + np.random.default_rng(0).normal(0, NOISE_N, truth.shape)
    shape = truth.shape[1:]
    print("drag_wrench_40, 150 frames, N/3    PSNR dB    error of the total force %")
    for label, f_min in (("clipped at 0", 0.0), ("kept, f_min = -0.056 N", -0.056)):
        skin = SkinDescription("wrench", *shape, 2.5, noise=NOISE_N, f_min=f_min)
        chain = Chain(skin, drift_rate=0.0)
        taxels = np.stack([chain.apply(frame, k) for k, frame in enumerate(raw)])
        phi = sparseskin.make_phi(
            "sbhe",
            n=truth[0].size,
            m=truth[0].size // 3,
            seed=0,
        )
        basis = sparseskin.make_basis("haar", *shape)
        solver = sparseskin.make_solver("skin", phi, basis)
        measurements = sparseskin.compress(taxels, phi)
        maps = {
            "readings": taxels,
            "reconstruction": sparseskin.reconstruct(measurements, solver),
        }
        true_totals = truth.sum(axis=(1, 2))
        for name, forces in maps.items():
            psnr_db = np.mean(sparseskin.psnr_db(truth, forces, f_max=2.5))
            totals = forces.sum(axis=(1, 2))
            error = 100 * np.mean(np.abs(totals / true_totals - 1))
            print(f"{label + ', ' + name:<38}{psnr_db:>5.1f}{error:>12.1f}")


if __name__ == "__main__":
    main()
