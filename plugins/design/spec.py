"""What a design states: the skin, its converters, bus, edge and host; from options or a file."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from sparseskin.messages.ranges import is_real, is_whole
from sparseskin.nodes.errors import SettingsError, SparseskinError
from sparseskin.nodes.lookup import did_you_mean, nearest_of
from sparseskin.nodes.numerics.arrays import Mask
from sparseskin.nodes.sensor.files.recording import shown
from sparseskin.nodes.toml import parse_toml
from sparseskin.plugins.points.files import EXAMPLE
from sparseskin.plugins.points.placing import Placement, placed

from .models.adc import Adc, read_adc
from .models.buses import Bus, read_bus
from .models.edge import Edge, read_edge
from .models.units import FORCE, LENGTH, RATE, TIME, quantity
from .strategies import ANALOG, DIGITAL

MAX_SIDE, MAX_TAXELS = 1024, 65536
MOST_CONVERTERS, MOST_CORES = 1024, 4096
SUMS = (DIGITAL, ANALOG)
Place: TypeAlias = "Callable[[str], str]"


@dataclass(frozen=True)
class Key:
    """A key of a design file, which is an option with two dashes too.

    Attributes
    ----------
    default : Any
        Where it is not stated; None if it has to be, or need not be.
    about : str
        One line of help.
    form : str
        How a value looks.
    """

    default: Any
    about: str
    form: str


KEYS = {
    "rows": Key(None, "rows of taxels", "R"),
    "cols": Key(None, "columns of taxels", "C"),
    "taxels": Key(None, "number of taxels of a skin that is no grid, in place of rows, cols", "N"),
    "points": Key(None, "layout of such a skin: .csv, .txt of an iCub, or example:torso", "FILE"),
    "pitch": Key("4mm", "distance of neighbouring taxels", "LENGTH"),
    "rate": Key("1000", "frames a second that are asked for", "HZ"),
    "noise": Key("0.01N", "standard deviation of a taxel's noise", "FORCE"),
    "range": Key("2.5N", "force at full scale", "FORCE"),
    "adc": Key("10bit@200kS/s", "bits and conversions a second of a converter", "ADC"),
    "converters": Key(1, "converters that run at once", "K"),
    "settling": Key("0us", "time that the multiplexer settles before a conversion", "TIME"),
    "sums": Key(
        DIGITAL, "where sums of SBHE are made: digital (edge) or analog (wires)", "digital|analog"
    ),
    "bits": Key(8, "bits of a measurement on the bus, 4..16", "B"),
    "bus": Key("serial:2M", "serial:BAUD, can:RATE, can-fd[:SLOW/FAST], spi:CLOCK, udp", "BUS"),
    "edge": Key("cortex-m4@168MHz", "cortex-m4@CLOCK or linux", "EDGE"),
    "host": Key("4cores", "cores of the host", "CORES"),
}
"""Keys of `design.toml`, and options."""
SIZE_KEYS = ("rows", "cols", "taxels", "points")
"""Keys that state the size: options that do replace all of them."""
_CORES = re.compile(r"(\d{1,4})\s*cores?", re.ASCII)


@dataclass(frozen=True)
class Design:
    """A skin that is not built yet.

    Attributes
    ----------
    n_rows, n_cols : int or None
        Size of the grid; None for a skin of points.
    n_taxels : int
    pitch_m, rate_hz, noise_n, range_n : float
        Distance of taxels in metres, frames a second, standard deviation and full scale in newtons.
    adc : Adc
    sums : "digital" or "analog"
        Where the sums of strategies that leave it open are made.
    bits : int
        Bits of a measurement.
    bus : Bus
    edge : Edge
    cores : int
        Cores of the host.
    mask : ndarray of bool, shape (rows, columns of a virtual grid), or None
        True where a taxel exists, of a skin whose points are known.
    words : dict of str to str
        The keys as they were stated, defaults included.
    """

    n_rows: int | None
    n_cols: int | None
    n_taxels: int
    pitch_m: float
    rate_hz: float
    noise_n: float
    range_n: float
    adc: Adc
    sums: str
    bits: int
    bus: Bus
    edge: Edge
    cores: int
    mask: Mask | None
    words: dict[str, str]

    @property
    def noise(self) -> float:
        """Standard deviation of the noise as a part of the range."""
        return self.noise_n / self.range_n

    @property
    def size(self) -> str:
        """The skin in words."""
        if self.n_rows is None:
            return f"{self.n_taxels} points"
        return f"{self.n_rows} x {self.n_cols} taxels"


def read_file(path: Path) -> dict[str, Any]:
    """Return the keys of a design file; `make_design` checks them. Raises SettingsError if it
    cannot be read or is no TOML.
    """
    try:
        with path.open(encoding="utf-8") as file:
            tree = parse_toml(file.read(1 << 17))
    except OSError as error:
        raise SettingsError(f"{path}: {error.strerror}") from error
    except ValueError as error:  # of its text encoding, too
        raise SettingsError(f"{path}: no TOML: {error}") from error
    found: dict[str, Any] = dict(tree)
    points = found.get("points")
    if isinstance(points, str) and not points.startswith(EXAMPLE):
        found["points"] = str(path.parent / points)
    return found


def make_design(stated: Mapping[str, Any], place: Place = lambda key: f"{key}: ") -> Design:
    """Check the keys of a design, each by itself and against the others. Raises SettingsError with
    a line for each key that is not known or not allowed: key, value, and what is allowed.

    Parameters
    ----------
    stated : mapping
        Values by the names of `KEYS`; others have their defaults.
    place : callable
        What an error begins with, by the key that it is about.
    """
    values = {key: one.default for key, one in KEYS.items()} | dict(stated)
    values = {key: v.strip() if isinstance(v, str) else v for key, v in values.items()}
    keys = _Keys(values, place)
    for key in stated:
        if key not in KEYS:
            keys.fault(key, f"unknown key{did_you_mean(key, KEYS)}")
    n_rows, n_cols, n_taxels, placement = _size(keys)
    if placement is not None and "pitch" not in stated:
        values["pitch"] = f"{1e3 * placement.pitch_m:.3g}mm"
    range_n = keys.read("range", quantity, FORCE, "2.5N", 1e-6, 1e6)
    noise_n = keys.read("noise", quantity, FORCE, "0.01N", 1e-9, 1e6)
    if range_n and noise_n and not 1e-6 * range_n <= noise_n <= 0.3 * range_n:
        keys.fault(
            "noise",
            f"{noise_n:g} N is not allowed for a range of {range_n:g} N; allowed: "
            "0.0001 to 30 % of it",
        )
    sums = keys.read("sums", _sums)
    settling_s = keys.read("settling", quantity, TIME, "5us", 0.0, 1.0)
    converters = keys.read("converters", _whole, 1, MOST_CONVERTERS)
    pitch_m = keys.read("pitch", quantity, LENGTH, "4mm", 1e-5, 1.0)
    rate_hz = keys.read("rate", _rate)
    adc = keys.read("adc", read_adc, converters or 1, settling_s or 0.0)
    bits = keys.read("bits", _whole, 4, 16)
    bus = keys.read("bus", read_bus)
    edge = keys.read("edge", read_edge)
    cores = keys.read("host", _cores)
    if keys.faults:
        raise SettingsError("\n".join(keys.faults))
    return Design(
        n_rows=n_rows,
        n_cols=n_cols,
        n_taxels=n_taxels,
        pitch_m=pitch_m,
        rate_hz=rate_hz,
        noise_n=noise_n,
        range_n=range_n,
        adc=adc,
        sums=sums,
        bits=bits,
        bus=bus,
        edge=edge,
        cores=cores,
        mask=None if placement is None else placement.skin(range_n, "N").exists,
        words={key: str(value) for key, value in values.items() if value is not None},
    )


class _Keys:
    """Values of a design by their keys, and the faults that were found in them."""

    def __init__(self, values: Mapping[str, Any], place: Place) -> None:
        self.values, self.faults = values, list[str]()
        self._place = place

    def fault(self, key: str, what: object) -> None:
        self.faults.append(f"{self._place(key)}{what}")

    def read(self, key: str, how: Callable[..., Any], *given: Any) -> Any:
        """The value of a key as `how` reads it; None, and a fault more, if it refuses."""
        try:
            return how(self.values[key], *given)
        except SparseskinError as error:
            self.fault(key, error)
            return None


def _size(keys: _Keys) -> tuple[int | None, int | None, int, Placement | None]:
    """Rows and columns, or None, the number of taxels, and the placement of points; after a fault
    a number of taxels of 0.
    """
    values = keys.values
    ways = [key for key in ("rows", "taxels", "points") if values[key] is not None]
    missing = [key for key in ("rows", "cols") if values[key] is None]
    if missing and (ways in ([], ["rows"]) or "cols" not in missing):
        if not keys.faults:  # it may be the key that is not known
            more = ", taxels, or points" if len(missing) == 2 else ""
            keys.fault(missing[0], f"is missing; state rows and cols{more}")
    elif len(ways) > 1:
        keys.fault(ways[1], f"states the size once more; leave out {ways[0]}")
    elif ways == ["taxels"]:
        return None, None, keys.read("taxels", _whole, 16, MAX_TAXELS) or 0, None
    elif ways == ["points"]:
        placement = keys.read("points", _placement)
        return None, None, placement.points.n if placement else 0, placement
    else:
        n_rows, n_cols = (keys.read(key, _whole, 1, MAX_SIDE) for key in ("rows", "cols"))
        if not (n_rows and n_cols):
            return None, None, 0, None
        n = n_rows * n_cols
        if 16 <= n <= MAX_TAXELS:
            return n_rows, n_cols, n, None
        keys.fault("rows", f"{n_rows} x {n_cols} are {n} taxels; allowed: 16..{MAX_TAXELS}")
    return None, None, 0, None


def _placement(layout: object) -> Placement:
    """The virtual grid of a layout of points; SettingsError if it cannot be used."""
    if not isinstance(layout, str):
        raise SettingsError(f"{shown(layout)}: expected a file, or example:torso")
    found = placed(layout)
    if not 16 <= found.points.n <= MAX_TAXELS:
        raise SettingsError(f"{layout}: {found.points.n} points; allowed: 16..{MAX_TAXELS}")
    return found


def _whole(value: object, low: int, high: int) -> int:
    if isinstance(value, str) and value.isascii() and value.isdigit() and len(value) < 10:
        value = int(value)
    if not is_whole(value, low, high):
        raise SettingsError(f"{shown(value)} is not allowed; allowed: {low}..{high}")
    return int(value)


def _sums(value: object) -> str:
    if value not in SUMS:
        text = str(value)[:40]
        raise SettingsError(f"{text!r} is not allowed{nearest_of(text, SUMS)}")
    return str(value)


def _rate(value: object) -> float:
    text = f"{value:g}" if is_real(value) else value
    return quantity(text, RATE, "1000 or 1kHz", 1.0, 10_000.0)


def _cores(value: object) -> int:
    found = _CORES.fullmatch(value) if isinstance(value, str) else None
    number = value if is_whole(value) else found and int(found[1])
    if not is_whole(number, 1, MOST_CORES):
        raise SettingsError(f"{shown(value)}: expected such as 4cores, 1..{MOST_CORES}")
    return int(number)
