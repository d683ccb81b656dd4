"""The graph of imports between modules: one way, and without circles."""

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
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


def test_no_imports_form_a_circle():
    edges = graph()
    assert len(edges) > 200
    assert sum(map(len, edges.values())) > 500
    TopologicalSorter(edges).prepare()  # raises CycleError with the modules of a circle


def test_no_layer_imports_one_above_it():
    upward = [
        f"{name} imports {other}"
        for name, others in graph().items()
        for other in others
        if LAYERS.index(name.split(".")[1]) < LAYERS.index(other.split(".")[1])
    ]
    assert upward == []
