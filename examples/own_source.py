"""A sensor source of your own: a generator that yields (stamp_ns, forces).

python examples/own_source.py                                        # in one program
sparseskin launch replay --set sensor.source=own_source:frames       # as processes
"""

import time

import numpy as np

import sparseskin


def frames():
    """A fingertip that circles over 16 x 24 taxels; in place of hardware."""
    rows, cols = np.mgrid[0:16, 0:24]
    for k in range(200):
        row = 8 + 4 * np.sin(k / 30)
        col = 12 + 7 * np.cos(k / 30)
        pressed = (rows - row) ** 2 + (cols - col) ** 2 < 9
        yield time.monotonic_ns(), np.where(pressed, 0.4, 0.0)  # newtons, 0 to 2.5


def main() -> None:
    settings = ["sensor.source=own_source:frames"]
    for frame in sparseskin.run_launch("replay", 100, settings):
        newest = frame
    quality = sparseskin.psnr_db(newest.forces, newest.taxels)
    m = newest.measurements.size
    n = newest.taxels.size
    print(f"{m} of {n} numbers, {quality:.1f} dB to the taxels")


if __name__ == "__main__":
    main()
