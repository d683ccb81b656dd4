"""skin.toml: what is written is read again, and what is not as stated is refused in one line."""

import os
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from damaged import refusal
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparseskin.nodes.files import OutputError
from sparseskin.nodes.sensor.calibration.description import (
    Response,
    SkinDescription,
    SkinFileError,
)
from sparseskin.nodes.sensor.skin_file import (
    MAX_FILE_CHARS,
    MAX_INLINE,
    load_skin,
    save_skin,
)

HEAD = "n_rows = 2\nn_cols = 3\nf_max = 2.5\n"


def write(folder, text):
    path = folder / "palm.toml"
    path.write_text(text)
    return path


def assert_same(a, b):
    """Equal field by field, arrays with their dtype."""
    for field in fields(a):
        one = getattr(a, field.name)
        other = getattr(b, field.name)
        if isinstance(one, Response):
            assert_same(one, other)
        elif isinstance(one, np.ndarray):
            np.testing.assert_array_equal(one, other)
            assert one.dtype == other.dtype
        else:
            assert one == other, field.name


def test_a_file_of_the_required_keys_alone_describes_a_skin_without_calibration(
    tmp_path,
):
    skin = load_skin(write(tmp_path, HEAD))
    assert skin.name == "palm"
    assert skin.shape == (2, 3)
    assert skin.f_max == 2.5
    assert skin.unit == "N"
    assert not skin.changes_readings
    assert skin.skin.mask is None
    assert skin.skin.pitch_m is None


def test_a_file_with_all_keys(tmp_path):
    text = HEAD + (
        'name = "left palm"\nunit = "kPa"\npitch_mm = 2.5\nmask = ["110", "111"]\n'
        "baseline = 12\ngains = [[1, 2, 3], [-4, 5, 6.5]]\nnoise = 0.01\nnoise_mid = 0.02\n"
        "f_min = -0.05\n[response]\nreading = [1, 3]\nforce = [0.5, 2.5]\n"
    )
    skin = load_skin(write(tmp_path, text))
    assert skin.skin.pitch_m == 0.0025
    assert skin.skin.n_taxels == 5
    assert skin.baseline is not None
    assert (skin.baseline == 12.0).all()
    assert skin.gains[1, 0] == -4.0
    np.testing.assert_allclose(skin.response.slopes, [0.5, 1.0])


finite = st.floats(-1e6, 1e6)
sizes = st.floats(1e-3, 1e3)


@st.composite
def skins(draw):
    shape = draw(st.tuples(st.integers(1, 5), st.integers(1, 5)))
    k = draw(st.integers(1, 4))
    steps = draw(arrays(np.float64, k, elements=sizes))
    own = draw(st.booleans())
    reading = draw(
        arrays(np.float64, (k, *shape) if own else k, elements=sizes)
    ).cumsum(axis=0)
    grids = {
        "baseline": arrays(np.float64, shape, elements=finite),
        "gains": arrays(np.float64, shape, elements=sizes | sizes.map(lambda x: -x)),
        "mask": arrays(np.bool_, shape).filter(lambda mask: bool(mask.any())),
    }
    chosen = {key: draw(st.none() | kind) for key, kind in grids.items()}
    return SkinDescription(
        name=draw(
            st.text(min_size=1, max_size=9).filter(
                lambda s: s.isprintable() and s.strip()
            )
        ),
        n_rows=shape[0],
        n_cols=shape[1],
        f_max=draw(st.floats(1.0, 1e3)),
        unit=draw(st.sampled_from(["N", "kPa", '"\\'])),
        pitch_mm=draw(st.none() | sizes),
        response=draw(st.none() | st.just(Response(reading, steps.cumsum()))),
        noise=draw(st.none() | st.floats(0.0, 1.0)),
        f_min=draw(st.just(0.0) | st.floats(-1.0, -1e-9)),
        **chosen,
    )


@given(skin=skins())
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_what_is_written_is_read_again(tmp_path_factory, skin):
    path = tmp_path_factory.mktemp("skins") / "skin.toml"
    assert save_skin(path, skin) == [path]
    assert_same(skin, load_skin(path))


def test_large_arrays_are_written_beside_the_file_and_read_again(tmp_path):
    rng = np.random.default_rng(1)
    shape = (64, 80)
    assert shape[0] * shape[1] > MAX_INLINE
    skin = SkinDescription(
        *("sole", *shape, 2.5),
        mask=rng.random(shape) > 0.1,
        baseline=rng.random(shape),
        gains=np.full(shape, 0.25),
        response=Response(
            rng.random((3, *shape)).cumsum(axis=0) + 0.1, np.array([0.5, 1.0, 2.5])
        ),
    )
    path = tmp_path / "sole.toml"
    assert [one.name for one in save_skin(path, skin)] == ["sole.toml", "sole.npz"]
    assert len(path.read_text()) < 1000
    assert_same(skin, load_skin(path))


def test_no_file_is_written_over(tmp_path):
    skin = SkinDescription("s", 64, 80, 2.5, baseline=np.arange(5120.0).reshape(64, 80))
    (tmp_path / "s.npz").write_bytes(b"mine")
    with pytest.raises(OutputError, match=r"s\.npz: exists already"):
        save_skin(tmp_path / "s.toml", skin)
    assert [one.name for one in tmp_path.iterdir()] == ["s.npz"]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("n_rows = 2\nn_cols = 3\n", "f_max: is missing"),
        (HEAD + "gain = 1", "gain: unknown key (did you mean 'gains'?)"),
        (
            HEAD + "[response]\nreadings = [1]",
            "response.readings: unknown key (did you mean 'rea",
        ),
        (
            HEAD + "[response]\nreading = [2, 1]\nforce = [1, 2]",
            "response.reading: must be above",
        ),
        (
            HEAD + "[response]\nreading = [1e-300]\nforce = [1e30]",
            "response: a slope is outside",
        ),
        (
            HEAD + f"[response]\nforce = {list(range(1, 34))}\nreading = [1]",
            "33 knots; allowed",
        ),
        (HEAD + "response = 3", "response: expected a table"),
        (
            "n_rows = true\nn_cols = 3\nf_max = 1",
            "n_rows: expected a whole number, got bool",
        ),
        ("n_rows = 4096\nn_cols = 4096\nf_max = 1", "4096 x 4096 cells; at most"),
        (HEAD + "noise_mid = 1", "noise_mid: is stated without noise"),
        (HEAD + "unit = ''", "unit: expected 1..32 printable"),
        (
            HEAD + "mask = ['111', '112']",
            "mask: expected 2 texts of 3 characters 0 and 1",
        ),
        (
            HEAD + "baseline = [[1, 2, 3], [1, 2, nan]]",
            "baseline: expected numbers of at most",
        ),
        (HEAD + "gains = 0", "gains: expected numbers of 1e-12..1e+12"),
        (
            HEAD + "gains = [1, 2]",
            "gains: float64 of shape (2,); expected float64 of shape (2, 3)",
        ),
        (HEAD + "arrays = 'b.npz'", "arrays: b.npz: "),
        (HEAD + "a = " + "[" * 900, "more than 8 tables or lists"),
        ("n_rows = ", "not TOML"),
        ("#" * (4 * MAX_FILE_CHARS + 1), "more than 1048576 bytes"),
    ],
)
def test_a_hostile_file_is_refused_in_one_line(tmp_path, text, line):
    path = write(tmp_path, text)
    shown = refusal(lambda: load_skin(path), SkinFileError)
    assert shown.startswith(f"{path}: ")
    assert line in shown
    assert "\n" not in shown
    assert len(shown) < len(str(path)) + 250


def save_arrays(path, **held):
    with path.open("wb") as file:
        np.savez_compressed(file, **held)


@pytest.mark.parametrize(
    ("held", "line"),
    [
        ({"baseline": np.zeros((3, 2))}, "float64 of shape (3, 2); expected float64"),
        ({"mask": np.array([[object()]])}, "it holds Python objects"),
        ({"baseline": np.zeros((2000, 2000))}, "bytes, of a file of"),
        ({"response_reading": np.ones((1, 2, 3))}, "response.force: is missing"),
    ],
)
def test_hostile_arrays_are_refused_in_one_line(tmp_path, held, line):
    save_arrays(tmp_path / "b.npz", **held)
    assert line in refusal(
        lambda: load_skin(write(tmp_path, HEAD + "arrays = 'b.npz'")), SkinFileError
    )


def test_arrays_stay_beside_the_file_and_pipes_and_folders_are_refused_at_once(
    tmp_path,
):
    away = tmp_path / "away"
    away.mkdir()
    save_arrays(away / "b.npz", baseline=np.zeros((2, 3)))
    (tmp_path / "b.npz").symlink_to(away / "b.npz")
    with pytest.raises(SkinFileError, match="is not a file beside"):
        load_skin(write(tmp_path, HEAD + "arrays = 'b.npz'"))
    os.mkfifo(tmp_path / "pipe.toml")
    (tmp_path / "folder.toml").mkdir()
    for name, what in (
        ("pipe", "is no regular file"),
        ("folder", "is a directory"),
        ("none", "no such file"),
    ):
        with pytest.raises(SkinFileError, match=what):
            load_skin(tmp_path / f"{name}.toml")


@given(raw=st.binary(max_size=300))
def test_any_bytes_are_a_skin_or_refused(tmp_path_factory, raw):
    folder = tmp_path_factory.mktemp("bytes")
    (folder / "b.npz").write_bytes(b"PK\x03\x04" + raw)
    (folder / "s.toml").write_bytes(raw)
    for path in (folder / "s.toml", write(folder, HEAD + "arrays = 'b.npz'")):
        with pytest.raises(SkinFileError):
            load_skin(path)


@given(
    knots=arrays(np.float64, (2, 4), elements=sizes),
    readings=arrays(np.float64, (2, 3), elements=st.floats(-1e4, 1e4)),
)
def test_a_response_curve_inverts_and_rises(knots, readings):
    curve = Response(knots[0].cumsum(), knots[1].cumsum())
    found = Response(curve.force, curve.reading).forces(curve.forces(readings))
    # Slopes of 1e-6..1e6 and their inverses amplify rounding by their ratio.
    scale = np.abs(curve.slopes).max() / np.abs(curve.slopes).min()
    np.testing.assert_allclose(
        found, readings, atol=1e-11 * scale * (1 + np.abs(readings).max())
    )
    order = np.argsort(readings.ravel())
    assert (np.diff(curve.forces(readings).ravel()[order]) >= 0).all()


def test_the_file_of_the_documentation_is_read(tmp_path):
    page = (Path(__file__).parents[3] / "docs/howto/calibration.md").read_text(
        encoding="utf-8"
    )
    text = page.partition("```text\n")[2].partition("```")[0]
    row = f'    "{"1" * 32}",\n'
    text = text.replace("    # ... 16 of them\n", 15 * row)
    text = "".join(
        line for line in text.splitlines(True) if not line.startswith("arrays")
    )
    skin = load_skin(write(tmp_path, text))
    assert skin.shape == (16, 32)
    assert skin.response is not None
