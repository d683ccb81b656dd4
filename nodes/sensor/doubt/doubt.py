"""Doubt: why the readings of a frame are not to be trusted, by rest, sign, range and repetition."""

from dataclasses import replace

import numpy as np

from sparseskin.messages.skin import Skin
from sparseskin.messages.text import printable
from sparseskin.nodes.numerics.arrays import AnyArray, Floats, Mask
from sparseskin.nodes.sensor.calibration.chain import TARE_FRAMES
from sparseskin.nodes.sensor.calibration.description import SkinDescription
from sparseskin.nodes.sensor.layout.checks import ADD
from sparseskin.nodes.sensor.saturation import Clipped
from sparseskin.nodes.sensor.sign import Sign

from .repeats import Repeats
from .rest import Rest


class Doubt:
    """Looks at the forces that became of the readings of one skin, frame by frame.

    `clipped` are the counts of what clips them before; None: nothing does, `take` counts them.
    `has_level`: nobody has stated what the untouched skin reads; `is_inverted`: it is stated that
    readings fall with force.
    """

    def __init__(
        self,
        skin: Skin,
        clipped: Clipped | None = None,
        *,
        has_level: bool,
        is_inverted: bool = False,
    ) -> None:
        if clipped is None:
            clipped = Clipped(mask=skin.mask)
        self._skin = skin
        self.clipped = clipped
        self._rest = Rest(skin) if has_level else None
        self._repeats = Repeats(skin)
        self._is_inverted = is_inverted
        self._sign_found = False
        #: Line on the sign; `_is_new` until `take_line` has returned one on sign or rest.
        self._line = ""
        self._is_new = False

    @property
    def is_settled(self) -> bool:
        """True if no level at rest can be found any more."""
        return self._rest is None or self._rest.is_settled

    @property
    def level(self) -> str:
        """`Reason.REST` where a level at rest is found, else ""."""
        if self._rest is None:
            return ""
        return self._rest.reason

    @property
    def stuck_cells(self) -> list[int]:
        """Flat cells of the stuck taxels of the last frame, in order, as of `Repeats`."""
        return self._repeats.cells

    @property
    def line(self) -> str:
        """What makes all frames so far untrusted, with the settings that answer it, behind `ADD`;
        "" if nothing does.
        """
        if self._rest is not None and self._rest.line:
            return self._rest.line
        if not self._sign_found:
            return ""
        return self._line

    def widen(self, f_max: float) -> None:
        """Raise the upper end of the range."""
        self._skin = replace(self._skin, f_max=f_max)
        # float32, as the readings that it is compared with.
        self._repeats.f_max = np.float32(f_max)
        if self._rest is not None:
            self._rest.skin = self._skin

    def take_line(self) -> str:
        """That line where it is new, and there were enough frames for it; "" at other times."""
        if not self._is_new:
            return ""
        self._is_new = False
        return self.line

    def take(
        self, forces: Floats, f_min: float = 0.0, noise: float | None = None
    ) -> str:
        """Reason of a frame as of `look`, before it is clipped to f_min and the skin's f_max; noise
        as of `Clipped.add`.
        """
        self.clipped.add(forces, f_min, self._skin.f_max, noise)
        return self.look(forces)

    def look(self, forces: Floats, missing: Mask | None = None) -> str:
        """Reason of a frame, float32 (n_rows, n_cols), 0 in masked cells; "" if there is none. It
        was added to `clipped` before it was clipped. `missing`: as in `Repeats.reason`.
        """
        if self._rest is not None and self._rest.update(forces):
            self._is_new = True

        # The line is made once, with the counts of that frame: later ones are larger.
        sign = self.clipped.sign
        if sign.is_found and not self._sign_found:
            self._is_new = True
            self._line = self._line_on(sign)
        self._sign_found = sign.is_found

        # The margin of a frame is used once: not all sources count what is clipped.
        repeats = self._repeats.reason(forces, self.clipped.margin, missing)
        self.clipped.margin = None
        # What doubts all frames comes before what is of this one.
        return self.level or self.clipped.reason(self._skin.n_taxels) or repeats

    def filled(self, forces: Floats) -> Floats:
        """The last frame with stuck taxels filled in by the working ones beside them."""
        return self._repeats.filled(forces)

    def _line_on(self, sign: Sign) -> str:
        depth = f"{-sign.lowest:.3g} {printable(self._skin.unit)}"
        falls = f"taxels fell {sign.n_falls} times, by up to {depth} below rest"
        counts = f"{falls}, and rose {sign.n_rises} times"
        invert = "false" if self._is_inverted else "true"
        answers = f"invert={invert} if a press does that, tare={TARE_FRAMES} if nothing touches"
        return f"{counts}{ADD}{answers} them"


def line_on_sign(
    described: SkinDescription, frames: AnyArray, is_inverted: bool
) -> str:
    """Line on the sign of raw frames, (n, n_rows, n_cols), of a skin that was calibrated without a
    press, as `Doubt.line`.
    """
    # The baseline is that of these frames: none of them has a level.
    doubt = Doubt(described.skin, has_level=False, is_inverted=is_inverted)
    for raw in frames:
        forces = described.forces(raw).astype(np.float32)
        doubt.take(forces, described.f_min, described.noise)
    return doubt.line
