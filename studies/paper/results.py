"""Figures of study `paper-tables`, and the reasons for which they differ from the paper's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from .numbers import ITERATIONS, PAPER, RATIOS

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
        psnr, contact = self.ours(scene, 3, "20"), np.flatnonzero(self.contact(scene))
        by_psnr = contact[np.argsort(psnr[contact])] + self.scenes[scene]["first"]
        return {"representative": int(by_psnr[len(by_psnr) // 2]), "worst": int(by_psnr[0])}

    def steps(self, scene: str) -> dict[str, Any]:
        """A line of table I."""
        steps, contact = PAPER[scene].steps, self.contact(scene)
        row = {"scenario": self.name(scene), "steps paper": steps, "ours": len(contact)}
        return {**row, "difference": len(contact) - steps, "ours, in contact": int(contact.sum())}

    @property
    def speedups(self) -> tuple[float, float]:
        """Least and largest quotient of the paper's time of a frame and ours."""
        found = [
            PAPER[scene].time_ms[int(method)] / ms for (scene, method), ms in self.times_ms.items()
        ]
        return min(found), max(found)

    def reasons(self, lambdas: Sequence[float], highest: Highest) -> dict[str, str]:
        """Figures in the section on differences from the paper and their causes."""

        def means(scene: str, contact: bool = False) -> str:
            of = [self.ours(scene, ratio, FITTED) for ratio in RATIOS]
            chosen = self.contact(scene) if contact else slice(None)
            return ", ".join(f"{frames[chosen].mean():.1f}" for frames in of)

        def papers(scene: str) -> str:
            return ", ".join(f"{PAPER[scene].by_ratio[ratio].mean}" for ratio in RATIOS)

        def off(scene: str, ratio: int, method: str = "30") -> str:
            found = self.ours(scene, ratio, method).mean() - PAPER[scene].by_ratio[ratio].mean
            return f"{found:+.1f}"

        def touching(scene: str, key: str) -> str:
            return f"{self.counts(scene, key)[self.contact(scene)].mean():.0f}"

        deviations = deviations_db(highest, few_levels=True)
        best = int(np.argmin(deviations))
        lows, noise = (
            [float(of(self.ours(s, 1))) - getattr(p.noisy, theirs) for s, p in PAPER.items()]
            for of, theirs in ((np.min, "low"), (np.mean, "mean"))
        )
        spreads = [
            np.ptp([self.ours(scene, 3, str(k)).mean() for k in ITERATIONS]) for scene in PAPER
        ]
        least, most = self.speedups
        wrench, box = "drag_wrench_64", ("lift_box_40", "lift_box_64")
        busy = self.counts(wrench, "d2") > PAPER[wrench].d2.mean
        return {
            **{"lambda_n": f"{lambdas[best]:g}", "best_db": f"{deviations[best]:.1f}"},
            **{"preset_n": f"{lambdas[0]:g}", "preset_db": f"{deviations[0]:.1f}"},
            **{"path": means("path_40"), "path_paper": papers("path_40")},
            "box_shares": ", ".join(f"{self.contact(scene).mean():.0%}" for scene in box),
            "box_means": "; ".join(f"{means(s, True)} dB (paper {papers(s)})" for s in box),
            "box_d4": ", ".join(
                f"{touching(s, 'd4_exact')} (paper {PAPER[s].d4.mean:.0f}), not counted "
                f"{touching(s, 'd4')}"
                for s in box
            ),
            **{"lift_off": off("lift_wrench_40", 3), "drag_off": off("drag_wrench_40", 3)},
            "lift_fitted": off("lift_wrench_40", 3, FITTED),
            "drag_fitted": off("drag_wrench_40", 3, FITTED),
            "drag_64": ", ".join(off(wrench, ratio) for ratio in RATIOS),
            "drag_d2": f"{self.counts(wrench, 'd2').mean():.0f}",
            "drag_paper_d2": f"{PAPER[wrench].d2.mean:.0f}",
            "drag_share": f"{self.contact(wrench).mean():.0%}",
            "drag_busy": f"{self.ours(wrench, 3)[busy == busy.any()].mean():.1f}",
            "drag_paper": f"{PAPER[wrench].by_ratio[3].mean}",
            "low_gaps": f"{min(lows):.1f} to {max(lows):.1f}",
            "mean_gaps": f"{min(noise):.1f} to {max(noise):.1f}",
            **{"spread_db": f"{max(spreads):.1f}", "speedups": f"{least:.0f} to {most:.0f}"},
        }


def upper_ends(side: int, ratio: int) -> list[float]:
    """Upper ends of the ranges in table III, dB, of the scenarios of one size."""
    return [paper.by_ratio[ratio].high for paper in PAPER.values() if paper.n == side * side]


def deviations_db(highest: Highest, few_levels: bool) -> list[float]:
    """Root mean square deviation, for each lambda, of an untouched skin's PSNR from the upper ends
    of table III over both sizes and three M, dB. On 64 x 64 there is but one Haar, of six levels.
    """
    off_db = [
        np.array(highest[side, few, ratio]) - np.mean(upper_ends(side, ratio))
        for side, few in ((40, few_levels), (64, True))
        for ratio in RATIOS
    ]
    return [float(one) for one in np.sqrt(np.mean(np.square(off_db), axis=0))]
