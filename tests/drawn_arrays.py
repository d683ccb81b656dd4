"""Arrays of frames drawn at random, with their axes in any order, and times beside them."""

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

AXES = ("frames", "rows", "cols")
DTYPES = ["u1", "<u2", ">u2", "i4", ">i8", "u8", "f2", "<f4", ">f4", "f8"]
TIME_NAMES = {"timestamps": 1e9, "t_ms": 1e6, "stamp_ns": 1, "time_s": 1e9}
"""Names of arrays of times, and nanoseconds of their units."""


@dataclass
class DrawnArray:
    """An array as it is stored, the frames in it, and what a user can state of it."""

    stored: np.ndarray
    frames: np.ndarray  # (n_frames, n_rows, n_cols)
    axes: tuple[str, ...]  # of `stored`, - for one of one entry
    time_name: str  # "": no times
    times: np.ndarray
    seconds: np.ndarray  # since the first frame

    @property
    def axes_stated(self) -> dict[str, str]:
        return {"axes": ",".join(self.axes)}

    @property
    def shape_stated(self) -> dict[str, int]:
        return {"n_rows": self.frames.shape[1], "n_cols": self.frames.shape[2]}

    @property
    def is_plain(self) -> bool:
        """True if its sides differ, and rows come before columns."""
        sides = self.frames.shape
        in_order = [name for name in self.axes if name != "frames" and name != "-"]
        return len({*sides}) == len(sides) and in_order == ["rows", "cols"]


@st.composite
def arrays(draw, max_side=6):
    """A `DrawnArray`."""
    sides = draw(st.lists(st.integers(2, max_side), min_size=3, max_size=3))
    n = int(np.prod(sides))
    dtype = np.dtype(draw(st.sampled_from(DTYPES)))
    frames = (1 + np.arange(n) % 251).reshape(sides).astype(dtype)
    order = draw(st.permutations(range(3)))
    stored = frames.transpose(order)
    axes = [AXES[at] for at in order]
    for _ in range(draw(st.integers(0, 2))):
        place = draw(st.integers(0, len(axes)))
        stored = np.expand_dims(stored, place)
        axes.insert(place, "-")
    stored = np.asarray(stored, order=draw(st.sampled_from("CF")))

    time_name = draw(st.sampled_from(["", *TIME_NAMES]))
    steps_ms = draw(
        st.lists(st.integers(8, 40), min_size=sides[0] - 1, max_size=sides[0] - 1)
    )
    ms = np.concatenate([[0], np.cumsum(steps_ms)]).astype(np.int64)
    unit_ns = TIME_NAMES.get(time_name, 1)
    times = (
        ms * 10**6 // int(unit_ns) if time_name == "stamp_ns" else ms * (1e6 / unit_ns)
    )
    return DrawnArray(stored, frames, tuple(axes), time_name, times, ms / 1000)


def check(source, array, has_times):
    """Assert that a source has the frames and times of a drawn array."""
    np.testing.assert_array_equal(source.frames, array.frames.astype(np.float32))
    even = 0.01 * np.arange(len(array.frames))
    seconds = array.seconds if has_times and array.time_name else even
    np.testing.assert_allclose(source.stamp_ns / 1e9, seconds, atol=1e-6)
