"""Mutation testing of the core: a sample of mutants of each module, and the share that is caught.

    make mutants                          # 8 mutants a module
    .venv/bin/python .ci/mutants.py 20 nodes/compressor/phi/sbhe.py

mutmut changes one expression at a time and runs the quick tests that reach it. The folders of
the repository are copied into a tree that is named as imported, since mutmut names a mutant by
its path. The sample is the same as long as the code is.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

from layout import CONFIG, IGNORED, ROOT, copy_package

CORE = (
    "messages/fields.py",
    "messages/quantised.py",
    "messages/wire.py",
    "nodes/clock.py",
    "nodes/compressor/phi/acts.py",
    "nodes/compressor/phi/hadamard.py",
    "nodes/compressor/phi/sbhe.py",
    "nodes/compressor/quantiser.py",
    "nodes/graph.py",
    "nodes/host.py",
    "nodes/monitor/metrics.py",
    "nodes/monitor/statistics.py",
    "nodes/player/schedule.py",
    "nodes/reconstructor/bases/haar.py",
    "nodes/reconstructor/bases/shifted_haar.py",
    "nodes/reconstructor/estimates/resultant.py",
    "nodes/reconstructor/estimates/uncertainty.py",
    "nodes/reconstructor/faults/rows.py",
    "nodes/reconstructor/faults/taxels.py",
    "nodes/reconstructor/skin/clip_bias.py",
    "nodes/reconstructor/skin/gain.py",
    "nodes/reconstructor/skin/noise_level.py",
    "nodes/reconstructor/skin/prediction.py",
    "nodes/reconstructor/skin/row_memory.py",
    "nodes/reconstructor/solvers/fista.py",
    "nodes/sensor/files/emed.py",
    "nodes/sensor/files/tekscan.py",
    "nodes/sensor/noise.py",
    "nodes/sensor/scenes/contact.py",
    "nodes/sensor/scenes/motion.py",
)
TESTS = ("tests/messages", "tests/nodes")
PER_MODULE = 8
WANTED_PERCENT = 90
#: Exit codes of the tests under a mutant: passed, or no test reached it.
SURVIVED, NO_TESTS = 0, 33


def main(arguments: list[str]) -> int:
    per_module = int(arguments.pop(0)) if arguments and arguments[0].isdecimal() else PER_MODULE
    modules = [m for m in arguments or CORE if (ROOT / m).is_file()]
    for missing in sorted(set(arguments or CORE) - set(modules)):
        print(f"{missing}: no such module", file=sys.stderr)
    if len(modules) < len(arguments or CORE):
        return 2
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        _lay_out(tree, modules)
        environment = {**os.environ, "PYTHONPATH": str(tree / "mutants")}
        command = [sys.executable, "-m", "mutmut", "run"]
        # The first run makes all mutants and learns which tests reach them; it tests none.
        _quietly([*command, "no.such.mutant"], tree, environment)
        sample = []
        for name in modules:
            mutants = sorted(_verdicts(tree, name))
            sample += random.Random(name).sample(mutants, min(per_module, len(mutants)))
        if not sample:
            print("mutmut made no mutants", file=sys.stderr)
            return 1
        _quietly([*command, *sample], tree, environment)
        return _report(tree, modules, sample)


def _quietly(command: list[str], tree: Path, environment: dict[str, str]) -> None:
    """Run mutmut without its progress; what it reports is read from its files."""
    done = subprocess.run(
        command, cwd=tree, env=environment, capture_output=True, text=True, check=False
    )
    if "Failed to run" in done.stdout or "Traceback" in done.stderr:
        print(done.stdout[-3000:], done.stderr[-3000:], file=sys.stderr)


def _lay_out(tree: Path, modules: list[str]) -> None:
    """Copy the package as it is imported, its tests, and a configuration of mutmut."""
    copy_package(tree)
    shutil.copytree(ROOT / "tests", tree / "tests", ignore=IGNORED)
    lines = [
        "[tool.mutmut]",
        'source_paths = ["sparseskin"]',
        f"only_mutate = {json.dumps([f'sparseskin/{name}' for name in modules])}",
        'also_copy = ["tests"]',
        f"pytest_add_cli_args_test_selection = {json.dumps(list(TESTS))}",
        'pytest_add_cli_args = ["-m", "not slow", "-p", "no:xdist"]',
        "[tool.pytest.ini_options]",
        'addopts = ["--import-mode=importlib", "--strict-markers"]',
        f"markers = {json.dumps(CONFIG['pytest']['ini_options']['markers'])}",
        'pythonpath = ["tests"]',
    ]
    (tree / "pyproject.toml").write_text("\n".join(lines) + "\n")


def _verdicts(tree: Path, module: str) -> dict[str, int | None]:
    """Exit code of the tests by mutant of a module; None where it was not tested."""
    meta = tree / "mutants" / "sparseskin" / f"{module}.meta"
    if not meta.is_file():
        return {}
    found: dict[str, int | None] = json.loads(meta.read_text())["exit_code_by_key"]
    return found


def _report(tree: Path, modules: list[str], sample: list[str]) -> int:
    counts: Counter[str] = Counter()
    survivors = []
    for name in modules:
        for mutant, code in _verdicts(tree, name).items():
            if mutant not in sample:
                continue
            caught = code not in (SURVIVED, NO_TESTS, None)
            counts["caught" if caught else "survived"] += 1
            if not caught:
                survivors.append(mutant)
    for mutant in survivors:
        shown = [sys.executable, "-m", "mutmut", "show", mutant]
        done = subprocess.run(shown, cwd=tree, capture_output=True, text=True, check=False)
        print(f"survived: {mutant}\n{done.stdout}")
    percent = 100 * counts["caught"] / len(sample)
    print(f"mutants: {counts['caught']} of {len(sample)} caught ({percent:.0f} %)")
    return 0 if percent >= WANTED_PERCENT else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
