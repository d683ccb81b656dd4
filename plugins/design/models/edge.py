"""Time that the edge takes for a frame: a microcontroller by counted instructions, or Linux."""

from __future__ import annotations

import re
from dataclasses import dataclass

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import nearest_of
from sparseskin.nodes.sensor.files.recording import shown

from .costs import cost
from .units import CLOCK, quantity

CORTEX_M4, LINUX = "cortex-m4", "linux"
A_READING, A_MEASUREMENT, A_BYTE, A_FRAME = 24, 72, 16, 550
"""Instructions of `edge.c` for each reading that enters the Hadamard transform, each measurement
that is scaled and rounded, each byte that is sent, and each frame. Fitted to the largest number of
instructions that `make cortex-m4` counts, of 40 exported edges (12 x 32 to 64 x 64 taxels, N/3 to
N/16, 4 to 16 bits, rows fixed and rotating; gcc 12.2 -O2, QEMU 7.2): all within 5 %."""
CYCLES = 2.0
"""Cycles an instruction: the upper end of 1 to 2. Most instructions of a Cortex-M4 take 1 cycle,
loads and taken branches 2 or more. Source: Arm, Cortex-M4 Technical Reference Manual r0p1, table of
the instruction set; waiting for flash is not counted."""
_M4 = re.compile(r"cortex-m4\s*@\s*(.+)", re.ASCII)


@dataclass(frozen=True)
class Edge:
    """The processor beside the skin: clock of a Cortex-M4, or None for a computer with Linux like
    the one that was measured.
    """

    clock_hz: float | None

    @property
    def label(self) -> str:
        """The edge in words."""
        return LINUX if self.clock_hz is None else f"Cortex-M4 at {self.clock_hz / 1e6:g} MHz"

    def seconds(
        self, strategy: str, n_taxels: int, readings: int, sums: int, n_bytes: int
    ) -> float:
        """Time of a frame, seconds: on Linux of a strategy of `STRATEGIES` on so many taxels; on a
        microcontroller of readings processed, sums scaled and rounded, and bytes sent.
        """
        if self.clock_hz is None:
            return cost(strategy, n_taxels).edge_s
        return CYCLES * instructions(readings, sums, n_bytes) / self.clock_hz


def instructions(readings: int, sums: int, n_bytes: int) -> int:
    """Instructions of a frame: 24 a reading, 72 a measurement, 16 a byte, and 550."""
    return A_READING * readings + A_MEASUREMENT * sums + A_BYTE * n_bytes + A_FRAME


def read_edge(text: object) -> Edge:
    """The edge that a text states: "cortex-m4@168MHz" or "linux". Raises SettingsError for other
    forms.
    """
    if text == LINUX:
        return Edge(None)
    found = _M4.fullmatch(text) if isinstance(text, str) and len(text) <= 40 else None
    if found is None:
        name = text.partition("@")[0].strip() if isinstance(text, str) else ""
        hint = "" if name == CORTEX_M4 else nearest_of(name, (CORTEX_M4, LINUX))
        raise SettingsError(f"{shown(text)}: expected cortex-m4@168MHz or linux{hint}")
    return Edge(quantity(found[1], CLOCK, "168MHz", 1e6, 2e9))
