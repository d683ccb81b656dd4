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
from sparseskin.nodes.process.control import Document
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

    def summary(self) -> Document:
        return {
            "all": self.every.summary(),
            "contact": self.contact.summary(),
        }


def _trust_summary(trusted: Extent) -> Document | None:
    """Number of frames, of those not to be trusted, and the share of the others; None of none."""
    if not trusted.count:
        return None
    untrusted = int(trusted.count - trusted.total)
    share = trusted.total / trusted.count
    return {"frames": trusted.count, "untrusted": untrusted, "trusted_share": share}


@dataclass
class QuietCount:
    """Number of frames that compressors did not send as nothing had changed, over all their runs.
    `late` as of `TopicCount`.
    """

    late: bool = False
    total: int = 0
    _n_of_run: int | None = None

    def add(self, n_of_run: int) -> int:
        """Count those of the present run; return how many are new."""
        n_counted = self._n_of_run
        if n_counted is None and self.late:
            n_counted = n_of_run
        # Another run begins with 0.
        if n_counted is None or n_of_run < n_counted:
            n_counted = 0
        self._n_of_run = n_of_run
        self.total += n_of_run - n_counted
        return n_of_run - n_counted


@dataclass
class FrameMetrics:
    """Messages of one frame, and its figures once it is complete; unknown ones are nan.

    `lost_so_far`: number of all frames up to this one that were sensed and neither reconstructed
    nor skipped on purpose; `n_sensed`, `n_answered`: those of the patch up to this frame, too.
    """

    taxels: Taxels | None = None
    truth: Truth | None = None
    reconstruction: Reconstruction | None = None
    psnr_noisy_db: float = math.nan
    psnr_db: float = math.nan
    latency_ms: float = math.nan
    solve_ms: float = math.nan
    lost_so_far: int = 0
    n_sensed: int = 0
    n_answered: int = 0


class PatchMetrics:
    """Pairs a patch's messages by stamp and accumulates the figures of its summary.

    The arrays and lists of a message have a patch axis, on which `[0]` is the patch.

    `since_ns` is the time at which the monitor joined a graph that already ran, None from its begin
    on; `clock_of` as of `Context`. `latency_ns` of the last reconstruction is by the clock of the
    monitor's host, None where a clock is unknown, or where no time passes, as in a recording that
    was computed offline; `latency_uncertainty_ns` is the largest so far, 0 on one host. `load` is
    the total force of the newest frame, 0 where it is not in contact, None before the first one;
    `doubts` the number of frames not to be trusted by the reason. While `idle`, the newest frame
    was published as unchanged; `unchanged` counts such frames. `lost_so_far` counts losses up to
    the newest complete frame, `lost` those of the summary.
    """

    def __init__(
        self, since_ns: int | None = None, clock_of: ClockOf = lambda topic: SAME_CLOCK
    ) -> None:
        self.since_ns = since_ns
        late = since_ns is not None
        self._late = late
        # How messages are paired.
        self._clock_of = clock_of
        # Its publisher states the time of acquisition.
        self._sensed_schema = Taxels.schema
        self._sensed = TopicCount(late)
        self._reconstructed = TopicCount(late)
        self._quiet = QuietCount(late)
        self._previous: Reconstruction | None = None
        # Of a late subscriber: sensed frames less those answered, at its first complete frame. They
        # count neither as sensed nor as lost.
        self._n_before = 0
        self._pending: OrderedDict[int, FrameMetrics] = OrderedDict()
        self._noise = MeasuredNoise()

        # What was measured, in the order of the summary.
        self.latency_ns: int | None = None
        self.latency_uncertainty_ns = 0
        self.skin: SkinState | None = None
        self.phi: PhiState | None = None
        self.solver: SolverState | None = None
        self.changes: list[Document] = []

        self.noisy = Quality()  # PSNR of the taxels, dB
        self.reconstruction = Quality()  # PSNR of the reconstruction, dB
        self.trust = Quality()  # 1 for a frame that is trusted, 0 for one that is not
        self.relative_error = Extent()  # ratio of norms, of contact frames
        self.latency = Quantiles()  # added in ns
        self.solve = Quantiles()  # added in ns

        self.bytes_in = 0
        self.bytes_out = 0
        self.bits: int | None = None
        self.lost_so_far = 0
        self.skipped = 0
        self.unchanged = 0
        self.unpaired = 0
        self.compared = 0
        self.doubts: Counter[str] = Counter()
        self.idle = False
        self.contacts: Contacts | None = None
        self.load: float | None = None

    @property
    def sensed(self) -> int:
        """Number of sensed frames."""
        return self._sensed.total - self._n_before

    @property
    def quiet(self) -> int:
        """Number of frames that were not sent to be reconstructed, as nothing had changed."""
        return self._quiet.total

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
        return max(0, self.sensed - self._answered)

    @property
    def _answered(self) -> int:
        """Number of sensed frames that were reconstructed, or not on purpose."""
        answered = self.reconstructed + self.skipped
        # Where frames are measured outside the graph, a quiet one is none of its.
        if self._sensed_schema == Taxels.schema:
            answered += self.quiet
        return answered

    def add(self, message: Message) -> FrameMetrics | None:
        """Add one message of the patch alone; return the frame that it completes, if any."""
        stamp_ns = message.stamp_ns
        # The newest count of sensed frames goes with the frame.
        if message.schema == self._sensed_schema:
            self._sensed.admit(message)
            self._pair(stamp_ns).n_sensed = self._sensed.total
        match message:
            case SkinState():
                self._note_changes(self.skin, message, "sigma_mid")
                self.skin = message
                self._sensed_schema = Measurements.schema
                if message.has_taxels:
                    self._sensed_schema = Taxels.schema
            case PhiState():
                self._note_changes(self.phi, message, "kind", "m", "rows")
                self.phi = message
            case SolverState():
                self._add_solver(message)
            case Measurements():
                self._add_measurements(message)
            case Taxels():
                self._add_taxels(message)
            case Truth():
                self._pair(stamp_ns).truth = message
            case Contacts():
                self.contacts = message
            case Reconstruction():
                self._add_reconstruction(message)
        return self._evaluate(stamp_ns)

    def _add_solver(self, message: SolverState) -> None:
        fields: tuple[str, ...] = _OF_SOLVER
        if self.solver is not None and self.solver.preset and message.preset:
            # The preset states the others.
            fields = ("preset",)
        self._note_changes(self.solver, message, *fields)
        self.solver = message

    def _add_measurements(self, message: Measurements) -> None:
        self.bytes_out += size_bytes(message)
        y = message.y
        bits = 8 * y.itemsize
        if isinstance(y, Quantised):
            # Its numbers are packed: they share bytes.
            bits = y.bits
        self._note_change("bits", self.bits, bits)
        self.bits = bits

    def _add_taxels(self, message: Taxels) -> None:
        self.bytes_in += size_bytes(message)
        if self.skin is not None and self.skin.mask is not None:
            # A real skin has no wires in masked cells.
            n_absent = message.forces.size - self.skin.skin.n_taxels
            self.bytes_in -= n_absent * message.forces.itemsize
        self._pair(message.stamp_ns).taxels = message

    def _add_reconstruction(self, message: Reconstruction) -> None:
        self.latency_ns = self._latency_ns(message)
        self.idle = message.unchanged[0]
        self.unchanged += self.idle
        # Skips before the first reconstruction that a late monitor read are not its own.
        if self.reconstructed or not self._late:
            self.skipped += message.skipped

        self._add_quiet(message)
        self._drop_passed(message.stamp_ns)
        frame = self._pair(message.stamp_ns)
        frame.reconstruction = message
        solve_ns = message.solve_ns[0]
        self.solve.add(solve_ns)
        frame.solve_ms = solve_ns / 1e6
        if self.latency_ns is not None:
            self.latency.add(self.latency_ns)
            frame.latency_ms = self.latency_ns / 1e6

        self._reconstructed.admit(message)
        frame.n_answered = self._answered

    def _add_quiet(self, message: Reconstruction) -> None:
        """Compare the frames before this one that were not sent with the forces that they kept."""
        n_quiet = self._quiet.add(message.quiet)
        previous = self._previous
        self._previous = message

        if not n_quiet or previous is None or self.skin is None:
            return
        begin_ns = previous.stamp_ns
        end_ns = message.stamp_ns
        between = [ns for ns in self._pending if begin_ns < ns < end_ns]

        # `_pair` dropped the first ones of a long silence, and counted them as unpaired. They were
        # not sent on purpose: that count is taken back.
        n_dropped = max(0, n_quiet - len(between))
        self.unpaired -= min(self.unpaired, n_dropped)
        # Some were lost, and nobody knows which.
        if len(between) > n_quiet:
            return
        for stamp_ns in between:
            frame = self._pending.pop(stamp_ns)
            self._compare(frame, previous, self.skin)

    def _drop_passed(self, stamp_ns: int) -> None:
        """Drop frames before one that was reconstructed: they were skipped, or lost."""
        # Frames are reconstructed in order. Those that only lack another message wait for it.
        passed = [
            pending_ns
            for pending_ns, frame in self._pending.items()
            if pending_ns < stamp_ns and frame.reconstruction is None
        ]
        for pending_ns in passed:
            del self._pending[pending_ns]
        # Of the frames before its first one, a late monitor has read a part.
        if self.compared or not self._late:
            self.unpaired += len(passed)

    def _latency_ns(self, message: Reconstruction) -> int | None:
        """Time from acquisition to reconstruction; None where it is unknown."""
        sensed_topic = topic_of(message.patch, self._sensed_schema)
        answered_topic = topic_of(message.patch, message.schema)
        acquired = self._clock_of(sensed_topic)
        reconstructed = self._clock_of(answered_topic)
        if acquired is None or reconstructed is None:
            return None
        if message.done_ns == message.stamp_ns:
            # No time passes where a recording is computed offline.
            return None

        if acquired is not reconstructed:
            uncertainty_ns = acquired.uncertainty_ns + reconstructed.uncertainty_ns
            self.latency_uncertainty_ns = max(
                self.latency_uncertainty_ns, uncertainty_ns
            )
        # The stamps are by two clocks, where the nodes are on two hosts.
        ahead_ns = reconstructed.offset_ns - acquired.offset_ns
        apparent_ns = message.done_ns - message.stamp_ns
        return apparent_ns - ahead_ns

    def _note_changes(
        self, before: Message | None, after: Message, *names: str
    ) -> None:
        for name in names:
            old = getattr(before, name, None)
            new = getattr(after, name)
            self._note_change(name, old, new)

    def _note_change(self, name: str, old: Any, new: Any) -> None:
        """Note a setting that changes after the first frame, but none that is or becomes empty."""
        if not self.reconstructed or len(self.changes) >= MAX_CHANGES:
            return
        if old != new and old not in (None, "") and new != "":
            change = {
                "frame": self.reconstructed,
                "setting": name,
                "from": old,
                "to": new,
            }
            self.changes.append(change)

    def end(self, schema: str, n_messages: int) -> None:
        """End a topic after n_messages: the publisher's own count is the right one."""
        if schema == self._sensed_schema:
            self._sensed.end(self._sensed.run_id, n_messages)
        elif schema == Reconstruction.schema:
            self._reconstructed.end(self._reconstructed.run_id, n_messages)

    def _pair(self, stamp_ns: int) -> FrameMetrics:
        # Messages of one frame share its stamp.
        if stamp_ns not in self._pending:
            self._pending[stamp_ns] = FrameMetrics()
            if len(self._pending) > MAX_PENDING:
                self._pending.popitem(last=False)
                self.unpaired += 1
        return self._pending[stamp_ns]

    def _evaluate(self, stamp_ns: int) -> FrameMetrics | None:
        """Evaluate a frame once all its messages have arrived."""
        # It may come in any order, of several nodes.
        frame = self._pending.get(stamp_ns)
        skin = self.skin
        if frame is None or skin is None or not frame.n_sensed:
            return None
        if frame.reconstruction is None:
            return None
        if skin.has_truth and frame.truth is None:
            return None

        del self._pending[stamp_ns]
        self._count(frame, stamp_ns)
        self._compare(frame, frame.reconstruction, skin)
        return frame

    def _count(self, frame: FrameMetrics, stamp_ns: int) -> None:
        """Count a complete frame, and those lost up to it."""
        if self._late and not self.compared:
            # What came of the frames before is incomplete.
            self._n_before = frame.n_sensed - frame.n_answered
            for pending_ns in list(self._pending):
                if pending_ns <= stamp_ns:
                    del self._pending[pending_ns]
        self.compared += 1

        # Sensed and answered frames are the same ones: the difference of their counts is lost.
        n_lost = frame.n_sensed - frame.n_answered - self._n_before
        self.lost_so_far = max(0, n_lost)
        frame.lost_so_far = self.lost_so_far

    def _compare(
        self, frame: FrameMetrics, reconstruction: Reconstruction, skin: SkinState
    ) -> None:
        """Add load, trust and accuracy of a complete frame, in the taxels that gave readings."""
        # A reading that was filled in is no reference.
        cells = _cells_read(skin, reconstruction)
        forces: Floats = reconstruction.forces[0][cells]
        taxels = _forces_in(cells, frame.taxels)
        truth = _forces_in(cells, frame.truth)

        if truth is not None:
            # A true force is without noise.
            is_contact = in_contact(truth, skin.f_max, 0.0)
        elif taxels is not None:
            is_contact = self._in_noisy_contact(taxels, skin)
        else:
            # Without a reference, contact is judged by the reconstruction.
            is_contact = self._in_noisy_contact(forces, skin)
        self.load = 0.0
        if is_contact:
            self.load = float(forces.sum())
        self._add_trust(reconstruction, is_contact)

        if taxels is not None and truth is not None:
            frame.psnr_noisy_db = psnr_db(taxels - truth, skin.f_max)
            self.noisy.add(frame.psnr_noisy_db, is_contact)
            self._add_accuracy(frame, forces, truth, skin.f_max, is_contact)
        elif taxels is not None:
            self._add_accuracy(frame, forces, taxels, skin.f_max, is_contact)

    def _in_noisy_contact(self, forces: Floats, skin: SkinState) -> bool:
        """True if noisy forces, (n,), are in contact. Noise that the skin does not state is that
        measured so far, with this frame.
        """
        noise = skin.sigma_end
        if not noise:
            noise = self._noise.update(forces)
        return in_contact(forces, skin.f_max, noise)

    def _add_accuracy(
        self,
        frame: FrameMetrics,
        forces: Floats,
        reference: Floats,
        f_max: float,
        is_contact: bool,
    ) -> None:
        """Compare the forces of a reconstruction, (n,), with those of the truth or the taxels."""
        error = forces - reference
        frame.psnr_db = psnr_db(error, f_max)
        self.reconstruction.add(frame.psnr_db, is_contact)
        if is_contact:
            square = _energy(error) / _energy(reference)
            self.relative_error.add(math.sqrt(square))

    def _add_trust(self, reconstruction: Reconstruction, is_contact: bool) -> None:
        estimate = reconstruction.error[0]
        is_trusted = reconstruction.trusted[0]
        if estimate is not None or not is_trusted:
            # Trusted without an estimate, it is no statement of the solver.
            self.trust.add(float(is_trusted), is_contact)
        if not is_trusted:
            reason = reconstruction.reason[0] or Reason.ERROR
            self.doubts[str(reason)] += 1

    def summary(self) -> Document:
        """The patch's part of the summary; unknown figures are None."""
        phi = self.phi
        # Frames that a late monitor read in part are not counted.
        n_unpaired = self.unpaired
        if self.compared or not self._late:
            n_unpaired += len(self._pending)
        summary = {
            "scene": getattr(self.skin, "source", None),
            "phi": getattr(phi, "kind", None),
            **_fields(self.solver, "basis", "solver", "preset"),
            **_fields(self.solver, "iterations", "max_iterations", "frame_ms"),
            **_fields(self.solver, "noise_sum"),
            **_fields(phi, "rows", "n", "m"),
            **_fields(self.skin, "f_min", "f_max", "unit"),
            "ratio": None,
            "bits": self.bits,
            "changes": [*self.changes],
            "ratio_bits": None,
            "frames": {
                "sensed": self.sensed,
                "reconstructed": self.reconstructed,
                "skipped": self.skipped,
                "quiet": self.quiet,
                "lost": self.lost,
                "unpaired": n_unpaired,
            },
            "unchanged": self.unchanged,
            "compared": self.compared,
            "since_ns": self.since_ns,
            **self._accuracy_summary(),
            "latency_ms": self.latency.summary(),
            "latency_uncertainty_ms": self.latency_uncertainty_ns / 1e6,
            "solve_ms": self.solve.summary(),
            "bytes_in": self.bytes_in,
            "bytes_out": self.bytes_out,
        }
        if phi is not None:
            summary["ratio"] = phi.n / phi.m
        if phi is not None and self.bits is not None:
            n_bits = phi.m * self.bits
            summary["ratio_bits"] = FLOAT_BITS * phi.n / n_bits
        return summary

    def _accuracy_summary(self) -> Document:
        reference = None
        if self.skin is not None and self.skin.has_truth:
            reference = "truth"
        elif self.skin is not None and self.skin.has_taxels:
            reference = "taxels"
        return {
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
        }


def _cells_read(skin: SkinState, reconstruction: Reconstruction) -> Any:
    """Index of the cells that exist and gave a reading; of all that exist where none did."""
    cells: Any = slice(None)
    if skin.mask is not None:
        cells = skin.mask
    missing = reconstruction.missing_cells((skin.n_rows, skin.n_cols))
    if missing is None or missing.all():
        return cells
    read = ~missing
    if skin.mask is not None:
        read &= skin.mask
    return read


def _forces_in(cells: Any, message: Taxels | Truth | None) -> Floats | None:
    if message is None:
        return None
    forces: Floats = message.forces[0][cells]
    return forces


def _fields(state: Message | None, *names: str) -> Document:
    """Fields of a state message; None while it has not arrived."""
    return {name: getattr(state, name, None) for name in names}
