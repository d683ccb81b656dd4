"""Vendors' exports: what shows at their begin, and what becomes of damaged ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from damaged import refusal
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from vendor_texts import ASC, emed_text, tekscan_text, xsensor_text

from sparseskin.nodes.sensor.files.recorded import RecordedSource, n_taxels, open_file

TEXTS = {
    "foot.lst": emed_text(),
    "hand.asf": tekscan_text().rstrip("\n"),
    "sole.csv": xsensor_text(),
    "mat.asc": ASC,
}
#: Pieces that mean something in one of them.
PIECES = ["", "9", "-", "\t", ",", "\n", "\f", "\xb2", "nan", "SENSELS\n", "FRAME,", "[c]"]


def opened(folder: Path, name: str, text: str) -> RecordedSource | None:
    """A file with a text; None where it is refused, in one line."""
    path = folder / name
    path.write_bytes(text.encode("latin-1"))
    f_max = 100.0 if name in ("foot.lst", "sole.csv") else None
    found: list[RecordedSource] = []
    assert refusal(lambda: found.append(open_file(path, f_max=f_max))).isprintable()
    return found[0] if found else None


@pytest.mark.parametrize(("name", "n"), [("foot.lst", 12), ("hand.asf", 4), ("mat.asc", 3)])
def test_the_number_of_taxels_shows_at_the_begin(name: str, n: int, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(TEXTS[name].encode("latin-1"))
    assert n_taxels(str(tmp_path / name)) == n


@pytest.mark.parametrize("name", TEXTS)
def test_windows_line_ends_and_commas_of_a_spreadsheet_are_read_the_same(
    name: str, tmp_path: Path
) -> None:
    whole = opened(tmp_path, name, TEXTS[name])
    assert whole is not None
    texts = [TEXTS[name].replace("\n", "\r\n")]
    if name == "hand.asf":
        texts.append(TEXTS[name].replace("\n", ",,,\n"))
    for text in texts:
        again = opened(tmp_path, name, text)
        assert again is not None
        np.testing.assert_array_equal(again.frames, whole.frames)


@pytest.mark.parametrize("name", ["foot.lst", "hand.asf", "sole.csv"])
def test_a_file_cut_anywhere_is_refused_or_loses_whole_frames(name: str, tmp_path: Path) -> None:
    text = TEXTS[name]
    whole = opened(tmp_path, name, text)
    assert whole is not None
    n_read = 0
    for end in range(1, len(text)):
        if (cut := opened(tmp_path, name, text[:end])) is not None:
            np.testing.assert_array_equal(cut.frames, whole.frames[: len(cut.frames)])
            n_read += 1
    assert n_read < len(text) - 1
    assert name != "hand.asf" or n_read == 0  # it has an end mark


@settings(
    max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(name=st.sampled_from(list(TEXTS)), data=st.data())
def test_damaged_files_give_what_a_source_promises_or_are_refused(
    name: str, data: st.DataObject, tmp_path: Path
) -> None:
    text = TEXTS[name]
    if data.draw(st.booleans()):
        text = data.draw(st.binary(max_size=300)).decode("latin-1")
    for _ in range(data.draw(st.integers(1, 4)) if text else 0):
        start = data.draw(st.integers(0, len(text) - 1)) if text else 0
        new = data.draw(
            st.sampled_from(PIECES) | st.binary(max_size=3).map(lambda b: b.decode("latin-1"))
        )
        text = text[:start] + new + text[start + data.draw(st.integers(0, 6)) :]
    source = opened(tmp_path, name, text)
    if source is None:
        return
    assert np.isfinite(source.frames).all()
    assert source.frames.min() >= 0
    assert source.frames.max() <= np.float32(source.skin.f_max)
    assert (np.diff([stamp for stamp, _ in source]) > 0).all()
