"""From recordings to a live label: three bodies are recognised from N/4 measurements.

A recording of each body trains the model of a node `recogniser`; then a graph labels bodies that
press at other places, with other forces. Needs scikit-learn: pip install 'sparseskin[tasks]'.

python examples/recogniser.py
"""

from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import sparseskin
from sparseskin.launch.commands.cli import main as command
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.presses import Timing, press_frames

BODIES = ("peg", "wrench", "fingertips")
GRAPH = """
[nodes.sensor]
type = "sensor"
source = "file:{recording}"
[nodes.compressor]
type = "compressor"
ratio = 4
[nodes.reconstructor]
type = "reconstructor"
[nodes.recogniser]
type = "recogniser"
model = "{model}"
"""


def recording(body: str, seeds: range, path: Path) -> Path:
    """A body that is pressed again and again on 20 x 20 taxels, in place of a skin of yours."""
    taps = Timing(
        untouched=0,
        contact=4,
        pause=1,
    )
    how = {
        "course": "sudden",
        "active": 0.2,
        "noise": NoiseModel(),
        "timing": taps,
    }
    frames = [
        r for seed in seeds for _, r in press_frames(body, (20, 20), 50, seed, **how)
    ]
    np.savez(
        path,
        forces=np.stack(frames),
        f_max=2.5,
        rate_hz=100.0,
        unit=np.array("N"),
    )
    return path


def main() -> None:
    with TemporaryDirectory() as name:
        folder = Path(name)
        files = [str(recording(b, range(15), folder / f"{b}.npz")) for b in BODIES]
        labels = folder / "labels.csv"
        labels.write_text(
            "recording,label\n" + "".join(f"{b}.npz,{b}\n" for b in BODIES)
        )
        out = str(folder / "model.joblib")
        if command(["tasks", "train", *files, "--labels", str(labels), "--out", out]):
            # The command has printed why: as a rule scikit-learn is not installed.
            raise SystemExit("the model was not trained")

        for body in BODIES:
            other = recording(body, range(100, 104), folder / f"other_{body}.npz")
            graph = folder / "graph.toml"
            graph.write_text(GRAPH.format(recording=other, model=out))
            pressed = [
                f for f in sparseskin.run_launch(str(graph)) if f.taxels.max() > 0.2
            ]
            counts = Counter(frame.label.label or "nothing" for frame in pressed)
            print(
                f"{body}:",
                ", ".join(f"{label} {n}" for label, n in counts.most_common()),
            )


if __name__ == "__main__":
    main()
