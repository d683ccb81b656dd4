"""Accuracy, latency and losses of one patch, frame by frame, against the truth where known."""

import math
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sparseskin.messages import (
    Contacts,
    Measurements,
    Message,
    PhiState,
    Reason,
    Reconstruction,
    SkinState,
    SolverState,
    Taxels,
    Truth,
    size_bytes,
    topic_of,
)
from sparseskin.messages.quantised import Quantised
from sparseskin.nodes.clock import SAME_CLOCK, ClockEstimate
from sparseskin.nodes.node_host import TopicCount
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.touch import MeasuredNoise, in_contact

from .statistics import Extent, Quantiles

PSNR_CAP_DB = 100.0
FLOAT_BITS = 32
"""Bits of a published taxel reading, float32."""
MAX_PENDING = 512
"""Most frames that wait for their reconstruction; the oldest is dropped as unpaired."""
MAX_CHANGES = 100
"""Changes of settings that are kept for the summary; later ones are not."""

_OF_SOLVER = ("preset", "solver", "basis", "iterations", "lambda_n")

ClockOf = Callable[[str], ClockEstimate | None]


def psnr_db(error: Floats, f_max: float) -> float:
    """Peak signal-to-noise ratio 20 log10(f_max / RMSE) in dB, capped at 100 dB, of differences
    from the reference, float32 of any shape, in the unit of `f_max`, the upper end of the range.
    Source: paper, section V-C.
    """
    rmse = math.sqrt(_energy(error) / error.size)
    if rmse * 10 ** (PSNR_CAP_DB / 20) <= f_max:
        return PSNR_CAP_DB
    return 20 * math.log10(f_max / rmse)


def _energy(values: Floats) -> float:
    """Sum of squares, computed in float64, of an array of any shape."""
    wide = values.reshape(-1).astype(np.float64)
    return float(np.dot(wide, wide))


@dataclass
class Quality:
    """A figure, as PSNR, over all frames and over contact frames alone."""

    every: Extent = field(default_factory=Extent)
    contact: Extent = field(default_factory=Extent)

    def add(self, value: float, is_contact: bool) -> None:
        self.every.add(value)
        if is_contact:
            self.contact.add(value)

    def summary(self) -> dict[str, Any]:
        return {"all": self.every.summary(), "contact": self.contact.summary()}


def _trust_summary(trusted: Extent) -> dict[str, Any] | None:
    """Number of frames, of those not to be trusted, and the share of the others; None of none."""
    if not trusted.count:
        return None
    untrusted = int(trusted.count - trusted.total)
    share = trusted.total / trusted.count
    return {"frames": trusted.count, "untrusted": untrusted, "trusted_share": share}


@dataclass
class FrameMetrics:
    """Messages of one frame, and its figures once it is complete; unknown ones are nan.

    `lost` is the number of frames up to this one that were sensed and neither reconstructed nor
    skipped on purpose.
    """

    taxels: Taxels | None = None
    truth: Truth | None = None
    reconstruction: Reconstruction | None = None
    psnr_noisy_db: float = math.nan
    psnr_db: float = math.nan
    latency_ms: float = math.nan
    solve_ms: float = math.nan
    lost: int = 0
    n_sensed: int = 0
    n_answered: int = 0


class PatchMetrics:
    """Pairs a patch's messages by stamp and accumulates the figures of its summary.

    `since_ns` is the time at which the monitor joined a graph that already ran, None from its begin
    on; `clock_of` as of `Context`. `latency_ns` of the last reconstruction is by the clock of the
    monitor's host, None where a clock is unknown, or where no time passes, as in a recording that
    was computed offline; `latency_uncertainty_ns` is the largest so far, 0 on one host. `load` is
    the total force of the newest frame, 0 where it is not in contact, None before the first one;
    `doubts` the number of frames not to be trusted by the reason. While `idle`, the newest frame
    was published as unchanged; `unchanged` counts such frames.
    """

    def __init__(
        self, since_ns: int | None = None, clock_of: ClockOf = lambda topic: SAME_CLOCK
    ) -> None:
        self.since_ns = since_ns
        late = since_ns is not None
        self._clock_of = clock_of
        self._sensed_schema = Taxels.schema  # its publisher states the time of acquisition
        self.latency_ns: int | None = None
        self.latency_uncertainty_ns = 0
        self.skin: SkinState | None = None
        self.phi: PhiState | None = None
        self.solver: SolverState | None = None
        self.changes: list[dict[str, Any]] = []
        self.noisy = Quality()
        self.reconstruction = Quality()
        self.trust = Quality()
        self.relative_error = Extent()
        self.latency = Quantiles()
        self.solve = Quantiles()
        self._sensed = TopicCount(late)
        self._reconstructed = TopicCount(late)
        self._late = late
        self._n_before = 0  # frames sensed before the first that a late subscriber can compare
        self.bytes_in = self.bytes_out = 0
        self.bits: int | None = None
        self.lost_so_far = self.skipped = self.unchanged = 0
        self.idle = False
        self.contacts: Contacts | None = None
        self.load: float | None = None
        self.doubts: Counter[str] = Counter()
        self._noise = MeasuredNoise()
        self.unpaired = self.compared = 0
        self._pending: OrderedDict[int, FrameMetrics] = OrderedDict()

    @property
    def sensed(self) -> int:
        """Number of sensed frames."""
        return self._sensed.total - self._n_before

    @property
    def reconstructed(self) -> int:
        """Number of reconstructed frames."""
        return self._reconstructed.total

    @property
    def lost(self) -> int:
        """Number of frames that were sensed, and neither reconstructed nor skipped on purpose; for
        a late subscriber that stops before the stream ends, up to the newest one reconstructed.
        """
        if self._late and not self._reconstructed.ended:
            return self.lost_so_far
        return max(0, self.sensed - self.reconstructed - self.skipped)

    def add(self, message: Message) -> FrameMetrics | None:
        """Add one message of the patch alone; return the frame that it completes, if any."""
        stamp_ns = message.stamp_ns
        if message.schema == self._sensed_schema:
            self._sensed.admit(message)
            self._pair(stamp_ns).n_sensed = self._sensed.total
        match message:
            case SkinState():
                self._note_changes(self.skin, message, "sigma_mid")
                self.skin = message
                self._sensed_schema = (Taxels if message.has_taxels else Measurements).schema
            case PhiState():
                self._note_changes(self.phi, message, "kind", "m", "rows")
                self.phi = message
            case SolverState():
                stated = self.solver is not None and self.solver.preset and message.preset
                fields = ("preset",) if stated else _OF_SOLVER  # a preset states the others
                self._note_changes(self.solver, message, *fields)
                self.solver = message
            case Measurements(y=y):
                self.bytes_out += size_bytes(message)
                bits = y.bits if isinstance(y, Quantised) else 8 * y.itemsize
                self._note_change("bits", self.bits, bits)
                self.bits = bits
            case Taxels():
                self.bytes_in += size_bytes(message)
                if self.skin is not None and self.skin.mask is not None:
                    # A real skin has no wires in masked cells.
                    n_absent = message.forces.size - self.skin.skin.n_taxels
                    self.bytes_in -= n_absent * message.forces.itemsize
                self._pair(stamp_ns).taxels = message
            case Truth():
                self._pair(stamp_ns).truth = message
            case Contacts():
                self.contacts = message
            case Reconstruction():
                self._add_reconstruction(message)
        return self._evaluate(stamp_ns)

    def _add_reconstruction(self, message: Reconstruction) -> None:
        self.latency_ns = self._latency_ns(message)
        (self.idle,) = message.unchanged
        (solve_ns,) = message.solve_ns
        self.unchanged += self.idle
        self.solve.add(solve_ns)
        if self.reconstructed or not self._late:
            self.skipped += message.skipped
        frame = self._pair(message.stamp_ns)
        frame.reconstruction = message
        frame.solve_ms = solve_ns / 1e6
        if self.latency_ns is not None:
            self.latency.add(self.latency_ns)
            frame.latency_ms = self.latency_ns / 1e6
        self._reconstructed.admit(message)
        frame.n_answered = self.reconstructed + self.skipped

    def _latency_ns(self, message: Reconstruction) -> int | None:
        """Time from acquisition to reconstruction; None where it is unknown."""
        acquired, reconstructed = (
            self._clock_of(topic_of(message.patch, schema))
            for schema in (self._sensed_schema, message.schema)
        )
        if acquired is None or reconstructed is None or message.done_ns == message.stamp_ns:
            return None
        if acquired is not reconstructed:
            uncertainty_ns = acquired.uncertainty_ns + reconstructed.uncertainty_ns
            self.latency_uncertainty_ns = max(self.latency_uncertainty_ns, uncertainty_ns)
        ahead_ns = reconstructed.offset_ns - acquired.offset_ns
        return message.done_ns - message.stamp_ns - ahead_ns

    def _note_changes(self, before: Message | None, after: Message, *names: str) -> None:
        for name in names:
            self._note_change(name, getattr(before, name, None), getattr(after, name))

    def _note_change(self, name: str, old: Any, new: Any) -> None:
        """Note a setting that changes after the first frame, but none that is or becomes empty."""
        room = self.reconstructed > 0 and len(self.changes) < MAX_CHANGES
        if room and old != new and old not in (None, "") and new != "":
            self.changes.append(
                {"frame": self.reconstructed, "setting": name, "from": old, "to": new}
            )

    def end(self, schema: str, n_messages: int) -> None:
        """End a topic after n_messages: the publisher's own count is the right one."""
        if schema == self._sensed_schema:
            self._sensed.end(self._sensed.run_id, n_messages)
        elif schema == Reconstruction.schema:
            self._reconstructed.end(self._reconstructed.run_id, n_messages)

    def _pair(self, stamp_ns: int) -> FrameMetrics:
        if stamp_ns not in self._pending:
            self._pending[stamp_ns] = FrameMetrics()
            if len(self._pending) > MAX_PENDING:
                self._pending.popitem(last=False)
                self.unpaired += 1
        return self._pending[stamp_ns]

    def _evaluate(self, stamp_ns: int) -> FrameMetrics | None:
        """Evaluate a frame once all its messages have arrived."""
        frame = self._pending.get(stamp_ns)
        skin = self.skin
        if frame is None or skin is None or not frame.n_sensed or frame.reconstruction is None:
            return None
        if skin.has_truth and frame.truth is None:
            return None
        del self._pending[stamp_ns]
        if self._late and not self.compared:  # what came of the frames before is incomplete
            self._n_before = frame.n_sensed - frame.n_answered
            self._pending = OrderedDict(
                (ns, later) for ns, later in self._pending.items() if ns > stamp_ns
            )
        self.compared += 1
        # Both streams count the same frames: the difference of their counts is lost.
        frame.lost = self.lost_so_far = max(0, frame.n_sensed - frame.n_answered - self._n_before)
        cells: Any = skin.mask if skin.mask is not None else slice(None)
        missing = frame.reconstruction.missing_cells((skin.n_rows, skin.n_cols))
        if missing is not None and not missing.all():
            cells = ~missing if skin.mask is None else skin.mask & ~missing
        forces = frame.reconstruction.forces[0][cells]
        taxels = None if frame.taxels is None else frame.taxels.forces[0][cells]
        reference = taxels if frame.truth is None else frame.truth.forces[0][cells]
        judged = forces if reference is None else reference  # nothing to compare with
        noise = 0.0 if frame.truth else skin.sigma_end or self._noise.update(judged)
        is_contact = in_contact(judged, skin.f_max, noise)
        self.load = float(forces.sum()) if is_contact else 0.0
        (estimate,) = frame.reconstruction.error
        (trusted,) = frame.reconstruction.trusted
        if estimate is not None or not trusted:  # else the solver estimates no error
            self.trust.add(float(trusted), is_contact)
        if not trusted:
            (reason,) = frame.reconstruction.reason
            self.doubts[str(reason or Reason.ERROR)] += 1
        if reference is None or taxels is None:
            return frame
        if frame.truth is not None:
            frame.psnr_noisy_db = psnr_db(taxels - reference, skin.f_max)
            self.noisy.add(frame.psnr_noisy_db, is_contact)
        error = forces - reference
        frame.psnr_db = psnr_db(error, skin.f_max)
        self.reconstruction.add(frame.psnr_db, is_contact)
        if is_contact:
            self.relative_error.add(math.sqrt(_energy(error) / _energy(reference)))
        return frame

    def summary(self) -> dict[str, Any]:
        """The patch's part of the summary; unknown figures are None."""
        skin = self.skin
        phi = self.phi
        n, m = (phi.n, phi.m) if phi else (0, 0)
        begun = self.compared > 0 or not self._late
        reference = None
        if skin is not None and (skin.has_truth or skin.has_taxels):
            reference = "truth" if skin.has_truth else "taxels"
        return {
            "scene": skin.source if skin else None,
            "phi": phi.kind if phi else None,
            **_fields(self.solver, "basis", "solver", "preset", "iterations", "max_iterations"),
            **_fields(self.solver, "frame_ms"),
            **_fields(phi, "rows", "n", "m"),
            **_fields(skin, "f_min", "f_max", "unit"),
            "ratio": n / m if m else None,
            "bits": self.bits,
            "changes": [*self.changes],
            "ratio_bits": FLOAT_BITS * n / (m * self.bits) if m and self.bits else None,
            "frames": {
                "sensed": self.sensed,
                "reconstructed": self.reconstructed,
                "skipped": self.skipped,
                "lost": self.lost,
                "unpaired": self.unpaired + (begun and len(self._pending)),
            },
            "unchanged": self.unchanged,
            "compared": self.compared,
            "since_ns": self.since_ns,
            "reference": reference,
            "psnr_db": {
                "noisy": self.noisy.summary(),
                "reconstruction": self.reconstruction.summary(),
            },
            "relative_error": self.relative_error.summary(),
            "trust": {
                "all": _trust_summary(self.trust.every),
                "contact": _trust_summary(self.trust.contact),
            },
            "doubts": dict(self.doubts),
            "latency_ms": self.latency.summary(),
            "latency_uncertainty_ms": self.latency_uncertainty_ns / 1e6,
            "solve_ms": self.solve.summary(),
            "bytes_in": self.bytes_in,
            "bytes_out": self.bytes_out,
        }


def _fields(state: Message | None, *names: str) -> dict[str, Any]:
    """Fields of a state message; None while it has not arrived."""
    return {name: getattr(state, name, None) for name in names}
