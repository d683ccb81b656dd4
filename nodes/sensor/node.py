"""The sensor node: acquires frames from a source and publishes the readings of the taxels."""

from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from sparseskin.messages import (
    Calibration,
    Message,
    Reason,
    SkinState,
    Taxels,
    Truth,
    topic_of,
)
from sparseskin.nodes.errors import RefusedError, SettingsError, SourceError
from sparseskin.nodes.node import Context, SourceNode, Tick
from sparseskin.nodes.numerics.arrays import Bytes, Floats

from .calibration.chain import Chain
from .calibration.description import Placement, SkinDescription, of_skin
from .calibration.drift import DRIFT_RATE
from .device_clock import DeviceClock
from .doubt.doubt import Doubt
from .layout.checks import spelled
from .layout.layout import MASK
from .missing import MissingReadings
from .noise import NoiseModel
from .points import point_skins
from .repetition import names_of
from .saturation import Clipped, clipped_text
from .settings import NO_TRUTH, SensorSettings
from .skin_file import load_skin
from .source import DEFAULT_RATE_HZ, Skin

WAIT_S = 0.05
"""Longest wait for a frame of a board, seconds; chosen: commands and signals wait no longer."""
LOG_S = 10
"""Least time between two lines of clipped readings, seconds; chosen: a log stays readable."""
_Bits = Bytes


class _Frame(NamedTuple):
    """A frame to publish: taxels; truth, where it is known; missing taxels; `reason` of them."""

    taxels: Floats
    truth: Floats | None = None
    missing: _Bits | None = None
    reason: str = ""


class Sensor(SourceNode[SensorSettings]):
    """Publishes /PATCH/skin once, then /PATCH/taxels, and /PATCH/truth where it is known; with a
    calibration, /PATCH/calibration at the start and after each tare.

    Frames of a scene or a recording are computed before their tick, so that their stamp is the
    time of acquisition without the time of simulation.
    """

    Settings = SensorSettings
    commands: ClassVar[Mapping[str, str]] = {
        **SourceNode.commands,
        "tare": "take the next frames, of the untouched skin, for the baseline: their number, or "
        "null for 30",
    }

    def __init__(self, settings: SensorSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._described: SkinDescription | None = None
        self._placement: Placement | None = None
        if settings.skin:
            self._described = load_skin(settings.skin)
            self._placement = self._described.placement
        if settings.points:
            self._placement = point_skins().place(settings.points)

        # Answers to a fault are settings, in the form that a command takes them.
        try:
            self._open_source()
        except SourceError as error:
            text = spelled(str(error), lambda key: f"--set {context.name}.{key}=")
            raise SourceError(text) from error

        skin = self._source_skin
        self._f_min = self._source.f_min
        if self._stage is not None:
            skin = self._stage.skin
            self._f_min = self._stage.description.f_min

        # Only a live source shows by its frames which taxels give no number.
        learns = settings.nan == MASK and self._source.is_live
        self._readings = MissingReadings(settings.missing_way, skin, learns)
        if self._source.is_live:
            self._source.clipped.mask = skin.mask

        self._noise = self._chosen_noise()
        self._rng = context.rng(settings.seed)
        self._clock: DeviceClock | None = None
        if settings.clock == "source":
            self._clock = self._source.clock
        self._stamp_ns = -1  # of the last frame of a live source
        self._set_pace()

        # Frames of a live source are of the time at which they are read: none is read ahead.
        self._begin()
        if not self._source.is_live:
            self._prepare()

    def _begin(self) -> None:
        """Set what changes from frame to frame, as before the first one."""
        settings = self.settings
        self._doubt: Doubt | None = None  # from the first frame on
        self._stated_rest = settings.tare is not None or settings.invert
        self._described_changes = False
        if self._described is not None:
            self._described_changes = self._described.changes_readings
        self._line = ""  # on rest and sign, as it was logged last

        self._next: _Frame | None = None
        # The first messages: those of later frames are like them.
        self._taxels: Taxels | None = None
        self._truth_message: Truth | None = None
        self._n_frames = 0
        self._n_stuck = 0  # taxels that were named in the log
        # Clipped readings when they were logged last, and the time of that.
        self._n_logged = 0
        self._logged_ns = 0

    def _open_source(self) -> None:
        """Open the source and make what converts its readings; it is closed if that fails."""
        settings = self.settings
        with ExitStack() as opened:
            source = settings.address().open()
            opened.callback(source.close)
            self._source = source
            source.loops = settings.loop
            if settings.first or settings.every > 1:
                source.read_part(settings.first, settings.every)

            # The stage is made for the skin of the placement.
            self._source_skin = self._placed_skin()
            self._stage = self._made_stage()
            opened.pop_all()

    @classmethod
    def outputs(cls, settings: SensorSettings) -> tuple[str, ...]:
        kinds: list[type[Message]] = [SkinState]
        if settings.is_calibrated:
            kinds.append(Calibration)
        kinds.append(Taxels)
        if settings.address().delivers != "taxels":
            kinds.append(Truth)
        return tuple(topic_of(settings.patch, kind.schema) for kind in kinds)

    @classmethod
    def facts(cls, settings: SensorSettings) -> Mapping[str, Any]:
        n_taxels = cls._n_taxels(settings)
        if n_taxels is None:
            return {}
        return {topic_of(settings.patch, SkinState.schema): n_taxels}

    @classmethod
    def _n_taxels(cls, settings: SensorSettings) -> int | None:
        """Number of taxels before the source is open; None where only the open one shows it."""
        if settings.nan == MASK:  # the frames show which taxels give no number
            return None
        if settings.points:
            return point_skins().n_taxels(settings.points)
        if settings.skin:  # a source that masks further cells shows when it runs
            return load_skin(settings.skin).skin.n_taxels
        return settings.address().n_taxels()

    def start(self) -> Iterable[Message]:
        if self._placement is not None:
            for line in self._placement.summary():
                self.context.log(line)
        self._log_lines()

        # First, so that a recorder knows it once the graph's other states follow from the skin.
        yield from self._calibration()
        if not self._readings.learns:
            yield self._describe()

    @property
    def unused(self) -> tuple[str, ...]:
        if self._source.delivers == "truth":
            return ()
        return (topic_of(self.settings.patch, Truth.schema),)

    @property
    def skin(self) -> Skin:
        """Geometry and range of the frames."""
        return self._readings.skin

    def change(self, settings: SensorSettings) -> Iterable[Message]:
        if settings.noise != self.settings.noise and self._source.delivers != "truth":
            raise SettingsError(NO_TRUTH)
        if settings.invert != self.settings.invert:
            # Gains of presses have the sign that the presses showed.
            described = self._described
            has_gains = described is not None and described.gains is not None
            if self._stage is None or has_gains:
                raise SettingsError(
                    "invert: is of a sensor with a baseline, and without gains"
                )
            self._stage.invert()

        pace_changes = settings.rate_hz != self.settings.rate_hz
        self.settings = settings
        self._noise = self._chosen_noise()
        # The next frame was computed with the noise before.
        if self._next is not None and self._next.truth is not None:
            self._next = self._next._replace(taxels=self._measured(self._next.truth))
        if pace_changes:
            self._set_pace()
            self.begin(self.context.clock.now_ns())
        if self._stage is not None:
            self._stage.drift.rate = self._drift_rate()

        # The first frame may still have to show which taxels there are: it is described then.
        if self._readings.is_known:
            yield self._describe()

    @property
    def follows_readers(self) -> bool:
        # What arrives does not wait: its frames would be lost where nobody counts them.
        return super().follows_readers and not self._source.arrives

    @property
    def _is_of_now(self) -> bool:
        """True if a clock sets the pace of frames that are no recorded ones."""
        source = self._source
        return source.is_live or (source.simulates and self.rate_hz > 0)

    def _describe(self) -> SkinState:
        self._readings.is_news = False
        has_truth = self._source.delivers == "truth"

        # 0: not known.
        sigmas = None
        if self._stage is not None:
            sigmas = self._stage.description.sigmas
        elif has_truth:
            sigmas = (self._noise.sigma_mid, self._noise.sigma_end)
        sigma_mid, sigma_end = sigmas or (0.0, 0.0)
        return SkinState(
            stamp_ns=self.context.clock.now_ns(),
            patch=self.settings.patch,
            **vars(self.skin),
            source=self._source.name,
            seed=self.settings.seed,
            rate_hz=self.rate_hz,
            has_truth=has_truth,
            live=self._is_of_now,
            sigma_mid=sigma_mid,
            sigma_end=sigma_end,
            f_min=self._f_min,
        )

    def _calibration(self) -> Iterable[Message]:
        if self._stage is not None:
            self._stage.is_news = False
            now_ns = self.context.clock.now_ns()
            yield self._stage.description.message(now_ns, self.settings.patch)

    def command(self, name: str, value: Any) -> str:
        if name != "tare":
            return super().command(name, value)
        if self._stage is None:
            raise RefusedError(
                "tare: this sensor has no baseline; state sensor.skin, or sensor.tare, "
                "in the launch file"
            )
        return self._stage.start_tare(value)

    def tick(self, tick: Tick) -> Iterable[Message]:
        source = self._source
        stamp_ns = tick.stamp_ns
        if source.is_live:
            self._prepare()
            stamp_ns = self._stamp_ns

        # After a tare or a change of sign: what was in doubt before is no longer.
        if self._stage is not None and self._stage.is_news:
            self._stated_rest = True
            self._doubt = None
            yield from self._calibration()
            self._readings.is_news |= self._readings.is_known

        frame = self._next
        if frame is None:
            return
        # Before the frame: readers set up Phi and solver by it.
        if self._readings.is_news:
            yield self._describe()
        yield self._taxels_of(stamp_ns, frame)
        if frame.truth is not None:
            yield self._truth_of(stamp_ns, frame.truth)
        self._n_frames += 1
        self._watch_rate(stamp_ns)

        if not source.is_live:
            self._prepare()

    def _taxels_of(self, stamp_ns: int, frame: _Frame) -> Taxels:
        settings = self.settings
        forces = frame.taxels
        if self._taxels is None or forces.shape[-2:] != self._taxels.forces.shape[-2:]:
            self._taxels = Taxels(
                patch=settings.patch,
                names=settings.patches,
                stamp_ns=stamp_ns,
                forces=forces,
                missing=frame.missing,
            )
        return self._taxels.following(
            stamp_ns=stamp_ns,
            forces=forces,
            missing=frame.missing,
            reason=(frame.reason,) * settings.n_patches,
        )

    def _truth_of(self, stamp_ns: int, forces: Floats) -> Truth:
        settings = self.settings
        message = self._truth_message
        if message is None or forces.shape != message.forces.shape:
            message = Truth(
                patch=settings.patch,
                names=settings.patches,
                stamp_ns=stamp_ns,
                forces=forces,
            )
            self._truth_message = message
        return message.following(stamp_ns=stamp_ns, forces=forces)

    def state(self) -> dict[str, Any]:
        state = super().state()
        # Without a stated rate, the pace of a driver is its own and not known.
        if not self._source.is_live or self.settings.rate_hz is not None:
            state["rate_hz"] = self.rate_hz
        if self._source.is_live and self._clock is not None:
            state |= self._clock.state()
        elif self._source.is_live:
            state["clock"] = "arrival"
        if self._stage is not None:
            state |= self._stage.state()
        if self.settings.accepts_missing:
            state |= self._readings.state()
        if self._doubt is not None:
            state["faulty_taxels"] = self._doubt.stuck_cells
        return state

    def status(self) -> str:
        source = self._source
        text = f"{source.name}: frame {self._n_frames}"
        if source.n_frames and not source.loops:
            text += f" of {source.n_frames}"
        if self.settings.n_patches > 1:
            text += f" of {self.settings.n_patches} patches"

        n_dropped = source.dropped()
        if n_dropped:
            text += f"; dropped: {n_dropped}"
        if self._readings.n_now:
            text += f"; {self._readings.n_now} readings missing"
        if not source.is_there:
            text += "; the device is gone"
        return text

    def close(self, counts: dict[str, Any]) -> None:
        self._source.close()

    def report(self) -> dict[str, Any]:
        report = self._clipped()
        if self._clock is not None:
            report |= self._clock.state()
        report |= self._source.report()
        report |= self._readings.report()

        # Beside those of the source.
        if self._line:
            report["lines"] = [*report.get("lines", ()), self._line]
        return report

    def _clipped(self) -> dict[str, Any]:
        """Counts of the readings that were clipped to the range."""
        return self._clips.report(self._f_min, self.skin.f_max, self.skin.unit)

    @property
    def _clips(self) -> Clipped:
        return (self._stage or self._source).clipped

    def _watch_range(self) -> None:
        """Log clipped readings at first, then when doubled, `LOG_S` apart: wrong sign or unit."""
        n_clipped = self._clips.n
        if n_clipped <= 2 * self._n_logged:
            return

        now_ns = self.context.clock.now_ns()
        if self._n_logged and now_ns - self._logged_ns < LOG_S * 1_000_000_000:
            return
        self._n_logged = n_clipped
        self._logged_ns = now_ns
        self.context.log(clipped_text(self._clipped()))

    def _chosen_noise(self) -> NoiseModel:
        scale = self.settings.noise
        if self._source.sigmas is None:
            return NoiseModel.for_range(self.skin.f_max, scale)
        sigmas = [scale * sigma for sigma in self._source.sigmas]
        return NoiseModel(self.skin.f_max, *sigmas)

    def _set_pace(self) -> None:
        if self.settings.rate_hz is not None:
            self.rate_hz = self.settings.rate_hz
        else:
            self.rate_hz = self._source.pace_hz
            # A recording's own: of its frames only one in `every` is read.
            if self.rate_hz == self._source.rate_hz:
                self.rate_hz /= self.settings.every
        self._source.period_s = 1 / (self.rate_hz or DEFAULT_RATE_HZ)

    def _prepare(self) -> None:
        """Compute the next frame, or note that there is none."""
        source = self._source
        self._next = None
        while (frame := source.next_frame(WAIT_S, newest=self.rate_hz > 0)) is not None:
            self._next = self._read(*frame)
            # A tick a frame of now, so that a slow skin answers commands meanwhile.
            if self._next is not None or source.is_live:
                break

        self._widen()
        self._watch_range()
        self._log_lines()

        if source.ended:
            self.exhausted = True
            if self._stage is not None and self._stage.is_starting:
                self.context.log(f"{source.name}: ended before its tare")

        if source.arrives:
            self.acquired = self._next is not None
            if frame is None:
                self.begin(self.context.clock.now_ns())  # no frame is made up for

    def _widen(self) -> None:
        """Follow the range of a recording, which a larger reading has widened."""
        if self._source.skin.f_max <= self._source_skin.f_max:
            return
        self._source_skin = replace(self._source_skin, f_max=self._source.skin.f_max)
        self._readings.widen(self._source_skin.f_max)
        self._readings.is_news = True
        if self._doubt is not None:
            self._doubt.widen(self._source_skin.f_max)
        self._log_lines()

    def _read(self, stamp_ns: int, forces: Floats) -> _Frame | None:
        """Convert a frame of the source; None during a tare."""
        source = self._source
        if source.is_live:
            # Stamps rise, whatever the clocks do.
            arrived_ns = self.context.clock.now_ns() - source.age_ns(stamp_ns)
            if self._clock is not None:
                arrived_ns = self._clock.map(source.stamp, arrived_ns)
            self._stamp_ns = max(arrived_ns, self._stamp_ns + 1)

        # Readings in the order of the file of points become a grid.
        if self._placement is not None and not source.on_points:
            forces = self._placement.on_grid(forces)
        if self._stage is not None:
            converted = self._stage.process(forces, stamp_ns)
            if converted is None:
                return None
            forces = converted

        missing = None
        if self.settings.accepts_missing and forces.ndim == 2:
            filled = self._readings.fill(forces, stamp_ns)
            if filled is None:
                return None
            forces, missing = filled

        if source.delivers == "taxels":
            reason = self._reason(forces, missing)
            assert self._doubt is not None
            return _Frame(self._doubt.filled(forces), None, missing, reason)
        return _Frame(self._measured(forces), self._truth(forces), missing)

    def _reason(self, forces: Floats, missing: _Bits | None) -> str:
        """Why the readings of a frame are not to be trusted, "" if they are; `missing` are the bits
        of those that are none.
        """
        # Not before: the first frame may change the skin.
        if self._doubt is None:
            self._doubt = Doubt(
                self.skin,
                self._clips,
                has_level=not self._stated_rest,
                is_inverted=self.settings.invert,
            )
        cells = None
        if missing is not None:
            bits = np.unpackbits(missing, count=forces.size)
            cells = bits.astype(np.bool_).reshape(forces.shape)

        reason = self._doubt.look(forces, cells)
        self._note_stuck(self._doubt.stuck_cells)
        line = self._doubt.take_line()
        if line:
            self._say(line)

        # A level that a calibration leaves is named, but a person has seen the readings.
        if self._described_changes and reason == Reason.REST:
            return self._clips.reason(self.skin.n_taxels)
        return reason

    def _note_stuck(self, cells: list[int]) -> None:
        """Log the stuck taxels when they are found, then when their number has doubled."""
        if len(cells) <= 2 * self._n_stuck:
            return
        self._n_stuck = len(cells)
        names = names_of(cells, self.skin.n_cols)
        self.context.log(f"stuck taxels, filled in by those beside them: {names}")

    def _say(self, line: str) -> None:
        """Log a line that names settings, for the end of the run, too."""
        self._line = spelled(line, lambda key: f"{self.context.name}.{key}=")
        self.context.log(self._line)

    def _log_lines(self) -> None:
        for line in (*self._source.take_lines(), *self._readings.take_lines()):
            self.context.log(line)

    def idle(self) -> None:
        if not self._source.arrives:
            return
        # Frames that arrive before the start, or in a pause, would be old later.
        if self.paused or not self._t0_ns:
            self._source.discard()
        elif self.rate_hz:
            self._source.receive(0.0)
        self._log_lines()

    def _made_stage(self) -> Chain | None:
        settings = self.settings
        source = self._source
        if not settings.is_calibrated:
            return None
        where = settings.skin or source.name
        if source.delivers == "truth":
            raise SourceError(
                f"{where}: {source.name} delivers true forces, which need none"
            )

        description = self._described or of_skin(source.name, self._source_skin)
        description = description.on(self._source_skin, where)
        description = replace(description, placement=self._placement)
        if settings.f_min is not None:
            f_min = max(settings.f_min, -description.f_max)
            description = replace(description, f_min=f_min)

        # The sign alone is no reason to follow a drift.
        self._drifts = description.changes_readings or bool(settings.tare)
        if settings.invert:
            description = description.inverted()
        return Chain(
            description, self._drift_rate(), settings.tare or 0, self.context.log
        )

    def _drift_rate(self) -> float:
        if self.settings.drift is not None:
            return self.settings.drift
        # Readings that are forces already have no baseline that could drift.
        if self._drifts:
            return DRIFT_RATE
        return 0.0

    def _placed_skin(self) -> Skin:
        """The skin of the source, of a layout that of its virtual grid; SourceError by its size."""
        skin = self._source.skin
        if self._placement is None or self._source.on_points:
            return skin
        self._placement.check_size(skin.n_rows * skin.n_cols)
        placed = self._placement.skin(skin.f_max, skin.unit)
        if skin.mask is None:
            return placed
        return placed.without(~self._placement.on_grid(skin.mask))

    def _truth(self, truth: Floats) -> Floats:
        """True forces of each patch."""
        n_patches = self.settings.n_patches
        # A scene of one patch: all of them show it.
        if n_patches > 1 and truth.ndim == 2:
            return np.repeat(truth[np.newaxis], n_patches, axis=0)
        return truth

    def _measured(self, truth: Floats) -> Floats:
        """Readings of true forces, of each patch."""
        taxels = self._noise.apply(self._truth(truth), self._rng)
        if self.skin.mask is not None:
            # Noise would show in cells without a taxel.
            taxels[..., ~self.skin.mask] = 0.0
        return taxels
