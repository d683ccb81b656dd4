"""Adaptive rows: in each frame those of W are measured that changed most since they were read.

Method and symbols: docs/explanation/adaptive.md. `AdaptivePhi` is the measurement matrix of a
frame's choice, which travels with the measurements as a few bits a node of the quad tree;
`AdaptiveChoice` chooses at the edge, from what was measured; `HeldRows` is what both ends know: the
last measurement of every row.
"""

from collections.abc import Callable
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.messages.state import CLIP_SD
from sparseskin.nodes.compressor.phi.base import BLOCK, Code, Phi, fingerprint_of
from sparseskin.nodes.errors import PhiError
from sparseskin.nodes.numerics.arrays import TINY, Doubles, Floats, Indices, Mask

from .quadtree import N_DETAILS, Quadtree

CLIP_MEAN = 0.399
"""Mean of an untouched taxel's noise clipped at 0, in standard deviations of the noise. Derived: of
max(0, z), z normal."""
UNTOUCHED_SIGMAS = 3.0
"""Standard deviations of its noise up to which the sum of a node is that of untouched taxels.
Chosen: 2 to 4 make no difference on presses on 40 x 40 taxels."""
UNTOUCHED_FRACTION = 1e-5
"""The same in parts of f_max where no noise is stated. Chosen: above the rounding of float32."""
MOST_SCALED = 1.5
"""Largest factor by which details grow with the sum of their node. Chosen."""

N_ROUNDS = 6
"""Rounds of reading a frame, each decided from those before it. Fitted on five recordings of real
skins: 3 are worse, 12 hardly better."""
SUM_CHANGE = 0.5
"""Expected squared change of a node's details, in that of its sum. Fitted on the same recordings:
0.25 is worse, 1 no better."""
DRIFT_MEMORY = 0.5
"""Weight of the past in a node's squared change a frame, when it is read. Chosen."""
OLDEST_PART = 0.125
"""Part of the measurements beyond the sums that goes to the nodes which were read longest ago, so
that every row is read in a bounded number of frames. Fitted on the same recordings: without it the
error is up to 1.9 % of the force larger."""
UNTOUCHED_HASTE = 0.125
"""Age of an untouched node in that of another one, where the oldest are read. Chosen."""

Read = Callable[[Indices], npt.NDArray[np.floating]]


class AdaptivePhi(Phi):
    """Phi = Q W of this frame: m rows of a quad tree's W, set by `choose` for each frame; before
    the first choice the first m. `lay_out` states the grid; before that, the taxels are in a line.
    The fingerprint is of n, m and the grid: the choice has to travel with the measurements. Raises
    PhiError also if m is less than 4, a sum and the details of a node.

    `tree` is W, of which the `rows`, intp (m,), ascending, are measured: all details of the nodes
    `chosen`, bool (n_nodes,). `bias` and `untouched` are the mean reading of an untouched taxel,
    and the normalised sum up to which a node counts as untouched, in the unit of the forces.
    """

    kind = "adaptive"
    choice = "nodes"
    solvers = MappingProxyType({"skin": f"{__package__}.solver:AdaptiveSkinSolver"})

    def __init__(self, n: int, m: int, seed: int, block: int = BLOCK) -> None:
        super().__init__(n, m, seed, block)
        self.exists: Mask | None = None
        self._edge: AdaptiveChoice | None = None
        self._arrange(np.ones((1, n), dtype=np.bool_))
        self.state_noise(0.0, PAPER_F_MAX_N)

    @classmethod
    def check_size(cls, n: int, m: int, seed: int, block: int) -> None:
        super().check_size(n, m, seed, block)
        m_min = min(n, 1 + N_DETAILS)
        if m < m_min:
            allowed = f"{m_min}..{n} (n = {n} taxels)"
            raise PhiError(
                f'phi "adaptive": m = {m} is not allowed; allowed: {allowed}'
            )

    def _lay_out(self, exists: Mask) -> None:
        # The same skin again keeps what was measured of it.
        if self.exists is None or not np.array_equal(self.exists, exists):
            self.exists = exists.copy()
            self._arrange(self.exists)

    def _arrange(self, exists: Mask) -> None:
        self.tree = Quadtree(exists, self.m)
        grid = (np.array(exists.shape, dtype=np.intp), np.flatnonzero(exists))
        self.fingerprint = fingerprint_of(self.kind, self.n, self.m, 1, *grid)
        self.rows: Indices = np.arange(self.m)
        self.chosen: Mask = np.zeros(self.tree.n_nodes, dtype=np.bool_)
        self.forget()

    def state_noise(self, sigma_end: float, f_max: float, clipped: bool = True) -> None:
        self.bias = 0.0
        sd = sigma_end
        if clipped:
            self.bias = CLIP_MEAN * sigma_end
            sd = CLIP_SD * sigma_end
        self.variance = sd**2
        self.untouched = max(UNTOUCHED_SIGMAS * sd, UNTOUCHED_FRACTION * f_max)
        self.forget()

    def measure(self, x: Floats) -> tuple[Floats, Code]:
        if self._edge is None:
            self._edge = AdaptiveChoice(self)
        y = self._edge.measure(self.tree.analysis(x).take)
        return y, self.tree.coded(self.chosen)

    def follow(self, code: Code) -> None:
        try:
            nodes = self.tree.decoded(code)
        except ValueError as cause:
            raise PhiError(
                f"adaptive: the code of the nodes is malformed: {cause}"
            ) from cause
        self.choose(nodes)

    def forget(self) -> None:
        self._edge = None

    @property
    def most_code_bytes(self) -> int:
        return self.tree.most_code_bytes(self.m - self.tree.n_tiles)

    def choose(self, chosen: Mask) -> None:
        """Set the nodes of a frame, bool (n_nodes,). Measured are the sums of all tiles, the
        details of these nodes, and the first rows of W that are not among them, up to m. Raises
        PhiError if these nodes have more than m measurements, or more than two fewer.
        """
        tree = self.tree
        measured = np.ones(self.n, dtype=np.bool_)
        measured[tree.n_tiles :] = chosen[tree.node_of_row[tree.n_tiles :]]
        n_measured = int(np.count_nonzero(measured))
        # A node has three details at most: fewer than these may be left over.
        n_missing = self.m - n_measured
        if not 0 <= n_missing < N_DETAILS:
            raise PhiError(
                f"adaptive: nodes of {n_measured} measurements are chosen; expected m "
                f"= {self.m}"
            )

        measured[np.flatnonzero(~measured)[:n_missing]] = True
        self.chosen = chosen
        self.rows = np.flatnonzero(measured)

    def dense(self) -> Doubles:
        """As of `Phi`, in float64 throughout."""
        unit_rows = np.eye(self.n)[self.rows]
        return np.array([self.tree.synthesis(row) for row in unit_rows])

    def _forward(self, x: Floats, out: Floats) -> None:
        out[:] = self.tree.analysis(x)[self.rows]

    def _adjoint(self, y: Floats, out: Floats) -> None:
        rows = np.zeros(self.n)
        rows[self.rows] = y
        out[:] = self.tree.synthesis(rows)


class HeldRows:
    """The last measurement of every row of W, and the forces that they make.

    Details that were not read again scale with the sum of their node: a contact that presses
    harder keeps its shape. Those of an untouched node are 0, because forces are not negative.

    `sums` and `sums_read`, float64 (n_nodes,), are the normalised sum of each node in this frame,
    and when its details were read, 0 before that; `now` and `details`, (n_nodes, 3), its details in
    this frame, and as they were read; `age` and `drift`, (n_nodes,), the frames since then, and the
    squared change of its details a frame.
    """

    def __init__(self, phi: AdaptivePhi) -> None:
        self._phi = phi
        self._tree = phi.tree
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        n_nodes = self._tree.n_nodes
        self._tiles = np.zeros(self._tree.n_tiles)
        self.sums = np.zeros(n_nodes)
        self.sums_read = np.zeros(n_nodes)
        self.now = np.zeros((n_nodes, N_DETAILS))
        self.details = np.zeros((n_nodes, N_DETAILS))
        self.age = np.zeros(n_nodes)
        self.drift = np.zeros(n_nodes)
        self.begin()

    def begin(self) -> None:
        """Begin a frame, of which no row is read."""
        self._fresh = np.zeros((self._tree.n_nodes, N_DETAILS), dtype=np.bool_)
        self._read = np.zeros((self._tree.n_nodes, N_DETAILS))

    def read(self, rows: Indices, values: npt.NDArray[np.floating]) -> None:
        """Process measurements of rows of W, (k,)."""
        tree = self._tree
        is_tile = rows < tree.n_tiles
        tiles = rows[is_tile]
        bias: float | Doubles = self._phi.bias
        # The sum of k taxels is normalised by sqrt(k), that of their means too.
        if tree.levels:
            bias = bias * np.sqrt(tree.n_taxels[tiles])
        self._tiles[tiles] = np.maximum(values[is_tile] - bias, 0)

        places = tree.place_of_row[rows[~is_tile]]
        self._read.reshape(-1)[places] = values[~is_tile]
        self._fresh.reshape(-1)[places] = True

    def update(self) -> Doubles:
        """Return the forces of the taxels, float64 (n,), which may be negative."""
        for level, sums, details in self._tree.descend(self._tiles):
            nodes = slice(level.first, level.first + level.size)
            self.sums[nodes] = sums

            # Details that are not read again grow with the sum of their node.
            growth = sums / np.maximum(self.sums_read[nodes], TINY)
            scale = np.clip(growth, 0, MOST_SCALED)
            scaled = self.details[nodes] * scale[:, None]
            details[:] = np.where(self._fresh[nodes], self._read[nodes], scaled)
            self.now[nodes] = details
        if not self._tree.levels:
            return self._tiles
        return self._tree.forces

    def changed2(self) -> Doubles:
        """Return the squared change of each node's details that its sum lets expect, (n_nodes,)."""
        # Both sums have noise, which is no change.
        change2 = np.square(self.sums - self.sums_read) - 2 * self._phi.variance
        return SUM_CHANGE * np.maximum(change2, 0)

    def learn(self, nodes: Indices | Mask, predicted: Doubles) -> Doubles:
        """Learn the drift of nodes that were read, from their predicted details, (k, 3); return
        their squared change, (k,).
        """
        # Noise of both readings is not a change.
        noise = 2 * self._phi.variance * self._tree.n_details[nodes]
        change = self._read[nodes] - predicted
        change2: Doubles = np.square(change).sum(axis=1)
        change2 = np.maximum(change2 - noise, 0)

        drift = self.drift[nodes]
        newest = change2 / self.age[nodes]
        self.drift[nodes] = DRIFT_MEMORY * drift + (1 - DRIFT_MEMORY) * newest
        self.age[nodes] = 0
        return change2

    def end(self) -> Mask:
        """End a frame, of which all rows are read; return which nodes are untouched. What was read
        of a part of a node's details is not kept.
        """
        n_read = np.count_nonzero(self._fresh, axis=1)
        whole = n_read == self._tree.n_details
        self.details[whole] = self.now[whole]
        self.sums_read[whole] = self.sums[whole]

        # Forces are not negative: all details of an untouched node are 0.
        untouched: Mask = (self.sums <= self._phi.untouched) & ~whole
        self.details[untouched] = 0
        self.sums_read[untouched] = 0
        return untouched


class AdaptiveChoice:
    """Chooses and reads m rows of a frame, at the edge, from what it has measured. Phi, whose
    `choose` is called in each frame, is laid out and its noise stated.
    """

    def __init__(self, phi: AdaptivePhi) -> None:
        self._phi = phi
        self._held = HeldRows(phi)
        #: Measurements that are due to the nodes which were read longest ago.
        self._owed = 0.0
        self._untouched = np.zeros(phi.tree.n_nodes, dtype=np.bool_)

    def measure(self, read: Read) -> Floats:
        """Choose and read a frame by `read`, of rows of W; return its measurements, float32 (m,),
        in the order of `rows`.
        """
        phi = self._phi
        tree = phi.tree
        rows = self._held
        rows.age += 1
        self._values = np.zeros(phi.n)
        is_chosen = np.zeros(tree.n_nodes, dtype=np.bool_)

        # The sums of all tiles.
        rows.begin()
        self._take(np.arange(min(tree.n_tiles, phi.m)), read)
        n_left = phi.m - tree.n_tiles

        # The nodes that are expected to have changed most, in rounds.
        self._owed = min(self._owed + OLDEST_PART * n_left, n_left)
        n_oldest = int(self._owed)
        for n_rounds in range(N_ROUNDS, 0, -1):
            rows.update()
            expected2 = rows.changed2() + rows.drift * rows.age
            n_round = (n_left - n_oldest) // n_rounds
            n_left -= self._read_most(expected2, n_round, is_chosen, read)

        # Those that were read longest ago.
        ages = rows.age * np.where(self._untouched, UNTOUCHED_HASTE, 1.0)
        while n_left >= N_DETAILS:
            n_read = self._read_most(ages, n_left, is_chosen, read)
            n_left -= n_read
            self._owed = max(0.0, self._owed - n_read)

        # One or two rows of other nodes, up to m.
        phi.choose(is_chosen)
        details = phi.rows[phi.rows >= tree.n_tiles]
        is_of_chosen = is_chosen[tree.node_of_row[details]]
        self._take(details[~is_of_chosen], read)
        rows.update()

        self._untouched = rows.end()
        rows.drift[self._untouched] *= DRIFT_MEMORY
        return self._values[phi.rows].astype(np.float32)

    def _read_most(self, score: Doubles, n_most: int, chosen: Mask, read: Read) -> int:
        """Read the unread nodes of highest score a measurement, above 0; return their rows."""
        tree = self._phi.tree
        score_per_row = np.where(chosen, 0, score) / np.maximum(tree.n_details, 1)
        order = np.argsort(-score_per_row, kind="stable")
        is_worth = (score_per_row[order] > TINY) & (tree.n_details[order] > 0)
        order = order[is_worth]

        ends = np.cumsum(tree.n_details[order])
        nodes = order[: np.searchsorted(ends, n_most, "right")]
        if not nodes.size:
            return 0

        chosen[nodes] = True
        predicted = self._held.now[nodes].copy()

        # All rows of these nodes, ascending.
        is_chosen = np.zeros_like(chosen)
        is_chosen[nodes] = True
        node_of_detail = tree.node_of_row[tree.n_tiles :]
        rows = tree.n_tiles + np.flatnonzero(is_chosen[node_of_detail])
        self._take(rows, read)
        self._held.learn(nodes, predicted)
        return int(ends[nodes.size - 1])

    def _take(self, rows: Indices, read: Read) -> None:
        if rows.size:
            self._values[rows] = read(rows)
            self._held.read(rows, self._values[rows])
