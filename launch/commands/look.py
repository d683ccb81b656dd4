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
from sparseskin.nodes.recorder.bag.format import FILE_SUFFIX
from sparseskin.nodes.sensor.files.file_source import located, open_file
from sparseskin.nodes.sensor.files.format import recording_of
from sparseskin.nodes.sensor.files.recording import Block, File, Head, reading
from sparseskin.nodes.sensor.layout.layout import EMPTY, KEYS, Layout, UnstatedError

from .options import add_layout, as_options, layout_of

MAP_LINES = 16
MAP_WIDTH = 72
MAX_NAMES = 3
MAX_NUMBERS = 8
MAX_STEPS = 1000
"""Frames whose times are looked at; chosen."""


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="a file, a folder, or example:NAME")
    add_layout(parser)


def look(arguments: argparse.Namespace) -> int:
    """Show how a file would be read: what was recognised, what is left out, the first frame, and
    the command that imports it so. The exit code is 2 if something has to be stated first.
    """
    name = str(arguments.file).removeprefix("file:")
    layout = layout_of(arguments)
    try:
        print("\n".join(_head_lines(name, layout)))
        lines = _frame_lines(name, layout)
    except SourceError as error:
        text = as_options(str(error))
        print(f"\nnot read yet: {printable(text)}", file=sys.stderr)
        return 2
    print("\n".join(lines))
    return 0


def _head_lines(name: str, layout: Layout) -> list[str]:
    """What the begin of the file shows."""
    with located(name) as (first, parts), reading(first) as file:
        try:
            recording = recording_of(File(file, first, parts, layout, raw=True))
        except UnstatedError:
            # If only the times are not clear, the rest can be shown.
            untimed = layout.stating({"time": "none"})
            recording = recording_of(File(file, first, parts, untimed, raw=True))
        head = recording.head()
        block = next(iter(recording.blocks()), None)
    known = {
        "file": name + (f" and {len(parts)} more" if parts else ""),
        "numbers": f"{_sides(head)}{_names(head)}",
        "first item": _first_numbers(block, head),
        "times": _times(head, layout),
        "unit": head.unit or (f"{layout.unit}, as stated" if layout.unit else "not stated"),
    }
    if head.rate_hz is not None:
        known["rate"] = f"{head.rate_hz:g} Hz"
    if head.mask is not None:
        known["mask"] = f"{int(head.mask.sum())} of {head.mask.size} cells are taxels"
    return facts(known)


def _sides(head: Head) -> str:
    """How many numbers an item has that may be readings."""
    if head.usable is not None:
        n_left_out = head.axes[0].size - len(head.usable)
        left_out = f" (and {n_left_out} of times, counts or texts)" * bool(n_left_out)
        return f"{len(head.usable)} columns{left_out}"
    return " x ".join(f"{axis.size} {axis.label}".strip() for axis in head.axes) + " per frame"


def _first_numbers(block: Block | None, head: Head) -> str:
    """The first numbers of the first item that may be readings."""
    if block is None:
        return "none"
    numbers = np.asarray(block.numbers[0], dtype=np.float64).reshape(-1)
    if head.usable is not None:
        numbers = numbers[list(head.usable)]
    shown = ", ".join(f"{number:.6g}" for number in numbers[:MAX_NUMBERS].tolist())
    return shown + ", ..." * (numbers.size > MAX_NUMBERS)


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
    if layout.rate_hz is not None:
        return f"{head.time_name or 'of each item'}, not read: rate_hz is stated"
    unit = f" in {head.time_unit}" if head.time_unit else ", of no stated unit"
    return f"{head.time_name or 'of each item'}{unit}"


def _frame_lines(name: str, layout: Layout) -> list[str]:
    """What all of the file shows."""
    source = open_file(name, layout)
    sample = islice(source, MAX_STEPS)
    first_ns, first = next(sample)
    # The frames are not kept: of a large file each pass decodes it.
    stamp_s = np.array([first_ns, *(stamp_ns for stamp_ns, _ in sample)]) / 1e9
    known = {
        "taxels": f"{source.skin.n_rows} x {source.skin.n_cols}"
        + ("" if source.skin.mask is None else f", {source.skin.n_taxels} exist"),
        "readings": f"up to {source.skin.f_max:g} {source.skin.unit}",
    }
    if len(stamp_s) > 1:
        steps_ms = 1000 * np.diff(stamp_s)
        known["time step"] = (
            f"{np.median(steps_ms):.4g} ms (median), {steps_ms.min():.4g} to {steps_ms.max():.4g}"
        )
    for k, note in enumerate(source.notes):
        known[f"note {k + 1}"] = as_options(note)
    top = max(float(np.nanmax(first)), 1e-9)
    width = min(MAP_WIDTH, shutil.get_terminal_size().columns - 1)
    coloured = sys.stdout.isatty() and "NO_COLOR" not in os.environ
    picture = heat_map(np.nan_to_num(first), top, width, MAP_LINES, coloured)
    title = "first frame:" if np.nanmax(first) > 0 else "first frame: no reading is above 0"
    return [*facts(known), "", title, *picture, "", f"import it: {_command(name, layout)}"]


def _command(name: str, layout: Layout) -> str:
    """The command that imports the file as it was looked at."""
    out = f"{Path(name.partition(':')[2] or name).stem}{FILE_SUFFIX}"
    words = ["sparseskin", "recording", "import", name, "--out", out]
    for key in KEYS:
        value = getattr(layout, key)
        if value != getattr(EMPTY, key):
            # A value that begins with a dash would pass for an option.
            words.append(f"--{key.replace('_', '-')}={value}")
    return shlex.join(words)
