"""The command `sparseskin study`: tables and charts, computed anew."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sparseskin.launch.commands.options import rare, whole
from sparseskin.nodes.errors import SettingsError, not_installed
from sparseskin.nodes.extensions import STUDIES as GROUP
from sparseskin.nodes.extensions import failures, loaded
from sparseskin.nodes.lookup import find_callable, nearest_of
from sparseskin.nodes.numerics.compiled import ENVIRONMENT
from sparseskin.nodes.tasks import FORMS


@dataclass(frozen=True)
class Study:
    """A study by name, imported when it is run.

    `target` is "module:callable", called as run(out, quick, seed, executor, **options). It computes
    the points that are not saved yet with an `executor` (as `points.compute` takes it) and writes
    page, tables and charts into the existing folder `out`; `quick`: fewer frames and points;
    `seed`: of noise and Phi. It returns its conclusion, lines that are printed, and raises
    StudyError if a point fails or a file cannot be written. `options`: those that it takes beside
    those of all studies; `numpy_only`: True if its figures are of numpy alone, with numba
    installed or not.
    """

    summary: str
    target: str
    options: tuple[str, ...] = ()
    numpy_only: bool = False


STUDIES = {
    "paper-tables": Study(
        "tables I to IV and the figures of the paper, beside ours",
        "sparseskin.studies.paper.tables:run",
        numpy_only=True,
    ),
    "speed-accuracy": Study(
        "solve time and bytes against PSNR: solvers, bases, Phi, and other libraries",
        "sparseskin.studies.speed_accuracy.charts:run",
    ),
    "stability": Study(
        "where solvers fail: too few measurements, extreme settings, drawn loads and faults",
        "sparseskin.studies.stability.tables:run",
        options=("worlds",),
        numpy_only=True,
    ),
    "scene-needs": Study(
        "which degrees of freedom and terms each scene needs",
        "sparseskin.studies.needs:run",
    ),
    "accuracy": Study(
        "recordings, moving bodies and frame rates, beside what a user would try first",
        "sparseskin.studies.accuracy.tables:run",
        options=("recordings", "seeds", "constants", "alone"),
    ),
    "tasks": Study(
        "recognition of shapes from taxels, measurements and forces (extra tasks)",
        "sparseskin.studies.tasks.tables:run",
        options=("data",),
    ),
    "speed": Study(
        "time of solvers, of bodies of many patches, and of a frame by stage",
        "sparseskin.studies.speed.tables:run",
    ),
    "train": Study(
        "weights of solver skin, trained on procedural presses (30 minutes; extras charts, train)",
        "sparseskin.studies.training.train:run",
    ),
}
"""Studies of the core, by name."""


def studies() -> dict[str, Study]:
    """Studies of the core, then those of plug-ins."""
    offers = loaded(GROUP)
    return STUDIES | {name: offers[name] for name in offers if name not in STUDIES}


#: Packages of the extra `charts`, which each study needs.
EXTRA = ("matplotlib", "pandas")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `study`."""
    parser.description = (
        "Compute the tables and charts of a study. A run that was interrupted continues\n"
        "where it was."
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    rare_options = rare(parser)
    summaries = {name: study.summary for name, study in studies().items()}
    lines = [f"{name:<15} {summary}" for name, summary in summaries.items()]
    parser.epilog = "\n".join(lines)
    name = parser.add_argument(
        "name", metavar="STUDY", help=f"study: {', '.join(summaries)}"
    )
    # Read by argcomplete: candidates for the word, and what each means.
    name.completer = lambda **_: summaries  # type: ignore[attr-defined]
    parser.add_argument(
        "--quick",
        action="store_true",
        help="fewer frames and points: to see that it runs",
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="folder to write to (default: out/NAME)",
    )
    rare_options.add_argument(
        "--executor",
        metavar="HOW",
        default=f"process:{len(os.sched_getaffinity(0))}",
        help=f"where points are computed: {FORMS} (default: %(default)s)",
    )
    _add_options_of_studies(rare_options)
    parser.set_defaults(run=_study)


def _add_options_of_studies(rare_options: argparse._ArgumentGroup) -> None:
    """Options that some studies take (`Study.options`), and those that are rarely used."""
    about = "accuracy: folder of recordings of real skins"
    rare_options.add_argument(
        "--recordings",
        metavar="DIR",
        type=Path,
        help=about,
    )
    about = "tasks: folder of frames with labels, STEMNIST or one .npz"
    rare_options.add_argument(
        "--data",
        metavar="DIR",
        type=Path,
        help=about,
    )
    rare_options.add_argument(
        "--anew", action="store_true", help="delete the points of earlier runs"
    )
    about = "seed of noise and Phi (default: 0)"
    rare_options.add_argument(
        "--seed",
        type=whole(0, 2**32 - 1),
        default=0,
        help=about,
    )
    about = "accuracy: number of seeds, from --seed on (default: 1)"
    rare_options.add_argument(
        "--seeds",
        metavar="K",
        type=whole(1, 1000),
        help=about,
    )
    about = "stability: so many drawn worlds of each kind, and no other section"
    rare_options.add_argument(
        "--worlds",
        metavar="K",
        type=whole(1, 1000),
        help=about,
    )
    constants = "constants of the default solver halved and doubled, rules off"
    flags = {
        "--constants": f"accuracy: with --recordings: {constants}",
        "--alone": "accuracy: single frames beside total variation (extra peers)",
    }
    for flag, about in flags.items():
        rare_options.add_argument(
            flag,
            action="store_true",
            default=None,
            help=about,
        )


def _study(arguments: argparse.Namespace) -> int:
    name: str = arguments.name
    by_name = studies()
    if name not in by_name:
        hint = f"{nearest_of(name, by_name)}{failures(GROUP)}"
        raise SettingsError(f"study {name!r} is not known{hint}")
    study = by_name[name]
    _check_packages(name)
    options = _options_of(name, by_name, arguments)

    # A quick run must not stand in the place of a whole one.
    folder = f"{name}-quick" if arguments.quick else name
    out: Path = arguments.out or Path("out") / folder
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"--out {out}: {error.strerror}") from error

    if study.numpy_only:
        os.environ.setdefault(ENVIRONMENT, "off")
    run = find_callable(study.target, SettingsError)
    if arguments.anew:
        from .points import forget

        forget(out)
    for name_of_option in ("quick", "seed", "executor"):
        options[name_of_option] = getattr(arguments, name_of_option)
    for line in run(out=out, **options) or ():
        print(f"- {line}")
    print(out / f"{name}.md")
    return 0


def _check_packages(name: str) -> None:
    """Raise SettingsError if a package that studies need is not installed."""
    absent = [package for package in EXTRA if find_spec(package) is None]
    if absent:
        # One command installs them all.
        raise SettingsError(f"study {name}: {not_installed(absent[0], 'charts')}")


def _options_of(
    name: str, by_name: Mapping[str, Study], arguments: argparse.Namespace
) -> dict[str, Any]:
    """The stated options of a study; raises SettingsError where it does not take one."""
    options: dict[str, Any] = {}
    for option in ("recordings", "data", "seeds", "constants", "alone", "worlds"):
        value = getattr(arguments, option)
        if value is None:
            continue
        if option not in by_name[name].options:
            takers = [study for study in by_name if option in by_name[study].options]
            raise SettingsError(
                f"--{option}: study {name!r} takes none; allowed: {', '.join(takers)}"
            )
        options[option] = value
    return options
