"""The package's folders as they are imported: a copy for tools that go by paths."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
CONFIG: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
IGNORED = shutil.ignore_patterns("__pycache__")


def copy_package(tree: Path) -> None:
    """Copy the folders that an installation maps to `sparseskin.*` to tree/sparseskin/..."""
    for imported, folder in CONFIG["setuptools"]["package-dir"].items():
        to = tree / imported.replace(".", "/")
        shutil.copytree(ROOT / folder, to, ignore=IGNORED, dirs_exist_ok=True)
