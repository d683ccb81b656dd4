"""Addresses of scenes: scene:NAME, on a flat grid or on points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.extensions import POINTS, loaded
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.sensor.points import point_scenes, point_skins
from sparseskin.nodes.sensor.source import Address, Listing, Source, about

from .scenes import SCENES, check_scene, open_scene


class SceneAddress(Address):
    """A simulated scene."""

    form = "scene:NAME"
    own = ("n_rows", "n_cols", "unit", "f_max", "skin", "tare", "drift", "f_min")

    def check(self) -> None:
        if self.rest in SCENES and not self.points:
            return
        on_points = point_scenes()
        if self.points:
            if self.rest in SCENES:
                known = ", ".join(on_points)
                raise SourceError(
                    f"scene {self.rest} presses a flat grid; allowed on points: {known}"
                )
            if self.rest not in on_points:
                hint = did_you_mean(self.rest, on_points)
                raise SourceError(f"no scene on points is called {self.rest!r}{hint}")
        elif self.rest in on_points:
            raise SourceError(
                f"scene {self.rest} presses a skin of points; state points, a file of them"
            )
        else:
            check_scene(self.rest)

    def n_taxels(self) -> int | None:
        return self.open().skin.n_taxels

    def open(self) -> Source:
        self.check()
        for name in ("n_rows", "n_cols", "unit", "f_max"):
            value = getattr(self, name)
            if value is not None:
                raise SourceError(
                    f"{self.source}: {name} = {value} is stated, but a scene has its own"
                )
        if not self.points:
            return open_scene(self.rest, seed=self.seed)
        return point_skins().open_scene(self.rest, self.points, self.seed)

    @classmethod
    def listings(cls) -> Sequence[Listing]:
        flat = {name: about(make) for name, make in SCENES.items()}
        title = "scenes that press a skin of points: add --set sensor.points=LAYOUT"
        return (
            Listing("scenes", "scenes", _entries(flat)),
            Listing("points", title, _entries(point_scenes())),
            *(one for skins in loaded(POINTS).values() for one in skins.listings()),
        )


def _entries(scenes: Mapping[str, str]) -> list[dict[str, str]]:
    return [{"source": f"scene:{name}", "about": words} for name, words in scenes.items()]
