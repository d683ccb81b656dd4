"""Paths, modules and tests that the pages and docstrings of examples name are there."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = {
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
    modules = {path.stem for top in TOP.split("|") for path in (ROOT / top).rglob("*.py")}
    for page, text in PAGES.items():
        missing = [p for p in PATH.findall(text) if p not in FORMER and not (ROOT / p).exists()]
        missing += [
            f"{folder}{name}.py"
            for folder, name in MODULE.findall(text)
            if not (ROOT / folder / f"{name}.py").exists()
        ]
        # A module that is named without its folder is somewhere.
        missing += sorted(set(re.findall(r"\bmodules?\s+`(\w+)`", text)) - modules)
        assert not missing, page


def test_every_module_and_name_of_a_page_can_be_found():
    for dotted in DOTTED.findall("\n".join(PAGES.values())):
        parts = dotted.split(".")[1:]
        while parts and not found(parts):
            attribute = parts.pop()
            base = ROOT.joinpath(*parts)
            source = base.with_suffix(".py") if parts else ROOT / "sparseskin" / "__init__.py"
            if source.is_file():
                assert re.search(rf"\b{attribute}\b", source.read_text(encoding="utf-8")), dotted
                break
        else:
            assert parts, dotted


def found(parts):
    path = ROOT.joinpath(*parts)
    return path.is_dir() or path.with_suffix(".py").is_file()


def test_every_test_and_link_of_a_page_is_there_and_no_path_of_a_machine():
    tests = {path.name for path in (ROOT / "tests").rglob("test_*.py")}
    for page, text in PAGES.items():
        assert set(TEST.findall(text)) <= tests, page
        missing = [link for link in LINK.findall(text) if not (page.parent / link).exists()]
        assert not missing, page
        assert not re.search(r"(?<![\w.])/(home|root|work|tmp|Users)/", text), page


def test_the_citation_states_the_version_of_the_package():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert f"\nversion: {project['version']}\n" in citation


def test_every_picture_has_the_command_that_makes_it_beside_it():
    command = re.compile(r"(?:`|^ {4})(sparseskin|make|python|\.venv/bin/python) ", re.M)
    for page, text in PAGES.items():
        lines = [line for line in text.splitlines() if line]
        for k, line in enumerate(lines):
            if line.startswith("![") and "data_flow.svg" not in line:  # drawn by hand
                assert command.search("\n".join(lines[max(0, k - 2) : k + 8])), (page, line)
