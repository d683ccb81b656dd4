"""Text of the monitor for a terminal: a line while the graph runs, a table at its end."""

import textwrap
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sparseskin.messages.contacts import sum_unit, summary
from sparseskin.messages.reasons import Reason, phrase_of
from sparseskin.messages.text import printable

from .metrics import FLOAT_BITS, PatchMetrics

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
    every = list(patches.values())
    n, lost = min(m.reconstructed for m in every), max(m.lost_so_far for m in every)
    rate, idle = f"{rate_hz:.0f} Hz", []
    name = next(iter(patches))
    if len(every) > 1:
        name, idle = f"{len(every)} patches", [f"idle {sum(m.idle for m in every)}"]
        asked = max((m.skin.rate_hz for m in every if m.skin is not None), default=0.0)
        rate = f"{rate_hz:.0f} of {asked:g} Hz" if asked else rate
        rate += f", skipped {max(m.skipped for m in every)}"
    psnr = [m.reconstruction.contact.mean for m in every if m.reconstruction.contact.count]
    noisy = [m.noisy.contact.mean for m in every if m.noisy.contact.count]
    trust = [m.trust.contact for m in every if m.trust.contact.count]
    share = sum(t.total for t in trust) / sum(t.count for t in trust) if trust else 0.0
    to_taxels = "" if noisy else " to taxels"
    latency, p50_ms = _latency(every)
    is_late = p50_ms >= LATE_MS
    # No frame is lost in a queue, but it ages there.
    age_ms = max((m.latency_ns or 0) for m in every) / 1e6
    queued = f", newest {age_ms / 1e3:.1f} s old" if age_ms >= QUEUED_MS else ""
    parts = [
        f"{name}: {n} frames, {rate}, lost {lost}{queued}",
        *(latency if is_late else ()),
        *_contacts(every),
        *idle,
        *([f"PSNR{to_taxels} {sum(psnr) / len(psnr):.1f} dB"] if psnr else ()),
        *([f"trusted {share_of(share)}"] if trust else ()),
        *(() if is_late else latency),
        *([f"taxels {sum(noisy) / len(noisy):.1f} dB"] if noisy else ()),
    ]
    since = _since(every[0].since_ns).strip()
    return " | ".join([*parts, since] if since else parts)


def _contacts(patches: Sequence[PatchMetrics]) -> list[str]:
    """Contacts of the newest frames and their force; where they are not published, the force."""
    units = [m.skin.unit for m in patches if m.skin is not None]
    known = [m.contacts for m in patches if m.contacts is not None]
    loads = [m.load for m in patches if m.load is not None]
    if known and units:
        n, total = sum(c.id.size for c in known), sum(float(c.total.sum()) for c in known)
        return [summary(n, total, units[0])]
    if any(loads):
        return [f"{sum(loads):.3g} {sum_unit(units[0])}"]
    return ["no contact"] if loads else []


def _latency(patches: Sequence[PatchMetrics]) -> tuple[list[str], float]:
    """Latency of the slowest patch as text and its median; none where it is unknown."""
    known = [(q["p50"], q["p99"], m) for m in patches if (q := m.latency.summary())]
    if not known:
        return [], 0.0
    p50, p99, slowest = max(known, key=lambda found: found[:2])
    within = slowest.latency_uncertainty_ns / 1e6
    text = f"latency p50 {p50:.1f}, p99 {p99:.1f} ms" + (f" ± {within:.1f}" if within else "")
    return [text], p50


def summary_table(patches: Mapping[str, Mapping[str, Any]]) -> str:
    """The summary of every patch as text for a terminal of 80 columns."""
    if len(patches) > FEW:
        text = _many_table(patches)
    else:
        text = "\n".join(patch_table(name, patch) for name, patch in patches.items())
    return "\n".join(filter(None, [text, doubts_text(patches.values())]))


def doubts_text(patches: Iterable[Mapping[str, Any]]) -> str:
    """Number of frames that are not to be trusted, their reasons, and what may help; "" of none."""
    every = [patch for patch in patches if patch["trust"]["all"]]
    n, total = (sum(p["trust"]["all"][key] for p in every) for key in ("untrusted", "frames"))
    if not n:
        return ""
    counts: Counter[str] = Counter()
    for patch in every:
        counts.update(patch["doubts"])
    are = "is" if n == 1 else "are"
    text = f"{n} of {total} frames {are} in doubt{_reasons(counts)}."
    if counts[Reason.ERROR]:
        rotate = "" if all(p["rows"] == "rotating" for p in every) else " or rotating rows"
        text += f" If the error lasts, more measurements{rotate} may help."
    return textwrap.fill(text, WIDTH)


def _reasons(counts: Counter[str]) -> str:
    """The reasons of frames, each with its number of frames where there are several reasons."""
    if len(counts) == 1:
        return "".join(f": {phrase_of(word)}" for word in counts)
    return "".join(
        f"; in {count} {'frame' if count == 1 else 'frames'}: {phrase_of(word)}"
        for word, count in counts.most_common()
    )


def patch_table(name: str, patch: Mapping[str, Any]) -> str:
    """The summary of one patch as text, `WIDTH` characters wide."""
    patch = {
        key: NONE if value is None else printable(value) if isinstance(value, str) else value
        for key, value in patch.items()
    }
    frames, n_in, n_out = patch["frames"], patch["bytes_in"], patch["bytes_out"]
    if not frames["sensed"] and not frames["reconstructed"]:
        scene = "" if patch["scene"] == NONE else f"{patch['scene']}: "
        return f"{printable(name)}: {scene}ended before the first frame"
    skipped = f"skipped {frames['skipped']}, " if frames["skipped"] else ""
    rotating = ", rotating rows" if patch["rows"] == "rotating" else ""
    bits = f", {patch['bits']} bits" if patch["bits"] not in (NONE, FLOAT_BITS) else ""
    basis = f" in {patch['basis']}" if patch["basis"] else ""
    preset = f" (preset {patch['preset']})" if patch["preset"] not in ("", NONE) else ""
    within = f" (± {ms:.2f})" if (ms := patch["latency_uncertainty_ms"]) else ""
    full_ms, compared = patch["frame_ms"], ""
    full = "" if full_ms in (NONE, 0) else f" ({full_ms:.2g} ms on a full skin)"
    iterations = f"{patch['iterations']}"
    if patch["max_iterations"] not in (NONE, 0):
        iterations += f" to {patch['max_iterations']}"
    if patch["compared"] < frames["reconstructed"]:
        why = _since(patch["since_ns"]) or " (the others came too late)"
        compared = f";\n            figures of {patch['compared']}{why}"
    rows = [f" {printable(name)}: {patch['scene']} ".center(WIDTH, "=")]
    if patch["changes"]:
        rows.append(_changes(patch["changes"]))
    rows += [
        f"frames      sensed {frames['sensed']}, reconstructed {frames['reconstructed']}, "
        f"{skipped}lost {frames['lost']}{compared}",
        f"measured    {patch['phi']}{rotating}: "
        f"N = {patch['n']}, M = {patch['m']} (ratio {shown(patch['ratio'], '.2f')}), "
        f"range {shown(patch['f_min'], 'g')}..{shown(patch['f_max'], 'g')} {patch['unit']}{bits}",
        f"solver      {patch['solver']}{basis}, {iterations} iterations{full}{preset}",
        f"bytes       {f'taxels {n_in:,}, ' if n_in else ''}measurements {n_out:,}"
        f"{f' (1/{n_in / n_out:.2f})' if n_in and n_out else ''}",
        f"time        latency {_times(patch['latency_ms'])}{within}; "
        f"solve {_times(patch['solve_ms'])}",
    ]
    against = {"truth": "against the truth", "taxels": "against the recorded taxels"}
    if patch["reference"] in against:
        head = f"PSNR in dB {against[patch['reference']]}"
        rows += ["", f"{head:<41}{'mean':>8}{'min':>8}{'max':>8}"]
    psnr, trust = patch["psnr_db"], patch["trust"]
    frames_of = {"all": "all frames", "contact": "contact frames"}
    for label, extents in (
        ("  noisy taxels", psnr["noisy"]),
        ("  reconstruction", psnr["reconstruction"]),
        # Where PSNR has no noise beside it.
        ("relative error", {"contact": patch["relative_error"]}
         if patch["reference"] == "taxels" else {}),
        ("trusted by the solver", trust),
    ):  # fmt: skip
        for which, extent in extents.items():
            if extent not in (None, NONE):
                form = ".3f" if label == "relative error" else ".1f"
                rows.append(f"{label:<24}{frames_of[which]:<17}{_figures(extent, form)}")
    return "\n".join([*rows, "=" * WIDTH])


def _since(stamp_ns: Any) -> str:
    """Time of day from which a monitor reads, where it joined a graph that already ran."""
    if not isinstance(stamp_ns, int):
        return ""
    return time.strftime(" since %H:%M:%S", time.localtime(stamp_ns / 1e9))


def _many_table(patches: Mapping[str, Mapping[str, Any]]) -> str:
    """One row a patch: counts of frames, mean PSNR of all and of contact frames, latency."""
    first = next(iter(patches.values()))
    rows = [
        f" {len(patches)} patches: {printable(str(first['scene']))} ".center(WIDTH, "="),
        f"{'':<12}{'frames':>8}{'skipped':>8}{'lost':>6}{'idle':>7}"
        f"{'PSNR dB':>10}{'contact':>8}{'latency p50':>12}{'p99 ms':>7}",
    ]
    for name, patch in patches.items():
        frames, psnr = patch["frames"], patch["psnr_db"]["reconstruction"]
        n = frames["reconstructed"]
        means = [psnr[k] and psnr[k]["mean"] for k in ("all", "contact")]
        times = [patch["latency_ms"] and patch["latency_ms"][k] for k in ("p50", "p99")]
        idle = f"{100 * patch['unchanged'] / n:.0f} %" if n else NONE
        rows.append(
            f"{printable(name)[:12]:<12}{n:>8}{frames['skipped']:>8}{frames['lost']:>6}{idle:>7}"
            f"{shown(means[0], '.1f'):>10}{shown(means[1], '.1f'):>8}"
            f"{shown(times[0], '.4g'):>12}{shown(times[1], '.4g'):>7}"
        )
    total = {
        key: sum(patch["frames"][key] for patch in patches.values())
        for key in ("sensed", "reconstructed", "skipped", "lost")
    } | {"unchanged": sum(patch["unchanged"] for patch in patches.values())}
    rows.append(f"{'all':<12}" + ", ".join(f"{key} {n}" for key, n in total.items()))
    rows.append("=" * WIDTH)
    return "\n".join(rows)


def _changes(changes: Sequence[Mapping[str, Any]]) -> str:
    """The settings that changed during the run, which the lines below state as they were last."""
    parts = [
        f"{LABELS.get(change['setting'], change['setting'])} "
        + " -> ".join(shown(change[key], "g") for key in ("from", "to"))
        + f" at frame {change['frame']}"
        for change in changes[:MAX_CHANGES]
    ]
    if len(changes) > MAX_CHANGES:
        parts.append(f"{len(changes) - MAX_CHANGES} more")
    text = f"settings changed during the run: {', '.join(parts)}; figures cover all of them"
    return textwrap.fill(text, WIDTH)


def _figures(extent: Mapping[str, float], form: str) -> str:
    """Mean, minimum and maximum; of trust the share, and the number of the others."""
    if "trusted_share" not in extent:
        return "".join(f"{extent[key]:>8{form}}" for key in ("mean", "min", "max"))
    share = share_of(extent["trusted_share"])
    return f"{share:>8}   ({extent['untrusted']} of {extent['frames']} not)"


def share_of(share: float) -> str:
    """A share in %; 100 % and 0 % only where it is exactly that."""
    if 0 < share < 1:
        return f"{min(max(100 * share, 0.1), 99.9):.1f} %"
    return f"{100 * share:.0f} %"


def shown(value: float | str | None, form: str) -> str:
    """A number in a format; "-" if unknown."""
    if value is None:
        return NONE
    return printable(value) if isinstance(value, str) else format(value, form)


def _times(quantiles: Mapping[str, float] | str) -> str:
    return ", ".join(
        f"{key} {quantiles if isinstance(quantiles, str) else f'{quantiles[key]:.2f} ms'}"
        for key in ("p50", "p99")
    )
