"""Accuracy, latency and losses of one patch, frame by frame, against the truth where known."""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sparseskin.messages import (
    Measurements,
    Message,
    PhiState,
    Reconstruction,
    Resultant,
    SkinState,
    SolverState,
    Taxels,
    Truth,
    size_bytes,
    topic_of,
)
from sparseskin.messages.quantised import Quantised
from sparseskin.messages.skin import CONTACT_FRACTION
from sparseskin.nodes.clock import SAME_CLOCK, ClockEstimate
from sparseskin.nodes.numerics.arrays import Floats

from .statistics import Extent, Quantiles

PSNR_CAP_DB = 100.0
FLOAT_BITS = 32
"""Bits of a published taxel reading, float32."""
JOINING_NS = 1_000_000_000
"""A late subscriber receives one topic before another: frames missed for this long are not lost."""
MAX_PENDING = 512
"""Most frames that wait for their reconstruction; the oldest is dropped as unpaired."""
MAX_CHANGES = 100
"""Changes of settings that are kept for the summary; later ones are not."""
RECENT = 100
"""Frames of the recent mean PSNR."""

_OF_SKIN = ("sigma_mid",)
_OF_PHI = ("kind", "m", "rows")
_OF_SOLVER = ("preset", "solver", "basis", "iterations", "lambda_n")

ClockOf = Callable[[str], ClockEstimate | None]


def psnr_db(error: Floats, f_max: float) -> float:
    """Peak signal-to-noise ratio 20 log10(f_max / RMSE) in dB, capped at 100 dB.

    Parameters
    ----------
    error : ndarray of float32, any shape
        Differences from the reference, in the unit of `f_max`.
    f_max : float
        Upper end of the range.

    Source: paper, section V-C.
    """
    rmse = math.sqrt(float(np.mean(np.square(error, dtype=np.float64))))
    if rmse * 10 ** (PSNR_CAP_DB / 20) <= f_max:
        return PSNR_CAP_DB
    return 20 * math.log10(f_max / rmse)


@dataclass
class Quality:
    """A figure, as PSNR, over all frames and over contact frames alone."""

    every: Extent = field(default_factory=Extent)
    contact: Extent = field(default_factory=Extent)
    in_contact: bool = False
    """True once there was a contact frame; `recent` is then of contact frames."""
    _recent: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))

    def add(self, value: float, in_contact: bool) -> None:
        self.every.add(value)
        if in_contact:
            self.contact.add(value)
            if not self.in_contact:
                self._recent.clear()
                self.in_contact = True
        if in_contact == self.in_contact:
            self._recent.append(value)

    def recent(self) -> float | None:
        """Mean over the last 100 contact frames, before the first one of all; None of none."""
        return sum(self._recent) / len(self._recent) if self._recent else None

    def summary(self) -> dict[str, Any]:
        return {"all": self.every.summary(), "contact": self.contact.summary()}


class Trust(Quality):
    """Trust of solvers that estimate their error: 1 for a frame to be trusted, 0 for another."""

    def add_frame(self, reconstruction: Reconstruction, in_contact: bool) -> None:
        """Count a frame, unless its solver estimates nothing."""
        (error,), (trusted,) = reconstruction.error, reconstruction.trusted
        if error is not None or not trusted:
            self.add(float(trusted), in_contact)

    def summary(self) -> dict[str, Any]:
        return {"all": trust_summary(self.every), "contact": trust_summary(self.contact)}


def trust_summary(trusted: Extent) -> dict[str, Any] | None:
    """Number of frames, of those not to be trusted, and the share of the others; None of none."""
    if not trusted.count:
        return None
    untrusted, share = int(trusted.count - trusted.total), trusted.total / trusted.count
    return {"frames": trusted.count, "untrusted": untrusted, "trusted_share": share}


@dataclass
class StreamCount:
    """Number of messages of a topic, over all runs of its publisher.

    A `late` subscriber counts from the first message it receives.
    """

    late: bool = False
    run_id: str = ""
    before: int = 0
    in_run: int = 0

    def add(self, message: Message) -> int:
        """Count a message; return its number, from 1."""
        if message.run_id != self.run_id:
            self.before += self.in_run
            if self.late and not self.run_id:
                self.before = -message.seq
            self.run_id, self.in_run = message.run_id, 0
        self.in_run = max(self.in_run, message.seq + 1)
        return self.before + message.seq + 1

    def end(self, n_messages: int) -> None:
        """Set the number of messages of the current run, as its publisher counted them."""
        self.in_run = max(self.in_run, n_messages)

    @property
    def total(self) -> int:
        return self.before + self.in_run


def same_clock(topic: str) -> ClockEstimate:
    """Clock of a topic's publisher in a graph on one host."""
    return SAME_CLOCK


class Delay:
    """Latency of reconstructions on the clock of the monitor's host.

    `clock_of` takes a topic and returns the clock estimate of its publisher, None while unknown.
    `sensed` is the schema of the messages whose publisher states the time of acquisition;
    `uncertainty_ns` is the largest uncertainty of a latency so far; 0 on one host.
    """

    def __init__(self, clock_of: ClockOf) -> None:
        self._clock_of = clock_of
        self.sensed = Taxels.schema
        self.uncertainty_ns = 0

    def of(self, message: Reconstruction) -> int | None:
        """Time from acquisition to reconstruction in ns; None while a clock is unknown."""
        acquired = self._clock_of(topic_of(message.patch, self.sensed))
        reconstructed = self._clock_of(topic_of(message.patch, Reconstruction.schema))
        if acquired is None or reconstructed is None:
            return None
        if acquired is not reconstructed:
            uncertainty_ns = acquired.uncertainty_ns + reconstructed.uncertainty_ns
            self.uncertainty_ns = max(self.uncertainty_ns, uncertainty_ns)
        ahead_ns = reconstructed.offset_ns - acquired.offset_ns
        return message.done_ns - message.stamp_ns - ahead_ns


@dataclass
class FrameMetrics:
    """Messages of one frame, and its figures once it is complete; unknown ones are nan.

    `lost` is the number of frames up to this one that were sensed and neither reconstructed nor
    skipped on purpose.
    """

    taxels: Taxels | None = None
    truth: Truth | None = None
    reconstruction: Reconstruction | None = None
    resultant: Resultant | None = None
    psnr_noisy_db: float = math.nan
    psnr_db: float = math.nan
    latency_ms: float = math.nan
    solve_ms: float = math.nan
    lost: int = 0
    n_sensed: int = 0
    n_answered: int = 0


class PatchMetrics:
    """Pairs a patch's messages by stamp and accumulates the figures of its summary.

    `late` is true if the graph already ran when the monitor joined it; `clock_of` as in `Delay`.
    `latency_ns` is the latency of the last reconstruction; None while a clock is unknown. `idle` is
    True while the newest frame was published as unchanged, `unchanged` the number of such frames.
    """

    def __init__(self, late: bool = False, clock_of: ClockOf = same_clock) -> None:
        self._delay = Delay(clock_of)
        self.latency_ns: int | None = None
        self.skin: SkinState | None = None
        self.phi: PhiState | None = None
        self.solver: SolverState | None = None
        self.changes: list[dict[str, Any]] = []
        self.noisy = Quality()
        self.reconstruction = Quality()
        self.relative_error = Extent()
        self.trust = Trust()
        self.latency = Quantiles()
        self.solve = Quantiles()
        self._sensed, self._reconstructed = StreamCount(late), StreamCount(late)
        self._first_ns: int | None = None if late else 0
        self._joining = late
        self._answered_ns = 0
        self._ended = False
        self.bytes_in = self.bytes_out = 0
        self.bits: int | None = None
        self.lost_so_far = self.skipped = self.unchanged = 0
        self.idle = False
        self.unpaired = self.compared = 0
        self._pending: OrderedDict[int, FrameMetrics] = OrderedDict()

    @property
    def latency_uncertainty_ms(self) -> float:
        """Uncertainty of a latency across the clocks of two hosts; 0 on one."""
        return self._delay.uncertainty_ns / 1e6

    @property
    def sensed(self) -> int:
        """Number of sensed frames."""
        return self._sensed.total

    @property
    def reconstructed(self) -> int:
        """Number of reconstructed frames."""
        return self._reconstructed.total

    @property
    def lost(self) -> int:
        """Number of frames that were sensed, and neither reconstructed nor skipped on purpose."""
        return max(0, self.sensed - self.reconstructed - self.skipped - self._under_way)

    @property
    def _under_way(self) -> int:
        """Number of frames of the last second that wait for their reconstruction, where a late
        subscriber stops before the stream ends.
        """
        if self._ended or not self._sensed.late:
            return 0
        after_ns = max(self._answered_ns, next(reversed(self._pending), 0) - JOINING_NS)
        return sum(ns > after_ns and frame.n_sensed > 0 for ns, frame in self._pending.items())

    def add(self, message: Message) -> FrameMetrics | None:
        """Add one message of the patch alone; return the frame that it completes, if any."""
        match message:
            case SkinState():
                self._note_changes(_fields(self.skin, *_OF_SKIN), _fields(message, *_OF_SKIN))
                self.skin = message
                self._delay.sensed = (Taxels if message.has_taxels else Measurements).schema
            case PhiState():
                self._note_changes(_fields(self.phi, *_OF_PHI), _fields(message, *_OF_PHI))
                self.phi = message
            case SolverState():
                before, after = _fields(self.solver, *_OF_SOLVER), _fields(message, *_OF_SOLVER)
                if before["preset"] and after["preset"]:  # it states the others
                    before, after = {"preset": before["preset"]}, {"preset": after["preset"]}
                self._note_changes(before, after)
                self.solver = message
            case Measurements():
                self.bytes_out += size_bytes(message)
                y = message.y
                bits = y.bits if isinstance(y, Quantised) else 8 * y.itemsize
                self._note_changes({"bits": self.bits}, {"bits": bits})
                self.bits = bits
                if self._delay.sensed == message.schema:
                    self._pair(message.stamp_ns).n_sensed = self._sensed.add(message)
                    if self._first_ns is None:
                        self._first_ns = message.stamp_ns
                    return self._evaluate(message.stamp_ns)
            case Taxels():
                self.bytes_in += size_bytes(message) - self._absent_bytes(message)
                if self._first_ns is None:
                    self._first_ns = message.stamp_ns
                frame = self._pair(message.stamp_ns)
                frame.taxels, frame.n_sensed = message, self._sensed.add(message)
                return self._evaluate(message.stamp_ns)
            case Truth():
                self._pair(message.stamp_ns).truth = message
                return self._evaluate(message.stamp_ns)
            # A late subscriber ignores frames whose taxels it has not received.
            case Resultant() | Reconstruction() if (
                self._first_ns is None or message.stamp_ns < self._first_ns
            ):
                return None
            case Resultant():
                self._pair(message.stamp_ns).resultant = message
            case Reconstruction():
                self._answered_ns = message.stamp_ns
                self.latency_ns = self._delay.of(message)
                if self.latency_ns is not None:
                    self.latency.add(self.latency_ns)
                (self.idle,), (solve_ns,) = message.unchanged, message.solve_ns
                self.unchanged += self.idle
                self.solve.add(solve_ns)
                if self._joining:
                    self._join(message.stamp_ns)
                else:
                    self.skipped += message.skipped
                frame = self._pair(message.stamp_ns)
                frame.reconstruction = message
                frame.solve_ms = solve_ns / 1e6
                if self.latency_ns is not None:
                    frame.latency_ms = self.latency_ns / 1e6
                frame.n_answered = self._reconstructed.add(message) + self.skipped
                return self._evaluate(message.stamp_ns)
        return None

    def _note_changes(self, before: Mapping[str, Any], after: Mapping[str, Any]) -> None:
        """Note settings that change after the first frame, but none that are or become empty."""
        for name, value in after.items():
            old = before[name]
            room = self.reconstructed > 0 and len(self.changes) < MAX_CHANGES
            if room and old != value and old not in (None, "") and value != "":
                self.changes.append(
                    {"frame": self.reconstructed, "setting": name, "from": old, "to": value}
                )

    def end(self, schema: str, n_messages: int) -> None:
        """End a topic after n_messages: the publisher's own count is the right one."""
        if schema == self._delay.sensed:
            self._sensed.end(n_messages)
        elif schema == Reconstruction.schema:
            self._reconstructed.end(n_messages)
            self._ended = True

    def _join(self, stamp_ns: int) -> None:
        """Ignore frames whose taxels came before reconstructions were received."""
        self._joining = False
        first = self._pending.get(stamp_ns)
        assert self._first_ns is not None
        if first is None or not first.n_sensed or stamp_ns - self._first_ns > JOINING_NS:
            return
        n_before = first.n_sensed - 1
        self._sensed.before -= n_before
        for before_ns in [ns for ns in self._pending if ns < stamp_ns]:
            del self._pending[before_ns]
        for frame in self._pending.values():
            frame.n_sensed = max(0, frame.n_sensed - n_before)
        self._first_ns = stamp_ns

    def _absent_bytes(self, taxels: Taxels) -> int:
        """Bytes of masked cells: a real skin has no wires there."""
        if self.skin is None or self.skin.mask is None:
            return 0
        return (taxels.forces.size - self.skin.skin.n_taxels) * taxels.forces.itemsize

    def _pair(self, stamp_ns: int) -> FrameMetrics:
        if stamp_ns not in self._pending:
            self._pending[stamp_ns] = FrameMetrics()
            if len(self._pending) > MAX_PENDING:
                self._pending.popitem(last=False)
                self.unpaired += 1
        return self._pending[stamp_ns]

    def _evaluate(self, stamp_ns: int) -> FrameMetrics | None:
        """Evaluate a frame once all its messages have arrived."""
        frame = self._pending[stamp_ns]
        if self.skin is None or not frame.n_sensed or frame.reconstruction is None:
            return None
        if self.skin.has_truth and frame.truth is None:
            return None
        del self._pending[stamp_ns]
        self.compared += 1
        # Both streams count the same frames: the difference of their counts is lost.
        frame.lost = self.lost_so_far = max(0, frame.n_sensed - frame.n_answered)
        cells = self.skin.mask if self.skin.mask is not None else slice(None)
        forces = frame.reconstruction.forces[0][cells]
        f_max = self.skin.f_max
        if frame.taxels is None:  # nothing to compare with
            in_contact = float(forces.max()) > CONTACT_FRACTION * f_max
            self.trust.add_frame(frame.reconstruction, in_contact)
            return frame
        taxels = frame.taxels.forces[0][cells]
        reference = taxels if frame.truth is None else frame.truth.forces[0][cells]
        in_contact = float(reference.max()) > CONTACT_FRACTION * f_max
        if frame.truth is not None:
            frame.psnr_noisy_db = psnr_db(taxels - reference, f_max)
            self.noisy.add(frame.psnr_noisy_db, in_contact)
        error = forces - reference
        frame.psnr_db = psnr_db(error, f_max)
        self.reconstruction.add(frame.psnr_db, in_contact)
        self.trust.add_frame(frame.reconstruction, in_contact)
        if in_contact:
            norm = float(np.linalg.norm(reference))
            self.relative_error.add(float(np.linalg.norm(error)) / norm)
        return frame

    def summary(self) -> dict[str, Any]:
        """The patch's part of the summary; unknown figures are None."""
        skin, phi = self.skin, self.phi
        n, m = (phi.n, phi.m) if phi else (0, 0)
        return {
            "scene": skin.source if skin else None,
            "phi": phi.kind if phi else None,
            **_fields(self.solver, "basis", "solver", "preset", "iterations", "frame_ms"),
            **_fields(phi, "rows", "n", "m"),
            **_fields(skin, "f_max", "unit"),
            "ratio": n / m if m else None,
            "bits": self.bits,
            "changes": [*self.changes],
            "ratio_bits": FLOAT_BITS * n / (m * self.bits) if m and self.bits else None,
            "frames": {
                "sensed": self.sensed,
                "reconstructed": self.reconstructed,
                "skipped": self.skipped,
                "lost": self.lost,
                "unpaired": self.unpaired + len(self._pending),
            },
            "unchanged": self.unchanged,
            "compared": self.compared,
            "reference": _reference(skin),
            "psnr_db": {
                "noisy": self.noisy.summary(),
                "reconstruction": self.reconstruction.summary(),
            },
            "relative_error": self.relative_error.summary(),
            "trust": self.trust.summary(),
            "latency_ms": self.latency.summary(),
            "latency_uncertainty_ms": self.latency_uncertainty_ms,
            "solve_ms": self.solve.summary(),
            "bytes_in": self.bytes_in,
            "bytes_out": self.bytes_out,
        }


def _reference(skin: SkinState | None) -> str | None:
    """What reconstructions are compared with; None where nothing is known."""
    if skin is None or not (skin.has_truth or skin.has_taxels):
        return None
    return "truth" if skin.has_truth else "taxels"


def _fields(state: Message | None, *names: str) -> dict[str, Any]:
    """Fields of a state message; None while it has not arrived."""
    return {name: getattr(state, name, None) for name in names}
