"""The command `sparseskin recording look`: how a file would be read, before it is imported."""

import argparse
import os
import shlex
import shutil
import sys
from itertools import islice
from pathlib import Path

import numpy as np

from sparseskin.launch.attach.heat_map import heat_map
from sparseskin.launch.attach.text import facts
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.recorder.bag.format import FILE_SUFFIX
from sparseskin.nodes.recorder.convert.to_bag import FileForces
from sparseskin.nodes.sensor.files.file_source import located, open_file
from sparseskin.nodes.sensor.files.format import recording_of
from sparseskin.nodes.sensor.files.recording import Block, File, Head
from sparseskin.nodes.sensor.files.survey import Needs
from sparseskin.nodes.sensor.layout.checks import reading
from sparseskin.nodes.sensor.layout.layout import EMPTY, KEYS, Layout, UnstatedError

from .options import add_layout, add_rest, as_options, layout_of

MAP_LINES = 16
MAP_WIDTH = 72
"""Size of the map of the first frame, characters: it fits a terminal of 80 x 24 with the text."""
MAX_NAMES = 3
MAX_NUMBERS = 8
MAX_STEPS = 1000
"""Frames whose times are looked at; chosen."""


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file", metavar="FILE", help="a file, a folder, or example:NAME"
    )
    add_layout(parser)
    add_rest(parser)


def look(arguments: argparse.Namespace) -> int:
    """Show how a file would be read: what was recognised, what is left out, the first frame, and
    the command that imports it so. The exit code is 2 if something has to be stated first.
    """
    name = str(arguments.file).removeprefix("file:")
    layout = layout_of(arguments)
    try:
        print("\n".join(_head_lines(name, layout)))
        lines = _frame_lines(name, layout, arguments.tare, arguments.invert == "true")
    except SourceError as error:
        text = as_options(str(error))
        print(f"\nnot read yet: {printable(text)}", file=sys.stderr)
        return 2
    print("\n".join(lines))
    return 0


def _head_lines(name: str, layout: Layout) -> list[str]:
    """What the begin of the file shows."""
    # The begin of the file is enough: this also works where the rest cannot be read.
    with located(name) as (path, parts), reading(path) as file:
        try:
            recording = recording_of(File(file, path, parts, layout, raw=True))
        except UnstatedError:
            # If only the times are not clear, the rest can be shown.
            untimed = layout.stating({"time": "none"})
            recording = recording_of(File(file, path, parts, untimed, raw=True))
        head = recording.head()
        block = next(iter(recording.blocks()), None)

    file_text = name
    if parts:
        # A recording of several files, as of one a frame.
        file_text += f" and {len(parts)} more"
    properties = {
        "file": file_text,
        "numbers": f"{_sides(head)}{_names(head)}",
        "first item": _first_numbers(block, head),
        "times": _times(head, layout),
        "unit": _unit(head, layout),
    }
    if head.rate_hz is not None:
        properties["rate"] = f"{head.rate_hz:g} Hz"
    if head.mask is not None:
        n_taxels = int(head.mask.sum())
        properties["mask"] = f"{n_taxels} of {head.mask.size} cells are taxels"
    return facts(properties)


def _unit(head: Head, layout: Layout) -> str:
    if head.unit:
        return head.unit
    if layout.unit:
        return f"{layout.unit}, as stated"
    return "not stated"


def _sides(head: Head) -> str:
    """How many numbers an item has that may be readings."""
    # All numbers may be readings, or only some columns.
    if head.usable is None:
        sides = (f"{axis.size} {axis.label}".strip() for axis in head.axes)
        return f"{' x '.join(sides)} per frame"

    text = f"{len(head.usable)} columns"
    n_others = head.axes[0].size - len(head.usable)
    if n_others:
        text += f" (and {n_others} of times, counts or texts)"
    return text


def _first_numbers(block: Block | None, head: Head) -> str:
    """The first numbers of the first item that may be readings."""
    if block is None:
        return "none"
    # Whatever its shape: it is the order of the file.
    item = np.asarray(block.numbers[0], dtype=np.float64)
    numbers = item.reshape(-1)
    if head.usable is not None:
        numbers = numbers[list(head.usable)]
    texts = [f"{number:.6g}" for number in numbers[:MAX_NUMBERS].tolist()]
    if numbers.size > MAX_NUMBERS:
        texts.append("...")
    return ", ".join(texts)


def _names(head: Head) -> str:
    """The names of the numbers, the first and the last ones."""
    if len(head.axes) != 1 or not any(head.axes[0].names):
        return ""
    names = head.axes[0].names
    if head.usable is not None:
        names = tuple(names[k] for k in head.usable)
    if len(names) <= 2 * MAX_NAMES:
        return f": {', '.join(map(printable, names))}"
    begin = ", ".join(map(printable, names[:MAX_NAMES]))
    return f": {begin}, ... {printable(names[-1])}"


def _times(head: Head, layout: Layout) -> str:
    if not head.is_timed:
        return "none recognised"
    # Which times are read decides on the rate, and on the age of frames.
    times = head.time_name or "of each item"
    if layout.rate_hz is not None:
        return f"{times}, not read: rate_hz is stated"
    if not head.time_unit:
        return f"{times}, of no stated unit"
    return f"{times} in {head.time_unit}"


def _frame_lines(
    name: str, layout: Layout, tare: int | None, invert: bool
) -> list[str]:
    """What the frames show: those of the begin, of a large file."""
    is_raw = bool(tare or invert)
    source = open_file(name, layout, is_raw, Needs(begin=True))
    skin = source.skin
    log: list[str] = []
    forces_of = FileForces(source, tare, invert, log.append)
    stamps_ns: list[int] = []
    first_forces: Floats | None = None
    for stamp_ns, readings, _ in islice(source.filled(), MAX_STEPS):
        stamps_ns.append(stamp_ns)
        # Each frame shows how the skin rests.
        frame = forces_of.frame(readings, stamp_ns)
        if first_forces is None and frame is not None:
            first_forces = frame[0].copy()
    if first_forces is None:
        raise SourceError(f"{name}: all of its first frames are of the tare")
    taxels = f"{skin.n_rows} x {skin.n_cols}"
    if skin.mask is not None:
        taxels += f", {skin.n_taxels} exist"

    properties = {"taxels": taxels, "readings": f"up to {skin.f_max:g} {skin.unit}"}
    if len(stamps_ns) > 1:
        properties["time step"] = _steps_text(stamps_ns)
    for k, note in enumerate([*source.notes, *log]):
        properties[f"note {k + 1}"] = as_options(note)
    if forces_of.line:
        properties["not trusted"] = as_options(forces_of.line)

    command = _command(name, layout, tare, invert)
    answer_first = []
    if forces_of.line:
        answer_first = ["first answer what is not trusted, by its option", ""]
    return [
        *facts(properties),
        "",
        *_picture_lines(first_forces),
        "",
        *answer_first,
        f"import it: {command}",
    ]


def _steps_text(stamps_ns: list[int]) -> str:
    """Times from frame to frame."""
    steps_ms = 1000 * np.diff(np.array(stamps_ns) / 1e9)
    extent = f"{steps_ms.min():.4g} to {steps_ms.max():.4g}"
    return f"{np.median(steps_ms):.4g} ms (median), {extent}"


def _picture_lines(forces: Floats) -> list[str]:
    """The first frame as a map."""
    # Missing readings are NaN; the map shows them as 0.
    largest = float(np.nanmax(forces))
    title = f"first frame, up to {largest:.4g}:"
    if not largest > 0:
        title = "first frame: no reading is above 0"
    width = min(MAP_WIDTH, shutil.get_terminal_size().columns - 1)
    coloured = sys.stdout.isatty() and "NO_COLOR" not in os.environ
    top = max(largest, 1e-9)
    return [title, *heat_map(np.nan_to_num(forces), top, width, MAP_LINES, coloured)]


def _command(name: str, layout: Layout, tare: int | None, invert: bool) -> str:
    """The command that imports the file as it was looked at."""
    stem = Path(name.partition(":")[2] or name).stem
    words = ["sparseskin", "recording", "import", name, "--out", f"{stem}{FILE_SUFFIX}"]
    for key in KEYS:
        value = getattr(layout, key)
        if value != getattr(EMPTY, key):
            # A value that begins with a dash would pass for an option.
            words.append(f"--{key.replace('_', '-')}={value}")
    if tare is not None:
        words.append(f"--tare={tare}")
    if invert:
        words.append("--invert=true")
    return shlex.join(words)
