"""The command `sparseskin reprocess`: recordings through other settings, offline."""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from sparseskin.launch.offline.job import Job, Outcome, run_whole
from sparseskin.nodes.errors import SettingsError, SparseskinError
from sparseskin.nodes.lookup import did_you_mean, one_line
from sparseskin.nodes.remote import (
    check_address,
    check_free,
    file_name,
    is_remote,
    local_path,
    store,
)
from sparseskin.nodes.tasks.executors import forms

from .options import add_set, add_summary, check_summary, whole, write_summary

START_POINTS = ("auto", "taxels", "measurements")
STATIONS = ("compressor", "reconstructor")
FIELD_MINUTES = 5.0
"""Minutes a GB of recording: the figure of the field, printed beside the own one."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `reprocess`."""
    parser.description = (
        "Compress and reconstruct recorded frames with other settings, faster than they were "
        "recorded; the result is a recording with the same stamps."
    )
    parser.add_argument("files", metavar="F.mcap", nargs="+", help="recordings, or addresses")
    add_set(parser, "change a setting of the compressor or the reconstructor", "NODE.KEY=VALUE")
    about = "file to write; a folder for several, made if it does not exist"
    parser.add_argument("--out", metavar="G.mcap", required=True, help=about)
    about = "recorded stream to start from; auto: measurements, unless the compressor is changed"
    parser.add_argument(
        "--from", dest="start_from", choices=START_POINTS, default=START_POINTS[0], help=about
    )
    parser.add_argument("--executor", metavar="WHERE", help=forms())
    about = "cut recordings into slices of this many seconds, or auto, which --executor shares"
    parser.add_argument("--slices", type=_slice_s, metavar="SECONDS|auto", help=about)
    about = "frames before a slice that are computed with it and left out (default: 256)"
    parser.add_argument("--warm-up", type=whole(0), metavar="FRAMES", help=about)
    about = "folder of finished slices, on a disk that all workers share (default: OUT.slices)"
    parser.add_argument("--parts", metavar="DIR", help=about)
    add_summary(parser)
    parser.set_defaults(run=_reprocess)


def _slice_s(text: str) -> float:
    """Seconds of a slice; 0 for auto."""
    if text == "auto":
        return 0.0
    with contextlib.suppress(ValueError):
        if 1e-6 <= (value := float(text)) <= 1e9:
            return value
    raise argparse.ArgumentTypeError(f"{text!r}: expected seconds above 0, or auto")


def _reprocess(arguments: argparse.Namespace) -> int:
    """Reprocess all recordings; those that fail are named, and do not stop the others."""
    from sparseskin.nodes.monitor.table import summary_table

    check_summary(arguments.summary)
    _check_slices(arguments)
    jobs = _jobs(arguments)
    outcomes = _run(jobs, arguments)
    for outcome in outcomes:
        if outcome.error:
            source = outcome.job.source
            places = (source, outcome.job.out)
            named = outcome.error.startswith("--") or any(p in outcome.error for p in places)
            print(outcome.error if named else f"{source}: {outcome.error}", file=sys.stderr)
        else:
            print(f"{outcome.job.out}:")
            print(summary_table(outcome.patches))
            for line in (*outcome.notes, _rate(outcome)):
                print(line)
    found = {o.job.out: {"patches": o.patches} for o in outcomes if not o.error}
    write_summary(arguments.summary, "reprocess-summary", {"recordings": found})
    return 2 if any(outcome.error for outcome in outcomes) else 0


def _rate(outcome: Outcome) -> str:
    """Bytes and time of a recording, beside those of the field."""
    gigabytes, minutes = outcome.n_bytes / 1e9, max(outcome.seconds, 1e-9) / 60
    return (
        f"{gigabytes:.3g} GB in {outcome.seconds:.1f} s: {gigabytes / minutes:.3g} GB a minute, "
        f"{minutes / max(gigabytes, 1e-9):.3g} minutes a GB (the field: {FIELD_MINUTES:g})"
    )


def run_job(job: Job, progress: bool = False, how_cut: Any = None) -> Outcome:
    """Reprocess one recording; without slices a task that any executor can run."""
    begin_s = time.monotonic()
    try:
        source = local_path(job.source)
        with _output(job) as local:
            notes: Sequence[str] = ()
            if how_cut is None:
                patches = run_whole(local, source, progress)
            else:
                from sparseskin.launch.offline.slices import run_sliced

                patches, notes = run_sliced(local, source, how_cut, progress)
        n_bytes = source.stat().st_size
    except SparseskinError as error:
        return Outcome(job, {}, str(error))
    seconds = time.monotonic() - begin_s
    return Outcome(job, patches, "", tuple(notes), n_bytes, seconds)


@contextlib.contextmanager
def _output(job: Job) -> Iterator[Job]:
    """A job that writes to a path: for an address one in a new folder, which is stored there."""
    if not is_remote(job.out):
        yield job
        return
    check_free(job.out)
    with tempfile.TemporaryDirectory(prefix="sparseskin-") as folder:
        path = Path(folder) / file_name(job.out)
        yield replace(job, out=str(path))
        store(path, job.out)


def _check_slices(arguments: argparse.Namespace) -> None:
    for option in ("warm_up", "parts"):
        if arguments.slices is None and getattr(arguments, option) is not None:
            raise SettingsError(f"--{option.replace('_', '-')}: goes with --slices")
    if arguments.slices is not None and is_remote(arguments.out) and arguments.parts is None:
        raise SettingsError(
            "--slices: the result is at an address; state --parts, a folder that workers share"
        )
    if arguments.parts is not None and len(arguments.files) > 1:
        raise SettingsError("--parts: goes with one recording; each has a folder of its own")


def _jobs(arguments: argparse.Namespace) -> list[Job]:
    from sparseskin.nodes.files import make_folder
    from sparseskin.nodes.recorder.bag.format import FILE_SUFFIX, PART_SUFFIX

    for file in arguments.files:
        if not file_name(file).removesuffix(PART_SUFFIX).endswith(FILE_SUFFIX):
            raise SettingsError(f"{file}: no recording ({FILE_SUFFIX})")
        if is_remote(file):
            check_address(file)
        elif not Path(file).is_file():
            raise SettingsError(f"{file}: no such file")
    for text in arguments.set:
        node = text.partition(".")[0]
        if text.startswith(f"{node}.patch="):
            raise SettingsError(f"--set {text}: the patch is that of the recording")
        if node not in STATIONS:
            hint = did_you_mean(node, STATIONS)
            raise SettingsError(f"--set {text}: unknown node '{node}'{hint}")
    several = len(arguments.files) > 1
    names = [file_name(file) for file in arguments.files]
    if len(set(names)) < len(names):
        raise SettingsError("two recordings have the same name")
    changes, start_from = tuple(arguments.set), arguments.start_from
    if is_remote(arguments.out):
        check_address(arguments.out)
        folder = arguments.out.rstrip("/")
        if not several and not folder.endswith(FILE_SUFFIX):
            raise SettingsError(f"--out {folder}: expected a name that ends in {FILE_SUFFIX}")
        outs = [f"{folder}/{name}" if several else folder for name in names]
    else:
        out = Path(arguments.out)
        if several and not out.is_dir():
            if out.suffix == FILE_SUFFIX:
                raise SettingsError(f"--out {out}: expected a folder, for several recordings")
            make_folder(out)
        outs = [str(out / name if several or out.is_dir() else out) for name in names]
    pairs = zip(arguments.files, outs, strict=True)
    return [Job(file, one, changes, start_from) for file, one in pairs]


def _run(jobs: Sequence[Job], arguments: argparse.Namespace) -> list[Outcome]:
    quiet, executor = not sys.stderr.isatty(), arguments.executor
    if arguments.slices is not None:
        from sparseskin.launch.offline.plan import WARM_UP
        from sparseskin.launch.offline.slices import Sliced

        warm_up = WARM_UP if arguments.warm_up is None else arguments.warm_up
        parts = arguments.parts or ""
        how_cut = Sliced(arguments.slices or None, warm_up, executor or "serial", parts)
        return [run_job(job, not quiet, how_cut) for job in jobs]
    if executor is None:
        return [run_job(job, progress=not quiet) for job in jobs]
    from tqdm import tqdm

    from sparseskin.nodes.tasks.results import computed

    outcomes: dict[int, Outcome] = {}
    with (
        closing(computed(executor, run_job, dict(enumerate(jobs)))) as finished,
        tqdm(total=len(jobs), disable=quiet, unit="recording") as bar,
    ):
        for k, future in finished:
            try:
                outcomes[k] = future.result()
            except Exception as error:  # its worker died
                outcomes[k] = Outcome(jobs[k], {}, one_line(error))
            bar.update()
    return [outcomes[k] for k in range(len(jobs))]
