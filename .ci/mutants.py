"""Mutation testing of the core: a sample of mutants of each area, and the share that is caught.

    make mutants                                         # 40 mutants an area: three hours
    .venv/bin/python .ci/mutants.py node network --size 20
    .venv/bin/python .ci/mutants.py --draw 2             # another sample
    .venv/bin/python .ci/mutants.py faults --tests tests/nodes/reconstructor/faults

A mutant is a module with one expression changed, as mutmut changes it: an operator, a number, a
condition, an argument left out. Two kinds are left out: texts, since a changed letter of a message
is no fault, and what mypy refuses, for which no test is needed.

For each mutant those quick tests of its area run that reach its statement, in any of their
processes, up to the first that fails. Those of the module's name run first, then those of its
folder, short ones before long ones, and as many as take `MOST_S`. On a line outside functions, as a
constant, all tests may run, those first that reach a statement which reads it. The golden hashes
are not among them: a hash says that something has changed, and not what is wrong. A mutant under
which the tests take five times as long is caught.

A sample is the same as long as the code is, and changes little with it. The interval is that of
Wilson for a share of which only a sample is known. Tests that were written for the survivors of one
draw make its share look better than that of the area: another draw shows the share. Survivors that
need no test are in mutants.toml, each with the reason. Those whose reason begins with "equivalent"
change nothing that the program does, and are no part of the share.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mutant_tests import Test, first_failure, record
from mutation import Mutant, mutants_of, statement_of, users_of, with_marks

PER_AREA = 40
WANTED_PERCENT = 85
#: Longest time of the tests of one mutant, by what they take without it, in seconds.
MOST_S = 30.0
#: Quantile of the standard normal distribution for an interval of 90 %.
QUANTILE = 1.645

_OF_SKIN = (
    "tests/nodes/reconstructor",
    "tests/nodes/test_bus.py",
    "tests/nodes/test_settings.py",
)
_OF_NODES = ("tests/nodes/test_*.py", "tests/nodes/process", "tests/nodes/player")


class Area(NamedTuple):
    """A part of the core, and the tests that are tried on its mutants."""

    sources: tuple[str, ...]
    tests: tuple[str, ...]


AREAS = {
    "node": Area(("nodes/node.py", "nodes/node_host.py"), _OF_NODES),
    "network": Area(("nodes/network",), ("tests/nodes/network", *_OF_NODES)),
    "messages": Area(("messages",), ("tests/messages", "tests/nodes/test_bus.py")),
    "launch/run": Area(("launch/run",), ("tests/launch/run",)),
    "patch": Area(("nodes/reconstructor/patch.py",), _OF_SKIN),
    "skin": Area(("nodes/reconstructor/skin",), _OF_SKIN),
    "faults": Area(("nodes/reconstructor/faults",), _OF_SKIN),
    "sensor": Area(("nodes/sensor",), ("tests/nodes/sensor",)),
    "clock": Area(("nodes/clock.py", "nodes/graph.py"), _OF_NODES),
    "compressor": Area(
        ("nodes/compressor/phi", "nodes/compressor/quantiser.py"),
        ("tests/nodes/compressor", "tests/messages"),
    ),
    "solvers": Area(
        (
            "nodes/reconstructor/bases",
            "nodes/reconstructor/estimates",
            "nodes/reconstructor/solvers",
        ),
        _OF_SKIN,
    ),
    "monitor": Area(
        ("nodes/monitor/metrics.py", "nodes/monitor/statistics.py"),
        ("tests/nodes/monitor/test_metrics.py",),
    ),
    "recorder": Area(("nodes/recorder",), ("tests/nodes/recorder",)),
    "vendors": Area(
        ("plugins/vendors/emed.py", "plugins/vendors/tekscan.py"),
        ("tests/plugins/vendors",),
    ),
    "chosen rows": Area(("plugins/chosen_rows",), ("tests/plugins/chosen_rows",)),
}
ROOT = Path(__file__).resolve().parent.parent
EXPLAINED = ROOT / ".ci" / "mutants.toml"
Explanations = dict[str, list[dict[str, str]]]
"""By module, entries with `old` and `new` code of a mutant, and `why` it needs no test."""


@dataclass
class Score:
    """What became of the sample of one area."""

    area: str
    n_mutants: int
    n_by_name: int = 0
    """Caught by a test of the module's name."""
    n_caught: int = 0
    n_equivalent: int = 0
    """Explained as a change of nothing that the program does."""
    n_survived: int = 0
    n_refused: int = 0
    """Refused by mypy, and therefore not of the sample."""

    @property
    def n_sample(self) -> int:
        return self.n_caught + self.n_survived

    @property
    def n_tried(self) -> int:
        return self.n_sample + self.n_equivalent

    def __str__(self) -> str:
        low, high = interval(self.n_caught, self.n_sample)
        percent = 100 * self.n_caught / max(self.n_sample, 1)
        return (
            f"{self.area}: {self.n_caught} of {self.n_sample} caught ({percent:.0f} %, "
            f"90 % interval {100 * low:.0f} to {100 * high:.0f}; {self.n_by_name} by tests of the "
            f"module's name; {self.n_equivalent} change nothing; {self.n_refused} more refused by "
            f"mypy; {self.n_mutants} mutants in all)"
        )


def main() -> int:
    parser = argparse.ArgumentParser(
        description="Share of mutants that tests catch, by area."
    )
    parser.add_argument(
        "areas", nargs="*", metavar="AREA", help=f"some of {', '.join(AREAS)}"
    )
    parser.add_argument("--size", type=int, default=PER_AREA, help="mutants an area")
    parser.add_argument("--draw", type=int, default=1, help="number of the sample")
    parser.add_argument(
        "--tests",
        nargs="+",
        metavar="PATH",
        help="tests in place of the area's: a share of few tests is a bound from below",
    )
    arguments = parser.parse_args()
    unknown = [area for area in arguments.areas if area not in AREAS]
    if unknown:
        parser.error(f"{unknown[0]}: no such area (allowed: {', '.join(AREAS)})")
    explained = tomllib.loads(EXPLAINED.read_text())
    scores: list[Score] = []
    names = arguments.areas or list(AREAS)
    # Areas of the same tests share what these reach.
    for paths in dict.fromkeys(AREAS[name].tests for name in names):
        members = [name for name in names if AREAS[name].tests == paths]
        with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
            tree = Path(folder)
            _copy(tree)
            if not _has_types(tree, [m for name in members for m in _modules(name)]):
                raise SystemExit("mypy refuses the code without a mutant")
            tests = _recorded(tree, members, arguments.tests or paths)
            for name in members:
                score = _score(
                    tree, name, tests, arguments.size, arguments.draw, explained
                )
                print(score, flush=True)
                scores.append(score)
    low = [
        score
        for score in scores
        if 100 * score.n_caught < WANTED_PERCENT * score.n_sample
    ]
    for score in low:
        print(f"fewer than {WANTED_PERCENT} %: {score.area}", file=sys.stderr)
    return 1 if low else 0


def interval(n_hits: int, n: int) -> tuple[float, float]:
    """Interval of Wilson (1927) for the share of which `n_hits` of `n` were drawn, 90 %."""
    if not n:
        return 0.0, 1.0
    share = n_hits / n
    square = QUANTILE**2
    centre = (share + square / (2 * n)) / (1 + square / n)
    spread = share * (1 - share) / n + square / (4 * n * n)
    half = QUANTILE * math.sqrt(spread) / (1 + square / n)
    return centre - half, centre + half


def _recorded(tree: Path, names: Sequence[str], patterns: Sequence[str]) -> list[Test]:
    """Run the tests of areas in a copy whose modules note what they run, and restore these."""
    modules = [module for name in names for module in _modules(name)]
    for module in modules:
        (tree / module).write_text(with_marks((ROOT / module).read_text(), module))
    # In the copy: it lacks files that git does not know yet.
    tests = record(
        tree, [str(p.relative_to(tree)) for t in patterns for p in sorted(tree.glob(t))]
    )
    for module in modules:
        shutil.copy2(ROOT / module, tree / module)
    return tests


def _score(
    tree: Path,
    name: str,
    tests: list[Test],
    size: int,
    draw: int,
    explained: Explanations,
) -> Score:
    """Test a sample of the mutants of an area."""
    codes = {module: (ROOT / module).read_text() for module in _modules(name)}
    mutants = [mutant for module in codes for mutant in mutants_of(ROOT, module)]
    mutants.sort(key=lambda mutant: _lot(mutant, draw))
    score = Score(name, len(mutants))
    for number, mutant in enumerate(mutants, 1):
        if score.n_tried == size:
            break
        path = tree / mutant.module
        path.write_text(mutant.code)
        # Another second for each, by which Python knows that its bytecode is not current.
        os.utime(path, (number, number))
        if _has_types(tree, [mutant.module]):
            chosen = tests_of(mutant, codes, tests)
            failed = first_failure(tree, chosen) if chosen else ""
            _count(score, mutant, failed, explained, len(chosen))
        else:
            score.n_refused += 1
        shutil.copy2(ROOT / mutant.module, path)
    return score


def _has_types(tree: Path, modules: Sequence[str]) -> bool:
    """True if mypy accepts some modules as they stand in the tree. Those that import them are left
    out: for each mutant of `messages` they take a minute.
    """
    command = [sys.executable, "-m", "mypy"]
    for module in modules:
        path = module.removesuffix(".py").removesuffix("/__init__")
        command += ["--module", f"sparseskin.{path.replace('/', '.')}"]
    return not subprocess.run(command, cwd=tree, capture_output=True).returncode


def _modules(area: str) -> list[str]:
    """Modules of an area, as paths within the repository."""
    modules: list[str] = []
    for source in AREAS[area].sources:
        path = ROOT / source
        files = [path] if path.is_file() else sorted(path.rglob("*.py"))
        modules += [str(file.relative_to(ROOT)) for file in files]
    return modules


def _lot(mutant: Mutant, draw: int) -> str:
    """Place of a mutant in a draw, which a change of other lines leaves as it is."""
    text = f"{draw} {mutant.module} {mutant.old} {mutant.new} {mutant.line}"
    return hashlib.sha256(text.encode()).hexdigest()


def _copy(tree: Path) -> None:
    """Copy the files of the repository, and compiled loops."""
    listing = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, check=True
    )
    names = listing.stdout.decode().splitlines()
    compiled = (ROOT / "nodes" / "numerics").glob("__pycache__/*.nb?")
    names += [str(path.relative_to(ROOT)) for path in compiled]
    for name in names:
        target = tree / name
        target.parent.mkdir(parents=True, exist_ok=True)
        # With its time, by which compiled loops know that they are current; links stay links.
        shutil.copy2(ROOT / name, target, follow_symlinks=False)
    checked = ROOT / ".mypy_cache"
    if checked.is_dir():
        shutil.copytree(checked, tree / checked.name)


def _count(
    score: Score, mutant: Mutant, failed: str, explained: Explanations, n_tests: int
) -> None:
    entries = explained.get(mutant.module, [])
    reasons = [
        e["why"] for e in entries if (e["old"], e["new"]) == (mutant.old, mutant.new)
    ]
    if failed:
        score.n_caught += 1
        score.n_by_name += _is_named(failed, mutant.module)
        return
    if reasons and reasons[0].startswith("equivalent"):
        score.n_equivalent += 1
        return
    score.n_survived += 1
    verdict = f"explained: {reasons[0]}" if reasons else f"survived {n_tests} tests"
    place = f"  {mutant.module}:{mutant.line}: {verdict}"
    # At once: a run of an hour that is cut off has shown what it found.
    print(place, f"    - {mutant.old}", f"    + {mutant.new}", sep="\n", flush=True)


def tests_of(mutant: Mutant, codes: Mapping[str, str], tests: list[Test]) -> list[Test]:
    """Tests that reach the statement of a mutant, in the order in which they are tried. Outside
    functions all tests, those first that reach a statement which reads what is defined there.
    `codes` are the texts of the modules of the area.
    """
    line = statement_of(codes[mutant.module], mutant.line)
    if line is None:
        marks = users_of(codes, mutant.module, mutant.line)
        reaching = list(tests)
    else:
        marks = {f"{mutant.module}:{line}"}
        reaching = [test for test in tests if test.marks & marks]
    folder = str(Path("tests") / Path(mutant.module).parent)
    reaching.sort(
        key=lambda test: (
            not _is_named(test.name, mutant.module),
            not test.marks & marks,
            not test.name.startswith(folder),
            test.seconds,
        )
    )
    chosen: list[Test] = []
    seconds = 0.0
    for test in reaching:
        seconds += test.seconds
        if seconds < MOST_S or not chosen:
            chosen.append(test)
    return chosen


def _is_named(test: str, module: str) -> bool:
    """True for a test of the file of the module's name, in the folder of its tests."""
    path = Path("tests") / module
    return test.startswith(f"{path.parent}/test_{path.name}::")


if __name__ == "__main__":
    sys.exit(main())
