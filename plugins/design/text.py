"""A design in words and as tables: what breaks first, rows."""

import math
import textwrap
from collections.abc import Callable, Sequence

from .budget import Accuracy, Row
from .models import instructions
from .spec import Design


def hertz(rate: float) -> str:
    """A rate in whole Hz, below 10 Hz with three digits."""
    if rate >= 10:
        return f"{rate:.0f}"
    return f"{rate:.3g}"


def _db(text: Callable[[Accuracy], str]) -> Callable[[Row], str]:
    """Cell of a figure of accuracy; "-" where nothing was simulated."""

    def cell(row: Row) -> str:
        if math.isnan(row.accuracy.psnr_db):
            return "-"
        return text(row.accuracy)

    return cell


def _rate(row: Row) -> str:
    """Cell of the rate that is reached, marked where it is less than asked for."""
    if row.is_met:
        return hertz(row.reached_hz)
    return f"{hertz(row.reached_hz)}!"


def _limit(row: Row) -> str:
    """Cell of the limiting stage, in brackets where it does not limit what is asked for."""
    if row.is_met:
        return f"({row.limit})"
    return row.limit


def _touch(row: Row) -> str:
    """Cell of the lightest touch, mN; "-" where none is known."""
    if math.isnan(row.light_touch_n):
        return "-"
    return f"{1e3 * row.light_touch_n:.3g}"


def _rest(row: Row) -> str:
    """Cell of the bytes a second at rest; "-" where every frame is sent."""
    if math.isnan(row.rest_bytes_s):
        return "-"
    return f"{row.rest_bytes_s:.0f}"


COLUMNS: dict[str, Callable[[Row], str]] = {
    "way to read": lambda row: row.strategy.name,
    "M": lambda row: str(row.m),
    "wires": lambda row: str(row.lines),
    "bytes": lambda row: str(row.n_bytes),
    "at rest\nB/s": _rest,
    "Hz": _rate,
    "limit": _limit,
    "PSNR\ndB": _db(lambda a: f"{a.psnr_db:.1f}"),
    "90 % of\nscenes": _db(lambda a: f"{a.low_db:.0f}..{a.high_db:.0f}"),
    "touch\nmN": _touch,
    "latency\nms": lambda row: f"{row.latency_s * 1e3:.1f}",
    "host\ncores": lambda row: f"{row.host_cores:.2f}",
}
"""Columns of the table of a design by their headings, of two lines in a terminal."""


def breaks(row: Row, design: Design) -> str:
    """What limits a strategy: the stage, what it has to do, its time, the rate that this allows."""
    ms = f"{row.stage_s[row.limit] * 1e3:.3g} ms"
    # What the limiting stage has to do in a frame.
    if row.limit == "ADC":
        load = f"{row.conversions} conversions take {ms} ({design.adc.label})"
    elif row.limit == "bus":
        load = f"{row.n_bytes} bytes take {ms} ({design.bus.label})"
    elif row.limit == "edge":
        n_sums = 0 if row.strategy.reads_single else row.m
        work = f"{instructions(row.conversions, n_sums, row.n_bytes):,} instructions take {ms}"
        if design.edge.clock_hz is None:
            work = f"{ms} a frame"
        load = f"{work} ({design.edge.label})"
    elif row.patches > 1:
        cores = f"{row.patches} patches on {design.cores} cores"
        load = f"{ms} a frame and patch under a dense press, {cores}"
    else:
        load = f"{ms} a frame under a dense press, on one core"
    return f"{row.limit}: {load}: {hertz(row.possible_hz)} Hz"


def first_breaks(rows: Sequence[Row], design: Design) -> list[tuple[str, list[str]]]:
    """What limits the strategies, each text with the names of those that it holds for."""
    names_of_text: dict[str, list[str]] = {}
    for row in rows:
        names_of_text.setdefault(breaks(row, design), []).append(row.strategy.name)
    return list(names_of_text.items())


def conclusions(rows: Sequence[Row], design: Design) -> list[str]:
    """The verdict: whether to read all taxels, and the costs of others beside that."""
    full = rows[0]
    met = [row for row in rows if row.is_met]
    asked = f"{hertz(design.rate_hz)} Hz"
    costs = f"{full.lines} wires, {full.conversions} conversions and {full.n_bytes} bytes per frame"
    if full.is_met:
        lines = [
            f"Read all taxels: {costs} reach {asked}, and nothing has to be reconstructed. "
            "Compress only to send fewer bytes, or to filter noise on the host."
        ]
    else:
        lines = [
            f"All taxels need {costs}, and reach {hertz(full.possible_hz)} Hz: "
            f"{full.limit} limits them. {len(met)} of {len(rows)} ways to read reach {asked}."
        ]
    if not met:
        fast = max(rows, key=lambda row: row.possible_hz)
        line = f"The fastest, {hertz(fast.possible_hz)} Hz: {_named(fast)}, {_beside(fast, full)}."
        return [*lines, line]

    rated = [row for row in met if not math.isnan(row.accuracy.psnr_db)]
    if rated:
        best = max(rated, key=lambda row: row.accuracy.psnr_db)
        costs = f"{_named(best)}, {_beside(best, full)}"
        lines.append(f"The most accurate that reaches it: {costs}.")
    small = min(met, key=lambda row: row.n_bytes)
    costs = f"{_named(small)}, {_beside(small, full)}"
    return [*lines, f"The fewest bytes that reach it: {costs}."]


def _named(row: Row) -> str:
    """Name of a strategy, and its PSNR where it is known."""
    db = row.accuracy.psnr_db
    if math.isnan(db):
        return row.strategy.name
    return f"{row.strategy.name} ({db:.1f} dB)"


def _beside(row: Row, full: Row) -> str:
    """Wires, conversions and bytes of a frame, each beside those of reading all taxels."""
    counts = (
        ("wires", row.lines, full.lines),
        ("conversions", row.conversions, full.conversions),
        ("bytes", row.n_bytes, full.n_bytes),
    )
    parts = []
    for name, count, count_of_all in counts:
        if count == count_of_all:
            change = "as many"
        elif count < count_of_all:
            change = f"{1 - count / count_of_all:.0%} fewer"
        else:
            change = f"{count / count_of_all:.3g} times as many"
        parts.append(f"{count} {name} ({change})")
    return ", ".join(parts)


def _table(rows: Sequence[Row]) -> str:
    """The table for a terminal; headings have two lines, names are aligned to the left."""
    columns = []
    for heading, text in COLUMNS.items():
        heads = heading.partition("\n")[::2]
        cells = [*heads, *(text(row) for row in rows)]
        width = max(map(len, cells))
        align = str.ljust if heading in ("way to read", "limit") else str.rjust
        columns.append([align(cell, width) for cell in cells])
    return "\n".join("  ".join(cells).rstrip() for cells in zip(*columns, strict=True))


def terminal(rows: Sequence[Row], design: Design) -> str:
    """The table of a design, what breaks first and notes, for a terminal."""
    breaking = []
    for text, names in first_breaks(rows, design):
        breaking.append(f"{_filled(', '.join(names))}\n  {text}")
    parts = [
        _filled(
            f"{design.size}, {design.pitch_m * 1e3:.4g} mm apart; ADC {design.adc.label}; "
            f"{design.bus.label}; edge {design.edge.label}; host {design.cores} cores; asked "
            f"{hertz(design.rate_hz)} Hz; noise {design.noise_n:g} N of {design.range_n:g} N"
        ),
        _table(rows),
        "\n".join(map(_filled, LEGEND)),
        "What breaks first:",
        "\n".join(breaking),
        "\n".join(map(_filled, conclusions(rows, design))),
    ]
    return "\n\n".join(parts)


def _filled(text: str) -> str:
    """A text in lines as wide as the table."""
    return textwrap.fill(text, 96, subsequent_indent="  ")


LEGEND = (
    "!: fewer than asked for; limit in brackets: reached, and what would break first",
    "90 % of scenes: PSNR of further scenes and seeds; touch: least force a taxel at which a light "
    "press of 3 x 3 taxels is found in 90 % of cases",
    "at rest: with compressor.quiet = 0.5, as many conversions, while nothing changes; -: the edge "
    "does not read all taxels, and sends every frame, as does the edge in C",
    "rate, limit, latency and cores are those of a dense press; a patch cannot use more than one "
    "core of the host, as a frame needs the one before it",
)
"""What the marks of the table mean."""


def record(row: Row, design: Design) -> dict[str, object]:
    """A row as plain values with their units in the names."""
    a = row.accuracy
    rates = {f"{stage.lower()}_hz": hz for stage, hz in row.stage_hz.items()}
    times = {f"{stage.lower()}_s": s for stage, s in row.stage_s.items()}
    return {
        "strategy": row.strategy.name,
        "m": row.m,
        "wires": row.lines,
        "conversions": row.conversions,
        "bytes": row.n_bytes,
        "rest_bytes_s": row.rest_bytes_s,
        "asked_hz": design.rate_hz,
        "reached_hz": row.reached_hz,
        "limit": row.limit,
        **rates,
        **times,
        "host_calm_s": row.host_calm_s,
        "latency_s": row.latency_s,
        "host_cores": row.host_cores,
        "psnr_db": a.psnr_db,
        "low_db": a.low_db,
        "high_db": a.high_db,
        "light_touch_n": row.light_touch_n,
    }
