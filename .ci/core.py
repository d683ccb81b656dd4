"""The core without the plug-ins: a copy of the repository without them, and its tests.

    python .ci/core.py          imports every module, and runs some tests
    python .ci/core.py all      runs all tests of the core (make test-core); more words go to pytest

The copy has an environment of its own, which takes third-party packages from the one that runs
this, and in which no plug-in is installed.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import tomllib
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LEFT_OUT = ("plugins/", "tests/plugins/", "src/sparseskin/plugins")
FEW = (
    *(
        "tests/test_package.py",
        "tests/test_extensions.py",
        "tests/nodes/sensor/test_sources.py",
    ),
    *(
        "tests/nodes/sensor/files/test_arrays.py",
        "tests/nodes/recorder/convert/test_exports.py",
    ),
    "tests/launch/commands/test_lists.py",
)
"""Tests of what plug-ins extend."""
OF_ALL = "tests/docs"
"""Tests of the pages, which name plug-ins, too."""
IMPORT_ALL = """
import importlib, pathlib, sys
import sparseskin
EXTRAS = ("torch",)  # not among what tests install
root = pathlib.Path(sparseskin.__file__).parent
for top in ("messages", "nodes", "launch", "studies"):
    folder = (root / top).resolve()
    for path in sorted(folder.rglob("*.py")):
        name = ".".join(("sparseskin", *path.relative_to(folder.parent).with_suffix("").parts))
        if path.stem not in ("__init__", "__main__"):
            try:
                importlib.import_module(name)
            except ModuleNotFoundError as error:
                if error.name.partition(".")[0] not in EXTRAS:
                    raise
assert not [name for name in sys.modules if name.startswith("sparseskin.plugins")]
"""


def copy_core(to: Path) -> None:
    """Copy the repository without the plug-ins, and without what pyproject.toml states of them."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(
        command, cwd=ROOT, capture_output=True, check=True
    ).stdout.decode()
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).exists() and not name.startswith(LEFT_OUT):
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, to / name, follow_symlinks=False)
    project = to / "pyproject.toml"
    lines = project.read_text(encoding="utf-8").splitlines(keepends=True)
    project.write_text(
        "".join(line for line in lines if "sparseskin.plugins" not in line)
    )


def make_environment(core: Path) -> Path:
    """The Python of an environment in which the copy is installed."""
    builder = venv.EnvBuilder(symlinks=True)
    builder.create(core / ".venv")
    context = builder.ensure_directories(core / ".venv")
    site = Path(sysconfig.get_path("purelib", vars={"base": str(core / ".venv")}))
    # Paths alone: the files *.pth of the other environment, that of its sparseskin, are not read.
    (site / "core.pth").write_text(f"{core / 'src'}\n{sysconfig.get_path('purelib')}\n")
    project = tomllib.loads((core / "pyproject.toml").read_text(encoding="utf-8"))[
        "project"
    ]
    found = site / f"sparseskin-{project['version']}.dist-info"
    found.mkdir()
    (found / "METADATA").write_text(
        f"Name: sparseskin\nVersion: {project['version']}\n"
    )
    groups = [
        f"[{group}]\n"
        + "".join(f"{name} = {target}\n" for name, target in points.items())
        for group, points in project["entry-points"].items()
    ]
    (found / "entry_points.txt").write_text("\n".join(groups))
    return Path(context.env_exe)


def main(words: list[str]) -> int:
    with tempfile.TemporaryDirectory() as folder:
        core = Path(folder)
        copy_core(core)
        python = make_environment(core)
        environment = {
            **os.environ,
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        environment.pop("PYTHONPATH", None)
        done = subprocess.run(
            [python, "-c", IMPORT_ALL], cwd="/", env=environment, check=False
        )
        if done.returncode:
            return done.returncode
        if words[:1] == ["all"]:
            chosen = ["--ignore", OF_ALL, *words[1:]]
        else:
            chosen = [*FEW, "-m", "not slow", "-x"]
            # None of these needs compiled loops, which would be compiled for the copy anew.
            environment["SPARSESKIN_FAST"] = "off"
        tests = [
            python,
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            "-n",
            "2",
            *chosen,
        ]
        return subprocess.run(tests, cwd=core, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
