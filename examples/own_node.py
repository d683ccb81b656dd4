"""A node of your own: it logs the taxel with the largest force.

python examples/own_node.py
"""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import sparseskin
from sparseskin.nodes.node import Node
from sparseskin.nodes.settings import PatchSettings, setting

LAUNCH_FILE = """
[nodes.sensor]
type = "sensor"
source = "scene:lift_box_40"

[nodes.compressor]
type = "compressor"

[nodes.reconstructor]
type = "reconstructor"

[nodes.largest]
type = "own_node:Largest"
above_n = 0.2
"""


@dataclass(frozen=True)
class LargestSettings(PatchSettings):
    """Settings of the node."""

    above_n: float = setting(
        1.0, "least force that is logged, newtons", low=0.0, high=100.0
    )


class Largest(Node[LargestSettings]):
    """Logs where the largest reconstructed force is, and keeps it for the final report."""

    Settings = LargestSettings

    @classmethod
    def inputs(cls, settings):
        return (f"/{settings.patch}/reconstruction",)

    def step(self, message):
        force = float(message.forces.max())
        if force > self.settings.above_n:
            self.context.log(f"{force:.2f} N at taxel {message.forces.argmax()}")
        return ()


def main() -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder, "largest.toml")
        path.write_text(LAUNCH_FILE)
        launch = sparseskin.load_launch(str(path))
        print("nodes:", ", ".join(launch.nodes))
        n_frames = sum(1 for _ in sparseskin.run_launch(launch, 330))
        print(f"{n_frames} frames")


if __name__ == "__main__":
    main()
