"""Settings of a board: what its frames look like, and the port that they come from.

They are stated in the name of the source, serial:DEVICE?KEY=VALUE&KEY=VALUE, and in a profile, a
TOML file of the same keys; the name of the source goes before the profile.
"""

import dataclasses
import ipaddress
import re
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from sparseskin.launch.attach.text import typed_value
from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SourceError, SparseskinError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.sensor.layout.arrangement import (
    Arrangement,
    Axis,
    arrange,
    check_grid,
)
from sparseskin.nodes.sensor.layout.checks import check_unit, shown
from sparseskin.nodes.sensor.layout.layout import GridLayout, Layout
from sparseskin.nodes.settings import Settings, setting
from sparseskin.nodes.toml import MAX_CHARS, parse_toml

from .checksums import CHECKSUMS
from .framing import Field, Framing
from .readings import DTYPES, Decoder

MAX_AT = 4096
"""Largest place of a number in a frame."""
PROFILES = Path(__file__).parent / "profiles"
MAX_FIXED_BYTES = 64
"""Most start or end bytes."""
NUMBERS = ("none", "u8", "u16", "u32")
STAMPS = ("none", "sequence", "u8", "u16", "u24", "u32", "u48", "u64")
PARTS = ("start", "sequence", "payload")
AT = "bytes from the begin of the frame"


@dataclass(frozen=True)
class BoardSettings(GridLayout):
    """Settings of every board."""

    start: str = setting(
        "", "bytes that begin each frame, hexadecimal: AA55; ??: any byte"
    )
    sequence: str = setting(
        "none", "number of the frame, after the start bytes", choices=NUMBERS
    )
    sequence_at: int | None = setting(
        None, f"place of the number: {AT}", low=0, high=MAX_AT
    )
    skip: int = setting(
        0, "bytes before the readings that are not used", low=0, high=1024
    )
    after: int = setting(
        0, "bytes after the readings that are not used", low=0, high=1024
    )
    stamp: str = setting(
        "none",
        "time on the board's clock; sequence: its number, if a timer sends",
        choices=STAMPS,
    )
    stamp_at: int | None = setting(
        None, f"place of the stamp: {AT}", low=0, high=MAX_AT
    )
    stamp_hz: float = setting(
        1e6, "ticks of the board's clock a second", low=1e-3, high=1e10
    )
    stamp_wrap: int | None = setting(
        None, "ticks until it is 0 again; else 2^bits", low=2
    )
    checksum: str = setting(
        "none", "checksum after the readings", choices=tuple(CHECKSUMS)
    )
    checksum_from: str = setting(
        "sequence",
        "first part that the checksum covers; the last are the readings",
        choices=PARTS,
    )
    confirm: bool = setting(
        True,
        "without a CRC: wait for the next frame; false: one that lost bytes may get through",
    )
    end: str = setting("", "bytes that end each frame, hexadecimal: 0D0A")
    dtype: str = setting("uint8", "type of a reading", choices=DTYPES)
    byte_order: str = setting(
        "little", "order of the bytes of a number", choices=("little", "big")
    )
    zero: float = setting(0.0, "count of an untouched taxel", low=-1e30, high=1e30)
    scale: float = setting(
        1.0, "reading of a count; below 0: a press lowers them", low=-1e30, high=1e30
    )
    unit: str = setting("raw", "unit of the readings")
    pitch_mm: float | None = setting(None, "distance of two taxels", low=1e-3, high=1e3)

    needs_start: ClassVar[bool] = False

    def decoder(self) -> Decoder:
        """Decoder of the readings; SourceError if a key is missing or wrong."""
        if self.n_rows is None or self.n_cols is None:
            key = "n_rows" if self.n_rows is None else "n_cols"
            raise SourceError(
                f"{key} is not stated; add {key}=NUMBER, or profile=NAME of a board that "
                "has its size (sparseskin sources lists them)"
            )
        check_grid(self.n_rows, self.n_cols, "n_rows, n_cols")
        check_unit("unit", self.unit)
        places = self.places()
        return Decoder(self.dtype, self.byte_order, places, self.scale, self.zero)

    def places(self) -> Arrangement:
        """Places of the readings in a frame as it is sent."""
        # The keys of a layout are settings of a board, too.
        names = [field.name for field in dataclasses.fields(GridLayout)]
        layout = Layout(**{name: getattr(self, name) for name in names})
        return arrange(layout, [Axis(self.n_stated or 0)], "the frame")

    def skin(self) -> Skin:
        """The skin, of stated rows and columns; SourceError if its range is not known."""
        f_max = self.f_max
        dtype = np.dtype(self.dtype)
        if f_max is None and dtype.kind == "f":
            raise SourceError(
                f"f_max is not stated, and {self.dtype} has no largest value"
            )
        if f_max is None:
            # With a scale below 0 the least count is the largest reading.
            ends = (np.iinfo(dtype).min, np.iinfo(dtype).max)
            f_max = max(float((end - self.zero) * self.scale) for end in ends)
        if not f_max > 0:
            raise SourceError(
                f"zero = {self.zero:g} leaves no range: the largest reading is {f_max:g}"
            )
        pitch_m = None
        if self.pitch_mm is not None:
            pitch_m = self.pitch_mm / 1000
        return Skin(self.n_rows or 0, self.n_cols or 0, f_max, self.unit, pitch_m)

    def framing(self, n_bytes: int) -> Framing:
        """Framing of a payload of so many bytes; SourceError if a key is wrong."""
        # Pairs may be separated for the eye: AA 55.
        digits = "".join(self.start.split())
        pairs = [digits[k : k + 2] for k in range(0, len(digits), 2)]
        free_places = frozenset(k for k, pair in enumerate(pairs) if pair == "??")
        for k in free_places:
            pairs[k] = "00"
        start = _bytes_of("start", "".join(pairs))
        if self.needs_start and not start:
            raise SourceError(
                "start is not stated; add start=HEX, the bytes that begin a frame"
            )
        if 0 in free_places:
            raise SourceError("start: the first byte has to be stated")

        framing = Framing(
            n_bytes,
            start=start,
            wild=free_places,
            end=_bytes_of("end", self.end),
            sequence_bytes=n_bytes_of(self.sequence),
            sequence_at=self.sequence_at,
            skip=self.skip,
            after=self.after,
            checksum=self.checksum,
            checksum_from=typing.cast(Any, self.checksum_from),
            byte_order="big" if self.byte_order == "big" else "little",
            confirm=self.confirm,
        )
        # Places of numbers can be checked once that of the readings is known.
        fields: dict[str, Any] = {}
        for key, (kind, at) in self.fields().items():
            fields[key] = self._field(framing, key, kind, at)
        del fields["sequence"]
        return dataclasses.replace(framing, **fields)

    def fields(self) -> dict[str, tuple[str, int | None]]:
        """Types and places of the numbers in a frame, by their keys."""
        # After the start bytes, it has no place that could be wrong.
        kind = "none" if self.sequence_at is None else self.sequence
        return {
            "sequence": (kind, self.sequence_at),
            "stamp": (self.stamp, self.stamp_at),
        }

    def _field(
        self, framing: Framing, key: str, kind: str, at: int | None
    ) -> Field | None:
        """Place of a number; SourceError if it is missing, or not outside the readings."""
        if kind == "sequence" and framing.sequence is None:
            raise SourceError(f"{key}: frames have no number; add sequence=u16")
        if kind == "sequence":
            return framing.sequence
        if kind == "none":
            return None

        n = n_bytes_of(kind)
        begin = framing.payload_at
        end = begin + framing.payload_bytes
        place = "is not stated"
        if at is not None:
            if at + n <= begin or end <= at <= end + framing.after - n:
                return Field(at, n)
            place = str(at)
        raise SourceError(
            f"{key}_at: {place}; allowed are the {n} bytes of {key} before the readings, "
            f"0..{begin - n}, or after them: skip, after"
        )

    def check_port(self) -> None:
        """Raise SourceError if a key of the port is wrong."""


@dataclass(frozen=True)
class StreamSettings(BoardSettings):
    """Settings of a board that sends frames of any length: a serial port, UDP."""

    piece: int | None = setting(
        None, "readings, of a piece of the skin", low=1, high=1 << 20
    )
    first: str = setting(
        "none", "number of the first reading of a piece", choices=NUMBERS
    )
    first_at: int | None = setting(
        None, f"place of that number: {AT}", low=0, high=MAX_AT
    )
    length: str = setting(
        "none", "bytes from readings to checksum, if they vary", choices=NUMBERS
    )
    length_at: int | None = setting(
        None, f"place of the length: {AT}", low=0, high=MAX_AT
    )

    def fields(self) -> dict[str, tuple[str, int | None]]:
        of_stream = {
            "first": (self.first, self.first_at),
            "length": (self.length, self.length_at),
        }
        return super().fields() | of_stream

    def framing(self, n_bytes: int) -> Framing:
        itemsize = np.dtype(self.dtype).itemsize
        n_all = n_bytes // itemsize
        n = n_all if self.piece is None else self.piece
        # A piece is put in its place by the number of its first reading.
        if (self.piece is None) != (self.first == "none") or n > n_all:
            raise SourceError(
                f"piece: goes with first=u16, and is at most {n_all}, the readings of the skin"
            )

        framing = super().framing(n * itemsize)
        # A wrong length would hide where the next frame begins.
        if framing.length and self.needs_start and not framing.is_strong:
            raise SourceError(
                "length: needs a CRC of 16 bits or more; add checksum=crc16"
            )
        return framing


@dataclass(frozen=True)
class SerialSettings(StreamSettings):
    """Settings of a board on a serial port."""

    baud: int = setting(115200, "bits a second", low=50, high=50_000_000)
    needs_start: ClassVar[bool] = True


@dataclass(frozen=True)
class UdpSettings(StreamSettings):
    """Settings of a board that sends UDP packets, each of one frame or several."""

    bind: str = setting(
        "127.0.0.1", "address of this host to receive at; 0.0.0.0 for all"
    )
    sender: str | None = setting(
        None, "address of the board; packets of others are dropped"
    )

    def check_port(self) -> None:
        for key in ("bind", "sender"):
            value = getattr(self, key)
            if value is None:
                continue
            try:
                ipaddress.IPv4Address(value)
            except ValueError:
                raise SourceError(f"{key}: {shown(value)} is no IPv4 address") from None


@dataclass(frozen=True)
class CanSettings(BoardSettings):
    """Settings of a board on a CAN bus: a frame of the skin is spread over several CAN frames."""

    ids: str = setting(
        "", "arbitration ids in order of the readings: 0x100-0x10F, or 0x100,0x102"
    )
    chunk: int | None = setting(
        None, "bytes of it in a CAN frame; all that fit", low=1, high=64
    )
    index: str = setting(
        "none",
        "number of the chunk, first in each CAN frame",
        choices=("none", "u8", "u16"),
    )
    counter: str = setting(
        "none",
        "number of the skin's frame, next in each CAN frame",
        choices=("none", "u8"),
    )
    fd: bool = setting(False, "CAN-FD: up to 64 bytes a CAN frame")
    interface: str = setting(
        "socketcan", "interface of python-can: socketcan, slcan, pcan ..."
    )
    bitrate: int | None = setting(
        None,
        "bits a second; of socketcan it is that of the interface",
        low=1000,
        high=20_000_000,
    )


KINDS: dict[str, type[BoardSettings]] = {
    "serial": SerialSettings,
    "udp": UdpSettings,
    "can": CanSettings,
}
"""Settings by the begin of the source's name."""


def n_bytes_of(kind: str) -> int:
    """Bytes of a type of numbers, as u16; 0 of none."""
    if kind == "none":
        return 0
    return int(kind[1:]) // 8


def _bytes_of(key: str, text: str) -> bytes:
    try:
        data = bytes.fromhex(text)
    except ValueError:
        raise SourceError(
            f"{key}: {shown(text)} is not allowed; allowed are pairs of hexadecimal digits, "
            "e.g. AA55"
        ) from None
    if len(data) > MAX_FIXED_BYTES:
        raise SourceError(f"{key}: {len(data)} bytes; at most {MAX_FIXED_BYTES}")
    return data


def split_source(source: str) -> tuple[str, str, dict[str, str]]:
    """Kind, address and query of "KIND:ADDRESS?KEY=VALUE&KEY=VALUE". Raises SourceError if a part
    of the query is no KEY=VALUE, or a key is stated twice.
    """
    kind, _, target = source.partition(":")
    address, _, query = target.partition("?")
    values: dict[str, str] = {}
    for part in query.split("&") if query else ():
        key, equals, value = part.partition("=")
        if not (key and equals):
            raise SourceError(f"{kind}:{address}: {shown(part)} is no KEY=VALUE")
        if key in values:
            raise SourceError(f"{kind}:{address}: {key} is stated twice")
        values[key] = value
    return kind, address, values


def read_settings(kind: str, query: Mapping[str, str]) -> BoardSettings:
    """Settings of a kind of board, by query and profile; SparseskinError if not allowed."""
    cls = KINDS[kind]
    of_query = dict(query)
    # What the source states goes before what the profile does.
    profile = of_query.pop("profile", None)
    of_profile = {}
    if profile is not None:
        of_profile = read_profile(profile, cls)
    return cls.from_mapping(of_profile | typed(cls, of_query, "profile"))


def typed(cls: type[Settings], query: Mapping[str, str], *more: str) -> dict[str, Any]:
    """Texts of a query as a class's settings; SourceError of other keys (`more`: ones to
    propose).
    """
    entries = {entry["key"]: entry for entry in cls.described()}
    for key in query:
        if key not in entries:
            raise SourceError(
                f"{key}: unknown key{did_you_mean(key, [*entries, *more])}"
            )
    return {key: typed_value(text, entries[key]) for key, text in query.items()}


def read_profile(name: str, cls: type[BoardSettings]) -> dict[str, Any]:
    """Settings of a profile for boards of a class, without `about` and keys of other ports: its
    name if it comes with the package, or the path of a .toml file. Raises SourceError if there is
    none, or it is no TOML of known keys.
    """
    is_path = name.endswith(".toml") or "/" in name
    path = Path(name) if is_path else PROFILES / f"{name}.toml"
    # A bare name must not lead out of the folder of profiles.
    is_name = re.fullmatch(r"\w+", name) is not None
    if not is_path and not (is_name and path.is_file()):
        hint = did_you_mean(name, profile_names())
        raise SourceError(
            f"profile: there is no {shown(name)}{hint}; or the path of a .toml file"
        )

    # One profile may serve a board by several ports.
    all_keys: set[str] = set()
    for kind in KINDS.values():
        all_keys |= {field.name for field in dataclasses.fields(kind)}
    values = read_toml(path)
    values.pop("about", None)
    for key, value in values.items():
        if key not in all_keys:
            hint = did_you_mean(key, all_keys)
            raise SourceError(f"profile {name}: {key}: unknown key{hint}")
        # A list of arbitration ids is a text in the name of a source.
        if isinstance(value, list):
            values[key] = ",".join(map(str, value))

    # A profile may also state keys of other ports.
    fields = {field.name for field in dataclasses.fields(cls)}
    of_class = {key: value for key, value in values.items() if key in fields}
    try:
        cls.from_mapping(of_class)
    except SparseskinError as error:
        raise SourceError(f"profile {name}: {error}") from error
    return of_class


def read_toml(path: Path) -> dict[str, Any]:
    """A profile as it is written; SourceError if it cannot be read."""
    try:
        if not path.is_file():
            raise SourceError(f"profile: {path}: no such file")
        with path.open("rb") as file:
            # Bounded: the path may be that of any file.
            raw = file.read(MAX_CHARS + 1)
        return parse_toml(raw.decode("utf-8"))
    except OSError as error:
        raise SourceError(
            f"profile: {path}: cannot be read ({error.strerror})"
        ) from error
    except ValueError as error:
        raise SourceError(f"profile: {path}: no TOML ({shown(error, 120)})") from error


def profile_names() -> list[str]:
    """Names of the profiles that come with the package."""
    return sorted(path.stem for path in PROFILES.glob("*.toml"))
