"""A board as a source of frames, and what the name of a source states of it."""

import dataclasses
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SourceError, SparseskinError
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.device_clock import DeviceClock
from sparseskin.nodes.sensor.layout.arrangement import check_stated_shape
from sparseskin.nodes.sensor.layout.checks import NAN_HINT
from sparseskin.nodes.sensor.layout.layout import EMPTY, Layout
from sparseskin.nodes.sensor.source import LiveSource

from .can_port import CanPort, chunks_of
from .framing import Counts, Framing
from .ports import Arrived, Port
from .readings import Pieces
from .serial_port import SerialPort
from .settings import (
    BoardSettings,
    CanSettings,
    SerialSettings,
    StreamSettings,
    UdpSettings,
    profile_names,
    read_settings,
    split_source,
)
from .udp_port import UdpPort

RETRY_S = 0.25
"""Time between two attempts to open a device that is gone, seconds; chosen: soon for a person."""
SILENT_S = 2.0
"""Time without a frame after which one line says so, seconds; chosen as in the examples."""
MAX_WAITING = 1024
"""Most frames that wait to be used, chosen: 1 s at 1 kHz. No more are read while so many wait."""


PORTS: dict[str, type[Port]] = {
    "serial": SerialPort,
    "udp": UdpPort,
    "can": CanPort,
}


@dataclass(frozen=True)
class Board:
    """What the name of a source and the sensor's settings state of a board."""

    name: str
    kind: str
    address: str
    settings: BoardSettings
    decode: Callable[..., Floats]
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
        # The source and the settings of the sensor may both state these.
        size = {"n_rows": n_rows, "n_cols": n_cols}
        of_sensor: dict[str, Any] = {
            **size,
            "f_max": f_max,
            "unit": unit,
        }
        # What the source leaves out; the unit of counts says nothing.
        missing = {}
        for key, value in of_sensor.items():
            if value is not None and getattr(settings, key) in (None, "raw"):
                missing[key] = value
        settings = dataclasses.replace(settings, **missing)

        decoder = settings.decoder()
        skin = settings.skin()
        check_stated_shape(*skin.shape, n_rows, n_cols, "the source")
        for key in ("f_max", "unit"):
            of_source = getattr(settings, key)
            if of_sensor[key] not in (None, of_source):
                raise SourceError(
                    f"{key} = {of_sensor[key]} is stated, but the source has "
                    f"{of_source}"
                )

        framing = settings.framing(decoder.n_bytes)
        settings.check_port()
        # Contradictions of a bus are found before it is opened.
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


_PROFILE = next(iter(profile_names()), "NAME")
_FORMS = {
    "serial": f"serial:DEVICE?profile=NAME, as serial:/dev/ttyUSB0?profile={_PROFILE}",
    "udp": "udp:PORT?KEY=VALUE&KEY=VALUE, as udp:5005?n_rows=16&n_cols=16",
    "can": "can:CHANNEL?KEY=VALUE&KEY=VALUE, as can:can0?ids=0x100-0x11F&n_rows=16&n_cols=16",
}


class BoardSource(LiveSource):
    """The frames of a board. Its attributes are those of a `Source`.

    What comes is checked: a frame that is not whole, or that the layout refuses for a reading that
    is no number, is counted and dropped; readings outside [0, f_max] are clipped and counted
    (`clipped`), but for `raw`, as a calibration converts them. A device that goes away is waited
    for. Raises SourceError if its device is missing or cannot be opened.
    """

    arrives = True

    def __init__(self, board: Board, raw: bool = False, layout: Layout = EMPTY) -> None:
        check_board(board)
        super().__init__()
        self._raw = raw
        self._layout = layout
        self.name = board.name
        self.skin = board.skin
        self.counts = Counts()
        self.n_unused = 0
        self.n_not_finite = 0
        self.n_gone = 0
        self._board = board
        self._port = PORTS[board.kind](
            board.address, board.settings, board.framing, self.counts
        )
        self._pieces = self._pieces_of(board)
        stamp = board.framing.stamp
        if stamp is not None:
            # A counter begins at 0 again when its bytes are full.
            wrap = board.settings.stamp_wrap or 1 << 8 * stamp.n_bytes
            ns_per_tick = 1e9 / board.settings.stamp_hz
            self.clock = DeviceClock(self.name, self._lines.append, ns_per_tick, wrap)

        self._waiting: deque[Arrived] = deque()
        self._last_ns = -1
        self._is_open = False
        self._retry_at = 0.0
        self._gone_at = 0.0
        self._heard_at = time.monotonic()
        self._said_silent = False
        self._bytes_before = 0
        with naming_board(self.name):
            self._port.open()
        self._is_open = True

    @property
    def is_there(self) -> bool:
        return self._is_open

    def next_frame(
        self, wait_s: float, newest: bool = False
    ) -> tuple[int, Floats] | None:
        """The next frame, or the newest of those that wait, the others counted as unused; None if
        none came in `wait_s` seconds.

        Returns the time at which its last byte came on the monotonic clock, nanoseconds, which
        rises from frame to frame; readings in [0, f_max], float32 (n_rows, n_cols).
        """
        # The port is read ahead of the frames, so that the kernel drops none.
        if newest or len(self._waiting) < MAX_WAITING:
            self.receive(0.0 if self._waiting else wait_s)

        while newest and len(self._waiting) > 1:
            self._waiting.popleft()
            self.n_unused += 1

        while self._waiting:
            arrived_ns, frame = self._waiting.popleft()
            self.stamp = frame.stamp
            readings = self._board.decode(frame.payload, self._layout.missing_numbers)
            forces = self._checked(readings)
            if forces is not None:
                # Frames that came in one read have one time of arrival.
                self._last_ns = max(arrived_ns, self._last_ns + 1)
                return self._last_ns, forces
        return None

    def age_ns(self, arrived_ns: int) -> int:
        return max(0, time.monotonic_ns() - arrived_ns)

    def discard(self) -> None:
        self.receive(0.0)
        self.n_unused += len(self._waiting)
        self._waiting.clear()

    def receive(self, wait_s: float) -> None:
        if not self._is_open and not self._reopen(wait_s):
            return
        try:
            arrived = self._whole(self._port.receive(wait_s))
        except OSError:
            self._port.close()
            self._is_open = False
            self.n_gone += 1
            self._gone_at = time.monotonic()
            self._retry_at = self._gone_at + RETRY_S
            self._lines.append(f"{self.name}: the device is gone; waiting for it")
            return

        self._lines += (f"{self.name}: {line}" for line in self._port.lines)
        self._port.lines.clear()
        if arrived:
            self._heard_at = arrived[-1][0] / 1e9
            self._bytes_before = self._port.n_bytes
            if self._said_silent:
                self._said_silent = False
                self._lines.append(f"{self.name}: frames come again")
        elif not self._said_silent and time.monotonic() - self._heard_at > SILENT_S:
            self._said_silent = True
            self._lines.append(self._why_silent())
        self._waiting += arrived

    def _reopen(self, wait_s: float) -> bool:
        """Try to open a device that is gone; False if it is not back."""
        wait_left_s = self._retry_at - time.monotonic()
        if wait_left_s > 0:
            time.sleep(min(wait_s, wait_left_s))
            if wait_s < wait_left_s:
                return False

        self._retry_at = time.monotonic() + RETRY_S
        try:
            self._port.open()
        except SourceError:
            return False

        # A frame that had begun has lost its end.
        if self._pieces is not None:
            self._pieces.reset()
        self._is_open = True
        self._heard_at = time.monotonic()
        self._said_silent = False
        gone_s = self._heard_at - self._gone_at
        self._lines.append(f"{self.name}: is back after {gone_s:.1f} s")
        return True

    def _pieces_of(self, board: Board) -> Pieces | None:
        if not (isinstance(board.settings, StreamSettings) and board.settings.piece):
            return None
        n = board.skin.n_rows * board.skin.n_cols
        size = board.framing.payload_bytes // board.settings.piece
        sequence = board.framing.sequence
        modulus = 0
        if sequence is not None:
            modulus = 1 << 8 * sequence.n_bytes
        return Pieces(n, size, modulus, self.counts)

    def _whole(self, arrived: list[Arrived]) -> list[Arrived]:
        """The frames of the skin of those that arrived."""
        if self._pieces is None:
            return arrived
        frames = []
        for arrived_ns, piece in arrived:
            frame = self._pieces.add(piece)
            if frame is not None:
                frames.append((arrived_ns, frame))
        return frames

    def _why_silent(self) -> str:
        n_bytes = self._port.n_bytes - self._bytes_before
        self._bytes_before = self._port.n_bytes
        n = self._board.framing.n_bytes
        settings = self._board.settings
        # One frame may wait for the start bytes of the next.
        if n_bytes > n:
            baud = ", baud" if isinstance(settings, SerialSettings) else ""
            return (
                f"{self.name}: {n_bytes} bytes came, but no frame of {n} bytes: check start, "
                f"n_rows, n_cols, dtype, checksum{baud}{self._port.hint()}"
            )
        if isinstance(settings, UdpSettings) and settings.bind.startswith("127."):
            return (
                f"{self.name}: no packet for {SILENT_S:g} s; for a board on the network add "
                "bind=ADDRESS of this host"
            )
        return f"{self.name}: nothing came for {SILENT_S:g} s"

    def _checked(self, forces: Floats) -> Floats | None:
        """Readings clipped to the range; None if one is no number, and that is refused."""
        f_max = self.skin.f_max
        # False for a NaN.
        if 0 <= forces.min() <= forces.max() <= f_max:
            return forces

        missing = ~np.isfinite(forces)
        if missing.any() and not self._layout.accepts_missing:
            # One line for all frames: they may come at 1 kHz.
            if not self.n_not_finite:
                self._lines.append(
                    f"{self.name}: a frame is dropped, as a reading is no number; "
                    f"{NAN_HINT}"
                )
            self.n_not_finite += 1
            return None

        # An infinite reading is missing, too.
        forces[missing] = np.nan
        if self._raw:
            return forces
        self.clipped.add(forces, 0.0, f_max)
        return np.clip(forces, 0, f_max).astype(np.float32)

    def figures(self) -> dict[str, int]:
        """Counters: those of `Counts`; unused_frames (before the start, while paused, or faster
        than rate_hz), not_finite_frames, gone (times that the device went away); drops of kernel
        and driver.
        """
        return {
            **asdict(self.counts),
            "unused_frames": self.n_unused,
            "not_finite_frames": self.n_not_finite,
            "gone": self.n_gone,
            **self._port.lost(),
        }

    def dropped(self) -> str:
        return dropped_text(self.figures())

    def report(self) -> dict[str, Any]:
        figures = self.figures()
        lines = []
        dropped = dropped_text(figures)
        if dropped:
            lines.append(f"dropped: {dropped}")
        if self.n_gone:
            times = "time" if self.n_gone == 1 else "times"
            lines.append(f"the device was gone {self.n_gone} {times}")
        return {"board": figures, "lines": lines}

    def close(self) -> None:
        self.n_unused += len(self._waiting)
        self._waiting.clear()
        self._port.close()

    def __iter__(self) -> Iterator[tuple[int, Floats]]:
        """Yield (stamp_ns, forces) for ever: nanoseconds since the first frame, and readings."""
        first_ns: int | None = None
        while True:
            frame = self.next_frame(RETRY_S)
            if frame is None:
                continue
            stamp_ns, forces = frame
            if first_ns is None:
                first_ns = stamp_ns
            yield stamp_ns - first_ns, forces


def dropped_text(figures: dict[str, int]) -> str:
    """What a board's figures state as dropped, in words; "" if nothing was."""
    words = {
        "bad_frames": "bad frames",
        "missing_frames": "missing frames",
        "late_frames": "late frames",
        "not_finite_frames": "frames with a reading that is no number",
        "other_senders": "packets of other senders",
        "kernel_packets": "packets dropped by the kernel",
        "port_errors": "errors of the port",
        "dropped_bytes": "bytes",
    }
    # Counters that stayed at zero are not named.
    keys = [key for key in words if figures.get(key)]
    return ", ".join(f"{figures[key]} {words[key]}" for key in keys)
