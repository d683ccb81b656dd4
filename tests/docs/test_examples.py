"""Every file in examples/ runs as it stands, and the site builds and needs no other host."""

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from browser import browser, lack

EXAMPLES = Path(__file__).parents[2] / "examples"
#: Drivers of hardware: test_drivers.py runs them against simulated skins.
DRIVERS = {"serial_skin", "udp_skin", "wuji_glove"}
#: Run below, as a job of several processes.
JOBS = {"mpi_pool", "dask_pool", "ray_pool"}
WITH_PICTURE = {"first_contact", "your_own_skin", "choosing_m", "calibrate"}
SLOW = WITH_PICTURE | {
    "recogniser",
    "run_graph",
    "own_solver",
    "noise_around_zero",
    "mujoco_skin",
}
ARGUMENTS = {"board_emulator": ["--frames", "3"]}
#: What each prints on its page (make gallery).
PRINTED = tomllib.loads((EXAMPLES.parent / "docs/reference/examples.toml").read_text())
#: Packages of extras that examples need.
NEEDS = {"mujoco_skin": "mujoco", "recogniser": "sklearn"}


def names():
    found = sorted(
        path.stem for path in EXAMPLES.glob("*.py") if path.stem not in DRIVERS | JOBS
    )
    return [
        pytest.param(name, marks=pytest.mark.slow if name in SLOW else [])
        for name in found
    ]


def run(name, folder, monkeypatch, *arguments):
    """Run an example as a program, in an empty folder."""
    path = EXAMPLES / f"{name}.py"
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.setattr(sys, "argv", [str(path), *arguments])
    runpy.run_path(str(path), run_name="__main__")


@pytest.mark.parametrize("name", names())
def test_an_example_runs_and_prints_its_result(name, tmp_path, monkeypatch, capsys):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name], reason=f"{NEEDS[name]} is not installed")
    arguments = ["out.png"] if name in WITH_PICTURE else ARGUMENTS.get(name, [])
    run(name, tmp_path, monkeypatch, *arguments)
    printed = capsys.readouterr().out
    # Its page is of this example: the last lines differ in numbers at most.
    last = {
        re.sub(r"[-\d.]+", "#", text.splitlines()[-1])
        for text in (printed, PRINTED[name])
    }
    assert len(last) == 1
    if name in WITH_PICTURE:
        assert (tmp_path / "out.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("name", "package", "line"),
    [
        *(
            (name, "matplotlib", "'sparseskin[charts]'")
            for name in sorted(WITH_PICTURE)
        ),
        ("mujoco_skin", "mujoco", "'sparseskin[mujoco]'"),
        ("mpi_pool", "mpi4py", "mpi4py"),
    ],
)
def test_an_example_without_its_package_ends_in_one_line_that_names_it(
    name, package, line, tmp_path, monkeypatch
):
    # None in sys.modules: an import raises ModuleNotFoundError, installed or not.
    monkeypatch.setitem(sys.modules, package, None)
    for module in [each for each in sys.modules if each.startswith(f"{package}.")]:
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(SystemExit) as refusal:
        run(name, tmp_path, monkeypatch)
    text = str(refusal.value)
    assert line in text
    assert "\n" not in text


@pytest.mark.slow
def test_the_notebook_runs_from_a_csv_to_the_error_over_m(tmp_path, monkeypatch):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    cells = json.loads(
        (EXAMPLES / "choose_m_from_csv.ipynb").read_text(encoding="utf-8")
    )["cells"]
    codes = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    # Outputs are not stored.
    assert not any(cell.get("outputs") for cell in cells)
    names: dict[str, object] = {}
    for code in codes:
        exec(code, names)
    errors = [error for error, _ in names["results"].values()]
    assert errors[0] < errors[-1] < 1
    assert (tmp_path / "error_over_m.png").read_bytes().startswith(b"\x89PNG")


def test_each_example_begins_with_a_line_on_what_it_shows():
    for path in EXAMPLES.glob("*.py"):
        first = path.read_text(encoding="utf-8").splitlines()[0]
        assert re.fullmatch(r'"""[A-Z].*[.:]', first), path.name


@pytest.mark.slow
def test_tasks_are_shared_by_the_processes_of_an_mpi_job(tmp_path):
    pytest.importorskip("mpi4py")
    mpiexec = shutil.which(
        "mpiexec", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    )
    if (
        mpiexec is None
        or subprocess.run([sys.executable, "-c", "import mpi4py.MPI"]).returncode
    ):
        pytest.skip("needs an MPI library and its mpiexec")
    job = [mpiexec, "-n", "3", sys.executable, "-m", "mpi4py.futures"]
    shutil.copy(EXAMPLES / "mpi_pool.py", tmp_path)
    done = subprocess.run(
        [*job, "mpi_pool.py"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.stdout.startswith("8 tasks on processes [1"), done.stderr
    assert "0" not in done.stdout.partition("[")[2].partition("]")[0]


ROOT = Path(__file__).parents[2]
FAULTS = """
    const missing = [...document.images].filter(i => i.complete && !i.naturalWidth);
    const name = (e) => `${e.tagName}.${e.className}: ${e.textContent.slice(0, 40)}`;
    const past = [...document.body.querySelectorAll("*")].filter(
        e => e.getBoundingClientRect().right > innerWidth + 1).map(name);
    const wide = document.documentElement.scrollWidth > innerWidth;
    return missing.map(i => i.src).concat(wide ? ["wider than the window", ...past] : []);
"""

#: What people look for, and the page that has it.
FIRST_FOUND = {
    "quantiser": "explanation/paper.html",
    "ROS 2 bag": "howto/files.html",
    "glove csv": "howto/files.html",
}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built."""
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    # Another test process may build it, too.
    out = tmp_path_factory.mktemp("out")
    pages = [sys.executable, "docs/site_pages.py", str(out)]
    subprocess.run(pages, cwd=ROOT, check=True)
    folder = out / "site"
    config = (
        (ROOT / "mkdocs.yml").read_text(encoding="utf-8").replace("out/", f"{out}/")
    )
    (out / "mkdocs.yml").write_text(config, encoding="utf-8")
    build = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict"]
    done = subprocess.run(
        [*build, "--config-file", str(out / "mkdocs.yml")],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
def test_the_site_needs_no_other_host_and_has_no_formula_as_text(site):
    pages = list(site.rglob("*.html"))
    assert {"index.html", "paper.html", "api.html", "contributing.html"} <= {
        p.name for p in pages
    }
    for page in pages:
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(
            r"<(?:script|img|link|iframe)[^>]*?(?:src|href)=\"?([^\s\">]+)", text
        )
        assert not [url for url in loaded if re.match(r"(https?:)?//", url)], page.name
        if page.parent.name == "explanation":
            text = re.sub(r"<(pre|code|script|style).*?</\1>", "", text, flags=re.S)
            assert "$" not in text, page.name
    assert "<math" in (site / "explanation" / "paper.html").read_text(encoding="utf-8")


def first_result(driver):
    """Address of the first result of a search; "" if there is none yet."""
    script = "return document.querySelector('.md-search-result__link')?.href ?? ''"
    return driver.execute_script(script)


@pytest.mark.slow
@pytest.mark.skipif(bool(lack()), reason=lack())
def test_pages_opened_as_files_fit_a_phone_and_are_searched(site, tmp_path):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.support.wait import WebDriverWait

    with browser(tmp_path, 390, 844) as driver:
        for page in sorted(site.glob("*/*.html")):
            driver.get(page.as_uri())
            assert driver.execute_script(FAULTS) == [], page.name
    with browser(tmp_path / "wide", 1440, 900) as driver:
        for query, page in FIRST_FOUND.items():
            driver.get((site / "howto" / "boards.html").as_uri())
            driver.find_element(By.NAME, "query").send_keys(query)
            # The page searches while the words are typed.
            WebDriverWait(driver, 60).until(
                lambda d, page=page: page in first_result(d), f"{query}: {page}"
            )
