"""The Haar basis with as many levels as a grid can be halved: three on 40 x 40."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import Basis


class FewLevelsHaarBasis(Basis):
    """Orthonormal 2-D Haar of as many levels as both sides are even.

    The project's own Haar goes down to one approximation coefficient on a grid of any size.
    Many a library stops where a side gets odd: on 40 x 40 after three levels, with 5 x 5
    approximations left. With sides of a power of two the two are one basis.
    """

    def __init__(self, n_rows: int, n_cols: int) -> None:
        super().__init__(n_rows, n_cols)
        self.shapes = [(n_rows, n_cols)]
        while not any(side % 2 for side in self.shapes[-1]):
            rows, cols = self.shapes[-1]
            self.shapes.append((rows // 2, cols // 2))

    def _analysis(self, image: Floats, out: Floats) -> None:
        np.copyto(out, image)
        pyramid = out.reshape(self.n_rows, self.n_cols)
        for rows, cols in self.shapes[:-1]:
            part = pyramid[:rows, :cols]
            low, high = (part[0::2] + part[1::2]) / 2, (part[0::2] - part[1::2]) / 2
            down, right = rows // 2, cols // 2
            part[:down, :right] = low[:, 0::2] + low[:, 1::2]
            part[:down, right:] = low[:, 0::2] - low[:, 1::2]
            part[down:, :right] = high[:, 0::2] + high[:, 1::2]
            part[down:, right:] = high[:, 0::2] - high[:, 1::2]

    def _synthesis(self, coefficients: Floats, out: Floats) -> None:
        np.copyto(out, coefficients)
        image = out.reshape(self.n_rows, self.n_cols)
        for rows, cols in reversed(self.shapes[:-1]):
            part = image[:rows, :cols]
            down, right = rows // 2, cols // 2
            both = np.empty_like(part)
            both[:, 0::2] = (part[:, :right] + part[:, right:]) / 2
            both[:, 1::2] = (part[:, :right] - part[:, right:]) / 2
            part[0::2] = both[:down] + both[down:]
            part[1::2] = both[:down] - both[down:]
