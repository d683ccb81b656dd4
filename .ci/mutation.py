"""Mutants of a module, and a copy of it that notes which of its statements run."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import ndiff
from itertools import accumulate
from pathlib import Path

import libcst
from libcst.metadata import MetadataWrapper, WhitespaceInclusivePositionProvider
from mutmut.mutation.file_mutation import Mutation, create_mutations

#: Number that is not changed by one, which would be less than a part in a hundred.
LARGE = 100
_TEXT = re.compile(r"""[rbf]*("([^"\\]|\\.)*"|'([^'\\]|\\.)*')""", re.IGNORECASE)


@dataclass(frozen=True)
class Mutant:
    """One changed expression of a module."""

    module: str
    """Path of the module within the repository."""
    code: str
    """Text of the whole module with the change."""
    old: str
    """The changed lines, as they are."""
    new: str
    """The changed lines, as they become."""
    line: int
    """Number of the first changed line, from 1."""


def mutants_of(root: Path, name: str) -> list[Mutant]:
    """Mutants of a module, other than those of texts, and small ones."""
    code = (root / name).read_text()
    module, mutations, _, _ = create_mutations(name, code)
    splice = _Splice(module, code)
    mutants = []
    for mutation in mutations:
        if _is_small(mutation):
            continue
        mutant = _mutant(name, code, splice.code_of(mutation))
        if _TEXT.sub("", mutant.old) != _TEXT.sub("", mutant.new):
            mutants.append(mutant)
    return mutants


class _Splice:
    """Texts of a module with one expression in place of another."""

    def __init__(self, module: libcst.Module, code: str) -> None:
        self._module = module
        self._code = code
        self._starts = [0, *accumulate(map(len, code.splitlines(keepends=True)))]
        wrapper = MetadataWrapper(module, unsafe_skip_copy=True)
        self._places = wrapper.resolve(WhitespaceInclusivePositionProvider)

    def code_of(self, mutation: Mutation) -> str:
        old = mutation.original_node
        new = mutation.mutated_node
        place = self._places[old]
        start = self._starts[place.start.line - 1] + place.start.column
        end = self._starts[place.end.line - 1] + place.end.column
        if "\n" in self._code[start:end]:
            # Only the whole module knows how far its lines are indented: 15 ms.
            return str(self._module.deep_replace(old, new).code)
        return self._code[:start] + self._module.code_for_node(new) + self._code[end:]


def _mutant(module: str, code: str, changed: str) -> Mutant:
    before = code.split("\n")
    after = changed.split("\n")
    start = 0
    while before[start] == after[start]:
        start += 1
    end = 0
    while (
        end < min(len(before), len(after)) - start
        and before[-1 - end] == after[-1 - end]
    ):
        end += 1
    # Equal lines within a change of several lines are not part of it.
    diff = list(
        ndiff(before[start : len(before) - end], after[start : len(after) - end])
    )
    old = " ".join(line[2:].strip() for line in diff if line[0] == "-")
    new = " ".join(line[2:].strip() for line in diff if line[0] == "+")
    return Mutant(module, changed, old, new, start + 1)


def _is_small(mutation: Mutation) -> bool:
    """True where a large number is changed by one."""
    old = mutation.original_node
    return (
        isinstance(old, libcst.Integer | libcst.Float) and old.evaluated_value >= LARGE
    )


def statement_of(code: str, line: int) -> int | None:
    """First line of the innermost statement of a function at a line; None outside functions."""
    return _statement_at(_bodies(ast.parse(code)), line)


def _statement_at(bodies: Sequence[Sequence[ast.stmt]], line: int) -> int | None:
    start = None
    for body in bodies:
        for statement in body:
            if statement.lineno <= line <= (statement.end_lineno or 0):
                start = max(start or 0, statement.lineno)
    return start


def users_of(codes: Mapping[str, str], module: str, line: int) -> set[str]:
    """`module:line` of the statements that read what a line outside functions defines: those of a
    function whose head it is, and those of `codes`, texts by module, that name its variable.
    """
    marks: set[str] = set()
    names: set[str] = set()
    for node in ast.walk(ast.parse(codes[module])):
        if not isinstance(node, ast.stmt):
            continue
        if not node.lineno <= line <= (node.end_lineno or 0):
            continue
        if isinstance(node, ast.FunctionDef):
            marks |= {f"{module}:{statement.lineno}" for statement in node.body}
        elif isinstance(node, ast.Assign):
            names |= {_name(target) for target in node.targets}
        elif isinstance(node, ast.AnnAssign):
            names.add(_name(node.target))
    names.discard("")

    for path, code in codes.items():
        tree = ast.parse(code)
        bodies = _bodies(tree)
        for node in ast.walk(tree):
            if isinstance(node, ast.expr) and _name(node) in names:
                marks.add(f"{path}:{_statement_at(bodies, node.lineno)}")
    return marks


def _name(node: ast.expr) -> str:
    """Name of a variable or of an attribute; "" of any other expression."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        return node.attr
    return ""


def with_marks(code: str, module: str) -> str:
    """The module with `reach("module:line")` before each statement of its functions."""
    tree = ast.parse(code)
    for body in _bodies(tree):
        marked: list[ast.stmt] = []
        for statement in body:
            is_docstring = isinstance(statement, ast.Expr) and isinstance(
                statement.value, ast.Constant
            )
            if not is_docstring:
                marked += ast.parse(f"_reach({f'{module}:{statement.lineno}'!r})").body
            marked.append(statement)
        body[:] = marked
    # Behind the docstring, and behind imports of __future__.
    place = 0
    while place < len(tree.body) and _stands_first(tree.body[place]):
        place += 1
    tree.body[place:place] = ast.parse("from mutant_reach import reach as _reach").body
    return ast.unparse(ast.fix_missing_locations(tree))


def _stands_first(statement: ast.stmt) -> bool:
    if isinstance(statement, ast.ImportFrom):
        return statement.module == "__future__"
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def _bodies(tree: ast.Module) -> list[list[ast.stmt]]:
    """Lists of statements within all functions, outer ones first."""
    bodies = []
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            for node in ast.walk(function):
                for name in ("body", "orelse", "finalbody"):
                    body = getattr(node, name, None)
                    # Functions within functions are walked twice, their statements listed once.
                    if isinstance(body, list) and not any(
                        body is other for other in bodies
                    ):
                        bodies.append(body)
    return bodies
