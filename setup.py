"""The tree of the package, and its description on an index: the README, its links absolute."""

import re
import shutil
import tomllib
from pathlib import Path

from setuptools import setup

HERE = Path(__file__).absolute().parent
SOURCE = tomllib.loads((HERE / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"][
    "Source"
]


def absolute(text: str) -> str:
    """Markdown whose relative links lead to the repository; pictures are raw files there."""
    text = re.sub(r"(!\[[^\]]*\]\()(?!\w+:|#)", rf"\g<1>{SOURCE}/raw/main/", text)
    return re.sub(r"((?<!!)\[[^\]]*\]\()(?!\w+:|#)", rf"\g<1>{SOURCE}/blob/main/", text)


def link_tree() -> None:
    """Link the folders of the repository to src/sparseskin, named as they are imported."""
    package = HERE / "src" / "sparseskin"
    shutil.rmtree(package, ignore_errors=True)
    package.mkdir(parents=True)
    for path in (HERE / "sparseskin").iterdir():
        (package / path.name).symlink_to(Path("../../sparseskin", path.name))
    for name in ("messages", "nodes", "launch", "studies", "plugins"):
        if (HERE / name).exists():  # the core alone has no plug-ins
            (package / name).symlink_to(Path("../..", name))


link_tree()
setup(
    long_description=absolute((HERE / "README.md").read_text(encoding="utf-8")),
    long_description_content_type="text/markdown",
)
