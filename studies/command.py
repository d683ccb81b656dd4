"""The command `sparseskin study`: tables and charts, computed anew."""

from __future__ import annotations

import argparse
import math
import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sparseskin.launch.executors import FORMS
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.fast import ENVIRONMENT
from sparseskin.nodes.lookup import did_you_mean, find_callable

#: By name: what it is, and its run(out, quick, seed, executor), imported when it is asked for.
STUDIES = {
    "paper-tables": (
        "tables I to IV and the figures of the paper, beside ours",
        "sparseskin.studies.paper_tables:run",
    ),
    "speed-accuracy": (
        "solve time and bytes against PSNR: solvers, bases, Phi, and other libraries",
        "sparseskin.studies.speed_accuracy:run",
    ),
    "stability": (
        "where integrators of a contact hold and where they blow up",
        "sparseskin.studies.stability:run",
    ),
    "scene-needs": (
        "what a scene has to model for its tables to come out",
        "sparseskin.studies.scene_needs:run",
    ),
    "operators": (
        "time of Phi, Psi and whole solvers beside the least there can be, and other libraries",
        "sparseskin.studies.operators:run",
    ),
    "targets": (
        "the default solver against the paper's and the full reading; what each part of it earns",
        "sparseskin.studies.targets:run",
    ),
    "bases": (
        "in which basis forces are sparse: D2, D4 and others, learned ones; adaptive sampling",
        "sparseskin.studies.bases:run",
    ),
    "endurance": (
        "the default solver over a million frames: nothing grows, drifts or locks in",
        "sparseskin.studies.endurance:run",
    ),
    "latency": (
        "from acquisition to reconstruction at 1 kHz, and where the time goes",
        "sparseskin.studies.latency:run",
    ),
    "soak": (
        "a graph that runs for long: memory, open files, lost frames",
        "sparseskin.studies.soak:run",
    ),
    "fuzz": (
        "hostile messages on the sockets of nodes that run, and mutated launch files",
        "sparseskin.studies.fuzz:run",
    ),
    "faults": (
        "what a graph does when something breaks: what is lost, how soon it recovers",
        "sparseskin.studies.faults:run",
    ),
}
#: Those whose figures are of numpy alone where nothing else is said, with numba installed or not.
OF_NUMPY = ("paper-tables", "speed-accuracy", "stability", "targets", "bases")


def add_study_parser(commands: Any) -> None:
    """Add `study` to the commands."""
    parser = commands.add_parser(
        "study",
        help="compute tables and charts anew",
        description="Compute the tables and charts of a study. A run that was interrupted goes "
        "on where it was.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="\n".join(f"{name:<15} {what}" for name, (what, _) in STUDIES.items()),
    )
    parser.add_argument("name", metavar="STUDY", help=f"study: {', '.join(STUDIES)}")
    parser.add_argument(
        "--quick", action="store_true", help="fewer frames and points: to see that it runs"
    )
    parser.add_argument(
        "--out", metavar="DIR", type=Path, help="folder to write to (default: out/NAME)"
    )
    parser.add_argument(
        "--executor",
        metavar="HOW",
        default=f"process:{len(os.sched_getaffinity(0))}",
        help=f"where points are computed: {FORMS} (default: %(default)s)",
    )
    parser.add_argument(
        "--recordings", metavar="DIR", type=Path, help="targets: folder of real skins' recordings"
    )
    parser.add_argument(
        "--minutes", metavar="T", type=_minutes, help="soak: how long the graph runs (default: 30)"
    )
    parser.add_argument(
        "--anew", action="store_true", help="forget what earlier runs have computed"
    )
    parser.add_argument("--seed", type=_seed, default=0, help="seed of noise and Phi (default: 0)")
    parser.set_defaults(run=_study)


def _seed(text: str) -> int:
    if not text.isdecimal() or int(text) >= 2**32:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a whole number, 0 or more")
    return int(text)


def _minutes(text: str) -> float:
    try:
        minutes = float(text)
    except ValueError:
        minutes = math.nan
    if not 0.1 <= minutes <= 100_000:
        raise argparse.ArgumentTypeError(f"{text!r}: expected minutes, 0.1..100000")
    return minutes


def _study(arguments: argparse.Namespace) -> int:
    name: str = arguments.name
    if name not in STUDIES:
        raise SettingsError(f"study {name!r} is not known{did_you_mean(name, STUDIES)}")
    if find_spec("matplotlib") is None:
        raise SettingsError("studies draw charts with matplotlib: pip install 'sparseskin[charts]'")
    out: Path = arguments.out or Path("out") / (f"{name}-quick" if arguments.quick else name)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"--out {out}: {error.strerror}") from error
    if name in OF_NUMPY:
        os.environ.setdefault(ENVIRONMENT, "off")
    run = find_callable(STUDIES[name][1], SettingsError)
    more = {}
    if arguments.recordings is not None:
        if name != "targets":
            raise SettingsError(f"--recordings: study {name!r} takes none; allowed: targets")
        more["recordings"] = arguments.recordings
    if arguments.minutes is not None:
        if name != "soak":
            raise SettingsError(f"--minutes: study {name!r} takes none; allowed: soak")
        more["minutes"] = arguments.minutes
    if arguments.anew:
        from .points import forget

        forget(out)
    run(out=out, quick=arguments.quick, seed=arguments.seed, executor=arguments.executor, **more)
    print(out / f"{name}.md")
    return 0
