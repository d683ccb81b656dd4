"""Recordings of this program, .mcap, as files of readings: the taxels of one patch."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.errors import SourceError

from .recording import File, Parsed, Recording, choose, rising


def is_bag(begin: bytes) -> bool:
    """True if a file begins as a recording of this program does: with its name as the library."""
    profile, rest = int.from_bytes(begin[17:21], "little"), begin[21:]
    return profile == 0 and rest[4:].startswith(b"sparseskin ")


class BagRecording(Recording):
    """The taxels of a patch: that of the stated topic, or the only one. Raises SourceError if the
    recording cannot be read, holds no taxels, or forces where readings are expected.
    """

    def __init__(self, file: File) -> None:
        self._file = file

    def read(self) -> Parsed:
        from sparseskin.messages import Calibration, Taxels
        from sparseskin.messages.frames import known_forces
        from sparseskin.messages.topics import topic_of
        from sparseskin.nodes.recorder.bag.format import BagError
        from sparseskin.nodes.recorder.bag.frames import decoded, described, patch_of, skin_of
        from sparseskin.nodes.recorder.bag.patches import split_bag
        from sparseskin.nodes.recorder.bag.reader import BagReader

        name, wants_raw = self._file.name, self._file.policy.raw
        try:
            with BagReader(name) as whole:
                bag = split_bag(whole)
                held = {t: i for t, i in bag.topics.items() if i.schema == Taxels.schema}
                topics = {t: f"{i.n_messages} frames" for t, i in held.items() if i.n_messages}
                topic = choose(topics, self._file.topic, name, "topics of taxels")
                patch = patch_of(topic)
                if wants_raw and topic_of(patch, Calibration.schema) in bag.topics:
                    what = "its taxels are forces, of a calibrated skin; expected raw readings"
                    raise SourceError(f"{name}: {what}")
                messages = (decoded(bag, each) for each in bag.messages([topic]))
                found = [one for one in messages if isinstance(one, Taxels)]
                skin = skin_of(bag, patch)
        except BagError as error:
            raise SourceError(str(error)) from error
        if len({one.forces.shape for one in found}) != 1:
            raise SourceError(f"{name}: {topic}: the shape of its frames changes")
        stated = {} if skin is None else described(skin, skin.rate_hz)
        return Parsed(
            np.stack([known_forces(one) for one in found]),
            stamp_ns=rising([one.stamp_ns for one in found], name),
            notes=(bag.recovered,) if bag.recovered else (),
            **stated,
        )
