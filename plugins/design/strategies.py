"""Ways to read a skin that a design compares: a measurement matrix, its ratio and its rows."""

from dataclasses import dataclass

from sparseskin.nodes.compressor.phi.rotation import FIXED, ROTATING, m_of

ANALOG = "analog"
DIGITAL = "digital"
SINGLE = "single"
"""Where the sums of a measurement are made: by amplifiers before the converter, M conversions a
frame; by the edge, from all N taxels; or nowhere, as each measurement is one taxel."""
LARGER = "larger"
"""Kind in place of a measurement matrix: fewer taxels, each as large as N / M of the others."""
COMMON_RATIO = 4.0
"""N / M of all kinds that are compared at one ratio. Chosen: the middle of those of SBHE."""


@dataclass(frozen=True)
class Strategy:
    """A way to read a skin: its name in words, as in tables and `STRATEGIES`; kind of the
    measurement matrix, as `make_phi` takes it, or `LARGER`; N / M, 1 or more; rows as of the
    compressor, "fixed" or "rotating"; where sums are made, if a design does not state it: see
    `ANALOG`.
    """

    name: str
    phi: str
    ratio: float
    rows: str
    sums: str

    @property
    def reads_single(self) -> bool:
        """True if each measurement is one taxel, with the bits of the converter."""
        return self.sums == SINGLE

    def m(self, n_taxels: int, n_rows: int | None = None) -> int:
        """Number of measurements M of a frame; of `row_local` a whole number of patterns of
        `n_rows` rows of the grid, one of all columns and one more at least.
        """
        m = max(1, m_of(n_taxels, self.ratio, self.rows))
        if self.phi == "row_local" and n_rows:
            m_min = min(2 * n_rows, n_taxels)
            m = min(n_taxels, max(m_min, m // n_rows * n_rows))
        return m


_ALL = (
    Strategy("all taxels", "full", 1.0, FIXED, SINGLE),
    # Single taxels, others in each frame.
    Strategy("N/4 taxels in turn", "subsample", COMMON_RATIO, ROTATING, SINGLE),
    # Fewer, larger taxels: each sums its neighbours by itself.
    Strategy("N/4 larger taxels", LARGER, COMMON_RATIO, FIXED, SINGLE),
    # Scrambled block Hadamard sums of all taxels.
    *(
        Strategy(f"N/{ratio} sums", "sbhe", float(ratio), ROTATING, DIGITAL)
        for ratio in (3, 4, 8, 16)
    ),
    # Binary patterns of columns, summed in each row; SBHE within 16 x 16 taxels.
    Strategy("N/4 sums of rows", "row_local", COMMON_RATIO, ROTATING, ANALOG),
    Strategy("N/4 sums of 16 x 16", "local:16", COMMON_RATIO, ROTATING, ANALOG),
    # Sums where forces changed, chosen in each frame.
    Strategy("N/4 adaptive sums", "adaptive", COMMON_RATIO, FIXED, DIGITAL),
)
STRATEGIES: dict[str, Strategy] = {strategy.name: strategy for strategy in _ALL}
"""Strategies by name, in the order of tables."""
FEW_SCENES = 5
N_SCENES = 15
"""Scenes that are simulated where their number is not stated, each body once; and all of them, each
body in each course. Chosen: all strategies in some 15 s on two cores."""
