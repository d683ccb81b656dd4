"""Study `wiring`: PSNR against the length of the wires, from local to scrambled sums."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import PAPER, ROTATING, m_of
from sparseskin.nodes.compressor.phi.sbhe import WIRED_BLOCK, SbhePhi
from sparseskin.nodes.numerics.arrays import Doubles, Indices, Mask
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.studies.frames import Frames, PressFrames, SceneFrames
from sparseskin.studies.harness import (
    Candidate,
    Experiment,
    Measurement,
    method_rows,
    unrefused,
)
from sparseskin.studies.points import compute
from sparseskin.studies.presses import N_BEFORE
from sparseskin.studies.report import Page, markdown

SHAPE = (64, 64)
RATIO = 3
BLOCK = WIRED_BLOCK
"""Size of the Hadamard blocks, each the taxels of one amplifier."""
SIDES = (4, 6, 8, 12, 16, 24, 32)
LOCAL = tuple(f"local:{side}" for side in SIDES)
ROW_LOCAL = "row_local"
SCRAMBLED = "sbhe"
SINGLE = "subsample"
KINDS_OF_PHI = (*LOCAL, SCRAMBLED, ROW_LOCAL, SINGLE)
DRAG = "drag_wrench_64"
BODIES = ("wrench", "fingertips", "gaussian")
N_FRAMES = 120
QUICK_FRAMES = 15
#: Frames of the scene: from 0.24 s on, when the wrench has landed, 2 ms apart.
DRAG_FIRST = 2400
DRAG_EVERY = 20
_CHUNK = 256
_OFF_GRID = np.array([0.31, 0.17])
PRESET_ROWS = {"skin": ROTATING, "paper": PAPER}


def run(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Compute the study, write its page and return its conclusion; see `command.Study`."""
    n_seeds = 1 if quick else 3
    seeds = range(seed, seed + n_seeds)
    n_frames = QUICK_FRAMES if quick else N_FRAMES
    frames = frames_of(n_frames, quick)
    rows = unrefused(experiment(frames, seeds).run(out, executor))
    rows = rows.assign(
        body=named(rows),
        preset=rows["method"],
        kind=rows["phi"],
    )

    points = [{"seed": seed_of_point} for seed_of_point in seeds]
    counted = compute(wiring, points, out, executor, "wires")
    wires = method_rows(points, counted, "kind")
    # The mean over the seeds.
    means = wires.groupby("kind", sort=False).mean(numeric_only=True)
    rows = rows.join(means.drop(columns="seed"), on="kind")

    # Loss against sums over the whole skin, of the same preset, body and seed.
    keys = ["preset", "body", "seed"]
    of_scrambled = rows[rows["kind"] == SCRAMBLED]
    scrambled_db = of_scrambled.set_index(keys)["mean_db"]
    same_frames = pd.MultiIndex.from_frame(rows[keys])
    reference_db = scrambled_db.loc[same_frames].to_numpy()
    rows["loss_db"] = reference_db - rows["mean_db"].to_numpy()

    page = Page(out, "wiring", Path(__file__).with_suffix(".md"), quick)
    page.section(
        "",
        _table(rows),
        n_rows=SHAPE[0],
        n_cols=SHAPE[1],
        n=math.prod(SHAPE),
        ratio=RATIO,
        m=m_of(math.prod(SHAPE), RATIO, ROTATING),
        n_frames=n_frames,
        n_seeds=n_seeds,
        scenes=", ".join(rows["body"].unique()),
    )
    page.csv("wiring", rows.drop(columns="method"))
    lines = conclusion(rows)
    page.write(lines)
    return lines


def frames_of(n_frames: int, quick: bool) -> list[Frames]:
    """Bodies that press the skin, and a scene; a solver learns the noise of the first 10 frames."""
    skip = N_BEFORE - 10
    # The scene is slow to simulate.
    frames: list[Frames] = []
    for body in BODIES:
        frames.append(PressFrames(body, SHAPE, N_BEFORE + n_frames, skip=skip))
    if not quick:
        contact, _ = next(SceneFrames(DRAG, 0).windows(0))
        begin = DRAG_FIRST - contact
        end = begin + n_frames * DRAG_EVERY
        frames.append(SceneFrames(DRAG, begin, end, DRAG_EVERY))
    return frames


def named(rows: pd.DataFrame) -> pd.Series:
    """Body or scene of each row."""
    names = rows.reindex(columns=["body", "scene"])
    return names["body"].fillna(names["scene"])


def experiment(frames: list[Frames], seeds: range) -> Experiment:
    """Each matrix with each preset, on the same readings."""
    measurements = [Measurement(RATIO, phi=kind, block=BLOCK) for kind in KINDS_OF_PHI]
    presets = {}
    for name, rows in PRESET_ROWS.items():
        presets[name] = Candidate(PRESETS[name], changes={"rows": rows})
    return Experiment(
        "accuracy", frames, measurements, presets, ("mean_db", "min_db"), tuple(seeds)
    )


def conclusion(rows: pd.DataFrame) -> list[str]:
    """Loss and length of wires of other kinds against rows over the whole skin, default solver."""
    of_default = rows[rows["preset"] == "skin"]
    mean = of_default.groupby("kind")[["loss_db", "length"]].mean()
    whole_length = mean.loc[SCRAMBLED, "length"]
    texts = {
        LOCAL[0]: f"Rows over neighbourhoods ({LOCAL[0]})",
        ROW_LOCAL: "Rows within the rows of an array",
        SINGLE: "Single taxels",
    }
    lines = []
    for kind, text in texts.items():
        percent = 100 * mean.loc[kind, "length"] / whole_length
        loss_db = mean.loc[kind, "loss_db"]
        lines.append(
            f"{text}: {percent:.0f} % of the length of the wires of rows over the whole skin, "
            f"for {loss_db:.1f} dB."
        )
    return lines


def wiring(point: dict[str, Any]) -> dict[str, Any]:
    """Wires of each matrix. `point`: seed."""
    # Wires of an array are those of the skin alone, whatever is read through them.
    n = math.prod(SHAPE)
    exists = np.ones(SHAPE, dtype=np.bool_)
    m = m_of(n, RATIO, ROTATING)
    wiring_of_kind = {}
    for kind in (ROW_LOCAL, SINGLE):
        wiring_of_kind[kind] = array_wiring(*SHAPE, m)
    for kind in (*LOCAL, SCRAMBLED):
        phi = make_phi(kind, n, m, point["seed"], BLOCK)
        phi.lay_out(exists)
        assert isinstance(phi, SbhePhi)
        wiring_of_kind[kind] = sbhe_wiring(phi, exists)
    return {"methods": {kind: vars(wires) for kind, wires in wiring_of_kind.items()}}


def _table(rows: pd.DataFrame) -> str:
    by_kind = rows.groupby("kind", sort=False)
    table = by_kind[["length", "crossings", "lines", "conversions"]].first()
    table["lines"] /= math.prod(SHAPE)
    table.insert(0, "kind", table.index)
    # Mean, loss and the range of the losses with each preset.
    for preset in PRESET_ROWS:
        of_preset = rows[rows["preset"] == preset].groupby("kind", sort=False)
        loss_db = of_preset["loss_db"]
        table[f"{preset}: mean dB"] = of_preset["mean_db"].mean()
        table[f"{preset}: loss, dB"] = loss_db.mean()
        ranges = []
        for _, losses_db in loss_db:
            ranges.append(f"{losses_db.min():.1f} .. {losses_db.max():.1f}")
        table[f"{preset}: loss, least .. most"] = ranges
    names = {"length": "length, pitches", "lines": "wires a taxel"}
    forms = {
        "length, pitches": ",.0f",
        "crossings": ",.0f",
        "wires a taxel": ".3f",
        "conversions": ".0f",
    }
    for preset in PRESET_ROWS:
        forms[f"{preset}: mean dB"] = ".1f"
        forms[f"{preset}: loss, dB"] = ".1f"
    return markdown(table.rename(columns=names), forms)


@dataclass(frozen=True)
class Wiring:
    """Wires of a skin: those that leave it or end in an amplifier on it; places where two cross;
    length of all, in pitches; conversions from analog to digital a frame.
    """

    lines: int
    crossings: int
    length: float
    conversions: int


def star_wiring(
    groups: list[Indices], cells: Indices, n_cols: int, conversions: int
) -> Wiring:
    """Wires of a skin whose taxels are summed in groups, by one amplifier a group.

    Each taxel has a wire of its own to the amplifier, which stands at the median row and column of
    its group, where the sum of the lengths is least. A wire runs along rows and columns, so that
    its length is |rows| + |columns|. Crossings are counted of straight wires: pairs of wires of
    different groups that cross. `groups`: numbers of the taxels of each; `cells`: cell of each
    taxel, intp (n,), row r and column c being r n_cols + c.
    """
    places = np.stack(np.divmod(cells, n_cols), axis=1).astype(np.float64)
    begins = places[np.concatenate(groups)]

    # The amplifier of each wire, and its group.
    sizes = [len(group) for group in groups]
    amplifiers = [np.median(places[group], axis=0) for group in groups]
    medians = np.repeat(amplifiers, sizes, axis=0)
    group_of = np.repeat(np.arange(len(groups)), sizes)
    # Not on a grid point, so that no wire runs through the begin of another.
    ends = medians + _OFF_GRID
    return Wiring(
        lines=len(begins),
        crossings=count_crossings(begins, ends, group_of),
        length=float(np.abs(begins - medians).sum()),
        conversions=conversions,
    )


def sbhe_wiring(phi: SbhePhi, exists: Mask) -> Wiring:
    """Wires where each Hadamard block is a group whose sums are analog: M conversions a frame."""
    ends = np.cumsum(phi.sizes)[:-1]
    groups = np.split(phi.permutation, ends)
    return star_wiring(groups, np.flatnonzero(exists), exists.shape[1], phi.m)


def array_wiring(n_rows: int, n_cols: int, conversions: int) -> Wiring:
    """Wires of a row-column array: a line along each row and column, which leave the skin and cross
    at the taxels; length n_rows (n_cols - 1) + n_cols (n_rows - 1).
    """
    length = float(n_rows * (n_cols - 1) + n_cols * (n_rows - 1))
    return Wiring(n_rows + n_cols, n_rows * n_cols, length, conversions)


def count_crossings(
    begins: Doubles,
    ends: Doubles,
    group_of: Indices,
) -> int:
    """Pairs of straight lines, (k, 2) each, of different groups, (k,), that cross within both."""
    total = 0
    for k in range(0, len(begins), _CHUNK):
        part = slice(k, k + _CHUNK)
        p = begins[part, None]
        q = ends[part, None]
        # Two lines cross where each has the ends of the other on its two sides.
        parts_them = _side(p, q, begins) * _side(p, q, ends) < 0
        is_parted = _side(begins, ends, p) * _side(begins, ends, q) < 0

        # Each pair once.
        numbers = np.arange(k, k + len(begins[part]))
        is_later = np.arange(len(begins)) > numbers[:, None]
        differ = group_of[part, None] != group_of
        total += int((parts_them & is_parted & is_later & differ).sum())
    return total


def _side(p: Doubles, q: Doubles, r: Doubles) -> Doubles:
    """Sign of the side of the line p -> q on which r lies."""
    d = q - p
    e = r - p
    area = d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0]
    return np.sign(area)
