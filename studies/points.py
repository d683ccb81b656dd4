"""The points of a study: computed by an executor, and each kept as soon as it is known."""

from __future__ import annotations

import fcntl
import hashlib
import json
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, as_completed
from contextlib import contextmanager
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

from tqdm import tqdm

from sparseskin import nodes
from sparseskin.launch.executors import make_executor
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.lookup import one_line

#: Raised when what a point computes changes its meaning: figures kept before are then not used.
STUDY_VERSION = 1
POINTS_FILE = "points.jsonl"

Point: TypeAlias = Mapping[str, Any]
Figures: TypeAlias = dict[str, Any]
Function: TypeAlias = Callable[[dict[str, Any]], Figures]


class StudyError(SparseskinError):
    """A study cannot be run, or one of its points cannot be computed."""


def compute(
    function: Function, points: Sequence[Point], out: Path, executor_name: str, label: str
) -> list[Figures]:
    """Compute the points that are not known yet, and return the figures of all.

    Each finished point is at once one line of `points.jsonl` in the folder: a run that was
    interrupted or killed goes on where it was, and loses at most the points under way.

    Parameters
    ----------
    function : callable
        Of a module, so that a worker finds it by name; takes one point, returns its figures.
        Best for 50 ms of work or more.
    points : sequence of mapping
        Parameters of each point, the seed included: what JSON can hold.
    out : Path
        Folder of the study, which exists.
    executor_name : str
        As in `sparseskin.launch.executors.make_executor`.
    label : str
        What the progress bar calls the points.

    Returns
    -------
    list of dict
        Figures in the order of the points, the same ones whether computed now or read.

    Raises
    ------
    StudyError
        If a point fails, the folder cannot be written to, or another run is at work in it.
    SettingsError
        If there is no such executor.
    """
    keys = [key_of(function, point) for point in points]
    code = code_fingerprint()
    with _opened(out) as file:
        known, code_of = _read(file)
        missing = {
            key: dict(point) for key, point in zip(keys, points, strict=True) if key not in known
        }
        _tell_known(label, set(keys), [code_of[k] != code for k in set(keys) & set(known)])
        with tqdm(total=len(missing), desc=label, unit="point", disable=not missing) as bar:
            for key, figures in _computed(function, missing, executor_name):
                record = {"key": key, "code": code, "point": missing[key], "figures": figures}
                line = json.dumps(record)
                file.write(line.encode() + b"\n")
                file.flush()
                # As it would be read: lists for tuples, so that a resumed run has the same.
                known[key] = json.loads(line)["figures"]
                bar.update()
    return [known[key] for key in keys]


def key_of(function: Function, point: Point) -> str:
    """What a point is found by: the SHA-256 of its function, its parameters and the version."""
    name = f"{function.__module__}:{function.__qualname__}"
    text = json.dumps([name, STUDY_VERSION, point], sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def code_fingerprint() -> str:
    """16 hexadecimal characters that change with the code of the nodes, which studies run."""
    digest = hashlib.sha256()
    root = Path(nodes.__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _tell_known(label: str, keys: set[str], is_other_code: Sequence[bool]) -> None:
    """Say how many points are not computed again, and whether they would be the same."""
    if not is_other_code:
        return
    text = f"{label}: {len(is_other_code)} of {len(keys)} points are known from an earlier run"
    if any(is_other_code):
        text += f", {sum(is_other_code)} of them by other code than today's"
    print(f"{text} (--anew forgets them)", file=sys.stderr)


def forget(out: Path) -> None:
    """Drop the points that earlier runs have computed into a folder.

    Raises
    ------
    StudyError
        If its file cannot be opened, or another run is computing there.
    """
    with _opened(out) as file:
        file.truncate(0)


@contextmanager
def _opened(out: Path) -> Iterator[BinaryIO]:
    """Open a folder's points for reading and appending, by one run at a time."""
    path = out / POINTS_FILE
    try:
        file = path.open("a+b")
    except OSError as error:
        raise StudyError(f"{path}: {error.strerror}") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise StudyError(f"{out}: another run of a study is at work in it") from error
        yield file


def _read(file: BinaryIO) -> tuple[dict[str, Figures], dict[str, str]]:
    """Figures by key, and the code that found them; a line torn by the end of a run is cut off."""
    file.seek(0)
    known: dict[str, Figures] = {}
    code_of: dict[str, str] = {}
    whole = 0
    for line in file:
        try:
            record = json.loads(line)
            key, figures = record["key"], record["figures"]
        except (ValueError, TypeError, KeyError):
            break
        if not line.endswith(b"\n"):
            break
        known[key], code_of[key] = figures, record.get("code", "")
        whole += len(line)
    file.truncate(whole)
    return known, code_of


def _computed(
    function: Function, missing: Mapping[str, dict[str, Any]], executor_name: str
) -> Iterator[tuple[str, Figures]]:
    """Yield (key, figures) of points as they are finished."""
    if not missing:
        return
    before = set(multiprocessing.active_children())
    executor = make_executor(executor_name)
    try:
        # Ctrl-C reaches the workers too; they inherit that it is none of their business.
        with _interrupts_ignored():
            futures = _submitted(executor, function, missing)
        for future in as_completed(futures):
            key = futures[future]
            try:
                figures = future.result()
                json.dumps(figures, allow_nan=False)
            except SparseskinError as error:
                raise StudyError(f"{_named(missing[key])}: {error}") from error
            except Exception as error:
                raise StudyError(f"{_named(missing[key])}: {one_line(error)}") from error
            yield key, figures
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        for worker in set(multiprocessing.active_children()) - before:
            worker.terminate()
        raise
    executor.shutdown()


def _submitted(
    executor: Executor, function: Function, missing: Mapping[str, dict[str, Any]]
) -> dict[Future[Figures], str]:
    return {executor.submit(_run, function, point): key for key, point in missing.items()}


def _run(function: Function, point: dict[str, Any]) -> Figures:
    """Compute one point, in a worker or in this process."""
    _end_with_parent()
    return function(point)


def _end_with_parent() -> None:
    """In a worker: see to it that it does not outlive a study that is killed."""
    parent = multiprocessing.parent_process()
    if parent is None or any(thread.name == _WATCH for thread in threading.enumerate()):
        return

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, name=_WATCH, daemon=True).start()


_WATCH = "parent-watch"


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _named(point: Mapping[str, Any]) -> str:
    return "point " + ", ".join(f"{key} = {value}" for key, value in point.items())
