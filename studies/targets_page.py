"""The page of study `targets`: what was to be reached, what is, and by what."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import product
from pathlib import Path
from statistics import mean
from typing import Any

from .report import markdown_table, write_csv, write_page
from .targets_bands import bands_table
from .targets_charts import draw_ablation, draw_gain
from .targets_peer import PAPER
from .targets_points import DEAD_ZONES_N, LIGHT_TOUCH_N, RANDOM, TOLD_N

Pairs = Sequence[tuple[dict[str, Any], dict[str, Any]]]
Methods = dict[str, dict[str, float]]
RATIOS = (3, 4, 8)
METHODS = ("skin", "skin, rotating")
#: Gain over preset paper to reach, dB, by number of taxels and ratio.
WANTED_DB = {1600: {3: 12, 4: 14, 8: 17}, 4096: {3: 11, 4: 12, 8: 17}}
WANTED_WORST_DB = 13
WANTED_FOUND = 0.95
_INTRODUCTION = """\
# Targets

The solver "skin" with its defaults, on the six scenes of the paper and on random ones (bodies of
random shape, pressed, slid, tapped, rolled, several at once) that no solver was tuned on. All
methods of a line have the same frames and noise, and the same measurements but for *skin,
rotating*, whose rows rotate: M others in each frame until all of W have been read, M being N /
ratio rounded up. PSNR is that of contact frames, peak 2.5 N; *paper* is preset paper (FISTA,
Haar, 30 iterations), *tuned* the same with the lambda that serves it best, *denoised* the full
reading put through "skin" (M = N): what the solver makes of all taxels, without compression.
Scenes are read from 20 frames before the first contact on."""
_DIFFERENCES = """\
What is missed, and why:

- With fixed rows, at N/8, an estimate that explains the measurements with the wrong outline is
  kept for long, as no measurement speaks against it. With rotating rows the next frames do, and
  most of that is won back. What remains are scenes in which paper does well already (a peg that
  lies still), and several bodies at once, of which 200 measurements a frame say too little.
- The worst frame is a first contact, or the frames of an impact in which a large body's outline
  has to be found anew. There the prediction knows nothing, and rotating rows cannot help: where
  everything moves within as few frames as a round of turns has, they are a little worse. Where
  paper's own worst frame is good already (43 dB in the scenes of 64 x 64 taxels at N/3), 13 dB
  more would be 8 dB above all taxels read and denoised.
- Above the raw reading means little for an untouched skin, whose reading has a floor of one-sided
  noise; so the reading with its best dead zone (the one that serves the scene best, which no user
  could know) and the denoised reading stand beside it, and the error over touched taxels alone."""


def write(
    out: Path, restored: Pairs, touched: Pairs, banded: Pairs, recorded: Pairs, ablated: Pairs
) -> None:
    """Write tables, charts and the page into a folder.

    Parameters
    ----------
    out : Path
    restored, touched, banded, recorded, ablated : sequence of (point, figures)
        As `targets_points`, `targets_bands` and `targets_ablation` give them.
    """
    by_scene = _by_scene(restored)
    parts = [
        _INTRODUCTION,
        "## Reached",
        _reached(by_scene),
        _DIFFERENCES,
        "## Scenes",
        *(draw_gain(out, method, _gains(by_scene, method)) for method in METHODS),
        _scene_table(by_scene),
        write_csv(out, "scenes", _rows(restored)),
        "## Error over touched taxels, and time",
        _touched_table(by_scene),
        "## Light touch",
        _light_table(touched),
        "## Uncertainty",
        bands_table(banded),
        "## Recordings of real skins",
        _recorded_table(recorded),
        "## What each ingredient earns",
        *_ablation(out, ablated),
    ]
    write_page(out, "targets", parts)


def _by_scene(restored: Pairs) -> dict[str, dict[int, dict[str, Any]]]:
    found: dict[str, dict[int, dict[str, Any]]] = {}
    for point, figures in restored:
        found.setdefault(point["scene"], {})[point["ratio"]] = figures
    return found


def _rows(restored: Pairs) -> list[dict[str, Any]]:
    return [
        {"scene": point["scene"], "n": figures["n"], "ratio": point["ratio"], "method": name}
        | figures_of
        for point, figures in restored
        for name, figures_of in figures["methods"].items()
    ]


def _best_zone(reading: Methods) -> tuple[str, float]:
    names = [f"dead zone {zone:.2f} N" for zone in DEAD_ZONES_N]
    best = max(names, key=lambda name: reading[name]["mean_db"])
    return best, reading[best]["mean_db"]


def _gain(ratios: dict[int, dict[str, Any]], ratio: int, method: str, figure: str) -> float:
    methods = ratios[ratio]["methods"]
    return float(methods[method][figure] - methods["paper"][figure])


def _gains(
    by_scene: dict[str, dict[int, dict[str, Any]]], method: str
) -> dict[str, dict[int, float]]:
    return {
        scene: {ratio: _gain(ratios, ratio, method, "mean_db") for ratio in RATIOS}
        for scene, ratios in by_scene.items()
    }


def _reached(by_scene: dict[str, dict[int, dict[str, Any]]]) -> str:
    rows = []
    for n, wanted in WANTED_DB.items():
        scenes = {name: r for name, r in by_scene.items() if r[3]["n"] == n}
        groups: list[tuple[str, Callable[[str], bool]]] = [
            ("the paper's", lambda name: not name.startswith(RANDOM)),
            ("random", lambda name: name.startswith(RANDOM)),
        ]
        for label, belongs in groups:
            group = [r for name, r in scenes.items() if belongs(name)]
            for ratio, method in product(RATIOS, METHODS) if group else ():
                gains = [_gain(r, ratio, method, "mean_db") for r in group]
                worst = [_gain(r, ratio, method, "min_db") for r in group]
                over = [_over_reading(r, ratio, method) for r in group]
                zone = [_over_zone(r, ratio, method) for r in group]
                rows.append(
                    [
                        f"{n}, {label}",
                        f"N/{ratio}",
                        method,
                        f"{mean(gains):+.1f} ({min(gains):+.1f})",
                        f"{wanted[ratio]:+d}",
                        f"{mean(worst):+.1f}",
                        f"{WANTED_WORST_DB:+d}" if ratio == 3 else "",
                        f"{mean(over):+.1f} ({min(over):+.1f})",
                        f"{mean(zone):+.1f}",
                    ]
                )
    header = [
        *("taxels, scenes", "M", "method", "gain over paper, dB: mean (least)", "wanted"),
        *("worst frame, dB: mean", "wanted", "over the raw reading: mean (least)"),
        "over its best dead zone",
    ]
    return markdown_table(header, rows)


def _over_reading(ratios: dict[int, dict[str, Any]], ratio: int, method: str) -> float:
    restored = ratios[ratio]["methods"][method]["mean_db"]
    return float(restored - ratios[1]["methods"]["raw"]["mean_db"])


def _over_zone(ratios: dict[int, dict[str, Any]], ratio: int, method: str) -> float:
    restored = ratios[ratio]["methods"][method]["mean_db"]
    return float(restored - _best_zone(ratios[1]["methods"])[1])


def _scene_table(by_scene: dict[str, dict[int, dict[str, Any]]]) -> str:
    rows = []
    for scene, ratios in by_scene.items():
        reading = ratios[1]["methods"]
        zone, zone_db = _best_zone(reading)
        for ratio in sorted(set(ratios) - {1}):
            methods = ratios[ratio]["methods"]
            rows.append(
                [
                    scene,
                    f"N/{ratio}",
                    *(_mean_and_min(methods[name]) for name in methods),
                    _mean_and_min(reading["raw"]),
                    f"{zone_db:.1f} ({zone.split()[2]} N)",
                    _mean_and_min(reading["skin"]),
                ]
            )
    header = ["scene", "M", "paper", "tuned", *METHODS, "raw", "raw, best dead zone", "denoised"]
    return "Mean and worst contact frame, dB:\n\n" + markdown_table(header, rows)


def _mean_and_min(figures: dict[str, float]) -> str:
    return f"{figures['mean_db']:.1f} / {figures['min_db']:.1f}"


def _touched_table(by_scene: dict[str, dict[int, dict[str, Any]]]) -> str:
    rows = []
    for scene, ratios in by_scene.items():
        for ratio in RATIOS:
            methods, reading = ratios[ratio]["methods"], ratios[1]["methods"]
            compared = [methods[name] for name in ("paper", *METHODS)]
            touched = [figures["touched_n"] * 1e3 for figures in (reading["raw"], *compared)]
            times = [f"{f['p50_ms']:.2f} / {f['p99_ms']:.2f}" for f in compared]
            peer = ratios[ratio]["pylops_ms"]
            than_peer = ["", "", ""]
            if peer is not None:
                than_peer = [f"{peer:.1f}", *(f"{peer / f['p50_ms']:.1f}" for f in compared[::2])]
            cells = (*(f"{value:.1f}" for value in touched), *times, *than_peer)
            rows.append([scene, f"N/{ratio}", *cells])
    header = ["scene", "M", "raw, mN"]
    header += [f"{name}, {unit}" for unit in ("mN", "ms") for name in ("paper", *METHODS)]
    header += ["PyLops, ms", "times paper", f"times {METHODS[-1]}"]
    text = (
        "RMS error over touched taxels in contact frames; solve time p50 / p99. Beside it the time "
        f"of {PAPER['iterations']} iterations of FISTA in PyLops, p50, with our operators as its "
        "own linear operator, on the same measurements, and how many times that is ours:\n\n"
    )
    return text + markdown_table(header, rows)


def _light_table(touched: Pairs) -> str:
    rows = [
        [
            f"{point['side']} x {point['side']}",
            point["solver"],
            f"{100 * figures['found']:.0f} %",
            f"{100 * figures['false']:.1f} %",
        ]
        for point, figures in touched
    ]
    text = (
        f"{LIGHT_TOUCH_N} N on 3 x 3 taxels at a random place, M = N/4: found within three frames "
        f"(wanted: {100 * WANTED_FOUND:.0f} %), told by a mean of nine taxels above {TOLD_N} N; "
        "and how many untouched frames have such a mean too.\n\n"
    )
    return text + markdown_table(["taxels", "solver", "found", "false, untouched frames"], rows)


def _recorded_table(recorded: Pairs) -> str:
    if not recorded:
        return "None given: state their folder with `--recordings DIR`."
    rows = [
        [
            Path(point["path"]).name,
            str(figures["n"]),
            point["solver"],
            f"N/{point['ratio']}",
            f"{figures['error']:.3f}",
            f"{figures['p50_ms']:.2f}",
        ]
        for point, figures in recorded
    ]
    text = (
        "Mean relative error of contact frames (wanted: skin at N/4 no more than paper at N/2). "
        "There is no truth but the recording itself, at tens of frames a second, so that each "
        "frame is a jump and many iterations are done.\n\n"
    )
    header = ["recording", "taxels", "solver", "M", "relative error", "solve p50, ms"]
    return text + markdown_table(header, rows)


def _ablation(out: Path, ablated: Pairs) -> Iterable[str]:
    names = list(ablated[0][1])
    whole = names[0]
    rows = []
    kinds = list(dict.fromkeys((point["ratio"], point["rows"]) for point, _ in ablated))
    losses: dict[str, list[float]] = {f"N/{ratio}, {how}": [] for ratio, how in kinds}
    for name in names:
        cells = [name]
        for (ratio, how), loss in zip(kinds, losses.values(), strict=True):
            of_kind = [f for point, f in ablated if (point["ratio"], point["rows"]) == (ratio, how)]
            change = [f[name]["mean_db"] - f[whole]["mean_db"] for f in of_kind]
            worst = [f[name]["min_db"] - f[whole]["min_db"] for f in of_kind]
            time = mean(f[name]["p50_ms"] - f[whole]["p50_ms"] for f in of_kind)
            loss.append(mean(change))
            cells += [f"{mean(change):+.2f}", f"{mean(worst):+.2f}", f"{time * 1e3:+.0f}"]
        rows.append(cells)
    header = ["without"]
    for kind in losses:
        header += [f"{kind}: mean, dB", "worst frame, dB", "p50, µs"]
    yield draw_ablation(out, names[1:], {kind: loss[1:] for kind, loss in losses.items()})
    yield markdown_table(header, rows[1:])
    yield (
        "The doubt of a lagging filter earns its place on recordings of few frames a second, "
        "where it keeps the filter from taking motion for noise; at a kilohertz it does nothing. "
        "Rows of earlier phases are those of rotating rows."
    )
