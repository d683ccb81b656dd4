"""Raw frames for a calibration: parts of a recording, or what a live source delivers now."""

import re
import threading
import time

import numpy as np

from sparseskin.nodes.errors import SourceError, SparseskinError
from sparseskin.nodes.numerics.arrays import AnyArray

from .calibration.fit import CalibrationError
from .layout.layout import EMPTY, Layout
from .source import Skin, Source
from .sources import open_source

MAX_READINGS = 1 << 27
"""Most readings that are kept of one step, chosen: 512 MiB."""
SILENT_S = 5.0
"""Time without a frame after which a live source has failed, seconds; chosen."""
POLL_S = 0.01
PARTS = "seconds as 3s, or START-STOPs as 5-8s"
_PART = re.compile(r"(?:(\d{1,6}(?:\.\d{1,6})?)-)?(\d{1,6}(?:\.\d{1,6})?)s")

Frames = AnyArray


def read_part(text: str) -> tuple[float, float] | None:
    """Start and stop of a part of a recording, seconds; None if a text is no such part.
    Raises CalibrationError if it is empty, or numbers without their unit.
    """
    match = _PART.fullmatch(text)
    # A bare number is meant for frames or seconds: no guess is made.
    if match is None and _PART.fullmatch(f"{text}s"):
        raise CalibrationError(
            f"{text}: expected seconds, as {text}s, or a file; frames are not counted"
        )
    if match is None:
        return None
    start = float(match[1] or 0)
    stop = float(match[2])
    if not start < stop:
        raise CalibrationError(f"{text}: the part is empty; expected {PARTS}")
    return start, stop


class Recorded:
    """Parts of a source that ends, by their stamps; all of it is read."""

    is_live = False

    def __init__(self, skin: Skin, stamps_ns: list[int], frames: Frames) -> None:
        self.skin = skin
        self._stamps_s = np.array(stamps_ns, dtype=np.float64) / 1e9
        self.frames = frames

    def part(self, start_s: float, stop_s: float) -> Frames:
        """Frames with stamps in [start_s, stop_s), seconds since the first.
        Raises CalibrationError if there is none.
        """
        is_in_part = (self._stamps_s >= start_s) & (self._stamps_s < stop_s)
        if not is_in_part.any():
            raise CalibrationError(
                f"{start_s:g}-{stop_s:g}s: no frame of the recording, which lasts "
                f"{self._stamps_s[-1]:g} s"
            )
        return self.frames[is_in_part]

    def close(self) -> None:
        """Nothing to close."""


class Live:
    """Frames of a live source, read in the background so that none is old when it is used."""

    is_live = True

    def __init__(self, source: Source) -> None:
        self.skin: Skin = source.skin
        self._source = source
        self._error = ""
        self._closing = False
        #: Where the thread puts frames; None while no part is asked for.
        self._keep: list[Frames] | None = None
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def part(self, start_s: float, stop_s: float) -> Frames:
        """Frames of the next `stop_s - start_s` seconds.
        Raises CalibrationError if none comes, or the source fails or ends.
        """
        max_frames = max(2, MAX_READINGS // (self.skin.n_rows * self.skin.n_cols))
        end = time.monotonic() + stop_s - start_s
        frames: list[Frames] = []
        self._keep = frames
        while not self._error and len(frames) < max_frames:
            # The first frame is waited for longer.
            deadline = end
            if not frames:
                deadline += SILENT_S
            if time.monotonic() >= deadline:
                break
            time.sleep(POLL_S)
        self._keep = None

        if not frames:
            raise CalibrationError(
                self._error or f"{self._source.name}: no frame in {SILENT_S:g} s"
            )
        return np.stack(frames)

    def close(self) -> None:
        """Close the source, where it can be."""
        self._closing = True
        # A device that is silent holds its reader: it is left to the end of the process.
        self._thread.join(1.0)
        if not self._thread.is_alive():
            self._source.close()

    def _read(self) -> None:
        try:
            for _, frame in self._source:
                # `part` may set it to None meanwhile.
                frames = self._keep
                if frames is not None:
                    frames.append(frame)
                if self._closing:
                    return
            self._error = f"{self._source.name}: has ended"
        except SparseskinError as cause:
            self._error = str(cause)


def open_frames(source: str, layout: Layout = EMPTY) -> Recorded | Live:
    """Open the source of a skin that is to be calibrated, by its name as in `open_source`.
    Raises SourceError if it cannot be opened, or delivers forces, as a scene does.
    """
    opened = open_source(source, seed=0, layout=layout, raw=True)

    if opened.delivers == "truth":
        opened.close()
        raise SourceError(f"{source}: delivers true forces, which need no calibration")
    # What has no end is read as it comes.
    if opened.is_live or opened.n_frames is None:
        return Live(opened)
    stamps_ns, frames = zip(*opened, strict=True)
    return Recorded(opened.skin, list(stamps_ns), np.stack(frames))
