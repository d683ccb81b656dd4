"""Choosing M, with a picture: PSNR over the number of measurements.

python examples/choosing_m.py [OUT.png]
"""

import sys

import numpy as np

import sparseskin

try:
    import matplotlib.pyplot as plt
except ModuleNotFoundError:
    sys.exit("this example draws a picture: pip install 'sparseskin[charts]'")

plt.switch_backend("Agg")

RATIOS = (2, 3, 4, 6, 8, 12)


def main(out: str = "choosing_m.png") -> None:
    truth, taxels = sparseskin.simulate("lift_box_40", 700)
    # The box lands at frame 320.
    truth = truth[300:]
    taxels = taxels[300:]
    contact = truth.max(axis=(1, 2)) > 0.01
    full = sparseskin.psnr_db(taxels, truth)[contact].mean()
    basis = sparseskin.make_basis("haar", 40, 40)
    n = taxels[0].size

    figure, ax = plt.subplots(
        figsize=(8, 4.8),
        dpi=90,
        layout="constrained",
    )
    ax.axhline(
        full,
        color="0.5",
        linestyle="--",
        label="all taxels (noisy)",
    )
    for name, label in (("fista", "preset paper"), ("skin", "preset skin")):
        means = []
        worst = []
        for ratio in RATIOS:
            phi = sparseskin.make_phi(
                "sbhe",
                n=n,
                m=int(n / ratio),
                seed=0,
            )
            solver = sparseskin.make_solver(name, phi, basis, rows="fixed")
            measurements = sparseskin.compress(taxels, phi, rows="fixed")
            reconstructed = sparseskin.reconstruct(measurements, solver)
            psnr = sparseskin.psnr_db(reconstructed, truth)[contact]
            means.append(psnr.mean())
            worst.append(psnr.min())
        (line,) = ax.plot(RATIOS, means, "o-", label=f"{label}, mean")
        ax.plot(
            RATIOS, worst, "o:", color=line.get_color(), label=f"{label}, worst frame"
        )
        good = [
            ratio for ratio, mean in zip(RATIOS, means, strict=True) if mean >= full
        ]
        fewest = f"N/{max(good):g}" if good else "none of these"
        print(
            f"{label}: fewest measurements with the mean PSNR of all taxels or more: {fewest}"
        )
    ax.set(
        xlabel="N / M",
        ylabel="PSNR of contact frames in dB",
        xscale="log",
    )
    ax.set_xticks(RATIOS, [f"{ratio:g}" for ratio in RATIOS])
    ax.minorticks_off()
    ax.legend(frameon=False)
    figure.savefig(out)
    print(
        f"mean of all taxels: {full:.1f} dB over {np.count_nonzero(contact)} contact frames"
    )


if __name__ == "__main__":
    main(*sys.argv[1:2])
