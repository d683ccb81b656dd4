"""Output of studies: tables, CSV files, charts and pages; and what the command refuses."""

import csv

import pandas as pd
import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.studies import command
from sparseskin.studies.points import StudyError
from sparseskin.studies.report import Chart, Page, cells, draw_lines, markdown

FRAME = pd.DataFrame({"solver": ["a", "b"], "n": [3, 4], "mean dB": [41.256, None]})


def test_a_table_formats_columns_and_leaves_missing_values_empty():
    assert markdown(FRAME, {"mean dB": ".1f"}).splitlines() == [
        "| solver | n | mean dB |",
        "| --- | --- | --- |",
        "| a | 3 | 41.3 |",
        "| b | 4 |  |",
    ]
    assert cells(FRAME, "{solver}: {n:.1f}") == ["a: 3.0", "b: 4.0"]


NOTES = "# Some page\n\nOf {n} points.\n\n## Second\n\nText.\n"


@pytest.mark.parametrize("quick", [False, True])
def test_a_page_is_notes_with_values_tables_and_links(quick, tmp_path):
    (tmp_path / "notes.md").write_text(NOTES)
    page = Page(tmp_path, "some", tmp_path / "notes.md", quick)
    page.csv("rows", [{"n": 3, "x": 0.1 + 0.2}, {"n": None, "x": 1e-30}])
    with (tmp_path / "rows.csv").open(newline="") as file:
        # Every digit, and whole numbers whole.
        assert list(csv.reader(file)) == [["n", "x"], ["3", repr(0.1 + 0.2)], ["", "1e-30"]]
    page.section("", n=4)
    page.section("Second", FRAME[["n"]], "")
    page.write(["It is so."])
    text = (tmp_path / "some.md").read_text()
    assert text.startswith("# Some page\n\n- It is so.\n")
    assert "\nOf 4 points.\n\n## Second\n\nText.\n\n| n |\n| --- |\n| 3 |\n| 4 |\n" in text
    assert ("A quick run" in text) == quick
    command = "study some --quick" if quick else "study some"
    assert f"[rows.csv](rows.csv). Computed by `sparseskin {command}`." in text
    with pytest.raises(KeyError):
        page.section("")
    with pytest.raises(KeyError, match="Third"):
        page.section("Third")


def draw(out):
    out.mkdir()
    with Chart(out, "lines", "Two lines", 3, 2, sharex=True) as chart:
        for axes in chart.panels:
            draw_lines(axes, FRAME, "n", "n", "solver", order=("b", "a"))
        chart.label("n", "n again")
    assert [axes.get_xlabel() for axes in chart.panels] == ["", "n", "n"]
    assert [axes.get_ylabel() for axes in chart.panels] == ["n again", "", "n again"]
    (legend,) = chart.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["a", "b"]
    return chart.markdown


def test_a_chart_is_saved_as_png_and_svg_and_is_the_same_again(tmp_path):
    assert "![Two lines](lines.png)" in draw(tmp_path / "a") == draw(tmp_path / "b")
    for name in ("lines.png", "lines.svg"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path):
    out = tmp_path / "no_such"
    with pytest.raises(StudyError, match=r"no_such.*No such file"), Chart(out, "chart", "A chart"):
        pass
    (tmp_path / "notes.md").write_text(NOTES)
    page = Page(out, "page", tmp_path / "notes.md", quick=False)
    with pytest.raises(StudyError, match=r"no_such.*No such file"):
        page.csv("rows", FRAME)
    with pytest.raises(StudyError, match=r"no_such.*No such file"):
        page.write([])


def test_without_a_package_of_the_extra_one_line_names_it_and_the_extra(monkeypatch, capsys):
    package = command.EXTRA[-1]
    monkeypatch.setattr(command, "find_spec", lambda name: None if name == package else name)
    assert main(["study", "paper-tables"]) == 2
    error = capsys.readouterr().err
    assert f"{package} is not installed" in error
    assert "pip install 'sparseskin[charts]'" in error
    assert error.count("\n") == 1
