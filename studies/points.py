"""Points of a study: computed by an executor, each saved as soon as it is finished."""

from __future__ import annotations

import fcntl
import hashlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

from tqdm import tqdm

from sparseskin import nodes
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.lookup import one_line
from sparseskin.nodes.tasks import computed

#: Raised when the figures of a point change their meaning: records of other versions are not used.
STUDY_VERSION = 2
POINTS_FILE = "points.jsonl"

Point: TypeAlias = Mapping[str, Any]
Figures: TypeAlias = dict[str, Any]
Function: TypeAlias = Callable[[dict[str, Any]], Figures]


@cache
def code_fingerprint() -> str:
    """16 hexadecimal characters that change with the code of the nodes."""
    digest = hashlib.sha256()
    (root,) = nodes.__path__
    for path in sorted(Path(root).rglob("*.py")):
        digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


class StudyError(SparseskinError):
    """A study cannot be run, or one of its points cannot be computed."""


def compute(
    function: Function,
    points: Sequence[Point],
    out: Path,
    executor_name: str,
    label: str,
) -> list[Figures]:
    """Compute the points that are not known yet, and return the figures of all, in their order.

    Each finished point is at once one line of `points.jsonl` in the folder `out`: a run that was
    interrupted or killed continues where it was, and loses at most the points under way.
    `function`, at the top of a module, so that a worker finds it by name, takes one point (its
    parameters, the seed included, as JSON holds them) and returns its figures; best for 50 ms of
    work or more. `executor_name`: as of `make_executor`. `label` is shown by the progress bar and
    part of the key of each point, as is the name of the function. Raises StudyError if a point
    fails, the folder cannot be written to, or another run uses it; SettingsError if there is no
    such executor.
    """
    keys = [key_of(function, label, point) for point in points]
    code = code_fingerprint()
    with _opened(out) as file:
        records = _read(file)
        figures_of_key = {key: record["figures"] for key, record in records.items()}
        # Equal points, as of a sweep that meets its centre twice, are computed once.
        missing = {}
        for key, point in zip(keys, points, strict=True):
            if key not in figures_of_key:
                missing[key] = dict(point)
        known_keys = set(keys) & set(figures_of_key)
        is_other_code = [records[key]["code"] != code for key in known_keys]
        _log_known(label, set(keys), is_other_code)
        name = f"{function.__module__}:{function.__qualname__}"
        names = {"label": label, "function": name}
        bare = not missing or not sys.stderr.isatty()
        with tqdm(
            total=len(missing),
            desc=label,
            unit="point",
            disable=bare,
        ) as bar:
            for key, figures in _computed(function, missing, executor_name):
                origin = {
                    "key": key,
                    **names,
                    "version": STUDY_VERSION,
                    "code": code,
                }
                line = json.dumps(
                    {
                        **origin,
                        "point": missing[key],
                        "figures": figures,
                    }
                )
                # At once: a run may be killed at any time.
                file.write(line.encode() + b"\n")
                file.flush()
                # As it would be read: lists for tuples, so that a resumed run has the same.
                figures_of_key[key] = json.loads(line)["figures"]
                bar.update()
        if missing and bare:
            text = f"{label}: {len(missing)} of {len(set(keys))} points computed"
            print(text, file=sys.stderr)
    return [figures_of_key[key] for key in keys]


def compute_rows(
    function: Function,
    points: Sequence[Point],
    out: Path,
    executor_name: str,
    label: str,
) -> list[Figures]:
    """Return each point together with its figures as one dict; see `compute`."""
    figures = compute(function, points, out, executor_name, label)
    return [{**point, **result} for point, result in zip(points, figures, strict=True)]


def key_of(function: Function, label: str, point: Point) -> str:
    """Key of a point: SHA-256 of its label, function's name, parameters and the version."""
    # Not the module: it may move.
    names = [label, function.__qualname__, STUDY_VERSION]
    text = json.dumps([*names, point], sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _log_known(label: str, keys: set[str], is_other_code: Sequence[bool]) -> None:
    """Log how many points are not computed again, and how many of them other code computed."""
    if not is_other_code:
        return
    text = f"{label}: {len(is_other_code)} of {len(keys)} points are known from an earlier run"
    if any(is_other_code):
        text += f", {sum(is_other_code)} of them by other code than today's"
    print(f"{text} (--anew forgets them)", file=sys.stderr)


def forget(out: Path) -> None:
    """Delete the points that earlier runs have saved in a folder.

    Raises StudyError if its file cannot be opened, or another run uses the folder.
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
        # Two runs would mix their lines.
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise StudyError(f"{out}: another run of a study uses it") from error
        yield file


def _read(file: BinaryIO) -> dict[str, dict[str, Any]]:
    """Read records of this version by key. An incomplete last line is cut off."""
    file.seek(0)
    records: dict[str, dict[str, Any]] = {}
    whole = 0
    for line in file:
        # The run before was killed as it wrote.
        if not line.endswith(b"\n"):
            break
        try:
            record = json.loads(line)
            if record.get("version") == STUDY_VERSION:
                records[record["key"]] = {
                    key: record[key] for key in ("figures", "code")
                }
        except (ValueError, TypeError, KeyError, AttributeError):
            break
        whole += len(line)
    file.truncate(whole)
    return records


def _computed(
    function: Function, missing: Mapping[str, dict[str, Any]], executor_name: str
) -> Iterator[tuple[str, Figures]]:
    """Yield (key, figures) of points as they are finished."""
    with closing(computed(executor_name, function, missing)) as finished:
        for key, future in finished:
            try:
                figures = future.result()
                json.dumps(figures, allow_nan=False)
            except Exception as error:
                parameters = missing[key].items()
                point = ", ".join(f"{name} = {value}" for name, value in parameters)
                fault = error if isinstance(error, SparseskinError) else one_line(error)
                raise StudyError(f"point {point}: {fault}") from error
            yield key, figures
