"""From counts to newtons, with a picture: a skin is calibrated, then used while it drifts.

python examples/calibrate.py [OUT.png]

The skin has what real ones have: an offset and a gain of each taxel, a response that saturates,
noise, whole counts, two taxels that do not work, and offsets that drift as it warms up.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from sparseskin.launch.commands.cli import main as sparseskin
from sparseskin.nodes.sensor.calibration.chain import Chain
from sparseskin.nodes.sensor.skin_file import load_skin

try:
    import matplotlib.pyplot as plt
except ModuleNotFoundError:
    sys.exit("this example draws a picture: pip install 'sparseskin[charts]'")

plt.switch_backend("Agg")

ROWS = 16
COLS = 32
RATE_HZ = 10
MINUTES = 10
RNG = np.random.default_rng(0)
OFFSET = RNG.uniform(20, 90, (ROWS, COLS))
GAIN = RNG.lognormal(0, 0.25, (ROWS, COLS))
# counts of drift in the end, 7 in the median
WARMING = RNG.lognormal(2, 0.2, (ROWS, COLS))


def counts(forces, time_s=0.0):
    """Readings of 10 bits under forces in newtons, after the skin was in use for some time."""
    clean = (
        OFFSET
        + GAIN * 900 * forces / (forces + 1.2)
        + WARMING * (1 - np.exp(-time_s / 300))
    )
    noisy = clean + RNG.normal(0, 2, clean.shape)
    readings = np.round(np.clip(noisy, 0, 1023))
    readings[3, 4] = 0  # a broken wire
    readings[12, 20] = OFFSET[12, 20]  # a broken taxel
    return readings


def frames(forces, n=100):
    return np.stack([counts(np.broadcast_to(forces, (ROWS, COLS))) for _ in range(n)])


def pressed(time_s):
    """A fingertip: 20 s in each minute, at another place and with another force each time."""
    k = int(time_s // 60)
    rows, cols = np.mgrid[:ROWS, :COLS]
    shape = np.exp(-((rows - 4 - k % 8) ** 2 + (cols - 5 - 5 * (k % 5)) ** 2) / 8)
    return (0.1 + 0.04 * k) * shape * (time_s % 60 > 40)


def calibrate(folder: Path):
    """Untouched frames, and a plate on foam that presses all taxels evenly with five weights."""
    np.save(folder / "untouched.npy", frames(0.0))
    words = [
        "calibrate",
        f"file:{folder / 'untouched.npy'}",
        "--out",
        str(folder / "palm.toml"),
    ]
    words += [
        "--untouched",
        str(folder / "untouched.npy"),
        "--pitch-mm",
        "2",
        "--keep-noise",
    ]
    for load in ("1kg", "3kg", "8kg", "16kg", "28kg"):
        newtons = float(load[:-2]) * 9.80665
        np.save(folder / f"{load}.npy", frames(newtons / (ROWS * COLS)))
        words += ["--press", f"{load}@all:{folder / load}.npy"]
    if sparseskin(words):
        raise SystemExit("the calibration has failed")
    return load_skin(folder / "palm.toml")


def main(out: str = "calibrate.png") -> None:
    with TemporaryDirectory() as folder:
        skin = calibrate(Path(folder))
    # What one would do without: one factor for all counts above one offset.
    factor = 0.3 / np.mean(GAIN * 900 * 0.3 / 1.5)
    chains = {
        "one factor, one offset": lambda raw, _: factor * (raw - OFFSET.mean()),
        "calibrated": Chain(skin, drift_rate=0.0).apply,
        "calibrated, drift followed": Chain(skin).apply,
    }
    times_s = np.arange(0, 60 * MINUTES, 1 / RATE_HZ)
    totals = {name: [] for name in ("true", *chains)}
    errors = {name: [] for name in chains}
    works = skin.skin.exists
    for time_s in times_s:
        force = pressed(time_s)
        raw = counts(force, time_s)
        totals["true"].append(force[works].sum())
        for name, apply in chains.items():
            measured = apply(raw, round(time_s * 1e9))
            totals[name].append(measured[works].sum())
            touched = works & (force > 0.05)
            if touched.any():
                errors[name].append(measured[touched] / force[touched] - 1)

    true = np.array(totals["true"])
    touched = true > 0
    print(f"\n{MINUTES} minutes, {RATE_HZ} Hz, presses of {true[touched].min():.1f} to "
          f"{true.max():.1f} N; the last two minutes alone in brackets")  # fmt: skip
    print(f"{'':<28}{'total: error %':>18}{'taxel: RMS %':>18}{'untouched: N':>16}")
    late = times_s > 60 * (MINUTES - 2)
    for name in chains:
        total = np.array(totals[name])
        off = 100 * np.abs(total / np.where(touched, true, 1) - 1)
        rms = [100 * np.sqrt(np.mean(np.square(np.concatenate(errors[name][k:]))))
               for k in (0, -(late & touched).sum())]  # fmt: skip
        print(f"{name:<28}{off[touched].mean():>10.1f} ({off[touched & late].mean():.1f})"
              f"{rms[0]:>11.1f} ({rms[1]:.1f}){total[~touched].mean():>16.2f}")  # fmt: skip

    figure, ax = plt.subplots(
        figsize=(9, 4),
        dpi=90,
        layout="constrained",
    )
    colours = {
        "true": "black",
        **dict(zip(chains, ("#b9b9b9", "#c05a00", "#0b6a9c"), strict=True)),
    }
    for name, total in totals.items():
        ax.plot(
            times_s / 60,
            total,
            color=colours[name],
            label=name,
            lw=2 if name == "true" else 1,
        )
    ax.set(
        xlabel="minutes",
        ylabel="total force in N",
        ylim=(0, 2.2 * true.max()),
    )
    ax.legend(
        loc="upper left",
        ncols=2,
        frameon=False,
    )
    ax.spines[["top", "right"]].set_visible(False)
    figure.savefig(out)


if __name__ == "__main__":
    main(*sys.argv[1:2])
