"""Run mypy on the package as it is imported.

The folders of the repository are mapped to `sparseskin.*` when it is installed, which mypy does
not see in an editable installation. So they are copied into a tree that is named as imported.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def main() -> int:
    config = tomllib.loads((ROOT / "pyproject.toml").read_text())
    mapped = config["tool"]["setuptools"]["package-dir"].values()
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder) / "sparseskin"
        for name in mapped:
            shutil.copytree(
                ROOT / name, package / name, ignore=shutil.ignore_patterns("__pycache__")
            )
        n_files = sum(1 for _ in package.rglob("*.py"))
        command = [sys.executable, "-m", "mypy", "--config-file", str(ROOT / "pyproject.toml")]
        done = subprocess.run(
            [*command, "-p", "sparseskin"], cwd=folder, capture_output=True, text=True, check=False
        )
    print(done.stdout + done.stderr, end="")
    checked = re.search(r"(?:in|checked) (\d+) source files", done.stdout)
    if done.returncode == 0 and (checked is None or int(checked[1]) < n_files):
        print(f"mypy saw fewer than the {n_files} files there are")
        return 1
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
