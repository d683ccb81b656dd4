"""The page of a design: static HTML with tables and charts, and a CSV file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jinja2

from sparseskin.studies.points import StudyError
from sparseskin.studies.report import write_csv

from . import text
from .budget import STAGES, Row
from .charts import draw_accuracy, draw_latency, draw_rates
from .models.costs import HOP_S
from .models.rigs import RIGS
from .spec import KEYS, Design


def write_page(out: Path, rows: Sequence[Row], design: Design) -> Path:
    """Write `design.html`, its charts as PNG and SVG, and `rows.csv` into an existing folder.
    Raises StudyError if a file cannot be written.
    """
    charts = [draw(out, rows, design) for draw in (draw_rates, draw_accuracy, draw_latency)]
    write_csv(out, "rows", [record(row, design) for row in rows])
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True, autoescape=True
    )
    template = (Path(__file__).parent / "page.html").read_text(encoding="utf-8")
    stages = (*STAGES, "process to process")
    page = environment.from_string(template).render(
        title=f"A skin of {design.size} at {text.hertz(design.rate_hz)} Hz",
        stated=[(key, design.words[key]) for key in KEYS if key in design.words],
        conclusions=text.conclusions(rows, design),
        columns=("", *(column.replace("-\n", "").replace("\n", ", ") for column in text.COLUMNS)),
        left=(1, 8),
        rows=[
            {
                "met": row.is_met,
                "about": row.strategy.label,
                "cells": (str(k), *text.cells(row)),
            }
            for k, row in enumerate(rows, 1)
        ],
        legend=text.legend(rows),
        breaks=text.first_breaks(rows, design),
        charts=[{"name": chart.name, "caption": chart.caption} for chart in charts],
        stages=stages,
        latencies=[(row.strategy.name, _latencies(row)) for row in rows],
        sources=text.sources(rows, design),
        rig_columns=text.RIG_COLUMNS,
        rig_left=(0, 1, 3),
        rigs=list(zip(text.rig_rows(), [rig.reason for rig in RIGS], strict=True)),
    )
    path = out / "design.html"
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise StudyError(f"{path}: {error.strerror}") from error
    return path


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
