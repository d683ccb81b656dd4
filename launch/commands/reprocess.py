"""The command `sparseskin reprocess`: recordings through other settings, offline."""

import argparse
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from sparseskin.launch.attach.text import size_text
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import did_you_mean, one_line
from sparseskin.nodes.tasks import FORMS

from .options import add_set, add_summary, bag_names, check_summary, rare, write_summary

if TYPE_CHECKING:
    from sparseskin.launch.offline.job import Job, Outcome

START_POINTS = ("auto", "taxels", "measurements")
STATIONS = ("compressor", "reconstructor")


def configure(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Compress and reconstruct recorded frames with other settings, faster than they were "
        "recorded; the result is a recording with the same stamps."
    )
    rarely_used = rare(parser)
    parser.add_argument(
        "files",
        metavar="F.mcap",
        nargs="+",
        help="recordings",
    )
    add_set(
        parser,
        "change a setting of the compressor or the reconstructor",
        "NODE.KEY=VALUE",
    )
    parser.add_argument(
        "--out",
        metavar="G.mcap",
        required=True,
        help="file to write; a folder for several, made if it does not exist",
    )
    about = "recorded stream to start from; auto: measurements, unless the compressor is changed"
    rarely_used.add_argument(
        "--from",
        dest="start_from",
        choices=START_POINTS,
        default=START_POINTS[0],
        help=about,
    )
    rarely_used.add_argument(
        "--executor",
        metavar="WHERE",
        help=f"where recordings are computed side by side: {FORMS}",
    )
    add_summary(parser)
    parser.set_defaults(run=_reprocess)


def _reprocess(arguments: argparse.Namespace) -> int:
    """Reprocess all recordings. Those that fail are named, and do not stop the others; those that
    an earlier run has finished are not computed again.
    """
    # A file that cannot be written is reported before the work, which may take long.
    check_summary(arguments.summary)
    outcomes = _outcomes(_jobs(arguments), arguments.executor)
    for outcome in outcomes:
        if outcome.error:
            print(_error_text(outcome), file=sys.stderr)
        else:
            _print_outcome(outcome)
    results = {}
    for outcome in outcomes:
        if outcome.patches:
            results[outcome.job.out] = {"patches": outcome.patches}
    write_summary(arguments.summary, "reprocess-summary", {"recordings": results})
    return 2 if any(outcome.error for outcome in outcomes) else 0


def _error_text(outcome: "Outcome") -> str:
    """The error of a job, with the recording where it names no file or option."""
    job = outcome.job
    # An error that names no place is of this recording.
    names_a_file = job.source in outcome.error or job.out in outcome.error
    if names_a_file or outcome.error.startswith("--"):
        return outcome.error
    return f"{job.source}: {outcome.error}"


def _print_outcome(outcome: "Outcome") -> None:
    from sparseskin.nodes.monitor.table import summary_table

    if outcome.was_finished:
        print(f"{outcome.job.out}: computed before, by the same command")
        return
    print(f"{outcome.job.out}:")
    print(summary_table(outcome.job.out, outcome.patches))
    per_minute = size_text(60 * outcome.n_bytes / outcome.seconds)
    size = size_text(outcome.n_bytes)
    print(f"{size} in {outcome.seconds:.1f} s: {per_minute} per minute")


def _jobs(arguments: argparse.Namespace) -> "list[Job]":
    """The jobs that a command line states, checked."""
    from sparseskin.launch.offline.job import Job
    from sparseskin.nodes.recorder.bag.format import FILE_SUFFIX, PART_SUFFIX

    for file in arguments.files:
        if not file.removesuffix(PART_SUFFIX).endswith(FILE_SUFFIX):
            raise SettingsError(f"{file}: no recording ({FILE_SUFFIX})")
        if not Path(file).is_file():
            raise SettingsError(f"{file}: no such file")
    # A wrong node is reported before the first recording is read.
    for text in arguments.set:
        node = text.partition(".")[0]
        if node not in STATIONS:
            hint = did_you_mean(node, STATIONS)
            raise SettingsError(f"--set {text}: unknown node '{node}'{hint}")
    # Named as the recording, whole or not.
    names = [Path(file).name.removesuffix(PART_SUFFIX) for file in arguments.files]
    outs = bag_names(names, arguments.out)
    changes = tuple(arguments.set)
    start_from = arguments.start_from
    pairs = zip(arguments.files, outs, strict=True)
    return [Job(file, out, changes, start_from) for file, out in pairs]


def _outcomes(jobs: "Sequence[Job]", executor: str | None) -> "list[Outcome]":
    from tqdm import tqdm

    from sparseskin.launch.offline.job import Outcome, run_job
    from sparseskin.nodes.tasks import computed

    lively = sys.stderr.isatty()
    # One after the other, with a bar for each.
    if executor is None:
        return [run_job(job, lively) for job in jobs]
    outcome_of: dict[Job, Outcome] = {}
    with (
        # Closed at an error, too: no job is left behind.
        closing(computed(executor, run_job, {job: job for job in jobs})) as finished,
        tqdm(
            total=len(jobs),
            disable=not lively,
            unit="recording",
        ) as bar,
    ):
        for job, future in finished:
            try:
                outcome_of[job] = future.result()
            except Exception as error:
                # Its worker died.
                outcome_of[job] = Outcome(job, {}, one_line(error))
            bar.update()
    return [outcome_of[job] for job in jobs]
