"""Run mypy on the package as it is imported.

The folders of the repository are mapped to `sparseskin.*` when it is installed, which mypy does
not see in an editable installation. So they are copied into a tree that is named as imported.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

from layout import ROOT, copy_package


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        copy_package(Path(folder))
        n_files = sum(1 for _ in Path(folder).rglob("*.py"))
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
