"""Tables drawn at random from what loggers write, with the frames and times that they hold."""

from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

import numpy as np
from hypothesis import strategies as st

NO_NAMES, NUMBERED, GRID_NAMES = "none", "s{k}", "r{r}c{c}"
TIMES = [
    "none",
    "time_s",
    "time_ms",
    "t [us]",
    "stamp",
    "clock",
    "epoch",
    "ts",
    "micros",
]
TIMES += ["date", "datetime", "Time", "Timestamp", "date_time", "timedelta", "elapsed"]
SPACED = ["ts", "Time", "Timestamp", "date_time", "timedelta"]
"""Times with spaces."""
START = datetime(2026, 3, 1, 9, 30, tzinfo=UTC)


@dataclass
class DrawnTable:
    """A text, the frames and stamps in it, and what a user would state."""

    text: str
    frames: np.ndarray
    seconds: np.ndarray | None  # since the first frame; None: the table has no times
    stated: dict = field(default_factory=dict)


def _times(draw, n):
    """Texts of the times, the header of their column, and seconds."""
    kind = draw(st.sampled_from(TIMES))
    steps_ms = draw(st.lists(st.integers(8, 40), min_size=n - 1, max_size=n - 1))
    ms = np.concatenate([[0], np.cumsum(steps_ms)]).astype(int)
    moments = [START + timedelta(milliseconds=int(each)) for each in ms]
    texts = {
        "none": None,
        "time_s": [f"{each / 1000:.3f}" for each in ms],
        "time_ms": [str(each + 77) for each in ms],
        "t [us]": [str(1000 * each) for each in ms],
        "stamp": [moment.isoformat() for moment in moments],
        "clock": [moment.strftime("%H:%M:%S.%f") for moment in moments],
        "epoch": [f"{moment.timestamp():.3f}" for moment in moments],
        "ts": [moment.strftime("%d.%m.%Y %H:%M:%S.%f") for moment in moments],
        "date": [moment.strftime("%Y%m%dT%H%M%S.%f") for moment in moments],
        "datetime": [moment.strftime("%Y%m%d%H%M%S.%f") for moment in moments],
        "Time": [moment.strftime("%I:%M:%S.%f %p") for moment in moments],
        "Timestamp": [moment.strftime("%m/%d/%Y %I:%M:%S.%f %p") for moment in moments],
        "date_time": [moment.strftime("%d-%b-%Y %H:%M:%S.%f") for moment in moments],
        "timedelta": [f"0 days {moment:%H:%M:%S.%f}" for moment in moments],
        "elapsed": [moment.strftime("%M:%S.%f") for moment in moments],
        "micros": [str((1000 * each - 50_000) % 2**32) for each in ms],
    }
    return texts[kind], kind, None if kind == "none" else ms / 1000


def _end(place):
    return "last" if place else "first"


def _shape_and_readings(draw, n_least, low):
    """Rows and columns of a skin, and whole readings of some frames, one a line."""
    n_rows = draw(st.integers(1, 4))
    n_cols = draw(st.integers(2, 5))
    n = draw(st.integers(n_least, 12))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return n_rows, n_cols, rng.integers(low, 1000, (n, n_rows * n_cols))


@st.composite
def tables(draw):
    """A `DrawnTable`."""
    n_rows, n_cols, readings = _shape_and_readings(draw, n_least=3, low=0)
    n, n_taxels = readings.shape
    # A column that rises, or counts, could be the times, or a counter: these ask (tested apart).
    readings[-1] = readings[0] - 1
    readings[0] = np.maximum(readings[0], 1)
    readings[-1] = readings[0] - 1

    texts, time_name, seconds = _times(draw, n)
    names_kind = draw(st.sampled_from([NO_NAMES, NUMBERED, GRID_NAMES]))
    is_named = names_kind != NO_NAMES
    names = [
        names_kind.format(k=k, r=k // n_cols, c=k % n_cols) for k in range(n_taxels)
    ]
    in_order = st.just(list(range(n_taxels)))
    order = draw(st.permutations(range(n_taxels)) if is_named else in_order)
    has_decimals = draw(st.booleans())
    values = readings / 4 if has_decimals else readings

    columns = [[f"{value:g}" for value in values[:, k]] for k in order]
    if not has_decimals and draw(st.booleans()):
        columns = [[f"0x{value:02X}" for value in values[:, k]] for k in order]
    header = [names[k] for k in order]
    if is_named and draw(st.booleans()):
        # A label changes rarely; names that take turns are those of skins (tested apart).
        labels = draw(st.lists(st.sampled_from(["cup", "box"]), min_size=n, max_size=n))
        columns.append(sorted(labels))
        header.append("object")
    if is_named and draw(st.booleans()):
        columns.insert(0, [str(k) for k in range(n)])
        header.insert(0, "sample")
    if texts is not None:
        place = draw(st.sampled_from([0, len(columns)]))
        columns.insert(place, texts)
        header.insert(place, time_name)

    separators = [",", ";", "\t"] if time_name in SPACED else [",", ";", "\t", " "]
    separator = draw(st.sampled_from(separators))
    if separator == " ":
        header = [name.replace(" ", "_") for name in header]
    has_comma = separator == ";" and time_name != "ts" and draw(st.booleans())
    end = draw(st.sampled_from(["\n", "\r\n"]))
    tail = separator if separator != " " and draw(st.booleans()) else ""
    rows = [separator.join(cells) + tail for cells in zip(*columns, strict=True)]
    if has_comma:
        rows = [row.replace(".", ",") for row in rows]
    lines = [separator.join(header)] * is_named + rows
    if draw(st.booleans()):
        lines.insert(draw(st.integers(0, len(lines))), "# a comment")
    if is_named and draw(st.booleans()):
        lines.insert(0, "Pressure logger 3000")
        # Some programs write a setting a line, more of them than a short recording has frames.
        settings = [
            f"setting_{k}{separator}{k}" for k in range(draw(st.integers(0, 12)))
        ]
        lines = settings * (len(header) > 2) + lines
    if is_named and draw(st.booleans()):
        lines.insert(draw(st.integers(0, len(lines))), "")
    if draw(st.booleans()):
        # What a board prints when it starts again.
        lines.insert(draw(st.integers(is_named, len(lines))), "rebooted")
    if separator == "," and draw(st.booleans()):
        lines.insert(0, "sep=,")
    stated = {"n_rows": n_rows, "n_cols": n_cols, "unit": "counts"}
    units = {"time_ms": "ms", "t [us]": "us"}
    if not is_named and time_name in units:
        # A step of 8 ms could be one of 8 s: without a name the unit is asked for.
        stated["time_unit"] = units[time_name]
    if time_name == "micros":
        # Microcontrollers count 32 bits.
        stated |= {"time": time_name if is_named else _end(place), "time_wrap": 2**32}
        stated |= {"time_unit": "us"}
    frames = values.reshape(n, n_rows, n_cols).astype(np.float32)
    return DrawnTable(end.join(lines) + end, frames, seconds, stated)


@st.composite
def transposed_tables(draw):
    """A `DrawnTable` with a line for each taxel, and perhaps one of the times."""
    n_rows, n_cols, readings = _shape_and_readings(draw, n_least=2, low=0)
    n = len(readings)
    readings[0, 0] = 1
    lines = [list(map(str, taxel)) for taxel in readings.T]
    if draw(st.booleans()):
        lines = [[f"s{k}", *cells] for k, cells in enumerate(lines)]
    seconds = None
    stated = {
        "n_rows": n_rows,
        "n_cols": n_cols,
        "unit": "counts",
        "axes": "taxels,frames",
    }
    if draw(st.booleans()):
        seconds = 0.02 * np.arange(n)
        place = draw(st.sampled_from([0, len(lines)]))
        name = ["t"] if len(lines[0]) > n else []
        lines.insert(place, name + [str(20 * k) for k in range(n)])
        stated |= {"time": _end(place), "time_unit": "ms"}
    separator = draw(st.sampled_from([",", ";", "\t", " "]))
    text = "\n".join(separator.join(cells) for cells in lines) + "\n"
    return DrawnTable(
        text, readings.reshape(n, n_rows, n_cols).astype("f4"), seconds, stated
    )


@st.composite
def logs(draw):
    """A `DrawnTable` whose lines have a time or a text before the readings, or these in a list."""
    n_rows, n_cols, readings = _shape_and_readings(draw, n_least=4, low=1)
    n = len(readings)
    readings[-1] = readings[0] - 1
    moments = [START + timedelta(milliseconds=20 * k) for k in range(n)]
    lists = [", ".join(map(str, frame)) for frame in readings]
    clocks = [moment.strftime("%H:%M:%S.%f") for moment in moments]
    kinds = ["stamp", "label", "list", "array", "numpy", "pairs", "marks"]
    kind = draw(st.sampled_from(kinds))
    if kind == "label":
        lines = [f"I ({100 + 20 * k}) SKIN: {cells}" for k, cells in enumerate(lists)]
    elif kind == "marks":
        lines = [f"<{20 * k},{cells}>" for k, cells in enumerate(lists)]
    elif kind == "stamp":
        lines = [
            f"[{clock}] {cells}" for clock, cells in zip(clocks, lists, strict=True)
        ]
    elif kind == "pairs":
        pairs = [
            ", ".join(f"s{k}: {reading} mV" for k, reading in enumerate(frame))
            for frame in readings
        ]
        lines = [f"t: {20 * k} ms, {text}" for k, text in enumerate(pairs)]
    else:
        form = {"list": '"[{}]"', "array": "\"array('H', [{}])\"", "numpy": "[{}]"}[
            kind
        ]
        if kind == "numpy":
            lists = [cells.replace(",", "") for cells in lists]
        lists = [form.format(cells) for cells in lists]
        lines = [
            f"{clock},{cells},97" for clock, cells in zip(clocks, lists, strict=True)
        ]
        lines.insert(0, "clock,pressure,battery")
    seconds = 0.02 * np.arange(n)
    stated = {"n_rows": n_rows, "n_cols": n_cols, "unit": "counts"}
    if kind in ("label", "pairs", "marks"):
        stated |= {"time": "1", "time_unit": "ms"}
    frames = readings.reshape(n, n_rows, n_cols).astype("f4")
    return DrawnTable("\n".join(lines) + "\n", frames, seconds, stated)


@st.composite
def grids(draw):
    """A `DrawnTable` of blocks of lines, perhaps with the numbers of rows and columns."""
    n_rows, n_cols = draw(st.integers(2, 5)), draw(st.integers(3, 5))
    n = draw(st.integers(2, 6))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    frames = rng.integers(1, 1000, (n, n_rows, n_cols))
    frames[0, 0, 0] = 999
    begin = draw(st.integers(0, 1))
    has_labels = draw(st.booleans())
    has_positions = has_labels and draw(st.booleans())
    is_numbered = not has_labels and n > 2 and draw(st.booleans())
    positions = ",".join(["", *(str(begin + k) for k in range(n_cols))])
    lines = []
    for number, frame in enumerate(frames):
        if has_positions:
            lines.append(positions)
        if is_numbered:
            lines.append(f"{20 * number}")
        for k, row in enumerate(frame):
            label = [str(begin + k)] if has_labels else []
            lines.append(",".join([*label, *map(str, row)]))
        lines.append("")
    stated = {"unit": "counts"}
    if draw(st.booleans()):
        stated |= {"n_rows": n_rows, "n_cols": n_cols}
    if is_numbered:
        stated |= {"time": "none"}
    return DrawnTable("\n".join(lines), frames.astype("f4"), None, stated)
