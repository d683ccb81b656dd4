"""How good and how fast one patch is, frame by frame, against the best reference there is."""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

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
)
from sparseskin.messages.quantised import Quantised

from .delay import ClockOf, Delay, same_clock
from .statistics import Extent, Quantiles

PSNR_CAP_DB = 100.0
CONTACT_FRACTION = 0.004
"""A frame is in contact where some taxel bears more than this part of f_max: 0.01 N of 2.5 N."""
FLOAT_BITS = 32
"""Bits of a taxel's reading as it is published."""
JOINING_NS = 1_000_000_000
"""Who joins late hears one topic before the other: frames of so long a time are no loss then."""
MAX_PENDING = 512
"""Frames that wait for their reconstruction; older ones are given up."""
RECENT = 100

Floats = npt.NDArray[np.float32]


def psnr_db(error: Floats, f_max: float) -> float:
    """Peak signal-to-noise ratio 20 log10(f_max / RMSE) in dB, capped at 100 dB.

    Parameters
    ----------
    error : ndarray of float32, any shape
        Differences from the reference, in the unit of f_max.
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
    """PSNR over all frames and over contact frames alone."""

    every: Extent = field(default_factory=Extent)
    contact: Extent = field(default_factory=Extent)
    recent: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))

    def add(self, psnr: float, in_contact: bool) -> None:
        self.every.add(psnr)
        self.recent.append(psnr)
        if in_contact:
            self.contact.add(psnr)

    def summary(self) -> dict[str, Any]:
        return {"all": self.every.summary(), "contact": self.contact.summary()}


@dataclass
class StreamCount:
    """How many messages a topic has had, over all runs of its publisher.

    Who joins `late` counts from the first message it sees.
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
        """The publisher says how many there were in its run."""
        self.in_run = max(self.in_run, n_messages)

    @property
    def total(self) -> int:
        return self.before + self.in_run


@dataclass(frozen=True)
class Judged:
    """One frame with all that belongs to it, and its figures; unknown ones are nan.

    `lost` counts the frames up to this one that were sensed and neither reconstructed nor skipped
    on purpose.
    """

    taxels: Taxels
    truth: Truth | None
    reconstruction: Reconstruction
    resultant: Resultant | None
    psnr_noisy_db: float
    psnr_db: float
    latency_ms: float
    solve_ms: float
    lost: int


@dataclass
class _Pending:
    taxels: Taxels | None = None
    truth: Truth | None = None
    reconstruction: Reconstruction | None = None
    resultant: Resultant | None = None
    latency_ns: int | None = None
    n_sensed: int = 0
    n_answered: int = 0


class PatchMetrics:
    """Pairs a patch's messages by stamp and keeps the figures of its summary.

    Parameters
    ----------
    late : bool
        Whether the graph already ran when the first message came.
    clock_of : callable
        Tells how far the clock of a topic's writer is ahead.

    Attributes
    ----------
    latency_ns : int or None
        Of the last reconstruction; None while a clock is not known.
    """

    def __init__(self, late: bool = False, clock_of: ClockOf = same_clock) -> None:
        self._delay = Delay(clock_of)
        self.latency_ns: int | None = None
        self.skin: SkinState | None = None
        self.phi: PhiState | None = None
        self.solver: SolverState | None = None
        self.noisy = Quality()
        self.restored = Quality()
        self.relative_error = Extent()
        self.latency = Quantiles()
        self.solve = Quantiles()
        self._sensed, self._reconstructed = StreamCount(late), StreamCount(late)
        self._first_ns: int | None = None if late else 0
        self._joining = late
        self.bytes_in = self.bytes_out = 0
        self.bits: int | None = None
        self.lost_so_far = self.skipped = 0
        self.unpaired = 0
        self._pending: OrderedDict[int, _Pending] = OrderedDict()

    @property
    def latency_uncertainty_ms(self) -> float:
        """By how much a latency may be wrong, because the clocks of two hosts are; 0 on one."""
        return self._delay.uncertainty_ns / 1e6

    @property
    def sensed(self) -> int:
        """Frames that were sensed."""
        return self._sensed.total

    @property
    def reconstructed(self) -> int:
        """Frames that were reconstructed."""
        return self._reconstructed.total

    @property
    def lost(self) -> int:
        """Frames that were sensed, and neither reconstructed nor skipped on purpose."""
        return max(0, self.sensed - self.reconstructed - self.skipped)

    def add(self, message: Message) -> Judged | None:
        """Take in one message of the patch; return the frame that it completes, if any."""
        match message:
            case SkinState():
                self.skin = message
            case PhiState():
                self.phi = message
            case SolverState():
                self.solver = message
            case Measurements():
                self.bytes_out += size_bytes(message)
                y = message.y
                self.bits = y.bits if isinstance(y, Quantised) else 8 * y.itemsize
            case Taxels():
                self.bytes_in += size_bytes(message) - self._absent_bytes(message)
                if self._first_ns is None:
                    self._first_ns = message.stamp_ns
                frame = self._pair(message.stamp_ns)
                frame.taxels, frame.n_sensed = message, self._sensed.add(message)
                return self._settle(message.stamp_ns)
            case Truth():
                self._pair(message.stamp_ns).truth = message
                return self._settle(message.stamp_ns)
            # Who joins late leaves out frames of which it has not seen the taxels.
            case Resultant() | Reconstruction() if (
                self._first_ns is None or message.stamp_ns < self._first_ns
            ):
                return None
            case Resultant():
                self._pair(message.stamp_ns).resultant = message
            case Reconstruction():
                self.latency_ns = self._delay.of(message)
                if self.latency_ns is not None:
                    self.latency.add(self.latency_ns)
                self.solve.add(message.solve_ns)
                if self._joining:
                    self._join(message.stamp_ns)
                else:
                    self.skipped += message.skipped
                frame = self._pair(message.stamp_ns)
                frame.reconstruction = message
                frame.latency_ns = self.latency_ns
                frame.n_answered = self._reconstructed.add(message) + self.skipped
                return self._settle(message.stamp_ns)
        return None

    def end(self, schema: str, n_messages: int) -> None:
        """A topic has ended after n_messages: the publisher's own count is the right one."""
        if schema == Taxels.schema:
            self._sensed.end(n_messages)
        elif schema == Reconstruction.schema:
            self._reconstructed.end(n_messages)

    def _join(self, stamp_ns: int) -> None:
        """Leave out frames whose taxels came before reconstructions could be heard at all."""
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
        """Bytes of masked cells: a real skin has no wires there, so they must not count."""
        if self.skin is None or self.skin.mask is None:
            return 0
        return (taxels.forces.size - self.skin.skin.n_taxels) * taxels.forces.itemsize

    def _pair(self, stamp_ns: int) -> _Pending:
        if stamp_ns not in self._pending:
            self._pending[stamp_ns] = _Pending()
            if len(self._pending) > MAX_PENDING:
                self._pending.popitem(last=False)
                self.unpaired += 1
        return self._pending[stamp_ns]

    def _settle(self, stamp_ns: int) -> Judged | None:
        """Judge a frame once all that belongs to it has come."""
        frame = self._pending[stamp_ns]
        if self.skin is None or frame.taxels is None or frame.reconstruction is None:
            return None
        if self.skin.has_truth and frame.truth is None:
            return None
        del self._pending[stamp_ns]
        # Both streams count the same frames, so a lag of numbers is what has been lost.
        self.lost_so_far = max(0, frame.n_sensed - frame.n_answered)
        cells = self.skin.mask if self.skin.mask is not None else slice(None)
        taxels = frame.taxels.forces[cells]
        restored = frame.reconstruction.forces[cells]
        f_max = self.skin.f_max
        reference = taxels if frame.truth is None else frame.truth.forces[cells]
        in_contact = float(reference.max()) > CONTACT_FRACTION * f_max
        noisy_db = math.nan
        if frame.truth is not None:
            noisy_db = psnr_db(taxels - reference, f_max)
            self.noisy.add(noisy_db, in_contact)
        error = restored - reference
        restored_db = psnr_db(error, f_max)
        self.restored.add(restored_db, in_contact)
        if in_contact:
            norm = float(np.linalg.norm(reference))
            self.relative_error.add(float(np.linalg.norm(error)) / norm)
        reconstruction = frame.reconstruction
        return Judged(
            taxels=frame.taxels,
            truth=frame.truth,
            reconstruction=reconstruction,
            resultant=frame.resultant,
            psnr_noisy_db=noisy_db,
            psnr_db=restored_db,
            latency_ms=math.nan if frame.latency_ns is None else frame.latency_ns / 1e6,
            solve_ms=reconstruction.solve_ns / 1e6,
            lost=self.lost_so_far,
        )

    def summary(self) -> dict[str, Any]:
        """The patch's part of the summary; figures that are not known are None."""
        n = self.phi.n if self.phi else None
        m = self.phi.m if self.phi else None
        has_truth = self.skin.has_truth if self.skin else None
        return {
            "scene": self.skin.source if self.skin else None,
            "phi": self.phi.kind if self.phi else None,
            "rows": self.phi.rows if self.phi else None,
            "basis": self.solver.basis if self.solver else None,
            "solver": self.solver.solver if self.solver else None,
            "preset": self.solver.preset if self.solver else None,
            "iterations": self.solver.iterations if self.solver else None,
            "max_iterations": self.solver.max_iterations if self.solver else None,
            "n": n,
            "m": m,
            "ratio": n / m if n and m else None,
            "bits": self.bits,
            "ratio_bits": FLOAT_BITS * n / (m * self.bits) if n and m and self.bits else None,
            "f_max": self.skin.f_max if self.skin else None,
            "unit": self.skin.unit if self.skin else None,
            "frames": {
                "sensed": self.sensed,
                "reconstructed": self.reconstructed,
                "skipped": self.skipped,
                "lost": self.lost,
                "unpaired": self.unpaired + len(self._pending),
            },
            "reference": {True: "truth", False: "taxels", None: None}[has_truth],
            "psnr_db": {
                "noisy": self.noisy.summary(),
                "reconstruction": self.restored.summary(),
            },
            "relative_error": self.relative_error.summary(),
            "latency_ms": self.latency.summary(),
            "latency_uncertainty_ms": self.latency_uncertainty_ms,
            "solve_ms": self.solve.summary(),
            "bytes_in": self.bytes_in,
            "bytes_out": self.bytes_out,
        }
