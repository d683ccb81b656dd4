"""The command `sparseskin design`: what a skin would deliver, before it is built."""

from __future__ import annotations

import argparse
from importlib.util import find_spec
from pathlib import Path

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import nearest_of
from sparseskin.nodes.sensor.files.recording import shown
from sparseskin.studies.command import EXTRA

from .simulation import FEW_SCENES, N_SCENES
from .spec import KEYS, SIZE_KEYS, Design, make_design, read_file


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `design`."""
    parser.description = (
        "Compare ways to read a skin that is not built yet: wires, rate and its limit, bytes,\n"
        "accuracy, latency, cores. State it by options, by a file with the same keys, or by both:\n"
        "options replace what the file states."
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("file", metavar="design.toml", nargs="?", type=Path, help="file of keys")
    for name, key in KEYS.items():
        default = "" if key.default is None else f" (default: {key.default})"
        about = f"{key.about}{default}"
        parser.add_argument(f"--{name}", metavar=key.form, help=about)
    about = "write a page, a chart and tables here; needs the extra charts"
    parser.add_argument("--out", metavar="DIR", type=Path, help=about)
    about = "strategies of the table, with commas between them (default: all)"
    parser.add_argument("--only", metavar="NAMES", help=about)
    about = "what presses the simulated skin: a body, or a recording of true forces (default: all)"
    parser.add_argument("--scene", metavar="SCENE", help=about)
    about = f"simulated scenes, 2..{N_SCENES}: more take longer (default: {FEW_SCENES})"
    parser.add_argument("--scenes", metavar="K", default=str(FEW_SCENES), help=about)
    about = "seed of scenes, noise and Phi (default: 0)"
    parser.add_argument("--seed", metavar="K", default="0", help=about)
    about = "no figures of accuracy: nothing is simulated"
    parser.add_argument("--no-accuracy", action="store_true", help=about)
    about = "print what the models predict for rigs that were built, and exit"
    parser.add_argument("--rigs", action="store_true", help=about)
    parser.set_defaults(run=_design)


def _design(arguments: argparse.Namespace) -> int:
    from . import text
    from .budget import budget

    if arguments.rigs:
        _refuse_others(arguments)
        print(text.rig_table())
        return 0
    design = design_of(arguments)
    if arguments.out is not None:
        check_out(arguments.out)
    seed = _number("--seed", arguments.seed)
    n_scenes = _number("--scenes", arguments.scenes)
    if not 2 <= n_scenes <= N_SCENES:
        raise SettingsError(f"--scenes: {n_scenes}: allowed: 2..{N_SCENES}")
    rows = budget(design, _names(arguments.only))
    if not arguments.no_accuracy:
        from .accuracy import simulated

        rows = simulated(rows, design, seed, scene=arguments.scene, n_scenes=n_scenes)
    print(text.terminal(rows, design))
    if arguments.out is not None:
        from .page import write_page

        print()
        print(write_page(arguments.out, rows, design))
    return 0


def design_of(arguments: argparse.Namespace) -> Design:
    """The design that options and file state; SettingsError has a line for each that is wrong."""
    options = {key: value for key in KEYS if (value := getattr(arguments, key)) is not None}
    stated = {} if arguments.file is None else read_file(arguments.file)
    if any(key in options for key in SIZE_KEYS):
        stated = {key: value for key, value in stated.items() if key not in SIZE_KEYS}

    def place(key: str) -> str:
        if key in options or key not in stated:
            return f"--{key}: "
        return f"{arguments.file}: {key if key in KEYS else shown(key)}: "

    return make_design({**stated, **options}, place)


def check_out(out: Path) -> None:
    """Make the folder of a page, or raise SettingsError."""
    absent = [package for package in EXTRA if find_spec(package) is None]
    if absent:
        missing = f"{', '.join(absent)} {'is' if len(absent) == 1 else 'are'} not installed"
        raise SettingsError(f"--out: {missing}: pip install 'sparseskin[charts]'")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"--out {out}: {error.strerror}") from error


def _refuse_others(arguments: argparse.Namespace) -> None:
    given: list[str] = [f"--{key}" for key in KEYS if getattr(arguments, key) is not None]
    given += [f"--{key}" for key in ("out", "scene", "only") if getattr(arguments, key)]
    given += [str(arguments.file)] if arguments.file else []
    if given:
        raise SettingsError(f"--rigs: stands alone; leave out {given[0]}")


def _names(text: str | None) -> list[str] | None:
    """Names of strategies that --only states; SettingsError if one is not known."""
    from .strategies import STRATEGIES

    if text is None:
        return None
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in STRATEGIES:
            hint = nearest_of(name, STRATEGIES)
            raise SettingsError(f"--only: strategy {name[:40]!r} is not known{hint}")
    return names


def _number(option: str, text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise SettingsError(f"{option}: {text[:20]!r}: expected a whole number, 0 or more")
    return int(text)
