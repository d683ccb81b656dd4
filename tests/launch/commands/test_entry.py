"""The entry point: an interrupt at any moment ends in no traceback."""

import os
import subprocess
import sys
import textwrap

import pytest


@pytest.mark.parametrize("module", ["argparse", "sparseskin.launch.commands.cli"])
def test_an_interrupt_of_the_imports_ends_with_130_and_no_traceback(module, tmp_path):
    # Importing the module interrupts, as Ctrl-C would at that moment.
    (tmp_path / "sitecustomize.py").write_text(
        textwrap.dedent(f"""
        import os, signal, sys

        # A background job of a shell would ignore it.
        signal.signal(signal.SIGINT, signal.default_int_handler)

        class Interrupting:
            def find_spec(self, name, path=None, target=None):
                if name == "{module}":
                    os.kill(os.getpid(), signal.SIGINT)

        sys.meta_path.insert(0, Interrupting())
        """)
    )
    done = subprocess.run(
        [sys.executable, "-m", "sparseskin", "--version"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_next_to_nothing_is_imported_before_an_interrupt_is_handled():
    code = (
        "import sys; before = set(sys.modules); import sparseskin.launch.commands.entry; "
        "print(*set(sys.modules) - before)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    own = ("sparseskin", "importlib._bootstrap")  # the latter has run before anything
    others = {name for name in done.stdout.split() if not name.startswith(own)}
    assert others <= {"__future__", "importlib", "warnings"}
