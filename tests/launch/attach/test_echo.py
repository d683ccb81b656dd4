"""Fields of messages as text and as JSON."""

from __future__ import annotations

import json

import numpy as np
import pytest

from sparseskin.launch.attach.echo import FieldPath, plain, text
from sparseskin.messages import Taxels
from sparseskin.messages.quantised import Quantised
from sparseskin.nodes.errors import SettingsError

FORCES = np.arange(12, dtype=np.float32).reshape(3, 4)
TAXELS = Taxels(stamp_ns=1, patch="skin", forces=FORCES)


def test_an_array_is_its_shape_extent_and_first_numbers() -> None:
    assert text(FORCES, full=False) == ("float32, 3 x 4: min 0, mean 5.5, max 11 [0 1 2 3 4 5 ...]")
    assert plain(FORCES, full=False) == {
        "dtype": "float32",
        "shape": [3, 4],
        "min": 0.0,
        "mean": 5.5,
        "max": 11.0,
        "first": [0, 1, 2, 3, 4, 5],
    }


def test_an_array_in_full_has_every_element(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    big = np.arange(6400, dtype=np.float32).reshape(80, 80)
    assert len(text(big, full=True).replace("[", " ").replace("]", " ").split()) == 4 + 6400
    assert json.loads(json.dumps(plain(big, full=True)))["data"] == big.tolist()


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, "none"),
        (0.5, "0.5"),
        ("a\x1b[2J\n b", r"a\x1b[2J b"),  # one line that cannot move the cursor
        (FORCES > 3, "bool, 3 x 4: 8 of 12 true"),
        (Quantised.of(np.array([250, 255, 260]), 9, 0.5), "float32 of 9 bits, 3: min "),
    ],
)
def test_other_values_are_one_line(value: object, shown: str) -> None:
    assert text(value, full=False).startswith(shown)


def test_a_field_or_one_element_is_found_by_its_path() -> None:
    assert FieldPath("patch", Taxels).of(TAXELS) == "skin"
    assert FieldPath("forces[2,1]", Taxels).of(TAXELS) == 9
    assert plain(FieldPath("forces[2,1]", Taxels).of(TAXELS), full=False) == 9


@pytest.mark.parametrize(
    ("path", "fault"),
    [
        ("forces[-1,0]", r"expected FIELD or FIELD\[I,J\]"),
        ("force", r"taxels has no such field \(did you mean 'forces'"),
        ("forces[3,0]", "is 3 x 4"),
        ("seq[0]", "is no array"),
    ],
)
def test_what_is_no_field_or_element_is_refused(path: str, fault: str) -> None:
    with pytest.raises(SettingsError, match=fault):
        FieldPath(path, Taxels).of(TAXELS)
