"""A glove whose readings are NaN where it has no taxel: 24 x 32 of Wuji, from 0 to 1.

sparseskin launch replay --set sensor.source=wuji_glove:frames --set sensor.f_max=1
  --set sensor.unit=raw --set sensor.nan=mask

Written by the published interface of `wujihandpy`; tested with an emulated glove alone.
"""

import queue
import time


def frames():
    from wujihandpy import tactile

    received = queue.SimpleQueue()
    with tactile.Glove() as glove:
        glove.start_streaming(
            lambda f: received.put((time.monotonic_ns(), f.pressure.copy()))
        )
        while True:
            yield received.get(timeout=2)
