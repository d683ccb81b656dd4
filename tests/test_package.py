"""The package: what is installed, and that it is all of it."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
CONFIG = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
STATIONS = [
    f"sparseskin.nodes.{station}"
    for station in ("sensor", "compressor", "reconstructor", "monitor", "recorder", "player")
]
UNSAFE_MODULES = {"pickle", "cPickle", "_pickle", "cloudpickle", "dill", "joblib", "jsonpickle"}
UNSAFE_MODULES |= {"marshal", "shelve", "code", "codeop", "runpy"}
UNSAFE_CALLS = {"eval", "exec", "compile", "__import__"}


def test_every_folder_with_modules_or_launch_files_is_a_package_and_no_other() -> None:
    folders = set()
    for name, top in CONFIG["package-dir"].items():
        modules = [*(ROOT / top).rglob("*.py"), *(ROOT / top).rglob("*.toml")]
        for module in modules:
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
    for needed in ("launch/drag_wrench_64.toml", "launch/commands/cli.py", "messages/py.typed"):
        assert f"sparseskin/{needed}" in names


@pytest.mark.parametrize(
    ("module", "strangers"),
    [
        ("sparseskin.nodes.compressor.node", ["scipy", "pywt", "sparseskin.nodes.reconstructor"]),
        ("sparseskin.nodes.sensor.node", ["scipy", "sparseskin.nodes.compressor"]),
        ("sparseskin.nodes.reconstructor.node", ["sparseskin.nodes.sensor"]),
        ("sparseskin.nodes.process.runner", ["sparseskin.launch", "sparseskin.nodes.monitor"]),
        ("sparseskin.messages", ["zmq", "scipy", "sparseskin.nodes"]),
        ("sparseskin.nodes.settings", ["zmq", "scipy", "numba"]),
        ("sparseskin.nodes.lookup", ["zmq", "scipy", "numba", "numpy"]),
        ("sparseskin.nodes.registry", ["zmq", "scipy", "numba", *STATIONS]),
        # A node process imports its own type only, and of the network what its graph needs.
        ("sparseskin.nodes.process.run_node", ["scipy", "numba", "asyncio", *STATIONS]),
    ],
)
def test_imports_run_one_way(module: str, strangers: list[str]) -> None:
    code = (
        f"import sys, {module}\n"
        f"print([m for m in sys.modules for s in {strangers!r} if (m + '.').startswith(s + '.')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def unsafe(tree: ast.AST) -> Iterator[str]:
    """Everything in a module that could execute what a file or a message holds."""
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Attribute):
            # Through another module: numpy.pickle, pandas.read_pickle, builtins.eval.
            names = [node.attr] if "pickle" in node.attr else []
            if isinstance(node.value, ast.Name) and node.value.id in ("builtins", "__builtins__"):
                yield f"builtins.{node.attr}"
            if isinstance(node.value, ast.Name) and node.value.id == "yaml":
                yield from [] if node.attr in ("safe_load", "safe_dump") else [f"yaml.{node.attr}"]
        elif isinstance(node, ast.Name) and node.id in UNSAFE_CALLS:
            yield node.id
        elif isinstance(node, ast.Call):
            for word in node.keywords:
                constant = isinstance(word.value, ast.Constant) and word.value.value is False
                if word.arg == "allow_pickle" and not constant:
                    yield "allow_pickle"
                if word.arg == "shell" and not constant:
                    yield "shell"
        for name in names:
            parts = name.split(".")
            if parts[0] in UNSAFE_MODULES or "pickle" in parts[-1]:
                yield name


def test_nothing_in_the_package_unpickles_or_evaluates() -> None:
    found = [
        f"{path.relative_to(ROOT)}: {what}"
        for top in CONFIG["package-dir"].values()
        for path in sorted((ROOT / top).rglob("*.py"))
        for what in unsafe(ast.parse(path.read_text()))
    ]
    assert found == []


@pytest.mark.parametrize(
    "code",
    [
        "import pickle",
        "from pickle import loads",
        "import pickle as p",
        "import marshal",
        "from marshal import loads",
        "import shelve",
        "import dill",
        "from joblib import load",
        "import numpy as np\nnp.load(path, allow_pickle=True)",
        "import numpy as np\nnp.load(path, allow_pickle=flag)",
        "import numpy\nnumpy.lib.format.read_array(file, allow_pickle=True)",
        "import pandas\npandas.read_pickle(path)",
        "from pandas import read_pickle",
        "import yaml\nyaml.load(text)",
        "import yaml\nyaml.unsafe_load(text)",
        "eval(text)",
        "run = exec",
        "import builtins\nbuiltins.eval(text)",
        "import subprocess\nsubprocess.run(text, shell=True)",
    ],
)
def test_every_way_to_unpickle_or_evaluate_is_found(code: str) -> None:
    assert list(unsafe(ast.parse(code)))


def test_safe_code_is_not_reported() -> None:
    code = "import re, yaml\nnp.load(p, allow_pickle=False)\nre.compile(p)\nyaml.safe_load(t)"
    assert not list(unsafe(ast.parse(code)))
