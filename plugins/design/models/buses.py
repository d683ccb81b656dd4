"""Time that the frames of a skin take on the bus between its edge and the host, in closed forms.

Each bus is a bound: no other device sends, no frame is repeated, and the host is never late.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import nearest_of
from sparseskin.nodes.sensor.files.recording import shown

from .units import BITS_A_SECOND, quantity

LOWEST_BIT_S, HIGHEST_BIT_S = 1e3, 1e11
FD_LENGTHS: tuple[int, ...] = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Lengths of the data field of a CAN FD frame. Source: ISO 11898-1:2015."""


def _serial_s(n: int, baud: float) -> float:
    """UART, 8N1: 10 bits a byte. Source: Microchip, ATmega328P data sheet."""
    return 10 * n / baud


def _can_s(n: int, bit_s: float) -> float:
    """Classic CAN: 34 + 8 n bits, stuff bits, 13 more. Source: ISO 11898-1; Davis et al. 2007."""
    stuffed = 34 + 8 * n
    return (stuffed + (stuffed - 1) // 4 + 13) / bit_s


def _can_fd_s(n: int, bit_s: float, data_bit_s: float) -> float:
    """CAN FD: 34 bits at the slow rate, the others at the fast one. Source: ISO 11898-1:2015."""
    n = next(length for length in FD_LENGTHS if length >= n)
    stuff, crc = (21 + 8 * n) // 4, 27 if n <= 16 else 32
    return (17 + 4 + 13) / bit_s + (5 + 8 * n + (stuff - 4) + crc) / data_bit_s


def _spi_s(n: int, clock: float) -> float:
    """SPI on one data line, no gaps: a bound. Source: Motorola, SPI Block Guide V03.06."""
    return 8 * n / clock


def _udp_s(n: int, bit_s: float) -> float:
    """UDP over IPv4 and Ethernet, preamble and gap too. Source: IEEE 802.3; RFC 791, 768."""
    return 8 * (8 + 14 + max(46, 28 + n) + 4 + 12) / bit_s


class _Kind(NamedTuple):
    """The bus in words, but its rates; time of a frame of n data bytes and the gap after it, by the
    rates; data bytes of a frame at most (None: no framing); the rates where none is stated.
    """

    label: str
    frame_s: Callable[..., float]
    most_bytes: int | None = None
    default: str = ""


KINDS = {
    "serial": _Kind("UART at {}baud", _serial_s),
    "can": _Kind("CAN at {}bit/s", _can_s, 8, "1M"),
    "can-fd": _Kind("CAN FD at {}/{}bit/s", _can_fd_s, 64, "1M/5M"),
    "spi": _Kind("SPI at {}Hz", _spi_s),
    "udp": _Kind("UDP over Ethernet at {}bit/s", _udp_s, 1472, "100M"),
}
FORMS = "serial:2M, can:1M, can-fd[:1M/5M], spi:20M, udp[:100M]"
"""Forms of a bus in options and files."""


@dataclass(frozen=True)
class Bus:
    """A bus that carries the frames of a skin in frames of its own; `rates` in bits a second: of
    UART its baud, of SPI its clock, of CAN FD arbitration and data.
    """

    kind: str
    rates: tuple[float, ...]

    @property
    def label(self) -> str:
        """The bus in words."""
        return KINDS[self.kind].label.format(*map(rate_text, self.rates))

    def seconds(self, n_bytes: int) -> float:
        """Time from the first to the last bit of a skin's frame of `n_bytes`, 1 or more, in
        seconds; the gap before the next one included.
        """
        kind = KINDS[self.kind]
        most = kind.most_bytes or n_bytes
        full, rest = divmod(n_bytes, most)
        last_s = kind.frame_s(rest, *self.rates) if rest else 0.0
        return full * kind.frame_s(most, *self.rates) + last_s


def read_bus(text: object) -> Bus:
    """The bus that a text states: see `FORMS`. Raises SettingsError for other forms."""
    kind, _, rate = text.partition(":") if isinstance(text, str) else ("", "", "")
    kind, rate = kind.strip(), rate.strip()
    if kind not in KINDS:
        hint = nearest_of(kind, KINDS)
        raise SettingsError(f"{shown(text)}: bus is not known{hint}; expected {FORMS}")
    rate = rate or KINDS[kind].default
    if not rate:
        raise SettingsError(f"{shown(text)}: states no rate; expected such as {kind}:2M")
    parts = rate.split("/") if kind == "can-fd" else [rate]
    if kind == "can-fd" and len(parts) != 2:
        raise SettingsError(f"{shown(text)}: expected can-fd:ARBITRATION/DATA, as can-fd:1M/5M")
    rates = tuple(
        quantity(part.strip(), BITS_A_SECOND, "1M", LOWEST_BIT_S, HIGHEST_BIT_S) for part in parts
    )
    if rates[-1] < rates[0]:
        raise SettingsError(f"{shown(text)}: data are slower than the arbitration")
    return Bus(kind, rates)


def rate_text(rate: float) -> str:
    """A rate with the largest prefix that leaves 1 or more: 2 M, 500 k, 9600 without one."""
    power = min(3, max(0, int(math.log10(rate) // 3))) if rate >= 1e4 else 0
    return f"{rate / 1000**power:.6g} {('', 'k', 'M', 'G')[power]}"
