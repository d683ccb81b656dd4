"""The Haar basis with as many levels as a grid can be halved: three on 40 x 40."""

from __future__ import annotations

from sparseskin.nodes.reconstructor.bases.haar import SeparableBasis, level_matrix


class FewLevelsHaarBasis(SeparableBasis):
    """Orthonormal 2-D Haar of as many levels as both sides are even.

    The project's own Haar goes down to one approximation coefficient on a grid of any size.
    Many a library stops where a side gets odd: on 40 x 40 after three levels, with 5 x 5
    approximations left. With sides of a power of two the two are one basis.
    """

    def __init__(self, n_rows: int, n_cols: int) -> None:
        sides = n_rows | n_cols
        super().__init__(n_rows, n_cols, level_matrix, (sides & -sides).bit_length() - 1)
