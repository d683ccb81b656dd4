"""The interface of a port that a board sends to."""

import importlib
from abc import ABC, abstractmethod
from types import ModuleType
from typing import Any

from sparseskin.nodes.errors import NotHereError, not_installed

from .framing import Counts, Frame, Framing

MAX_READS = 64
"""Reads of one call at most; chosen, so that a flood ends."""
READ_BYTES = 1 << 16

Arrived = tuple[int, Frame]
"""Time of arrival on the monotonic clock, nanoseconds; the frame."""


class Port(ABC):
    """A port with the parser of its frames; `n_bytes` received so far, `lines` for the log."""

    def __init__(
        self, address: str, settings: Any, framing: Framing, counts: Counts
    ) -> None:
        self.address = address
        self._settings = settings
        self.n_bytes = 0
        self.lines: list[str] = []

    @classmethod
    @abstractmethod
    def check(cls, address: str, settings: Any) -> None:
        """Raise SourceError if the device is not there, or cannot be opened by this user."""

    @abstractmethod
    def open(self) -> None:
        """Open the device; SourceError if it cannot be."""

    @abstractmethod
    def receive(self, wait_s: float) -> list[Arrived]:
        """Frames that came; none after `wait_s` without any. OSError if the device is gone."""

    @abstractmethod
    def close(self) -> None:
        """Close the device; may be called more than once."""

    @abstractmethod
    def lost(self) -> dict[str, int]:
        """What kernel and driver have dropped, by its name."""

    @abstractmethod
    def hint(self) -> str:
        """What the bytes show that came last, where no frame was among them; "" for nothing."""


def needed_module(name: str, package: str, extra: str) -> ModuleType:
    """Import a package of an extra; NotHereError if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise NotHereError(not_installed(package, extra)) from error
