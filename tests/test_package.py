"""The package: what is installed, and that it is all of it."""

from __future__ import annotations

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
CONFIG = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]


def test_every_folder_with_modules_is_a_package_and_no_other() -> None:
    folders = set()
    for name, top in CONFIG["package-dir"].items():
        for module in (ROOT / top).rglob("*.py"):
            inner = module.parent.relative_to(ROOT / top).parts
            folders.add(".".join((name, *inner)))
    assert folders == set(CONFIG["packages"])


def test_launch_has_no_init_that_would_shadow_the_package_of_ros_2() -> None:
    assert not (ROOT / "launch" / "__init__.py").exists()


def test_a_wheel_holds_sparseskin_and_nothing_else(tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE", *CONFIG["package-dir"].values()):
        (source / name).symlink_to(ROOT / name)
    options = ["--quiet", "--disable-pip-version-check", "--no-deps", "--no-build-isolation"]
    wheel = [sys.executable, "-m", "pip", "wheel", *options, "--wheel-dir", str(tmp_path)]
    subprocess.run([*wheel, str(source)], check=True)
    (built,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(built).namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"sparseskin"}
    for needed in ("launch/drag_wrench_64.toml", "launch/cli.py", "messages/py.typed"):
        assert f"sparseskin/{needed}" in names


@pytest.mark.parametrize(
    ("module", "strangers"),
    [
        ("sparseskin.nodes.compressor.node", ["scipy", "pywt", "sparseskin.nodes.reconstructor"]),
        ("sparseskin.nodes.sensor.node", ["sparseskin.nodes.compressor"]),
        ("sparseskin.nodes.reconstructor.node", ["sparseskin.nodes.sensor"]),
        ("sparseskin.nodes.runner", ["sparseskin.launch", "sparseskin.nodes.monitor"]),
        ("sparseskin.messages", ["zmq", "sparseskin.nodes"]),
    ],
)
def test_imports_run_one_way(module: str, strangers: list[str]) -> None:
    code = (
        f"import sys, {module}\n"
        f"print([m for m in sys.modules for s in {strangers!r} if (m + '.').startswith(s + '.')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
