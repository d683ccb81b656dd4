"""Addresses of scenes: scene:NAME, on a flat grid or on points."""

from __future__ import annotations

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.source import Address, Source

from .scenes import SCENES, check_scene, open_scene


class SceneAddress(Address):
    """A simulated scene. Scenes on points take SciPy, which a flat grid does not need."""

    own = ("n_rows", "n_cols", "unit", "f_max", "skin", "tare", "drift", "f_min")

    def check(self) -> None:
        if self.rest in SCENES and not self.points:
            return
        from sparseskin.nodes.sensor.layouts.scenes import SCENES as ON_POINTS
        from sparseskin.nodes.sensor.layouts.scenes import check_point_scene

        if self.points:
            if self.rest in SCENES:
                known = ", ".join(ON_POINTS)
                raise SourceError(
                    f"scene {self.rest} presses a flat grid; allowed on points: {known}"
                )
            check_point_scene(self.rest)
        elif self.rest in ON_POINTS:
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
        from sparseskin.nodes.sensor.layouts.placing import placed
        from sparseskin.nodes.sensor.layouts.scenes import PointScene

        return PointScene(self.rest, placed(self.points), self.seed)
