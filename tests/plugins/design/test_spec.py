"""Designs from options and files: what is allowed, and the line of what is not."""

from pathlib import Path

import pytest

from sparseskin.nodes.errors import SettingsError
from sparseskin.plugins.design.models import Bus
from sparseskin.plugins.design.spec import make_design, read_file

PAD = {"rows": 12, "cols": 32}


def test_a_design_has_defaults_and_units():
    d = make_design({**PAD, "pitch": "0.3cm", "noise": "20mN", "rate": "1kHz", "bus": "can-fd"})
    assert (d.n_rows, d.n_cols, d.n_taxels, d.size) == (12, 32, 384, "12 x 32 taxels")
    assert (d.pitch_m, d.noise_n, d.rate_hz) == pytest.approx((0.003, 0.02, 1000.0))
    assert d.noise == pytest.approx(0.02 / 2.5)
    assert d.bus == Bus("can-fd", (1e6, 5e6))
    assert (d.adc.bits, d.adc.rate_hz, d.bits, d.cores, d.sums) == (10, 200e3, 8, 4, "digital")


@pytest.mark.parametrize(
    "keys",
    [
        {**PAD, "rate": 500, "host": 2, "bits": 6},
        {"rows": "12", "cols": " 32", "rate": "500 Hz", "host": "2 cores", "bits": "6 "},
    ],
)
def test_numbers_of_a_file_are_those_of_options(keys):
    d = make_design(keys)
    assert (d.n_taxels, d.rate_hz, d.cores, d.bits) == (384, 500.0, 2, 6)


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        ({"rows": 12}, "cols: is missing; state rows and cols"),
        ({**PAD, "taxels": 99}, "taxels: states the size once more; leave out rows"),
        ({"rows": 1, "cols": 2}, "rows: 1 x 2 are 2 taxels; allowed: 16..65536"),
        ({**PAD, "noise": "1N"}, "noise: 1 N is not allowed for a range of 2.5 N; allowed: 0.0001"),
        ({**PAD, "rate": "0"}, "rate: '0': is outside 1 .. 10000"),
        ({**PAD, "host": "4 core s"}, "host: '4 core s': expected such as 4cores, 1..4096"),
        ({**PAD, "sums": "analogue"}, "sums: 'analogue' is not allowed (did you mean 'analog'?)"),
        ({"points": "few.csv"}, "points: few.csv: 2 points; allowed: 16..65536"),
    ],
)
def test_a_wrong_key_is_refused_in_one_line(keys, line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("few.csv").write_text("x_mm,y_mm,z_mm\n0,0,0\n5,0,0\n")
    with pytest.raises(SettingsError) as error:
        make_design(keys)
    assert str(error.value).startswith(line)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("raw", [b"rows = ", b"\xff\xfe\x00rows"])
def test_a_wrong_file_is_refused_in_one_line(raw, tmp_path):
    path = tmp_path / "design.toml"
    path.write_bytes(raw)
    with pytest.raises(SettingsError, match=r"design\.toml: no TOML: .*$"):
        read_file(path)


def test_points_stand_beside_the_file_that_names_them(tmp_path):
    lines = [f"{x},{y},0,0,0,1" for x in range(0, 25, 5) for y in range(0, 25, 5)]
    (tmp_path / "pad.csv").write_text("\n".join(["x_mm,y_mm,z_mm,nx,ny,nz", *lines, ""]))
    (tmp_path / "design.toml").write_text('points = "pad.csv"\n')
    d = make_design(read_file(tmp_path / "design.toml"))
    assert (d.n_taxels, d.n_rows) == (25, None)
    assert d.pitch_m == pytest.approx(0.005)
    assert int(d.mask.sum()) == 25
