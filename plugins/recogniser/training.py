"""Training of a recogniser's model: frames of recordings, labels of a table."""

import csv
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sparseskin.messages import Measurements, Reconstruction
from sparseskin.messages.labels import MAX_LABEL
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.recordings import read_recording
from sparseskin.studies.evaluate import LOADED
from sparseskin.studies.tasks.classifier import Classifier

COLUMNS = ("recording", "label")
SPAN = ("begin_s", "end_s")
MOST_FRAMES = 4000
"""Frames that are trained, evenly chosen from more. Chosen: the training then takes some seconds;
its time grows with the third power of their number."""
MOST_ROWS = 100_000
PARTS = 4
"""Parts in time of the frames of a label, of which the last one is held out where a label has one
recording."""


class Span(NamedTuple):
    """A row of the table: name of a recording, its label, begin and end in seconds from its first
    frame on.
    """

    recording: str
    label: str
    begin_s: float
    end_s: float


class Examples(NamedTuple):
    """Inputs, float32 (n, d); n labels; n numbers of the rows of the table they are of."""

    inputs: Floats
    labels: np.ndarray[Any, Any]
    spans: np.ndarray[Any, Any]


class TrainedModel(Classifier):
    """A classifier that states what it reads; see `models.Model`."""

    def __init__(self, reads: str, phi: str = "") -> None:
        super().__init__()
        self.reads = reads
        self.phi = phi


def read_labels(path: Path) -> list[Span]:
    """Read a table of labels, CSV with columns recording, label and, if it likes, begin_s, end_s.

    Raises SparseskinError, with the line, if it is not as described.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or "no CSV in UTF-8"
        raise SparseskinError(f"{path}: {reason}") from error
    if not rows or any(name not in rows[0] for name in COLUMNS):
        raise SparseskinError(
            f"{path}: expected columns {', '.join(COLUMNS)}[, begin_s, end_s]"
        )
    if len(rows) > MOST_ROWS:
        raise SparseskinError(f"{path}: more than {MOST_ROWS} rows")
    return [_span(f"{path}:{k}", row) for k, row in enumerate(rows, start=2)]


def _span(place: str, row: dict[str, Any]) -> Span:
    label = str(row["label"] or "").strip()
    if not label or not label.isprintable() or len(label) > MAX_LABEL:
        raise SparseskinError(
            f"{place}: label {label!r}; allowed: 1..{MAX_LABEL} characters"
        )
    times = []
    defaults = (0.0, np.inf)
    for name, default in zip(SPAN, defaults, strict=True):
        text = row.get(name) or ""
        try:
            times.append(float(text) if text.strip() else default)
        except ValueError as error:
            raise SparseskinError(f"{place}: {name} {text!r} is no number") from error
    if not 0 <= times[0] < times[1]:
        raise SparseskinError(
            f"{place}: begin_s {times[0]:g} is not in 0 .. end_s {times[1]:g}"
        )
    return Span(str(row["recording"] or "").strip(), label, *times)


def examples(paths: Sequence[str], spans: Sequence[Span], reads: str) -> Examples:
    """Frames of recordings in the spans of their labels.

    Frames whose norm is below a tenth of the 95th percentile of their recording are left out: in
    them nothing presses. Of a recording without reconstructions, `reads` "reconstruction" takes the
    readings. Raises SparseskinError if a recording cannot be read, has no rows in the table, or
    another number of values than the others.
    """
    inputs: list[Floats] = []
    labels: list[str] = []
    numbers: list[int] = []
    stated_names: set[str] = set()
    for path in paths:
        frames, seconds = _frames(path, reads)
        # The table may name a recording by its path, its file or its name.
        names = {path, os.path.basename(path), Path(path).stem}
        stated_names |= names
        rows = [k for k, span in enumerate(spans) if span.recording in names]
        if not rows:
            raise SparseskinError(f"{path}: no row of the table of labels names it")

        # Nothing presses in frames of a small norm.
        norms = np.linalg.norm(frames, axis=1)
        is_loaded = norms > LOADED * np.percentile(norms, 95)
        for k in rows:
            span = spans[k]
            is_in_span = is_loaded & (seconds >= span.begin_s) & (seconds < span.end_s)
            n_frames = int(is_in_span.sum())
            inputs.append(frames[is_in_span])
            labels += [span.label] * n_frames
            numbers += [k] * n_frames
        # Of another skin, or of another number of measurements.
        if inputs[0].shape[1] != frames.shape[1]:
            raise SparseskinError(
                f"{path}: {frames.shape[1]} numbers a frame, but {inputs[0].shape[1]} "
                f"in {paths[0]}"
            )

    # A name that was typed wrong would be trained without its frames.
    unused = sorted({span.recording for span in spans} - stated_names)
    if unused:
        raise SparseskinError(f"labels of {unused[0]!r}: no such recording is stated")
    all_inputs = np.concatenate(inputs)
    return _evenly(Examples(all_inputs, np.array(labels), np.array(numbers)))


def _frames(path: str, reads: str) -> tuple[Floats, np.ndarray[Any, Any]]:
    """Frames of a recording, float32 (n, d), and their times from the first one on, seconds."""
    recording = read_recording(path)
    name = reads
    stamps = f"{reads}_stamp_ns"
    if reads == Reconstruction.schema and reads not in recording:
        # A recording of another program: its readings stand for forces.
        name = "forces"
        stamps = "stamp_ns"
    if name not in recording:
        raise SparseskinError(f"{path}: holds no {reads}")
    frames = np.asarray(recording[name], dtype=np.float32)
    frames = np.nan_to_num(frames.reshape(len(frames), -1))
    stamp_ns = np.asarray(recording[stamps])
    return frames, (stamp_ns - stamp_ns[0]) / 1e9


def _evenly(given_examples: Examples) -> Examples:
    """At most `MOST_FRAMES` examples, evenly chosen."""
    n = len(given_examples.inputs)
    if n <= MOST_FRAMES:
        return given_examples
    evenly_spaced = np.arange(MOST_FRAMES) * n // MOST_FRAMES
    return Examples(*(part[evenly_spaced] for part in given_examples))


def held_out(given_examples: Examples) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Marks of the examples of the test: of a label the last of its rows of the table, or, where it
    has one row, the last quarter of its frames.
    """
    marks = np.zeros(len(given_examples.labels), dtype=np.bool_)
    for label in np.unique(given_examples.labels):
        of_label = np.flatnonzero(given_examples.labels == label)
        spans = given_examples.spans[of_label]
        if np.unique(spans).size > 1:
            marks[of_label[spans == spans.max()]] = True
        else:
            marks[of_label[len(of_label) - len(of_label) // PARTS :]] = True
    return marks


def train(
    given_examples: Examples, reads: str, phi: str = ""
) -> tuple[TrainedModel, float]:
    """Train a model on all examples; and the share of those that are right of a test, of a model
    that was trained without them. Raises SparseskinError if there are too few.
    """
    is_test = held_out(given_examples)
    inputs, labels, _ = given_examples
    # One model for the test alone, and one of all examples for the node.
    trial = TrainedModel(reads).fit(inputs[~is_test], labels[~is_test])
    shares = trial.predict_proba(inputs[is_test])
    is_right = trial.classes_[shares.argmax(axis=1)] == labels[is_test]

    model = TrainedModel(reads, phi)
    model.fit(inputs, labels)
    share = float("nan")
    if is_right.size:
        share = float(is_right.mean())
    return model, share


def phi_of(paths: Sequence[str], reads: str) -> str:
    """Fingerprint of the Phi of measurements in recordings; "" of reconstructions. Raises
    SparseskinError if they are of several, as rotating rows are.
    """
    if reads != Measurements.schema:
        return ""
    from sparseskin.nodes.recorder.bag.frames import streams
    from sparseskin.nodes.recorder.bag.reader import BagReader

    ending = f"/{Measurements.schema}"
    fingerprints: set[str] = set()
    for path in paths:
        with BagReader(path) as bag:
            topics = [topic for topic in bag.topics if topic.endswith(ending)]
            for message, _ in streams(bag, topics, "phi"):
                assert isinstance(message, Measurements)
                fingerprints.add(message.phi)
    if len(fingerprints) != 1:
        raise SparseskinError(
            f"measurements of {len(fingerprints)} matrices, whose numbers differ in meaning; "
            'record with compressor.rows = "fixed", or --reads reconstruction'
        )
    return fingerprints.pop()
