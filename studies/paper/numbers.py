"""The figures that the paper reports, its tables I to IV as numbers, and ours.

Source: Hollis, Patterson, Trinkle, "Compressed Sensing for Tactile Skins", 2016.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

RATIOS = (4, 3, 2)
ITERATIONS = (10, 20, 30)


class Psnr(NamedTuple):
    """PSNR over the frames of a scenario, in dB."""

    mean: float
    low: float
    high: float


class Counts(NamedTuple):
    """Coefficients that are not zero, over the frames of a scenario."""

    mean: float
    largest: int


class Scenario(NamedTuple):
    """One scenario in all tables: its name, and number of taxels."""

    title: str
    n: int
    # Table I.
    steps: int
    # Table II.
    d2: Counts
    d4: Counts
    # Tables III and IV.
    noisy: Psnr
    # For each of `RATIOS`, 30 iterations.
    third_table: tuple[Psnr, Psnr, Psnr]
    # Table IV, for each of `ITERATIONS`, M = N/3: least PSNR, mean time a frame.
    lows_db: tuple[float, float, float]
    times_ms: tuple[float, float, float]

    @property
    def by_ratio(self) -> dict[int, Psnr]:
        """Table III, by N/M."""
        return dict(zip(RATIOS, self.third_table, strict=True))

    @property
    def by_iterations(self) -> dict[int, Psnr]:
        """Table IV, by iterations, on which mean and upper end do not depend."""
        third = self.by_ratio[3]
        lows = zip(ITERATIONS, self.lows_db, strict=True)
        return {k: third._replace(low=low_db) for k, low_db in lows}

    @property
    def time_ms(self) -> dict[int, float]:
        """Table IV, mean time a frame, by iterations."""
        return dict(zip(ITERATIONS, self.times_ms, strict=True))


PAPER = {
    "lift_box_40": Scenario(
        title="LIFT BOX",
        n=1600,
        steps=700,
        d2=Counts(108.3, 266),
        d4=Counts(750.1, 1575),
        noisy=Psnr(46.5, 39.1, 48.7),
        third_table=(
            Psnr(52.8, 39.5, 63.2),
            Psnr(52.5, 40.9, 60.8),
            Psnr(52.1, 41.4, 57.6),
        ),
        lows_db=(37.0, 40.9, 40.9),
        times_ms=(10.8, 20.7, 30.9),
    ),
    "lift_wrench_40": Scenario(
        title="LIFT WRENCH",
        n=1600,
        steps=3000,
        d2=Counts(92.2, 388),
        d4=Counts(282.2, 1575),
        noisy=Psnr(47.2, 38.4, 48.8),
        third_table=(
            Psnr(52.1, 26.5, 62.3),
            Psnr(52.7, 31.1, 60.4),
            Psnr(52.6, 36.9, 58.0),
        ),
        lows_db=(26.7, 30.7, 31.1),
        times_ms=(10.6, 20.6, 30.1),
    ),
    "drag_wrench_40": Scenario(
        title="DRAG WRENCH",
        n=1600,
        steps=5000,
        d2=Counts(84.9, 449),
        d4=Counts(254.3, 1575),
        noisy=Psnr(46.4, 37.4, 48.7),
        third_table=(
            Psnr(44.7, 25.3, 61.9),
            Psnr(47.7, 28.5, 59.8),
            Psnr(48.9, 34.5, 58.0),
        ),
        lows_db=(26.3, 28.4, 28.5),
        times_ms=(10.7, 20.7, 28.1),
    ),
    "path_40": Scenario(
        title="PATH",
        n=1600,
        steps=12200,
        d2=Counts(30.3, 266),
        d4=Counts(139.8, 1575),
        noisy=Psnr(48.0, 44.8, 49.1),
        third_table=(
            Psnr(56.3, 45.4, 63.1),
            Psnr(55.9, 49.2, 60.7),
            Psnr(55.0, 50.3, 58.4),
        ),
        lows_db=(49.2, 49.1, 49.2),
        times_ms=(10.3, 18.1, 28.8),
    ),
    "lift_box_64": Scenario(
        title="LIFT BOX",
        n=4096,
        steps=7600,
        d2=Counts(189.8, 263),
        d4=Counts(929.1, 961),
        noisy=Psnr(46.8, 36.6, 48.5),
        third_table=(
            Psnr(49.8, 38.6, 54.9),
            Psnr(49.9, 39.0, 54.1),
            Psnr(50.2, 38.3, 53.6),
        ),
        lows_db=(32.1, 38.9, 39.0),
        times_ms=(8.1, 21.6, 25.1),
    ),
    "drag_wrench_64": Scenario(
        title="DRAG WRENCH",
        n=4096,
        steps=12600,
        d2=Counts(240.3, 670),
        d4=Counts(602.7, 1208),
        noisy=Psnr(46.4, 36.2, 48.3),
        third_table=(
            Psnr(45.4, 23.3, 54.8),
            Psnr(46.4, 29.8, 53.9),
            Psnr(48.3, 37.0, 53.2),
        ),
        lows_db=(23.1, 29.3, 29.8),
        times_ms=(8.0, 17.0, 31.7),
    ),
}

FITTED = "few levels, fitted lambda"
"""The method with 30 iterations, a Haar basis of few levels, and the lambda that fits the paper's
figures best. Others are named by their iterations."""
#: Highest PSNR of an untouched skin in dB, by (side, few levels, N / M), for each lambda.
Highest: TypeAlias = Mapping[tuple[int, bool, int], Sequence[float]]
Decibels: TypeAlias = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Results:
    """Figures of the study; `quick`: of frames around the first contact alone. By scene figures of
    `tables.scene_figures`; by (scene, N / M, method) PSNR of each frame, dB; by (scene, method)
    mean solve time of a frame at N/3.
    """

    quick: bool
    scenes: Mapping[str, Mapping[str, Any]]
    psnr: Mapping[tuple[str, float, str], Decibels]
    times_ms: Mapping[tuple[str, str], float]

    @staticmethod
    def name(scene: str) -> str:
        """Name of a scene in the tables."""
        return f"{PAPER[scene].title} ({PAPER[scene].n})"

    def contact(self, scene: str) -> npt.NDArray[np.bool_]:
        """True for each frame of a scene that is in contact."""
        return np.array(self.scenes[scene]["contact"], dtype=np.bool_)

    def ours(self, scene: str, ratio: int, method: str = "30") -> Decibels:
        """PSNR of each frame in dB; ratio 1: of the noisy signal."""
        if ratio == 1:
            return np.array(self.scenes[scene]["noisy_db"])
        return self.psnr[scene, ratio, method]

    def counts(self, scene: str, key: str) -> npt.NDArray[np.int_]:
        """Number of coefficients in each frame: d2, d4, d2_exact, d4_exact."""
        return np.array(self.scenes[scene][key])

    def chosen_frames(self, scene: str) -> dict[str, int]:
        """Numbers of the contact frames of median and of least PSNR, from N/3 by 20 iterations."""
        psnr_db = self.ours(scene, 3, "20")
        contact = np.flatnonzero(self.contact(scene))
        order = np.argsort(psnr_db[contact])
        by_psnr = contact[order] + self.scenes[scene]["first"]
        return {
            "representative": int(by_psnr[len(by_psnr) // 2]),
            "worst": int(by_psnr[0]),
        }

    def steps(self, scene: str) -> dict[str, Any]:
        """A line of table I."""
        steps = PAPER[scene].steps
        contact = self.contact(scene)
        return {
            "scenario": self.name(scene),
            "steps paper": steps,
            "ours": len(contact),
            "difference": len(contact) - steps,
            "ours, in contact": int(contact.sum()),
        }

    @property
    def speedups(self) -> tuple[float, float]:
        """Least and largest quotient of the paper's time of a frame and ours."""
        quotients = []
        for (scene, method), ms in self.times_ms.items():
            paper_ms = PAPER[scene].time_ms[int(method)]
            quotients.append(paper_ms / ms)
        return min(quotients), max(quotients)


def upper_ends(side: int, ratio: int) -> list[float]:
    """Upper ends of the ranges in table III, dB, of the scenarios of one size."""
    return [
        paper.by_ratio[ratio].high for paper in PAPER.values() if paper.n == side * side
    ]


def deviations_db(highest: Highest) -> list[float]:
    """Root mean square deviation, for each lambda, of an untouched skin's PSNR with few levels from
    the upper ends of table III over both sizes and three M, dB.
    """
    deviations = []
    for side, ratio in product((40, 64), RATIOS):
        of_paper = np.mean(upper_ends(side, ratio))
        ours = np.array(highest[side, True, ratio])
        deviations.append(ours - of_paper)
    # Over both sizes and three M, for each lambda.
    mean_square = np.mean(np.square(deviations), axis=0)
    rms_db: list[float] = np.sqrt(mean_square).tolist()
    return rms_db
