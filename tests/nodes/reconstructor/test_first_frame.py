"""The first frame of a graph waits for nothing that could be ready before it."""

import subprocess
import sys

import pytest

CODE = """
import sys
import numpy as np
from sparseskin.messages import Measurements, PhiState, SkinState
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.sensor.node import Sensor

class Observed(Reconstructor):
    def step(self, message):
        before = set(sys.modules)
        made = list(super().step(message))
        print(type(message).__name__, len(made), sorted(set(sys.modules) - before))
        return made

settings = Reconstructor.Settings(preset=sys.argv[1], fast="off")
nodes = {
    "sensor": (Sensor, Sensor.Settings(source="scene:path_40")),
    "compressor": (Compressor, Compressor.Settings()),
    "reconstructor": (Observed, settings),
}
bus = Bus(nodes, ManualClock(0))
for _ in bus.frames(1):
    pass
assert "numba" not in sys.modules
"""


@pytest.mark.parametrize("preset", ["skin", "paper"])
def test_the_first_frame_imports_nothing_and_off_no_numba(preset):
    done = subprocess.run(
        [sys.executable, "-c", CODE, preset],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert done.stdout.splitlines()[-1] == "Measurements 1 []"
    assert "PhiState 1 []" in done.stdout
