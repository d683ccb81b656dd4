"""Fields of messages as text and as JSON."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sparseskin.launch.attach.echo import Echo, FieldPath, plain, text
from sparseskin.launch.attach.stream import Arrival
from sparseskin.messages import Contacts, Taxels, encode
from sparseskin.messages.quantised import Quantised
from sparseskin.nodes.errors import SettingsError

FORCES = np.arange(12, dtype=np.float32).reshape(3, 4)
TAXELS = Taxels(stamp_ns=1, patch="skin", forces=FORCES)


def test_an_array_is_its_shape_extent_and_first_numbers():
    assert text(FORCES, full=False) == ("float32, 3 x 4: min 0, mean 5.5, max 11 [0 1 2 3 4 5 ...]")
    assert plain(FORCES, full=False) == {
        "dtype": "float32",
        "shape": [3, 4],
        "min": 0.0,
        "mean": 5.5,
        "max": 11.0,
        "first": [0, 1, 2, 3, 4, 5],
    }


def test_an_array_in_full_has_every_element(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    big = np.arange(6400, dtype=np.float32).reshape(80, 80)
    assert len(text(big, full=True).replace("[", " ").replace("]", " ").split()) == 4 + 6400
    assert json.loads(json.dumps(plain(big, full=True)))["data"] == big.tolist()


def test_contacts_are_a_line_each_and_an_array_may_be_empty():
    one, two = np.ones(1, np.float32), np.ones((1, 2), np.float32)
    contacts = Contacts(
        **{"stamp_ns": 1, "patch": "skin", "done_ns": 2, "id": np.array([7], np.int32)},
        **{"total": 3 * one, "total_sd": 0.1 * one, "peak": one, "area": np.array([9], np.int32)},
        **{"centre": 4 * two, "centre_sd": 0.25 * two, "velocity": two, "age_s": one},
        **{"over": one > 0, "sliding": one < 0},
        events=np.array([[0, 7, 0]], np.int32),
    )
    options = {"n": None, "max_hz": None, "in_json": False, "full": False, "unit": "N"}
    echo = Echo("/skin/contacts", None, **options)
    lines = echo.text(contacts).split("\n")
    about = "3 ± 0.1 N; peak 1 N; at (4 ± 0.25, 4 ± 0.25) taxels; 9 taxels, 1 s; over"
    assert " ".join(line.strip() for line in lines).endswith(
        f"contact 7: {about} event of 7: begin"
    )
    places = np.array([[5, 6, 0]], np.float32)
    flat = replace(contacts, place_mm=places, place_sd_mm=places / 10, events=None)
    assert "at (5 ± 0.5, 6 ± 0.6) mm" in " ".join(echo.text(flat).split())
    # In the time between two shown messages those with an event are shown, too.
    made = [replace(m, stamp_ns=k, seq=k) for k, m in enumerate([flat, flat, contacts])]
    shown = [echo.take(Arrival(*encode(m), 0, "", m.seq, m.stamp_ns, ends=False)) for m in made]
    assert shown == [True, False, True]
    assert text(one[:0], full=False) == "float32, 0"
    assert plain(one[:0], full=False)["first"] == []


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
def test_other_values_are_one_line(value, shown):
    assert text(value, full=False).startswith(shown)


def test_a_field_or_one_element_is_found_by_its_path():
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
def test_what_is_no_field_or_element_is_refused(path, fault):
    with pytest.raises(SettingsError, match=fault):
        FieldPath(path, Taxels).of(TAXELS)
