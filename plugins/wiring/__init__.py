"""Plug-in `wiring`: wires that a measurement matrix needs, and the study of them."""

from sparseskin.studies.command import Study

STUDY = Study(
    "PSNR against the length of wires, from local to scrambled sums",
    f"{__name__}.study:run",
    numpy_only=True,
)
