"""The edge node: measurements of a compressor outside the graph, from its frames on a wire."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sparseskin.messages import Measurements, Message, PhiState, SkinState, topic_of
from sparseskin.nodes.node import Context, SourceNode, Tick
from sparseskin.nodes.settings import PatchSettings, naming, setting

from .description import EdgeDescription
from .frames import EdgeFrame, FrameReader
from .line import check_line, open_line

COUNTS = "counts"
FAULTS = {
    "missing_frames": "never came",
    "bad_frames": "had a wrong checksum",
    "other_matrix": "are of another matrix",
}


@dataclass(frozen=True)
class EdgeSettings(PatchSettings):
    """Settings of the edge node."""

    source: str = setting(
        "serial:/dev/ttyACM0", "where its frames come from: serial:DEVICE or udp:PORT", decides=True
    )
    description: str = setting("edge.toml", "file that was exported with its program")
    baud: int = setting(2_000_000, "symbols a second of a serial line", low=9600, high=4_000_000)
    unit: str | None = setting(None, "unit of the forces; counts if not stated")
    f_max: float | None = setting(
        None, "force at full scale, in that unit; not stated: the largest count", low=1e-9, high=1e9
    )
    pitch_m: float | None = setting(
        None, "distance between neighbouring taxels, metres", low=1e-6, high=10.0
    )

    def check(self) -> None:
        with naming("source"):
            check_line(self.source)
        with naming("description"):
            EdgeDescription.read(Path(self.description))


class Edge(SourceNode[EdgeSettings]):
    """Publishes /PATCH/skin and /PATCH/phi once, then /PATCH/measurements.

    The stamp of a frame is the time at which it has been read. Frames of another matrix than those
    described are counted and never published.
    """

    Settings = EdgeSettings

    def __init__(self, settings: EdgeSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._description = EdgeDescription.read(Path(settings.description))
        self._reader = FrameReader(self._description)
        self._frames: deque[EdgeFrame] = deque()
        full_scale = self._description.full_scale
        self._f_max = float(full_scale) if settings.f_max is None else settings.f_max
        self._of_count = self._f_max / full_scale
        self._logged: dict[str, int] = {}
        with naming("source"):
            self._line = open_line(settings.source, settings.baud)

    @classmethod
    def outputs(cls, settings: EdgeSettings) -> tuple[str, ...]:
        return tuple(
            topic_of(settings.patch, cls.schema) for cls in (SkinState, PhiState, Measurements)
        )

    @classmethod
    def facts(cls, settings: EdgeSettings) -> Mapping[str, Any]:
        described = EdgeDescription.read(Path(settings.description))
        return {
            topic_of(settings.patch, SkinState.schema): described.n_taxels,
            topic_of(settings.patch, PhiState.schema): described.phi.kind,
            topic_of(settings.patch, Measurements.schema): lambda n: (described.rows, described.m),
        }

    def start(self) -> Iterable[Message]:
        d, s = self._description, self.settings
        stamp_ns = self.context.clock.now_ns()
        yield SkinState(
            stamp_ns=stamp_ns,
            patch=s.patch,
            n_rows=d.n_rows,
            n_cols=d.n_cols,
            f_max=self._f_max,
            unit=s.unit or COUNTS,
            pitch_m=s.pitch_m,
            mask=d.mask,
            source=s.source,
            seed=0,
            rate_hz=0.0,
            has_truth=False,
            has_taxels=False,
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
        )

    def tick(self, tick: Tick) -> Iterable[Message]:
        while not self._frames:
            data = self._line.read()
            if self._line.packets:
                found = self._reader.packet(data)
                self._frames.extend([] if found is None else [found])
            else:
                self._frames.extend(self._reader.feed(data))
            self._log_faults()
        frame = self._frames.popleft()
        yield Measurements(
            stamp_ns=max(tick.stamp_ns, self.context.clock.now_ns()),
            patch=self.settings.patch,
            y=frame.measurements(self._description.bits, self._of_count),
            phi=frame.phi,
        )

    def status(self) -> str:
        d, counts = self._description, self._counts()
        faults = "".join(f", {n} {FAULTS[name]}" for name, n in counts.items() if n)
        n = self._reader.n_frames
        return f"{self.settings.source}: frame {n}, {d.m} of {d.bits} bits{faults}"

    def report(self) -> dict[str, Any]:
        return {"frames": self._reader.n_frames, **self._counts()}

    def close(self, counts: dict[str, Any]) -> None:
        self._line.close()

    def _counts(self) -> dict[str, int]:
        reader = self._reader
        return {
            "missing_frames": reader.n_lost,
            "bad_frames": reader.n_damaged,
            "other_matrix": reader.n_strangers,
        }

    def _log_faults(self) -> None:
        """Log the number of each fault each time that it has doubled."""
        for name, n in self._counts().items():
            if n <= 2 * self._logged.get(name, 0):
                continue
            self._logged[name] = n
            line = f"{self.settings.source}: {n} frames {FAULTS[name]}"
            if name == "other_matrix":
                described = ", ".join(f"{tag:08x}" for tag in self._description.tags)
                line += (
                    f" (the last {self._reader.stranger}; described {described}): is "
                    f"{self.settings.description} that of the program on the board?"
                )
            self.context.log(line)
