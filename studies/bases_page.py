"""The page of study `bases`: the question of D2 or D4, for every basis, and of how to sample."""

from __future__ import annotations

from collections.abc import Mapping
from math import log10
from pathlib import Path
from statistics import mean
from typing import Any

from .bases_charts import draw_missing, draw_restored, draw_sampled
from .bases_points import KEPT_PARTS, LAMBDAS_N, SAMPLINGS
from .report import markdown_table, write_csv, write_page

Figures = dict[str, Any]
Counted = Mapping[tuple[str, str], Figures]
Restored = Mapping[tuple[str, str, int], Figures]
Sampled = Mapping[tuple[str, int], Figures]

PAPERS_LAMBDA = LAMBDAS_N.index(0.003125)
#: The part of the coefficients that a table shows: 2 % of them.
SHOWN_PART = KEPT_PARTS.index(0.02)
NAMES = {"haar": "haar (D2)", "db2": "db2 (D4)"}
_INTRODUCTION = """\
# Bases

In which basis are the forces on a skin sparse, and which one restores them best? The paper
(section IV-A) takes Haar, which is D2, and asks whether D4 (*db2*) would be better. Here stand
beside the two: longer wavelets, the cosine transform, the taxels themselves (*identity*), Haar on
tiles of 8 x 8, and bases on such tiles that were learned from true forces, of another seed than
those they are tried on: *learned* from scenes of the other two bodies alone, so that nothing of
this shape was seen; *learned, same body* from a scene of this body on the other array (of the peg,
from another path).

Frames are spread evenly from the first contact to the end of a scene."""
_COUNTED = """\
## Sparse?

Mean number of coefficients above rounding (1e-6 N) of the true forces, contact frames; in brackets
the energy in dB that is *not* in the largest 2 % of the coefficients (lower is better)."""
_RESTORED = """\
## Restored?

FISTA, 30 iterations, on the same noisy measurements: mean PSNR over contact frames in dB with the
lambda of five (0.0016 to 0.025 N) that serves the basis best on that scene; in brackets with the
paper's, 0.003125 N."""
_SAMPLED = """\
## Sampled otherwise?

*acts*: M single taxels, chosen anew in each frame by what those that were read first say, and
linear interpolation between them (after ACTS, arXiv 2410.13847: the sampling follows differences
of readings, and interpolation is along rows, columns and diagonals, which is ours; that article
compares with linear interpolation, and has a dictionary besides). *subsample*: M taxels drawn
once, linear interpolation on triangles. *paper*, *skin*: M scrambled block Hadamard measurements
and those presets. Frames one after the other from shortly before the
first contact. Mean PSNR over contact frames in dB, in brackets the worst frame.

A frame of *acts* is M reads one after the other, each decided by those before; its places take
N / 8 bytes beside the 4 M of the readings. Noise is added by the taxels alone, in all of these;
reading one adds none."""


def write(out: Path, counted: Counted, restored: Restored, sampled: Sampled) -> None:
    """Write tables, charts and the page into a folder.

    Parameters
    ----------
    out : Path
    counted : mapping of (scene, basis)
        As `bases_points.coefficients` gives it.
    restored : mapping of (scene, basis, ratio)
        As `bases_points.restored` gives it.
    sampled : mapping of (scene, ratio)
        As `bases_points.sampled` gives it.
    """
    parts = [
        _INTRODUCTION,
        _answer(counted, restored),
        _COUNTED,
        _counted_table(counted),
        draw_missing(out, counted),
        _RESTORED,
        _restored_table(restored),
        draw_restored(out, {key: max(found["mean_db"]) for key, found in restored.items()}),
        write_csv(out, "bases", _basis_rows(counted, restored)),
        _SAMPLED,
        _sampled_words(sampled),
        _sampled_table(sampled),
        draw_sampled(out, sampled),
        write_csv(out, "sampling", _sampling_rows(sampled)),
    ]
    write_page(out, "bases", parts)


def named(basis: str) -> str:
    """What a basis is called on the page."""
    return NAMES.get(basis, basis)


def _scenes(keys: Mapping[Any, Any]) -> list[str]:
    return list(dict.fromkeys(key[0] for key in keys))


def _bases(keys: Mapping[Any, Any]) -> list[str]:
    return list(dict.fromkeys(key[1] for key in keys))


def _ratios(restored: Restored) -> list[int]:
    return sorted({ratio for _, _, ratio in restored})


def _tuned(restored: Restored, basis: str, ratio: int) -> float:
    return float(mean(max(restored[scene, basis, ratio]["mean_db"]) for scene in _scenes(restored)))


def _gains(restored: Restored, basis: str, than: str) -> list[float]:
    """What a basis gains over another, each with its best lambda, dB, by scene and ratio."""
    keys = [(scene, ratio) for scene, name, ratio in restored if name == basis]
    best = {key: max(found["mean_db"]) for key, found in restored.items()}
    return [best[scene, basis, ratio] - best[scene, than, ratio] for scene, ratio in keys]


def _answer(counted: Counted, restored: Restored) -> str:
    """The answer in words, made from the figures."""
    scenes, bases = _scenes(counted), _bases(counted)

    def n_nonzero(scene: str, basis: str) -> float:
        return float(counted[scene, basis]["n_nonzero"])

    fewer = sum(n_nonzero(scene, "haar") < n_nonzero(scene, "db2") for scene in scenes)
    times = mean(n_nonzero(scene, "db2") / n_nonzero(scene, "haar") for scene in scenes)
    lines = [
        "## Answer",
        f"Haar (D2) needs fewer coefficients than D4 in {fewer} of {len(scenes)} scenes; D4 needs "
        f"{times:.2f} times as many in the mean.",
    ]
    for ratio in _ratios(restored):
        tuned = {basis: _tuned(restored, basis, ratio) for basis in bases}
        order = sorted(bases, key=lambda basis: -tuned[basis])
        listed = "; ".join(f"{named(basis)} {tuned[basis]:.1f}" for basis in order)
        lines.append(f"Restored from N/{ratio}, mean of the scenes, best lambda, in dB: {listed}.")
    for said, basis, than in (
        ("D4 in place of D2 changes that by", "db2", "haar"),
        ("Learning from other bodies adds to Haar on the same tiles", "learned", "haar, tiles"),
        ("Learning from the same body adds to it", "learned, same body", "haar, tiles"),
    ):
        gains = _gains(restored, basis, than)
        lines.append(
            f"{said} {mean(gains):+.1f} dB in the mean, {min(gains):+.1f} to {max(gains):+.1f} by "
            "scene."
        )
    return "\n\n".join(lines)


def _counted_table(counted: Counted) -> str:
    scenes = _scenes(counted)
    rows = []
    for basis in _bases(counted):
        cells = [
            f"{counted[scene, basis]['n_nonzero']:.0f} "
            f"({_decibels(counted[scene, basis]['missing'][SHOWN_PART])})"
            for scene in scenes
        ]
        rows.append([named(basis), *cells])
    return markdown_table(["basis", *scenes], rows)


def _decibels(part: float) -> str:
    """A part of the energy in dB; float32 leaves nothing to be told below -120 dB."""
    return "< -120" if part < 1e-12 else f"{10 * log10(part):.0f}"


def _restored_table(restored: Restored) -> str:
    scenes, ratios = _scenes(restored), _ratios(restored)
    rows = []
    for basis in _bases(restored):
        for ratio in ratios:
            found = [restored[scene, basis, ratio]["mean_db"] for scene in scenes]
            cells = [
                f"{max(by_lambda):.1f} ({by_lambda[PAPERS_LAMBDA]:.1f})" for by_lambda in found
            ]
            rows.append([named(basis), f"N/{ratio}", *cells])
    return markdown_table(["basis", "M", *scenes], rows)


def _basis_rows(counted: Counted, restored: Restored) -> list[dict[str, Any]]:
    rows = []
    for (scene, basis, ratio), found in restored.items():
        best = max(range(len(LAMBDAS_N)), key=found["mean_db"].__getitem__)
        count = counted[scene, basis]
        rows.append(
            {
                "scene": scene,
                "basis": basis,
                "ratio": ratio,
                "n_nonzero": round(count["n_nonzero"], 1),
                "missing_2_percent": count["missing"][SHOWN_PART],
                "mean_db": found["mean_db"][best],
                "min_db": found["min_db"][best],
                "lambda_n": LAMBDAS_N[best],
                "mean_db_papers_lambda": found["mean_db"][PAPERS_LAMBDA],
                "n_frames": count["n_frames"],
            }
        )
    return rows


def _sampled_words(sampled: Sampled) -> str:
    """Where adaptive sampling is ahead, made from the figures."""
    lines = []
    for ratio in sorted({ratio for _, ratio in sampled}):
        found = [figures for (_, r), figures in sampled.items() if r == ratio]
        means = {name: mean(f[name]["mean_db"] for f in found) for name in found[0]}
        ahead = sum(f["acts"]["mean_db"] > f["paper"]["mean_db"] for f in found)
        behind = sum(f["acts"]["mean_db"] < f["skin"]["mean_db"] for f in found)
        listed = ", ".join(f"{name} {value:.1f}" for name, value in means.items())
        lines.append(
            f"- N/{ratio}: mean of the scenes {listed} dB; acts is above paper in {ahead} of "
            f"{len(found)} scenes, below skin in {behind}."
        )
    return "\n".join(lines)


def _sampled_table(sampled: Sampled) -> str:
    names = ("reading", *SAMPLINGS)
    rows = [
        [scene, f"N/{ratio}"]
        + [f"{found[name]['mean_db']:.1f} ({found[name]['min_db']:.1f})" for name in names]
        for (scene, ratio), found in sampled.items()
    ]
    return markdown_table(["scene", "M", "all taxels read", *SAMPLINGS], rows)


def _sampling_rows(sampled: Sampled) -> list[dict[str, Any]]:
    return [
        {"scene": scene, "ratio": ratio, "sampling": name, **found[name]}
        for (scene, ratio), found in sampled.items()
        for name in found
    ]
