"""The study `speed-accuracy`: solve time and bytes sent against PSNR, and other libraries."""

from __future__ import annotations

import sys
from pathlib import Path

from sparseskin.nodes.reconstructor.presets import PRESETS

from .points import compute
from .speed_charts import draw_bytes, draw_parts, draw_race, draw_speed
from .speed_design import CENTRE_RATIO, QUICK_SCENES, SCENES, design
from .speed_page import write_speed_page
from .speed_peers import PEERS, missing_peers
from .speed_points import full_reading, timed
from .speed_race import race
from .speed_rows import gather

#: One process at a time, so that what is timed has its core to itself.
TIMED_ON = "process:1"


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the points and write the page.

    Parameters
    ----------
    out : Path
        Folder to write to, which exists.
    quick : bool
        Two scenes, fewer frames, iterations and M.
    seed : int
        Of noise, Phi and the peg's path.
    executor : str
        For what is not timed; solve times are measured on this host, one point at a time.
    """
    scenes = QUICK_SCENES if quick else SCENES
    full, full_short = (
        dict(
            zip(
                scenes,
                compute(
                    full_reading,
                    [{"scene": scene, "seed": seed, "short": short} for scene in scenes],
                    *(out, executor, "full readings"),
                ),
                strict=True,
            )
        )
        for short in (quick, True)
    )
    points = design(quick, seed)
    figures = compute(timed, points, out, TIMED_ON, "solvers")
    absent = missing_peers()
    for peer in absent:
        print(
            f"{peer} is left out: it is not installed (pip install 'sparseskin[peers]')",
            file=sys.stderr,
        )
    runners = [
        {
            **{"peer": peer, "scene": scene, "seed": seed, "short": quick},
            **{"ratio": CENTRE_RATIO, "lambda_n": PRESETS["paper"]["lambda_n"]},
            "n_frames": 4 if quick else 10,
        }
        for scene in scenes
        for peer in PEERS
        if peer not in absent
    ]
    raced = compute(race, runners, out, TIMED_ON, "libraries")
    ran = [{**point, **found} for point, found in zip(runners, raced, strict=True)]
    results = gather(points, figures, quick, full, full_short, ran)
    charts = [
        *(draw_speed(out, results, pooled=True), draw_speed(out, results, pooled=False)),
        *(draw_bytes(out, results, pooled=True), draw_bytes(out, results, pooled=False)),
        *(draw_race(out, results), draw_parts(out, results)),
    ]
    write_speed_page(out, results, charts, absent, quick)
