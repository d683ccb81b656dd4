"""The package: what is installed, that it is all of it, and its imports: one way, no circles."""

import ast
import re
import subprocess
import sys
import zipfile
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("src/sparseskin", "messages", "nodes", "launch", "studies", "plugins")
STATIONS = [
    f"sparseskin.nodes.{station}"
    for station in (
        "sensor",
        "compressor",
        "reconstructor",
        "monitor",
        "recorder",
        "player",
    )
]


EVERY_PHI = "[b.make_phi(kind, 64, 64, seed=0) for kind in b.KINDS]"


@pytest.mark.slow
def test_a_wheel_holds_all_of_sparseskin_and_nothing_else(tmp_path):
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE", *FOLDERS):
        (source / name).parent.mkdir(exist_ok=True)
        (source / name).symlink_to(ROOT / name)
    options = [
        "--quiet",
        "--disable-pip-version-check",
        "--no-deps",
        "--no-build-isolation",
    ]
    wheel = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        *options,
        "--wheel-dir",
        str(tmp_path),
    ]
    subprocess.run([*wheel, str(source)], check=True)
    (built,) = tmp_path.glob("*.whl")
    wheel_file = zipfile.ZipFile(built)
    names = wheel_file.namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"sparseskin"}
    held = {
        name.removeprefix("sparseskin/")
        for name in names
        if name.startswith("sparseskin/")
    }
    wanted = (
        "*.py",
        "*.toml",
        "*.typed",
        "*.npz",
        "*.md",
        "*.js",
        "*.css",
        "*.html",
        "*.c",
        "*.h",
    )
    files = {
        str(path.relative_to(ROOT)).removeprefix("src/sparseskin/")
        for top in FOLDERS
        for pattern in wanted
        for path in (ROOT / top).rglob(pattern)
    }
    assert files - held == set()
    others = {Path(name).suffix for name in held - files}
    assert others <= {"", ".svg", ".in", ".ld", ".csv", ".ino", ".cpp", ".hpp", ".mcap"}
    # It would shadow the package of ROS 2.
    assert not (ROOT / "launch" / "__init__.py").exists()
    (metadata,) = [name for name in names if name.endswith(".dist-info/METADATA")]
    links = re.findall(r"\]\((.*?)\)", wheel_file.read(metadata).decode())
    assert len(links) > 5
    assert [link for link in links if not re.match(r"https://|#", link)] == []


@pytest.mark.parametrize(
    ("module", "strangers"),
    [
        (
            "sparseskin.nodes.compressor.node",
            ["scipy", "pywt", "sparseskin.nodes.reconstructor"],
        ),
        ("sparseskin.nodes.compressor.phi.base as b; " + EVERY_PHI, ["scipy", "pywt"]),
        ("sparseskin.nodes.sensor.node", ["scipy", "sparseskin.nodes.compressor"]),
        ("sparseskin.nodes.reconstructor.node", ["scipy", "pywt", "numba"]),
        (
            "sparseskin.nodes.process.runner",
            ["sparseskin.launch", "sparseskin.nodes.monitor"],
        ),
        ("sparseskin.messages", ["zmq", "scipy", "sparseskin.nodes"]),
        ("sparseskin", ["numpy", "sparseskin.nodes"]),
        ("sparseskin.nodes.registry", ["zmq", "scipy", "numba", *STATIONS]),
        # A node process imports its own type only, and of the network what its graph needs.
        ("sparseskin.nodes.process.run_node", ["scipy", "numba", "asyncio", *STATIONS]),
    ],
)
def test_imports_run_one_way(module, strangers):
    code = (
        f"import sys, {module}\n"
        f"print([m for m in sys.modules for s in {strangers!r} if (m + '.').startswith(s + '.')])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_nothing_in_the_package_unpickles_or_evaluates():
    """Beside what ruff refuses (S, TID251): arrays of objects, and built-in functions."""
    unsafe = (
        r"allow_pickle=(?!False)|(?<![.\w])(?<!def )(eval|exec|compile|__import__)\("
    )
    found = [
        f"{path.relative_to(ROOT)}: {match[0]}"
        for top in FOLDERS
        for path in sorted((ROOT / top).rglob("*.py"))
        for match in re.finditer(unsafe, path.read_text(encoding="utf-8"))
    ]
    assert found == []


LAYERS = ("messages", "nodes", "launch", "studies", "plugins")


def modules():
    """Files of all modules, by the names under which they are imported."""
    found = {}
    for path in (path for layer in LAYERS for path in (ROOT / layer).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(("sparseskin", *parts)).removesuffix(".__init__")] = path
    return found


def imports(name, known):
    """Modules that a module imports anywhere: within functions and for type checkers too."""
    path = known[name]
    package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) + 1 - node.level] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                full = f"{base}.{alias.name}"
                yield full if full in known else base


@cache
def graph():
    """Modules that each module imports, of those that are known."""
    known = modules()
    return {name: set(imports(name, known)) & known.keys() - {name} for name in known}


def test_imports_form_no_circle_and_run_one_way():
    edges = graph()
    assert len(edges) > 200
    assert sum(map(len, edges.values())) > 500
    TopologicalSorter(edges).prepare()  # raises CycleError with the modules of a circle
    upward = [
        f"{name} imports {other}"
        for name, others in graph().items()
        for other in others
        if LAYERS.index(name.split(".")[1]) < LAYERS.index(other.split(".")[1])
    ]
    assert upward == []


SENSOR = "sparseskin.nodes.sensor."
SENSOR_LAYERS = (
    *("layout", "device_clock", "noise", "sign", "saturation", "missing"),
    *("repetition", "calibration", "doubt", "zero", "source", "points", "skin_file"),
    *("files", "driver", "scenes", "sources", "raw_frames", "settings", "node"),
)
"""Modules and folders of the sensor, the lowest first."""


def test_imports_within_the_sensor_run_one_way():
    upward = []
    for name, others in graph().items():
        if not name.startswith(SENSOR):
            continue
        place = name.removeprefix(SENSOR).split(".")[0]
        for other in others:
            if other.startswith(SENSOR):
                target = other.removeprefix(SENSOR).split(".")[0]
                if SENSOR_LAYERS.index(target) > SENSOR_LAYERS.index(place):
                    upward.append(f"{name} imports {other}")
    assert upward == []
