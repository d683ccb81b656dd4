"""The commands `sparseskin calibrate`, from raw readings of a skin to its file skin.toml, and
`tare`, which makes the reading of an untouched skin its zero.
"""

import argparse
import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sparseskin.launch.attach.client import ask_node, describe, describe_node
from sparseskin.launch.attach.text import facts, table
from sparseskin.launch.run.running import GraphError, RunningGraph, choose_graph
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.files import TAKEN, OutputError
from sparseskin.nodes.sensor.calibration.description import SkinFileError
from sparseskin.nodes.sensor.calibration.fit import (
    AREAS,
    LOADS,
    CalibrationError,
    Fit,
    Press,
    fit,
    read_area,
    read_load,
)
from sparseskin.nodes.sensor.doubt.doubt import line_on_sign
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.layout.layout import Layout
from sparseskin.nodes.sensor.raw_frames import (
    PARTS,
    Live,
    Recorded,
    open_frames,
    read_part,
)
from sparseskin.nodes.sensor.skin_file import save_skin

from .options import (
    add_graph,
    add_layout,
    as_options,
    layout_of,
    rare,
    real,
    show,
    whole,
)

UNTOUCHED = "3s"
"""Untouched frames where none are stated: at 10 Hz 30, enough for a standard deviation."""
STEP_S = 2.0
"""Time for which a guided step collects frames under a load, seconds; chosen: a hand is steady."""
CURVES = ("shared", "taxel", "linear")


def configure(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Calibrate a skin: baseline, noise and faulty taxels from untouched frames, gains and "
        "response curve from presses of known weight. Without --press it asks for each step."
    )
    rarely_used = rare(parser)
    parser.add_argument(
        "source", metavar="SOURCE", help="as sensor.source; readings may be raw"
    )
    _add_presses(parser, rarely_used)
    _add_readings(parser, rarely_used)
    add_layout(parser, but=("unit", "f_max", "rate_hz"))
    parser.set_defaults(run=_calibrate)


def _add_presses(
    parser: argparse.ArgumentParser, rarely_used: argparse._ArgumentGroup
) -> None:
    """Options of the file that is written, of untouched frames, and of presses."""
    parser.add_argument(
        "--out",
        metavar="F.toml",
        type=Path,
        required=True,
        help="file to write, NAME.toml; large arrays lie beside it in NAME.npz",
    )
    about = "untouched frames: the first seconds (3s), a part of a recording (5-8s), or a file"
    parser.add_argument(
        "--untouched",
        metavar="WHERE",
        default=UNTOUCHED,
        help=about,
    )
    about = (
        "a load and its frames, as 500g:12-15s, 4.9N:FILE; with an area that carries it evenly, as "
        "500g@all:FILE, 500g@4-11x8-15:12-15s (rows x columns); may be repeated"
    )
    parser.add_argument(
        "--press",
        metavar="LOAD[@AREA]:WHERE",
        action="append",
        help=about,
    )
    parser.add_argument(
        "--no-questions",
        action="store_true",
        help="ask nothing: take no presses, or those of --press",
    )
    rarely_used.add_argument(
        "--wait",
        metavar="S",
        type=real(above_0=False),
        help="live sources: seconds to wait before each step, in place of Enter",
    )
    about = "even loads of several weights: one curve for all taxels, one each, or none"
    rarely_used.add_argument(
        "--curve",
        choices=CURVES,
        default=CURVES[0],
        help=about,
    )


def _add_readings(
    parser: argparse.ArgumentParser, rarely_used: argparse._ArgumentGroup
) -> None:
    """Options of what a skin and its readings are."""
    rarely_used.add_argument(
        "--name", help="name of the skin; default: that of the file"
    )
    about = (
        "upper end of a taxel's range; default: 1.25 times the largest force of a press"
    )
    parser.add_argument(
        "--f-max",
        metavar="X",
        type=real(above_0=True),
        help=about,
    )
    about = (
        "unit of the readings where there are no presses; default: that of the source"
    )
    rarely_used.add_argument("--unit", help=about)
    rarely_used.add_argument(
        "--pitch-mm",
        metavar="X",
        type=real(above_0=True),
        help="distance of neighbouring taxels; default: that of the source",
    )
    rarely_used.add_argument(
        "--invert",
        choices=("true", "false"),
        default="false",
        help="without a press: readings fall with force",
    )
    rarely_used.add_argument(
        "--keep-noise",
        action="store_true",
        help="let the range begin below 0, so that noise around 0 is not clipped",
    )


def _calibrate(arguments: argparse.Namespace) -> int:
    out: Path = arguments.out
    # A person presses once: what can fail is checked before.
    _check_out(out)
    layout = layout_of(arguments)
    invert = arguments.invert == "true"
    reader = open_frames(arguments.source, layout)
    try:
        # A live source is closed even where the questions are broken off.
        steps = _Steps(arguments, reader, layout)
        untouched = steps.untouched()
        presses = steps.presses()
    finally:
        reader.close()

    skin = reader.skin
    # With presses the range follows from the largest of them.
    f_max = arguments.f_max
    if not f_max and not presses:
        f_max = skin.f_max
    # The file states millimetres, the skin metres.
    pitch_mm = arguments.pitch_mm
    if not pitch_mm and skin.pitch_m is not None:
        pitch_mm = 1000 * skin.pitch_m
    calibration = fit(
        arguments.name or out.stem,
        untouched,
        presses,
        f_max=f_max,
        unit=arguments.unit or skin.unit,
        pitch_mm=pitch_mm,
        mask=skin.mask,
        curve=arguments.curve,
        keep_noise=arguments.keep_noise,
        invert=invert,
    )
    # Presses show the sign; without one, a touch in the rest of the recording may.
    if not presses and isinstance(reader, Recorded):
        line = line_on_sign(calibration.skin, reader.frames, invert)
        if line:
            calibration.remarks.append(as_options(line))

    print("\n".join(report(calibration)))
    for path in save_skin(out, calibration.skin):
        print(f"{path}: written")
    # The next command of most people.
    settings = (f"sensor.source={arguments.source}", f"sensor.skin={out}")
    words = " ".join(f"--set {shlex.quote(setting)}" for setting in settings)
    print(f"use it: sparseskin launch replay {words}")
    return 0


def _check_out(out: Path) -> None:
    """Raise an error if the file cannot be written, before a person has pressed."""
    if out.suffix != ".toml":
        raise SkinFileError(f"--out {out}: expected a name that ends in .toml")
    # Arrays may lie beside it: a file of another skin must not be overwritten.
    for path in (out, out.with_suffix(".npz")):
        if path.exists():
            raise OutputError(f"--out {path}: {TAKEN}")


class _Steps:
    """The steps of a calibration: asked for in the terminal, waited for, or taken from files."""

    def __init__(
        self, arguments: argparse.Namespace, reader: Recorded | Live, layout: Layout
    ) -> None:
        self._arguments = arguments
        self._layout = layout
        self._reader = reader
        self._shape = reader.skin.shape

    def untouched(self) -> Any:
        """Frames of the untouched skin."""
        return self._frames(self._arguments.untouched, "Leave the skin untouched")

    def presses(self) -> list[Press]:
        """Loads and their frames: those of --press, or those that a person states."""
        if self._arguments.press or self._arguments.no_questions:
            return [self._stated(text) for text in self._arguments.press or ()]

        presses: list[Press] = []
        # An empty line ends the list of presses.
        question = f"Load on the skin ({LOADS}; empty: no more): "
        force = self._answer(question, read_load)
        while force:
            press = self._asked(force)
            if press is None:
                break
            presses.append(press)
            force = self._answer(question, read_load)
        return presses

    def _asked(self, force: float) -> Press | None:
        """Area and frames of a load that a person states; None if there are no frames."""
        answer = self._answer(
            f"Area that carries it evenly ({AREAS}; empty: not known): ",
            lambda text: (f"@{text}", read_area(text, self._shape)),
        )
        at, area = answer or ("", None)
        label = f"{force:.4g}N{at}"
        # A recording was made before: the person states where the press is in it.
        if self._reader.is_live:
            frames = self._frames(f"{STEP_S:g}s", f"Put {label} on")
        else:
            frames = self._answer(
                "Part of the recording (START-STOPs), or a file: ",
                lambda text: self._frames(text, ""),
            )
        if frames is None:
            return None
        return Press(label, force, frames, area)

    def _stated(self, text: str) -> Press:
        load_at_area, colon, where = text.partition(":")
        if not (colon and where):
            raise CalibrationError(
                f"--press {text}: expected LOAD[@AREA]:WHERE, LOAD as {LOADS}, WHERE as 5-8s or "
                "a file"
            )
        # An error of any part names the option as it was typed.
        load, at, area = load_at_area.partition("@")
        try:
            force = read_load(load)
            cells = None
            if at:
                cells = read_area(area, self._shape)
            frames = self._frames(where, f"Put {load_at_area} on the skin")
        except SparseskinError as error:
            raise CalibrationError(f"--press {text}: {error}") from error
        return Press(load_at_area, force, frames, cells)

    def _answer(self, question: str, read: Callable[[str], Any]) -> Any:
        """What a person answers, asked again until it can be read; None for an empty line."""
        while True:
            text = _line(question)
            if not text:
                return None
            try:
                return read(text)
            except SparseskinError as error:
                print(error)

    def _frames(self, where: str, request: str) -> Any:
        """Frames of a part of the source, or of a file."""
        # START-STOPs of the source, or else the name of a file.
        part = read_part(where)
        if part is None:
            if not Path(where).exists():
                raise CalibrationError(
                    f"{where}: no such file; allowed: {PARTS}, or a file"
                )
            return open_file(where, self._layout, raw=True).frames
        # Of a live source the part is in the future.
        if self._reader.is_live:
            begin_s, end_s = part
            self._wait(f"{end_s - begin_s:g} s", request)
        return self._reader.part(*part)

    def _wait(self, duration: str, request: str) -> None:
        """Wait for a person to do what is requested: for Enter, or the stated time."""
        # A script waits for a time, a person answers.
        wait_s = self._arguments.wait
        if wait_s is None and self._arguments.no_questions:
            wait_s = 0.0
        if wait_s is None:
            _line(f"{request}, then press Enter ({duration}): ")
        else:
            print(f"{request}: {duration} in {wait_s:g} s", flush=True)
            time.sleep(wait_s)


def _line(question: str) -> str:
    """A line of standard input.
    Raises CalibrationError at its end: whoever closed it has not answered.
    """
    print(question, end="", flush=True)
    text = sys.stdin.readline()
    # The terminal shows the line break that a person types, a pipe shows none.
    if not (text and sys.stdin.isatty()):
        print()
    if not text:
        raise CalibrationError(
            "the input ended before the questions; nothing is written (--press, --no-questions "
            "and --wait ask none)"
        )
    return text.strip()


def report(calibration: Fit) -> list[str]:
    """Lines about a calibration: the skin, its faulty taxels, how well it measures its presses."""
    skin = calibration.skin
    size = f"{skin.n_rows} x {skin.n_cols} taxels, {skin.f_min:g}..{skin.f_max:g} {skin.unit}"
    lines = [f"{skin.name}: {size}", *facts(_properties(calibration))]
    if calibration.presses:
        head = (
            "PRESS",
            "STATED N",
            "MEASURED N",
            "ERROR %",
            "TAXELS +- %",
            "BEFORE +- %",
        )
        rows = []
        for press in calibration.presses:
            # What a person reads first: how far off each press is.
            error = 100 * (press.measured / press.force - 1)
            spreads = [_percent(press.spread), _percent(press.spread_before)]
            rows.append([press.label, press.force, press.measured, error, *spreads])
        lines += ["", *table(head, rows)]
    return [*lines, *(f"note: {remark}" for remark in calibration.remarks)]


def _properties(calibration: Fit) -> dict[str, str]:
    skin = calibration.skin
    noise = f"{skin.noise or 0.0:.3g} {skin.unit} ({calibration.noise_raw:.3g} raw)"
    n_masked = calibration.stuck + calibration.noisy + calibration.dead
    masked = f"{n_masked} taxels"
    if n_masked:
        masked += f": {calibration.stuck} stuck, {calibration.noisy} noisy, "
        masked += f"{calibration.dead} dead"
    properties = {
        "noise": f"{noise}, of {calibration.n_frames} untouched frames",
        "masked": masked,
    }
    if skin.response is not None:
        taxels = "all taxels"
        if skin.response.reading.ndim == 3:
            # Points of a curve, by row and column.
            taxels = "each taxel"
        properties["response"] = f"{len(skin.response.force)} knots for {taxels}"
    return properties


def _percent(share: float | None) -> float | None:
    if share is None:
        return None
    return 100 * share


TARE = "tare"
POLL_S = 0.1
PATIENCE_S = 60.0
"""Longest time without another frame of a tare, seconds; chosen."""


def configure_tare(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Take the next frames of the sensors of a running graph for the baseline; the skin must be "
        "untouched. Returns once it is done."
    )
    parser.add_argument(
        "nodes",
        metavar="NODE",
        nargs="*",
        help="names of sensors; all that have a calibration by default",
    )
    rare(parser).add_argument(
        "--frames",
        metavar="N",
        type=whole(1),
        help="number of frames, whose median is taken (default: 30)",
    )
    add_graph(parser, "one JSON document")
    parser.set_defaults(run=_tare)


def _tare(arguments: argparse.Namespace) -> int:
    graph = choose_graph(arguments.graph)
    # All are started before the first is waited for.
    names = arguments.nodes or _calibrated(graph)
    for name in names:
        ask_node(graph, name, TARE, arguments.frames)
    results = {name: _wait_for_tare(graph, name) for name in names}
    lines = [f"{name}: {text}" for name, text in results.items()]
    return show(
        arguments, "tare-result", {"graph": graph.label, "tared": results}, lines
    )


def _calibrated(graph: RunningGraph) -> list[str]:
    nodes: list[dict[str, Any]] = describe(graph)["nodes"]
    names = [node["name"] for node in nodes if "tare_left" in node["state"]]
    if names:
        return names
    hint = ""
    if any(node["type"] == "sensor" for node in nodes):
        hint = "; state sensor.skin, or sensor.tare, in the launch file"
    raise GraphError(f"{graph.label}: has no sensor with a calibration{hint}")


def _wait_for_tare(graph: RunningGraph, name: str) -> str:
    """Wait for the end of a tare; return its result."""
    heard_s = time.monotonic()
    n_missing = None
    while time.monotonic() - heard_s < PATIENCE_S:
        state = describe_node(graph, name)["state"]
        n_now = state.get("tare_left")
        if n_now == 0:
            return str(state.get("tared", ""))
        if n_now is None:
            raise GraphError(f"{name}: has no calibration")
        if n_now != n_missing:
            heard_s = time.monotonic()
            n_missing = n_now
        time.sleep(POLL_S)
    raise GraphError(
        f"{name}: no frame for {PATIENCE_S:g} s; {n_missing} frames are missing"
    )
