"""Addresses of boards: serial:DEVICE, udp:PORT and can:CHANNEL."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sparseskin.messages.text import printable
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
        layout = self.layout
        stated: dict[str, Any] = {"unit": layout.unit, "f_max": layout.f_max}
        return describe_board(
            self.source, n_rows=layout.n_rows, n_cols=layout.n_cols, **stated
        )

    @classmethod
    def ports(cls) -> Iterable[str]:
        """Addresses of this host that such a board may be at."""
        return ()

    @classmethod
    def completions(cls, prefix: str) -> Mapping[str, str]:
        address, query, _ = prefix.partition("?")
        if not query:
            return dict.fromkeys(cls.ports(), "")
        start = f"{address}?"
        if "&" in prefix:
            stated_keys, _, _ = prefix.rpartition("&")
            start = f"{stated_keys}&"
        profiles = {f"{start}profile={name}": "" for name in profile_names()}
        settings = KINDS[address.partition(":")[0]].described()
        return profiles | {
            f"{start}{entry['key']}=": entry["doc"] for entry in settings
        }


class SerialAddress(BoardAddress):
    """A board on a serial port."""

    form = "serial:DEVICE"

    @classmethod
    def ports(cls) -> Iterable[str]:
        return (f"serial:{path}?" for path in serial_devices())

    @classmethod
    def listings(cls) -> Sequence[Listing]:
        devices = serial_devices()
        text_of_path = dict.fromkeys(devices, "")
        try:
            from serial.tools.list_ports import comports
        except ImportError:
            missing = "pyserial is not installed: pip install 'sparseskin[serial]'"
            text_of_path = dict.fromkeys(text_of_path, missing)
        else:
            descriptions = {
                port.device: port.description
                for port in comports()
                if port.hwid != "n/a"
            }
            names = {device: name for name, device in devices.items()}
            for device, text in descriptions.items():
                text_of_path[names.get(device, device)] = "" if text == "n/a" else text

        ports = [
            {"source": f"serial:{path}", "about": printable(text)}
            for path, text in sorted(text_of_path.items())
        ]
        profiles = []
        for name in profile_names():
            profile = read_toml(PROFILES / f"{name}.toml")
            profiles.append({"name": name, "about": str(profile.get("about", ""))})
        about = "profiles of boards: for ?profile=NAME; or the path of a .toml file"
        return (
            Listing("serial", "serial ports: add ?profile=NAME", ports),
            Listing("profiles", about, profiles),
        )


class UdpAddress(BoardAddress):
    """A board that sends packets."""

    form = "udp:PORT"

    @classmethod
    def listings(cls) -> Sequence[Listing]:
        about = "packets that come to a port of this host"
        entries = [{"source": "udp:PORT?n_rows=R&n_cols=C", "about": about}]
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
