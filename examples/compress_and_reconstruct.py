"""Compress one frame to a third of its numbers and reconstruct it.

python examples/compress_and_reconstruct.py
"""

import numpy as np

import sparseskin


def main() -> None:
    forces = np.zeros((40, 40), np.float32)
    forces[12:20, 8:24] = 0.6  # a rectangular contact, newtons per taxel

    phi = sparseskin.make_phi(
        "sbhe",
        n=1600,
        m=533,
        seed=0,
    )
    basis = sparseskin.make_basis("haar", 40, 40)
    solver = sparseskin.make_solver("fista", phi, basis, iterations=30, rows="fixed")

    measurements = sparseskin.compress(forces, phi, rows="fixed")
    reconstructed = sparseskin.reconstruct(measurements, solver)
    quality = sparseskin.psnr_db(reconstructed, forces)
    print(
        f"{forces.size} taxels, {measurements.size} measurements, PSNR {quality:.1f} dB"
    )


if __name__ == "__main__":
    main()
