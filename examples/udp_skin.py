"""A skin that sends each frame as one UDP packet: 40 x 40 unsigned 16-bit integers.

sparseskin launch replay --set sensor.source=udp_skin:frames

As a pattern for other packets: these need no code, but the source
udp:5005?n_rows=40&n_cols=40&dtype=uint16.
"""

import os
import socket
import sys
import time

import numpy as np

PORT = int(os.environ.get("SKIN_PORT", "5005"))
SHAPE = (40, 40)
RANGE_N = 2.5
SILENT_S = 2.0
SO_RXQ_OVFL = 40  # Linux: number of packets that the kernel has dropped


def frames():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as skin:
        skin.bind(("127.0.0.1", PORT))
        skin.settimeout(SILENT_S)
        skin.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        n_bad = n_dropped = logged = 0
        while True:
            try:
                packet, notes, _, sender = skin.recvmsg(65536, 64)
            except TimeoutError:
                raise TimeoutError(
                    f"no packet for {SILENT_S:g} s on port {PORT}"
                ) from None
            n_dropped = (
                max(int.from_bytes(n[2], sys.byteorder) for n in notes) if notes else 0
            )
            whole = len(packet) == 2 * SHAPE[0] * SHAPE[1]
            n_bad += not whole
            if n_bad + n_dropped > 2 * logged:  # at 1, 3, 7 ...
                logged = n_bad + n_dropped
                print(
                    f"{n_bad} packets of a wrong size, {n_dropped} dropped by the kernel"
                )
            if whole:
                # packets of others are dropped by the kernel from now on
                skin.connect(sender)
                counts = np.frombuffer(packet, "<u2").reshape(SHAPE)
                yield time.monotonic_ns(), counts * (RANGE_N / 65535)
