"""What commands print of messages, readings and settings: one line each, in the width there is."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.launch.attach.echo import Echo, FieldPath, plain, text
from sparseskin.launch.attach.heat_map import COLOURS, LETTERS, UPPER_HALF, heat_map
from sparseskin.launch.attach.stream import Arrival
from sparseskin.launch.attach.text import MAX_SHOWN, shown_value, table, typed_value
from sparseskin.messages import Contacts, Reason, Reconstruction, Taxels, encode
from sparseskin.messages.quantised import Quantised
from sparseskin.nodes.errors import SettingsError

FORCES = np.arange(12, dtype=np.float32).reshape(3, 4)
TAXELS = Taxels(stamp_ns=1, patch="skin", forces=FORCES)


def test_an_array_is_its_shape_extent_and_first_numbers_or_in_full_every_element(
    monkeypatch,
):
    assert text(FORCES, full=False) == (
        "float32, 3 x 4: min 0, mean 5.5, max 11 [0 1 2 3 4 5 ...]"
    )
    assert plain(FORCES, full=False) == {
        "dtype": "float32",
        "shape": [3, 4],
        "min": 0.0,
        "mean": 5.5,
        "max": 11.0,
        "first": [0, 1, 2, 3, 4, 5],
    }
    monkeypatch.setenv("COLUMNS", "80")
    big = np.arange(6400, dtype=np.float32).reshape(80, 80)
    assert (
        len(text(big, full=True).replace("[", " ").replace("]", " ").split())
        == 4 + 6400
    )
    assert json.loads(json.dumps(plain(big, full=True)))["data"] == big.tolist()


def test_contacts_are_a_line_each_and_an_array_may_be_empty():
    one = np.ones(1, np.float32)
    two = np.ones((1, 2), np.float32)
    contacts = Contacts(
        **{"stamp_ns": 1, "patch": "skin", "done_ns": 2, "id": np.array([7], np.int32)},
        **{
            "total": 3 * one,
            "total_sd": 0.1 * one,
            "peak": one,
            "area": np.array([9], np.int32),
        },
        **{"centre": 4 * two, "centre_sd": 0.25 * two, "velocity": two, "age_s": one},
        **{"over": one > 0, "sliding": one < 0},
        events=np.array([[0, 7, 0]], np.int32),
    )
    options = {"n": None, "max_hz": None, "in_json": False, "full": False, "unit": "N"}
    echo = Echo("/skin/contacts", None, **options)
    lines = echo.text(contacts).split("\n")
    about = "3 ± 0.1 N; peak 1 N; at (4 ± 0.25, 4 ± 0.25) taxels; 9 taxels, 1 s; over"
    assert " ".join(s.strip() for s in lines).endswith(
        f"contact 7: {about} event of 7: begin"
    )
    places = np.array([[5, 6, 0]], np.float32)
    flat = replace(contacts, place_mm=places, place_sd_mm=places / 10, events=None)
    assert "at (5 ± 0.5, 6 ± 0.6) mm" in " ".join(echo.text(flat).split())
    # In the time between two shown messages those with an event are shown, too.
    made = [replace(m, stamp_ns=k, seq=k) for k, m in enumerate([flat, flat, contacts])]
    shown = [
        echo.take(Arrival(*encode(m), 0, "", m.seq, m.stamp_ns, ends=False))
        for m in made
    ]
    assert shown == [True, False, True]
    assert text(one[:0], full=False) == "float32, 0"
    assert plain(one[:0], full=False)["first"] == []


@pytest.mark.parametrize("reason", Reason)
def test_the_reason_of_a_frame_is_followed_by_its_meaning(reason):
    of_patches = {
        "iterations": (1, 1, 1),
        "residual": (0.1, 0.1, 0.1),
        "solve_ns": (1, 1, 1),
    }
    body = Reconstruction(
        **{
            "stamp_ns": 1,
            "patch": "body",
            "names": ("a", "b", "c"),
            "done_ns": 2,
            **of_patches,
        },
        **{"forces": np.ones((3, 2, 2), np.float32), "phi": "0" * 16},
        **{"trusted": (False, True, False), "reason": (reason.value, "", reason.value)},
    )
    skin = body.split()[0]
    options = {"n": None, "max_hz": None, "full": False}
    echo = Echo("/body/reconstruction", None, in_json=False, **options)
    meaning = f" reason {reason}: {reason.sentence}"
    for message in (body, skin):
        assert " ".join(echo.text(message).split()).endswith(meaning)
    shown = json.loads(
        Echo("/skin/reconstruction", None, in_json=True, **options).text(skin)
    )
    assert shown["reason"] == reason
    assert f"reason {reason}" not in shown


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


@pytest.mark.parametrize(
    ("path", "fault"),
    [
        ("forces[-1,0]", r"expected FIELD or FIELD\[I,J\]"),
        ("force", r"taxels has no such field \(did you mean 'forces'"),
        ("forces[3,0]", "is 3 x 4"),
        ("seq[0]", "is no array"),
    ],
)
def test_a_field_or_one_element_is_found_by_its_path_and_no_other(path, fault):
    assert FieldPath("patch", Taxels).of(TAXELS) == "skin"
    assert plain(FieldPath("forces[2,1]", Taxels).of(TAXELS), full=False) == 9
    with pytest.raises(SettingsError, match=fault):
        FieldPath(path, Taxels).of(TAXELS)


CODE = re.compile(r"\x1b\[[0-9;]*m")


def pixels(lines):
    """Levels of the places that coloured lines show, two rows a line."""
    rows = []
    for line in lines:
        upper = []
        lower = []
        colours = (0, 0)
        for token in re.findall(r"\x1b\[[0-9;]*m|.", line):
            if found := re.fullmatch(r"\x1b\[38;5;(\d+);48;5;(\d+)m", token):
                colours = COLOURS.index(int(found[1])), COLOURS.index(int(found[2]))
            elif token == UPPER_HALF:
                upper.append(colours[0])
                lower.append(colours[1])
        rows += [upper, lower]
    return np.array(rows)


def test_a_taxel_is_a_square_as_large_as_fits_of_more_than_fit_the_largest_is_shown():
    forces = np.zeros((2, 3), np.float32)
    forces[0, 2] = 1.0
    forces[1, 0] = 0.5
    shown = pixels(heat_map(forces, 1.0, 12, 5))
    assert shown.shape == (8, 12)  # four places a taxel
    expected = np.zeros((2, 3))
    expected[0, 2] = len(COLOURS) - 1
    expected[1, 0] = len(COLOURS) // 2
    np.testing.assert_array_equal(shown, np.kron(expected, np.ones((4, 4))))
    forces = np.zeros((64, 64), np.float32)
    forces[37, 61] = 1.0
    shown = pixels(heat_map(forces, 1.0, 16, 8))
    assert shown.shape == (16, 16)
    assert list(np.argwhere(shown)[0]) == [37 // 4, 61 // 4]
    # Without colours letters stand for the readings.
    forces = np.linspace(0, 1, len(LETTERS), dtype=np.float32)[None]
    (line,) = heat_map(forces, 1.0, 2 * len(LETTERS), 1, coloured=False)
    assert line == "".join(2 * letter for letter in LETTERS)


@given(
    rows=st.integers(1, 70),
    cols=st.integers(1, 70),
    width=st.integers(1, 90),
    height=st.integers(1, 40),
    coloured=st.booleans(),
)
def test_the_map_fits(rows, cols, width, height, coloured):
    lines = heat_map(np.ones((rows, cols), np.float32), 1.0, width, height, coloured)
    assert 1 <= len(lines) <= height
    widths = {len(CODE.sub("", line)) for line in lines}
    assert len(widths) == 1
    assert 1 <= widths.pop() <= max(width, 1 if coloured else 2)


def entry(type_, **stated):
    return {
        "type": type_,
        "low": None,
        "high": None,
        "choices": [],
        "known": [],
        **stated,
    }


@pytest.mark.parametrize(
    ("text", "type_", "value"),
    [
        ("3", "int", 3),
        ("true", "bool", True),
        ("12", "str", "12"),
        ("none", "float | None", None),
        ("none", "str", "none"),
        ('["/skin/taxels"]', "tuple[str, ...]", ["/skin/taxels"]),
        ("1\nb = 2", "int", 1),
    ],
)
def test_what_is_typed_is_toml_or_a_text(text, type_, value):
    assert typed_value(text, entry(type_)) == value
    assert type(typed_value(text, entry(type_))) is type(value)


@given(st.integers(-(10**12), 10**12) | st.booleans() | st.floats(-1e9, 1e9))
def test_a_number_that_is_shown_can_be_typed_again(value):
    assert typed_value(shown_value(value), entry(type(value).__name__)) == value


@given(st.text(max_size=50))
def test_any_text_is_shown_on_one_line_and_can_be_typed_again(value):
    assert len(shown_value("x" * 5000)) == MAX_SHOWN
    assert shown_value(None) == "none"
    assert shown_value("a\nb\nc\n") == "(3 lines: param get prints them)"
    shown = shown_value(value)
    assert len(shown.splitlines()) == 1
    if value.isprintable() and '"' not in value and "'" not in value:
        assert typed_value(shown, entry("str")) == value


def test_the_last_column_is_wrapped_under_itself(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    lines = table(["KEY", "WHAT"], [["key", "many words " * 20]])
    assert all(len(line) <= 80 for line in lines)
    assert all(
        line.startswith("     many") or line.startswith("     words")
        for line in lines[2:]
    )
