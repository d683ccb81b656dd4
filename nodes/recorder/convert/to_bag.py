"""Bags made of other files: recordings in other formats, and broken bags."""

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from sparseskin.messages import Message, MessageError, SkinState, Taxels
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import progress
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import BagWriter, removing
from sparseskin.nodes.recorder.node import metadata_of
from sparseskin.nodes.sensor.calibration.chain import Chain
from sparseskin.nodes.sensor.calibration.description import of_skin
from sparseskin.nodes.sensor.calibration.drift import DRIFT_RATE
from sparseskin.nodes.sensor.doubt.doubt import Doubt
from sparseskin.nodes.sensor.files.file_source import RecordedSource, open_file
from sparseskin.nodes.sensor.files.survey import Needs
from sparseskin.nodes.sensor.layout.layout import EMPTY, KEEP, Layout
from sparseskin.nodes.sensor.source import DEFAULT_RATE_HZ

PATCH = "skin"
"""Patch of the frames of a file, as of a sensor unless stated otherwise."""


def import_file(
    source: Path,
    out: Path,
    *,
    layout: Layout = EMPTY,
    keep: Sequence[str] = (),
    tare: int | None = None,
    invert: bool = False,
    log: Callable[[str], None] = lambda _: None,
) -> int:
    """Write a recording, in any format that the sensor reads, as a bag.

    The bag holds what a sensor would have published from the file: /skin/skin, then
    /skin/taxels, with stamps from 0; and /skin/calibration where readings are made forces. The
    run id is a hash of the frames, so the same file gives the same bag.

    `layout` is what the file does not state; `keep` are further channels, as x and y, each of
    which becomes a patch of its own, skin_x, with its sign; `tare` and `invert` are settings of
    the sensor: frames of the tare are left out. Frames that are not to be trusted for rest, sign
    or range have the reason. `log` is called with lines on how the file was read, on what was
    assumed, on readings that were not valid, and on rest and sign. Returns the number of frames.

    Raises SourceError if the recording is missing or malformed or a setting contradicts it,
    BagError if the bag exists or cannot be written.
    """
    main = _Imported(source, PATCH, layout, _Zeroing(tare, invert), log)
    patches = [main]
    for channel in keep:
        # x and y are forces of both signs, which a range from 0 on would cut.
        name = f"{PATCH}_{channel}"
        of_channel = layout.stating({"channel": channel, "negative": KEEP})
        patches.append(_Imported(source, name, of_channel, _Zeroing(0), log))
    metadata = metadata_of(launch="", graph="") | {"imported_from": source.name}
    with _whole_bag(out, metadata, {"lost": {}}) as bag:
        # All patches by time, as a recorder would have received them.
        streams = [imported.messages() for imported in patches]
        total = (main.frames.n_frames or 0) * len(patches)
        merged = heapq.merge(*streams, key=lambda timed: timed[0])
        for stamp_ns, message, number in progress(merged, total, "import"):
            bag.record(message.published(main.frames.digest, number), stamp_ns)
        # A bag without a frame is no recording: nothing can be played.
        if main.n_frames == 0:
            raise BagError(f"{str(source)!r}: all frames are of the tare")
    return main.n_frames


class _Zeroing(NamedTuple):
    """What is stated of the reading at rest: settings of the sensor."""

    tare: int | None
    invert: bool = False


class _Imported:
    """One patch of a file that is imported."""

    def __init__(
        self,
        source: Path,
        patch: str,
        layout: Layout,
        zeroing: _Zeroing,
        log: Callable[[str], None],
    ) -> None:
        # Then readings are not forces yet, and may have any range.
        raw = bool(zeroing.tare or zeroing.invert)
        self.frames = open_file(source, layout, raw, Needs(digest=True))
        self.n_frames = 0
        self._source = source
        self._patch = patch
        self._log = log
        self._forces_of = FileForces(self.frames, zeroing.tare, zeroing.invert, log)
        # What was found as the file was opened stands before all else.
        for line in self.frames.take_lines():
            log(line)

    def messages(self) -> Iterator[tuple[int, Message, int]]:
        """Stamps, messages, and their numbers on their topics."""
        for stamp_ns, readings, missing in self.frames.filled():
            frame = self._forces_of.frame(readings, stamp_ns)
            if frame is None:
                continue
            # States come before the first frame that is no part of the tare.
            if self.n_frames == 0:
                for state in self._forces_of.states(self._skin_state()):
                    yield 0, state, 0
            forces, reason = frame
            taxels = Taxels(
                stamp_ns=stamp_ns,
                patch=self._patch,
                forces=forces,
                missing=missing,
                reason=reason,
            )
            yield stamp_ns, taxels, self.n_frames
            self.n_frames += 1
        # Once all frames are known: the counts in it are those of the whole file.
        if self._forces_of.line:
            self._log(self._forces_of.line)

    def _skin_state(self) -> SkinState:
        frames = self.frames
        rate_hz = DEFAULT_RATE_HZ if frames.rate_hz is None else frames.rate_hz
        try:
            return SkinState(
                stamp_ns=0,
                patch=self._patch,
                **vars(frames.skin),
                source=frames.name,
                seed=0,
                rate_hz=rate_hz,
                has_truth=False,
                sigma_mid=0.0,
                sigma_end=0.0,
                f_min=frames.f_min,
            )
        except MessageError as error:
            raise BagError(f"{str(self._source)!r}: {error}") from error


class FileForces:
    """Forces of the readings of a file, and why they are not to be trusted, as of a sensor."""

    def __init__(
        self,
        source: RecordedSource,
        tare: int | None,
        invert: bool,
        log: Callable[[str], None],
    ) -> None:
        described = of_skin(source.name, source.skin)
        if invert:
            described = described.inverted()
        # Drift is followed from the level at rest, which a tare measures.
        drift_rate = DRIFT_RATE if tare else 0.0
        self._chain: Chain | None = None
        if tare or invert:
            self._chain = Chain(described, drift_rate, tare or 0, log)
        # Who states one of them, a tare of 0 too, has looked at the readings.
        has_level = tare is None and not invert
        clipped = (self._chain or source).clipped
        self._doubt = Doubt(
            source.skin, clipped, has_level=has_level, is_inverted=invert
        )

    @property
    def line(self) -> str:
        """What makes all frames untrusted; "" if nothing does."""
        return self._doubt.line

    def frame(
        self, readings: Floats, stamp_ns: int
    ) -> tuple[Floats, tuple[str, ...]] | None:
        """Forces and reason of a frame, as of `Taxels`; None in a tare."""
        forces: Floats | None = readings
        if self._chain is not None:
            forces = self._chain.process(readings, stamp_ns)
        if forces is None:
            return None
        reason = self._doubt.look(forces)
        forces = self._doubt.filled(forces)
        reasons = (reason,) if reason else ()
        return forces, reasons

    def states(self, skin: SkinState) -> Iterator[Message]:
        """The states before the first frame: the calibration, where there is one, and the skin with
        the noise that it has shown.
        """
        if self._chain is not None:
            described = self._chain.description
            yield described.message(0, skin.patch)
            sigma_mid, sigma_end = described.sigmas or (0.0, 0.0)
            skin = replace(skin, sigma_mid=sigma_mid, sigma_end=sigma_end)
        yield skin


def recover_bag(bag: BagReader, out: Path) -> int:
    """Copy every readable message and the metadata of a broken bag into a new bag.

    The new metadata have the entry "recovered", a line on the damage. Returns the number of
    messages. Raises BagError if the new bag exists or cannot be written.
    """
    metadata = dict(bag.metadata)
    # A bag that is whole is copied as it is.
    if bag.recovered:
        metadata["recovered"] = bag.recovered
    total = sum(info.n_messages for info in bag.topics.values())
    with _whole_bag(out, metadata, bag.counts) as new:
        for message in progress(bag.messages(), total, "recover"):
            new.write(message)
    return new.n_messages


@contextmanager
def _whole_bag(
    out: Path, metadata: Mapping[str, str], counts: Mapping[str, Any] | None
) -> Iterator[BagWriter]:
    """Yield a bag to write into; if an exception is raised it is removed, as its source remains."""
    with removing(out, out):
        writer = BagWriter(out, metadata)
        try:
            yield writer
            writer.close(counts)
        except BaseException:
            writer.discard()
            raise
