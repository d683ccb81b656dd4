"""Sources by name: a scene, a file, a board, a MuJoCo model, a ROS 2 topic, or a driver."""

from __future__ import annotations

import re
import symtable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import (
    did_you_mean,
    is_missing,
    note_import,
    one_line,
    search_here,
)
from sparseskin.nodes.sensor.files.parsed import (
    DEFAULT_POLICY,
    KEEP,
    REFUSE,
    Policy,
    check_stated_shape,
)
from sparseskin.nodes.sensor.files.recorded import n_taxels, open_file
from sparseskin.nodes.sensor.scenes.scenes import SCENES, check_scene, open_scene
from sparseskin.nodes.sensor.simulators.model import MUJOCO, check_model

from .boards.board import check_board, describe_board, is_board
from .boards.settings import KINDS
from .boards.source import BoardSource
from .driver import DriverSource, open_callable
from .source import Source

SCENE = "scene:"
FILE = "file:"
ROS2 = "ros2:"
FORMS = (
    "scene:NAME, file:PATH, mujoco:MODEL.xml#SITE, serial:DEVICE, udp:PORT, can:CHANNEL, "
    "ros2:/TOPIC or module:callable"
)


def check_source(
    source: str,
    n_rows: int | None = None,
    n_cols: int | None = None,
    unit: str | None = None,
    policy: Policy = DEFAULT_POLICY,
    f_max: float | None = None,
    on_points: bool = False,
) -> None:
    """Check that a source exists, without opening it; of a file the begin is read.

    `on_points` is True for a skin of points, which has scenes of its own.

    Raises
    ------
    SourceError
        If it has none of these forms, the scene is unknown, a board's settings or device are wrong,
        the file is missing, of an unknown format or refused by `n_taxels`, the model is refused by
        `check_model`, or the module of the driver is missing.
    """
    kind, colon, rest = source.partition(":")
    if not (kind and colon and rest):
        hint = f' (did you mean "{SCENE}{source}"?)' if source in SCENES else ""
        raise SourceError(f'source "{source}": expected {FORMS}{hint}')
    if source.startswith(SCENE):
        _check_scene(rest, on_points)
    elif source.startswith(ROS2):
        from sparseskin.nodes.bridges.ros2_source import check

        check(source)
    elif is_board(source):
        board = describe_board(source, n_rows=n_rows, n_cols=n_cols, unit=unit, f_max=f_max)
        check_board(board)
    elif source.startswith(MUJOCO):
        check_model(source, n_rows, n_cols)
    elif not source.startswith(FILE):
        check_module(source)
    else:
        n_taxels(rest, n_rows, n_cols, unit, policy)


def _check_scene(name: str, on_points: bool) -> None:
    """Check that a scene exists, and that it is one of a grid, or one on points."""
    if name in SCENES and not on_points:
        return
    # Takes SciPy, which a flat grid does not need.
    from .layouts.scenes import SCENES as ON_POINTS
    from .layouts.scenes import check_point_scene

    if on_points:
        if name in SCENES:
            known = ", ".join(ON_POINTS)
            raise SourceError(f"scene {name} presses a flat grid; allowed on points: {known}")
        check_point_scene(name)
    elif name in ON_POINTS:
        raise SourceError(f"scene {name} presses a skin of points; state points, a file of them")
    else:
        check_scene(name)


def check_module(target: str) -> None:
    """Check that the module of a driver exists and that its source names the callable, without
    importing it; the packages that it is in are imported.

    Raises
    ------
    SourceError
        If it does not.
    """
    module, _, attribute = target.partition(":")
    package = module.rpartition(".")[0]
    note_import(package)
    here = search_here(module)
    found = None
    try:
        found = find_spec(module)
    except ModuleNotFoundError as cause:
        if not is_missing(package, cause) and cause.name != module:
            raise SourceError(f"{target}: importing {package} failed: {one_line(cause)}") from cause
    except (Exception, SystemExit) as cause:
        if package:
            raise SourceError(f"{target}: importing {package} failed: {one_line(cause)}") from cause
    if found is None:
        kinds = ("scene", "file", "mujoco", *KINDS)
        hint = did_you_mean(module, kinds) if len(module) < 8 else ""
        hint = hint if "did you mean" in hint else ""
        raise SourceError(f"{target}: there is no module {module!r}, installed or in {here}{hint}")
    names = _names_of(Path(found.origin)) if found.origin else None
    if names is not None and attribute.partition(".")[0] not in names:
        near = did_you_mean(attribute, names)
        hint = near if "did you mean" in near else "; allowed: a callable of that module"
        raise SourceError(f"{target}: {module} has no {attribute!r}{hint}")


def _names_of(path: Path) -> set[str] | None:
    """Names that the source of a module binds; None where it cannot be read, or binds more than its
    statements show.
    """
    if path.name == "__init__.py":
        return None  # its modules are names of it, too
    try:
        table = symtable.symtable(path.read_bytes(), str(path), "exec")  # type: ignore[arg-type]
        source = path.read_text(encoding="utf-8")
    except (OSError, ValueError, SyntaxError):
        return None
    if re.search(r"import +\*|__getattr__|global|vars\(|setattr|exec\(|__dict__|modules", source):
        return None
    return {
        name.get_name() for name in table.get_symbols() if name.is_assigned() or name.is_imported()
    }


def open_source(
    source: str,
    *,
    seed: int,
    n_rows: int | None = None,
    n_cols: int | None = None,
    unit: str | None = None,
    f_max: float | None = None,
    policy: Policy = DEFAULT_POLICY,
    raw: bool = False,
) -> Source:
    """Open a source.

    Parameters
    ----------
    source : str
        One of the forms in `FORMS`.
    seed : int
        Seed of a scene; not used by files and drivers.
    n_rows, n_cols, unit, f_max
        Properties that a file, board or driver does not state, as in `open_file`, `describe_board`
        and `open_callable`.
    policy : Policy
        What to do with readings of a file that are not finite or below 0.
    raw : bool
        True: readings may have any sign and size, as a calibration converts them.

    Raises
    ------
    SourceError
        If the source is missing or malformed, or a setting contradicts it.
    """
    if raw and policy.negative == REFUSE:
        policy = replace(policy, negative=KEEP)
    if is_board(source):
        board = describe_board(source, n_rows=n_rows, n_cols=n_cols, unit=unit, f_max=f_max)
        return BoardSource(board, raw)
    if source.startswith(FILE):
        path = source.removeprefix(FILE)
        return open_file(path, n_rows=n_rows, n_cols=n_cols, unit=unit, f_max=f_max, policy=policy)
    check_source(source, n_rows, n_cols, unit, policy)
    if source.startswith(SCENE):
        stated = {"n_rows": n_rows, "n_cols": n_cols, "unit": unit, "f_max": f_max}
        for name, value in stated.items():
            if value is not None:
                raise SourceError(f"{source}: {name} = {value} is stated, but a scene has its own")
        return open_scene(source.removeprefix(SCENE), seed=seed)
    if source.startswith(MUJOCO):
        from sparseskin.nodes.sensor.simulators.source import open_mujoco

        return open_mujoco(source, f_max=f_max, n_rows=n_rows, n_cols=n_cols, unit=unit)
    driver = _open_driver(source, f_max, unit, raw)
    try:
        check_stated_shape(*driver.skin.shape, n_rows, n_cols, source)
    except SourceError:
        driver.close()
        raise
    return driver


def _open_driver(source: str, f_max: float | None, unit: str | None, raw: bool) -> DriverSource:
    if source.startswith(ROS2):
        from sparseskin.nodes.bridges.ros2_source import frames

        return DriverSource(source, frames(source), f_max=f_max, unit=unit, rate_hz=None, raw=raw)
    return open_callable(source, f_max=f_max, unit=unit, raw=raw)
