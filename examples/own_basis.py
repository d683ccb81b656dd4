"""A basis of your own: the cosine transform of blocks of 8 x 8 taxels.

python examples/own_basis.py

In a launch file: basis = "own_basis:BlockCosine" for the reconstructor.
"""

import numpy as np
from scipy.fft import dctn, idctn

import sparseskin
from sparseskin.nodes.reconstructor.bases.base import Basis

SIDE = 8


class BlockCosine(Basis):
    """Orthonormal cosine transform of each block of 8 x 8 taxels; sides are multiples of 8."""

    def _blocks(self, flat):
        rows = self.n_rows // SIDE
        cols = self.n_cols // SIDE
        return flat.reshape(rows, SIDE, cols, SIDE)

    def _analysis(self, image, out):
        self._blocks(out)[:] = dctn(self._blocks(image), axes=(1, 3), norm="ortho")

    def _synthesis(self, coefficients, out):
        self._blocks(out)[:] = idctn(
            self._blocks(coefficients), axes=(1, 3), norm="ortho"
        )


def main() -> None:
    rows, cols = np.mgrid[0:40, 0:40]
    smooth = np.exp(-((rows - 18.0) ** 2 + (cols - 22.0) ** 2) / 50).astype(np.float32)
    phi = sparseskin.make_phi(
        "sbhe",
        n=1600,
        m=533,
        seed=0,
    )
    measurements = sparseskin.compress(smooth, phi, rows="fixed")
    for name in ("haar", "own_basis:BlockCosine"):
        basis = sparseskin.make_basis(name, 40, 40)
        sparseskin.check_basis(basis)
        solver = sparseskin.make_solver(
            "fista", phi, basis, iterations=100, rows="fixed"
        )
        reconstructed = sparseskin.reconstruct(measurements, solver)
        print(f"{name}: {sparseskin.psnr_db(reconstructed, smooth):.1f} dB")


if __name__ == "__main__":
    main()
