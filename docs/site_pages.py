"""Finished pages of the documentation site: python docs/site_pages.py FOLDER writes them to
FOLDER/pages, from where the site builder takes them.

Added are the pages at the top of the repository and one for each example. Formulas stand in the
pages as `$...$` in a line and as blocks fenced by ```math, as GitHub shows them. The site has them
as MathML, which browsers draw themselves: no script, no font and no other host is needed.
FOLDER/package is a copy of the package from which the builder reads docstrings.
"""

from __future__ import annotations

import ast
import re
import shutil
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

from latex2mathml.converter import convert

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
OUTPUTS = tomllib.loads(
    (ROOT / "docs/reference/examples.toml").read_text(encoding="utf-8")
)
#: Pages of the site that stand at the top of the repository.
TOP_PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
_BLOCK = re.compile(r"^```math\n(.*?)^```$", re.MULTILINE | re.DOTALL)
# Code comes first: a dollar sign in it begins no formula.
_INLINE = re.compile(
    r"(?P<code>^```.*?^```$|^    [^\n]*$|`[^`\n]+`)|\$(?P<tex>[^$\n]+)\$", re.M | re.S
)


def write(out: Path) -> None:
    """Write pages and package into the folder `out`, in place of those of an earlier run."""
    for folder in (out / "pages", out / "package"):
        shutil.rmtree(folder, ignore_errors=True)
    left_out = shutil.ignore_patterns("*.py", "__pycache__")
    shutil.copytree(ROOT / "docs", out / "pages", ignore=left_out)
    _copy_package(out / "package" / "sparseskin")

    pages = {
        str(path.relative_to(ROOT / "docs")): path.read_text(encoding="utf-8")
        for path in (ROOT / "docs").rglob("*.md")
    }
    for source, page in TOP_PAGES.items():
        pages[page] = _moved((ROOT / source).read_text(encoding="utf-8"))
    for path in EXAMPLES:
        pages[f"examples/{path.stem}.md"] = _example_page(path)
    for page, text in pages.items():
        target = out / "pages" / page
        target.parent.mkdir(exist_ok=True)
        target.write_text(_finished(page, text), encoding="utf-8")


def _copy_package(package: Path) -> None:
    """Copy the package, each folder of it a package for who reads docstrings."""
    # A source distribution has the folders alone, without the links to them.
    folders = ("messages", "nodes", "launch", "studies", "plugins")
    links = shutil.ignore_patterns(*folders)
    shutil.copytree(ROOT / "src" / "sparseskin", package, ignore=links)
    for name in folders:
        shutil.copytree(ROOT / name, package / name)
    # It has none, and would not be searched.
    (package / "launch" / "__init__.py").touch()


def _finished(page: str, markdown: str) -> str:
    """The text of a page with its generated part, each formula as MathML, and links out of docs/
    as links to pages.
    """
    if page == "reference/json.md":
        markdown += "".join(_tables(ROOT / "docs" / "reference" / "json.toml"))
    if page == "reference/examples.md":
        cards = "".join(
            map(_card, sorted(EXAMPLES, key=lambda path: not _picture(path)))
        )
        markdown += f'\n<div class="grid cards" markdown>\n\n{cards}\n</div>\n'
    for source, target in TOP_PAGES.items():
        markdown = markdown.replace(f"](../../{source}", f"](../{target}")
    markdown = re.sub(
        r"\]\((?:\.\./(\.\./))?examples/(\w+)\.py\)", r"](\1examples/\2.md)", markdown
    )
    markdown = _BLOCK.sub(lambda m: f"\n{_mathml(m[1], 'block')}\n", markdown)
    return _INLINE.sub(lambda m: m["code"] or _mathml(m["tex"], "inline"), markdown)


def _tables(path: Path) -> Iterator[str]:
    """A section of each format of JSON, with the table of its fields."""
    for name, form in tomllib.loads(path.read_text(encoding="utf-8")).items():
        yield f"\n## `{name}`\n\n{form['about']}\n\n| field | type | meaning |\n|---|---|---|\n"
        for field, (kind, meaning) in form["fields"].items():
            yield f"| `{field}` | {kind} | {meaning} |\n"


def _mathml(tex: str, display: str) -> str:
    made = convert(" ".join(tex.split()), display=display)
    # Capital Greek letters are upright, as LaTeX has them.
    made = re.sub(
        r"<mi>(&#x003[9A][0-9A-F];)</mi>", r'<mi mathvariant="normal">\1</mi>', made
    )
    kind = "div" if display == "block" else "span"
    return f'<{kind} class="math">{made}</{kind}>'


def _moved(text: str) -> str:
    """A page of the top folder, its links as seen from docs/."""
    text = text.replace("](docs/", "](")
    for source, page in TOP_PAGES.items():
        text = text.replace(f"]({source}", f"]({page}")
    # Files of the repository that are no pages.
    files = r"LICENSE|CITATION\.cff|SECURITY\.md|CODE_OF_CONDUCT\.md"
    return re.sub(rf"\[([^\]]+)\]\(({files})\)", r"\1 (`\2`)", text)


def _title(path: Path) -> str:
    """First line of the docstring of an example."""
    return (
        ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    ).splitlines()[0]


def _picture(path: Path) -> str:
    """The picture of an example, "" where it has none."""
    made = ROOT / "docs" / "pictures" / f"{path.stem}.png"
    return f"![{path.stem}](../pictures/{made.name})" if made.exists() else ""


def _card(path: Path) -> str:
    page = f"../../examples/{path.name}"
    picture = f"[{_picture(path)}]({page})<br>" if _picture(path) else ""
    return f"-   {picture}[**{path.name}**]({page})<br>{_title(path)}\n"


def _example_page(path: Path) -> str:
    source = path.read_text(encoding="utf-8")
    printed = OUTPUTS.get(path.stem)
    output = f"It prints:\n\n```text\n{printed}```\n\n" if printed else ""
    head = f"# {path.name}\n\n{_title(path)}\n\n{_picture(path)}\n\n"
    return f"{head}{output}```python\n{source}```\n"


if __name__ == "__main__":
    write(Path(sys.argv[1]))
