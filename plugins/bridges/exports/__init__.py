"""Exports of bags to the formats of other tools."""

from sparseskin.nodes.recorder.convert.export import Export

FOXGLOVE = Export("_foxglove.mcap", f"{__name__}.foxglove:export_foxglove")
LEROBOT = Export(
    "_lerobot",
    f"{__name__}.lerobot:export_lerobot",
    {
        "fps": ("N", "rows a second (default: 30)"),
        "contacts": (
            "K",
            "contacts of a patch in the state, the strongest (default: 4)",
        ),
        "window": ("K", "tactile frames a row (default: as many as come meanwhile)"),
        "into": (
            "DATASET",
            "join the frames into the episodes of this dataset, a copy",
            str,
        ),
        "offset": (
            "S",
            "seconds from the first frame to the first row, or one an episode",
            str,
        ),
    },
    several=True,
)
ROS2 = Export("_ros2", f"{__name__}.ros2:export_ros2")
