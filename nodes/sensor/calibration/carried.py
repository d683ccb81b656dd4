"""The calibration of a skin as messages and recordings carry it."""

from __future__ import annotations

import numpy as np

from sparseskin.messages import Calibration, SkinState
from sparseskin.nodes.numerics.arrays import Doubles, Floats

from .description import SkinDescription, points_on_grid
from .response import Response


def message_of(skin: SkinDescription, stamp_ns: int, patch: str) -> Calibration:
    """The calibration of a skin as a message, in float32."""
    reading = force = None
    if skin.response is not None:
        shape = skin.response.reading.shape
        reading = _single(skin.response.reading.reshape(*shape, *(1,) * (3 - len(shape))))
        force = _single(skin.response.force)
    return Calibration(
        stamp_ns=stamp_ns,
        patch=patch,
        name=skin.name,
        baseline=None if skin.baseline is None else _single(skin.baseline),
        gains=None if skin.gains is None else _single(skin.gains),
        response_reading=reading,
        response_force=force,
    )


def description_of(state: SkinState, calibration: Calibration) -> SkinDescription:
    """The skin that the messages of a patch describe, the inverse of `message_of` up to the
    rounding of float32.

    Raises
    ------
    SkinFileError
        If the messages, which may come from anywhere, contradict each other.
    """
    response = None
    if calibration.response_reading is not None and calibration.response_force is not None:
        reading = calibration.response_reading.astype(np.float64)
        if reading.shape[1:] == (1, 1) != (state.n_rows, state.n_cols):
            reading = reading[:, 0, 0]
        response = Response(reading, calibration.response_force.astype(np.float64))
    return SkinDescription(
        *(calibration.name, state.n_rows, state.n_cols, state.f_max, state.unit),
        pitch_mm=1000 * state.pitch_m if state.pitch_m else None,
        mask=state.mask,
        baseline=_double(calibration.baseline),
        gains=_double(calibration.gains),
        response=response,
        noise=state.sigma_end or None,
        noise_mid=state.sigma_mid if state.sigma_mid and state.sigma_end else None,
        f_min=state.f_min,
        points=points_on_grid(state.skin),
    )


def _single(array: Doubles) -> Floats:
    return np.ascontiguousarray(array, dtype=np.float32)


def _double(array: Floats | None) -> Doubles | None:
    return None if array is None else array.astype(np.float64)
