"""The interface of skins of points, whose taxels form no flat grid, to the plug-in for them."""

from collections.abc import Mapping, Sequence
from typing import Protocol

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.extensions import POINTS, load, loaded, offered

from .calibration.description import Placement
from .source import Listing, Source

NAME = "points"
"""Name of the entry point."""


class PointSkins(Protocol):
    """What a plug-in brings for skins of points."""

    def n_taxels(self, layout: str) -> int:
        """Number of taxels of a layout, a path or `example:NAME`. Raises SourceError if it is
        missing or malformed.
        """

    def place(self, layout: str) -> Placement:
        """The placement of a layout; raises SourceError as `n_taxels`."""

    def scenes(self) -> Mapping[str, str]:
        """Names of scenes that press such a skin, and a few words on each."""

    def open_scene(self, name: str, layout: str, seed: int) -> Source:
        """One of `scenes` on a layout; raises SourceError as `n_taxels`."""

    def listings(self) -> Sequence[Listing]:
        """Layouts that need no file."""


def point_skins() -> PointSkins:
    """The plug-in for skins of points. Raises SourceError if there is none."""
    if NAME not in offered(POINTS):
        raise SourceError(
            f"skins of points need the plug-in {NAME}, which is not installed"
        )
    plugin: PointSkins = load(POINTS, NAME, SourceError)
    return plugin


def point_scenes() -> Mapping[str, str]:
    """Scenes on skins of points; none without the plug-in."""
    # Lists of scenes are for everybody: without the plug-in there is no fault.
    plugin: PointSkins | None = loaded(POINTS).get(NAME)
    if plugin is None:
        return {}
    return plugin.scenes()
