"""Contacts that the watch for idle patches misses, and its false alarms; the rest is in small.

The table of the documents is computed at full size.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from stress.contacts import FRAMES, false_alarms, missed

from sparseskin.messages.skin import Skin
from sparseskin.nodes.sensor.scenes.tiled import TiledScene

SIDE = 64


def test_strong_contacts_are_noticed_and_alarms_are_rare(full: bool, note: Any) -> None:
    n_patches, n_frames = (200, 640) if full else (20, 64)
    for contact in (4, 8, 16) if full else (8,):
        for sigmas in (1.0, 2.0, 3.0):
            shares = missed(SIDE, contact, sigmas, n_patches).shares
            found = {f"{k} frames": f"{s:.1%}" for k, s in zip(FRAMES, shares, strict=True)}
            note(touched=f"{contact} x {contact}", sigmas=sigmas, **found)
            assert sigmas < 3 or contact < 8 or shares[-1] == 0
    press = TiledScene("hug", Skin(SIDE, SIDE, 2.5, pitch_m=0.005), 1).forces(2.2)[0]
    for name, truth in (("untouched", np.zeros_like(press)), ("pressed", press)):
        share = false_alarms(truth, 16, n_frames)
        note(touched=f"false alarms, {name}", sigmas=f"{share:.2%}")
        assert share < 0.02
