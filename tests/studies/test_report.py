"""Output of studies: tables, CSV files, charts and pages; accuracy over speed; refusals."""

import csv
import importlib
import re

import numpy as np
import pandas as pd
import pytest
from damaged import npz

from sparseskin.launch.commands.cli import main
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.skin.gates import Gates
from sparseskin.nodes.reconstructor.skin.tiles import WINDOW
from sparseskin.nodes.reconstructor.skin.tuning import SkinTuning
from sparseskin.nodes.reconstructor.solvers.fista import FistaSolver
from sparseskin.studies import command
from sparseskin.studies.accuracy import constants, rules
from sparseskin.studies.baselines.libraries import PEERS, Bpdn, Library, TotalVariation
from sparseskin.studies.points import StudyError
from sparseskin.studies.report import Chart, Page, cells, draw_lines, markdown
from sparseskin.studies.speed_accuracy.experiments import ROTATED
from sparseskin.studies.speed_accuracy.time_chart import draw_times
from sparseskin.studies.training import train

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
        assert list(csv.reader(file)) == [
            ["n", "x"],
            ["3", repr(0.1 + 0.2)],
            ["", "1e-30"],
        ]
    page.section("", n=4)
    page.section("Second", FRAME[["n"]], "")
    page.write(["It is so."])
    text = (tmp_path / "some.md").read_text()
    assert text.startswith("# Some page\n\n- It is so.\n")
    assert (
        "\nOf 4 points.\n\n## Second\n\nText.\n\n| n |\n| --- |\n| 3 |\n| 4 |\n" in text
    )
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
        assert (tmp_path / "a" / name).read_bytes() == (
            tmp_path / "b" / name
        ).read_bytes()


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path):
    out = tmp_path / "no_such"
    with (
        pytest.raises(StudyError, match=r"no_such.*No such file"),
        Chart(out, "chart", "A chart"),
    ):
        pass
    (tmp_path / "notes.md").write_text(NOTES)
    page = Page(out, "page", tmp_path / "notes.md", quick=False)
    with pytest.raises(StudyError, match=r"no_such.*No such file"):
        page.csv("rows", FRAME)
    with pytest.raises(StudyError, match=r"no_such.*No such file"):
        page.write([])


def test_without_a_package_of_the_extra_one_line_names_it_and_the_extra(
    monkeypatch, capsys
):
    package = command.EXTRA[-1]
    monkeypatch.setattr(
        command, "find_spec", lambda name: None if name == package else name
    )
    assert main(["study", "paper-tables"]) == 2
    error = capsys.readouterr().err
    assert f"{package} is not installed" in error
    assert "pip install 'sparseskin[charts]'" in error
    assert error.count("\n") == 1


GRID = (12, 20)


def problem_of(lambda_n=0.01, sigma_n=0.0):
    n = GRID[0] * GRID[1]
    phi = make_phi("sbhe", n=n, m=n // 3, seed=0)
    return Bpdn(phi, make_basis("haar", *GRID), lambda_n, sigma_n)


def minimum(problem, y):
    """Coefficients after 1000 iterations of the project's FISTA."""
    solver = FistaSolver(
        problem.phi, problem.basis, iterations=1000, lambda_n=problem.lambda_n
    )
    solver.solve(y)
    return solver.theta.reshape(-1)


def pressed():
    """A frame of two flat pads, newtons."""
    frame = np.zeros(GRID, np.float32)
    frame[2:6, 3:9] = 1.0
    frame[8:11, 12:14] = 0.4
    return frame


def test_the_problem_has_an_adjoint_and_its_minimum_is_lowest():
    problem = problem_of()
    rng = np.random.default_rng(0)
    theta = rng.standard_normal(problem.phi.n).astype(np.float32)
    y = rng.standard_normal(problem.phi.m).astype(np.float32)
    inner = float(problem.forward(theta) @ y)
    assert inner == pytest.approx(float(theta @ problem.adjoint(y)), abs=1e-3)
    best = minimum(problem, y)
    # At the minimum no coefficient's gradient is steeper than lambda.
    gradient = problem.adjoint(problem.forward(best) - y)
    assert np.abs(gradient).max() <= problem.lambda_n * 1.01
    for step in (1e-3, -1e-3):
        assert problem.objective(best + step * theta, y) > problem.objective(best, y)


@pytest.mark.parametrize("name", [name for name in PEERS if name != "SPGL1"])
def test_a_library_finds_the_minimum_and_goes_on_from_its_last_frame(name):
    pytest.importorskip(PEERS[name].module)
    problem = problem_of()
    frame = pressed()
    y = problem.phi.forward(frame.reshape(-1))
    lowest = problem.objective(minimum(problem, y), y)
    expected = problem.image(minimum(problem, y))
    library = Library(name, problem, 600)
    solved = library.reconstruct(frame)
    assert np.abs(solved.forces - expected).max() < 0.01
    # As few iterations are enough from there, and not from nothing.
    library._iterations = 2
    library.reconstruct(frame)
    assert problem.objective(library._theta, y) <= 1.01 * lowest
    library.reset()
    library.reconstruct(frame)
    assert problem.objective(library._theta, y) > 1.1 * lowest


def test_spgl1_fits_to_the_noise_and_finds_nothing_within_it():
    pytest.importorskip("spgl1")
    problem = problem_of(sigma_n=0.02)
    frame = pressed()
    library = Library("SPGL1", problem, 300)
    library.reconstruct(frame)
    y = problem.phi.forward(frame.reshape(-1))
    bound = 0.02 * problem.phi.m**0.5
    assert np.linalg.norm(problem.forward(library._theta) - y) == pytest.approx(
        bound, rel=0.02
    )
    # The true frame explains y as well, so that its coefficients are no fewer in sum.
    assert np.abs(library._theta).sum() < np.abs(problem.basis.analysis(frame)).sum()
    weak = frame * np.float32(0.5 * bound / np.linalg.norm(y))
    assert not library.reconstruct(weak).forces.any()


def test_the_chart_of_times_names_the_default_and_every_other_point(tmp_path):
    rng = np.random.default_rng(0)
    labels = [*[ROTATED] * 4, "tv", "fista, preset paper", *PEERS]
    points = pd.DataFrame(
        {
            "panel": "N = 1600",
            "label": labels,
            "pace": [1, 8, 16, 24, *[0] * (len(labels) - 4)],
            # Close to each other, so that labels are in each other's way.
            "median_ms": rng.uniform(1, 4, len(labels)),
            "mean_db": rng.uniform(44, 50, len(labels)),
        }
    )
    draw_times(tmp_path, points, {"N = 1600": 46.0})
    texts = re.findall("<!-- (.+) -->", (tmp_path / "time_of_a_frame.svg").read_text())
    assert {"tv", "fista, preset paper", *PEERS} <= set(texts)
    assert sum("default" in text for text in texts) == 1


def test_total_variation_of_sigpy_finds_an_even_box():
    pytest.importorskip("sigpy")
    mask = np.ones((16, 16), np.bool_)
    mask[0] = False
    box = np.zeros((16, 16), np.float32)
    box[5:11, 4:12] = 1
    phi = make_phi("sbhe", n=240, m=120, seed=0)
    found = TotalVariation(phi, mask, 0.01, 1000).reconstruct(box).forces
    assert np.linalg.norm(found - box) < 0.1 * np.linalg.norm(box)
    assert not found[0].any()


def test_every_constant_has_a_candidate_halved_and_doubled():
    assert set(constants.PARTS + constants.GROWTHS) <= set(constants.VALUES)
    assert set(constants.SWITCHES) == set(vars(SkinTuning())) - set(constants.VALUES)
    tunings = [
        one.settings.get("tuning", {}) for one in constants.candidates().values()
    ]
    for name in constants.VALUES:
        low, high = (tuning[name] for tuning in tunings if name in tuning)
        assert low < getattr(SkinTuning(), name) < high


@pytest.mark.parametrize("name", rules.RULES)
def test_every_rule_is_switched_off_and_on_again(name):
    rule = rules.RULES[name]
    before = {place: _attribute(*place) for place in rule.patches}
    assert rule.switch
    with rules.switched_off(rule) as tuning:
        assert all(_attribute(*place) == value for place, value in rule.patches.items())
        assert (tuning == SkinTuning()) == (not rule.tuning)
    assert before == {place: _attribute(*place) for place in rule.patches}


def _attribute(module, name):
    place = importlib.import_module(module)
    *owners, attribute = name.split(".")
    for owner in owners:
        place = getattr(place, owner)
    return getattr(place, attribute, None)


def test_the_worst_column_is_named_first():
    unchanged = pd.Series(0.0, index=list(rules.COLUMNS))
    assert rules.worse(unchanged) == rules.NOTHING
    changed = unchanged.copy()
    changed["sudden, dB"] = -0.5
    changed["silent, %"] = 1.0
    changed["moving, dB"] = 3.0
    assert rules.worse(changed) == "**silent, %**; sudden, dB"


def test_without_pytorch_the_study_names_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(train, "find_spec", lambda name: None)
    with pytest.raises(StudyError, match=r"sparseskin\[train\]"):
        train.run(tmp_path, quick=True, seed=0, executor="")


def test_network_and_gates_are_the_same():
    torch = pytest.importorskip("torch")
    from sparseskin.studies.training.network import first_network, gated, weights

    network = first_network(0)
    gates = Gates.read(npz(**weights(network)), "trained")
    shape = (50, WINDOW * WINDOW)
    windows = 3 * np.random.default_rng(0).standard_normal(shape, dtype=np.float32)
    tiles, error = gated(network, torch.tensor(windows))
    found, expected = gates.gated(windows)
    np.testing.assert_allclose(found, tiles.detach().numpy(), atol=1e-4)
    np.testing.assert_allclose(expected, error.detach().numpy(), rtol=1e-4)
