"""Mutation testing of the core: a sample of mutants of each module, and the share that is caught.

    make mutants                          # 8 mutants a module
    .venv/bin/python .ci/mutants.py 20 nodes/compressor/phi/sbhe.py

mutmut changes one expression at a time and runs the quick tests that reach it, up to the first that
fails: those in the test file of the module's name, or in all of its folder where there is none
(`TESTS_OF` has the exceptions). A mutant that runs five times as long as its tests is caught. Texts
are left out: a changed letter of a message is no fault.

The sample is the same as long as the code is. Survivors that need no test are in mutants.toml, each
with the reason; they are printed, and counted by themselves.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter
from difflib import ndiff
from itertools import groupby
from pathlib import Path

from mutmut.configuration import reset_config
from mutmut.mutation.file_mutation import mutate_file_contents
from mutmut.utils.format_utils import get_mutant_name

CORE = (
    "messages/fields.py",
    "messages/quantised.py",
    "messages/wire.py",
    "nodes/clock.py",
    "nodes/graph.py",
    "nodes/node_host.py",
    "nodes/compressor/quantiser.py",
    "plugins/chosen_rows/acts.py",
    "nodes/compressor/phi/hadamard.py",
    "nodes/compressor/phi/sbhe.py",
    "nodes/monitor/metrics.py",
    "nodes/monitor/statistics.py",
    "nodes/network/gate.py",
    "nodes/network/network.py",
    "nodes/player/schedule.py",
    "nodes/reconstructor/bases/haar.py",
    "nodes/reconstructor/estimates/uncertainty.py",
    "nodes/reconstructor/faults/rows.py",
    "nodes/reconstructor/faults/taxels.py",
    "nodes/reconstructor/skin/estimator.py",
    "nodes/reconstructor/skin/gates.py",
    "nodes/reconstructor/skin/rows.py",
    "nodes/reconstructor/skin/solver.py",
    "nodes/reconstructor/skin/frame_vectors.py",
    "nodes/reconstructor/skin/noise_level.py",
    "nodes/reconstructor/skin/trust.py",
    "nodes/reconstructor/solvers/fista.py",
    "nodes/recorder/bag/writer.py",
    "nodes/recorder/convert/to_bag.py",
    "nodes/sensor/noise.py",
    "plugins/vendors/emed.py",
    "plugins/vendors/tekscan.py",
    "nodes/sensor/scenes/contact.py",
    "nodes/sensor/scenes/bodies.py",
)
PER_MODULE = 8
WANTED_PERCENT = 90
#: Tests of a module, where they are elsewhere.
TESTS_OF = {
    "nodes/compressor/quantiser.py": ("tests/messages",),
    "nodes/compressor/phi/sbhe.py": ("tests/nodes/compressor/phi",),
    "nodes/monitor/statistics.py": ("tests/nodes/monitor/test_metrics.py",),
    "nodes/network/network.py": ("tests/nodes/network",),
    "nodes/reconstructor/skin/estimator.py": ("tests/nodes/reconstructor/skin/test_skin.py",),
    "nodes/reconstructor/skin/frame_vectors.py": ("tests/nodes/reconstructor/skin/test_skin.py",),
    "nodes/reconstructor/skin/noise_level.py": ("tests/nodes/reconstructor/skin/test_skin.py",),
    "nodes/reconstructor/skin/rows.py": ("tests/nodes/reconstructor/skin/test_skin.py",),
    "nodes/reconstructor/skin/trust.py": ("tests/nodes/reconstructor/skin/test_skin.py",),
    "nodes/sensor/noise.py": ("tests/nodes/sensor/test_missing.py",),
    "nodes/sensor/scenes/bodies.py": ("tests/nodes/sensor/scenes/test_scenes.py",),
    "nodes/sensor/scenes/contact.py": ("tests/nodes/sensor/scenes/test_scenes.py",),
}
#: Exit codes of the tests under a mutant: passed, or no test reached it.
SURVIVED, NO_TESTS = 0, 33
ROOT = Path(__file__).resolve().parent.parent
CONFIG = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
IGNORED = shutil.ignore_patterns("__pycache__")
EXPLAINED = ROOT / ".ci" / "mutants.toml"
Explanations = dict[str, list[dict[str, str]]]
"""By module, entries with `old` and `new` code of a mutant, and `why` it needs no test."""
_MANGLED = re.compile(r"__mutmut_\w+")
_TEXT = re.compile(r"""[rbf]*("([^"\\]|\\.)*"|'([^'\\]|\\.)*')""", re.IGNORECASE)


def main(arguments: list[str]) -> int:
    per_module = int(arguments.pop(0)) if arguments and arguments[0].isdecimal() else PER_MODULE
    modules = arguments or list(CORE)
    missing = [name for name in modules if not (ROOT / name).is_file()]
    for name in missing:
        print(f"{name}: no such module", file=sys.stderr)
    if missing:
        return 2
    explained = tomllib.loads(EXPLAINED.read_text())
    counts: Counter[str] = Counter()
    for _, members in groupby(modules, os.path.dirname):
        counts += _test_modules(list(members), per_module, explained)
    if not counts:
        print("mutmut made no mutants", file=sys.stderr)
        return 1
    percent = 100 * counts["caught"] / counts.total()
    print(
        f"mutants: {counts['caught']} of {counts.total()} caught ({percent:.0f} %), "
        f"{counts['explained']} explained, {counts['survived']} survived"
    )
    return 0 if percent >= WANTED_PERCENT or not counts["survived"] else 1


def _test_modules(modules: list[str], size: int, explained: Explanations) -> Counter[str]:
    """Test a sample of mutants of each module; print scores and survivors, return the counts."""
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        _lay_out(Path(name), modules)
        reset_config()  # mutmut reads its configuration from the folder that it runs in
        samples = {module: _sample(module, size) for module in modules}
        _run_mutmut([mutant for sample in samples.values() for mutant in sample])
        codes = {module: _exit_codes(module) for module in modules}
    counts: Counter[str] = Counter()
    for module, sample in samples.items():
        reasons = {(e["old"], e["new"]): e["why"] for e in explained.get(module, [])}
        missed = [
            change
            for mutant, change in sample.items()
            if codes[module].get(mutant) in (SURVIVED, NO_TESTS, None)
        ]
        print(f"{module}: {len(sample) - len(missed)} of {len(sample)}", flush=True)
        for change in missed:
            verdict = f"explained: {reasons[change]}" if change in reasons else "survived:"
            print(f"  {verdict}\n    - {change[0]}\n    + {change[1]}", flush=True)
        counts["caught"] += len(sample) - len(missed)
        counts["explained"] += sum(change in reasons for change in missed)
        counts["survived"] += sum(change not in reasons for change in missed)
    return counts


def _lay_out(tree: Path, modules: list[str]) -> None:
    """Copy the package as it is imported, its tests, and a configuration of mutmut."""
    # Links are followed: a mutant is a change of the copy alone.
    shutil.copytree(ROOT / "src" / "sparseskin", tree / "sparseskin", ignore=IGNORED)
    shutil.copytree(ROOT / "tests", tree / "tests", ignore=IGNORED)
    tests = sorted({path for module in modules for path in _tests_of(module)})
    lines = [
        "[tool.mutmut]",
        'source_paths = ["sparseskin"]',
        f"only_mutate = {json.dumps([f'sparseskin/{name}' for name in modules])}",
        'also_copy = ["tests"]',
        "timeout_multiplier = 5.0",
        "timeout_constant = 10.0",
        f"pytest_add_cli_args_test_selection = {json.dumps(tests)}",
        'pytest_add_cli_args = ["-m", "not slow", "--hypothesis-seed=0"]',
        "[tool.pytest.ini_options]",
        'addopts = ["--import-mode=importlib", "--strict-markers"]',
        f"markers = {json.dumps(CONFIG['pytest']['ini_options']['markers'])}",
        f"pythonpath = {json.dumps(CONFIG['pytest']['ini_options']['pythonpath'])}",
    ]
    (tree / "pyproject.toml").write_text("\n".join(lines) + "\n")


def _tests_of(module: str) -> tuple[str, ...]:
    """Return the test file of the module's name, or all of its folder."""
    path = Path(module)
    named = Path("tests", path.parent, f"test_{path.name}")
    found = named if (ROOT / named).is_file() else named.parent
    return TESTS_OF.get(module, (str(found),))


def _sample(module: str, size: int) -> dict[str, tuple[str, str]]:
    """Draw mutants of a module, other than those of texts; the old and new code, by name."""
    path = Path("sparseskin", module)
    mutated = mutate_file_contents(str(path), path.read_text())
    lines = mutated.code.split("\n")
    code = {
        name: [_MANGLED.sub("", line) for line in lines[span.start - 1 : span.end]]
        for name, span in mutated.line_span_by_function_name.items()
    }
    names = sorted(mutated.mutant_names)
    sample: dict[str, tuple[str, str]] = {}
    for name in random.Random(module).sample(names, len(names)):
        if len(sample) == size:
            break
        diff = list(ndiff(code[_MANGLED.sub("__mutmut_orig", name)], code[name]))
        old, new = (" ".join(line[2:].strip() for line in diff if line[0] == s) for s in "-+")
        if _TEXT.sub("", old) != _TEXT.sub("", new):
            sample[get_mutant_name(path, name)] = (old, new)
    return sample


def _run_mutmut(mutants: list[str]) -> None:
    """Run mutmut on these mutants without its progress; what it finds is read from its files."""
    folder = Path("mutants").absolute()
    folder.mkdir()  # now: Python forgets folders of its path that are not there when it starts
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    command = [sys.executable, "-m", "mutmut", "run", "--max-children", "1", *mutants]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = [line for line in done.stdout.splitlines() if not "⠀" <= line[:1] <= "⣿"]
        print(*lines[-30:], done.stderr[-3000:], sep="\n", file=sys.stderr)


def _exit_codes(module: str) -> dict[str, int | None]:
    """Exit code of the tests by mutant of a module; None where it was not tested."""
    meta = Path("mutants", "sparseskin", f"{module}.meta")
    if not meta.is_file():
        return {}
    found: dict[str, int | None] = json.loads(meta.read_text())["exit_code_by_key"]
    return found


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
