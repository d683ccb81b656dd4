"""First contact, with a picture: a box lands on the skin, and one frame changes everything.

python examples/first_contact.py [OUT.png]
"""

import sys

import numpy as np

import sparseskin

try:
    import matplotlib.pyplot as plt
except ModuleNotFoundError:
    sys.exit("this example draws a picture: pip install 'sparseskin[charts]'")

plt.switch_backend("Agg")


def main(out: str = "first_contact.png") -> None:
    truth, taxels = sparseskin.simulate("lift_box_40", 420)
    phi = sparseskin.make_phi(
        "sbhe",
        n=1600,
        m=533,
        seed=0,
    )
    basis = sparseskin.make_basis("haar", 40, 40)
    measurements = sparseskin.compress(taxels, phi, rows="fixed")
    estimates = {"all taxels": taxels}
    for name, label in (("fista", "N/3, preset paper"), ("skin", "N/3, preset skin")):
        solver = sparseskin.make_solver(name, phi, basis, rows="fixed")
        estimates[label] = sparseskin.reconstruct(measurements, solver)

    touched = truth.max(axis=(1, 2)) > 0.01
    landing = int(np.argmax(touched))
    print(f"first contact in frame {landing}")

    figure = plt.figure(
        figsize=(11, 7),
        dpi=90,
        layout="constrained",
    )
    maps, curves = figure.subfigures(2, 1, height_ratios=(1, 1))
    number = landing + 4
    panels = {"true forces": truth, **estimates}
    axes = maps.subplots(1, len(panels))
    for ax, (label, frames) in zip(axes, panels.items(), strict=True):
        image = ax.imshow(frames[number], vmin=0, vmax=truth[number].max())
        ax.set(
            title=label,
            xticks=[],
            yticks=[],
        )
    maps.colorbar(
        image,
        ax=axes,
        label="force in N",
        shrink=0.8,
    )
    maps.suptitle(f"frame {number}, {1 + number - landing} ms after the first touch")

    ax = curves.subplots()
    window = slice(landing - 10, landing + 60)
    for label, frames in estimates.items():
        psnr = sparseskin.psnr_db(frames, truth)
        ax.plot(np.arange(len(psnr))[window], psnr[window], label=label)
        print(
            f"{label}: {psnr[touched].mean():.1f} dB mean, {psnr[touched].min():.1f} dB worst"
        )
    ax.axvline(landing, color="0.7")
    ax.set(xlabel="frame (1 ms each)", ylabel="PSNR in dB")
    ax.legend(
        frameon=False,
        loc="center right",
        bbox_to_anchor=(1, 0.42),
    )
    figure.savefig(out)


if __name__ == "__main__":
    main(*sys.argv[1:2])
