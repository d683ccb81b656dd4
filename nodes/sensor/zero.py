"""Zero: rest, sign and range of readings that a program hands over as arrays."""

import numpy as np

from sparseskin.messages import Reason
from sparseskin.messages.ranges import is_whole
from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.numerics.arrays import Floats

from .calibration.chain import MAX_TARE_FRAMES
from .doubt.doubt import Doubt
from .repetition import line_on_still


class Zero:
    """Makes forces of the readings of one skin, frame by frame, as the sensor node does, and states
    why they are not to be trusted. Stuck taxels have the mean of those beside them.

    Parameters
    ----------
    skin : Skin
        Its range is that of the forces.
    tare : int, optional
        Number of first frames, of the untouched skin, whose median is the reading at rest: their
        forces are 0. 0: readings are forces, whatever the untouched skin reads. Not stated: so they
        are, but a level that nearly all taxels read at first is not trusted.
    invert : bool
        Readings fall with force: a force is the reading at rest less the reading.

    Attributes
    ----------
    reason : str
        Word of the `Reason` for which the last frame is not to be trusted; "" if it is.
    doubt : Doubt
        What was found of all frames.

    Raises SettingsError, after the name of the argument, if one is not allowed.
    """

    def __init__(
        self, skin: Skin, tare: int | None = None, invert: bool = False
    ) -> None:
        if tare is not None and not is_whole(tare, 0, MAX_TARE_FRAMES):
            raise SettingsError(
                f"tare = {tare!r} is not allowed; allowed: a whole number, "
                f"0..{MAX_TARE_FRAMES}"
            )
        if not isinstance(invert, bool | np.bool_):
            raise SettingsError(
                f"invert = {invert!r} is not allowed; allowed: True, False"
            )
        self._skin = skin
        self._n_tare = tare or 0
        # Who states a tare, 0 too, or the sign has looked at the readings.
        self._invert = bool(invert)
        self._has_level = tare is None and not invert
        self.reset()

    def reset(self) -> None:
        """Forget all frames, and the reading at rest."""
        self.reason = ""
        self._untouched: list[Floats] = []
        self._baseline: Floats | None = None
        self._still = ""
        self.doubt = Doubt(
            self._skin, has_level=self._has_level, is_inverted=self._invert
        )

    @property
    def changes_readings(self) -> bool:
        """True if forces differ from readings."""
        return self._invert or self._n_tare > 0

    def take_still(self) -> str:
        """Line on the taxels that did not move in the tare, as of `line_on_still`; "" the next
        time, and if there are none.
        """
        line = self._still
        self._still = ""
        return line

    def forces(self, readings: Floats) -> Floats:
        """Forces of a frame, float32 (n_rows, n_cols), 0 in those of the tare; not clipped."""
        if len(self._untouched) < self._n_tare:
            # A copy: a program may hand over the same array again, with other readings.
            self._untouched.append(readings.copy())
            if len(self._untouched) == self._n_tare:
                untouched = np.array(self._untouched)
                self._baseline = np.median(untouched, axis=0).astype(np.float32)
                self._still = line_on_still(untouched, self._skin.exists)
            self.reason = Reason.REST
            return np.zeros_like(readings)

        forces = readings
        if self._baseline is not None:
            forces = forces - self._baseline
        if self._invert:
            forces = -forces

        # Cells without a taxel may read anything: it must not count as clipped or stuck.
        existing = forces
        if self._skin.mask is not None:
            existing = np.where(self._skin.mask, forces, np.float32(0))
        self.reason = self.doubt.take(existing)
        return self.doubt.filled(forces)
