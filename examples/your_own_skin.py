"""Your own skin, with a picture: read a recording, compress it, look at the error.

python examples/your_own_skin.py [OUT.png]

Replace `write_recording` by a file of yours: Novel emed .lst, Tekscan .csv or .asf, XSENSOR .csv,
.npy, .npz.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib
import numpy as np

import sparseskin

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def write_recording(path: Path) -> None:
    """60 frames of a heel that presses on 32 x 20 taxels, in newtons; noise of 5 mN."""
    rows, cols = np.mgrid[0:32, 0:20]
    shape = np.exp(-((((rows - 20) / 6) ** 2 + ((cols - 10) / 4) ** 2) ** 2))
    load = np.sin(np.linspace(0, np.pi, 60))[:, None, None]
    noise = np.random.default_rng(0).normal(0, 0.005, (60, 32, 20))
    np.save(path, np.clip(1.8 * load * shape + noise, 0, None).astype(np.float32))


def main(out: str = "your_own_skin.png") -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder, "heel.npy")
        write_recording(path)
        recording = sparseskin.read_recording(path, unit="N", f_max=2.5, rate_hz=100)
    taxels = recording["forces"]
    n_rows, n_cols = taxels.shape[1:]
    n = n_rows * n_cols  # without the masked cells, where recording["mask"] states some

    loaded = taxels.max(axis=(1, 2)) > 0.1
    shown = int(taxels.sum(axis=(1, 2)).argmax())
    panels = {"readings": taxels[shown]}
    for ratio in (2, 4, 8):
        phi = sparseskin.make_phi("sbhe", n=n, m=n // ratio, seed=0)
        basis = sparseskin.make_basis("haar", n_rows, n_cols)
        solver = sparseskin.make_solver("skin", phi, basis, rows="fixed")
        forces = sparseskin.reconstruct(sparseskin.compress(taxels, phi, rows="fixed"), solver)
        norms = np.linalg.norm((forces - taxels)[loaded], axis=(1, 2))
        error = np.median(norms / np.linalg.norm(taxels[loaded], axis=(1, 2)))
        panels[f"N/{ratio}: error {error:.1%}"] = forces[shown]
        print(f"N/{ratio}: median relative error {error:.1%} over {loaded.sum()} loaded frames")

    figure, axes = plt.subplots(1, len(panels), figsize=(10, 4.4), dpi=90, layout="constrained")
    for ax, (label, frame) in zip(axes, panels.items(), strict=True):
        image = ax.imshow(frame, vmin=0, vmax=taxels[shown].max())
        ax.set(title=label, xticks=[], yticks=[])
    figure.colorbar(image, ax=axes, label="force in N")
    figure.savefig(out)


if __name__ == "__main__":
    main(*sys.argv[1:2])
