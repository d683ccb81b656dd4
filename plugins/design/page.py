"""The page of a design, as studies write theirs: tables and a chart in Markdown, and a CSV file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from sparseskin.studies.report import Page

from . import text
from .budget import STAGES, Row
from .charts import draw_accuracy
from .models.costs import DENSE, HOP_S, stored
from .models.rigs import RIGS
from .spec import KEYS, Design


def write_page(out: Path, rows: Sequence[Row], design: Design) -> Path:
    """Write `design.md`, its chart as PNG and SVG, and `rows.csv` into an existing folder.
    Raises StudyError if a file cannot be written.
    """
    page = Page(out, "design", Path(__file__).with_suffix(".md"), False, "design")
    stated = ", ".join(f"{key} `{design.words[key]}`" for key in KEYS if key in design.words)
    page.section("", size=design.size, rate=text.hertz(design.rate_hz), stated=stated)
    heads = [column.replace("-\n", "").replace("\n", ", ") for column in text.COLUMNS]
    table = pd.DataFrame([text.cells(row) for row in rows], columns=heads)
    page.section("Strategies", table, "\n".join(f"- {line}" for line in text.legend(rows)))
    broken = [(", ".join(names), line) for line, names in text.first_breaks(rows, design)]
    page.section("What breaks first", pd.DataFrame(broken, columns=["strategies", "limit"]))
    page.section("Chart", draw_accuracy(out, rows, design).markdown)
    latencies = [(row.strategy.name, *_latencies(row)) for row in rows]
    columns = ["strategy", *STAGES, "process to process", "sum"]
    page.section("Latency of a frame, ms", pd.DataFrame(latencies, columns=columns))
    page.section(
        "Models and their sources",
        edge=design.edge.source,
        bus=design.bus.source,
        dense=f"{DENSE:.0%}",
        conditions=stored()["conditions"],
        hop_ms=f"{1e3 * HOP_S:g}",
    )
    rigs = pd.DataFrame(text.rig_rows(), columns=text.RIG_COLUMNS)
    rigs["remark"] = [rig.reason for rig in RIGS]
    page.section("The same models on rigs that were built", rigs)
    page.csv("rows", [record(row, design) for row in rows])
    page.write(text.conclusions(rows, design))
    return out / "design.md"


def _latencies(row: Row) -> list[str]:
    """Time of each stage, and their sum, milliseconds; of the host calm frame..dense press."""
    before = [f"{1e3 * row.stage_s[stage]:.3g}" for stage in STAGES[:-1]]
    calm_s = row.latency_s - row.stage_s["host"] + row.host_calm_s
    total = f"{1e3 * calm_s:.3g}..{1e3 * row.latency_s:.3g}"
    return [*before, text.host_ms(row), f"{1e3 * HOP_S:.3g}", total]


def record(row: Row, design: Design) -> dict[str, object]:
    """A row as plain values with their units in the names."""
    a = row.accuracy
    return {
        "strategy": row.strategy.name,
        "m": row.m,
        "wires": row.wires.lines,
        "crossings": row.wires.crossings,
        "wire_length_m": row.wires.length_m,
        "conversions": row.wires.conversions,
        "bytes": row.n_bytes,
        "asked_hz": design.rate_hz,
        "reached_hz": row.reached_hz,
        "limit": row.limit,
        **{f"{stage.lower()}_hz": hz for stage, hz in row.stage_hz.items()},
        **{f"{stage.lower()}_s": s for stage, s in row.stage_s.items()},
        "host_calm_s": row.host_calm_s,
        "latency_s": row.latency_s,
        "host_cores": row.host_cores,
        "psnr_db": a.psnr_db,
        "low_db": a.low_db,
        "high_db": a.high_db,
        "light_touch_n": row.light_touch_n,
        "note": a.note,
    }
