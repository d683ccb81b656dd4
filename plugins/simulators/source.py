"""A MuJoCo model as a source of true forces."""

import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.messages.skin import PAPER_F_MAX_N, Skin
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import one_line
from sparseskin.nodes.numerics.arrays import Doubles, Floats
from sparseskin.nodes.process.isolation import child_status
from sparseskin.nodes.sensor.layout.arrangement import check_stated_shape
from sparseskin.nodes.sensor.source import Address, Source

from .model import check_model, find_pad, load_model, split_address
from .touch import Touch

RATE_HZ = 1000.0
"""Frames a second of simulated time; less where the model's time step is longer."""
Control = Callable[[Any, Any, float], None]
"""Called before each step with model, data and time in s; it may set ctrl, poses and forces."""


class MujocoSource(Source):
    """A simulation whose taxels are read 1000 times a second of its time.

    Every iteration runs it from its beginning. Without `control`, called as `control(model, data,
    time_s)` before each step, the model's keyframes drive it where their times rise: controls and
    mocap poses are interpolated between them, and the last one ends it, or `duration_s`. The first
    keyframe is the initial state in any case. `source`: mujoco:MODEL.xml#SITE, or MODEL.xml#SITE.
    Forces above `f_max` (2.5 N by default) are clipped, as a taxel saturates; the body feels them
    in full. `n_rows`, `n_cols`: shape that the skin must have. Raises SourceError as `check_model`;
    while it runs, if the simulation diverges or `control` fails.
    """

    delivers = "truth"
    simulates = True

    def __init__(
        self,
        source: str,
        *,
        f_max: float | None = None,
        n_rows: int | None = None,
        n_cols: int | None = None,
        control: Control | None = None,
        duration_s: float | None = None,
    ) -> None:
        self._source = source
        self.path, site = split_address(source)
        if not Path(self.path).is_file():
            check_model(source, n_rows, n_cols)
        self.model = load_model(self.path)
        self.pad = find_pad(self.model, site, self.path)
        check_stated_shape(*self.pad.shape, n_rows, n_cols, source)
        self.name = re.sub(r"[^\x20-\x7e]", "?", f"{Path(self.path).stem}#{site}")[:200]
        if f_max is None:
            f_max = PAPER_F_MAX_N
        self.skin = Skin(*self.pad.shape, f_max=f_max, pitch_m=self.pad.pitch_m)

        self._control = control
        self._schedule: Doubles | None = None
        if control is None:
            self._schedule = _schedule(self.model)

        # Frames are taken every few steps of the model.
        self._every = max(1, round(1.0 / (RATE_HZ * self.model.opt.timestep)))
        self.rate_hz: float | None = 1.0 / (self._every * self.model.opt.timestep)
        if duration_s is None and self._schedule is not None:
            duration_s = float(self._schedule[-1])
        self.n_frames: int | None = None
        if duration_s is not None:
            self.n_frames = max(1, round(duration_s * self.rate_hz))
        self.touch = Touch(self.model, self._reset(), self.pad, self.path)

    def __iter__(self) -> Iterator[tuple[int, Floats]]:
        """Yield simulated ns since the first frame, and forces in N, a fresh float32 (n_rows,
        n_cols).
        """
        import mujoco

        model = self.model
        # Every iteration begins with the same state, and yields the same forces.
        data = self._reset()
        touch = Touch(model, data, self.pad, self.path)
        self.touch = touch
        self.data = data
        f_max = np.float32(self.skin.f_max)
        step = 0
        n_frames = 0
        while self.n_frames is None or n_frames < self.n_frames:
            frame_is_due = step % self._every == 0
            self._drive(data)
            mujoco.mj_step1(model, data)
            # A skin that bears the load presses in every step.
            if touch.presses:
                forces = touch.press()
            elif frame_is_due:
                forces = touch.read()
            mujoco.mj_step2(model, data)
            self._check(data)

            if frame_is_due:
                stamp_ns = round(step * model.opt.timestep * 1e9)
                yield stamp_ns, np.minimum(forces, f_max)
                n_frames += 1
            step += 1

    def _reset(self) -> Any:
        import mujoco

        data = mujoco.MjData(self.model)
        if self.model.nkey:
            mujoco.mj_resetDataKeyframe(self.model, data, 0)
            data.time = 0.0
        mujoco.mj_forward(self.model, data)
        return data

    def _drive(self, data: Any) -> None:
        if self._control is not None:
            try:
                self._control(self.model, data, float(data.time))
            except Exception as error:
                # The user's own code may raise anything.
                raise SourceError(
                    f"{self._source}: control failed: {one_line(error)}"
                ) from error
        elif self._schedule is not None:
            _follow(self.model, data, self._schedule)

    def _check(self, data: Any) -> None:
        import mujoco

        kinds = mujoco.mjtWarning
        diverges = (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)
        if any(data.warning[kind].number for kind in diverges):
            raise SourceError(
                f"{self._source}: the simulation diverges at {data.time:.3f} s; allowed: a smaller "
                "time step, or less stiffness or damping of the skin for the mass of its bodies"
            )


def _schedule(model: Any) -> Doubles | None:
    """Times of the keyframes, if there are several and they rise; None otherwise."""
    times = np.array(model.key_time, dtype=np.float64)
    if len(times) < 2 or not np.all(np.diff(times) > 0):
        return None
    return times


def _follow(model: Any, data: Any, times: Doubles) -> None:
    """Set controls and mocap poses between two keyframes."""
    # Before the first keyframe and behind the last one, the pose of that one is kept.
    k = np.searchsorted(times, data.time, side="right")
    following = int(np.clip(k, 1, len(times) - 1))
    preceding = following - 1
    span_s = times[following] - times[preceding]
    part = np.clip((data.time - times[preceding]) / span_s, 0.0, 1.0)

    def between(values: Doubles) -> Doubles:
        begin = values[preceding]
        end = values[following]
        values_now: Doubles = (1.0 - part) * begin + part * end
        return values_now

    data.ctrl[:] = between(model.key_ctrl)
    if model.nmocap:
        data.mocap_pos[:] = between(model.key_mpos).reshape(-1, 3)
        quaternions = between(model.key_mquat).reshape(-1, 4)
        # A mean of two unit quaternions is shorter than 1.
        lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
        data.mocap_quat[:] = quaternions / np.maximum(lengths, 1e-12)


class MujocoAddress(Address):
    """A model and the site of its skin."""

    form = "mujoco:MODEL.xml#SITE"
    keys = ("n_rows", "n_cols", "unit", "f_max")
    delivers = "truth"

    def check(self) -> None:
        self.n_taxels()

    def n_taxels(self) -> int:
        return check_model(self.source, self.layout.n_rows, self.layout.n_cols)

    def open(self) -> MujocoSource:
        self.check()
        layout = self.layout
        if layout.unit not in (None, "N"):
            raise SourceError(
                f"{self.source}: unit = {layout.unit} is stated, but a simulation has newtons"
            )
        shape: dict[str, Any] = {"n_rows": layout.n_rows, "n_cols": layout.n_cols}
        return MujocoSource(self.rest, f_max=layout.f_max, **shape)


def main(address: str) -> int:
    """Print rows and columns of the skin of MODEL#SITE, or why it is refused; the exit status."""
    return child_status(address, lambda: print(*MujocoSource(address).pad.shape))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
