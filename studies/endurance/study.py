"""The study `endurance`: the solver "skin" over a million frames, never reset."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.skin.solver import SkinSolver
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.evaluate import phis_at
from sparseskin.studies.points import compute
from sparseskin.studies.report import fill_page, write_csv
from sparseskin.studies.targets.scenes import random_scene

#: Rows and columns, N / M, rows of the measurement matrix.
STREAMS = ((20, 3, "fixed"), (20, 3, "rotating"), (20, 8, "rotating"))
#: A round is so many scenes, each cut into its middle, where its body is down: from one to the
#: next everything changes between two frames. Every round has the same scenes, and other noise.
SCENES, FIRST, FRAMES = 50, 60, 160
PER_SCENE = FRAMES - FIRST
PER_ROUND = SCENES * PER_SCENE
#: In every fourth scene so many frames are lost from here on.
LOST_EVERY, LOST_FROM, LOST = 4, 30, 50
#: A jump is over when so many frames after it the error is near that of a solver that starts
#: there and has seen the same frames.
SETTLED_AFTER = 3
ENOUGH_DB = 60.0
"""PSNR from which frames count as equal: an error of a sixth of the noise."""
#: Of which an eighth is lost.
LONG_FRAMES, QUICK_FRAMES = 1_150_000, 2 * PER_ROUND
ALLOWED_DB = 1.0


def endured(point: dict[str, Any]) -> dict[str, Any]:
    """Reconstruct a stream of scenes by one solver that is never reset.

    `point`: side, ratio, rows ("fixed" or "rotating"), n_frames, seed.

    Returns
    -------
    dict
        "n_frames" reconstructed, "not_finite" of them, "largest_n" the largest force; "rounds_db"
        the mean PSNR of each round; "jumps_db" and "losses_db": dB by which the third frame after
        each jump, and after each loss, is below that of a solver that starts there, where 60 dB
        and more count as 60; "apart_db", after both, dB by which another such solver, which draws
        other shifts, is below the first; "frame_ms".
    """
    side: int = point["side"]
    phis = phis_at(side * side, point["ratio"], point["rows"], point["seed"])
    scenes = [_frames(number, side) for number in range(SCENES)]
    noise, rng = NoiseModel.for_range(PAPER_F_MAX_N), np.random.default_rng(point["seed"])
    solver, fresh, other = (
        SkinSolver(phis[0], make_basis("haar", side, side), seed=seed) for seed in (0, 0, 1)
    )
    psnr: list[float] = []
    behind: dict[str, list[float]] = {"jump": [], "loss": []}
    apart: list[float] = []
    not_finite, largest_n, since, why = 0, 0.0, SETTLED_AFTER, "jump"
    begin = time.perf_counter()
    for k, (truth, event) in enumerate(_stream(scenes, point["n_frames"])):
        phi = phis[k % len(phis)]
        if truth is None:
            continue
        if event and k:
            since, why = 0, event
            fresh.reset()
            other.reset()
        y = phi.forward(noise.apply(truth, rng).reshape(-1))
        solver.use(phi)
        forces = solver.solve(y)
        largest_n = max(largest_n, float(forces.max()))
        psnr.append(psnr_db(forces - truth, PAPER_F_MAX_N))
        not_finite += not math.isfinite(psnr[-1])
        if since < SETTLED_AFTER:
            since += 1
            fresh.use(phi)
            other.use(phi)
            anew, again = fresh.solve(y), other.solve(y)
            if since == SETTLED_AFTER:
                anew_db = _capped_db(anew, truth)
                behind[why].append(anew_db - min(psnr[-1], ENOUGH_DB))
                apart.append(anew_db - _capped_db(again, truth))
    return {
        "n_frames": len(psnr),
        "not_finite": not_finite,
        "largest_n": largest_n,
        "rounds_db": [float(np.mean(part)) for part in _rounds(psnr)],
        "jumps_db": behind["jump"],
        "losses_db": behind["loss"],
        "apart_db": apart,
        "frame_ms": (time.perf_counter() - begin) / len(psnr) * 1e3,
    }


def _frames(number: int, side: int) -> Floats:
    frames = list(random_scene(number, FRAMES, side)[1])
    return np.array(frames[FIRST:])


def _stream(scenes: list[Floats], n_frames: int) -> Iterator[tuple[Floats | None, str]]:
    """Yield each frame, None where it is lost, and the event before it: "jump", "loss" or ""."""
    for k in range(n_frames):
        scene, place = divmod(k, PER_SCENE)
        lossy = scene % LOST_EVERY == LOST_EVERY - 1
        lost = lossy and LOST_FROM <= place < LOST_FROM + LOST
        after_loss = lossy and place == LOST_FROM + LOST
        event = "jump" if place == 0 else "loss" if after_loss else ""
        yield (None if lost else scenes[scene % SCENES][place]), event


def _capped_db(forces: Floats, truth: Floats) -> float:
    return min(psnr_db(forces - truth, PAPER_F_MAX_N), ENOUGH_DB)


def _rounds(psnr: list[float]) -> list[list[float]]:
    """Frames by whole rounds; a shorter stream counts as one."""
    lossy = SCENES // LOST_EVERY
    per_round = PER_ROUND - lossy * LOST
    whole = [psnr[a : a + per_round] for a in range(0, len(psnr) - per_round + 1, per_round)]
    return whole or [psnr]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the streams (quick: two rounds each) and write the page; see `command.Study`."""
    common = {"n_frames": QUICK_FRAMES if quick else LONG_FRAMES, "seed": seed}
    names = ("side", "ratio", "rows")
    points = [{**dict(zip(names, stream, strict=True)), **common} for stream in STREAMS]
    found = compute(endured, points, out, executor, "streams")
    rows = [summary(point, figures) for point, figures in zip(points, found, strict=True)]
    fill_page(
        out,
        "endurance",
        conclusion=conclusion(found),
        scenes=SCENES,
        lost=LOST,
        table=pd.DataFrame(rows),
        csv=write_csv(out, "endurance", rows),
    )


def conclusion(found: Sequence[dict[str, Any]]) -> list[str]:
    """What a stream of frames without end does to the solver."""
    frames = sum(figures["n_frames"] for figures in found)
    not_finite = sum(figures["not_finite"] for figures in found)
    drifts = [figures["rounds_db"][-1] - figures["rounds_db"][0] for figures in found]
    jumps = np.concatenate([np.array(figures["jumps_db"], float) for figures in found])
    within = float(np.mean(jumps <= ALLOWED_DB)) if jumps.size else 1.0
    return [
        f"{frames:,} frames in {len(found)} streams, {not_finite} of them not finite.",
        f"From the first round to the last the mean PSNR changes by {min(drifts):+.2f} to "
        f"{max(drifts):+.2f} dB.",
        f"After {100 * within:.1f} % of {jumps.size:,} jumps the solver is within "
        f"{ALLOWED_DB:g} dB of one that starts there.",
    ]


def summary(point: dict[str, Any], figures: dict[str, Any]) -> dict[str, str]:
    """One line of the table, by column."""
    rounds = figures["rounds_db"]
    return {
        "taxels": str(point["side"] ** 2),
        "M": f"N/{point['ratio']}, {point['rows']}",
        "frames": f"{figures['n_frames']:,}",
        "not finite": str(figures["not_finite"]),
        "largest force, N": f"{figures['largest_n']:.2f}",
        "first round, dB": f"{rounds[0]:.2f}",
        "last round, dB": f"{rounds[-1]:.2f}",
        "least round, dB": f"{min(rounds):.2f}",
        f"after a jump within {ALLOWED_DB:g} dB of a cold start": _within(figures["jumps_db"]),
        f"after {LOST} lost frames": _within(figures["losses_db"]),
        f"two cold starts within {ALLOWED_DB:g} dB": _within(figures["apart_db"]),
        "ms a frame": f"{figures['frame_ms']:.2f}",
    }


def _within(behind_db: list[float]) -> str:
    behind = np.array(behind_db)
    if not behind.size:
        return "none"
    return (
        f"{100 * float(np.mean(behind <= ALLOWED_DB)):.1f} % of {behind.size:,} "
        f"(median {float(np.median(behind)):+.1f} dB, worst {float(behind.max()):+.1f} dB)"
    )
