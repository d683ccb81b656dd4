"""Messages of a batch: the frames of equal patches of skin, acquired together, in one message.

The `patch` of such a message is the name of the batch; `names` are those of its patches. `split`
returns the messages of the single patches, `join` makes one message of them.
"""

from __future__ import annotations

import functools
from collections.abc import MutableMapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from .base import Message
from .errors import FieldError, OversizedError, ShapeError
from .fields import Array, FieldKind, Integer, Text, wire
from .frames import FINGERPRINT_PATTERN, Floats, Measurements, Reconstruction, Taxels, Truth
from .topics import check_name

MAX_PATCHES = 256
"""Largest number of patches of a batch."""
MAX_NAMES = 4096
"""Most characters of the names of all patches of a batch, a space between each two."""
NO_ERROR = -1.0
"""Error of a patch whose solver estimates none."""


@dataclass(frozen=True)
class Names(FieldKind):
    """Names of patches, a tuple of 1 to 256 different texts; its wire form is one text, in which
    spaces separate them.
    """

    travels_as_it_is: ClassVar[bool] = False

    def check(self, name: str, value: Any) -> tuple[str, ...]:
        if not isinstance(value, tuple) or not all(isinstance(each, str) for each in value):
            raise FieldError(f"{name}: expected a tuple of texts, got {type(value).__name__}")
        return _names(name, " ".join(value))

    def pack(self, value: Any) -> str:
        return " ".join(value)

    def unpack(self, name: str, raw: Any) -> tuple[str, ...]:
        if not isinstance(raw, str):
            raise FieldError(f"{name}: expected a text, got {type(raw).__name__}")
        return _names(name, raw)


@functools.lru_cache(maxsize=64)
def _names(place: str, text: str) -> tuple[str, ...]:
    """Names in a text; the same few texts recur in every frame."""
    if len(text) > MAX_NAMES:
        raise OversizedError(f"{place}: {len(text)} characters, at most {MAX_NAMES}")
    names = text.split(" ")
    if len(names) > MAX_PATCHES:
        raise OversizedError(f"{place}: {len(names)} names, at most {MAX_PATCHES}")
    for name in names:
        check_name(place, name)
    if len(set(names)) < len(names):
        raise FieldError(f"{place}: a name occurs twice")
    return tuple(names)


def unchecked(cls: type[Message], values: dict[str, Any]) -> Any:
    """A message of fields that were checked before, all of them stated."""
    made = object.__new__(cls)
    made.__dict__.update(values)
    return made


@dataclass(frozen=True, kw_only=True, eq=False)
class BatchMessage(Message):
    """Base of the messages of a batch; `single` is the class of the messages of its patches."""

    single: ClassVar[type[Message]]

    names: tuple[str, ...] = wire(Names())

    def _check_rows(self, name: str, values: npt.NDArray[Any]) -> None:
        if len(values) != len(self.names):
            raise ShapeError(f"{name}: {len(values)} rows for {len(self.names)} patches")

    def _common(self, name: str) -> dict[str, Any]:
        """Fields that every message has, for one patch."""
        return {
            "stamp_ns": self.stamp_ns,
            "patch": name,
            "run_id": self.run_id,
            "seq": self.seq,
        }

    def split(self, held: MutableMapping[str, Floats]) -> list[Any]:
        """Return the messages of the single patches, arrays being views.

        `held` keeps the forces of each patch for a `ReconstructionBatch`; others do not use it.
        """
        raise NotImplementedError

    @classmethod
    def join(cls, patch: str, parts: Sequence[Any]) -> Self:
        """Make the message of the batch `patch` of those of its patches, of one stamp."""
        raise NotImplementedError


def _head(patch: str, parts: Sequence[Any]) -> dict[str, Any]:
    """Return stamp, name and patches of the batch `patch` of these messages."""
    names = tuple(part.patch for part in parts)
    return {"stamp_ns": parts[0].stamp_ns, "patch": patch, "names": names}


@dataclass(frozen=True, kw_only=True, eq=False)
class _ForcesBatch(BatchMessage):
    """Forces of all patches, float32, shape (n_patches, n_rows, n_cols)."""

    forces: Floats = wire(Array("<f4", 3))

    def validate(self) -> None:
        self._check_rows("forces", self.forces)

    def split(self, held: MutableMapping[str, Floats]) -> list[Any]:
        return [
            unchecked(self.single, {**self._common(name), "forces": forces})
            for name, forces in zip(self.names, self.forces, strict=True)
        ]

    @classmethod
    def join(cls, patch: str, parts: Sequence[Any]) -> Self:
        return cls(
            **_head(patch, parts),
            forces=np.stack([part.forces for part in parts]),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class TaxelsBatch(_ForcesBatch):
    """Readings of the taxels of all patches, as `Taxels`; shape (n_patches, n_rows, n_cols)."""

    schema: ClassVar[str] = "taxels_batch"
    single: ClassVar[type[Message]] = Taxels


@dataclass(frozen=True, kw_only=True, eq=False)
class TruthBatch(_ForcesBatch):
    """True forces of all patches, as `Truth`; shape (n_patches, n_rows, n_cols)."""

    schema: ClassVar[str] = "truth_batch"
    single: ClassVar[type[Message]] = Truth


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasurementsBatch(BatchMessage):
    """Measurements of all patches by one Phi: `y`, float32, shape (n_patches, M), else as
    `Measurements`.
    """

    schema: ClassVar[str] = "measurements_batch"
    single: ClassVar[type[Message]] = Measurements

    y: Floats = wire(Array("<f4", 2))
    phi: str = wire(Text(16, FINGERPRINT_PATTERN))

    def validate(self) -> None:
        self._check_rows("y", self.y)

    def split(self, held: MutableMapping[str, Floats]) -> list[Any]:
        same = {"phi": self.phi, "places": None, "nodes": None}
        return [
            unchecked(self.single, {**self._common(name), "y": y, **same})
            for name, y in zip(self.names, self.y, strict=True)
        ]

    @classmethod
    def join(cls, patch: str, parts: Sequence[Any]) -> Self:
        return cls(
            **_head(patch, parts),
            y=np.stack([part.y for part in parts]),
            phi=parts[0].phi,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class ReconstructionBatch(BatchMessage):
    """Reconstructed forces of all patches, as `Reconstruction`, without standard deviations.

    Attributes
    ----------
    forces : ndarray of float32, shape (n_changed, n_rows, n_cols), or None
        Forces of the patches that are not `unchanged`, in their order; None where all are.
    unchanged : ndarray of bool, shape (n_patches,)
        True where the forces are those of the patch's frame before, and are not sent again.
    phi, done_ns, skipped
        As in `Reconstruction`.
    iterations : ndarray of int32, shape (n_patches,)
    residual, error : ndarray of float32, shape (n_patches,)
        As in `Reconstruction`, in the skin's unit; an error of -1 where none is estimated.
    solve_ns : ndarray of int64, shape (n_patches,)
    trusted : ndarray of bool, shape (n_patches,)
    """

    schema: ClassVar[str] = "reconstruction_batch"
    single: ClassVar[type[Message]] = Reconstruction
    times: ClassVar[tuple[str, ...]] = ("stamp_ns", "done_ns")

    forces: Floats | None = wire(Array("<f4", 3, optional=True))
    unchanged: npt.NDArray[np.bool_] = wire(Array("|b1", 1))
    phi: str = wire(Text(16, FINGERPRINT_PATTERN))
    iterations: npt.NDArray[np.int32] = wire(Array("<i4", 1))
    residual: Floats = wire(Array("<f4", 1))
    error: Floats = wire(Array("<f4", 1))
    solve_ns: npt.NDArray[np.int64] = wire(Array("<i8", 1))
    trusted: npt.NDArray[np.bool_] = wire(Array("|b1", 1))
    done_ns: int = wire(Integer())
    skipped: int = wire(Integer(), default=0, omitted=True)

    def validate(self) -> None:
        for name in ("unchanged", "iterations", "residual", "error", "solve_ns", "trusted"):
            self._check_rows(name, getattr(self, name))
        n_changed = len(self.names) - int(np.count_nonzero(self.unchanged))
        n_sent = 0 if self.forces is None else len(self.forces)
        if n_sent != n_changed:
            raise ShapeError(f"forces: of {n_sent} patches, but {n_changed} have changed")
        lowest = min(int(self.iterations.min()), int(self.solve_ns.min()), self.residual.min())
        if lowest < 0:
            raise FieldError(f"iterations, residual or solve_ns: {lowest} is below 0")

    def split(self, held: MutableMapping[str, Floats]) -> list[Any]:
        """As in `BatchMessage`; a patch that is unchanged and not in `held` is left out, as its
        forces were sent before this reader came.
        """
        sent = iter(() if self.forces is None else self.forces)
        parts = []
        for k, name in enumerate(self.names):
            unchanged = bool(self.unchanged[k])
            if not unchanged:
                held[name] = next(sent)
            elif name not in held:
                continue
            error = float(self.error[k])
            fields = {
                "forces": held[name],
                "phi": self.phi,
                "iterations": int(self.iterations[k]),
                "residual": float(self.residual[k]),
                "solve_ns": int(self.solve_ns[k]),
                "done_ns": self.done_ns,
                "sd": None,
                "skipped": self.skipped,
                "error": None if error < 0 else error,
                "trusted": bool(self.trusted[k]),
                "unchanged": unchanged,
            }
            parts.append(unchecked(self.single, {**self._common(name), **fields}))
        return parts

    @classmethod
    def join(cls, patch: str, parts: Sequence[Any]) -> Self:
        changed = [part.forces for part in parts if not part.unchanged]
        errors = [NO_ERROR if part.error is None else part.error for part in parts]
        return cls(
            **_head(patch, parts),
            forces=np.stack(changed) if changed else None,
            unchanged=np.array([part.unchanged for part in parts]),
            phi=parts[0].phi,
            iterations=np.array([part.iterations for part in parts], np.int32),
            residual=np.array([part.residual for part in parts], np.float32),
            error=np.array(errors, np.float32),
            solve_ns=np.array([part.solve_ns for part in parts], np.int64),
            trusted=np.array([part.trusted for part in parts]),
            done_ns=max(part.done_ns for part in parts),
            skipped=parts[0].skipped,
        )


BATCHES: dict[str, type[BatchMessage]] = {
    cls.single.schema: cls
    for cls in (TaxelsBatch, TruthBatch, MeasurementsBatch, ReconstructionBatch)
}
"""Message classes of batches by the schema of their single messages."""
