"""Your own skin, with a picture: read a recording, compress it, look at the error.

python examples/your_own_skin.py [OUT.png [RECORDING]]
"""

import sys

import numpy as np

import sparseskin

try:
    import matplotlib.pyplot as plt
except ModuleNotFoundError:
    sys.exit("this example draws a picture: pip install 'sparseskin[charts]'")

plt.switch_backend("Agg")


def main(out: str = "your_own_skin.png", path: str = "example:fingers") -> None:
    recording = sparseskin.read_recording(path)
    taxels = recording["forces"]
    unit = recording["unit"]
    n_rows, n_cols = taxels.shape[1:]
    # True where a taxel exists
    mask = recording.get("mask", np.ones((n_rows, n_cols), bool))
    n = int(mask.sum())

    loaded = taxels.max(axis=(1, 2)) > 0.1 * recording["f_max"]
    strongest = int(taxels.sum(axis=(1, 2)).argmax())
    panels = {"readings": taxels[strongest]}
    for ratio in (2, 4, 8):
        phi = sparseskin.make_phi(
            "sbhe",
            n=n,
            m=n // ratio,
            seed=0,
        )
        basis = sparseskin.make_basis("haar", n_rows, n_cols)
        solver = sparseskin.make_solver("skin", phi, basis, mask, rows="fixed")
        measurements = sparseskin.compress(taxels, phi, mask, rows="fixed")
        forces = sparseskin.reconstruct(measurements, solver)
        norms = np.linalg.norm((forces - taxels)[loaded], axis=(1, 2))
        error = np.median(norms / np.linalg.norm(taxels[loaded], axis=(1, 2)))
        panels[f"N/{ratio}: error {error:.1%}"] = forces[strongest]
        print(
            f"N/{ratio}: median relative error {error:.1%} over {loaded.sum()} loaded frames"
        )

    figure, axes = plt.subplots(
        1,
        len(panels),
        figsize=(10, 2.9),
        dpi=90,
        layout="constrained",
    )
    for ax, (label, frame) in zip(axes, panels.items(), strict=True):
        image = ax.imshow(frame, vmin=0, vmax=taxels[strongest].max())
        ax.set(
            title=label,
            xticks=[],
            yticks=[],
        )
    figure.colorbar(image, ax=axes, label=f"readings, {unit}")
    figure.savefig(out)


if __name__ == "__main__":
    main(*sys.argv[1:3])
