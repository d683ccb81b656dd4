"""Recordings of this program, .mcap, as files of readings: the taxels of one patch."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.layout.arrangement import Axis
from sparseskin.nodes.sensor.layout.checks import choose
from sparseskin.nodes.sensor.layout.tally import Tally

from .recording import Block, File, Head, Recording, gathered

if TYPE_CHECKING:
    from sparseskin.messages import Taxels
    from sparseskin.nodes.recorder.bag.reader import BagReader


def is_bag(begin: bytes) -> bool:
    """True if a file begins as a recording of this program does: with its name as the library."""
    profile = int.from_bytes(begin[17:21], "little")
    header = begin[21:]
    return profile == 0 and header[4:].startswith(b"sparseskin ")


class BagRecording(Recording):
    """The taxels of a patch: that of the stated topic, or the only one. Readings that were missing
    are NaN. Raises SourceError if the recording cannot be read, holds no taxels, or forces where
    readings are expected.
    """

    def __init__(self, file: File) -> None:
        self.tally = Tally("messages")
        self._file = file

    def head(self) -> Head:
        from sparseskin.messages.state import described
        from sparseskin.nodes.recorder.bag.frames import patch_of, skin_of

        with self._opened() as bag:
            topic = self._topic(bag)
            message = next(self._taxels(bag, topic))
            n_rows, n_cols = message.forces.shape[1:]
            head = Head(
                (Axis(n_rows, "rows"), Axis(n_cols, "cols")),
                is_timed=True,
                time_unit="ns",
                n_items=bag.topics[topic].n_messages,
                notes=(bag.recovered,) if bag.recovered else (),
            )
            skin = skin_of(bag, patch_of(topic))
            if skin is not None:
                head = replace(head, **described(skin, skin.rate_hz))
            return head

    def blocks(self) -> Iterator[Block]:
        self.tally.begin()
        with self._opened() as bag:
            yield from gathered(self._frames(bag), self.tally)

    def _frames(
        self, bag: BagReader
    ) -> Iterator[tuple[np.ndarray[tuple[int, ...], np.dtype[np.float32]], int]]:
        """Frames and their stamps."""
        from sparseskin.messages.frames import known_forces

        topic = self._topic(bag)
        shape = None
        for message in self._taxels(bag, topic):
            forces = known_forces(message)
            shape = shape or forces.shape
            if forces.shape != shape:
                fault = f"{topic}: the shape of its frames changes"
                raise SourceError(f"{self._file.name}: {fault}")
            yield forces, message.stamp_ns

    @contextmanager
    def _opened(self) -> Iterator[BagReader]:
        from sparseskin.nodes.recorder.bag.format import BagError
        from sparseskin.nodes.recorder.bag.patches import split_bag
        from sparseskin.nodes.recorder.bag.reader import BagReader

        try:
            with BagReader(self._file.name) as whole:
                yield split_bag(whole)
        except BagError as error:
            raise SourceError(str(error)) from error

    def _topic(self, bag: BagReader) -> str:
        """The topic of the taxels."""
        from sparseskin.messages import Calibration, Taxels
        from sparseskin.messages.topics import topic_of
        from sparseskin.nodes.recorder.bag.frames import patch_of

        name = self._file.name
        counts = {
            topic: info.n_messages
            for topic, info in bag.topics.items()
            if info.schema == Taxels.schema and info.n_messages
        }

        about = {topic: f"{n} frames" for topic, n in counts.items()}
        topic = choose(about, self._file.layout.topic, name, "topics of taxels")
        if (
            self._file.raw
            and topic_of(patch_of(topic), Calibration.schema) in bag.topics
        ):
            fault = "its taxels are forces, of a calibrated skin; expected raw readings"
            raise SourceError(f"{name}: {fault}")
        return topic

    def _taxels(self, bag: BagReader, topic: str) -> Iterator[Taxels]:
        """The messages of the topic."""
        from sparseskin.messages import Taxels
        from sparseskin.nodes.recorder.bag.frames import decoded

        for recorded in bag.messages([topic]):
            message = decoded(bag, recorded)
            if isinstance(message, Taxels):
                yield message
            else:
                self.tally.drop("messages of another type")
