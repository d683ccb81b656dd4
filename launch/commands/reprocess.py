"""The command `sparseskin reprocess`: recordings through other settings, offline."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import Future, as_completed
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparseskin.nodes.errors import SettingsError, SparseskinError
from sparseskin.nodes.executors import FORMS, make_executor
from sparseskin.nodes.lookup import did_you_mean, one_line

from .options import add_set, add_summary, check_summary, write_summary

if TYPE_CHECKING:
    from sparseskin.launch.launchfile.spec import LaunchFile

START_POINTS = ("auto", "taxels", "measurements")
STATIONS = ("compressor", "reconstructor")


@dataclass(frozen=True)
class Job:
    """One recording to reprocess."""

    source: str
    out: str
    overrides: tuple[str, ...]
    start_from: str


@dataclass(frozen=True)
class Outcome:
    """Result of a job: the monitor's summary by patch, or a line with the reason of its failure."""

    job: Job
    patches: dict[str, Any]
    error: str = ""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `reprocess`."""
    parser.description = (
        "Compress and reconstruct recorded frames with other settings, faster than they were "
        "recorded; the result is a recording with the same stamps."
    )
    parser.add_argument("files", metavar="F.mcap", nargs="+", help="recordings")
    add_set(parser, "a setting of the compressor or the reconstructor")
    about = "file to write; a folder for several, made if it does not exist"
    parser.add_argument("--out", metavar="G.mcap", required=True, help=about)
    about = "recorded stream to start from; auto: measurements, unless the compressor is changed"
    parser.add_argument(
        "--from", dest="start_from", choices=START_POINTS, default=START_POINTS[0], help=about
    )
    parser.add_argument("--executor", metavar="WHERE", help=FORMS)
    add_summary(parser)
    parser.set_defaults(run=_reprocess)


def _reprocess(arguments: argparse.Namespace) -> int:
    """Reprocess all recordings; those that fail are named, and do not stop the others."""
    from sparseskin.nodes.monitor.table import summary_table

    check_summary(arguments.summary)
    jobs = _jobs(arguments)
    outcomes = _run(jobs, arguments.executor)
    for outcome in outcomes:
        if outcome.error:
            source = outcome.job.source
            places = (source, outcome.job.out)
            named = outcome.error.startswith("--") or any(p in outcome.error for p in places)
            print(outcome.error if named else f"{source}: {outcome.error}", file=sys.stderr)
        else:
            print(f"{outcome.job.out}:")
            print(summary_table(outcome.patches))
    found = {o.job.out: {"patches": o.patches} for o in outcomes if not o.error}
    write_summary(arguments.summary, "reprocess-summary", {"recordings": found})
    return 2 if any(outcome.error for outcome in outcomes) else 0


def run_job(job: Job, progress: bool = False) -> Outcome:
    """Reprocess one recording; a task that any executor can run."""
    try:
        return Outcome(job, _run_job(job, progress))
    except SparseskinError as error:
        return Outcome(job, {}, str(error))


def _jobs(arguments: argparse.Namespace) -> list[Job]:
    from sparseskin.nodes.files import make_folder
    from sparseskin.nodes.recorder.bag.format import FILE_SUFFIX, PART_SUFFIX

    for file in arguments.files:
        if not file.removesuffix(PART_SUFFIX).endswith(FILE_SUFFIX):
            raise SettingsError(f"{file}: no recording ({FILE_SUFFIX})")
        if not Path(file).is_file():
            raise SettingsError(f"{file}: no such file")
    for text in arguments.set:
        node = text.partition(".")[0]
        if text.startswith(f"{node}.patch="):
            raise SettingsError(f"--set {text}: the patch is that of the recording")
        if node not in STATIONS:
            hint = did_you_mean(node, STATIONS)
            raise SettingsError(f"--set {text}: unknown node '{node}'{hint}")
    out = Path(arguments.out)
    several = len(arguments.files) > 1
    names = [Path(file).name for file in arguments.files]
    if len(set(names)) < len(names):
        raise SettingsError("two recordings have the same name")
    if several and not out.is_dir():
        if out.suffix == FILE_SUFFIX:
            raise SettingsError(f"--out {out}: expected a folder, for several recordings")
        make_folder(out)
    return [
        Job(
            file,
            str(out / name if several or out.is_dir() else out),
            tuple(arguments.set),
            arguments.start_from,
        )
        for file, name in zip(arguments.files, names, strict=True)
    ]


def _run(jobs: Sequence[Job], executor: str | None) -> list[Outcome]:
    quiet = not sys.stderr.isatty()
    if executor is None:
        return [run_job(job, progress=not quiet) for job in jobs]
    from tqdm import tqdm

    with make_executor(executor) as pool:
        futures = {pool.submit(run_job, job): k for k, job in enumerate(jobs)}
        done = tqdm(as_completed(futures), total=len(jobs), disable=quiet, unit="recording")
        outcomes = {futures[future]: _settled(jobs[futures[future]], future) for future in done}
    return [outcomes[k] for k in range(len(jobs))]


def _settled(job: Job, future: Future[Outcome]) -> Outcome:
    """The outcome of a job, also where its worker died."""
    try:
        return future.result()
    except Exception as error:
        return Outcome(job, {}, one_line(error))


def _run_job(job: Job, progress: bool) -> dict[str, Any]:
    """Run one job; its result appears under its name when it is complete, or not at all."""
    from sparseskin.nodes.files import whole_file
    from sparseskin.nodes.recorder.bag.format import FILE_SUFFIX
    from sparseskin.nodes.recorder.bag.writer import removing

    if Path(job.out).suffix != FILE_SUFFIX:
        raise SettingsError(f"--out {job.out}: expected a name that ends in {FILE_SUFFIX}")
    with whole_file(Path(job.out)) as draft, removing(draft, Path(job.out)):
        return _stream(job, _graph(job, draft), progress)


def _stream(job: Job, launch: LaunchFile, progress: bool) -> dict[str, Any]:
    from tqdm import tqdm

    from sparseskin.nodes.bus import Bus
    from sparseskin.nodes.clock import ManualClock
    from sparseskin.nodes.recorder.bag.reader import BagReader

    clock = ManualClock()
    bus = Bus({n.name: (n.cls, n.settings) for n in launch.nodes.values()}, clock)
    with BagReader(job.source) as bag:
        total = max((info.n_messages for info in bag.topics.values()), default=0)
    bar = tqdm(total=total, disable=not progress, unit="frame", desc=Path(job.source).name)
    with bar, closing(bus):
        for messages in bus.frames():
            # Offline a frame is done when it was acquired: no latency is invented.
            newest_ns = max((message.stamp_ns for message in messages), default=0)
            clock.advance(max(0, newest_ns - clock.now_ns()))
            bar.update()
    bus.check()
    patches: dict[str, Any] = bus.reports()["monitor"]["patches"]
    return {name: patch | {"latency_ms": None} for name, patch in patches.items()}


def _how(job: Job, made_by: str) -> str:
    """Provenance of a result, for its metadata: the command, then the text in the recording."""
    changes = " ".join(f"--set {text}" for text in job.overrides)
    command = f"# sparseskin reprocess {Path(job.source).name} {changes}".rstrip()
    return f"{command} --from {job.start_from}\n{made_by}"


def _graph(job: Job, out: Path) -> LaunchFile:
    """The graph that reprocesses a recording: a launch file that is never written."""
    from sparseskin.launch.launchfile.load import load_tables
    from sparseskin.messages import Calibration, Measurements, PhiState, SkinState, Taxels, Truth
    from sparseskin.messages.topics import split_topic
    from sparseskin.nodes.recorder.bag.reader import BagReader

    with BagReader(job.source) as bag:
        topics = [split_topic(topic) for topic in bag.topics]
        made_by = bag.metadata.get("launch", "")
    patches = sorted({patch for patch, _ in topics})
    if len(patches) != 1:
        raise SparseskinError(f"holds {len(patches)} patches; reprocess takes recordings of one")
    present = {schema for _, schema in topics}
    changes_edge = any(text.startswith("compressor.") for text in job.overrides)
    start_from = job.start_from
    if start_from == "auto":
        start_from = "measurements" if "measurements" in present and not changes_edge else "taxels"
    if start_from == "measurements" and changes_edge:
        raise SettingsError("--from measurements: the compressor cannot be changed then")
    schemas = [SkinState.schema, Taxels.schema, Truth.schema]
    schemas += [Calibration.schema] if Calibration.schema in present else []
    tables: dict[str, dict[str, Any]] = {}
    if start_from == "measurements":
        schemas += [PhiState.schema, Measurements.schema]
    else:
        tables["compressor"] = {"type": "compressor", "patch": patches[0]}
    tables = {
        "player": {"type": "player", "file": job.source, "schemas": schemas, "keep_stamps": True},
        **tables,
        "reconstructor": {"type": "reconstructor", "patch": patches[0]},
        "monitor": {"type": "monitor", "patches": patches},
        "recorder": {"type": "recorder", "out": str(out), "launch": _how(job, made_by)},
    }
    return load_tables(f"reprocess {Path(job.source).name}", tables, job.overrides)
