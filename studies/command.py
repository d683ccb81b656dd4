"""The command `sparseskin study`: tables and charts, computed anew."""

from __future__ import annotations

import argparse
import contextlib
import os
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import find_callable, nearest_of
from sparseskin.nodes.numerics.compiled import ENVIRONMENT
from sparseskin.nodes.tasks.executors import FORMS


@dataclass(frozen=True)
class Study:
    """A study by name, imported when it is run.

    Attributes
    ----------
    summary : str
    options : tuple of str
        Options that it takes beside those of all studies.
    numpy_only : bool
        True if its figures are of numpy alone where nothing else is set, with numba installed
        or not.
    target : str
        "module:callable" of the study, run(out, quick, seed, executor, **options); by default
        `run` in the module `study` of the folder of its name. It computes the points that are not
        saved yet with an `executor` (as `points.compute` takes it) and writes page, tables and
        charts into the existing folder `out`; `quick`: fewer frames and points; `seed`: of noise
        and Phi. It raises StudyError if a point fails or a file cannot be written.
    """

    summary: str
    options: tuple[str, ...] = ()
    numpy_only: bool = False
    target: str = ""


STUDIES = {
    "paper-tables": Study(
        "tables I to IV and the figures of the paper, beside ours", numpy_only=True
    ),
    "speed-accuracy": Study(
        "solve time and bytes against PSNR: solvers, bases, Phi, and other libraries",
        numpy_only=True,
    ),
    "stability": Study(
        "stable and unstable step sizes, contact parameters and settings of solvers",
        numpy_only=True,
    ),
    "scene-needs": Study("which degrees of freedom and terms each scene needs"),
    "operators": Study(
        "time of Phi, Psi and whole solvers beside the lower bound, and other libraries"
    ),
    "targets": Study(
        "the default solver against the paper's and the full reading; effect of each part",
        options=("recordings",),
        numpy_only=True,
    ),
    "rates": Study(
        "gain of the default solver by the frame rate, beside filters of the full reading",
        numpy_only=True,
    ),
    "moving": Study(
        "bodies that move a quarter of a taxel a frame, ramps and sudden contacts",
        numpy_only=True,
    ),
    "real": Study(
        "the default solver on recordings of real skins, beside what a user would try first",
        options=("recordings", "seeds"),
        numpy_only=True,
    ),
    "wiring": Study(
        "PSNR against the length of wires, from local to scrambled sums; circuits of row sums",
        numpy_only=True,
    ),
    "layouts": Study(
        "skins of points beside the grid, and beside other ways to put points on a grid"
    ),
    "bases": Study(
        "in which basis forces are sparse: D2, D4 and others, learned ones; adaptive sampling",
        numpy_only=True,
    ),
    "endurance": Study(
        "the default solver over a million frames: memory, drift, recovery after changes"
    ),
    "bridges": Study("what bridges to other tools cost, and cost the graph beside them"),
    "latency": Study("time from acquisition to reconstruction at 1 kHz, by stage"),
    "scale": Study(
        "a body of 1 to 244 patches: time, memory, idle patches, and the rate that is held live"
    ),
    "slices": Study(
        "how long the warm-up of a slice of a recording has to be", options=("recordings",)
    ),
    "soak": Study("a long run: memory, open files, lost frames", options=("minutes",)),
    "fuzz": Study("hostile messages on the sockets of nodes that run, and mutated launch files"),
    "faults": Study("a graph under faults: frames lost, and time to recover"),
    "attacks": Study(
        "a graph under half-open connections, open pages and commands in a loop",
        options=("minutes",),
    ),
}
#: Packages of the extra `charts`, which each study needs.
EXTRA = ("matplotlib", "jinja2", "pandas")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `study`."""
    parser.description = (
        "Compute the tables and charts of a study. A run that was interrupted continues\n"
        "where it was."
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "\n".join(f"{name:<15} {study.summary}" for name, study in STUDIES.items())
    name = parser.add_argument("name", metavar="STUDY", help=f"study: {', '.join(STUDIES)}")
    # Read by argcomplete: candidates for the word, and what each means.
    name.completer = lambda **_: {  # type: ignore[attr-defined]
        known: study.summary for known, study in STUDIES.items()
    }
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
        "--recordings",
        metavar="DIR",
        type=Path,
        help="real, targets: folder of real skins' recordings",
    )
    parser.add_argument(
        "--minutes",
        metavar="T",
        type=_minutes,
        help="how long the graph of soak runs (default: 30), the commands of attacks (60)",
    )
    parser.add_argument("--anew", action="store_true", help="delete the points of earlier runs")
    parser.add_argument("--seed", type=_seed, default=0, help="seed of noise and Phi (default: 0)")
    parser.add_argument(
        "--seeds",
        metavar="K",
        type=_count,
        help="real: number of seeds, from --seed on (default: 1)",
    )
    parser.set_defaults(run=_study)


def target_of(name: str) -> str:
    """Return what runs a study, as "module:callable"."""
    return STUDIES[name].target or f"sparseskin.studies.{name.replace('-', '_')}.study:run"


def _seed(text: str) -> int:
    if not text.isdecimal() or int(text) >= 2**32:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a whole number, 0 or more")
    return int(text)


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 1000:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a whole number, 1..1000")
    return int(text)


def _minutes(text: str) -> float:
    with contextlib.suppress(ValueError):
        if 0.1 <= float(text) <= 100_000:
            return float(text)
    raise argparse.ArgumentTypeError(f"{text!r}: expected minutes, 0.1..100000")


def _study(arguments: argparse.Namespace) -> int:
    name: str = arguments.name
    if name not in STUDIES:
        raise SettingsError(f"study {name!r} is not known{nearest_of(name, STUDIES)}")
    study = STUDIES[name]
    absent = [package for package in EXTRA if find_spec(package) is None]
    if absent:
        missing = f"{', '.join(absent)} {'is' if len(absent) == 1 else 'are'} not installed"
        raise SettingsError(f"study {name}: {missing}: pip install 'sparseskin[charts]'")
    options = {}
    for option in ("recordings", "minutes", "seeds"):
        value = getattr(arguments, option)
        if value is None:
            continue
        if option not in study.options:
            takers = ", ".join(known for known in STUDIES if option in STUDIES[known].options)
            raise SettingsError(f"--{option}: study {name!r} takes none; allowed: {takers}")
        options[option] = value
    out: Path = arguments.out or Path("out") / (f"{name}-quick" if arguments.quick else name)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"--out {out}: {error.strerror}") from error
    if study.numpy_only:
        os.environ.setdefault(ENVIRONMENT, "off")
    run = find_callable(target_of(name), SettingsError)
    if arguments.anew:
        from .points import forget

        forget(out)
    run(out=out, quick=arguments.quick, seed=arguments.seed, executor=arguments.executor, **options)
    print(out / f"{name}.md")
    return 0
