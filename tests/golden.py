"""Reconstructions of the six scenes as hashes: `python tests/golden.py > tests/golden.json`.

The hashes hold for one version of numpy, scipy and OpenBLAS and for one of its kernels, so they
are computed in a process of their own that asks for a kernel which every x86-64-v3 host has.
"""

import hashlib
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterable
from typing import Any

ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "SPARSESKIN_FAST": "off",
}
#: First frame and number of frames of each scene: contact, from before its beginning in some.
WINDOWS = {
    "lift_box_40": (315, 80),
    "lift_wrench_40": (315, 80),
    "drag_wrench_40": (1550, 80),
    "path_40": (315, 80),
    "lift_box_64": (3230, 80),
    "drag_wrench_64": (4000, 80),
}
#: Rows, and iterations, of each preset.
ROWS = {"paper": ("paper", "rotating"), "skin": ("fixed", "rotating")}
ITERATIONS = {"paper": 30, "skin": 24}


def golden(
    scenes: Iterable[str] = WINDOWS, kernel: str | None = "Haswell"
) -> dict[str, Any]:
    """Versions; by "SCENE PRESET ROWS" the SHA-256 of the reconstructed forces, float32, and their
    mean PSNR over the contact frames (some force > 0.01 N), dB, for f_max = 2.5 N.

    `kernel` is the OpenBLAS kernel; None leaves the choice to OpenBLAS.
    """
    environment = {**os.environ, **ENVIRONMENT}
    if kernel is not None:
        environment["OPENBLAS_CORETYPE"] = kernel
    done = subprocess.run(
        [sys.executable, __file__, "--here", *scenes],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def versions() -> dict[str, str]:
    """The conditions on which the bits depend beside the code."""
    import numpy as np
    import scipy

    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    return {
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "blas": f"{blas['name']} {blas['version']}",
        "machine": platform.machine(),
    }


def main(scenes: Iterable[str]) -> None:
    import numpy as np

    from sparseskin.launch.launchfile.load import load
    from sparseskin.messages import Reconstruction, Taxels, Truth
    from sparseskin.nodes.bus import Bus

    hashes: dict[str, str] = {}
    psnr_db: dict[str, float] = {}
    for scene in scenes:
        first, count = WINDOWS[scene]
        # All frames: those of a launch file are for those who watch.
        sensor = load(scene, ["sensor.first=0", "sensor.every=1"]).nodes["sensor"]
        alone = Bus({"sensor": (sensor.cls, sensor.settings)})
        frames = list(alone.frames(first + count))[first:]
        taxels = [m for messages in frames for m in messages if isinstance(m, Taxels)]
        truth = np.stack(
            [m.forces[0] for frame in frames for m in frame if isinstance(m, Truth)]
        )
        for preset, kinds in ROWS.items():
            for rows in kinds:
                settings = [f"reconstructor.preset={preset}", f"compressor.rows={rows}"]
                # Whatever the host has time for.
                settings += [f"reconstructor.iterations={ITERATIONS[preset]}"]
                nodes = load(scene, settings).nodes
                bus = Bus(
                    {
                        n: (nodes[n].cls, nodes[n].settings)
                        for n in nodes
                        if n != "monitor"
                    }
                )
                made = [
                    message.forces[0]
                    for taxel in taxels
                    for measured in bus.hosts["compressor"].receive(taxel)
                    for message in bus.hosts["reconstructor"].receive(measured)
                    if isinstance(message, Reconstruction)
                ]
                assert len(made) == count
                name = f"{scene} {preset} {rows}"
                hashes[name] = hashlib.sha256(np.stack(made).tobytes()).hexdigest()
                error = np.stack(made).astype(np.float64) - truth
                rmse = np.sqrt(np.mean(error**2, axis=(1, 2)))[
                    truth.max(axis=(1, 2)) > 0.01
                ]
                psnr_db[name] = round(float(np.mean(20 * np.log10(2.5 / rmse))), 4)
    print(
        json.dumps(
            {"versions": versions(), "hashes": hashes, "psnr_db": psnr_db}, indent=2
        )
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--here"]:
        main(sys.argv[2:])
    else:
        json.dump(golden(), sys.stdout, indent=2)
        print()
