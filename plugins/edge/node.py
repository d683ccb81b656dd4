"""The edge node: measurements of a compressor outside the graph, from its frames on a wire."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.messages import Measurements, Message, PhiState, SkinState, topic_of
from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import did_you_mean, suggestion
from sparseskin.nodes.node import Context, SourceNode, Tick
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.settings import PatchSettings, naming, setting
from sparseskin.plugins.boards.settings import read_settings, split_source
from sparseskin.plugins.boards.source import Board, BoardSource, naming_board
from sparseskin.plugins.boards.udp_port import UdpPort

from .description import EdgeDescription, framing_of, read_frame, stated

COUNTS = "counts"
WAIT_S = 0.05
"""Longest wait for a frame, seconds; chosen as for boards: commands and signals wait no longer."""


KEYS = {"serial": ("baud",), "udp": ("bind", "sender")}
"""Kinds of wires, and what may be stated of each."""


def describe_wire(source: str, description: EdgeDescription, skin: Skin) -> Board:
    """Describe the wire "serial:DEVICE[?baud=NUMBER]" or "udp:PORT[?bind=ADDRESS]", without opening
    it; `skin`: the one whose forces are measured. Raises SourceError if the source has another
    form, or a key or value is not allowed.
    """
    kind, address, query = split_source(source)
    if kind not in KEYS or not address:
        hint = ""
        if kind not in KEYS:
            hint = suggestion(kind, KEYS)
        raise SourceError(f'"{source}": expected serial:DEVICE or udp:PORT{hint}')
    name = f"{kind}:{address}"
    with naming_board(name):
        # Frames of an edge have one form, so that only the port can be stated.
        for key in query:
            if key not in KEYS[kind]:
                raise SourceError(f"{key}: unknown key{did_you_mean(key, KEYS[kind])}")
        settings = read_settings(kind, query)
        settings.check_port()
        if kind == "udp":
            UdpPort.check(address, settings)
    framing = framing_of(description)
    return Board(name, kind, address, settings, _undecoded, framing, skin)


def _undecoded(*_: object) -> Floats:
    """No readings: a payload is taken whole."""
    return np.empty(0, np.float32)


class EdgeWire(BoardSource):
    """Payloads from a wire; the device, lost and damaged frames are treated as of other boards."""

    def next_payload(self, wait_s: float) -> tuple[int, bytes] | None:
        """Time at which the last byte of the next payload came on the monotonic clock, nanoseconds,
        and the payload; None if none came in `wait_s` seconds.
        """
        if not self._waiting:
            self.receive(wait_s)
        if not self._waiting:
            return None
        arrived_ns, frame = self._waiting.popleft()
        return arrived_ns, frame.payload


@dataclass(frozen=True)
class EdgeSettings(PatchSettings):
    """Settings of the edge node."""

    source: str = setting(
        "serial:/dev/ttyACM0",
        "where its frames come from: serial:DEVICE?baud=NUMBER, or udp:PORT?bind=ADDRESS",
        decides=True,
    )
    description: str = setting("edge.toml", "file that was exported with its program")
    unit: str | None = setting(None, "unit of the forces; counts if not stated")
    f_max: float | None = setting(
        None,
        "force at full scale, in that unit; not stated: the largest count",
        low=1e-9,
        high=1e9,
    )
    pitch_m: float | None = setting(
        None, "distance between neighbouring taxels, metres", low=1e-6, high=10.0
    )

    def check(self) -> None:
        with naming("description"):
            # Read here, so that a wrong file is reported before any process starts.
            described = EdgeDescription.read(Path(self.description))
        with naming("source"):
            describe_wire(self.source, described, self.skin(described))

    def skin(self, described: EdgeDescription) -> Skin:
        """The skin whose forces are measured."""
        f_max = self.f_max
        if f_max is None:
            f_max = float(described.full_scale)
        mask = None if described.mask is None else described.exists
        unit = self.unit or COUNTS
        return Skin(described.n_rows, described.n_cols, f_max, unit, self.pitch_m, mask)


class Edge(SourceNode[EdgeSettings]):
    """Publishes /PATCH/skin and /PATCH/phi once, then /PATCH/measurements.

    The stamp of a frame is the time at which its last byte was read. Frames of another matrix than
    those described are counted and never published.
    """

    Settings = EdgeSettings

    def __init__(self, settings: EdgeSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._described = EdgeDescription.read(Path(settings.description))
        self.skin = settings.skin(self._described)
        # Force of one count: full scale is the largest count.
        self._of_count = self.skin.f_max / self._described.full_scale
        self._n_frames = 0
        self._n_other = 0
        self._n_logged = 0
        self._stamp_ns = 0
        with naming("source"):
            board = describe_wire(settings.source, self._described, self.skin)
            self._wire = EdgeWire(board)

    @classmethod
    def outputs(cls, settings: EdgeSettings) -> tuple[str, ...]:
        messages = (SkinState, PhiState, Measurements)
        return tuple(topic_of(settings.patch, message.schema) for message in messages)

    @classmethod
    def facts(cls, settings: EdgeSettings) -> Mapping[str, Any]:
        described = EdgeDescription.read(Path(settings.description))
        skin, phi, measurements = cls.outputs(settings)
        # Known from the file, before the first frame.
        rows_and_m = (described.rows, described.m)
        return {
            skin: described.n_taxels,
            phi: described.phi.kind,
            measurements: lambda n: rows_and_m,
        }

    def start(self) -> Iterable[Message]:
        d = self._described
        s = self.settings
        # Both states are of the moment at which the node starts.
        stamp_ns = self.context.clock.now_ns()
        yield SkinState(
            stamp_ns=stamp_ns,
            patch=s.patch,
            **vars(self.skin),
            source=self._wire.name,
            seed=0,
            rate_hz=0.0,
            has_truth=False,
            has_taxels=False,
            live=True,
            sigma_mid=0.0,
            sigma_end=0.0,
        )
        yield PhiState(
            stamp_ns=stamp_ns,
            patch=s.patch,
            kind=d.phi.kind,
            n=d.phi.n,
            m=d.phi.m,
            block=d.block,
            seed=d.seed,
            fingerprint=d.phi.fingerprint,
            rows=d.rows,
            rule=d.rule,
        )

    @property
    def follows_readers(self) -> bool:
        # What arrives does not wait: its frames would be lost where nobody counts them.
        return False

    def tick(self, tick: Tick) -> Iterable[Message]:
        arrived = self._wire.next_payload(WAIT_S)
        self._log_lines()
        self.acquired = False
        if arrived is None:
            return

        arrived_ns, payload = arrived
        frame = read_frame(self._described, payload)
        self.acquired = frame is not None
        if frame is None:
            self._n_other += 1
            self._log_other(payload)
            return

        self._n_frames += 1
        now_ns = self.context.clock.now_ns()
        # Stamps rise from frame to frame.
        self._stamp_ns = max(now_ns - self._wire.age_ns(arrived_ns), self._stamp_ns + 1)
        yield Measurements(
            stamp_ns=self._stamp_ns,
            patch=self.settings.patch,
            y=frame.measurements(self._described.bits, self._of_count),
            phi=frame.phi,
        )

    def idle(self) -> None:
        # Frames that come while it is paused are dropped, and counted as unused.
        if self.paused:
            self._wire.discard()
        self._log_lines()

    def status(self) -> str:
        d = self._described
        dropped = self._wire.dropped()
        text = f"{self._wire.name}: frame {self._n_frames}, {d.m} of {d.bits} bits"
        if self._n_other:
            text += f"; {self._n_other} of another matrix"
        if dropped:
            text += f"; dropped: {dropped}"
        if not self._wire.is_there:
            text += "; the device is gone"
        return text

    def report(self) -> dict[str, Any]:
        figures = self._wire.figures()
        figures |= {"frames": self._n_frames, "other_matrix": self._n_other}
        return {**self._wire.report(), "board": figures}

    def close(self, counts: dict[str, Any]) -> None:
        self._wire.close()

    def _log_lines(self) -> None:
        for line in self._wire.take_lines():
            self.context.log(line)

    def _log_other(self, payload: bytes) -> None:
        """Log frames of another matrix, each time that their number has doubled."""
        if self._n_other <= 2 * self._n_logged:
            return
        self._n_logged = self._n_other
        # Both are named, so that a person sees which of the two is old.
        described = ", ".join(f"{tag:08x}" for tag in self._described.tags)
        self.context.log(
            f"{self._wire.name}: {self._n_other} frames of another matrix (the last "
            f"{stated(payload)}; described {described}): is {self.settings.description} that "
            "of the program on the board?"
        )
