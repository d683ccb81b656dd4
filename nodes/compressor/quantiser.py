"""The quantiser at the edge: measurements in few bits."""

import numpy as np

from sparseskin.messages.quantised import Quantised, largest_code
from sparseskin.nodes.numerics.arrays import Floats

SMALLEST = 1e-12
"""Least scale of a frame, newtons: a frame of zeros needs some step above 0. Chosen."""


def quantised(y: Floats, bits: int) -> Quantised:
    """Round the measurements of a frame, float32 newtons of any shape, to 2..24 bits.

    Codes are round(y / step), with step = max |y| / (2^(bits - 1) - 1) of this frame, which is
    published with them: none is clipped. The error is at most half a step (and the rounding of
    a float32), and nearly uniform: its standard deviation is step / sqrt(12).

    Source: uniform mid-tread quantiser; Widrow, Kollar, "Quantization Noise", Cambridge
    University Press, 2008, chapter 1.
    """
    # The largest measurement of the frame has the largest code.
    top = largest_code(bits)
    sizes = np.abs(y)
    largest = max(float(sizes.max()), SMALLEST)
    step = np.float32(largest / top)

    # In float64: at 16 bits the rounding of a float32 quotient would show.
    quotients = np.divide(y, step, dtype=np.float64)
    # The step was rounded to float32: with 24 bits the largest code may come out 1 too large.
    rounded = np.rint(quotients)
    codes = np.clip(rounded, -top, top)
    return Quantised.of(codes.astype(np.int32), bits, float(step))
