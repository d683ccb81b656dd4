"""Record a graph into an MCAP file, and read it into arrays.

python examples/read_recording.py
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import sparseskin


def main() -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder, "box.mcap")
        launch = sparseskin.load_launch("lift_box_40", record=str(path))
        for _ in sparseskin.run_launch(launch, 50):
            pass
        recording = sparseskin.read_recording(path)
    for name, value in recording.items():
        print(name, getattr(value, "shape", value))


if __name__ == "__main__":
    main()
