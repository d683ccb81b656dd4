"""A Dask cluster whose scheduler and workers are processes of their own."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path

from conftest import PATIENCE_S, wait_until


class Cluster:
    """A scheduler and workers, each a process; `address` is that of the scheduler."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file = folder / "scheduler.json"
        self.workers: list[subprocess.Popen[bytes]] = []
        self.processes: list[subprocess.Popen[bytes]] = []
        options = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        self._run("scheduler", *options, "--scheduler-file", str(self._file))
        found: list[str] = []

        def is_there() -> bool:
            with contextlib.suppress(OSError, ValueError):  # it is being written
                found.append(json.loads(self._file.read_text())["address"])
            return bool(found)

        wait_until(is_there, "the scheduler's file")
        self.address = found[0]

    def _run(self, what: str, *options: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_" + what, *options],
            cwd=self._folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        self.processes.append(process)
        return process

    def add_worker(self) -> None:
        options = ("--no-nanny", "--nthreads", "1", "--no-dashboard", "--host", "127.0.0.1")
        self.workers.append(self._run("worker", self.address, *options))

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait(PATIENCE_S)
