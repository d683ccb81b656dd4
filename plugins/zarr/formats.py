"""Zarr as a format of recordings, and as a kind of export."""

from sparseskin.nodes.recorder.convert.export import Export
from sparseskin.nodes.sensor.files.format import Format

from .reader import MARKERS, ZarrRecording

FORMAT = Format({".zarr": "Zarr"}, ZarrRecording, markers=MARKERS)
EXPORT = Export(
    ".zarr",
    "sparseskin.plugins.zarr.export:export_zarr",
    {
        "side": (
            "SIDE",
            "side of the patches whose name states none (default: right)",
            str,
        ),
        "area": (
            "N",
            "functional area of the skins, as datasets number them (default: none)",
            int,
        ),
    },
    several=True,
)
