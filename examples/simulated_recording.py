"""Frames of any simulator as a file that the sensor reads: the way for Isaac Lab and Genesis.

Their arrays are tensors (environments, rows, columns), one a step. Collect those of one
environment, `.cpu().numpy()`, and write them once, as below.
Here a Gaussian bump stands for the simulator.
"""

from __future__ import annotations

import numpy as np

import sparseskin

N_STEPS = 300
N_ROWS = 24
N_COLS = 24
STEP_S = 0.002
PITCH_M = 0.004


def step(k):
    """Normal forces of the taxels in newtons after step k, (rows, columns)."""
    row, col = np.mgrid[:N_ROWS, :N_COLS]
    at_row = 6 + 12 * k / N_STEPS
    at_col = 11.5
    force = 0.8 * np.sin(np.pi * k / N_STEPS)
    return force * np.exp(-((row - at_row) ** 2 + (col - at_col) ** 2) / (2 * 2.5**2))


frames = np.stack([step(k) for k in range(N_STEPS)]).astype(np.float32)
frames[frames < 1e-3] = 0.0  # a bump has no edge, a contact has one
np.savez_compressed(
    "simulated.npz",
    forces=frames,  # (frames, rows, columns), 0 or more
    stamp_ns=np.arange(N_STEPS) * round(STEP_S * 1e9),  # rising, nanoseconds
    unit=np.array("N"),
    f_max=2.5,  # upper end of a taxel's range
    pitch_m=PITCH_M,
    rate_hz=1 / STEP_S,
)

settings = [
    "sensor.source=file:simulated.npz",
    "sensor.rate_hz=0",
    "compressor.ratio=4",
]
trusted = [
    (sparseskin.psnr_db(frame.forces, frame.taxels, f_max=2.5), frame.trusted)
    for frame in sparseskin.run_launch("replay", N_STEPS, settings)
]
psnr = np.array([value for value, _ in trusted])
n_trusted = sum(flag for _, flag in trusted)
print(f"N/4: PSNR {psnr.mean():.1f} dB in the mean, {psnr.min():.1f} dB at least;")
print(f"{n_trusted} of {N_STEPS} frames are trusted")
