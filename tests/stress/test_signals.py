"""SIGTERM at random times of the start of a command: it always ends it, with exit code 143."""

import random
import signal
import subprocess
import time

from processes import PATIENCE_S, SENSOR, Program
from stress.graphs import FULL

N_STARTS = 200 if FULL else 4
ENDED = {
    -signal.SIGTERM: "before the handler was there",
    128 + signal.SIGTERM: "by the handler",
}
"""Return codes of a process whose exit code a shell reports as 143."""


def compiling(folder):
    """Environment of a start that compiles each module: no bytecode is there, and none is kept."""
    return {"PYTHONDONTWRITEBYTECODE": "1", "PYTHONPYCACHEPREFIX": str(folder / "none")}


def begun(folder):
    (folder / "graph.toml").write_text(SENSOR)
    environment = compiling(folder)
    # The command itself: with the limits of tests, most modules are imported before it begins.
    return Program(
        "launch", "graph.toml", cwd=folder, limits=True, environment=environment
    )


def test_sigterm_at_a_random_time_of_the_start_always_ends_it(tmp_path, note):
    with begun(tmp_path) as program:
        began_s = time.monotonic()
        program.wait_for("[launch] ready")
        start_s = time.monotonic() - began_s

    codes = []
    for _ in range(N_STARTS):
        with begun(tmp_path) as program:
            try:
                program.process.wait(random.uniform(0, 1.1 * start_s))
            except subprocess.TimeoutExpired:
                program.process.terminate()
            program.process.wait(PATIENCE_S)
            codes.append(program.process.returncode)
            assert program.survivors() == {}

    note(starts=N_STARTS, **{how: codes.count(code) for code, how in ENDED.items()})
    assert set(codes) <= set(ENDED), codes
