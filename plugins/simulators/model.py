"""MuJoCo models with a skin: the address of a source, and what a model must have."""

from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.messages.fields import MAX_SIDE
from sparseskin.messages.ranges import is_real
from sparseskin.nodes.errors import SourceError, not_installed
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.process.isolation import output_of
from sparseskin.nodes.sensor.layout.arrangement import check_grid, check_stated_shape
from sparseskin.nodes.sensor.scenes.scenes import SKIN

MUJOCO = "mujoco:"
FORM = "mujoco:MODEL.xml#SITE"
INSTALL = not_installed("mujoco", "mujoco")
SUFFIXES = (".xml", ".mjb")
LEAST_STEP_S = 1e-6
LONGEST_STEP_S = 0.1
"""Allowed time step of a model, seconds; chosen: a shorter one takes hours for a second, a longer
one passes through a skin."""
MAX_DEPTH_M = 0.02
"""Deepest penetration that is read by default, metres; deeper bodies read it. Chosen: four pitches
of 5 mm; a force of 2.5 N, the range, is one of 20.5 mm."""
_WHOLE = 0.02
"""Allowed distance of the number of taxels of a side from a whole one; chosen."""


@dataclass(frozen=True)
class Pad:
    """A skin in a model: a box site, whose face at its largest z is the plane of the taxels.

    Ids of site and body; rows and columns along the site's y and x, taxel (0, 0) at the smallest x
    and y; pitch in m, k in N/m and c in N s/m of each taxel, deepest penetration read, in m; height
    of the plane over the middle of the site, in m.
    """

    site: int
    body: int
    shape: tuple[int, int]
    pitch_m: float
    stiffness: float
    damping: float
    depth_m: float
    top_m: float


def split_address(source: str) -> tuple[str, str]:
    """Path and site of an address; SourceError if a part is missing."""
    path, mark, site = source.removeprefix(MUJOCO).rpartition("#")
    if not (path and mark and site):
        raise SourceError(
            f"{source}: expected {FORM}, with the name of a box site of the model"
        )
    return path, site


def check_model(source: str, n_rows: int | None, n_cols: int | None) -> int:
    """Check a source by loading its model and computing its first state, in a process whose time
    and memory are bounded; the number of taxels. Raises SourceError if MuJoCo is not installed, the
    file is missing or refused by it, has no such box site, no geom can touch it, its number of
    taxels is not allowed or not the one that is stated, or the process fails or takes too long.
    """
    path, site = split_address(source)
    file = Path(path)
    if not file.is_file():
        fault = "is a folder" if file.is_dir() else "no such file"
        raise SourceError(f"{path}: {fault}")
    if file.suffix.lower() not in SUFFIXES:
        raise SourceError(f"{path}: expected a MuJoCo model, {' or '.join(SUFFIXES)}")
    if find_spec("mujoco") is None:
        raise SourceError(f"{path}: {INSTALL}")

    # A file that was written again is checked again.
    state = file.stat()
    shape = _shape(path, site, (state.st_mtime_ns, state.st_size))
    check_stated_shape(*shape, n_rows, n_cols, source)
    return shape[0] * shape[1]


def shape_in_child(address: str, n_bytes: int) -> tuple[int, int]:
    """Rows and columns of the skin MODEL#SITE, of a file of `n_bytes`, by a child: a short model
    may take any time and memory. Raises SourceError.
    """
    output = output_of(f"{__package__}.source", address, n_bytes=n_bytes)
    n_rows, n_cols = map(int, output.split()[-2:])
    return n_rows, n_cols


@lru_cache(maxsize=8)
def _shape(path: str, site: str, version: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns, of one form of the file: its time and size."""
    return shape_in_child(f"{path}#{site}", version[1])


def load_model(path: str) -> Any:
    """Load a model; SourceError in one line if MuJoCo is not installed or refuses it."""
    try:
        import mujoco
    except ImportError as error:
        raise SourceError(f"{path}: {INSTALL}") from error
    # Without it, a warning is written to MUJOCO_LOG.TXT in the folder of the user.
    mujoco.set_mju_user_warning(lambda text: None)
    load = mujoco.MjModel.from_xml_path
    if path.lower().endswith(".mjb"):
        load = mujoco.MjModel.from_binary_path
    try:
        model = load(path)
    except Exception as error:
        # MuJoCo has errors of its own, and raises ValueError.
        text = " ".join(str(error).split())
        raise SourceError(f"{path}: MuJoCo refuses it: {text[:300]}") from error
    step_s = float(model.opt.timestep)
    if not LEAST_STEP_S <= step_s <= LONGEST_STEP_S:
        raise SourceError(
            f"{path}: a time step of {step_s:g} s; allowed: "
            f"{LEAST_STEP_S:g}..{LONGEST_STEP_S:g} s"
        )
    return model


def find_pad(model: Any, site: str, path: str) -> Pad:
    """The skin at a site; its constants are numerics SITE_pitch_m, SITE_stiffness, SITE_damping and
    SITE_depth_m of the model, else those of the scenes. Raises SourceError if there is no such
    site, it is no box, or a constant or the number of taxels is not allowed.
    """
    import mujoco

    names = [model.site(k).name for k in range(model.nsite)]
    is_box = np.asarray(model.site_type) == mujoco.mjtGeom.mjGEOM_BOX
    boxes = [names[k] for k in np.flatnonzero(is_box)]
    if site not in names:
        hint = did_you_mean(site, boxes) or " (it has no box site)"
        raise SourceError(f"{path}: has no site {site[:80]!r}{hint}")
    if site not in boxes:
        raise SourceError(
            f"{path}: site {site!r} is no box; a skin is the face of a box at its +z"
        )

    def constant(name: str, default: float, low: float, high: float) -> float:
        return _constant(model, path, f"{site}_{name}", default, (low, high))

    k = model.site(site).id
    # Sides of a box site are stated as halves.
    pitch = constant("pitch_m", SKIN.pitch_m, 1e-5, 1.0)
    half_x, half_y, half_z = (float(side) for side in model.site_size[k])
    sides = (2 * half_y / pitch, 2 * half_x / pitch)
    shape = (round(sides[0]), round(sides[1]))
    for axis, side, n_taxels in zip(("y", "x"), sides, shape, strict=True):
        if not (1 <= n_taxels <= MAX_SIDE and abs(side - n_taxels) <= _WHOLE):
            raise SourceError(
                f"{path}: site {site!r} has {side:.2f} taxels of {1000 * pitch:g} mm along {axis}; "
                f"allowed is a whole number in 1..{MAX_SIDE} (size, or numeric {site}_pitch_m)"
            )
    check_grid(*shape, path)

    return Pad(
        site=k,
        body=int(model.site_bodyid[k]),
        shape=shape,
        pitch_m=pitch,
        stiffness=constant("stiffness", SKIN.stiffness, 1e-6, 1e9),
        damping=constant("damping", SKIN.damping, 0.0, 1e9),
        depth_m=constant("depth_m", MAX_DEPTH_M, 1e-5, 1.0),
        top_m=half_z,
    )


def _constant(
    model: Any, path: str, numeric: str, default: float, bounds: tuple[float, float]
) -> float:
    """The number of a numeric of the model, or the default where it has none of this name."""
    # MuJoCo raises KeyError with all names where there is none of this one.
    numerics = [model.numeric(i).name for i in range(model.nnumeric)]
    if numeric not in numerics:
        return default
    data = np.ravel(model.numeric(numeric).data)
    value = np.nan
    if data.size == 1:
        value = float(data[0])
    low, high = bounds
    if not is_real(value, low, high):
        raise SourceError(
            f"{path}: numeric {numeric!r}: expected one number in {low:g}..{high:g}"
        )
    return value


def touching_geoms(model: Any, pad: Pad, path: str) -> Any:
    """Ids of the geoms that can touch the skin: those that collide, of bodies not welded to it or
    its parent (which MuJoCo does not let collide either). SourceError if there is none.
    """
    weld = int(model.body_weldid[pad.body])
    # The world is 0: it has no parent of its own.
    parent = 0
    if weld:
        parent = int(model.body_weldid[model.body_parentid[weld]])
    bodies = model.body_weldid[model.geom_bodyid]

    # The world is the parent of all that stands on it, and may still be touched.
    can_move = (bodies != weld) & ((bodies != parent) | (parent == 0))
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    geoms = np.flatnonzero(can_move & collides)
    # Geoms of the world do not move against a skin that is fixed to it.
    if weld == 0:
        geoms = geoms[bodies[geoms] != 0]
    if not geoms.size:
        raise SourceError(
            f"{path}: no geom can touch site {model.site(pad.site).name!r}: expected a geom with "
            "contype or conaffinity on a body that can move against it"
        )
    return geoms


def bears_load(model: Any, pad: Pad) -> bool:
    """True if a geom of the skin's body collides, so that MuJoCo's contact bears the load."""
    on_body = model.geom_bodyid == pad.body
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    return bool(np.any(on_body & collides))
