"""Addresses of boards: serial:DEVICE, udp:PORT and can:CHANNEL."""

from collections.abc import Iterable, Mapping, Sequence

from sparseskin.messages.text import printable
from sparseskin.nodes.errors import not_installed
from sparseskin.nodes.sensor.source import Address, Listing

from .can_port import can_channels
from .serial_port import serial_devices
from .settings import KINDS, PROFILES, profile_names, read_toml
from .source import Board, BoardSource, check_board, describe_board


class BoardAddress(Address):
    """A board."""

    delivers = "taxels"
    keys = ("n_rows", "n_cols", "unit", "f_max", "missing", "nan")

    def check(self) -> None:
        check_board(self._board())

    def n_taxels(self) -> int:
        return self._board().skin.n_taxels

    def open(self) -> BoardSource:
        return BoardSource(self._board(), self.raw, self.layout)

    def _board(self) -> Board:
        keys = ("n_rows", "n_cols", "unit", "f_max")
        stated = {key: getattr(self.layout, key) for key in keys}
        return describe_board(self.source, **stated)

    @classmethod
    def ports(cls) -> Iterable[str]:
        """Addresses of this host that such a board may be at."""
        return ()

    @classmethod
    def completions(cls, prefix: str) -> Mapping[str, str]:
        address, query, _ = prefix.partition("?")
        # Ports are proposed until the question mark, keys after it.
        if not query:
            return dict.fromkeys(cls.ports(), "")
        start = f"{address}?"
        # Keys that are stated already stay as they are.
        if "&" in prefix:
            stated_keys, _, _ = prefix.rpartition("&")
            start = f"{stated_keys}&"
        words = {f"{start}profile={name}": "" for name in profile_names()}
        for entry in KINDS[address.partition(":")[0]].described():
            words[f"{start}{entry['key']}="] = entry["doc"]
        return words


class SerialAddress(BoardAddress):
    """A board on a serial port."""

    form = "serial:DEVICE"

    @classmethod
    def ports(cls) -> Iterable[str]:
        return (f"serial:{path}?" for path in serial_devices())

    @classmethod
    def listings(cls) -> Sequence[Listing]:
        ports = [
            {"source": f"serial:{path}", "about": printable(text)}
            for path, text in sorted(_texts_of_ports().items())
        ]
        profiles = []
        for name in profile_names():
            profile = read_toml(PROFILES / f"{name}.toml")
            profiles.append({"name": name, "about": str(profile.get("about", ""))})
        return (
            Listing("serial", "serial ports: add ?profile=NAME", ports),
            Listing(
                "profiles",
                "profiles of boards: for ?profile=NAME; or the path of a .toml file",
                profiles,
            ),
        )


def _texts_of_ports() -> dict[str, str]:
    """What is known of each serial port, by its path."""
    devices = serial_devices()
    try:
        from serial.tools.list_ports import comports
    except ImportError:
        return dict.fromkeys(devices, not_installed("pyserial", "serial"))

    texts = dict.fromkeys(devices, "")
    names = {device: name for name, device in devices.items()}
    for port in comports():
        # Ports without a hardware id are those of the mainboard: nothing need be at them.
        if port.hwid != "n/a":
            text = "" if port.description == "n/a" else port.description
            texts[names.get(port.device, port.device)] = text
    return texts


class UdpAddress(BoardAddress):
    """A board that sends packets."""

    form = "udp:PORT"

    @classmethod
    def listings(cls) -> Sequence[Listing]:
        entries = [
            {
                "source": "udp:PORT?n_rows=R&n_cols=C",
                "about": "packets that come to a port of this host",
            }
        ]
        return (Listing("udp", "boards on the network", entries),)


class CanAddress(BoardAddress):
    """A board on a CAN bus."""

    form = "can:CHANNEL"

    @classmethod
    def ports(cls) -> Iterable[str]:
        return (f"can:{name}?" for name in can_channels())

    @classmethod
    def listings(cls) -> Sequence[Listing]:
        title = "CAN interfaces: add ?ids=FIRST-LAST&n_rows=R&n_cols=C"
        entries = [
            {"source": f"can:{name}", "about": "CAN interface"}
            for name in can_channels()
        ]
        return (Listing("can", title, entries),)
