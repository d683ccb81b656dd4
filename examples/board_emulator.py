"""An emulated FlexiTac on a pseudo terminal: a ball that rolls over the skin. It prints the device.

With --still the ball stands; with --untouched 20 it is put on after 20 s, as for a calibration.
With --clock, frames have a time stamp after AA 55, of a clock that is 100 ppm fast, and are late by
up to 5 ms.

    python examples/board_emulator.py
    sparseskin scope "serial:DEVICE?profile=flexitac_16x32"

Its frames are those of the firmware: AA 55, then 16 x 32 bytes row by row, without a checksum.
"""

import argparse
import os
import pty
import time
import tty

import numpy as np

MARK = b"\xaa\x55"
SHAPE = (16, 32)
UNTOUCHED = 4.0  # counts
PRESSED = 180.0  # counts
NOISE = 1.0  # counts, standard deviation
RADIUS = 3.0  # taxels
FAST = 100e-6  # part by which its clock is fast
LATE_S = 0.005  # most time from a stamp to its frame, seconds


def reading(t_s, rng, options):
    rows, cols = np.indices(SHAPE)
    row = 7.5
    col = 15.5
    if not options.still:
        row += 5 * np.sin(1.3 * t_s)
        col += 12 * np.sin(0.7 * t_s)
    distance2 = (rows - row) ** 2 + (cols - col) ** 2
    press = np.exp(-distance2 / RADIUS**2)
    if t_s < options.untouched:
        press = 0.0
    counts = UNTOUCHED + PRESSED * press + NOISE * rng.standard_normal(SHAPE)
    return np.clip(counts, 0, 255).astype(np.uint8)


def main():
    parser = argparse.ArgumentParser(
        description="An emulated FlexiTac on a pseudo terminal."
    )
    parser.add_argument(
        "--rate",
        type=float,
        default=100.0,
        help="frames a second",
    )
    parser.add_argument(
        "--frames",
        type=int,
        default=10**9,
        help="frames to send",
    )
    parser.add_argument(
        "--clock", action="store_true", help="time stamps, us (u32), and jitter"
    )
    parser.add_argument("--still", action="store_true", help="the ball does not move")
    about = "seconds before the ball is put on"
    parser.add_argument(
        "--untouched",
        type=float,
        metavar="S",
        default=0.0,
        help=about,
    )
    options = parser.parse_args()
    board, host = pty.openpty()
    tty.setraw(host)
    os.set_blocking(board, False)
    print(os.ttyname(host), flush=True)
    rng = np.random.default_rng(0)
    begin = time.monotonic()
    sent = dropped = 0
    remainder = b""  # of the frame that the line has taken in part
    for k in range(options.frames):
        time.sleep(max(0.0, begin + k / options.rate - time.monotonic()))
        head = MARK
        if options.clock:
            ticks = int((time.monotonic() - begin) * 1e6 * (1 + FAST)) % 2**32
            head += ticks.to_bytes(4, "little")
            time.sleep(rng.uniform(0, LATE_S))
        frame = head + reading(k / options.rate, rng, options).tobytes()
        frame = remainder or frame
        try:  # as a real line, it does not wait for a reader
            n_taken = os.write(board, frame)
            remainder = frame[n_taken:]
            sent += not remainder
        except BlockingIOError:
            dropped += 1
    print(f"{sent} frames sent, {dropped} not: nobody read")


if __name__ == "__main__":
    main()
