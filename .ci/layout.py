"""The package's folders as they are imported: a copy for tools that go by paths."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
CONFIG: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
FOLDERS = ("sparseskin", "messages", "nodes", "launch", "studies", "plugins")
IGNORED = shutil.ignore_patterns("__pycache__")


def copy_package(tree: Path) -> None:
    """Copy the folders of the package to tree/sparseskin/..."""
    for folder in FOLDERS:
        to = tree / "sparseskin" / ("" if folder == "sparseskin" else folder)
        shutil.copytree(ROOT / folder, to, ignore=IGNORED, dirs_exist_ok=True)
