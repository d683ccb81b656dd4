"""Contacts as other tools take them."""

import numpy as np
import pytest
from bags import skin_state

from sparseskin.messages import Contacts
from sparseskin.plugins.bridges.contacts import STATE, shapes, state, state_names, wrench


def made(totals, trusted=True, **more):
    """Contacts at rows 0, 1, ... of column 2."""
    n = len(totals)
    total = np.array(totals, np.float32)
    centre = np.stack([np.arange(n), np.full(n, 2)], axis=1).astype(np.float32)
    return Contacts(
        **{"stamp_ns": 0, "patch": "skin", "done_ns": 0, "trusted": trusted},
        id=np.arange(1, n + 1, dtype=np.int32),
        area=np.full(n, 9, np.int32),
        **dict.fromkeys(("total", "total_sd", "peak", "age_s"), total),
        **dict.fromkeys(("centre", "centre_sd", "velocity"), centre),
        **dict.fromkeys(("over", "sliding"), np.zeros(n, np.bool_)),
        **more,
    )


def test_a_wrench_is_the_sum_of_forces_into_the_skin_and_of_their_torques():
    places = np.array([[1000, 0, 0], [0, 2000, 0]], np.float32)
    force, torque = wrench(made([2.0, 3.0], place_mm=places))
    assert force.tolist() == [0, 0, -5]  # of a flat skin, whose z axis points outwards
    assert torque.tolist() == [2 * -3, 1 * 2, 0]
    normals = np.array([[1, 0, 0], [0, 0, -1]], np.float32)
    force, torque = wrench(made([2.0, 3.0], place_mm=places, normal=normals))
    assert force.tolist() == [-2, 0, 3]
    assert torque.tolist() == [6, 0, 0]
    assert not np.any(wrench(made([])))


def test_shapes_point_at_contacts_on_points_along_the_force():
    points = np.zeros((34, 6), np.float32)
    points[:, 0], points[:, 5] = np.linspace(0, 0.5, 34), 1
    skin = skin_state(points=points, pitch_m=0.01)
    normal = np.array([[0, 1, 0]], np.float32)
    (one,) = shapes(made([5.0], place_mm=np.full((1, 3), 30, np.float32), normal=normal), skin)
    assert one.centre == pytest.approx([0.03, 0.03, 0.03])
    assert one.tail - one.centre == pytest.approx([0, 0.5 * 5 / 25, 0])  # as long as the skin: 25 N
    assert one.diameter == pytest.approx(0.03)


def test_the_state_has_the_strongest_contacts_first_and_zeros_where_there_are_fewer():
    names = state_names("palm", 2)
    assert names[:2] == ["palm.trusted", "palm.contact_1.total"]
    places = np.arange(9, dtype=np.float32).reshape(3, 3)
    mm2 = np.array([7, 8, 9], np.float32)
    three = made([1, 4, 3], place_mm=places, velocity_mm_s=-places, area_mm2=mm2)
    found = dict(zip(names, state(three, 2).tolist(), strict=True))
    at = {name: found[f"palm.contact_1.{name}"] for name in ("total", "x", "y_velocity", "area")}
    assert at == {"total": 4, "x": 3, "y_velocity": -4, "area": 8}
    assert found["palm.contact_2.total"] == 3
    one = state(made([6.0], trusted=False), 2)
    assert one[: 1 + len(STATE)].tolist() == [0, 6, 6, 2, 0, 0, 2, 0, 0, 9, 6]  # taxels
    assert not one[1 + len(STATE) :].any()
