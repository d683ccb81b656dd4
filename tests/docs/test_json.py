"""docs/reference/json.toml documents each field of the JSON that commands print and write, and no
other: tests of these commands check their documents by it.
"""

from documented import documented

from sparseskin.launch.attach.formats import VERSIONS


def test_every_format_is_documented_in_its_version():
    assert set(documented()) == {f"sparseskin/{name}/{k}" for name, k in VERSIONS.items()}
