"""What a user can set, drawn and explained."""

from __future__ import annotations

from pathlib import Path

from sparseskin.nodes.compressor.limits import MIN_BLOCK
from sparseskin.nodes.reconstructor.limits import LAMBDAS_N, MIN_ITERATIONS
from sparseskin.studies.report import markdown_table, write_csv
from sparseskin.studies.stability_curves import (
    Sweep,
    draw_sweeps,
    reasons_table,
    rows_of,
    sweep_table,
)
from sparseskin.studies.stability_settings import measure, points

_TEXT = """## Solvers: settings and surroundings

Three excerpts of 40 frames on 40 x 40 taxels (the box's impact frame by frame; at 100 Hz the
wrench as it is dragged and the peg on its way), all other settings those of the project. Mean PSNR
over contact frames, and signal over error on the touched taxels alone (0 dB: all was restored as
0, which on a skin that the light peg presses is 58 dB of PSNR); the grey line is that of the
readings of all taxels. What lies beyond the edges is drawn at them. *fails*: worse by 3 dB than
the best of its sweep, in either figure; with *noise*, worse than the readings. It is one draw of
noise and Phi: at N/8, where the peg is half found and half lost, that is 2 to 3 dB of scatter.

- *step*: rows too long by √step, of a Phi that says they are of length 1: the solver's steps are
  then `step`/L. In theory a gradient step fails beyond 2/L, with FISTA's momentum beyond 4/(3 L).
- *noise*: times the paper's. *block*: size of the Hadamard blocks, with taxels dealt out at random
  and, *unscrambled*, with neighbours in one block."""

SWEEPS = {
    "step": Sweep(
        "step, in 1/L",
        "each step overshoots by more than it corrects, and errors grow from step to step",
        "refuses a Phi of the user's own whose largest eigenvalue is not what it says",
        edges={"4/3: momentum": 4 / 3, "2: none": 2.0},
    ),
    "lambda_n": Sweep(
        "λ, N",
        "too large, forces are shrunk away; too small, the noise is fitted",
        "warns, in newtons, outside "
        + ", ".join(f"{low:g} to {high:g} ({name})" for name, (low, high) in LAMBDAS_N.items())
        + "; refuses what leaves nothing of a skin pressed all over",
        scale="log",
    ),
    "iterations": Sweep(
        "iterations a frame",
        "a sudden change is not followed within its frame",
        "warns below "
        + ", ".join(f"{least} ({name})" for name, least in MIN_ITERATIONS.items())
        + "; skin chooses how many by what it finds",
        scale="log",
    ),
    "noise": Sweep(
        "noise, times the paper's",
        "what the noise hides no solver can see; a threshold that is not of its size fits it",
        "nothing: noise is met, not set",
        against_readings=True,
    ),
    "block": Sweep(
        "block size B",
        "a small block sees few taxels: most rows see none that is pressed",
        f"warns below {MIN_BLOCK}",
        scale="log",
    ),
    "unscrambled": Sweep(
        "block size B, unscrambled",
        "neighbours share a block, and a pad falls into few of the blocks: these have more taxels "
        "pressed than rows",
        "cannot be set; warns of a Phi of the user's own that measures some pads far better than "
        "others",
        scale="log",
    ),
}


def section(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Compute, draw and explain."""
    rows = rows_of(measure, points(quick, seed), out, executor, "settings")
    parts = [_TEXT, reasons_table(SWEEPS)]
    for ratio in dict.fromkeys(row["ratio"] for row in rows):
        mine = [row for row in rows if row["ratio"] == ratio]
        caption = f"Settings, M = N/{ratio}."
        parts.append(draw_sweeps(out, f"settings_n{ratio}", caption, mine, SWEEPS, 3))
        parts.append(sweep_table(mine, SWEEPS))
    single = [row for row in rows if row["sweep"] == "subsample"]
    parts.append(
        "Single taxels in place of sums (phi `subsample`): a pad of fewer than N/M taxels may "
        "touch none that is read. The compressor warns."
    )
    scores = ("psnr_db", "touched_db", "noisy_psnr_db", "noisy_touched_db")
    parts.append(
        markdown_table(
            ["solver", "M", "PSNR, dB", "where touched, dB", "readings: PSNR", "where touched"],
            [[r["solver"], f"N/{r['ratio']}", *(f"{r[s]:.1f}" for s in scores)] for r in single],
        )
    )
    parts.append(f"All figures: {write_csv(out, 'settings', rows)}.")
    return parts
