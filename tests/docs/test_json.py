"""docs/reference/json.toml documents each field of the JSON that commands print and write, and no
other: tests of these commands check their documents by it.
"""

import pytest
from documented import check, documented

from sparseskin.launch.attach.formats import VERSIONS


def test_every_format_is_documented_in_its_version():
    assert set(documented()) == {f"sparseskin/{name}/{k}" for name, k in VERSIONS.items()}


def test_a_field_that_is_not_documented_or_of_another_type_is_noticed():
    document = {"format": "sparseskin/param-set/1", "node": "a", "set": {"m": 3}, "answer": "m = 3"}
    check(document)
    for wrong in (
        {**document, "more": 1},
        {**document, "answer": 3},
        {"format": document["format"]},
    ):
        with pytest.raises(AssertionError):
            check(wrong)
