"""What the name of a source states of a board: serial:DEVICE, udp:PORT or can:CHANNEL."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SourceError, SparseskinError
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.files.recording import check_stated_shape

from .can_port import CanPort, chunks_of
from .framing import Framing
from .ports import Port
from .serial_port import SerialPort
from .settings import BoardSettings, CanSettings, profile_names, read_settings, split_source
from .udp_port import UdpPort

PORTS: dict[str, type[Port]] = {"serial": SerialPort, "udp": UdpPort, "can": CanPort}


@dataclass(frozen=True)
class Board:
    """What the name of a source and the sensor's settings state of a board."""

    name: str
    kind: str
    address: str
    settings: BoardSettings
    decode: Callable[[bytes], Floats]
    framing: Framing
    skin: Skin


def describe_board(
    source: str,
    *,
    n_rows: int | None = None,
    n_cols: int | None = None,
    unit: str | None = None,
    f_max: float | None = None,
) -> Board:
    """Read all that is stated of a board, "serial:DEVICE?KEY=VALUE&...", "udp:PORT?..." or
    "can:CHANNEL?...", without opening it; n_rows, n_cols, unit, f_max: what the source may leave
    out. Raises SourceError if a key or value is not allowed, one is missing, or two contradict each
    other.
    """
    kind, address, query = split_source(source)
    name = f"{kind}:{address}"
    with naming_board(name):
        if not address:
            raise SourceError("nothing follows; expected " + _FORMS[kind])
        settings = read_settings(kind, query)
        given: dict[str, Any] = {"rows": n_rows, "cols": n_cols, "f_max": f_max, "unit": unit}
        own = {key for key in given if getattr(settings, key) not in (None, "raw")}
        missing = {k: v for k, v in given.items() if v is not None and k not in own}
        settings = dataclasses.replace(settings, **missing)
        decoder = settings.decoder()
        skin = settings.skin()
        check_stated_shape(*skin.shape, n_rows, n_cols, "the source")
        for key in ("f_max", "unit"):
            found = getattr(settings, key)
            if given[key] not in (None, found):
                raise SourceError(f"{key} = {given[key]} is stated, but the source has {found}")
        framing = settings.framing(decoder.n_bytes)
        settings.check_port()
        if isinstance(settings, CanSettings):
            chunks_of(settings, framing)
        return Board(name, kind, address, settings, decoder, framing, skin)


def check_board(board: Board) -> None:
    """Raise SourceError if the port of a board is not there, or cannot be opened by this user."""
    with naming_board(board.name):
        PORTS[board.kind].check(board.address, board.settings)


@contextmanager
def naming_board(name: str) -> Iterator[None]:
    try:
        yield
    except SparseskinError as error:
        raise SourceError(f"{name}: {error}") from error


_FORMS = {
    "serial": "serial:DEVICE?profile=NAME, as serial:/dev/ttyUSB0?profile="
    + next(iter(profile_names()), "NAME"),
    "udp": "udp:PORT?KEY=VALUE&KEY=VALUE, as udp:5005?rows=16&cols=16",
    "can": "can:CHANNEL?KEY=VALUE&KEY=VALUE, as can:can0?ids=0x100-0x11F&rows=16&cols=16",
}
