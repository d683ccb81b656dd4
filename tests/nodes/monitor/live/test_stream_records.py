"""Records of the stream that a page reads: header and arrays come back as they went."""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
from feeds import Record, read_records
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy

from sparseskin.nodes.monitor.live.stream import record

NUMBERS = st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats()
HEADERS = st.dictionaries(st.text(), st.recursive(NUMBERS | st.text(), st.lists, max_leaves=8))
ARRAYS = st.dictionaries(
    st.text(max_size=8),
    st_numpy.arrays(
        st.sampled_from(("<f4", "<f8", "|u1", "<i8")),
        st_numpy.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=4),
    ),
    max_size=4,
)


def parsed(data: bytes) -> list[Record]:
    return list(read_records(io.BytesIO(data).read))


def without_nan(value: Any) -> Any:
    if isinstance(value, list):
        return [without_nan(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@given(HEADERS.filter(lambda header: "arrays" not in header), ARRAYS)
def test_decoding_a_record_returns_its_header_and_arrays(
    header: dict[str, Any], arrays: dict[str, np.ndarray[Any, Any]]
) -> None:
    ((found, back),) = parsed(record(header, arrays))
    assert found == {key: without_nan(value) for key, value in header.items()}
    assert list(back) == list(arrays)
    for name, array in arrays.items():
        assert (back[name].dtype, back[name].shape) == (array.dtype, array.shape)
        assert back[name].tobytes() == array.tobytes()


def test_an_array_that_is_a_view_is_sent_in_its_own_order() -> None:
    array = np.arange(12, dtype=np.float32).reshape(3, 4)[::2, ::-1]
    ((_, back),) = parsed(record({}, {"a": array}))
    np.testing.assert_array_equal(back["a"], array)
