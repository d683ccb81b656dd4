"""Contacts as other tools take them: a wrench, shapes in space, rows of numbers, a vector of fixed
length.

The force of a contact on the skin acts against the outward normal: that of the points' file, or, of
a flat skin, whose x runs along the columns and y along the rows, the z axis.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from sparseskin.messages import Contacts, SkinState
from sparseskin.nodes.numerics.arrays import Doubles, Floats

from .base import UNKNOWN_PITCH_M

FULL = 10.0
"""Total force of a contact, in ranges of a taxel, whose arrow is as long as the skin. Chosen."""
STATE = (
    "total",
    "total_sd",
    "x",
    "y",
    "z",
    "x_velocity",
    "y_velocity",
    "z_velocity",
    "area",
    "age_s",
)
"""Numbers of a contact in the state of a policy: force and its deviation, in the skin's unit; place
and its velocity, mm; area, mm2; where no pitch is known, taxels; time since the begin, seconds."""
N_STATE = 4
"""Contacts in the state by default."""
COLOURS = {True: (0.15, 0.55, 1.0, 0.8), False: (1.0, 0.55, 0.0, 0.8)}
"""Red, green, blue and opacity of contacts by whether their frame is trusted."""


class Shape(NamedTuple):
    """A contact in space, metres: a sphere at its centre with that diameter, as wide as a square of
    its area, and an arrow that ends there, along the force and as long as the force is large.
    """

    id: int
    centre: Doubles
    tail: Doubles
    diameter: float
    text: str


def places(contacts: Contacts) -> tuple[Doubles, Doubles]:
    """Centres in metres and outward unit normals of contacts, float64 (n, 3) each."""
    if contacts.place_mm is not None:
        centres = contacts.place_mm / 1e3
    else:
        # Without a pitch, places are in taxels.
        centres = UNKNOWN_PITCH_M * _in_plane(contacts.centre)
    normals = contacts.normal
    if normals is None:
        # A flat skin lies in the plane of x and y.
        normals = np.tile(np.array([0, 0, 1], np.float32), (len(centres), 1))
    return centres.astype(np.float64), normals.astype(np.float64)


def wrench(contacts: Contacts) -> tuple[Doubles, Doubles]:
    """Sum of the forces of all contacts on the skin, in its unit, and of their torques about the
    origin, that times metres; float64 (3,) each.
    """
    centres, normals = places(contacts)
    # A body presses into the skin, against the outward normal.
    forces = -contacts.total[:, None] * normals
    return forces.sum(axis=0), np.cross(centres, forces).sum(axis=0)


def shapes(contacts: Contacts, skin: SkinState) -> list[Shape]:
    """What is drawn of each contact."""
    centres, normals = places(contacts)
    if skin.points is None:
        side = skin.pitch_m or UNKNOWN_PITCH_M
        extent = side * max(skin.n_rows, skin.n_cols)
    else:
        extent = float(np.ptp(skin.points[:, :3], axis=0).max())
        side = skin.pitch_m or extent / math.sqrt(len(skin.points))

    # Arrows are scaled by the skin, so that they fit to it whatever its size is.
    lengths = contacts.total * (extent / (FULL * skin.f_max))
    tails = centres + lengths[:, None] * normals
    drawn = []
    for k, number in enumerate(contacts.id.tolist()):
        # The area counts taxels of one pitch squared each.
        diameter = side * math.sqrt(contacts.area[k])
        text = f"{number}: {contacts.total[k]:.3g} {skin.unit}"
        drawn.append(Shape(number, centres[k], tails[k], diameter, text))
    return drawn


def numbers(contacts: Contacts) -> dict[str, Floats]:
    """Columns of a table with a row for each contact, float32 (n,); what is not known is NaN."""
    columns = contacts.columns()
    # float32 cannot hold a time in nanoseconds.
    del columns["stamp_ns"]
    return {name: values.astype(np.float32) for name, values in columns.items()}


def as_json(contacts: Contacts) -> dict[str, Any]:
    """Sum of the forces, number of contacts, those numbers of each that are known, and events."""
    columns = contacts.columns()
    names = [name for name in columns if name not in ("stamp_ns", "trusted")]
    rows = zip(*(columns[name].tolist() for name in names), strict=True)
    entries = []
    for row in rows:
        # JSON has no NaN, by which numbers that are not known are marked.
        entries.append({name: v for name, v in zip(names, row, strict=True) if v == v})

    # Events name contacts that may have ended, and have no entry.
    events = [{"id": number, "event": event} for number, event in contacts.named_events]
    return {
        "n": contacts.id.size,
        "total": float(contacts.total.sum()),
        "trusted": contacts.trusted[0],
        "contacts": entries,
        "events": events,
    }


def json_schema(contacts: Contacts) -> dict[str, Any]:
    """JSON Schema of `as_json`."""
    number = {"type": "number"}
    flag = {"type": "boolean"}
    text = {"type": "string"}
    contact = dict.fromkeys(contacts.columns(), number) | {
        "over": flag,
        "sliding": flag,
    }

    def rows(properties: dict[str, Any]) -> dict[str, Any]:
        return {"type": "array", "items": {"type": "object", "properties": properties}}

    properties = {
        "n": number,
        "total": number,
        "trusted": flag,
        "contacts": rows(contact),
        "events": rows({"id": number, "event": text}),
    }
    return {
        "type": "object",
        "title": "sparseskin.Contacts",
        "properties": properties,
    }


def state_names(patch: str, k: int) -> list[str]:
    """Names of the numbers of `state`."""
    ranks = range(1, k + 1)
    names = [f"{patch}.contact_{place}.{name}" for place in ranks for name in STATE]
    return [f"{patch}.trusted", *names]


def state(contacts: Contacts, k: int) -> Floats:
    """1 if the frame is trusted, then the numbers `STATE` of each of the k contacts of the largest
    forces, the largest first; zeros where there are fewer. float32 (1 + k * len(STATE),).
    """
    # In taxels where no pitch is known.
    place = contacts.place_mm
    if place is None:
        place = _in_plane(contacts.centre)
    velocity = contacts.velocity_mm_s
    if velocity is None:
        velocity = _in_plane(contacts.velocity)
    area: Any = contacts.area_mm2
    if area is None:
        area = contacts.area
    columns = [contacts.total, contacts.total_sd, place, velocity, area, contacts.age_s]
    table = np.column_stack(columns)

    order = np.argsort(-contacts.total, kind="stable")
    # A policy reads the same place for the strongest contact in each frame.
    strongest = table[order[:k]].ravel()
    vector = np.zeros(1 + k * len(STATE), np.float32)
    vector[0] = contacts.trusted[0]
    vector[1 : 1 + strongest.size] = strongest
    return vector


def _in_plane(values: Floats) -> Floats:
    """x, y and z = 0 of rows and columns, (n, 2)."""
    return np.column_stack([values[:, ::-1], np.zeros(len(values), np.float32)])
