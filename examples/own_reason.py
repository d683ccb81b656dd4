"""A fault reason of your own: a node beside the sensor marks frames in which all taxels rise.

python examples/own_reason.py
"""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import sparseskin
from sparseskin.messages import SkinState, Taxels
from sparseskin.nodes.node import Node
from sparseskin.nodes.settings import PatchSettings, setting

LAUNCH_FILE = """
[nodes.sensor]
type = "sensor"
source = "own_reason:humming"
n_rows = 16
n_cols = 16
f_max = 2.5
rate_hz = 0
patch = "raw"

[nodes.hum]
type = "own_reason:Hum"

[nodes.compressor]
type = "compressor"

[nodes.reconstructor]
type = "reconstructor"
"""
HUM = "hum"
"""The word of the reason."""


def humming():
    """Frames of an untouched skin; in the 20 in the middle all readings rise together."""
    rng = np.random.default_rng(0)
    for k in range(60):
        hum_n = 0.5 if 20 <= k < 40 else 0.0
        readings = hum_n + rng.normal(0, 0.02, (16, 16))
        yield k * 10_000_000, readings.astype(np.float32)


@dataclass(frozen=True)
class HumSettings(PatchSettings):
    """Settings of the node; `patch` is the name under which it passes frames on."""

    source: str = setting("raw", "name of the patch that the sensor publishes")
    rise_n: float = setting(
        0.2, "rise of the median taxel that is a hum, N", low=0.0, high=100.0
    )


class Hum(Node[HumSettings]):
    """Passes on skin and frames, and gives those a reason whose median taxel rises."""

    Settings = HumSettings

    def __init__(self, settings, context):
        super().__init__(settings, context)
        self._at_rest = None

    @classmethod
    def inputs(cls, settings):
        return (f"/{settings.source}/skin", f"/{settings.source}/taxels")

    @classmethod
    def outputs(cls, settings):
        return (f"/{settings.patch}/skin", f"/{settings.patch}/taxels")

    def step(self, message):
        message = replace(message, patch=self.settings.patch)
        if isinstance(message, SkinState):
            yield message
        elif isinstance(message, Taxels):
            # What the sensor states comes first.
            (of_sensor,) = message.reason or ("",)
            yield replace(message, reason=(of_sensor or self._reason(message.forces),))

    def _reason(self, forces):
        median = float(np.median(forces))
        if self._at_rest is None:
            self._at_rest = median
        return HUM if median > self._at_rest + self.settings.rise_n else ""


def main() -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder, "hum.toml")
        path.write_text(LAUNCH_FILE)
        frames = sparseskin.run_launch(sparseskin.load_launch(str(path)), 60)
        reasons = Counter(
            frame.reason or "trusted" for frame in frames if frame.patch == "skin"
        )
    for reason, n_frames in sorted(reasons.items()):
        print(f"{reason}: {n_frames} frames")


if __name__ == "__main__":
    main()
