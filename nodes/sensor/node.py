"""The sensor node: acquires frames from a source and publishes the readings of the taxels."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from sparseskin.messages import Message, SkinState, Taxels, Truth, topic_of
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.node import Context, SourceNode, Tick
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.settings import PatchSettings, naming, setting

from .boards.board import describe_board, is_board
from .boards.source import BoardSource, dropped_text
from .driver import DriverSource
from .files.head import n_taxels
from .files.parsed import NAN_WAYS, NEGATIVE_WAYS, Policy
from .files.recorded import RecordedSource
from .noise import NoiseModel
from .sources import FILE, SCENE, check_source, open_source

DEFAULT_RATE_HZ = 100.0
"""Frame rate of scenes and of recordings without a rate of their own."""
RATE_S = 2.0
"""Time after which the rate reached is compared with the one asked, in seconds; chosen, so that a
short delay at the start is made up for before."""
KEPT_RATE = 0.9
"""Share of the rate asked below which the sensor logs a warning."""
WAIT_S = 0.05
"""Longest wait for a frame of a board, seconds; chosen: commands and signals wait no longer."""
_Frame = tuple[Floats, Floats | None]  # taxels, and truth where it is known


@dataclass(frozen=True)
class SensorSettings(PatchSettings):
    """Settings of the sensor node."""

    source: str = setting(
        "scene:drag_wrench_64",
        "where frames come from: scene:NAME, file:PATH, serial:DEVICE, udp:PORT, can:CHANNEL or "
        "module:callable",
        decides=True,
    )
    rate_hz: float | None = setting(
        None,
        "frames a second; not stated: a recording's own rate, a driver's own pace, "
        "100 for a scene; 0: as fast as its subscribers process them",
        low=0.0,
        high=100_000.0,
        live=True,
    )
    seed: int = setting(0, "seed of the scene and of the noise", low=0, high=2**32 - 1)
    noise: float = setting(
        1.0,
        "noise added to a known truth, in multiples of the paper's",
        low=0.0,
        high=100.0,
        live=True,
    )
    n_rows: int | None = setting(
        None,
        "rows of a plain CSV's frame, or those that a file or driver must have",
        low=1,
        high=4096,
    )
    n_cols: int | None = setting(
        None,
        "columns of a plain CSV's frame, or those that a file or driver must have",
        low=1,
        high=4096,
    )
    unit: str | None = setting(None, "unit of a file's or driver's readings")
    f_max: float | None = setting(
        None, "upper end of a file's or driver's range, in its unit", low=1e-9, high=1e9
    )
    nan: str = setting("refuse", "readings of a file that are not finite", choices=NAN_WAYS)
    negative: str = setting("refuse", "readings of a file below 0", choices=NEGATIVE_WAYS)

    @property
    def policy(self) -> Policy:
        """What to do with invalid readings of a file."""
        return Policy(self.nan, self.negative)

    def check(self) -> None:
        with naming("source"):
            check_source(self.source, self.n_rows, self.n_cols, self.unit, self.policy, self.f_max)
        if self.source.startswith(SCENE):
            for key in ("n_rows", "n_cols", "unit", "f_max"):
                if getattr(self, key) is not None:
                    raise SettingsError(f"{key}: a scene has its own")


class Sensor(SourceNode[SensorSettings]):
    """Publishes /PATCH/skin once, then /PATCH/taxels, and /PATCH/truth where it is known.

    Frames of a scene or a recording are computed before their tick, so that their stamp is the
    time of acquisition without the time of simulation.
    """

    Settings = SensorSettings

    def __init__(self, settings: SensorSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._source = open_source(
            settings.source,
            seed=settings.seed,
            n_rows=settings.n_rows,
            n_cols=settings.n_cols,
            unit=settings.unit,
            f_max=settings.f_max,
            policy=settings.policy,
        )
        self.skin = self._source.skin
        self._noise = self._chosen_noise()
        self._rng = context.rng(settings.seed)
        self._live = isinstance(self._source, DriverSource | BoardSource)
        self._board_ns = -1
        self.rate_hz = self._chosen_rate()
        self._frames: Iterator[tuple[int, Floats]] = iter(self._source)
        self._next: _Frame | None = None
        self._n_frames = self._n_clipped = self._n_logged = 0
        self._missed_hz = 0.0
        if not self._live:
            self._prepare()

    @classmethod
    def outputs(cls, settings: SensorSettings) -> tuple[str, ...]:
        return tuple(topic_of(settings.patch, cls.schema) for cls in (SkinState, Taxels, Truth))

    @classmethod
    def facts(cls, settings: SensorSettings) -> Mapping[str, Any]:
        source, n_rows, n_cols = settings.source, settings.n_rows, settings.n_cols
        n: int | None
        if source.startswith(SCENE):
            n = open_source(source, seed=settings.seed).skin.n_taxels
        elif is_board(source):
            unit, f_max = settings.unit, settings.f_max
            board = describe_board(source, n_rows=n_rows, n_cols=n_cols, unit=unit, f_max=f_max)
            n = board.skin.n_taxels
        elif source.startswith(FILE):
            path = source.removeprefix(FILE)
            n = n_taxels(path, n_rows, n_cols, settings.unit, settings.policy)
        else:  # otherwise known once the driver runs
            n = n_rows * n_cols if n_rows and n_cols else None
        return {} if n is None else {topic_of(settings.patch, SkinState.schema): n}

    def start(self) -> Iterable[Message]:
        if isinstance(self._source, RecordedSource):
            for line in self._source.treated.lines(self._source.policy, self.skin.unit):
                self.context.log(line)
        yield self._describe()

    def change(self, settings: SensorSettings) -> Iterable[Message]:
        if settings.noise != self.settings.noise and self._source.delivers != "truth":
            raise SettingsError(
                "noise: this source delivers noisy taxels; there is no truth to add noise to"
            )
        new_pace = settings.rate_hz != self.settings.rate_hz
        self.settings = settings
        self._noise = self._chosen_noise()
        if self._next is not None and self._next[1] is not None:
            self._next = self._measured(self._next[1])  # it was computed with the noise before
        if new_pace:
            self.rate_hz = self._chosen_rate()
            self.begin(self.context.clock.now_ns())
        yield self._describe()

    @property
    def follows_readers(self) -> bool:
        # A board does not wait: its frames would be lost where nobody counts them.
        return super().follows_readers and not isinstance(self._source, BoardSource)

    def _describe(self) -> SkinState:
        skin, has_truth = self.skin, self._source.delivers == "truth"
        return SkinState(
            stamp_ns=self.context.clock.now_ns(),
            patch=self.settings.patch,
            **vars(skin),
            source=self._source.name,
            seed=self.settings.seed,
            rate_hz=self.rate_hz,
            has_truth=has_truth,
            sigma_mid=self._noise.sigma_mid if has_truth else 0.0,
            sigma_end=self._noise.sigma_end if has_truth else 0.0,
        )

    def tick(self, tick: Tick) -> Iterable[Message]:
        stamp_ns = tick.stamp_ns
        if self._live:
            self._prepare()
            # A driver waits for its hardware: its frame is younger than the tick.
            stamp_ns = max(stamp_ns, self.context.clock.now_ns())
        if isinstance(self._source, BoardSource):
            stamp_ns = self._board_ns
        if self._next is None:
            return
        taxels, truth = self._next
        patch = self.settings.patch
        yield Taxels(stamp_ns=stamp_ns, patch=patch, forces=taxels)
        if truth is not None:
            yield Truth(stamp_ns=stamp_ns, patch=patch, forces=truth)
        self._n_frames += 1
        self._watch_rate(stamp_ns)
        if not self._live:
            self._prepare()

    def state(self) -> dict[str, Any]:
        # Without a stated rate, the pace of a driver is its own and not known.
        paced = self._live and self.settings.rate_hz is None
        return {**super().state(), **({} if paced else {"rate_hz": self.rate_hz})}

    def status(self) -> str:
        total = f" of {self._source.n_frames}" if self._source.n_frames is not None else ""
        text = f"{self._source.name}: frame {self._n_frames}{total}"
        if isinstance(self._source, BoardSource):
            dropped = dropped_text(self._source.figures())
            text += f"; dropped: {dropped}" if dropped else ""
            text += "" if self._source.is_there else "; the device is gone"
        return text

    def close(self, counts: dict[str, Any]) -> None:
        if isinstance(self._source, DriverSource | BoardSource):
            self._source.close()

    def report(self) -> dict[str, Any]:
        source = self._source
        board = {"board": source.figures()} if isinstance(source, BoardSource) else {}
        if isinstance(source, RecordedSource) and (invalid := source.treated.counts()):
            return {"clipped": 0, "invalid": invalid}
        if not isinstance(source, DriverSource | BoardSource) or not self._n_clipped:
            return {"clipped": 0, **board}
        read = {"lowest": source.lowest, "highest": source.highest}
        allowed = {"f_max": self.skin.f_max, "unit": self.skin.unit}
        return {"clipped": self._n_clipped, **read, **allowed, **board}

    def _watch_range(self) -> None:
        """Log clipped readings, each time their number has doubled: a wrong sign, unit or range."""
        source = self._source
        n_clipped = source.n_clipped if isinstance(source, DriverSource | BoardSource) else 0
        if n_clipped > 2 * self._n_logged:
            self._n_logged = n_clipped
            self.context.log(
                f"{n_clipped} readings outside 0..{self.skin.f_max:g} {self.skin.unit} were clipped"
            )
        self._n_clipped = n_clipped

    def _watch_rate(self, now_ns: int) -> None:
        """Log, once for each rate, that frames are acquired more slowly than asked."""
        passed_s = (now_ns - self._t0_ns) / 1e9
        if not self._t0_ns or passed_s < RATE_S or self.rate_hz == self._missed_hz:
            return
        reached_hz = self._n_ticks / passed_s
        if reached_hz < KEPT_RATE * self.rate_hz:
            self._missed_hz = self.rate_hz
            self.context.log(f"{self.rate_hz:g} Hz asked, {reached_hz:.1f} Hz reached")

    def _chosen_noise(self) -> NoiseModel:
        return NoiseModel.for_range(self.skin.f_max, self.settings.noise)

    def _chosen_rate(self) -> float:
        if self.settings.rate_hz is not None:
            return self.settings.rate_hz
        if self.settings.source.startswith(SCENE):
            return DEFAULT_RATE_HZ
        if self._source.rate_hz is not None:
            return self._source.rate_hz
        return 0.0 if self._live else DEFAULT_RATE_HZ

    def _prepare(self) -> None:
        """Compute the next frame, or note that there is none."""
        if isinstance(self._source, BoardSource):
            forces = self._from_board(self._source)
            self._next, self.acquired = (
                None if forces is None else (forces, None),
                forces is not None,
            )
            return
        try:
            _, forces = next(self._frames)
        except StopIteration:
            self._next, self.exhausted = None, True
            return
        self._watch_range()
        if self._source.delivers == "taxels":
            self._next = (forces, None)
            return
        self._next = self._measured(forces)

    def _from_board(self, board: BoardSource) -> Floats | None:
        """The next frame of a board, and its stamp; None if none came."""
        frame = board.next_frame(WAIT_S, newest=self.rate_hz > 0)
        self._log_lines(board)
        now_ns = self.context.clock.now_ns()
        if frame is None:
            self.begin(now_ns)  # no frame is made up for
            return None
        arrived_ns, forces = frame
        self._board_ns = max(now_ns - board.age_ns(arrived_ns), self._board_ns + 1)
        self._watch_range()
        return forces

    def _log_lines(self, board: BoardSource) -> None:
        while board.lines:
            self.context.log(board.lines.popleft())

    def idle(self) -> None:
        if not isinstance(self._source, BoardSource):
            return
        if self.paused or not self._t0_ns:
            self._source.discard()
        elif self.rate_hz:
            self._source.receive(0.0)
        self._log_lines(self._source)

    def _measured(self, truth: Floats) -> _Frame:
        """Return the readings of true forces, and these."""
        taxels = self._noise.apply(truth, self._rng)
        if self.skin.mask is not None:
            taxels[~self.skin.mask] = 0.0
        return taxels, truth
