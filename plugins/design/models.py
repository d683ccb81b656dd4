"""Models of the parts of a skin: converters, bus, edge and host; closed forms, and measured times.

A bus is a bound: no other device sends, no frame is repeated, and the host is never late. Processor
times of Linux and host were measured once, and are stored in `costs.toml`.
"""

import functools
import math
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import nearest_of
from sparseskin.nodes.sensor.layout.checks import shown

LENGTH = {
    "mm": 1e-3,
    "cm": 1e-2,
    "m": 1.0,
    "um": 1e-6,
}
FORCE = {
    "N": 1.0,
    "mN": 1e-3,
    "kN": 1e3,
}
RATE = {
    "Hz": 1.0,
    "kHz": 1e3,
    "": 1.0,
}
CLOCK = {
    "Hz": 1.0,
    "kHz": 1e3,
    "MHz": 1e6,
    "GHz": 1e9,
}
TIME = {
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "ns": 1e-9,
}
SAMPLES = {
    "S/s": 1.0,
    "kS/s": 1e3,
    "MS/s": 1e6,
}
BITS_A_SECOND = {
    "": 1.0,
    "k": 1e3,
    "M": 1e6,
    "G": 1e9,
}
"""Units of each kind of quantity, and their size in SI units."""

_QUANTITY = re.compile(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)\s*([a-zA-Z/]*)", re.ASCII)
_MAX_CHARS = 40


def quantity(
    text: object, units: dict[str, float], example: str, low: float, high: float
) -> float:
    """Return a quantity in SI units: a decimal number of at most 40 characters and one of `units`,
    which have their size in SI units ("": none is needed). Raises SettingsError, with an `example`,
    if the text has another form or unit, or the value is not in low..high.
    """
    match = _matched(_QUANTITY, text)
    if match is None:
        raise SettingsError(
            f"{shown(text)}: expected a number with its unit, such as {example}"
        )
    number, unit = match.groups()
    if unit not in units:
        unit_names = [name for name in units if name]
        fault = "has no unit"
        if unit:
            fault = f"unit {unit!r} is not known{nearest_of(unit, unit_names)}"
        raise SettingsError(f"{shown(text)}: {fault}; expected such as {example}")

    value = float(number) * units[unit]
    # An exponent may make it infinite.
    if not (math.isfinite(value) and low <= value <= high):
        lowest = f"{low / units[unit]:.6g} {unit}".strip()
        largest = f"{high / units[unit]:.6g} {unit}".strip()
        raise SettingsError(f"{shown(text)}: is outside {lowest} .. {largest}")
    return value


def _matched(pattern: re.Pattern[str], text: object) -> re.Match[str] | None:
    """Match a whole value with a pattern; None also if it is no text, or too long for one."""
    if not isinstance(text, str) or len(text) > _MAX_CHARS:
        return None
    return pattern.fullmatch(text)


_ADC = re.compile(r"(\d{1,2})\s*bits?\s*@\s*(.+)", re.ASCII)


@dataclass(frozen=True)
class Adc:
    """Converters behind multiplexers.

    Those that run at once share the conversions of a frame: t = ceil(conversions / converters) (1 /
    rate + settling); `bits` of a reading, 4..24; `rate_hz` of one converter by its data sheet;
    `settling_s` after the multiplexer has switched, which through a resistance R into a capacitance
    C to half a step of B bits is (B + 1) R C ln 2.
    """

    bits: int
    rate_hz: float
    converters: int = 1
    settling_s: float = 0.0

    @property
    def label(self) -> str:
        """The converters in words."""
        label = f"{self.bits} bit at {self.rate_hz / 1e3:g} kS/s"
        if self.converters > 1:
            label = f"{self.converters} x {label}"
        if self.settling_s:
            label = f"{label} + {self.settling_s * 1e6:g} us"
        return label

    def seconds(self, conversions: int) -> float:
        """Time of so many conversions, seconds."""
        # All converters run at once; the last round may leave some idle.
        n_in_turn = -(-conversions // self.converters)
        return n_in_turn * (1 / self.rate_hz + self.settling_s)


def read_adc(text: object) -> Adc:
    """One converter that a text such as "10bit@200kS/s" states; SettingsError for other forms."""
    match = _matched(_ADC, text)
    if match is None:
        raise SettingsError(
            f"{shown(text)}: expected bits and samples a second, as 10bit@200kS/s"
        )
    bits = int(match[1])
    if not 4 <= bits <= 24:
        raise SettingsError(f"{shown(text)}: {bits} bits; allowed: 4..24")
    rate_hz = quantity(match[2], SAMPLES, "200kS/s", 1.0, 1e10)
    return Adc(bits, rate_hz)


LOWEST_BIT_S = 1e3
HIGHEST_BIT_S = 1e11
FD_LENGTHS: tuple[int, ...] = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Lengths of the data field of a CAN FD frame. Source: ISO 11898-1:2015."""


def _serial_s(n: int, baud: float) -> float:
    """UART, 8N1: 10 bits a byte. Source: Microchip, ATmega328P data sheet."""
    return 10 * n / baud


def _can_s(n: int, bit_s: float) -> float:
    """Classic CAN: 34 + 8 n bits, stuff bits, 13 more. Source: ISO 11898-1; Davis et al. 2007."""
    # At most one stuff bit after each four.
    stuffed = 34 + 8 * n
    return (stuffed + (stuffed - 1) // 4 + 13) / bit_s


def _can_fd_s(n: int, bit_s: float, data_bit_s: float) -> float:
    """CAN FD: 34 bits at the slow rate, the others at the fast one. Source: ISO 11898-1:2015."""
    # A frame is filled up to the next length that exists.
    n = next(length for length in FD_LENGTHS if length >= n)
    # At most one stuff bit after each four, of which the first four are sent at the slow rate.
    stuff = (21 + 8 * n) // 4
    crc = 27 if n <= 16 else 32
    return (17 + 4 + 13) / bit_s + (5 + 8 * n + (stuff - 4) + crc) / data_bit_s


def _spi_s(n: int, clock: float) -> float:
    """SPI on one data line, no gaps: a bound. Source: Motorola, SPI Block Guide V03.06."""
    return 8 * n / clock


def _udp_s(n: int, bit_s: float) -> float:
    """UDP over IPv4 and Ethernet, preamble and gap too. Source: IEEE 802.3; RFC 791, 768."""
    # A payload of Ethernet has 46 bytes at least.
    return 8 * (8 + 14 + max(46, 28 + n) + 4 + 12) / bit_s


class _Kind(NamedTuple):
    """Label without rates; time of a frame of n bytes by the rates; its most bytes; default
    rates.
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
        frame_bytes = kind.most_bytes or n_bytes
        # Full frames of the bus, and a shorter one for the rest.
        n_full, n_last = divmod(n_bytes, frame_bytes)
        last_s = 0.0
        if n_last:
            last_s = kind.frame_s(n_last, *self.rates)
        return n_full * kind.frame_s(frame_bytes, *self.rates) + last_s


def read_bus(text: object) -> Bus:
    """The bus that a text states: see `FORMS`. Raises SettingsError for other forms."""
    kind = ""
    rate = ""
    if isinstance(text, str):
        kind, rate = (part.strip() for part in text.partition(":")[::2])
    if kind not in KINDS:
        hint = nearest_of(kind, KINDS)
        raise SettingsError(f"{shown(text)}: bus is not known{hint}; expected {FORMS}")

    rate = rate or KINDS[kind].default
    if not rate:
        raise SettingsError(
            f"{shown(text)}: states no rate; expected such as {kind}:2M"
        )

    # CAN FD has a second rate, of the data.
    parts = [rate]
    if kind == "can-fd":
        parts = rate.split("/")
        if len(parts) != 2:
            raise SettingsError(
                f"{shown(text)}: expected can-fd:ARBITRATION/DATA, as can-fd:1M/5M"
            )
    allowed = (BITS_A_SECOND, "1M", LOWEST_BIT_S, HIGHEST_BIT_S)
    rates = tuple(quantity(part.strip(), *allowed) for part in parts)
    # Of CAN FD: the other order is a slip.
    if rates[-1] < rates[0]:
        raise SettingsError(f"{shown(text)}: data are slower than the arbitration")
    return Bus(kind, rates)


def rate_text(rate: float) -> str:
    """A rate with the largest prefix that leaves 1 or more: 2 M, 500 k, 9600 without one."""
    power = 0
    if rate >= 1e4:
        power = min(3, max(0, int(math.log10(rate) // 3)))
    prefix = ("", "k", "M", "G")[power]
    return f"{rate / 1000**power:.6g} {prefix}"


LARGEST = 4096
"""Taxels of the largest patch that is timed. A larger skin is taken as several patches of so many:
each is reconstructed by itself."""
FIGURES = ("edge_us", "calm_us", "dense_us")
"""Figures of a strategy on a skin: fields of `Cost`, in microseconds."""
HOP_S = 0.28e-3
"""Time of a frame from one process to the next, seconds: half of the column "wires" of
`sparseskin study speed`, 64 x 64 taxels at 1 kHz, every frame reconstructed."""


@dataclass(frozen=True)
class Cost:
    """Processor time of a frame, s: compressor on Linux; reconstructor, untouched and densely
    pressed.
    """

    edge_s: float
    calm_s: float
    dense_s: float


def cost(strategy: str, n_taxels: int) -> Cost:
    """Return the stored cost of a frame of one patch. Between the stored sizes, log(time) is linear
    in log(taxels); below the smallest, the cost is that of the smallest, and beyond `LARGEST` in
    proportion to the taxels.
    """
    # Only the sizes that were measured are in the table.
    table = stored()["cost"]
    sizes = sorted(int(size) for size in table)
    # Patches are no larger than the largest size: beyond it, each taxel costs as much.
    beyond_largest = max(1.0, n_taxels / sizes[-1])
    seconds = []
    for key in FIGURES:
        us = [float(table[str(size)][strategy][key]) for size in sizes]
        log_us = np.interp(math.log(n_taxels), np.log(sizes), np.log(us))
        seconds.append(math.exp(float(log_us)) * beyond_largest * 1e-6)
    return Cost(*seconds)


@functools.cache
def stored() -> dict[str, Any]:
    """The stored table: conditions, and `FIGURES` by taxels and strategy."""
    path = Path(__file__).with_name("costs.toml")
    return tomllib.loads(path.read_text(encoding="utf-8"))


CORTEX_M4 = "cortex-m4"
LINUX = "linux"
A_READING = 24
A_MEASUREMENT = 72
A_BYTE = 16
A_FRAME = 550
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
    """The processor beside the skin: clock of a Cortex-M4; None: Linux on the computer measured."""

    clock_hz: float | None

    @property
    def label(self) -> str:
        """The edge in words."""
        if self.clock_hz is None:
            return LINUX
        return f"Cortex-M4 at {self.clock_hz / 1e6:g} MHz"

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
    """The edge of "cortex-m4@168MHz" or "linux"; raises SettingsError for other forms."""
    if text == LINUX:
        return Edge(None)
    match = _matched(_M4, text)
    if match is None:
        name = text.partition("@")[0].strip() if isinstance(text, str) else ""
        # After the right name it is the clock that is wrong.
        hint = "" if name == CORTEX_M4 else nearest_of(name, (CORTEX_M4, LINUX))
        raise SettingsError(f"{shown(text)}: expected cortex-m4@168MHz or linux{hint}")
    return Edge(quantity(match[1], CLOCK, "168MHz", 1e6, 2e9))
