"""Study `accuracy`: tables and charts of what is reconstructed, by frames, measurements, method."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.studies.baselines.sampling import (
    CODECS,
    DEAD_ZONE_N,
    JUMP_SIGMAS,
    NEWEST,
)
from sparseskin.studies.evaluate import (
    CLOSE,
    GHOST,
    LOADED,
    POOR,
    RIGHT,
    UNTOUCHED,
    VALUE_BYTES,
    VANISHED,
    WRONG,
)
from sparseskin.studies.frames import part_of, scene_of
from sparseskin.studies.harness import Candidate, unrefused
from sparseskin.studies.points import StudyError
from sparseskin.studies.report import Chart, Page, cells, draw_lines, markdown
from sparseskin.studies.stability.tables import FAR_FROM_READING, RESIDUE

from . import contacts, rounding, rules
from .constants import LEAST_ERROR, UNCHANGED, candidates, table
from .experiments import (
    ALL,
    ALONE,
    ALONE_FRAMES,
    CANDIDATES,
    DEFAULT,
    FILTERED,
    LONGEST_RECORDED,
    PAPER,
    QUICK_RECORDED,
    RATED_SCENES,
    RATES_HZ,
    RATIOS,
    RAW,
    SIMPLE,
    SKIN,
    SPEED,
    TOUCHED,
    Runs,
)

METHODS = (*CANDIDATES, ALL, FILTERED, RAW, *CODECS)
"""Order of the columns."""


def run(
    out: Path,
    quick: bool,
    seed: int,
    executor: str,
    recordings: Path | None = None,
    seeds: int = 1,
    constants: bool = False,
    alone: bool = False,
) -> list[str]:
    """Compute the study, write its page and return its conclusion; see `command.Study`.

    `recordings`: folder of recordings of real skins; `seeds`: their number, from `seed` on;
    `constants`, `alone`: add these sections, the second with sigpy.
    """
    if constants and recordings is None:
        raise StudyError("--constants: needs recordings, by --recordings DIR")
    runs = Runs(out, executor, quick, range(seed, seed + seeds), recordings)
    page = Page(out, "accuracy", Path(__file__).with_name("notes.md"), quick)
    of_filter = {
        "newest": NEWEST,
        "jump_sigmas": JUMP_SIGMAS,
        "dead_zone_n": DEAD_ZONE_N,
    }
    ratios = " / ".join(f"N/{ratio}" for ratio in RATIOS)
    page.section(
        "",
        value_bytes=VALUE_BYTES,
        ratios=ratios,
        seeds=seeds,
        **of_filter,
    )
    lines = []
    if recordings:
        lines += recorded(page, runs, quick)
    lines += [scenes(page, runs), rates(page, runs), moving(page, runs)]
    sizes(page, runs)
    of_contacts = [*contacts.sources(quick), *runs.recorded_frames()]
    rows = contacts.rows(out, executor, of_contacts, range(seed, seed + seeds))
    lines.append(touched(page, rows))
    lines.append(rounding.section(page, executor, of_contacts, seed))
    if constants:
        varied(page, runs)
        without_rules(page, runs, executor, quick, seed)
    if alone:
        lines.append(single(page, runs))
    page.write(lines)
    return lines


def by_ratio(rows: pd.DataFrame, keys: Sequence[str], text: str) -> pd.DataFrame:
    """Means of some rows by method: a line a key, cells of all ratios side by side.

    `text`: cell of one ratio, as "{mean_db:.1f}"; methods that have no figure are left out.
    """
    figures = [name for name in rows.columns if f"{{{name}:" in text]
    is_complete = rows[figures].notna().all(axis=1)
    complete = rows[is_complete].astype(dict.fromkeys(figures, float))
    groups = complete.groupby([*keys, "method", "ratio"], sort=False)
    means = groups[figures].mean().reset_index()

    # The cells of a method side by side, by ratio.
    means = means.assign(cell=cells(means, text))
    means = means.sort_values("ratio", kind="stable")
    of_method = means.groupby([*keys, "method"], sort=False)["cell"]
    joined = of_method.agg(" / ".join).unstack("method")
    lines = complete[list(keys)].drop_duplicates()
    order = [name for name in METHODS if name in joined]
    return lines.join(joined[order], on=list(keys)).fillna("-")


def over(rows: pd.DataFrame, keys: Sequence[str], reference: str) -> pd.Series:
    """PSNR of each row above that of a method on the same frames, dB; of its own ratio, or of 1."""
    of_reference = rows[rows["method"] == reference]
    by = [*keys, "seed"]
    if of_reference["ratio"].nunique() > 1:
        by.append("ratio")
    base_db = of_reference.set_index(by)["mean_db"].astype(float)
    same_frames = pd.MultiIndex.from_frame(rows[by])
    return rows["mean_db"].astype(float) - base_db.reindex(same_frames).array


def _size_text(scene: str) -> str:
    """Rows and columns of a scene."""
    n_rows, n_cols = scene_of(scene).shape
    return f"{n_rows} x {n_cols}"


def scenes(page: Page, runs: Runs) -> str:
    """Simulated scenes at their own rate: gain over preset paper, and PSNR."""
    rows = runs.scenes()
    rows["taxels"] = rows["scene"].map(_size_text)
    rows["gain"] = over(rows, ["scene"], PAPER)
    rows["over_raw"] = over(rows, ["scene"], RAW)
    ours = rows[rows["method"].isin([DEFAULT, SKIN])]
    page.csv("scenes", rows)
    page.section(
        "Simulated scenes",
        "Gain of the mean PSNR over preset paper, dB:",
        by_ratio(ours, ["taxels"], "{gain:+.1f}"),
        "The same over the raw reading of all taxels:",
        by_ratio(ours, ["taxels"], "{over_raw:+.1f}"),
        "Mean PSNR, dB:",
        by_ratio(rows, ["scene"], "{mean_db:.1f}"),
        "Least PSNR of a contact frame, dB:",
        by_ratio(rows, ["scene"], "{min_db:.1f}"),
        "Root mean square error of touched taxels, mN:",
        by_ratio(rows, ["scene"], "{touched_mn:.1f}"),
        *marks(rows, ["scene"]),
    )
    is_first = ours["ratio"] == RATIOS[0]
    of_default = ours[(ours["method"] == DEFAULT) & is_first]
    means = of_default.groupby("taxels", sort=False)["gain"].mean()
    gains = ", ".join(f"{gain:+.1f} dB ({taxels})" for taxels, gain in means.items())
    return f"Gain of {DEFAULT} over preset paper at N/{RATIOS[0]}, simulated scenes: {gains}."


def rates(page: Page, runs: Runs) -> str:
    """Scenes at lower frame rates, beside filters of the full reading."""
    rows = runs.rates()
    rows["gain"] = over(rows, ["scene", "spacing_ms"], PAPER)
    rows["spacing"] = cells(rows, "{spacing_ms:.3g} ms")
    keys = ["scene", "spacing"]
    page.csv("rates", rows)
    page.section(
        "Frame rates",
        _draw_rates(page.out, rows),
        "Gain of the mean PSNR over preset paper, dB:",
        by_ratio(rows[rows["method"] != PAPER], keys, "{gain:+.1f}"),
        "Mean / least PSNR of contact frames, dB:",
        by_ratio(rows, keys, "{mean_db:.1f} / {min_db:.1f}"),
    )
    means = rows.groupby(["method", "spacing_ms"])["mean_db"].mean()
    gain_texts = []
    for method in (PAPER, FILTERED):
        gain = means[DEFAULT] - means[method]
        # The highest rate, and the lowest.
        ends = (rows["spacing_ms"].min(), rows["spacing_ms"].max())
        texts = [f"{gain[ms]:+.1f} dB at {1000 / ms:.0f} Hz" for ms in ends]
        gain_texts.append(", ".join(texts))
    over_paper, over_filter = gain_texts
    return f"{DEFAULT} at N/3 against preset paper: {over_paper}; against a filter: {over_filter}."


def moving(page: Page, runs: Runs) -> str:
    """Bodies that move far from frame to frame, ramps and sudden contacts."""
    rows = runs.moving()
    rows["taxels"] = rows["shape"].map("{0[0]} x {0[1]}".format)
    page.csv("moving", rows)
    page.section(
        "Bodies that move",
        "Mean PSNR of contact frames, dB:",
        by_ratio(rows, ["taxels"], "{mean_db:.1f}"),
        by_ratio(rows, ["taxels", "course"], "{mean_db:.1f}"),
        "First frames of contacts:",
        by_ratio(rows, ["taxels", "course"], "{first_db:.1f}"),
        "By body:",
        by_ratio(rows, ["taxels", "course", "body"], "{mean_db:.1f}"),
        *marks(rows, ["taxels", "course"]),
        touched=100 * TOUCHED,
        speed=SPEED,
    )
    compared = rows[rows["ratio"].isin([1, RATIOS[0]])]
    mean_db = compared.groupby(["course", "method"])["mean_db"].mean()
    courses = []
    for course in rows["course"].unique():
        texts = []
        for method in (DEFAULT, PAPER, RAW):
            texts.append(f"{method} {mean_db[course, method]:.1f}")
        courses.append(f"{course}: {', '.join(texts)}")
    return f"Bodies at N/{RATIOS[0]}, mean PSNR in dB: {'; '.join(courses)}."


def sizes(page: Page, runs: Runs) -> None:
    """Contacts on small skins: how far off a reconstruction is, and which contacts it loses."""
    rows = runs.sizes()
    # Of a skin of scattered taxels, their number beside the size of the grid.
    numbers = []
    for n in rows["n_scattered"].astype(float):
        numbers.append(f", {n:.0f} taxels" if n > 0 else "")
    rows["taxels"] = rows["shape"].map("{0[0]} x {0[1]}".format) + numbers
    page.csv("sizes", rows)
    page.section(
        "Small skins",
        "Median relative error of contact frames in %:",
        by_ratio(rows, ["taxels"], "{median:.0f}"),
        f"Contact frames that have vanished, with an error of {100 * VANISHED:g} % or more, in %:",
        by_ratio(rows, ["taxels"], "{vanished:.0f}"),
    )


def single(page: Page, runs: Runs) -> str:
    """Single frames, beside total variation and Haar with the weight that is best in hindsight."""
    rows = unrefused(runs.frames_alone())
    rows = rows[rows["median"].notna()]  # frames in contact
    names = rows["path"].map(lambda path: Path(path).stem, "ignore")
    rows["of"] = names.fillna(rows["scene"])
    rows["method"] = rows["method"].str.rsplit(", ", n=1).str[0]
    rows = rows.astype({"median": float, "mean_ms": float})
    # The weight that is best in hindsight.
    groups = rows.groupby(["of", "ratio", "method"], sort=False)
    best = rows.loc[groups["median"].idxmin()]
    page.csv("alone", best.drop(columns=["path"]))
    text = best.assign(cell=cells(best, "{median:.1f}"))
    of_method = text.groupby(["of", "method"], sort=False)["cell"]
    joined = of_method.agg(" / ".join).unstack("method")
    times = best.groupby("method", sort=False)["mean_ms"].median()
    ours = best[best["method"] == SKIN].set_index(["of", "ratio"])["median"]
    parts = []
    beside_ours = best[best["method"] != SKIN]
    for method, of_other in beside_ours.groupby("method", sort=False):
        medians = of_other.set_index(["of", "ratio"])["median"]
        ahead = int((ours <= medians).sum())
        ms = f"{times[method]:.2g} ms"
        parts.append(f"{method} ({ms}) in {ahead} of {len(medians)}")
    line = (
        f"Frames alone, {SKIN} ({times[SKIN]:.2g} ms) is ahead of {'; '.join(parts)}."
    )
    page.section("Frames alone", joined.reset_index(), n=ALONE_FRAMES)
    return line


def touched(page: Page, rows: pd.DataFrame) -> str:
    """Contacts that are found, beside the true ones."""
    of_frames = rows.reindex(
        columns=["path", "scene", "kind", "body", "course", "strength"]
    )
    rows["frames"] = [*map(_source, of_frames.itertuples())]
    page.csv("contacts", rows.drop(columns=["path"], errors="ignore"))
    sums = _missed(rows)
    by_source = rows.assign(missed=100 - rows["found"].astype(float))
    keys = ["frames"]
    page.section(
        "Contacts",
        _draw_contacts(page.out, rows),
        "Frames from the begin of a contact to its event, median (95th percentile), and contacts "
        "that were found at all, in %:",
        by_ratio(rows, keys, "{delay:.0f} ({delay_95:.0f}), {begun:.0f}"),
        "True contacts that are missed, in % of all in all frames, by their total force in ranges "
        "of a taxel:",
        by_ratio(sums, ["force"], "{missed:.1f}"),
        "The same by source:",
        by_ratio(by_source, keys, "{missed:.1f}"),
        "Contacts where nothing touches, in 1000 frames:",
        by_ratio(rows, keys, "{ghosts:.0f}"),
        "Median error of the centre in mm:",
        by_ratio(rows, keys, "{off_mm:.2f}"),
        "Median error of the total force in %:",
        by_ratio(rows, keys, "{force:.1f}"),
        "True deviations of total and centre, by the median of the errors, in those stated:",
        by_ratio(rows, keys, "{total_sds:.1f}, {centre_sds:.1f}"),
        "Errors of total and centre within 1.645 stated deviations, of 90, in %:",
        by_ratio(rows, keys, "{total_held:.0f}, {centre_held:.0f}"),
        "The same, beside the true forces on the taxels of the contact that is published:",
        by_ratio(rows, keys, "{own_total_held:.0f}, {own_centre_held:.0f}"),
        "Ids lost and swapped, in 1000 frames of a contact:",
        by_ratio(rows, keys, "{lost:.1f}, {swapped:.1f}"),
        least=contacts.LEAST,
        ratios=" / ".join(f"N/{ratio}" for ratio in contacts.CONTACT_RATIOS),
    )
    groups = rows.astype({"found": float}).groupby(["method", "ratio"])
    means = groups["found"].mean()
    texts = []
    for ratio, mean in means[DEFAULT].items():
        texts.append(f"{mean:.1f} % at N/{ratio:g}")
    ours = ", ".join(texts)
    reading = means[RAW].iloc[0]
    return f"Contacts found, mean over the sources: {ours}, {reading:.1f} % in the full reading."


def _missed(rows: pd.DataFrame) -> pd.DataFrame:
    """True contacts that are missed, in %, by class of their force, method and ratio."""
    classes = rows.explode(["n_true", "n_missed"])
    classes["force"] = list(contacts.CLASSES) * len(rows)
    groups = classes.groupby(["force", "method", "ratio"], sort=False)
    sums = groups[["n_true", "n_missed"]].sum()
    sums = sums[sums["n_true"] > 0].reset_index()
    sums["missed"] = 100 * sums["n_missed"] / sums["n_true"]
    # In the order of the forces.
    has_contacts = set(sums["force"])
    order = [name for name in contacts.CLASSES if name in has_contacts]
    return sums.set_index("force").loc[order].reset_index()


def _source(row: Any) -> str:
    """Name of frames: that of the file or scene, body and course, or kind."""
    # A field that frames of this kind lack is NaN.
    if isinstance(row.body, str):
        strength = f" x {row.strength:g}" if row.strength < 1 else ""
        return f"{row.body} {row.course}{strength}"
    for name in (row.path, row.scene):
        if isinstance(name, str):
            return Path(name).stem
    kind: str = row.kind
    return kind.removesuffix("Frames").lower()


def varied(page: Page, runs: Runs) -> None:
    """Constants of the default solver, each halved and doubled; the table is printed too."""
    rows = runs.constants(candidates())
    changes = table(rows)
    print(markdown(changes))
    names = rows["path"].map(lambda path: Path(path).name, "ignore")
    page.csv("constants", rows.assign(recording=names).drop(columns=["path"]))
    page.section(
        "Constants",
        changes,
        least=LEAST_ERROR,
        ratio=max(RATIOS),
        wrong=100 * WRONG,
    )


def without_rules(
    page: Page, runs: Runs, executor: str, quick: bool, seed: int
) -> None:
    """Rules of the default solver and of the search for faults, each switched off."""
    unchanged = {UNCHANGED: Candidate(PRESETS["skin"])}
    rows = runs.constants(unchanged | rules.candidates(), "rules")
    n_worlds = rules.QUICK_WORLDS if quick else rules.N_WORLDS
    of_worlds = rules.worlds(page.out, executor, quick, seed)
    lines = rules.table(rows, of_worlds)
    print(markdown(lines))
    page.csv("rules", of_worlds)
    names = {
        "far": f"{FAR_FROM_READING:g}",
        "residue": f"{RESIDUE:.0%}",
        "n": n_worlds,
    }
    page.section("Rules", lines, ratio=max(RATIOS), **names)


def recorded(page: Page, runs: Runs, quick: bool) -> list[str]:
    """Recordings of real skins: errors, lost contacts, marks, and frames that are packed."""
    rows = runs.recordings()
    compared = rows[rows["ratio"] > 1]
    packed = rows[rows["ratio"] == 1]
    lines = [*geometric(rows), *beaten(rows), smaller(rows)]
    page.csv("recordings", rows.drop(columns=["path"]))
    keys = ["recording"]
    page.section(
        "Recordings",
        facts(rows, QUICK_RECORDED if quick else LONGEST_RECORDED),
        "\n".join(f"- {line}" for line in lines),
        "Median relative error of loaded frames in %:",
        by_ratio(compared, keys, "{median:.1f}"),
        "Mean:",
        by_ratio(compared, keys, "{mean:.1f}"),
        f"Loaded frames with a relative error of {100 * VANISHED:g} % or more, in %:",
        by_ratio(compared, keys, "{vanished:.0f}"),
        f"Untouched frames (total below {100 * UNTOUCHED:g} % of the 95th percentile) that are "
        f"reconstructed with more than {100 * GHOST:g} % of it, in %:",
        by_ratio(compared, keys, "{ghosts:.0f}"),
        loaded=100 * LOADED,
        simple=", ".join(SIMPLE),
        least=LEAST_ERROR,
    )
    page.section("Marks and estimated errors", *marks(rows, keys))
    failed = rows[rows["refused"] != ""].drop_duplicates(
        ["recording", "method", "ratio"]
    )
    page.section(
        "All taxels read",
        by_ratio(packed, keys, "{n_bytes:.0f} / {median:.3g}"),
        by_ratio(compared[compared["method"] == DEFAULT], keys, "{n_bytes:.0f}"),
        "\n".join(
            cells(failed, "- not computed: {recording}, {method}, N/{ratio}: {refused}")
        ),
    )
    return lines


def geometric(rows: pd.DataFrame) -> list[str]:
    """Return a line a kind of rows of the default solver: geometric mean over the recordings."""
    ours = rows["method"].isin(
        (DEFAULT, SKIN)
    )  # what reads all that matters may have no error
    with_error = rows[ours & rows["median"].notna() & (rows["ratio"] > 1)]
    logs = np.log(with_error["median"].astype(float))
    means = np.exp(logs.groupby([with_error["method"], with_error["ratio"]]).mean())
    lines = []
    for name in [default for default in (DEFAULT, SKIN) if default in means]:
        text = ", ".join(
            f"{mean:.2f} % at N/{ratio:g}" for ratio, mean in means[name].items()
        )
        lines.append(f"{name}: geometric mean of the median errors {text}.")
    return lines


def beaten(rows: pd.DataFrame) -> list[str]:
    """Return a line a ratio: where the best simple method beats the default."""
    with_error = rows[(rows["ratio"] > 1) & rows["median"].notna()].astype(
        {"median": float}
    )
    keys = ["recording", "ratio"]
    lines = []
    means = (
        with_error.groupby([*keys, "method"], sort=False)["median"]
        .mean()
        .unstack("method")
    )
    best = means[[name for name in SIMPLE if name in means]].min(axis=1)
    quotient = means[DEFAULT].clip(LEAST_ERROR) / best.clip(LEAST_ERROR)
    quotients = quotient.dropna().rename("quotient").reset_index()
    for ratio, of_ratio in quotients.groupby("ratio", sort=True):
        worse = list(of_ratio[of_ratio["quotient"] > 1]["recording"])
        names = f" ({', '.join(worse)})" if worse else ""
        lines.append(
            f"N/{ratio:g}: the best simple method beats {DEFAULT} on {len(worse)} of "
            f"{len(of_ratio)} recordings{names}; median quotient of the errors "
            f"{of_ratio['quotient'].median():.2f}."
        )
    return lines


def smaller(rows: pd.DataFrame) -> str:
    """Return the line on all taxels in 8 bits, packed, beside the default."""
    sent = rows.astype({"n_bytes": float, "median": float}).drop_duplicates(
        ["recording", "method", "ratio"]
    )
    codec = sent[sent["method"] == CODECS[0]].set_index("recording")
    ours = sent[(sent["method"] == DEFAULT) & (sent["ratio"] > 1)]
    is_smaller = ours["recording"].map(codec["n_bytes"]) < ours["n_bytes"]
    counts = ", ".join(
        f"at N/{ratio:g} on {int(of_ratio.sum())} of {len(of_ratio)}"
        for ratio, of_ratio in is_smaller.groupby(ours["ratio"], sort=True)
    )
    error = f"error {codec['median'].median():.2g} % in the median"
    packed = f"All taxels in 8 bits, packed by zstd, are fewer bytes than {DEFAULT}"
    return f"{packed}: {counts} recordings; {error}."


def marks(rows: pd.DataFrame, keys: list[str]) -> tuple[Any, ...]:
    """Return tables and lines of the frames that are marked, and of the estimated errors."""
    rows = rows[(rows["ratio"] > 1) & rows["flagged"].notna()]
    return (
        "Marked frames, in %:",
        by_ratio(rows, keys, "{flagged:.0f}"),
        "Estimated over true RMS error of contact frames: median (5th to 95th percentile):",
        by_ratio(
            rows,
            keys,
            "{estimate_median:.2f} ({estimate_low:.2f} to {estimate_high:.2f})",
        ),
        f"The same: frames within a factor of {CLOSE:g}, in %:",
        by_ratio(rows, keys, "{estimate_close:.0f}"),
        "True forces of touched taxels within 1.645 standard deviations, of 90, in %:",
        by_ratio(rows, keys, "{held:.0f}"),
        "The same, of bands by the true RMS error of each frame in place of the estimated one:",
        by_ratio(rows, keys, "{held_by_true:.0f}"),
        "\n".join(f"- {line}" for line in marked(rows)),
    )


def marked(rows: pd.DataFrame) -> list[str]:
    """Return a line a method whose solver estimates its error: wrong and right frames it marks."""
    lines = []
    for name, of_method in rows.groupby("method", sort=False):
        parts = []
        bounds = {
            "wrong": f"above {100 * WRONG:g} %",
            "right": f"below {100 * RIGHT:g} %",
        }
        for which, bound in bounds.items():
            share, n = _share(of_method[f"flagged_{which}"], of_method[f"n_{which}"])
            parts.append(f"{share:.1f} % of {n:.0f} frames with an error {bound}")
        share, n = _share(of_method["flagged_poor"], of_method["n_flagged"])
        poor = f"{share:.0f} % of {n:.0f} marked ones are above {100 * POOR:g} %"
        lines.append(f"{name} marks {' and '.join(parts)}; {poor}")
    return lines


def _share(shares: pd.Series, counts: pd.Series) -> tuple[float, float]:
    """Return the mean of some shares by their counts, and the sum of these."""
    n = counts.astype(float)
    return float((shares.astype(float).fillna(0) * n).sum() / max(1.0, n.sum())), float(
        n.sum()
    )


def facts(rows: pd.DataFrame, n_most: int) -> pd.DataFrame:
    """Facts of the recordings."""
    lines = []
    for (name, path), of_part in rows.groupby(["recording", "path"], sort=False):
        part = part_of(str(path), n_most)
        x = part.truth[:, part.mask].astype(np.float64)
        changes = np.linalg.norm(np.diff(x, axis=0), axis=1)
        norms = np.linalg.norm(x[1:], axis=1)
        loaded = norms > LOADED * part.norm
        change = np.median(changes[loaded] / norms[loaded]) if loaded.any() else 0.0
        stop = part.first + len(part.frames)
        lines.append(
            {
                "recording": name,
                "N": x.shape[1],
                "unit": part.unit,
                "grid": "{} x {}".format(*part.mask.shape),
                "frames": f"{part.first}..{stop - 1} of {part.n_recorded}",
                "loaded": int(of_part["n_contact"].max() or 0),
                "untouched": int(of_part["n_untouched"].max() or 0),
                "spacing": "-"
                if part.spacing_ms is None
                else f"{part.spacing_ms:.3g} ms",
                "pressed, %": f"{100 * np.mean(x > 0):.0f}",
                "change, %": f"{100 * change:.1f}",
            }
        )
    return pd.DataFrame(lines)


def _draw_contacts(out: Path, rows: pd.DataFrame) -> str:
    caption = "Contacts found, of all true ones in all frames, by bytes per taxel in each frame"
    with_contacts = rows[rows["found"].notna()].astype({"found": float})
    with_contacts["bytes"] = VALUE_BYTES / with_contacts["ratio"]
    with_contacts["recorded"] = with_contacts["kind"] == "RecordedFrames"
    means = (
        with_contacts.groupby(["recorded", "frames", "bytes", "ratio"])["found"]
        .mean()
        .reset_index()
    )
    panels = [(of, of_kind) for of, of_kind in means.groupby("recorded")]
    ratios = sorted(means["ratio"].unique())
    names = [f"N/{ratio}" if ratio > 1 else "all" for ratio in ratios]
    ticks = [VALUE_BYTES / ratio for ratio in ratios]
    n = len(panels)
    labels = [f"{name}\n{tick:.3g}" for name, tick in zip(names, ticks, strict=True)]
    with Chart(
        out, "contacts", caption, n, n, size_in=(9.5, 5.0), sharey=True
    ) as chart:
        for axes, (recorded, of_kind) in zip(chart.panels, panels, strict=True):
            draw_lines(
                axes,
                of_kind,
                "bytes",
                "found",
                "frames",
                list(means["frames"].unique()),
            )
            axes.set_xscale("log")
            axes.set_xticks(ticks, labels)
            axes.set_xticks([], minor=True)
            axes.set_ylim(0, 103)
            axes.set_title("recordings" if recorded else "simulated")
        chart.label("measurements\nbytes per taxel", "contacts found, %")
    return chart.markdown


def _draw_rates(out: Path, rows: pd.DataFrame) -> str:
    drawn = (DEFAULT, ALL, FILTERED, RAW, ALONE, "hold")
    caption = (
        "Gain of mean PSNR over preset paper at N/3, by frame rate; contact frames"
    )
    n = len(RATED_SCENES)
    ticks = [1000 / rate for rate in RATES_HZ]
    labels = [f"{rate}\n{ms:.3g}" for rate, ms in zip(RATES_HZ, ticks, strict=True)]
    with Chart(
        out,
        "gain",
        caption,
        n,
        n,
        size_in=(9.5, 4.4),
        legend_columns=3,
        sharey=True,
    ) as chart:
        for axes, scene in zip(chart.panels, RATED_SCENES, strict=True):
            of_scene = rows[(rows["scene"] == scene) & rows["method"].isin(drawn)]
            means = (
                of_scene.groupby(["method", "spacing_ms"], sort=False)["gain"]
                .mean()
                .reset_index()
            )
            draw_lines(axes, means, "spacing_ms", "gain", "method", drawn)
            axes.axhline(0, color="black", linewidth=1.2)
            axes.set_xscale("log")
            axes.set_xticks(ticks, labels)
            axes.set_xticks([], minor=True)
            axes.set_title(scene)
        chart.label("frame rate, Hz\nframe spacing, ms", "gain over paper, dB")
    return chart.markdown
