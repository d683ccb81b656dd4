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
    SkinState,
    SolverState,
    Taxels,
    Truth,
    size_bytes,
)

from .statistics import Extent, Quantiles

PSNR_CAP_DB = 100.0
CONTACT_FRACTION = 0.004
"""A frame is in contact where some taxel bears more than this part of f_max: 0.01 N of 2.5 N."""
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
class _Pending:
    taxels: Taxels | None = None
    truth: Truth | None = None
    reconstruction: Reconstruction | None = None


class PatchMetrics:
    """Pairs a patch's messages by stamp and keeps the figures of its summary."""

    def __init__(self) -> None:
        self.skin: SkinState | None = None
        self.phi: PhiState | None = None
        self.solver: SolverState | None = None
        self.noisy = Quality()
        self.restored = Quality()
        self.relative_error = Extent()
        self.latency = Quantiles()
        self.solve = Quantiles()
        self.sensed = self.reconstructed = 0
        self.bytes_in = self.bytes_out = 0
        self.lost_so_far = 0
        self.unpaired = 0
        self._pending: OrderedDict[int, _Pending] = OrderedDict()

    def add(self, message: Message) -> None:
        """Take in one message of the patch."""
        match message:
            case SkinState():
                self.skin = message
            case PhiState():
                self.phi = message
            case SolverState():
                self.solver = message
            case Measurements():
                self.bytes_out += size_bytes(message)
            case Taxels():
                self.sensed = max(self.sensed, message.seq + 1)
                self.bytes_in += size_bytes(message) - self._absent_bytes(message)
                self._pair(message.stamp_ns).taxels = message
                self._settle(message.stamp_ns)
            case Truth():
                self._pair(message.stamp_ns).truth = message
                self._settle(message.stamp_ns)
            case Reconstruction():
                self.reconstructed = max(self.reconstructed, message.seq + 1)
                self.latency.add(message.done_ns - message.stamp_ns)
                self.solve.add(message.solve_ns)
                self._pair(message.stamp_ns).reconstruction = message
                self._settle(message.stamp_ns)

    def end(self, schema: str, n_messages: int) -> None:
        """A topic has ended after n_messages: the publisher's own count is the right one."""
        if schema == Taxels.schema:
            self.sensed = n_messages
        elif schema == Reconstruction.schema:
            self.reconstructed = n_messages

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

    def _settle(self, stamp_ns: int) -> None:
        """Judge a frame once all that belongs to it has come."""
        frame = self._pending[stamp_ns]
        if self.skin is None or frame.taxels is None or frame.reconstruction is None:
            return
        if self.skin.has_truth and frame.truth is None:
            return
        del self._pending[stamp_ns]
        # Both streams count the same frames, so a lag of numbers is what has been lost.
        self.lost_so_far = max(0, frame.taxels.seq - frame.reconstruction.seq)
        cells = self.skin.mask if self.skin.mask is not None else slice(None)
        taxels = frame.taxels.forces[cells]
        restored = frame.reconstruction.forces[cells]
        f_max = self.skin.f_max
        reference = taxels if frame.truth is None else frame.truth.forces[cells]
        in_contact = float(reference.max()) > CONTACT_FRACTION * f_max
        if frame.truth is not None:
            self.noisy.add(psnr_db(taxels - reference, f_max), in_contact)
        error = restored - reference
        self.restored.add(psnr_db(error, f_max), in_contact)
        if in_contact:
            norm = float(np.linalg.norm(reference))
            self.relative_error.add(float(np.linalg.norm(error)) / norm)

    def summary(self) -> dict[str, Any]:
        """The patch's part of the summary; figures that are not known are None."""
        n = self.phi.n if self.phi else None
        m = self.phi.m if self.phi else None
        has_truth = self.skin.has_truth if self.skin else None
        return {
            "scene": self.skin.source if self.skin else None,
            "phi": self.phi.kind if self.phi else None,
            "basis": self.solver.basis if self.solver else None,
            "solver": self.solver.solver if self.solver else None,
            "preset": self.solver.preset if self.solver else None,
            "iterations": self.solver.iterations if self.solver else None,
            "n": n,
            "m": m,
            "ratio": n / m if n and m else None,
            "f_max": self.skin.f_max if self.skin else None,
            "unit": self.skin.unit if self.skin else None,
            "frames": {
                "sensed": self.sensed,
                "reconstructed": self.reconstructed,
                "lost": max(0, self.sensed - self.reconstructed),
                "unpaired": self.unpaired + len(self._pending),
            },
            "reference": {True: "truth", False: "taxels", None: None}[has_truth],
            "psnr_db": {
                "noisy": self.noisy.summary(),
                "reconstruction": self.restored.summary(),
            },
            "relative_error": self.relative_error.summary(),
            "latency_ms": self.latency.summary(),
            "solve_ms": self.solve.summary(),
            "bytes_in": self.bytes_in,
            "bytes_out": self.bytes_out,
        }
