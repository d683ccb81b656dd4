"""A skin on a serial line: frames with start bytes and a checksum.

Each is AA 55, then 12 x 32 bytes row by row, then their sum modulo 256. As a pattern for other
lines: this one needs no code, but the source
serial:/dev/ttyUSB0?n_rows=12&n_cols=32&start=AA55&checksum=sum8&baud=2000000.

It needs the standard library alone; with pyserial (`pip install pyserial`),
`serial.Serial(DEVICE, 2000000, timeout=2)` and its `read` replace `opened` and `read`.

    SKIN_DEVICE=/dev/ttyUSB0 sparseskin launch replay --set sensor.source=serial_skin:frames
"""

import os
import select
import termios
import time
import tty

import numpy as np

DEVICE = os.environ.get("SKIN_DEVICE", "/dev/ttyUSB0")
SHAPE = (12, 32)
RANGE_N = 2.5
SILENT_S = 2.0
MARK = b"\xaa\x55"
SIZE = SHAPE[0] * SHAPE[1]


def opened():
    line = os.open(DEVICE, os.O_RDWR | os.O_NOCTTY)
    tty.setraw(line, termios.TCSANOW)
    state = termios.tcgetattr(line)
    state[4] = state[5] = termios.B2000000  # both ways
    termios.tcsetattr(line, termios.TCSANOW, state)
    return line


def read(line):
    if not select.select([line], [], [], SILENT_S)[0]:
        raise TimeoutError(f"{DEVICE}: nothing came for {SILENT_S:g} s")
    return os.read(line, 4096)


def frames():
    line = opened()
    waiting = b""
    n_bad = 0
    logged = 0
    try:
        while True:
            begin = waiting.find(MARK) + len(MARK)
            if begin < len(MARK):
                waiting = waiting[-1:] + read(line)  # its end may be half a mark
            elif len(waiting) <= begin + SIZE:
                waiting += read(line)
            elif sum(waiting[begin : begin + SIZE]) % 256 == waiting[begin + SIZE]:
                counts = np.frombuffer(waiting, "u1", SIZE, begin).reshape(SHAPE)
                yield time.monotonic_ns(), counts * (RANGE_N / 255)
                waiting = waiting[begin + SIZE + 1 :]
            else:
                waiting = waiting[begin:]
                n_bad += 1
                if n_bad > 2 * logged:  # at 1, 3, 7 ...
                    logged = n_bad
                    print(f"{DEVICE}: {n_bad} frames with a wrong sum")
    finally:
        os.close(line)
