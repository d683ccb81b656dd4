"""A design in words and as tables: what breaks first, rows, rigs, sources."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from .budget import STAGES, Accuracy, Row
from .models.edge import instructions
from .models.rigs import RIGS
from .spec import Design


def hertz(rate: float) -> str:
    """A rate in whole Hz, below 10 Hz with three digits."""
    return f"{rate:.0f}" if rate >= 10 else f"{rate:.3g}"


def host_ms(row: Row) -> str:
    """Time of the host for a frame, milliseconds: calm frame..dense press."""
    return "..".join(
        f"{ms:.{2 if ms < 1 else 1 if ms < 10 else 0}f}"
        for ms in (1e3 * row.host_calm_s, 1e3 * row.stage_s["host"])
    )


def _db(text: Callable[[Accuracy], str]) -> Callable[[Row], str]:
    """Cell of a figure of accuracy; "-" where nothing was simulated."""
    return lambda row: "-" if math.isnan(row.accuracy.psnr_db) else text(row.accuracy)


COLUMNS: dict[str, Callable[[Row], str]] = {
    "strategy": lambda row: row.strategy.name,
    "M": lambda row: str(row.m),
    "wires": lambda row: str(row.wires.lines),
    "cross-\nings": lambda row: "-" if row.wires.crossings is None else str(row.wires.crossings),
    "conver-\nsions": lambda row: str(row.wires.conversions),
    "bytes": lambda row: str(row.n_bytes),
    "Hz": lambda row: f"{hertz(row.reached_hz)}{'' if row.is_met else '!'}",
    "limit": lambda row: f"({row.limit})" if row.is_met else row.limit,
    "PSNR\ndB": _db(lambda a: f"{a.psnr_db:.1f}{'*' if a.note else ''}"),
    "band\ndB": _db(lambda a: f"{a.low_db:.1f}..{a.high_db:.1f}"),
    "touch\nmN": lambda row: (
        "-" if math.isnan(row.light_touch_n) else f"{1e3 * row.light_touch_n:.3g}"
    ),
    "latency\nms": lambda row: f"{row.latency_s * 1e3:.1f}",
    "host\nms": host_ms,
    "host\ncores": lambda row: f"{row.host_cores:.2f}",
}
"""Columns of the table of a design by their headings, of two lines in a terminal."""
RIG_COLUMNS = ("rig", "reads", "predicted, Hz", "limit", "published, Hz", "ratio")
"""Columns of the table of rigs; remarks follow it."""


def cells(row: Row) -> tuple[str, ...]:
    """A row of the table: one text for each of `COLUMNS`."""
    return tuple(text(row) for text in COLUMNS.values())


def breaks(row: Row, design: Design, stage: str | None = None) -> str:
    """What limits a strategy: the stage, what it has to do, its time, the rate that this allows."""
    stage = stage or row.limit
    rate = f"{hertz(row.stage_hz[stage])} Hz"
    ms = f"{row.stage_s[stage] * 1e3:.3g} ms"
    if stage == "ADC":
        return f"ADC: {row.wires.conversions} conversions take {ms} ({design.adc.label}): {rate}"
    if stage == "bus":
        return f"bus: {row.n_bytes} bytes take {ms} ({design.bus.label}): {rate}"
    if stage == "edge":
        sums = 0 if row.strategy.reads_single else row.m
        work = f"{instructions(row.wires.conversions, sums, row.n_bytes):,} instructions take {ms}"
        if design.edge.clock_hz is None:
            work = f"{ms} a frame"
        return f"edge: {work} ({design.edge.label}): {rate}"
    if row.patches > 1:
        cores = f"{row.patches} patches on {design.cores} cores"
        return f"host: {ms} a frame and patch under a dense press, {cores}: {rate}"
    return f"host: {ms} a frame under a dense press, on one core: {rate}"


def first_breaks(rows: Sequence[Row], design: Design) -> list[tuple[str, list[str]]]:
    """What limits the strategies, each text with the names of those that it holds for."""
    found: dict[str, list[str]] = {}
    for row in rows:
        found.setdefault(breaks(row, design), []).append(row.strategy.name)
    return list(found.items())


def conclusions(rows: Sequence[Row], design: Design) -> list[str]:
    """At most four sentences: which strategies reach the rate, the best of them, what breaks first
    of the full reading, what would help.

    `rows` are those of `budget`.
    """
    met = [row for row in rows if row.is_met]
    full = next((row for row in rows if row.strategy.name == "full"), None)
    asked = f"{hertz(design.rate_hz)} Hz"
    best = max(rows, key=_accuracy)
    lines = []
    if met:
        lines.append(f"{len(met)} of {len(rows)} strategies reach {asked}{_most_accurate(met)}.")
        lines.append(_fewest_bytes(met, full))
    else:
        fast = max(rows, key=lambda row: row.possible_hz)
        lines.append(
            f"No strategy reaches {asked}: the fastest is {_named(fast)}, at "
            f"{hertz(fast.possible_hz)} Hz ({breaks(fast, design)})."
        )
    if full is not None:
        possible = "reaches" if full.is_met else "falls short of"
        slowest = breaks(full, design)
        lines.append(f"Reading every taxel {possible} {asked}; its slowest stage is {slowest}.")
    if not best.is_met and not math.isnan(best.accuracy.psnr_db):
        factors = [
            f"{name} {design.rate_hz / best.stage_hz[name]:.1f} times"
            for name in STAGES
            if best.stage_hz[name] < design.rate_hz
        ]
        listed = " and ".join(filter(None, [", ".join(factors[:-1]), factors[-1]]))
        lines.append(
            f"The most accurate at a rate below {asked} is {_named(best)} at "
            f"{hertz(best.possible_hz)} Hz: for {asked} it needs {listed} as fast."
        )
    return lines


def _most_accurate(met: Sequence[Row]) -> str:
    """The most accurate of the rows that reach the rate; "" where that is not known."""
    good = max(met, key=_accuracy)
    if math.isnan(good.accuracy.psnr_db):
        return ""
    return (
        f"; the most accurate is {_named(good)}, whose slowest stage, the {good.limit}, allows "
        f"{hertz(good.possible_hz)} Hz"
    )


def _fewest_bytes(met: Sequence[Row], full: Row | None) -> str:
    """The row of the fewest bytes, and that of those as accurate as the full reading."""
    small = min(met, key=lambda row: row.n_bytes)
    line = f"Fewest bytes a frame: {small.n_bytes}, {_named(small)}"
    if full is None or math.isnan(full.accuracy.psnr_db):
        return f"{line}."
    line += f"; {{}} the full reading ({full.accuracy.psnr_db:.1f} dB)."
    as_good = [row for row in met if _accuracy(row) >= full.accuracy.psnr_db and row is not full]
    if not as_good:
        return line.format("none is as accurate as")
    least = min(as_good, key=lambda row: row.n_bytes)
    same = "it" if least is small else f"with {least.n_bytes}, {_named(least)}"
    return line.format(f"{same} is no less accurate than")


def _accuracy(row: Row) -> float:
    """PSNR, or less than any other where it is not known."""
    db = row.accuracy.psnr_db
    return -math.inf if math.isnan(db) else db


def _named(row: Row) -> str:
    """Name of a strategy, and its PSNR where it is known."""
    db = row.accuracy.psnr_db
    return row.strategy.name if math.isnan(db) else f"{row.strategy.name} ({db:.1f} dB)"


def aligned(columns: Sequence[str], rows: Sequence[Sequence[str]], left: Sequence[int]) -> str:
    """A table for a terminal; columns of the numbers `left` are aligned to the left. A heading may
    have two lines.
    """
    heads = [column.partition("\n")[::2] for column in columns]
    lines = [*zip(*heads, strict=True), *rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    texts = [
        "  ".join(
            cell.ljust(width) if k in left else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    ]
    return "\n".join(filter(None, texts))


def terminal(rows: Sequence[Row], design: Design) -> str:
    """The table of a design, what breaks first and notes, for a terminal."""
    parts = [
        f"{design.size}, {design.pitch_m * 1e3:g} mm apart; ADC {design.adc.label}; "
        f"{design.bus.label}; edge {design.edge.label}; host {design.cores} cores; asked "
        f"{hertz(design.rate_hz)} Hz; noise {design.noise_n:g} N of {design.range_n:g} N",
        aligned(list(COLUMNS), [cells(row) for row in rows], (0, 7)),
        "\n".join(legend(rows)),
        "\n".join(conclusions(rows, design)),
        "What breaks first:",
        "\n".join(f"{', '.join(names)}\n  {text}" for text, names in first_breaks(rows, design)),
    ]
    return "\n\n".join(parts)


def legend(rows: Sequence[Row]) -> list[str]:
    """What the marks of the table mean, and the notes of its figures of accuracy."""
    lines = [
        "!: fewer than asked for; limit in brackets: reached, and what would break first",
        "band: of 90 % of further scenes and seeds; touch: least force a taxel at which a light "
        "press of 3 x 3 taxels is found in 90 % of cases",
        "host ms: calm frame..dense press; rate, limit, latency and cores are those of the dense "
        "press",
    ]
    if any(row.limit == "host" for row in rows):
        lines.append(
            "host: a frame needs the one before it, so that a patch cannot use more than one core; "
            "reconstructor.budget_ms bounds its time, at some accuracy"
        )
    notes: dict[str, list[str]] = {}
    for row in rows:
        if row.accuracy.note:
            notes.setdefault(row.accuracy.note, []).append(row.strategy.name)
    for note, names in notes.items():
        named = "all" if len(names) == len(rows) else ", ".join(names)
        lines.append(f"*: {named}: {note}")
    return lines


def rig_rows() -> list[tuple[str, ...]]:
    """Rows of the table of rigs: one text for each of `RIG_COLUMNS`."""
    return [
        (
            rig.name,
            rig.reads,
            hertz(rig.predicted_hz),
            rig.limit,
            hertz(rig.published_hz),
            f"{rig.ratio:.2f}{'' if rig.is_within else ' !'}",
        )
        for rig in RIGS
    ]


def rig_table() -> str:
    """The table of rigs for a terminal, with facts and reasons."""
    lines = [aligned(RIG_COLUMNS, rig_rows(), (0, 1, 3)), ""]
    lines.append("ratio: predicted over published; !: beyond a factor 2")
    for rig in RIGS:
        lines += ["", f"{rig.name}: {rig.facts}."]
        if rig.reason:
            lines.append(f"  Remark: {rig.reason}.")
    return "\n".join(lines)
