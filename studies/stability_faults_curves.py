"""What breaks on the way, drawn and explained."""

from __future__ import annotations

from pathlib import Path

from sparseskin.nodes.compressor.limits import MIN_BITS
from sparseskin.studies.report import write_csv
from sparseskin.studies.stability_curves import (
    Sweep,
    draw_sweeps,
    reasons_table,
    rows_of,
    sweep_table,
)
from sparseskin.studies.stability_faults import bits_of_the_noise, measure, points

_TEXT = """## What breaks on the way

The same excerpts and figures, M = N/3. Broken taxels are not judged, the living ones are. *dead*:
reads 0; *masked*: the skin says so, and they are left out; *stuck*: reads one value between 0 and
f_max for ever; *saturated*: reads f_max for ever. *rows*: measurements that read 0. *lost* frames
leave the last restored frame standing; bursts are of 10 frames. *bits*: of a measurement as the
compressor sends it, with steps that fit each frame's largest. *converter*: bits of an ADC before
it, whose range holds any sum of 32 taxels; the dotted line is where its steps make as much noise
(step/√12) as an untouched taxel has. Solvers are shown by themselves here, without the watch that
a reconstructor keeps on rows and taxels."""

SWEEPS = {
    "dead": Sweep(
        "share of taxels dead",
        "its force is missing in the sums as if nobody pressed there, as on any skin; pads get "
        "holes, so more coefficients",
        "takes a mask with the skin, which undoes it",
    ),
    "masked": Sweep(
        "share of taxels dead, in the mask",
        "the fewer the taxels, the fewer their measurements (M = N/3)",
        "nothing is to be done",
    ),
    "stuck": Sweep(
        "share of taxels stuck",
        "to whoever sees the sums alone a false force is a force: it is restored, and takes up "
        "what measurements there are",
        "finds most of them within some 200 frames, takes them out of the sums, and says so; takes "
        "a mask with the skin",
    ),
    "saturated": Sweep(
        "share of taxels saturated",
        "as stuck, at the largest force",
        "takes a mask with the skin; the maps of the monitor show them while nobody touches it",
    ),
    "rows": Sweep(
        "measurements that read 0",
        "a sum said to be 0 is an error as large as the sum, spread over the whole frame",
        "finds them by their residual, within 20 frames or so, leaves them out, and says so",
    ),
    "lost singly": Sweep(
        "share of frames lost, singly",
        "the last frame stands in, one frame old",
        "counts lost frames, and the summary says how many",
    ),
    "lost in bursts": Sweep(
        "share of frames lost, in bursts",
        "the last frame stands in, older than what has moved since, and the next one starts as far "
        "away as after a slip",
        "as above",
    ),
    "bits": Sweep(
        "bits of a measurement",
        "steps that fit the largest measurement hide what the small ones say",
        f"warns below {MIN_BITS}",
    ),
    "converter": Sweep(
        "bits of the converter",
        "steps larger than the noise are noise themselves, and no longer independent",
        "nothing: it cannot know of a converter before it",
        edges={"noise of the skin": bits_of_the_noise()},
    ),
}


def section(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Compute, draw and explain."""
    rows = rows_of(measure, points(quick, seed), out, executor, "faults")
    return [
        _TEXT,
        reasons_table(SWEEPS),
        draw_sweeps(out, "faults", "Faults, M = N/3.", rows, SWEEPS, 3),
        sweep_table(rows, SWEEPS),
        f"All figures: {write_csv(out, 'faults', rows)}.",
    ]
