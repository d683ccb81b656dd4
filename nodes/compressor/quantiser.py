"""The edge's quantiser: measurements in few bits."""

from __future__ import annotations

import numpy as np

from sparseskin.messages.quantised import Quantised, largest_code

from .calls import Floats

SMALLEST = 1e-12
"""A frame of zeros has no largest value; any step will do for it."""


def quantised(y: Floats, bits: int) -> Quantised:
    """Round a frame's measurements to `bits` bits; the step is a frame's own and goes with it.

    The largest measurement of the frame sets the step, so that none is clipped: the steps are
    small where the forces are. The error is at most half a step (and a float32's rounding), and
    as good as uniform: its standard deviation is step / sqrt(12).

    Parameters
    ----------
    y : ndarray of float32, shape (m,)
        Measurements, newtons.
    bits : int
        2..24.

    Source: uniform mid-tread quantiser; Widrow, Kollar, "Quantization Noise", Cambridge
    University Press, 2008, chapter 1.
    """
    top = largest_code(bits)
    step = np.float32(max(float(np.abs(y).max()), SMALLEST) / top)
    # In float64: at 16 bits the rounding of a float32 quotient would show.
    codes = np.clip(np.rint(np.divide(y, step, dtype=np.float64)), -top, top).astype(np.int32)
    return Quantised.of(codes, bits, float(step))
