"""Text of the monitor for a terminal: a line while the graph runs, a table at its end."""

import textwrap
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from sparseskin.messages.contacts import sum_unit, summary
from sparseskin.messages.reasons import Reason, phrase_of
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import counted

from .metrics import FLOAT_BITS, PatchMetrics

Summary = Mapping[str, Any]
"""The summary of a patch, as `PatchMetrics.summary` returns it, or a part of it."""
NONE = "-"
WIDTH = 78
LABELS = {"m": "M", "kind": "phi", "sigma_mid": "noise sigma"}
MAX_CHANGES = 4
"""Changes of settings that the table lists."""
LATE_MS = 200.0
"""Median latency that stands before everything but the frames, milliseconds; chosen: a graph that
falls behind shows, and no other does."""
QUEUED_MS = 500.0
"""Latency of the newest frame that only a queue causes, milliseconds; chosen."""
FEW = 4
"""Most patches that are shown with all their figures; of more, each has one row."""


def status_line(patches: Mapping[str, PatchMetrics], rate_hz: float) -> str:
    """State of one patch, or of several, in one line whose parts stand by their weight, for a
    terminal to leave out the last ones.

    Contacts of the newest frames, or their total force; then the figures of the table of contact
    frames, mean PSNR and share trusted by the solver, and latency, that of the readings, and since
    when. Of several, frames, skips and losses are those of the worst patch, PSNR is the mean,
    latency that of the slowest; `rate_hz` is the mean of their rates.
    """
    metrics = list(patches.values())
    latency, p50_ms = _latency(metrics)
    # A narrow terminal cuts off the last parts: what is wrong comes first.
    is_late = p50_ms >= LATE_MS

    parts = [_progress(patches, rate_hz)]
    if is_late:
        parts += latency
    parts += _contacts(metrics)
    if len(metrics) > 1:
        parts.append(f"idle {sum(m.idle for m in metrics)}")
    noisy_db = [m.noisy.contact.mean for m in metrics if m.noisy.contact.count]
    to_what = " to taxels"
    if noisy_db:
        # The truth is known: PSNR is to it.
        to_what = ""
    parts += _accuracy(metrics, to_what)
    if not is_late:
        parts += latency
    if noisy_db:
        mean_db = sum(noisy_db) / len(noisy_db)
        parts.append(f"taxels {mean_db:.1f} dB")
    since = _since(metrics[0].since_ns).strip()
    if since:
        parts.append(since)
    return " | ".join(parts)


def _progress(patches: Mapping[str, PatchMetrics], rate_hz: float) -> str:
    """Frames, their rate, losses, and the age of the newest one where it waits in a queue."""
    metrics = list(patches.values())
    n_frames = min(m.reconstructed for m in metrics)
    n_lost = max(m.lost_so_far for m in metrics)

    name = next(iter(patches))
    rate = f"{rate_hz:.0f} Hz"
    if len(metrics) > 1:
        name = f"{len(metrics)} patches"
        # One rate stands for all: patches of a graph are sensed together.
        rates_hz = [m.skin.rate_hz for m in metrics if m.skin is not None]
        asked_hz = max(rates_hz, default=0.0)
        if asked_hz:
            rate = f"{rate_hz:.0f} of {asked_hz:g} Hz"
        n_skipped = max(m.skipped for m in metrics)
        rate += f", skipped {n_skipped}"
    text = f"{name}: {n_frames} frames, {rate}, lost {n_lost}"

    # No frame is lost in a queue, but it ages there.
    ages_ns = [m.latency_ns or 0 for m in metrics]
    age_ms = max(ages_ns) / 1e6
    if age_ms >= QUEUED_MS:
        text += f", newest {age_ms / 1e3:.1f} s old"
    return text


def _accuracy(patches: Sequence[PatchMetrics], to_what: str) -> Iterator[str]:
    """Mean PSNR of contact frames and the share that the solver trusts, where there are any."""
    psnr_db = []
    for metrics in patches:
        in_contact = metrics.reconstruction.contact
        if in_contact.count:
            psnr_db.append(in_contact.mean)
    if psnr_db:
        mean_db = sum(psnr_db) / len(psnr_db)
        yield f"PSNR{to_what} {mean_db:.1f} dB"

    trust = [m.trust.contact for m in patches if m.trust.contact.count]
    if trust:
        # A trusted frame counts 1, any other 0.
        n_trusted = sum(extent.total for extent in trust)
        n_frames = sum(extent.count for extent in trust)
        share = n_trusted / n_frames
        yield f"trusted {share_of(share)}"


def _contacts(patches: Sequence[PatchMetrics]) -> list[str]:
    """Contacts of the newest frames and their force; where they are not published, the force."""
    units = [m.skin.unit for m in patches if m.skin is not None]
    contacts = [m.contacts for m in patches if m.contacts is not None]
    loads = [m.load for m in patches if m.load is not None]
    if contacts and units:
        n_contacts = sum(c.id.size for c in contacts)
        totals = [float(c.total.sum()) for c in contacts]
        total = sum(totals)
        return [summary(n_contacts, total, units[0])]
    if any(loads):
        unit = sum_unit(units[0])
        noise_sum = sum(m.solver.noise_sum for m in patches if m.solver is not None)
        if not noise_sum:
            return [f"{sum(loads):.3g} {unit}"]
        untouched = f"an untouched skin shows about {noise_sum:.3g} {unit}"
        return [f"{sum(loads):.3g} {unit} ({untouched})"]
    if loads:
        return ["no contact"]
    return []


def _latency(patches: Sequence[PatchMetrics]) -> tuple[list[str], float]:
    """Latency of the slowest patch as text and its median; none where it is unknown."""
    stated = []
    for metrics in patches:
        quantiles = metrics.latency.summary()
        if quantiles is not None:
            within_ns = metrics.latency_uncertainty_ns
            stated.append((quantiles["p50"], quantiles["p99"], within_ns))
    if not stated:
        return [], 0.0
    p50_ms, p99_ms, within_ns = max(stated, key=lambda latency: latency[:2])
    text = f"latency p50 {p50_ms:.1f}, p99 {p99_ms:.1f} ms"
    if within_ns:
        text += f" ± {within_ns / 1e6:.1f}"
    return [text], p50_ms


def summary_table(graph: str, patches: Mapping[str, Summary]) -> str:
    """The summary of every patch of a graph as text for a terminal of 80 columns."""
    if len(patches) > FEW:
        text = _many_table(graph, patches)
    else:
        tables = [_patch_table(graph, *entry) for entry in patches.items()]
        text = "\n".join(tables)
    doubts = doubts_text(patches.values())
    if doubts:
        text += f"\n{doubts}"
    return text


def doubts_text(patches: Iterable[Summary]) -> str:
    """Number of frames that are not to be trusted, their reasons, and what may help; "" of none."""
    # A patch without any judged frame has no trust to report.
    judged = [patch for patch in patches if patch["trust"]["all"]]
    trusts = [patch["trust"]["all"] for patch in judged]
    n_untrusted = sum(trust["untrusted"] for trust in trusts)
    n_frames = sum(trust["frames"] for trust in trusts)
    if not n_untrusted:
        return ""

    counts: Counter[str] = Counter()
    for patch in judged:
        counts.update(patch["doubts"])
    are = "are"
    if n_untrusted == 1:
        are = "is"
    text = f"{n_untrusted} of {n_frames} frames {are} in doubt{_reasons(counts)}."
    # Where all taxels are read there are no more measurements.
    compressed = [patch for patch in judged if patch.get("ratio") != 1]
    if counts[Reason.ERROR] and compressed:
        remedy = "more measurements"
        if any(patch["rows"] != "rotating" for patch in judged):
            remedy += " or rotating rows"
        text += f" If the error lasts, {remedy} may help."
    return textwrap.fill(text, WIDTH)


def _reasons(counts: Counter[str]) -> str:
    """The reasons of frames, each with its number of frames where there are several reasons."""
    if len(counts) == 1:
        return "".join(f": {phrase_of(word)}" for word in counts)
    text = ""
    for word, count in counts.most_common():
        text += f"; in {counted(count, 'frame')}: {phrase_of(word)}"
    return text


def _patch_table(graph: str, name: str, patch: Summary) -> str:
    """The summary of one patch as text, `WIDTH` characters wide."""
    patch = {key: _cell(value) for key, value in patch.items()}
    # What was launched, and what was sensed where that has another name.
    title = printable(name)
    if graph:
        title = printable(f"{graph}: {name}")
    if patch["scene"] not in (NONE, graph):
        title += f", {patch['scene']}"

    # A table of nothing would be all dashes.
    frames = patch["frames"]
    if not frames["sensed"] and not frames["reconstructed"]:
        return f"{title}: ended before the first frame"

    rows = [f" {title} ".center(WIDTH, "=")]
    if patch["changes"]:
        rows.append(_changes(patch["changes"]))
    rows += [
        f"frames      {_frames_text(patch)}",
        f"measured    {_measured_text(patch)}",
        f"solver      {_solver_text(patch)}",
        f"bytes       {_bytes_text(patch)}",
        f"time        {_time_text(patch)}",
        *_score_rows(patch),
    ]
    return "\n".join([*rows, "=" * WIDTH])


def _cell(value: Any) -> Any:
    """A value of the summary as the table holds it: "-" for None, texts without control codes."""
    if value is None:
        return NONE
    if isinstance(value, str):
        return printable(value)
    return value


def _frames_text(patch: Summary) -> str:
    frames = patch["frames"]
    text = f"sensed {frames['sensed']}, reconstructed {frames['reconstructed']}, "
    if frames["skipped"]:
        text += f"skipped {frames['skipped']}, "
    text += f"lost {frames['lost']}"
    if patch["compared"] < frames["reconstructed"]:
        why = _since(patch["since_ns"]) or " (the others came too late)"
        text += f";\n            figures of {patch['compared']}{why}"
    return text


def _measured_text(patch: Summary) -> str:
    phi = patch["phi"]
    if patch["rows"] == "rotating":
        phi += ", rotating rows"
    ratio = shown(patch["ratio"], ".2f")
    f_min = shown(patch["f_min"], "g")
    f_max = shown(patch["f_max"], "g")
    text = f"{phi}: N = {patch['n']}, M = {patch['m']} (ratio {ratio}), "
    text += f"range {f_min}..{f_max} {patch['unit']}"
    if patch["bits"] not in (NONE, FLOAT_BITS):
        text += f", {patch['bits']} bits"
    return text


def _solver_text(patch: Summary) -> str:
    text = str(patch["solver"])
    if patch["basis"]:
        text += f" in {patch['basis']}"
    text += f", {patch['iterations']}"
    if patch["max_iterations"] not in (NONE, 0):
        text += f" to {patch['max_iterations']}"
    text += " iterations"
    if patch["frame_ms"] not in (NONE, 0):
        text += f" ({patch['frame_ms']:.2g} ms on a full skin)"
    if patch["preset"] not in ("", NONE):
        text += f" (preset {patch['preset']})"
    return text


def _bytes_text(patch: Summary) -> str:
    # None come in where frames are compressed outside the graph.
    n_in = patch["bytes_in"]
    n_out = patch["bytes_out"]
    text = f"measurements {n_out:,}"
    if n_in:
        text = f"taxels {n_in:,}, {text}"
    if n_in and n_out:
        text += f" (1/{n_in / n_out:.2f})"
    return text


def _time_text(patch: Summary) -> str:
    text = f"latency {_times(patch['latency_ms'])}"
    if patch["latency_uncertainty_ms"]:
        text += f" (± {patch['latency_uncertainty_ms']:.2f})"
    return f"{text}; solve {_times(patch['solve_ms'])}"


def _score_rows(patch: Summary) -> Iterator[str]:
    """PSNR or relative error, and trust: of all frames and of contact frames."""
    against = {"truth": "against the truth", "taxels": "against the recorded taxels"}
    if patch["reference"] in against:
        head = f"PSNR in dB {against[patch['reference']]}"
        yield ""
        yield f"{head:<41}{'mean':>8}{'min':>8}{'max':>8}"

    scores = {
        "  noisy taxels": patch["psnr_db"]["noisy"],
        "  reconstruction": patch["psnr_db"]["reconstruction"],
    }
    if patch["reference"] == "taxels":
        # Noise of the taxels, to compare PSNR with, is not known then.
        scores["relative error"] = {"contact": patch["relative_error"]}
    scores["trusted by the solver"] = patch["trust"]

    frames_of = {"all": "all frames", "contact": "contact frames"}
    for label, extents in scores.items():
        form = ".1f"
        if label == "relative error":
            # A share of the force, and no decibels.
            form = ".3f"
        for which, extent in extents.items():
            if extent not in (None, NONE):
                yield f"{label:<24}{frames_of[which]:<17}{_figures(extent, form)}"


def _since(stamp_ns: Any) -> str:
    """Time of day from which a monitor reads, where it joined a graph that already ran."""
    if not isinstance(stamp_ns, int):
        return ""
    return time.strftime(" since %H:%M:%S", time.localtime(stamp_ns / 1e9))


def _many_table(graph: str, patches: Mapping[str, Summary]) -> str:
    """One row a patch: counts of frames, mean PSNR of all and of contact frames, latency."""
    # Patches of a body may have scenes of their own: what was launched names them all.
    rows = [
        f" {printable(graph)}: {len(patches)} patches ".center(WIDTH, "="),
        f"{'':<12}{'frames':>8}{'skipped':>8}{'lost':>6}{'idle':>7}"
        f"{'PSNR dB':>10}{'contact':>8}{'latency p50':>12}{'p99 ms':>7}",
    ]
    for name, patch in patches.items():
        frames = patch["frames"]
        psnr_db = patch["psnr_db"]["reconstruction"]
        n_frames = frames["reconstructed"]
        # None of a patch that was never touched, or has no reference.
        mean_db = {k: extent and extent["mean"] for k, extent in psnr_db.items()}
        latency_ms = patch["latency_ms"] or {}
        idle = NONE
        if n_frames:
            idle = f"{100 * patch['unchanged'] / n_frames:.0f} %"
        rows.append(
            f"{printable(name)[:12]:<12}{n_frames:>8}{frames['skipped']:>8}{frames['lost']:>6}"
            f"{idle:>7}"
            f"{shown(mean_db['all'], '.1f'):>10}{shown(mean_db['contact'], '.1f'):>8}"
            f"{shown(latency_ms.get('p50'), '.4g'):>12}"
            f"{shown(latency_ms.get('p99'), '.4g'):>7}"
        )

    total = {
        key: sum(patch["frames"][key] for patch in patches.values())
        for key in ("sensed", "reconstructed", "skipped", "lost")
    }
    total["unchanged"] = sum(patch["unchanged"] for patch in patches.values())
    totals = ", ".join(f"{key} {n}" for key, n in total.items())
    rows.append(f"{'all':<12}{totals}")
    rows.append("=" * WIDTH)
    return "\n".join(rows)


def _changes(changes: Sequence[Summary]) -> str:
    """The settings that changed during the run, which the lines below state as they were last."""
    parts = []
    for change in changes[:MAX_CHANGES]:
        label = LABELS.get(change["setting"], change["setting"])
        old = shown(change["from"], "g")
        new = shown(change["to"], "g")
        parts.append(f"{label} {old} -> {new} at frame {change['frame']}")
    if len(changes) > MAX_CHANGES:
        parts.append(f"{len(changes) - MAX_CHANGES} more")
    text = f"settings changed during the run: {', '.join(parts)}; figures cover all of them"
    return textwrap.fill(text, WIDTH)


def _figures(extent: Mapping[str, float], form: str) -> str:
    """Mean, minimum and maximum; of trust the share, and the number of the others."""
    if "trusted_share" not in extent:
        figures = [extent[key] for key in ("mean", "min", "max")]
        return "".join(f"{figure:>8{form}}" for figure in figures)
    share = share_of(extent["trusted_share"])
    return f"{share:>8}   ({extent['untrusted']} of {extent['frames']} not)"


def share_of(share: float) -> str:
    """A share in %; 100 % and 0 % only where it is exactly that."""
    if 0 < share < 1:
        # Rounded, 99.97 % would pass for all.
        percent = min(max(100 * share, 0.1), 99.9)
        return f"{percent:.1f} %"
    return f"{100 * share:.0f} %"


def shown(value: float | str | None, form: str) -> str:
    """A number in a format; "-" if unknown."""
    if value is None:
        return NONE
    if isinstance(value, str):
        return printable(value)
    return format(value, form)


def _times(quantiles: Mapping[str, float] | str) -> str:
    # "-" where they are not known.
    if isinstance(quantiles, str):
        return f"p50 {quantiles}, p99 {quantiles}"
    return f"p50 {quantiles['p50']:.2f} ms, p99 {quantiles['p99']:.2f} ms"
