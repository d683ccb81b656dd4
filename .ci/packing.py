"""Packed code: what a statement or a function holds beyond one thing, counted by file.

Each file may hold as much of each kind as `packing.json` lists. What is above its list fails; so
does what is below, until the list is written anew: it shrinks, and nothing is packed again.

    python .ci/packing.py            check
    python .ci/packing.py --list     every place
    python .ci/packing.py --write    write the list of today
"""

from __future__ import annotations

import ast
import json
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
LIST = Path(__file__).with_suffix(".json")
FOLDERS = ("messages", "nodes", "launch", "src", "plugins", "studies")
MAX_PARAMETERS = 8
MAX_LINES = 50
"""Lines of a function, without its signature and its docstring."""
FILLERS = frozenset(
    {
        *(
            "after",
            "apart",
            "before",
            "both",
            "chosen",
            "first",
            "found",
            "given",
            "held",
            "here",
        ),
        *(
            "kept",
            "known",
            "last",
            "least",
            "left",
            "like",
            "listed",
            "made",
            "more",
            "most",
        ),
        *(
            "named",
            "one",
            "other",
            "others",
            "own",
            "rest",
            "said",
            "shown",
            "some",
            "there",
        ),
        *("wanted", "what"),
    }
)
"""Names of locals that do not say what they hold."""
Function = ast.FunctionDef | ast.AsyncFunctionDef


class Place(NamedTuple):
    """A line, and the kind of packing that it holds."""

    line: int
    kind: str


def main(arguments: list[str]) -> int:
    """Check all files; returns the exit code."""
    places = {
        str(path.relative_to(ROOT)): sorted(places_of(ast.parse(path.read_text())))
        for folder in FOLDERS
        for path in sorted((ROOT / folder).rglob("*.py"))
    }
    if "--list" in arguments:
        for name, of_file in places.items():
            for place in of_file:
                print(f"{name}:{place.line}: {place.kind}")
        return 0

    counts = {
        name: dict(sorted(Counter(place.kind for place in of_file).items()))
        for name, of_file in places.items()
        if of_file
    }
    if "--write" in arguments:
        LIST.write_text(json.dumps(counts, indent=1) + "\n")
        return 0

    lines = list(differences(counts, json.loads(LIST.read_text())))
    for line in lines:
        print(line)
    return int(bool(lines))


def differences(
    counts: dict[str, dict[str, int]], allowed: dict[str, dict[str, int]]
) -> Iterator[str]:
    """A line for each file and kind whose count is not the one in the list."""
    for name in sorted(counts.keys() | allowed.keys()):
        of_file = Counter(counts.get(name, {}))
        of_list = Counter(allowed.get(name, {}))
        for kind in sorted(of_file.keys() | of_list.keys()):
            if of_file[kind] > of_list[kind]:
                yield f"{name}: {of_file[kind]} x {kind}; allowed: {of_list[kind]} (see --list)"
            elif of_file[kind] < of_list[kind]:
                yield f"{name}: {kind} fell to {of_file[kind]}: run .ci/packing.py --write"


def places_of(tree: ast.Module) -> Iterator[Place]:
    """Every place of a file that is packed."""
    for node in ast.walk(tree):
        if isinstance(node, ast.stmt):
            yield from places_of_statement(node)
        if isinstance(node, Function):
            yield from places_of_function(node)
        if isinstance(node, ast.Subscript) and contains(node.slice, ast.NamedExpr):
            yield Place(node.lineno, "assignment within a subscript")
        if (
            isinstance(node, ast.Name)
            and isinstance(node.ctx, ast.Store)
            and node.id in FILLERS
        ):
            yield Place(node.lineno, "name that does not say what it holds")


def places_of_statement(statement: ast.stmt) -> Iterator[Place]:
    """What one statement holds beyond one thing."""
    if isinstance(statement, ast.Assign) and assigns_several(statement):
        yield Place(statement.lineno, "statement that assigns several things")
    n_choices = sum(isinstance(node, ast.IfExp) for node in expressions(statement))
    if n_choices > 1:
        yield Place(statement.lineno, "statement with several conditional expressions")


def assigns_several(statement: ast.Assign) -> bool:
    """True for `a, b = x, y`, unless the values need the targets as they were before."""
    target = statement.targets[0]
    if not isinstance(target, ast.Tuple) or not isinstance(statement.value, ast.Tuple):
        return False
    if len(target.elts) < 2:
        return False
    targets = {ast.unparse(element) for element in target.elts}
    values = {
        ast.unparse(node)
        for node in ast.walk(statement.value)
        if isinstance(node, ast.expr)
    }
    return not targets & values


def places_of_function(function: Function) -> Iterator[Place]:
    """Too many parameters, or too many lines."""
    parameters = function.args
    names = [
        p.arg
        for p in (*parameters.posonlyargs, *parameters.args, *parameters.kwonlyargs)
    ]
    if len(set(names) - {"self", "cls"}) > MAX_PARAMETERS:
        yield Place(
            function.lineno, f"function of more than {MAX_PARAMETERS} parameters"
        )

    body = function.body
    if ast.get_docstring(function) is not None:
        body = body[1:]
    if body and (body[-1].end_lineno or 0) - body[0].lineno >= MAX_LINES:
        yield Place(function.lineno, f"function of more than {MAX_LINES} lines")


def expressions(statement: ast.stmt) -> Iterator[ast.AST]:
    """Nodes of a statement, without the statements in its body."""
    waiting: list[ast.AST] = [statement]
    while waiting:
        node = waiting.pop()
        yield node
        children = ast.iter_child_nodes(node)
        waiting += [child for child in children if not isinstance(child, ast.stmt)]


def contains(expression: ast.expr, kind: type[ast.AST]) -> bool:
    """True if an expression holds a node of a kind."""
    return any(isinstance(node, kind) for node in ast.walk(expression))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
