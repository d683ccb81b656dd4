"""Messages of every class with any values, for properties of their wire forms."""

from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sparseskin.messages import (
    Calibration,
    Contacts,
    End,
    Labels,
    Measurements,
    Message,
    PhiState,
    Reconstruction,
    SkinState,
    SolverState,
    Taxels,
    Truth,
)
from sparseskin.messages.base import wire_fields
from sparseskin.messages.fields import Array, Each, FieldKind, Flag, Integer, Real, Text
from sparseskin.messages.wire import Payload, received, wire_bytes


def sent(message: Message) -> tuple[bytes, Payload]:
    """Topic and payload as they arrive."""
    return received(wire_bytes(message))


texts = st.text(
    st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]),
    min_size=0,
    max_size=32,
)


def of_kind(kind: FieldKind, n_patches: int) -> st.SearchStrategy[Any] | None:
    """Any value of a field; None for a field that is no number and no text."""
    match kind:
        case Each():
            one = of_kind(kind.kind, n_patches)
            return None if one is None else st.tuples(*[one] * n_patches)
        case Integer():
            return st.integers(kind.low, kind.high)
        case Real():
            within = max(kind.low, -1e30), min(kind.high, 1e30)
            known = st.floats(*within, allow_nan=False)
            return st.none() | known if kind.optional else known
        case Flag():
            return st.booleans()
        case Text() if kind.pattern == Text.pattern:
            return texts
        case Text():
            found = st.from_regex(kind.pattern, fullmatch=True)
            return found.filter(lambda text: len(text) <= kind.longest)
    return None


def scalars(
    cls: type[Message], names: tuple[str, ...] = ()
) -> dict[str, st.SearchStrategy[Any]]:
    """Strategies of the fields of a class that are numbers and texts; `names` of the patches."""
    n_patches = len(names) or 1
    found = {name: of_kind(kind, n_patches) for name, kind in wire_fields(cls).items()}
    found |= {"names": st.just(names)} if names else {}
    return {name: strategy for name, strategy in found.items() if strategy is not None}


def made(
    cls: type[Message], **others: st.SearchStrategy[Any]
) -> st.SearchStrategy[Message]:
    """Any message of a class; `others`: its arrays, and fields that depend on each other."""
    return st.builds(cls, **scalars(cls) | others)


def forces(ndim: int) -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(
        np.float32,
        hnp.array_shapes(min_dims=ndim, max_dims=ndim, min_side=1, max_side=12),
        elements=st.floats(
            -(2.0**100), 2.0**100, width=32, allow_nan=False, allow_infinity=False
        ),
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
    values = {name: draw(strategy) for name, strategy in scalars(SkinState).items()}
    values |= {"n_rows": shape[0], "n_cols": shape[1], "mask": mask, "points": placed}
    values |= {"f_max": draw(st.floats(1e-6, 1e6)), "f_min": -draw(st.floats(0, 1e30))}
    return SkinState(**values, point_rows=None if placed is None else draw(rows))


@st.composite
def calibrations(draw: st.DrawFn) -> Calibration:
    shape = draw(st.tuples(st.integers(1, 6), st.integers(1, 6)))
    k = draw(st.integers(1, 4))
    values = st.floats(-1e6, 1e6, width=32)
    grids = st.none() | hnp.arrays(np.float32, shape, elements=values)
    curves = draw(st.sampled_from([None, (k, 1, 1), (k, *shape)]))
    return Calibration(
        **{name: draw(strategy) for name, strategy in scalars(Calibration).items()},
        baseline=draw(grids),
        gains=draw(grids),
        response_reading=None if curves is None else np.ones(curves, np.float32),
        response_force=None if curves is None else np.ones(k, np.float32),
    )


@st.composite
def several(draw: st.DrawFn) -> Message:
    """A message of frames of several patches, of any class."""
    cls = draw(st.sampled_from([Taxels, Truth, Measurements, Reconstruction]))
    one_name = of_kind(wire_fields(cls)["patch"], 1)
    assert one_name is not None
    names = tuple(draw(st.lists(one_name, min_size=1, max_size=5, unique=True)))
    head: dict[str, Any] = {
        name: draw(strategy) for name, strategy in scalars(cls, names).items()
    }
    if cls is Measurements:
        return Measurements(**head, y=np.tile(draw(forces(1)), (len(names), 1)))
    maps = np.tile(draw(forces(2)), (len(names), 1, 1))
    if cls is Reconstruction:
        left_out = np.array(head["unchanged"]) & draw(st.booleans())
        return Reconstruction(**head, forces=maps[~left_out])
    return cls(**head, forces=maps)


@st.composite
def with_sd(draw: st.DrawFn) -> Message:
    found = draw(forces(2))
    return draw(made(Reconstruction, forces=st.just(found), sd=st.just(np.abs(found))))


@st.composite
def contacts(draw: st.DrawFn) -> Contacts:
    """Contacts of one patch or several, none or some, with and without what may be unknown."""
    names = draw(st.sampled_from([(), ("left", "right")]))
    n, n_events = draw(st.integers(0, 4)), draw(st.integers(0, 3))
    values = {
        name: draw(strategy) for name, strategy in scalars(Contacts, names).items()
    }
    for name, kind in wire_fields(Contacts).items():
        if isinstance(kind, Array) and not (kind.optional and draw(st.booleans())):
            width = 3 if "mm" in name or name == "normal" else 2
            numbers = draw(hnp.arrays(np.int8, (n, width)[: kind.ndim])).astype(
                kind.dtype
            )
            values[name] = abs(numbers) if name == "id" else numbers
    rows = [draw(st.integers(0, max(0, len(names) - 1))) for _ in range(n + n_events)]
    values["patch_of"] = np.array(rows[:n], np.int32) if names else None
    changes = [
        (row, draw(st.integers(1, 9)), draw(st.integers(0, 3))) for row in rows[n:]
    ]
    values["events"] = np.array(changes, np.int32) if changes else None
    return Contacts(**values)


messages: st.SearchStrategy[Message] = st.one_of(
    made(Taxels, forces=forces(2)),
    made(Truth, forces=forces(2)),
    made(Measurements, y=forces(1)),
    made(Reconstruction, forces=forces(2)),
    with_sd(),
    several(),
    contacts(),
    made(Labels),
    skin_states(),
    calibrations(),
    made(PhiState),
    made(SolverState),
    made(End, of=st.sampled_from(["taxels", "truth", "x_1"])),
)
