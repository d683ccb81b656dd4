"""Interface of the work on vectors of the default solver, which has a numpy and a compiled form."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

from sparseskin.nodes.numerics.arrays import TINY, Floats
from sparseskin.nodes.sensor.noise import NoiseModel

from .prediction import Motion, MotionSums
from .row_subset import Comparison, RowSubset

UNKNOWN = 1e34
"""Variance of a row that was not read yet, beyond that of any measurement."""

CLEAR_RATIO = 1e4
"""Squared change of a measurement, as a multiple of the one of which half is doubted, beyond which
a larger change does not count: its power stays finite."""
CERTAIN = 1e-6
"""Least part of a measurement that is not doubted: its variance stays finite."""

NEGLIGIBLE = 1e-3
"""Length of a correction, as a multiple of that of the innovation, which shows no direction."""


class Innovation(NamedTuple):
    """Sums over the rows read: of their innovation, and of the correction by the last frame; and
    over those of them that were read before: of what their filters had not expected.

    Noise is what the last innovation of the row subset exceeds this one by, but for the part that
    the change of the prediction between them explains: an estimate that converges lowers the
    innovation, too. The noise of either frame is its product with the innovation of that frame; the
    mean of both counts, by the precision of each.
    """

    squares: float
    correction_squares: float
    products: float  # of innovation and correction
    noise_squares: (
        float  # squared noise that this and the last innovation of the rows show
    )
    n_known: int  # rows read before
    filter_squares: float  # squared innovation of the filters
    filter_variances: float  # variance of the filters' means
    n_read: int

    @property
    def mean_square(self) -> float:
        return self.squares / self.n_read

    @property
    def correlation(self) -> float:
        """Of the innovation with the last correction, -1 to 1."""
        correction2 = self.correction_squares + NEGLIGIBLE**2 * self.squares
        return self.products / math.sqrt(self.squares * correction2 + TINY)


class RowVariances(NamedTuple):
    """Variances by which the rows of a frame are filtered."""

    noise: float  # of a measurement
    prediction: float  # of the prediction of a row
    change: float  # of what has changed in a row since the last frame
    floor: float  # least variance


class Filtered(NamedTuple):
    """Numbers of the targets and filters of a frame."""

    target_variance: float  # mean variance of the targets of the rows read
    n_known: int  # rows read so far


CONVERGED = 8
"""Steps of a frame that need no others before them."""
N_FORMULA = 3
"""Steps by the formula before fewer than `CONVERGED`. Measured on five recordings and on presses at
N/3: 3 and 1 have less error than 3 alone, in less time."""
FORMULA_SHARE = 4
"""Part of the time of a tile that a step by the formula takes for it, as a divisor. Measured."""


class StepTimes(NamedTuple):
    """Time that the steps of a frame may take, counted in that of a tile in a step of the gates; 0:
    the number of steps does not depend on the tiles.
    """

    frame: int = 0  # of all steps
    step: int = 0  # of a step without any tile


class StepPlan(NamedTuple):
    """Steps of a frame. Where `frame_tiles` is not 0, `steps_for` chooses them in the first one."""

    n_formula: int  # steps by the formula, which come first
    n: int  # steps by the weights; the least where they are chosen
    first_shift: int  # number of the shift of the first step
    frame_tiles: int  # time of the steps of a frame; 1 is that of a tile in a step
    step_tiles: int  # time of a step without any tile, in the same unit
    most: int  # largest number of steps that is chosen
    target_variance: float  # as of `Filtered`
    floor: float  # least variance


def steps_for(plan: StepPlan, n_busy: int) -> StepPlan:
    """The plan of a frame in whose first step n_busy tiles stand out of the noise: as many steps as
    fit into its time, if as many tiles take part in each of them.

    Times are counted, not measured: a frame gets the same number on any host.
    """
    if plan.frame_tiles == 0:
        return plan
    per_step = plan.step_tiles + n_busy
    n_formula = 0
    n = min(plan.frame_tiles // per_step, plan.most)
    if n < CONVERGED:
        n_formula = N_FORMULA
        by_formula = plan.step_tiles + n_busy // FORMULA_SHARE
        n = (plan.frame_tiles - n_formula * by_formula) // per_step
        n = min(n, CONVERGED - 1, plan.most)
    return plan if n < plan.n else plan._replace(n_formula=n_formula, n=n)


class Steps(NamedTuple):
    """Means over the steps of a frame, weighted as their estimates are; and their numbers."""

    expected2: float  # squared error that the denoiser expects
    residual2: float  # squared residual of the rows read, before the step
    n_formula: int = 0  # steps by the formula
    n: int = 0  # steps by the weights
    n_tiles: int = 0  # tiles of all steps; those by the formula count as a part


class Blend(NamedTuple):
    """How the estimate of a frame and its forces are made."""

    part: float  # weight of the prediction
    bias: float  # mean reading of an untouched taxel
    noise_sd: float  # noise of an untouched taxel
    least_force: float  # smaller forces are returned as 0


class Settled(NamedTuple):
    """The forces of a frame, float32 (n,), and sums that tell how its estimate x fits."""

    forces: Floats
    power: float  # mean square of x
    residual2: float  # mean square of the residual
    left_out2: (
        float  # that of the part of the steps in x, each row left out of its own value
    )
    along_x: float  # product of W x and the residual of x, each row left out of its own value
    read2: float  # squared length of W x in the rows read
    along_ones: float  # product of the residual and Phi 1
    unpressed: float  # sum of x over taxels within the noise
    pressed: float  # part of the taxels beyond it


class Vectors(ABC):
    """The work on vectors of `SkinEstimator`, whose docstring states the method.

    A frame calls `begin`, `predict`, `filter_rows`, `steps` (or none), `fade` and `settle`, in this
    order.
    All vectors are float32.

    Attributes
    ----------
    x, x_rows : ndarray, shape (n,), (n_rows,)
        The last estimate, and W x.
    doubt : ndarray, shape (n_read,)
        Part of each value of the rows read that no force explains, 0 to 1; set by `begin`.
    innovation : ndarray, shape (n_read,)
        Values of the rows read less those predicted, without what is doubted; set by `predict`.
    predicted : ndarray, shape (n_read,)
        Values predicted of the rows read; set by `predict`.
    residual : ndarray, shape (n_read,)
        Values of the rows read less W x of the estimate, without what is doubted; set by `settle`.
    """

    x: Floats
    x_rows: Floats
    doubt: Floats
    innovation: Floats
    predicted: Floats
    residual: Floats

    @abstractmethod
    def forget(self) -> None:
        """Begin anew: nothing presses, and no row was read."""

    @abstractmethod
    def forget_rows(self) -> None:
        """Keep the estimate alone: the rows are those of another W."""

    @abstractmethod
    def start_from(self, x: Floats) -> None:
        """Take x, float32 (n,), for the last estimate."""

    @abstractmethod
    def begin(
        self, y: Floats, subset: RowSubset, bias: float, noise: float
    ) -> tuple[Comparison, MotionSums]:
        """Begin a frame of measurements y, float32 (m,), of a row subset, whose noise variance was
        `noise`: subtract the bias, and doubt those that no force explains.

        All rows of a block but its sum add its taxels with random signs: a change of forces moves
        all of them alike. So a squared change is compared with the mean of the others in its block,
        but for the largest, which may be faulty, too.
        """

    @abstractmethod
    def predict(self, motion: Motion) -> Innovation:
        """Predict the frame from the last estimate."""

    @abstractmethod
    def filter_rows(self, variances: RowVariances) -> Filtered:
        """Set the targets of all rows and their variances; process the values of the rows read."""

    @abstractmethod
    def steps(self, plan: StepPlan) -> Steps:
        """Iterate from the prediction; keep a mean of the estimates."""

    @abstractmethod
    def fade(self, part: float) -> None:
        """Subtract a part of prediction and estimate of the frame: 1 where nothing presses. What
        was measured, as the innovation, stays: it shows how far the prediction was off.
        """

    @abstractmethod
    def settle(self, blend: Blend, ones: Floats) -> Settled:
        """Take the mean of the estimates and the prediction for x; ones, float32 (n_read,), is
        Phi 1.

        Readings of mean bias + u are of the force u + bias (1 - exp(-u / bias)), which is not
        clipped as often.
        """

    @abstractmethod
    def mean_variance(self, forces: Floats, model: NoiseModel) -> float:
        """Mean over the taxels of the variance of the readings of forces, float32 (n,)."""
