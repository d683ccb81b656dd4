"""Addresses of scenes: scene:NAME, on a flat grid or on points."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sparseskin.messages.fields import MAX_ELEMENTS
from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.extensions import POINTS, loaded
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.sensor.calibration.description import SkinDescription
from sparseskin.nodes.sensor.points import point_scenes, point_skins
from sparseskin.nodes.sensor.skin_file import parse_skin
from sparseskin.nodes.sensor.source import Address, Listing, Source, about

from .scenes import SCENES, check_scene, open_scene
from .tiled import TILED, TiledScene

PITCH_MM = 5.0
"""Distance of taxels where none is stated, in mm: that of the paper's skin."""


class SceneAddress(Address):
    """A simulated scene."""

    form = "scene:NAME"
    delivers = "truth"
    keys = ()
    own = ("n_rows", "n_cols", "unit", "f_max", "skin", "tare", "drift", "f_min")

    def check(self) -> None:
        # Without opening a scene where its name shows the fault: a simulation loads slowly.
        name = self.rest
        on_grid = name in SCENES
        has_points = bool(self.points) or "points" in (self.simulated or {})
        if on_grid and has_points:
            allowed = ", ".join(point_scenes())
            raise SourceError(
                f"scene {name} presses a flat grid; allowed on points: {allowed}"
            )

        if name in TILED:
            self._check_size(self._described().shape)
        elif on_grid and self.n_patches > 1:
            # All patches show the same frames.
            self._check_size(self.open().skin.shape)
        elif self.points and name not in point_scenes():
            hint = did_you_mean(name, point_scenes())
            raise SourceError(f"no scene on points is called {name!r}{hint}")
        elif not self.points and not on_grid:
            if name in point_scenes():
                raise SourceError(
                    f"scene {name} presses a skin of points; state points, a file of "
                    "them"
                )
            check_scene(name, TILED)

    def _check_size(self, shape: tuple[int, int]) -> None:
        """Raise SourceError if the patches together have more cells than a message may hold."""
        if self.n_patches * math.prod(shape) > MAX_ELEMENTS:
            raise SourceError(
                f"{self.n_patches} patches of {shape[0]} x {shape[1]} cells; at most "
                f"{MAX_ELEMENTS} cells together: use more batches"
            )

    def _described(self) -> SkinDescription:
        """The skin of each patch of a body."""
        table: dict[str, Any] = {"name": self.rest, "f_max": PAPER_F_MAX_N}
        table |= self.simulated or {"n_rows": 64, "n_cols": 64}
        # The pitch of points follows from their places.
        if "points" not in table:
            table.setdefault("pitch_mm", PITCH_MM)
        return parse_skin(table, "simulated", Path())

    def n_taxels(self) -> int | None:
        if self.rest in TILED:
            return self._described().skin.n_taxels
        return self.open().skin.n_taxels

    def open(self) -> Source:
        if self.rest not in SCENES:
            self.check()
        if self.rest in TILED:
            described = self._described()
            return TiledScene(
                self.rest,
                described.skin,
                self.n_patches,
                active=self.active,
                seed=self.seed,
                sigmas=described.sigmas,
            )

        # Refused by `SensorSettings`; other callers have `open` alone.
        for name in ("n_rows", "n_cols", "unit", "f_max"):
            value = getattr(self.layout, name)
            if value is not None:
                raise SourceError(
                    f"{self.source}: {name} = {value} is stated, but a scene has its "
                    "own"
                )
        if not self.points:
            return open_scene(self.rest, seed=self.seed)
        return point_skins().open_scene(self.rest, self.points, self.seed)

    @classmethod
    def listings(cls) -> Sequence[Listing]:
        flat = {name: about(make) for name, make in SCENES.items()}
        listings = [
            Listing("scenes", "scenes", _entries(flat)),
            Listing(
                "points",
                "scenes that press a skin of points: add --set sensor.points=LAYOUT",
                _entries(point_scenes()),
            ),
        ]
        # Layouts that need no file, of the plug-in for points.
        for skins in loaded(POINTS).values():
            listings += skins.listings()
        return tuple(listings)


def _entries(scenes: Mapping[str, str]) -> list[dict[str, str]]:
    return [
        {"source": f"scene:{name}", "about": words} for name, words in scenes.items()
    ]
