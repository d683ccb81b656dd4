"""Messages of every class with any values, for properties of their wire forms."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sparseskin.messages import (
    Calibration,
    End,
    Measurements,
    Message,
    PhiState,
    Reconstruction,
    Resultant,
    SkinState,
    SolverState,
    Taxels,
    Truth,
)
from sparseskin.messages.batches import BATCHES, MeasurementsBatch, ReconstructionBatch
from sparseskin.messages.fields import MAX_ELEMENTS

names = st.from_regex(r"[a-z][a-z0-9_]{0,31}", fullmatch=True)
numbers = st.integers(0, 2**63 - 1)
positive = st.floats(0, 1e30, allow_nan=False)
texts = st.text(
    st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), min_size=0, max_size=32
)
prints = st.from_regex(r"[0-9a-f]{16}", fullmatch=True)
headers = {"stamp_ns": numbers, "patch": names, "run_id": prints | st.just(""), "seq": numbers}


def forces(ndim: int) -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(
        np.float32,
        hnp.array_shapes(min_dims=ndim, max_dims=ndim, min_side=1, max_side=12),
        elements=st.floats(-(2.0**100), 2.0**100, width=32, allow_nan=False, allow_infinity=False),
    )


def points(n: int) -> st.SearchStrategy[np.ndarray]:
    """Places and unit normals of n taxels."""
    places = hnp.arrays(np.float32, (n, 3), elements=st.floats(-1000, 1000, width=32))
    axes = hnp.arrays(np.int8, n, elements=st.integers(0, 2))
    unit = np.eye(3, dtype=np.float32)
    return st.builds(lambda p, k: np.concatenate([p, unit[k]], axis=1), places, axes)


@st.composite
def skin_states(draw: st.DrawFn) -> SkinState:
    shape = draw(st.tuples(st.integers(1, 9), st.integers(1, 9)))
    mask = draw(st.none() | hnp.arrays(np.bool_, shape).filter(lambda m: m.any()))
    n = shape[0] * shape[1] if mask is None else int(mask.sum())
    placed = draw(st.none() | points(n))
    rows = st.none() | hnp.arrays(np.int32, n, elements=st.integers(0, 2**31 - 1))
    return SkinState(
        **{key: draw(value) for key, value in headers.items()},
        n_rows=shape[0],
        n_cols=shape[1],
        f_max=draw(st.floats(1e-6, 1e6)),
        unit=draw(texts),
        pitch_m=draw(st.none() | positive),
        mask=mask,
        source=draw(texts),
        seed=draw(numbers),
        rate_hz=draw(positive),
        has_truth=draw(st.booleans()),
        sigma_mid=draw(positive),
        sigma_end=draw(positive),
        f_min=-draw(positive),
        points=placed,
        point_rows=None if placed is None else draw(rows),
    )


@st.composite
def calibrations(draw: st.DrawFn) -> Calibration:
    shape = draw(st.tuples(st.integers(1, 6), st.integers(1, 6)))
    k = draw(st.integers(1, 4))
    values = st.floats(-1e6, 1e6, width=32)
    grids = st.none() | hnp.arrays(np.float32, shape, elements=values)
    curves = draw(st.sampled_from([None, (k, 1, 1), (k, *shape)]))
    return Calibration(
        **{key: draw(value) for key, value in headers.items()},
        name=draw(texts),
        baseline=draw(grids),
        gains=draw(grids),
        response_reading=None if curves is None else np.ones(curves, np.float32),
        response_force=None if curves is None else np.ones(k, np.float32),
    )


@st.composite
def reconstructions_with_sd(draw: st.DrawFn) -> Reconstruction:
    restored = draw(forces(2))
    return Reconstruction(
        **{key: draw(value) for key, value in headers.items()},
        forces=restored,
        phi=draw(prints),
        iterations=3,
        residual=draw(positive),
        solve_ns=draw(numbers),
        done_ns=draw(numbers),
        sd=np.abs(restored),
    )


@st.composite
def batches(draw: st.DrawFn) -> Message:
    """A message of a batch, of any class."""
    head = {key: draw(value) for key, value in headers.items()}
    head["names"] = tuple(draw(st.lists(names, min_size=1, max_size=5, unique=True)))
    n, cls = len(head["names"]), draw(st.sampled_from(list(BATCHES.values())))
    if cls is MeasurementsBatch:
        return MeasurementsBatch(**head, y=np.tile(draw(forces(1)), (n, 1)), phi=draw(prints))
    maps = np.tile(draw(forces(2)), (n, 1, 1))
    if cls is not ReconstructionBatch:
        return cls(**head, forces=maps)
    of = {key: draw(hnp.arrays(np.bool_, n)) for key in ("unchanged", "trusted")}
    changed = maps[~of["unchanged"]]
    return ReconstructionBatch(
        **head,
        **of,
        forces=changed if len(changed) else None,
        phi=draw(prints),
        iterations=draw(hnp.arrays(np.int32, n, elements=st.integers(0, 1000))),
        residual=np.ones(n, np.float32),
        error=np.full(n, -1, np.float32),
        solve_ns=draw(hnp.arrays(np.int64, n, elements=numbers)),
        done_ns=draw(numbers),
        skipped=draw(numbers),
    )


elements = st.integers(1, MAX_ELEMENTS)
messages: st.SearchStrategy[Message] = st.one_of(
    st.builds(Taxels, **headers, forces=forces(2)),
    st.builds(Truth, **headers, forces=forces(2)),
    st.builds(Measurements, **headers, y=forces(1), phi=prints),
    st.builds(
        Reconstruction,
        **headers,
        forces=forces(2),
        phi=prints,
        iterations=st.integers(0, 1000),
        residual=positive,
        solve_ns=numbers,
        done_ns=numbers,
        skipped=numbers,
        error=st.none() | positive,
        trusted=st.booleans(),
        unchanged=st.booleans(),
    ),
    batches(),
    reconstructions_with_sd(),
    st.builds(Resultant, **headers, total=positive, total_sd=positive, done_ns=numbers),
    st.builds(
        Resultant,
        **headers,
        **dict.fromkeys(("total", "total_sd", "row", "col", "row_sd", "col_sd"), positive),
        done_ns=numbers,
    ),
    skin_states(),
    calibrations(),
    st.builds(
        PhiState,
        **headers,
        kind=texts,
        n=elements,
        m=elements,
        block=elements,
        seed=numbers,
        fingerprint=prints,
        rows=st.sampled_from(["fixed", "rotating"]),
    ),
    st.builds(
        SolverState,
        **headers,
        solver=texts,
        basis=texts,
        preset=texts,
        iterations=st.integers(0, 1000),
        lambda_n=positive,
        max_iterations=st.integers(0, 1000),
    ),
    st.builds(End, **headers, of=names.filter(lambda name: name != "end"), n_messages=numbers),
)
