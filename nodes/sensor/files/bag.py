"""Recordings of this program, .mcap, as files of readings: the taxels of one patch."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from sparseskin.messages import Calibration, Taxels
from sparseskin.messages.arrays import Floats
from sparseskin.messages.frames import known_forces
from sparseskin.messages.state import described
from sparseskin.messages.topics import topic_of
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import decoded, patch_of, skin_of
from sparseskin.nodes.recorder.bag.patches import split_bag
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.sensor.layout.arrangement import Axis
from sparseskin.nodes.sensor.layout.checks import choose
from sparseskin.nodes.sensor.layout.tally import Tally

from .recording import Block, File, Head, Recording, gathered


class BagRecording(Recording):
    """The taxels of a patch: that of the stated topic, or the only one. Readings that were missing
    are NaN. Raises SourceError if the recording cannot be read, holds no taxels, or forces where
    readings are expected.
    """

    def __init__(self, file: File) -> None:
        self.tally = Tally("messages")
        self._file = file

    def head(self) -> Head:
        with self._opened() as (bag, topic):
            n_rows, n_cols = next(self._taxels(bag, topic)).forces.shape[1:]
            # All is stated by the messages, but for what the latched state of the skin has.
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
        with self._opened() as (bag, topic):
            yield from gathered(self._frames(bag, topic), self.tally)

    def _frames(self, bag: BagReader, topic: str) -> Iterator[tuple[Floats, int]]:
        """Frames and their stamps."""
        shape = None
        for message in self._taxels(bag, topic):
            forces = known_forces(message)
            shape = shape or forces.shape
            if forces.shape != shape:
                fault = f"{topic}: the shape of its frames changes"
                raise SourceError(f"{self._file.name}: {fault}")
            yield forces, message.stamp_ns

    @contextmanager
    def _opened(self) -> Iterator[tuple[BagReader, str]]:
        """The recording, and the topic of the taxels."""
        name = self._file.name
        try:
            # A recording may be split: the files that go on with it are found by its name.
            with BagReader(name) as whole:
                bag = split_bag(whole)
                about = {}
                for topic, info in bag.topics.items():
                    if info.schema == Taxels.schema and info.n_messages:
                        about[topic] = f"{info.n_messages} frames"
                topic = choose(about, self._file.layout.topic, name, "topics of taxels")
                calibration = topic_of(patch_of(topic), Calibration.schema)
                # Calibrating newtons once more would be a wrong force without a word.
                if self._file.raw and calibration in bag.topics:
                    fault = "its taxels are forces, of a calibrated skin"
                    raise SourceError(f"{name}: {fault}; expected raw readings")
                yield bag, topic
        except BagError as error:
            raise SourceError(str(error)) from error

    def _taxels(self, bag: BagReader, topic: str) -> Iterator[Taxels]:
        """The messages of the topic."""
        for recorded in bag.messages([topic]):
            message = decoded(bag, recorded)
            if isinstance(message, Taxels):
                yield message
            else:
                self.tally.drop("messages of another type")
