"""Plug-in `points`: skins whose taxels stand at free places, on a virtual grid; scenes on them."""

from collections.abc import Mapping, Sequence

from sparseskin.nodes.sensor.calibration.description import Placement
from sparseskin.nodes.sensor.points import PointSkins
from sparseskin.nodes.sensor.source import Listing, Source, about

# The modules of this package take SciPy, which a node without such a skin does not need.


class _Points(PointSkins):
    def n_taxels(self, layout: str) -> int:
        from .files import load_points

        return load_points(layout).n

    def place(self, layout: str) -> Placement:
        from .placing import placed

        return placed(layout)

    def scenes(self) -> Mapping[str, str]:
        from .scenes import SCENES

        return {name: scene.about() for name, scene in SCENES.items()}

    def open_scene(self, name: str, layout: str, seed: int) -> Source:
        from .placing import placed
        from .scenes import PointScene

        return PointScene(name, placed(layout), seed)

    def listings(self) -> Sequence[Listing]:
        from .examples import EXAMPLES
        from .files import EXAMPLE

        entries = [
            {"name": f"{EXAMPLE}{name}", "about": about(make)}
            for name, make in EXAMPLES.items()
        ]
        title = (
            "layouts: for sensor.points; or a file of places, .csv or an iCub's .txt"
        )
        return (Listing("layouts", title, entries),)


POINTS = _Points()
