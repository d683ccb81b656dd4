"""Time that the frames of a skin take on the bus between its edge and the host, in closed forms.

Each bus is a bound: no other device sends, no frame is repeated, and the host is never late.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import nearest_of
from sparseskin.nodes.sensor.files.recording import shown

from .units import BITS_A_SECOND, quantity

LOWEST_BIT_S, HIGHEST_BIT_S = 1e3, 1e11


@dataclass(frozen=True)
class Bus(ABC):
    """A bus that carries the frames of a skin in frames of its own.

    Attributes
    ----------
    bit_s : float
        Bits a second: of UART its baud, of SPI its clock, of CAN FD the rate of the arbitration.
    form : str
        The bus in words, but its rate.
    most_bytes : int or None
        Data bytes of a frame of the bus at most; None where it has no framing.
    """

    form: ClassVar[str]
    most_bytes: ClassVar[int | None] = None
    bit_s: float

    @property
    def label(self) -> str:
        """The bus in words."""
        return self.form.format(rate_text(self.bit_s))

    @abstractmethod
    def frame_s(self, n_bytes: int) -> float:
        """Time of one frame of the bus with so many data bytes, and the gap after it, seconds."""

    def seconds(self, n_bytes: int) -> float:
        """Time from the first to the last bit of a skin's frame of `n_bytes`, 1 or more, in
        seconds; the gap before the next one included.
        """
        most = self.most_bytes or n_bytes
        full, rest = divmod(n_bytes, most)
        return full * self.frame_s(most) + (self.frame_s(rest) if rest else 0.0)


class Serial(Bus):
    """UART with 8 data bits, no parity and one stop bit (8N1): 10 bits a byte.

    t = 10 n / baud. Source: Microchip, ATmega328P data sheet, frame formats of the USART.
    """

    form = "UART at {}baud"

    def frame_s(self, n_bytes: int) -> float:
        return 10 * n_bytes / self.bit_s


class Can(Bus):
    """Classic CAN, 11-bit identifiers, 8 bytes a frame.

    A frame of n bytes has 34 + 8 n bits from its start to its CRC, into which at most
    floor((33 + 8 n) / 4) stuff bits are put, and 13 more: CRC delimiter, acknowledgement (2), end
    of frame (7) and intermission (3). Of 8 bytes: 135 bits.

    Source: ISO 11898-1:2015; bound of the stuff bits as in Davis, Burns, Bril, Lukkien, "Controller
    Area Network (CAN) schedulability analysis", Real-Time Systems 35, 2007.
    """

    form = "CAN at {}bit/s"
    most_bytes = 8

    def frame_s(self, n_bytes: int) -> float:
        stuffed = 34 + 8 * n_bytes
        return (stuffed + (stuffed - 1) // 4 + 13) / self.bit_s


FD_LENGTHS: tuple[int, ...] = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Lengths of the data field of a CAN FD frame. Source: ISO 11898-1:2015."""


@dataclass(frozen=True)
class CanFd(Bus):
    """CAN FD, 11-bit identifiers, 64 bytes a frame, data at a higher rate.

    At the arbitration rate: 17 bits from the start to the bit rate switch, at most 4 stuff bits,
    and 13 bits from the CRC delimiter to the end of the intermission. At the data rate: 5 bits
    (error state, length), 8 n bits of data with the other stuff bits, at most
    floor((21 + 8 n) / 4) of both phases, and the CRC with the stuff count and its fixed stuff bits:
    27 bits to 16 bytes of data, 32 bits beyond. n is the next of `FD_LENGTHS`. Source: ISO
    11898-1:2015.
    """

    form = "CAN FD at {}/{}bit/s"
    most_bytes = 64
    data_bit_s: float

    @property
    def label(self) -> str:
        return self.form.format(rate_text(self.bit_s), rate_text(self.data_bit_s))

    def frame_s(self, n_bytes: int) -> float:
        n = next(length for length in FD_LENGTHS if length >= n_bytes)
        stuff, crc = (21 + 8 * n) // 4, 27 if n <= 16 else 32
        slow, fast = 17 + 4 + 13, 5 + 8 * n + (stuff - 4) + crc
        return slow / self.bit_s + fast / self.data_bit_s


class Spi(Bus):
    """SPI on one data line: 8 clocks a byte, without gaps, as DMA sends.

    t = 8 n / clock. Source: Motorola, SPI Block Guide V03.06. The bus has no
    framing of its own, and devices may need pauses between bytes: this is a bound.
    """

    form = "SPI at {}Hz"

    def frame_s(self, n_bytes: int) -> float:
        return 8 * n_bytes / self.bit_s


class Udp(Bus):
    """UDP over IPv4 and Ethernet: datagrams of at most 1472 bytes, which fill an Ethernet frame:
    1500 - 20 (IPv4) - 8 (UDP).

    On the wire a datagram of n bytes is preamble 8, header 14, max(46, 28 + n), check
    sequence 4, and a gap of 12. Source: IEEE 802.3-2018; RFC 791; RFC 768.
    """

    form = "UDP over Ethernet at {}bit/s"
    most_bytes = 1472

    def frame_s(self, n_bytes: int) -> float:
        return 8 * (8 + 14 + max(46, 28 + n_bytes) + 4 + 12) / self.bit_s


FORMS = "serial:2M, can:1M, can-fd[:1M/5M], spi:20M, udp[:100M]"
"""Forms of a bus in options and files."""
_KINDS: dict[str, tuple[type[Bus], str]] = {
    **{"can": (Can, "1M"), "can-fd": (CanFd, "1M/5M"), "udp": (Udp, "100M")},
    **{"serial": (Serial, ""), "spi": (Spi, "")},
}
"""Buses by name, each with its rate where none is stated."""


def read_bus(text: object) -> Bus:
    """Return the bus that a text states: see `FORMS`. Raises SettingsError if the text has another
    form.
    """
    kind, _, rate = text.partition(":") if isinstance(text, str) else ("", "", "")
    kind, rate = kind.strip(), rate.strip()
    if kind not in _KINDS:
        hint = nearest_of(kind, _KINDS)
        raise SettingsError(f"{shown(text)}: bus is not known{hint}; expected {FORMS}")
    made, default = _KINDS[kind]
    rate = rate or default
    if not rate:
        raise SettingsError(f"{shown(text)}: states no rate; expected such as {kind}:2M")
    slow, slash, fast = rate.partition("/") if kind == "can-fd" else (rate, "", "")
    rates = [_bit_s(slow.strip(), "1M")]
    if kind == "can-fd":
        if not slash:
            raise SettingsError(f"{shown(text)}: expected can-fd:ARBITRATION/DATA, as can-fd:1M/5M")
        rates.append(_bit_s(fast.strip(), "5M"))
        if rates[1] < rates[0]:
            raise SettingsError(f"{shown(text)}: data are slower than the arbitration")
    return made(*rates)


def rate_text(rate: float) -> str:
    """A rate with the largest prefix that leaves 1 or more: 2 M, 500 k, 9600 without one."""
    power = min(3, max(0, int(math.log10(rate) // 3))) if rate >= 1e4 else 0
    return f"{rate / 1000**power:.6g} {('', 'k', 'M', 'G')[power]}"


def _bit_s(text: str, example: str) -> float:
    return quantity(text, BITS_A_SECOND, example, LOWEST_BIT_S, HIGHEST_BIT_S)
