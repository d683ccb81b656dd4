"""Messages of several patches: split into single ones, and refused where they do not fit."""

from dataclasses import replace

import numpy as np
import pytest

from sparseskin.messages import (
    FieldError,
    Measurements,
    OversizedError,
    Reconstruction,
    ShapeError,
    Taxels,
    Truth,
)
from sparseskin.messages.frames import of_patches, values_alone

NAMES = ("hand", "arm", "back")
HEAD = {"stamp_ns": 5, "patch": "body", "names": NAMES}
MAPS = np.arange(18, dtype=np.float32).reshape(3, 2, 3)


def reconstructed(*unchanged, **changes):
    left_out = np.array(unchanged or [False] * 3)
    fields = {
        **{"forces": MAPS[~left_out], "phi": "0" * 16, "done_ns": 9, "skipped": 2},
        **{
            "iterations": (4, 3, 2),
            "residual": (0.5, 0.25, 0.0),
            "solve_ns": (7, 8, 9),
        },
        **{"error": (None, 0.25, None), "unchanged": unchanged},
    }
    return Reconstruction(**{**HEAD, **fields, **changes})


def test_a_message_is_split_into_those_of_its_patches():
    for message in (
        Taxels(**HEAD, forces=MAPS),
        Measurements(**HEAD, y=MAPS[:, 0], phi="0" * 16),
        reconstructed(),
    ):
        parts = message.split()
        assert [(part.patch, part.names) for part in parts] == [
            (name, ()) for name in NAMES
        ]
        for k, part in enumerate(parts):
            for name in of_patches(type(message)):
                if (whole := getattr(message, name)) is not None:
                    np.testing.assert_array_equal(getattr(part, name), whole[k : k + 1])
            assert replace(part) == part  # its fields are valid
            assert part.split() == [part]


def test_one_patch_needs_no_axis_where_its_message_is_made():
    made = Taxels(stamp_ns=5, patch="arm", forces=MAPS[1])
    assert made == Taxels(**HEAD, forces=MAPS).split()[1]
    assert made.forces.shape == (1, 2, 3)
    np.testing.assert_array_equal(values_alone(made)["forces"], MAPS[1])
    found = values_alone(reconstructed().split()[1])
    assert found["iterations"] == 3
    assert found["error"] == 0.25
    assert found["trusted"]


def test_forces_of_an_unchanged_patch_are_not_sent_and_are_those_of_its_last_frame():
    held = {}
    before = reconstructed().split(held)
    now = reconstructed(False, True, False)
    assert len(now.forces) == 2
    parts = now.split(held)
    assert [part.forces.tobytes() for part in parts] == [
        one.forces.tobytes() for one in before
    ]
    assert [part.unchanged for part in parts] == [(False,), (True,), (False,)]
    # A reader that came later has not seen them.
    assert [part.patch for part in now.split()] == ["hand", "back"]
    idle = reconstructed(True, True, True)
    assert len(idle.forces) == 0
    assert [part.patch for part in idle.split(held)] == list(NAMES)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"names": ("hand", "arm")}, ShapeError),
        ({"names": ("hand", "hand", "arm")}, FieldError),
        ({"names": ("hand", "Arm", "back")}, FieldError),
        ({"names": ("hand arm", "back", "leg")}, ShapeError),
        ({"names": ()}, ShapeError),
        ({"names": tuple(f"p{k}" for k in range(257))}, OversizedError),
        ({"names": tuple(f"p{k:030d}" for k in range(256))}, OversizedError),
    ],
)
def test_names_that_do_not_fit_are_refused(changes, error):
    with pytest.raises(error):
        Truth(**{**HEAD, "forces": MAPS, **changes})


@pytest.mark.parametrize(
    ("changes", "error", "line"),
    [
        ({"forces": MAPS[:2]}, ShapeError, "forces: 2 rows for 3 patches"),
        ({"forces": MAPS[:0]}, ShapeError, "forces: 0 rows for 3 patches"),
        ({"iterations": (1, -1, 1)}, FieldError, "iterations: -1 is outside"),
        ({"iterations": ()}, ShapeError, "iterations: 0 rows for 3 patches"),
        ({"residual": (0.1,)}, ShapeError, "residual: 1 rows for 3 patches"),
        ({"trusted": True}, ShapeError, "trusted: 1 rows for 3 patches"),
    ],
)
def test_something_of_each_patch_is_needed(changes, error, line):
    with pytest.raises(error, match=line):
        reconstructed(**changes)


def test_places_are_those_of_one_patch():
    made = {"phi": "0" * 16, "places": np.array([0b11000000], np.uint8)}
    assert (
        Measurements(stamp_ns=1, patch="arm", y=MAPS[0, 0, :2], **made).places
        is not None
    )
    with pytest.raises(FieldError, match="of one patch"):
        Measurements(**HEAD, y=MAPS[:, 0, :2], **made)
