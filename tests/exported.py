"""Bags with all that exports must keep."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from bags import MASK, N_COLS, N_ROWS, PERIOD_NS, PHI, M, frame, make_bag, skin_state

from sparseskin.messages import Calibration, Contacts, PhiState, SkinState, SolverState
from sparseskin.messages.base import Message
from sparseskin.messages.quantised import Quantised

N_FRAMES = 12


def contacts(k: int, n: int | None = None) -> Contacts:
    """n or k % 3 contacts of frame k, which begin in that frame; of one alone the place."""
    n = k % 3 if n is None else n
    ones, pairs = np.full(n, 0.5 + k, np.float32), np.full((n, 2), 0.25 * k, np.float32)
    ids, flags = np.arange(1, n + 1, dtype=np.int32), np.zeros(n, np.bool_)
    place = {"place_mm": np.ones((1, 3), np.float32)} if n == 1 else {}
    events = {"events": np.array([(0, one, 0) for one in ids], np.int32)} if n else {}
    return Contacts(
        **{
            "stamp_ns": k * PERIOD_NS,
            "patch": "skin",
            "done_ns": 3,
            "id": ids,
            "area": ids,
        },
        **dict.fromkeys(("total", "total_sd", "peak", "age_s"), ones),
        **dict.fromkeys(("centre", "centre_sd", "velocity"), pairs),
        **dict.fromkeys(("over", "sliding"), flags),
        **place,
        **events,
        trusted=k != 4,
    )


def rich_frames() -> list[Message]:
    """Messages with all that exports must keep: each optional field both with and without."""
    found: list[Message] = [
        skin_state(),
        PhiState(
            stamp_ns=1,
            patch="skin",
            kind="sbhe",
            n=34,
            m=M,
            block=32,
            seed=7,
            fingerprint=PHI,
        ),
        SolverState(
            stamp_ns=1,
            patch="skin",
            solver="skin",
            basis="",
            preset="",
            iterations=3,
            lambda_n=0.0,
        ),
    ]
    for k in range(N_FRAMES):
        taxels, truth, measurements, reconstruction = frame(k)
        rng = np.random.default_rng(100 + k)
        if k % 3 == 1:
            codes = rng.integers(-7, 8, M).astype(np.int32)
            measurements = replace(measurements, y=Quantised.of(codes, 4, 0.125))
        if k % 3 == 2:
            places = np.packbits(np.arange(N_ROWS * N_COLS) < M - k % 2)
            y = rng.normal(size=M - k % 2).astype(np.float32)
            measurements = replace(measurements, y=y, places=places)
        if k % 2:
            sd = rng.uniform(0, 0.1, (N_ROWS, N_COLS)).astype(np.float32)
            reconstruction = replace(
                reconstruction, sd=sd, error=(0.25,), trusted=(k != 3,), skipped=k
            )
        found += [taxels, truth, measurements, reconstruction, contacts(k)]
        if k == 5:
            found.append(
                replace(skin_state(), stamp_ns=k * PERIOD_NS, rate_hz=50.0, mask=None)
            )
            gains = np.full((N_ROWS, N_COLS), 2.0, np.float32)
            reading = np.arange(3, dtype=np.float32).reshape(3, 1, 1)
            found.append(
                Calibration(
                    stamp_ns=k * PERIOD_NS,
                    patch="skin",
                    name="palm",
                    baseline=None,
                    gains=gains,
                    response_reading=reading,
                    response_force=reading.ravel(),
                )
            )
    return [m.published("0123456789abcdef", seq) for seq, m in enumerate(found)]


def points_bag(path: Path) -> SkinState:
    """Make a bag of a skin of points from a file, whose order is not that of the grid."""
    rng, n = np.random.default_rng(5), int(MASK.sum())
    points = np.zeros((n, 6), np.float32)
    points[:, :3], points[:, 5] = rng.normal(size=(n, 3)), 1
    rows = rng.permutation(n).astype(np.int32)
    state = replace(skin_state(), points=points, point_rows=rows)
    make_bag(path, [state, *frame(0), *frame(1)])
    return state
