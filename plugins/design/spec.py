"""What a design states: the skin, its converters, bus, edge and host; from options or a file."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from sparseskin.messages.ranges import is_real, is_whole
from sparseskin.nodes.errors import SettingsError, SparseskinError
from sparseskin.nodes.lookup import did_you_mean, nearest_of
from sparseskin.nodes.numerics.arrays import Mask
from sparseskin.nodes.sensor.layout.checks import shown
from sparseskin.nodes.toml import parse_toml

from .models import (
    FORCE,
    LENGTH,
    RATE,
    TIME,
    Adc,
    Bus,
    Edge,
    quantity,
    read_adc,
    read_bus,
    read_edge,
)
from .strategies import ANALOG, DIGITAL

if TYPE_CHECKING:
    from sparseskin.plugins.points.placing import Placement

MAX_SIDE = 1024
MAX_TAXELS = 65536
MOST_CORES = 4096
Place: TypeAlias = "Callable[[str], str]"
Reads: TypeAlias = "Callable[[object], Any]"
_CORES = re.compile(r"(\d{1,4})\s*cores?", re.ASCII)
_DIGITS = re.compile(r"\d{1,9}", re.ASCII)


EXAMPLE = "example:"
"""Start of a layout that comes with the package."""


def _placement(layout: object) -> "Placement":
    """The virtual grid of a layout of points; SettingsError if it cannot be used."""
    # Imported here: with it comes SciPy's interpolation.
    from sparseskin.plugins.points.placing import placed

    if not isinstance(layout, str):
        raise SettingsError(f"{shown(layout)}: expected a file, or example:torso")
    placement = placed(layout)
    if not 16 <= placement.points.n <= MAX_TAXELS:
        raise SettingsError(
            f"{layout}: {placement.points.n} points; allowed: 16..{MAX_TAXELS}"
        )
    return placement


def _sums(value: object) -> str:
    if value not in (DIGITAL, ANALOG):
        text = str(value)[:40]
        raise SettingsError(
            f"{text!r} is not allowed{nearest_of(text, (DIGITAL, ANALOG))}"
        )
    return str(value)


def _rate(value: object) -> float:
    text = f"{value:g}" if is_real(value) else value
    return quantity(text, RATE, "1000 or 1kHz", 1.0, 10_000.0)


def _cores(value: object) -> int:
    match = _CORES.fullmatch(value) if isinstance(value, str) else None
    number = int(match[1]) if match else value
    if not is_whole(number, 1, MOST_CORES):
        raise SettingsError(f"{shown(value)}: expected such as 4cores, 1..{MOST_CORES}")
    return int(number)


@dataclass(frozen=True)
class Key:
    """A key of a design file, which is an option with two dashes too: default (None: it has to be
    stated, or need not be), a line of help, how a value looks, and what checks a value and returns
    it.
    """

    default: Any
    about: str
    form: str
    read: Reads


def _whole(default: Any, about: str, form: str, low: int, high: int) -> Key:
    def read(value: object) -> int:
        # Options are texts.
        if isinstance(value, str) and _DIGITS.fullmatch(value):
            value = int(value)
        if not is_whole(value, low, high):
            raise SettingsError(
                f"{shown(value)} is not allowed; allowed: {low}..{high}"
            )
        return int(value)

    return Key(default, about, form, read)


def _quantity(
    default: str,
    about: str,
    form: str,
    units: dict[str, float],
    low: float,
    high: float,
) -> Key:
    read = partial(
        quantity,
        units=units,
        example=default,
        low=low,
        high=high,
    )
    return Key(default, about, form, read)


_TAXELS = "number of taxels of a skin that is no grid, in place of n_rows, n_cols"
_POINTS = "layout of such a skin: .csv, .txt of an iCub, or example:torso"
_SETTLING = "time that the multiplexer settles before a conversion"
_SUMS = "where sums of SBHE are made: digital (edge) or analog (wires)"
_BUS = "serial:BAUD, can:RATE, can-fd[:SLOW/FAST], spi:CLOCK, udp"
KEYS = {
    "n_rows": _whole(None, "rows of taxels", "R", 1, MAX_SIDE),
    "n_cols": _whole(None, "columns of taxels", "C", 1, MAX_SIDE),
    "taxels": _whole(None, _TAXELS, "N", 16, MAX_TAXELS),
    "points": Key(None, _POINTS, "FILE", _placement),
    "pitch": _quantity(
        "4mm", "distance of neighbouring taxels", "LENGTH", LENGTH, 1e-5, 1.0
    ),
    "rate": Key("1000", "frames a second that are asked for", "HZ", _rate),
    "noise": _quantity(
        "0.01N", "standard deviation of a taxel's noise", "FORCE", FORCE, 1e-9, 1e6
    ),
    "range": _quantity("2.5N", "force at full scale", "FORCE", FORCE, 1e-6, 1e6),
    "adc": Key(
        "10bit@200kS/s", "bits and conversions a second of a converter", "ADC", read_adc
    ),
    "converters": _whole(1, "converters that run at once", "K", 1, 1024),
    "settling": _quantity("0us", _SETTLING, "TIME", TIME, 0.0, 1.0),
    "sums": Key(DIGITAL, _SUMS, "digital|analog", _sums),
    "bits": _whole(8, "bits of a measurement on the bus, 4..16", "B", 4, 16),
    "bus": Key("serial:2M", _BUS, "BUS", read_bus),
    "edge": Key("cortex-m4@168MHz", "cortex-m4@CLOCK or linux", "EDGE", read_edge),
    "host": Key("4cores", "cores of the host", "CORES", _cores),
}
"""Keys of `design.toml`, and options."""
SIZE_KEYS = ("n_rows", "n_cols", "taxels", "points")
"""Keys that state the size: options that do replace all of them."""


@dataclass(frozen=True)
class Design:
    """A skin that is not built yet, in metres, newtons, frames a second. `n_rows`, `n_cols`: None
    for a skin of points; `sums`: where the sums of strategies that leave it open are made; `mask`:
    True where a taxel exists, on the virtual grid of a skin whose points are known.
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
    """Return the keys of a design file; SettingsError if it cannot be read or is no TOML."""
    try:
        with path.open(encoding="utf-8") as file:
            tree = parse_toml(file.read(1 << 17))
    except OSError as error:
        raise SettingsError(f"{path}: {error.strerror}") from error
    except ValueError as error:
        # Also where its bytes are no UTF-8.
        raise SettingsError(
            f"{path}: no TOML: {error}; of a recording, `sparseskin reprocess` shows what fewer "
            "measurements lose"
        ) from error
    keys = dict(tree)
    # A relative path is one from the folder of the file.
    points = keys.get("points")
    if isinstance(points, str) and not points.startswith(EXAMPLE):
        keys["points"] = str(path.parent / points)
    return keys


def make_design(
    stated: Mapping[str, Any], place: Place = lambda key: f"{key}: "
) -> Design:
    """Check the keys of a design, each by itself and against the others; those not stated have
    their defaults. Raises SettingsError with a line for each that is not known or not allowed: what
    `place` returns for the key, value, what is allowed.
    """
    faults = []
    for name in stated:
        if name not in KEYS:
            faults.append(f"{place(name)}unknown key{did_you_mean(name, KEYS)}")
    values: dict[str, Any] = dict.fromkeys(KEYS)
    for name, key in KEYS.items():
        value = stated.get(name, key.default)
        if isinstance(value, str):
            value = value.strip()
        try:
            if value is not None:
                values[name] = key.read(value)
        except SparseskinError as error:
            faults.append(f"{place(name)}{error}")
    if not faults:
        contradiction = _contradiction(values)
        if contradiction is not None:
            name, fault = contradiction
            faults.append(f"{place(name)}{fault}")
    if faults:
        raise SettingsError(*faults)

    return _design_of(values, states_pitch="pitch" in stated)


def _design_of(values: Mapping[str, Any], states_pitch: bool) -> Design:
    """The design of values that go together. A layout of points states the number of taxels, their
    places, and their distance, if that is not stated.
    """
    n_rows = values["n_rows"]
    n_cols = values["n_cols"]
    n_taxels = values["taxels"]
    pitch_m = values["pitch"]
    mask = None
    placement = values["points"]
    if placement is not None:
        n_taxels = placement.points.n
        mask = placement.skin(values["range"], "N").exists
        if not states_pitch:
            pitch_m = placement.pitch_m
    elif not n_taxels:
        n_taxels = n_rows * n_cols

    adc = replace(
        values["adc"], converters=values["converters"], settling_s=values["settling"]
    )
    return Design(
        n_rows=n_rows,
        n_cols=n_cols,
        n_taxels=n_taxels,
        pitch_m=pitch_m,
        rate_hz=values["rate"],
        noise_n=values["noise"],
        range_n=values["range"],
        adc=adc,
        sums=values["sums"],
        bits=values["bits"],
        bus=values["bus"],
        edge=values["edge"],
        cores=values["host"],
        mask=mask,
    )


def _contradiction(values: Mapping[str, Any]) -> tuple[str, str] | None:
    """A key that is missing or does not go with others, and the fault; None if there is none."""
    size_keys = [key for key in SIZE_KEYS if values[key] is not None]
    if not size_keys:
        return "n_rows", "is missing; state n_rows and n_cols, taxels, or points"
    if size_keys == ["n_rows"]:
        return "n_cols", "is missing; state n_rows and n_cols"
    if size_keys == ["n_cols"]:
        return "n_rows", "is missing; state n_rows and n_cols"
    if size_keys == ["n_rows", "n_cols"]:
        n_rows = values["n_rows"]
        n_cols = values["n_cols"]
        n = n_rows * n_cols
        if not 16 <= n <= MAX_TAXELS:
            return (
                "n_rows",
                f"{n_rows} x {n_cols} are {n} taxels; allowed: 16..{MAX_TAXELS}",
            )
    elif len(size_keys) > 1:
        return size_keys[-1], f"states the size once more; leave out {size_keys[0]}"

    noise = values["noise"]
    full_scale = values["range"]
    if not 1e-6 * full_scale <= noise <= 0.3 * full_scale:
        text = f"{noise:g} N is not allowed for a range of {full_scale:g} N"
        return "noise", f"{text}; allowed: 0.0001 to 30 % of it"
    return None
