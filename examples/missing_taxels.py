"""A skin that is no full rectangle: cells without a taxel are masked.

python examples/missing_taxels.py
"""

import numpy as np

import sparseskin


def main() -> None:
    rows, cols = np.mgrid[0:24, 0:24]
    mask = (rows - 11.5) ** 2 + (cols - 11.5) ** 2 < 12**2  # a round skin
    forces = np.where(mask & (rows > 14) & (cols > 8), 0.5, 0).astype(np.float32)

    n = int(mask.sum())
    phi = sparseskin.make_phi(
        "sbhe",
        n=n,
        m=n // 2,
        seed=0,
    )
    basis = sparseskin.make_basis("haar", 24, 24)
    solver = sparseskin.make_solver(
        "fista", phi, basis, mask, iterations=100, rows="fixed"
    )

    # Existing taxels alone are read.
    measurements = sparseskin.compress(forces, phi, mask, rows="fixed")
    reconstructed = sparseskin.reconstruct(measurements, solver)
    assert not reconstructed[~mask].any()
    quality = sparseskin.psnr_db(reconstructed[mask][None], forces[mask][None])
    print(f"{n} of {mask.size} cells are taxels; PSNR over them {quality:.1f} dB")


if __name__ == "__main__":
    main()
