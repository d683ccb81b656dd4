"""Simulate a scene with noise, and reconstruct it by the paper's method and by the default.

python examples/noisy_scene.py
"""

import sparseskin


def main() -> None:
    truth, taxels = sparseskin.simulate("lift_box_40", 420)  # the box lands at frame 320
    phi = sparseskin.make_phi("sbhe", n=1600, m=533, seed=0)
    basis = sparseskin.make_basis("haar", 40, 40)
    measurements = sparseskin.compress(taxels, phi)
    contact = truth.max(axis=(1, 2)) > 0.01

    print(f"all taxels: {sparseskin.psnr_db(taxels, truth)[contact].mean():.1f} dB")
    for name in ("fista", "skin"):
        solver = sparseskin.make_solver(name, phi, basis)
        reconstructed = sparseskin.reconstruct(measurements, solver)
        print(f"N/3, {name}: {sparseskin.psnr_db(reconstructed, truth)[contact].mean():.1f} dB")


if __name__ == "__main__":
    main()
