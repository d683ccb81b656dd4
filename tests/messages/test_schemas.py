"""The form of each message: the fields that it needs, and what those mean that it leaves out."""

import msgpack
import numpy as np
import pytest

from sparseskin.messages import MalformedError, MessageError, ShapeError, decode
from sparseskin.messages.base import wire_fields
from sparseskin.messages.schemas import SCHEMAS

HEAD = {"stamp_ns": 5, "patch": "skin", "run_id": "0" * 16, "seq": 7}
PHI = "0123456789abcdef"


def array(dtype, *shape):
    """Zeros as they travel."""
    data = np.zeros(shape, dtype).tobytes()
    return {"dtype": dtype, "shape": [*shape], "order": "C", "data": data}


SHORTEST = {
    "skin": {
        **{"n_rows": 3, "n_cols": 2, "f_max": 2.5, "unit": "N", "pitch_m": None},
        **{"mask": None, "source": "", "seed": 0, "rate_hz": 0.0, "has_truth": False},
        **{"sigma_mid": 0.0, "sigma_end": 0.0},
    },
    "calibration": {
        **{"name": "", "baseline": None, "gains": None},
        **{"response_reading": None, "response_force": None},
    },
    "phi": {
        **{"kind": "sbhe", "n": 6, "m": 3, "block": 4, "seed": 0},
        "fingerprint": PHI,
    },
    "solver": {
        **{"solver": "skin", "basis": "", "preset": "skin"},
        **{"iterations": 4, "lambda_n": 0.0},
    },
    "taxels": {"forces": array("<f4", 1, 3, 2)},
    "truth": {"forces": array("<f4", 1, 3, 2)},
    "measurements": {"y": array("<f4", 1, 3), "phi": PHI},
    "reconstruction": {
        **{"forces": array("<f4", 1, 3, 2), "phi": PHI, "iterations": [4]},
        **{"residual": [0.0], "solve_ns": [0], "done_ns": 0},
    },
    "contacts": {
        **{name: array("<i4", 2) for name in ("id", "area")},
        **{name: array("<f4", 2) for name in ("total", "total_sd", "peak", "age_s")},
        **{name: array("<f4", 2, 2) for name in ("centre", "centre_sd", "velocity")},
        **{name: array("|b1", 2) for name in ("over", "sliding")},
        "done_ns": 0,
    },
    "labels": {"label": "", "share": 0.0, "age_s": 0.0, "done_ns": 0},
    "end": {"of": "taxels", "n_messages": 0},
}
"""The fields without which a message of each schema is refused, as they travel."""

LEFT_OUT = {
    "skin": {
        **{"has_taxels": True, "f_min": 0.0, "live": False},
        **{"points": None, "point_rows": None},
    },
    "phi": {"rows": "fixed", "rule": 1},
    "solver": {
        **{"frame_ms": 0.0, "max_iterations": 0, "frame_tiles": 0},
        **{"step_tiles": 0, "noise_sum": 0.0},
    },
    "taxels": {"names": (), "missing": None, "reason": ("",)},
    "truth": {"names": ()},
    "measurements": {
        **{"names": (), "missing": None, "reason": ("",), "places": None},
        **{"nodes": None, "unchanged": (False,), "quiet": 0},
    },
    "reconstruction": {
        **{"names": (), "missing": None, "reason": ("",), "sd": None, "skipped": 0},
        **{"error": (None,), "trusted": (True,), "unchanged": (False,), "quiet": 0},
    },
    "contacts": {
        **{"names": (), "trusted": (True,), "place_mm": None, "place_sd_mm": None},
        **{"velocity_mm_s": None, "area_mm2": None, "normal": None},
        **{"patch_of": None, "events": None},
    },
    "labels": {"trusted": True},
}
"""What a message has that was written before these fields were added, or that leaves them out."""

VERSIONS = dict.fromkeys(SHORTEST, 1)
VERSIONS |= dict.fromkeys(
    ("taxels", "truth", "measurements", "reconstruction", "contacts"), 2
)


def read(schema, **changes):
    """The shortest message of a schema with some fields more, as a reader gets it."""
    body = {"schema": schema, "version": VERSIONS[schema], **HEAD, **SHORTEST[schema]}
    body |= changes
    kind = body["of"] if schema == "end" else schema
    return decode(f"/skin/{kind}".encode(), msgpack.packb(body))


def test_the_schemas_are_those_of_recordings():
    assert SCHEMAS.keys() == SHORTEST.keys()


@pytest.mark.parametrize("schema", SHORTEST)
def test_what_a_message_leaves_out_has_the_value_of_messages_before_it(schema):
    message = read(schema)
    stated = {name: getattr(message, name) for name in LEFT_OUT.get(schema, {})}
    assert stated == LEFT_OUT.get(schema, {})


@pytest.mark.parametrize("schema", SHORTEST)
def test_a_message_has_no_other_fields(schema):
    names = {*HEAD, *SHORTEST[schema], *LEFT_OUT.get(schema, {})}
    assert names == wire_fields(SCHEMAS[schema]).keys()


@pytest.mark.parametrize(
    ("schema", "name"),
    [(schema, name) for schema in SHORTEST for name in (*HEAD, *SHORTEST[schema])],
)
def test_a_message_without_a_field_that_it_needs_is_refused(schema, name):
    body = {"schema": schema, "version": VERSIONS[schema], **HEAD, **SHORTEST[schema]}
    del body[name]
    with pytest.raises(MalformedError):
        decode(f"/skin/{schema}".encode(), msgpack.packb(body))


WHOLE = {
    "skin": ("seed",),
    "phi": ("seed",),
    "solver": ("iterations", "max_iterations", "frame_tiles", "step_tiles"),
    "measurements": ("quiet",),
    "reconstruction": ("iterations", "solve_ns", "done_ns", "skipped", "quiet"),
    "contacts": ("done_ns",),
    "labels": ("done_ns",),
    "end": ("n_messages",),
}
REAL = {
    "skin": ("rate_hz", "sigma_mid", "sigma_end", "pitch_m"),
    "solver": ("lambda_n", "frame_ms", "noise_sum"),
    "reconstruction": ("residual", "error"),
    "labels": ("share", "age_s"),
}
OF_PATCHES = ("residual", "error", "solve_ns", "iterations")


def numbers(names):
    return [(schema, name) for schema in names for name in names[schema]]


def sent_number(schema, name, number):
    """A number as it travels: of messages of several patches one for each."""
    is_of_patches = schema == "reconstruction" and name in OF_PATCHES
    return {name: [number]} if is_of_patches else {name: number}


@pytest.mark.parametrize(("schema", "name"), numbers(WHOLE))
def test_whole_numbers_are_0_or_more(schema, name):
    for number in (0, 1):
        read(schema, **sent_number(schema, name, number))
    for wrong in (-1, 0.5):
        with pytest.raises(MessageError):
            read(schema, **sent_number(schema, name, wrong))


@pytest.mark.parametrize(("schema", "name"), numbers(REAL))
def test_numbers_that_are_no_whole_ones_are_0_or_more(schema, name):
    for number in (0.0, 0.25):
        read(schema, **sent_number(schema, name, number))
    for wrong in (-0.25, "0"):
        with pytest.raises(MessageError):
            read(schema, **sent_number(schema, name, wrong))


ARRAYS = [
    *[("skin", "mask", "|b1", (3, 2)), ("skin", "points", "<f4", (6, 6))],
    *[("taxels", "missing", "|u1", (1,)), ("measurements", "nodes", "|u1", (9,))],
    ("reconstruction", "sd", "<f4", (1, 3, 2)),
    *[("contacts", "place_mm", "<f4", (2, 3)), ("contacts", "normal", "<f4", (2, 3))],
    ("contacts", "place_sd_mm", "<f4", (2, 3)),
    ("contacts", "velocity_mm_s", "<f4", (2, 3)),
    ("contacts", "area_mm2", "<f4", (2,)),
    *[("contacts", "patch_of", "<i4", (2,)), ("contacts", "events", "<i4", (4, 3))],
    *[
        ("calibration", "gains", "<f4", (3, 2)),
        ("calibration", "baseline", "<f4", (3, 2)),
    ],
]
"""Arrays that a message may have, and of which type and shape."""


@pytest.mark.parametrize(("schema", "name", "dtype", "shape"), ARRAYS)
def test_an_array_that_may_be_left_out_is_read_where_it_is_sent(
    schema, name, dtype, shape
):
    sent = array(dtype, *shape)
    if name == "points":
        # Normals of length 1.
        values = np.zeros(shape, dtype)
        values[:, 5] = 1
        sent["data"] = values.tobytes()
    if name == "mask":
        sent["data"] = b"\1" * 6
    value = getattr(read(schema, **{name: sent}), name)
    assert value.dtype == np.dtype(dtype)
    assert value.shape == shape


@pytest.mark.parametrize(("schema", "name", "dtype", "shape"), ARRAYS)
def test_an_array_of_another_type_or_number_of_sides_is_refused(
    schema, name, dtype, shape
):
    other = "<f8" if dtype != "<f8" else "<f4"
    for wrong in (array(other, *shape), array(dtype, *shape, 1), array(dtype)):
        with pytest.raises(MessageError):
            read(schema, **{name: wrong})


@pytest.mark.parametrize(
    "name", [name for name in SHORTEST["contacts"] if name != "done_ns"]
)
def test_columns_of_contacts_have_an_entry_or_a_row_for_each(name):
    sent = SHORTEST["contacts"][name]
    longer = array(sent["dtype"], 3, *sent["shape"][1:])
    wider = array(sent["dtype"], *sent["shape"], 2)
    for wrong in (longer, wider):
        with pytest.raises(ShapeError):
            read("contacts", **{name: wrong})
