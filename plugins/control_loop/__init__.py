"""Plug-in `control_loop`: the study of the ages at which a loop has forces and contacts."""

from sparseskin.studies.command import Study

STUDY = Study(
    "age of forces in a loop: Stream, subscribe, C++, ROS 2, beside topic echo",
    f"{__name__}.study:run",
)
