"""Settings of the sensor node."""

from dataclasses import dataclass
from typing import Any

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.settings import PatchesSettings, naming, setting

from .calibration.chain import MAX_TARE_FRAMES
from .layout.checks import check_unit
from .layout.layout import EMPTY, KEYS, Layout
from .points import point_skins
from .skin_file import load_skin
from .source import Address
from .sources import find_address

WITH_END = ("scene", "file", "example")
"""Kinds of sources that have an end, at which they can begin again."""
NO_TRUTH = "noise: is added to true forces alone; state that of readings in the file of sensor.skin"


@dataclass(frozen=True)
class SensorSettings(Layout, PatchesSettings):
    """Settings of the sensor node."""

    source: str = setting(
        "scene:drag_wrench_64",
        "where frames come from: scene:NAME, file:PATH, module:callable, or of a kind that a "
        "plug-in brings, as serial:DEVICE",
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
    first: int = setting(
        0, "first frame of a scene or file that is read, from 0", low=0, high=2**31 - 1
    )
    every: int = setting(
        1,
        "steps from one frame of a scene or file to the next that is read; a file's own rate is "
        "divided by it",
        low=1,
        high=2**31 - 1,
    )
    seed: int = setting(0, "seed of the scene and of the noise", low=0, high=2**32 - 1)
    noise: float = setting(
        1.0,
        "noise added to a known truth, in multiples of the paper's",
        low=0.0,
        high=100.0,
        live=True,
    )
    loop: bool = setting(False, "begin a scene or recording again at its end")
    clock: str = setting(
        "source",
        "time of a frame of a board or driver: its own stamp mapped to the graph's clock, or its "
        "arrival",
        choices=("source", "arrival"),
    )
    simulated: dict[str, Any] | None = setting(
        None,
        "table of n_rows, n_cols, points, pitch_mm, f_max, mask, noise and noise_mid, as in a file "
        "skin.toml, of each patch that a scene of a body presses",
    )
    active: float | None = setting(
        None,
        "part of the patches that a scene of a body presses, not its own",
        low=0.0,
        high=1.0,
    )
    skin: str = setting(
        "",
        "file skin.toml with shape, pitch, unit, range, mask, calibration and noise of the skin, "
        "whose source delivers raw readings",
        decides=True,
    )
    points: str = setting(
        "",
        "file with the places of the taxels of a skin that is no flat grid, .csv or an iCub's "
        ".txt, or example:NAME (torso, grip); a source delivers readings in its order",
        decides=True,
    )
    tare: int | None = setting(
        None,
        "number of first frames, of the untouched skin, whose median is the baseline; 0: readings "
        "are forces, whatever the untouched skin reads; not stated: the baseline is that of the "
        "skin's file, or 0, and a level that nearly all taxels read at first is not trusted",
        low=0,
        high=MAX_TARE_FRAMES,
    )
    invert: bool = setting(
        False,
        "readings fall with force: a force is the baseline less the reading",
        live=True,
    )
    drift: float | None = setting(
        None,
        "largest drift of the baseline that is followed while a taxel is untouched, in parts of "
        "f_max a second; not stated: 0.0001 with a calibration or tare, else 0",
        low=0.0,
        high=1.0,
        live=True,
    )
    f_min: float | None = setting(
        None,
        "lower end of the range, 0 or less, in the unit of the forces: below 0, noise around 0 is "
        "not clipped; not stated: that of the skin's file, or 0",
        low=-1e9,
        high=0.0,
    )

    @property
    def is_calibrated(self) -> bool:
        """True if raw readings are converted to forces."""
        return bool(self.skin or self.tare or self.invert or self.f_min)

    def address(self) -> Address:
        """The source, as these settings state it. Raises SourceError if it has no known form."""
        # Read anew each time: a launch checks settings long before it runs them.
        described = None
        if self.skin:
            described = load_skin(self.skin)
        return find_address(
            self.source,
            layout=self.layout,
            seed=self.seed,
            raw=self.is_calibrated,
            points=self.points,
            described=described,
            n_patches=self.n_patches,
            simulated=self.simulated,
            active=self.active,
        )

    @property
    def layout(self) -> Layout:
        """What is stated of the source."""
        values = {key: getattr(self, key) for key in KEYS}
        # A rate of 0 is a pace of the sensor, and none of the source.
        values["rate_hz"] = self.rate_hz or None
        return Layout(**values)

    def check(self) -> None:
        if self.skin:
            self._check_skin()
        if self.points:
            with naming("points"):
                point_skins().n_taxels(self.points)
        with naming("source"):
            check_unit(self.source, self.unit)
            address = self.address()
            address.check()
            if self.n_patches > 1 and address.kind != "scene":
                raise SettingsError(
                    f"{self.source} is not available for several patches"
                )

        if self.loop and address.kind not in WITH_END:
            allowed = ", ".join(f"{kind}:" for kind in WITH_END)
            raise SettingsError(
                f"loop: {self.source} has no beginning; allowed: {allowed}"
            )
        if self.noise != 1 and address.delivers == "taxels":
            raise SettingsError(NO_TRUTH)

        # Each of these, not stated, is None, "" or 0.
        for key in address.own:
            if getattr(self, key) not in (None, "", 0):
                raise SettingsError(f"{key}: a {address.kind} has its own")
        # What a kind of source does not use must not be stated: it would be without effect.
        for key in KEYS:
            is_used = key == "rate_hz" or key in address.keys
            if not is_used and getattr(self, key) != getattr(EMPTY, key):
                raise SettingsError(f"{key}: does not go with a {address.kind} source")

    def _check_skin(self) -> None:
        """Check the file of the skin, and the settings that it states itself."""
        # Those of the source would be of raw readings, which have neither.
        for key in ("unit", "f_max"):
            if getattr(self, key) is not None:
                raise SettingsError(f"{key}: the file of the skin has its own")
        with naming("skin"):
            described = load_skin(self.skin)

        # Gains of presses have the sign that the presses showed.
        if self.invert and described.gains is not None:
            raise SettingsError("invert: the gains in the file of the skin have a sign")
        if self.points and described.placement is not None:
            raise SettingsError("points: the file of the skin has its own")
