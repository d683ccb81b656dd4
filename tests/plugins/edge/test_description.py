"""The description of an edge: what is refused, and that its file is read back as it was."""

import numpy as np
import pytest

from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.base import RANDOM
from sparseskin.nodes.errors import SettingsError
from sparseskin.plugins.edge.description import EdgeDescription

MASK = np.array([[True, False, True], [True, True, True]])


@pytest.mark.parametrize("mask", [None, MASK])
def test_its_file_is_read_back_as_it_was_written(mask, tmp_path):
    made = EdgeDescription.chosen(2, 3, ratio=2, mask=mask, bits=11, block=4, seed=3, adc_bits=9)
    path = tmp_path / "edge.toml"
    path.write_text(made.to_toml())
    read = EdgeDescription.read(path)
    assert read.to_toml() == made.to_toml()
    assert read.phi.fingerprint == made.phi.fingerprint
    assert read.tags == made.tags


@pytest.mark.parametrize(("ratio", "rows"), [(1, None), (3, "fixed"), (3.5, None), (8, "rotating")])
def test_rows_and_m_are_those_of_the_compressor(ratio, rows):
    made = EdgeDescription.chosen(7, 9, ratio=ratio, rows=rows)
    assert (made.rows, made.m) == CompressorSettings(ratio=ratio, rows=rows).rows_and_m(63)


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"n_rows": 0}, "n_rows: 0 is outside 1..4096"),
        ({"n_rows": 4096, "n_cols": 17}, "n_rows: 69632 cells; allowed: 65536 or fewer"),
        ({"block": 48}, "block: 48 is not a power of two (1, 2, 4 ...)"),
        ({"m": 13}, "m: 13 is not allowed; allowed: 1..12"),
        ({"rows": "rotate"}, "rows: 'rotate' is not allowed (did you mean 'rotating'?)"),
        ({"mask": ["0000"] * 3}, "mask: leaves no taxel"),
    ],
)
def test_values_that_are_not_allowed_are_refused_by_name(values, line):
    with pytest.raises(SettingsError) as refused:
        EdgeDescription(**{"n_rows": 3, "n_cols": 4, "m": 4, **values})
    assert str(refused.value).startswith(line)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("n_rows = 6", "n_row = 6", "n_row: unknown key (did you mean 'n_rows'?)"),
        ("version = 1", "version = 2", "version: 2 is not allowed; allowed: 1"),
        ("seed = 0", "seed = 1", "fingerprint: "),
        (
            "seed = 0",
            "seed = 0\nmask = [" + '"1x1111",' * 6 + "]",
            "mask: expected texts of 0 and 1",
        ),
    ],
)
def test_a_file_that_was_changed_is_refused_with_its_place(old, new, line, tmp_path):
    path = tmp_path / "edge.toml"
    text = EdgeDescription.chosen(6, 6, ratio=3).to_toml()
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))
    with pytest.raises(SettingsError) as refused:
        EdgeDescription.read(path)
    assert str(refused.value).startswith(f"{path}: {line}")
    assert "\n" not in str(refused.value)


EDGE = """
version = 1
n_rows = 9
n_cols = 11
m = 30
bits = 8
rows = "rotating"
block = 32
seed = 7
adc_bits = 12
fingerprint = "443e07fb12311131"
mask = ["00011111111", {eight}]
"""


def test_a_file_of_version_0_1_is_read(tmp_path):
    path = tmp_path / "edge.toml"
    path.write_text(EDGE.format(eight=", ".join(['"11111111111"'] * 8)), encoding="utf-8")
    read = EdgeDescription.read(path)
    assert (read.rule, len(read.subsets)) == (RANDOM, 4)
    path.write_text(read.to_toml(), encoding="utf-8")
    assert EdgeDescription.read(path).tags == read.tags
