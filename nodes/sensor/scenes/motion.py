"""Prescribed motions of a body after its drop: lifted, dragged, or moved along a random path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Place = tuple[float, float]


@dataclass(frozen=True)
class Lift:
    """Lifted straight up at constant speed, in m/s, from `at_s` seconds on, tilts held constant.

    Source: paper, section II-B: 0.1 m/s.
    """

    at_s: float
    speed_m_s: float = 0.1

    def place(self, t_s: float) -> Place:
        """Return (0, 0): it is not moved along the skin."""
        return (0.0, 0.0)


@dataclass(frozen=True)
class Drag:
    """Dragged parallel to the skin at constant velocity (x, y), in m/s, from `at_s` seconds on.

    Source: paper, section II-B: 0.05 m/s.
    """

    at_s: float
    velocity_m_s: Place

    def place(self, t_s: float) -> Place:
        """Return the offset (x, y) in m from the place of the drop."""
        moved_s = max(0.0, t_s - self.at_s)
        return (self.velocity_m_s[0] * moved_s, self.velocity_m_s[1] * moved_s)


@dataclass(frozen=True)
class RandomPath:
    """Moved at constant speed, in m/s, between random places, from `at_s` seconds on."""

    at_s: float
    speed_m_s: float = 0.05

    def draw(
        self, rng: np.random.Generator, half_width_m: float, half_height_m: float, end_s: float
    ) -> tuple[Place, PolygonalCourse]:
        """Draw the place of the drop, in m from the middle of the skin, and a course from there
        until `end_s`. Places are uniform in a rectangle about that middle.
        """
        half = np.array([half_width_m, half_height_m])
        start = rng.uniform(-half, half)
        corners = [start]
        times = [self.at_s]
        while times[-1] <= end_s:
            corners.append(rng.uniform(-half, half))
            length = float(np.hypot(*(corners[-1] - corners[-2])))
            times.append(times[-1] + length / self.speed_m_s)
        offsets = [(float(x - start[0]), float(y - start[1])) for x, y in corners]
        return (float(start[0]), float(start[1])), PolygonalCourse(tuple(times), tuple(offsets))


@dataclass(frozen=True)
class PolygonalCourse:
    """Straight lines between corners, reached at given times; the body rests before and after."""

    times_s: tuple[float, ...]
    offsets_m: tuple[Place, ...]  # from the place of the drop

    def place(self, t_s: float) -> Place:
        """Return the offset (x, y) in m from the place of the drop."""
        x, y = (np.interp(t_s, self.times_s, along) for along in zip(*self.offsets_m, strict=True))
        return (float(x), float(y))


Course = Lift | Drag | PolygonalCourse
"""The place of a body over the skin at each time."""
