"""Packages of packages/, installed for a test alone as pip installs them."""

import contextlib
import shutil
import sys
import tomllib
from pathlib import Path

from sparseskin.nodes import extensions

PACKAGES = Path(__file__).parents[1] / "packages"


@contextlib.contextmanager
def installed(name, folder, monkeypatch):
    """A package in a folder of `sys.path`, with the metadata of its pyproject.toml."""
    project = tomllib.loads((PACKAGES / name / "pyproject.toml").read_text())["project"]
    shutil.copy2(PACKAGES / name / f"{name}.py", folder)
    info = folder / f"{name}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Name: {project['name']}\nVersion: {project['version']}\n"
    )
    lines = []
    for group, points in project["entry-points"].items():
        lines += [
            f"[{group}]",
            *(f"{name} = {target}" for name, target in points.items()),
        ]
    (info / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(folder)
    extensions.forget()
    yield
    extensions.forget()
    sys.modules.pop(name, None)
