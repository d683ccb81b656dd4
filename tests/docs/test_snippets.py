"""Every snippet of README and docs/ runs or is accepted by its parser; names stand in the docs."""

import importlib.util
import json
import re
import shlex
import shutil
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pytest

import sparseskin
from sparseskin.launch.commands import cli
from sparseskin.nodes.monitor.node import MonitorSettings

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"^    (\S.*)$", re.MULTILINE)
INLINE = re.compile(
    r"`(?:\.venv/bin/)?((?:sparseskin|make|python|pytest|pip) [^`\n]+)`"
)
#: Programs of the host, and words of the shell, that are not run here.
OTHERS = {"ssh", "source", "cd", "git", "docker", "."}
#: Commands that need no running graph and take a moment: these are run.
QUICK = ("scenes", "recording info", "recording export", "keys make", "--version")
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def fenced(page, language):
    """Fenced blocks of one language, in order."""
    text = page.read_text(encoding="utf-8")
    return [block for name, block in FENCED.findall(text) if name == language]


def commands(page, form):
    """Words of each command of a page: INDENTED (blocks are commands alone) or INLINE."""
    text = re.sub(FENCED, "", page.read_text(encoding="utf-8")).replace("\\\n", " ")
    for line in form.findall(text):
        words = shlex.split(line, comments=True)
        while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):
            del words[0]
        if words:
            words[0] = words[0].removeprefix(".venv/bin/")
            yield words


def stated(program, *forms):
    """Words of each command of a program on the pages, once each."""
    found = {
        shlex.join(words): words
        for page in PAGES
        for form in forms or (INDENTED, INLINE)
        for words in commands(page, form)
        if words[0] == program
    }
    return list(found.values())


def page_ids(page):
    return str(page.relative_to(ROOT))


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """An empty folder with the files that the pages name, as far as a command opens them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    page = "Matrix: 32x12\nSensor area: 0.25 cm2\nTime/picture: 20 ms\nSensor size: 0.5x0.5 cm\n"
    (tmp_path / "step.lst").write_text(f"{page}Pict-No.: 1\n\t1\n1\t10.0\n\f")
    frame = np.full((12, 32), 0.5)
    np.save(tmp_path / "log.npy", frame[None])
    np.savetxt(tmp_path / "log.csv", frame.reshape(1, -1), delimiter=",")
    models = ROOT / "examples" / "models"
    shutil.copytree(models, tmp_path / "examples" / "models")
    np.save(tmp_path / "simulated.npy", frame[None])
    np.savez(tmp_path / "simulated.npz", forces=frame[None])
    places = [f"{4 * k},{4 * i},0" for i in range(8) for k in range(10)]
    (tmp_path / "hand.csv").write_text("\n".join(["x_mm,y_mm,z_mm", *places]))
    (tmp_path / "my_robot.py").write_text(
        "def pad():\n    yield 0, [[0.5] * 32] * 12\n"
    )
    (tmp_path / "my_skin.py").write_text(
        "def frames():\n    yield 0, [[0.5] * 32] * 12\n"
    )
    return tmp_path


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A short recording of a graph."""
    path = tmp_path_factory.mktemp("bag") / "drag.mcap"
    launch = sparseskin.load_launch("drag_wrench_40", record=str(path))
    assert sum(1 for _ in sparseskin.run_launch(launch, 8)) == 8
    return path


@pytest.mark.parametrize(
    "page", [p for p in PAGES if fenced(p, "python")], ids=page_ids
)
def test_python_blocks_of_a_page_run_one_after_the_other(page, workplace):
    names = {"__name__": "__main__"}
    for number, block in enumerate(fenced(page, "python"), 1):
        if file := re.match(r"# (\w+)\.py\b", block):
            (workplace / f"{file[1]}.py").write_text(block, encoding="utf-8")
            importlib.invalidate_caches()
            names |= vars(importlib.import_module(file[1]))
        else:
            exec(compile(block, f"{page.name}, block {number}", "exec"), names)


def test_the_driver_of_the_pages_delivers_frames(workplace):
    (block,) = (
        b for b in fenced(ROOT / "docs/howto/drivers.md", "python") if "my_skin.py" in b
    )
    (workplace / "my_skin.py").write_text(block, encoding="utf-8")
    frames = sparseskin.run_launch("replay", 3, ["sensor.source=my_skin:frames"])
    assert [frame.taxels.shape for frame in frames] == [(12, 32)] * 3


@pytest.mark.parametrize("page", [p for p in PAGES if fenced(p, "toml")], ids=page_ids)
def test_launch_files_of_a_page_are_accepted(page, workplace):
    for name in ("arm", "desk"):
        assert cli.main(["keys", "make", name]) == 0
    (workplace / "model.joblib").touch(mode=0o600)  # it is read when the node starts
    for number, block in enumerate(fenced(page, "toml")):
        path = workplace / f"page{number}.toml"
        path.write_text(block, encoding="utf-8")
        assert sparseskin.load_launch(str(path)).nodes


@pytest.mark.parametrize("words", stated("sparseskin", INDENTED), ids=" ".join)
def test_a_command_of_the_pages_is_accepted(words, workplace, bag, capsys):
    arguments = list(words[1:])
    if "--record" not in arguments:
        (workplace / "drag.mcap").write_bytes(bag.read_bytes())
    assert cli.make_parser(arguments).parse_args(arguments).run
    if "lerobot" in arguments:
        pytest.importorskip("pyarrow")
    if " ".join(arguments).startswith(QUICK):
        assert cli.main(arguments) == 0
    elif arguments[0] == "launch" and runnable(arguments):
        assert cli.main([*arguments, "--dry-run"]) == 0
        assert "\nNODE " in capsys.readouterr().out


def test_commands_named_in_the_text_have_help(capsys):
    for words in stated("sparseskin", INLINE):
        with pytest.raises(SystemExit) as done:
            cli.main([*words[1:], "--help"])
        assert done.value.code == 0, words


def runnable(arguments):
    """True if a launch command names no file or device that only its reader has."""
    readers = (".toml", "--host", "serial:/dev", "file:my_bag", ".csv --open")
    return not any(part in " ".join(arguments) for part in readers)


def test_targets_scripts_tests_and_extras_of_the_pages_are_there():
    targets = {
        word for words in stated("make") for word in words[1:] if "=" not in word
    }
    done = subprocess.run(
        ["make", "-n", *targets], cwd=ROOT, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr
    for words in [*stated("python"), *stated("pytest")]:
        target = next(
            word for word in words[1:] if "/" in word or not word.startswith("-")
        )
        if words[1:3] == ["-m", "pytest"]:
            target = words[-1]
        if words[1] == "-m" and words[2] != "pytest":
            assert importlib.util.find_spec(words[2]) is not None
        else:
            assert (ROOT / target).exists()
    known = set(PYPROJECT["project"]["optional-dependencies"])
    for words in stated("pip"):
        for extras in re.findall(r"\.\[([\w,]+)\]", " ".join(words)):
            assert set(extras.split(",")) <= known
    known = {"sparseskin", "make", "python", "pip", *OTHERS}
    for first in {
        words[0] for page in PAGES for words in commands(page, INDENTED)
    } - known:
        assert (ROOT / first).exists(), first


TEXTS = {
    page: page.read_text(encoding="utf-8")
    for page in [
        *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
        *sorted((ROOT / "docs").rglob("*.md")),
    ]
}
TOP = "messages|nodes|launch|plugins|packages|studies|sparseskin|examples|tests|docs"
PATH = re.compile(rf"`((?:{TOP})/[\w/.]*)`")
MODULE = re.compile(rf"`((?:{TOP})/[\w/]*/)`,\s+module\s+`(\w+)`")
DOTTED = re.compile(r"`(?:import )?(sparseskin(?:\.\w+)+)`")
TEST = re.compile(r"`(test_\w+\.py)`")
LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)")
#: Paths that were, and are named as such.
FORMER = {"docs/examples/"}


def test_every_path_of_a_page_is_there():
    modules = {
        path.stem for top in TOP.split("|") for path in (ROOT / top).rglob("*.py")
    }
    for page, text in TEXTS.items():
        missing = [
            p for p in PATH.findall(text) if p not in FORMER and not (ROOT / p).exists()
        ]
        missing += [
            f"{folder}{name}.py"
            for folder, name in MODULE.findall(text)
            if not (ROOT / folder / f"{name}.py").exists()
        ]
        # A module that is named without its folder is somewhere.
        missing += sorted(set(re.findall(r"\bmodules?\s+`(\w+)`", text)) - modules)
        assert not missing, page


def test_every_module_and_name_of_a_page_can_be_found():
    for dotted in DOTTED.findall("\n".join(TEXTS.values())):
        parts = dotted.split(".")[1:]
        while parts and not found(parts):
            attribute = parts.pop()
            base = ROOT.joinpath(*parts)
            top = ROOT / "src" / "sparseskin" / "__init__.py"
            source = base.with_suffix(".py") if parts else top
            if source.is_file():
                assert re.search(
                    rf"\b{attribute}\b", source.read_text(encoding="utf-8")
                ), dotted
                break
        else:
            assert parts, dotted


def found(parts):
    path = ROOT.joinpath(*parts)
    return path.is_dir() or path.with_suffix(".py").is_file()


def test_every_test_and_link_of_a_page_is_there_no_path_of_a_machine_and_the_version():
    tests = {path.name for path in (ROOT / "tests").rglob("test_*.py")}
    for page, text in TEXTS.items():
        assert set(TEST.findall(text)) <= tests, page
        missing = [
            link for link in LINK.findall(text) if not (page.parent / link).exists()
        ]
        assert not missing, page
        assert not re.search(r"(?<![\w.])/(home|root|work|tmp|Users)/", text), page
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
        "project"
    ]
    assert f"\nversion: {project['version']}\n" in citation


def test_every_picture_has_the_command_that_makes_it_beside_it():
    command = re.compile(
        r"(?:`|^ {4})(sparseskin|make|python|\.venv/bin/python) ", re.M
    )
    for page, text in TEXTS.items():
        lines = [line for line in text.splitlines() if line]
        for k, line in enumerate(lines):
            by_hand = "data_flow.svg" in line or "skin_state.svg" in line
            if line.startswith("![") and not by_hand:
                assert command.search("\n".join(lines[max(0, k - 2) : k + 8])), (
                    page,
                    line,
                )


def test_the_container_starts_a_graph_and_forwards_the_port_of_its_page():
    text = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    forwards, launches = re.fullmatch(
        r"(.*) & +exec (.*)\n", text.rpartition("CMD ")[2]
    ).groups()
    port = str(MonitorSettings().port)
    assert f"TCP:127.0.0.1:{port}" in shlex.split(forwards)
    # The page has its own port on one interface, so the forwarder listens on another one, which
    # the printed address leads to through the port that `docker run` publishes.
    exposed = re.search(r"^EXPOSE (\d+)$", text, re.M)[1]
    assert exposed != port
    assert f"TCP-LISTEN:{exposed}," in forwards
    published = f"docker run --rm --init -p 127.0.0.1:{port}:{exposed} sparseskin"
    install = (ROOT / "docs" / "start" / "install.md").read_text(encoding="utf-8")
    assert published in text
    assert published in install
    of_editor = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text())
    assert of_editor["forwardPorts"] == [int(port)]
    assert cli.main([*shlex.split(launches)[1:], "--dry-run"]) == 0
