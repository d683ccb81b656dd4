"""Run the examples and keep what they print and draw, for the pages of the gallery: make gallery.

The picture of an example that draws none is the frame with the largest sum of forces among those
that it reconstructs last.
"""

from __future__ import annotations

import ast
import contextlib
import io
import os
import re
import runpy
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import sparseskin

ROOT = Path(__file__).resolve().parents[2]
PICTURES, OUTPUTS = ROOT / "docs/pictures", ROOT / "docs/reference/examples.toml"
#: Drivers of hardware, and jobs of several processes or hosts.
NOT_RUN = {
    "serial_skin",
    "udp_skin",
    "wuji_glove",
    "mpi_pool",
    "dask_pool",
    "ray_pool",
}
ARGUMENTS = {"board_emulator": ["--frames", "3"]}
PRESSED_N = 0.1
"""Largest force of a frame that is worth a picture."""


def main(names: list[str]) -> None:
    found = {path.stem: path for path in sorted((ROOT / "examples").glob("*.py"))}
    sections = []
    for name in names or sorted(found.keys() - NOT_RUN):
        print(name, flush=True)
        sections.append(f"{name} = '''\n{run(found[name])}'''\n")
    if not names:
        OUTPUTS.write_text("# Written by `make gallery`.\n" + "".join(sections))


def run(path: Path) -> str:
    """Run an example in an empty folder; what it prints."""
    printed, best = io.StringIO(), Best()
    draws = "OUT.png" in (ast.get_docstring(ast.parse(path.read_text())) or "")
    picture = PICTURES / f"{path.stem}.png"
    sys.argv = [str(path), *([str(picture)] if draws else ARGUMENTS.get(path.stem, []))]
    sys.path.insert(0, str(path.parent))
    with (
        tempfile.TemporaryDirectory() as folder,
        best,
        contextlib.redirect_stdout(printed),
    ):
        os.chdir(folder)
        runpy.run_path(str(path), run_name="__main__")
        os.chdir(ROOT)
    if not draws and best.maps and best.maps[0].max() > PRESSED_N:
        draw(picture, *best.maps)
    text = re.sub(rf"{tempfile.gettempdir()}/\w+", "/tmp/folder", printed.getvalue())
    return "".join(f"{line.rstrip()}\n" for line in text.splitlines())


class Best:
    """Notes the forces that pass through `sparseskin`, and keeps readings and reconstruction."""

    def __init__(self) -> None:
        self.maps: tuple[Any, ...] = ()

    def __enter__(self) -> None:
        self._own = {
            n: getattr(sparseskin, n) for n in ("compress", "reconstruct", "run_launch")
        }
        for name in self._own:
            setattr(sparseskin, name, getattr(self, name))

    def __exit__(self, *_: object) -> None:
        for name, own in self._own.items():
            setattr(sparseskin, name, own)

    def compress(self, forces: Any, *more: Any, **options: Any) -> Any:
        self._forces = forces
        return self._own["compress"](forces, *more, **options)

    def reconstruct(self, measurements: Any, *more: Any, **options: Any) -> Any:
        made = self._own["reconstruct"](measurements, *more, **options)
        shape = (-1, *made.shape[-2:])
        read, solved = np.reshape(self._forces, shape), made.reshape(shape)
        k = int(solved.sum(axis=(1, 2)).argmax())
        self.maps = read[k], solved[k], measurements.shape[-1]
        return made

    def run_launch(self, *words: Any, **options: Any) -> Any:
        largest = -1.0
        for frame in self._own["run_launch"](*words, **options):
            if frame.forces is not None and frame.forces.sum() > largest:
                largest = frame.forces.sum()
                self.maps = (
                    frame.taxels.copy(),
                    frame.forces.copy(),
                    frame.measurements.size,
                )
            yield frame


def draw(path: Path, read: Any, made: Any, n: int) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(6, 3), dpi=80, layout="constrained")
    titles = f"readings of {read.size} cells", f"reconstructed from {n} numbers"
    for ax, forces, title in zip(axes, (read, made), titles, strict=True):
        image = ax.imshow(
            forces, vmin=0, vmax=float(read.max()), interpolation="nearest"
        )
        ax.set_title(title, fontsize=10)
        ax.set(xticks=[], yticks=[])
    figure.colorbar(image, ax=axes, label="force in N", shrink=0.8)
    figure.savefig(path)
    plt.close(figure)


if __name__ == "__main__":
    main(sys.argv[1:])
