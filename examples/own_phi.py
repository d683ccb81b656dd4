"""A measurement matrix of your own: each measurement is a signed sum of taxels chosen at random.

python examples/own_phi.py

In a launch file, for the compressor and the reconstructor alike (nothing on the wire is imported):
phi = "own_phi:RandomSums".
"""

import numpy as np
from scipy.sparse import csr_array

import sparseskin
from sparseskin.nodes.compressor.phi.base import Phi, fingerprint_of


class RandomSums(Phi):
    """m rows, each with `block` entries of +1 or -1 divided by sqrt(block), at random places."""

    kind = "own_phi:RandomSums"

    def __init__(self, n: int, m: int, seed: int, block: int = 32) -> None:
        super().__init__(n, m, seed, block)
        rng = np.random.default_rng(seed)
        places = np.concatenate([rng.permutation(n)[:block] for _ in range(m)])
        signs = rng.choice((-1.0, 1.0), size=places.size).astype(np.float32)
        rows = np.repeat(np.arange(m), places.size // m)
        self._matrix = csr_array(
            (signs / np.float32(block**0.5), (rows, places)), (m, n)
        )
        self._transpose = self._matrix.T.tocsr()
        self.fingerprint = fingerprint_of(self.kind, n, m, block, places, signs)
        self._lipschitz = float(np.linalg.norm(self.dense(), 2) ** 2)

    @property
    def lipschitz(self) -> float:
        """Largest eigenvalue of Phi Phi^T: the step size of a solver is its reciprocal."""
        return self._lipschitz

    def _forward(self, x, out):
        out[:] = self._matrix @ x

    def _adjoint(self, y, out):
        out[:] = self._transpose @ y


def main() -> None:
    truth, taxels = sparseskin.simulate("lift_box_40", 340)
    # The box lands at frame 320.
    truth = truth[-25:]
    taxels = taxels[-25:]
    basis = sparseskin.make_basis("haar", 40, 40)
    for kind in ("sbhe", "own_phi:RandomSums"):
        phi = sparseskin.make_phi(
            kind,
            n=1600,
            m=533,
            seed=0,
        )
        sparseskin.check_phi(phi)
        solver = sparseskin.make_solver("fista", phi, basis)
        reconstructed = sparseskin.reconstruct(sparseskin.compress(taxels, phi), solver)
        print(f"{kind}: {sparseskin.psnr_db(reconstructed[-1], truth[-1]):.1f} dB")


if __name__ == "__main__":
    main()
