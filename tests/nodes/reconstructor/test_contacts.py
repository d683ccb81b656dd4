"""Contacts: closed forms of what is found, ids from frame to frame, events, messages, a graph."""

from dataclasses import replace

import numpy as np
import pytest
from bags import chain, skin_state

import sparseskin
from sparseskin.messages import Contacts, decode
from sparseskin.messages.contacts import EVENTS
from sparseskin.messages.wire import received, wire_bytes
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.reconstructor.contact_tracks import (
    NOTHING,
    ContactTracker,
    joined,
)
from sparseskin.nodes.reconstructor.contacts import (
    SD_SCALE,
    Limits,
    components,
    find_contacts,
)
from sparseskin.nodes.reconstructor.estimates.uncertainty import SCALE, Spread
from sparseskin.nodes.reconstructor.settings import ReconstructorSettings

SHAPE = (32, 40)
NOISE_N = 0.0141
PITCH_M = 0.002
DT_NS = 10_000_000


def boxes(*corners, force=0.5, size=(4, 6)):
    """Uniform forces on boxes of 4 x 6 taxels, by their first rows and columns."""
    forces = np.zeros(SHAPE, np.float32)
    for row, col in corners:
        forces[row : row + size[0], col : col + size[1]] = force
    return forces


def state(**changes):
    grid = {"n_rows": SHAPE[0], "n_cols": SHAPE[1], "pitch_m": PITCH_M, "mask": None}
    return skin_state(**{**grid, "sigma_mid": NOISE_N, "sigma_end": NOISE_N, **changes})


UNTOUCHED = Contacts(stamp_ns=0, patch="skin", done_ns=0, **NOTHING)


class Stream:
    """Contacts of frames, 10 ms apart."""

    def __init__(self, limits=None, **changes):
        self.tracker = ContactTracker(state(**changes))
        self.stamp_ns = 0
        self.tracker.limits = limits or Limits()

    def __call__(self, forces, error=None):
        self.stamp_ns += DT_NS
        fields = joined([self.tracker.update(forces, error, self.stamp_ns)])
        checked = Contacts(stamp_ns=self.stamp_ns, patch="skin", done_ns=0, **fields)
        sent = UNTOUCHED.at(self.stamp_ns, 0, (True,), **fields)
        assert decode(*received(wire_bytes(sent))) == checked
        return checked


def test_total_centre_area_and_deviations_of_boxes_are_those_of_their_closed_forms():
    found = find_contacts(boxes((2, 3), (20, 30)), NOISE_N)
    assert found.total.tolist() == [12.0, 12.0]
    assert found.area.tolist() == [24, 24]
    assert found.peak.tolist() == [0.5, 0.5]
    assert found.centre.tolist() == [[3.5, 5.5], [21.5, 32.5]]
    error = SD_SCALE * NOISE_N
    assert found.total_sd == pytest.approx(error * np.sqrt(24))
    rows = np.arange(4) - 1.5
    cols = np.arange(6) - 2.5
    spread = np.sqrt([6 * np.sum(rows**2), 4 * np.sum(cols**2)])
    assert found.centre_sd == pytest.approx(np.tile(error * spread / 12.0, (2, 1)))
    mean = find_contacts(boxes((2, 3)), NOISE_N, is_mean=True)
    assert mean.total_sd == pytest.approx(error * np.sqrt(32 * 40))
    stated = find_contacts(boxes((2, 3)), NOISE_N, sd=np.full(SHAPE, 0.1, np.float32))
    assert stated.total_sd == pytest.approx(SD_SCALE * 0.1 * np.sqrt(24))


def test_deviations_of_forces_make_those_of_a_total_as_the_error_of_the_frame_does():
    forces = np.full(SHAPE, 0.5, np.float32)
    sd = Spread(np.ones(SHAPE, np.bool_)).deviations(forces, NOISE_N)
    by_error = find_contacts(forces, NOISE_N, is_mean=True)
    by_forces = find_contacts(forces, NOISE_N, sd=sd)
    for field in ("total_sd", "centre_sd"):
        expected = SCALE * getattr(by_error, field)
        np.testing.assert_allclose(getattr(by_forces, field), expected, rtol=1e-4)


def test_an_error_that_all_forces_share_adds_to_the_deviation_of_totals_alone():
    forces = boxes((2, 3), (20, 30))
    plain, shared = (
        joined([ContactTracker(state()).update(forces, NOISE_N, DT_NS, common=common)])
        for common in (0.0, 0.1)
    )
    assert shared["total_sd"] == pytest.approx(
        np.hypot(plain["total_sd"], 0.1 * plain["total"])
    )
    np.testing.assert_array_equal(shared["centre_sd"], plain["centre_sd"])


def test_thresholds_have_hysteresis_and_diagonal_neighbours_are_one_contact():
    forces = boxes((2, 3), force=3 * NOISE_N)
    assert not find_contacts(forces, NOISE_N).total.size
    forces[2, 3] = 7 * NOISE_N
    assert find_contacts(forces, NOISE_N).area.tolist() == [24]
    forces[6, 9] = forces[7, 10] = 3 * NOISE_N
    assert find_contacts(forces, NOISE_N).area.tolist() == [26]
    assert not find_contacts(forces, NOISE_N, area=27).total.size
    assert not find_contacts(forces, NOISE_N, force=3.0).total.size
    outside = np.ones(SHAPE, np.bool_)
    outside[2:6, 3:9] = False
    assert not find_contacts(forces, NOISE_N, mask=outside).total.size


def test_bodies_that_slide_keep_their_ids_and_have_their_velocity():
    stream = Stream(Limits(slide=100.0))
    seen = [stream(boxes((2, 2 + k), (24, 30 - k))) for k in range(20)]
    assert all(one.id.tolist() == [1, 2] for one in seen)
    assert seen[0].named_events == [(1, "begin"), (2, "begin")]
    # One taxel of 2 mm in 10 ms is 200 mm/s; an event comes where it is half of that.
    assert seen[-1].velocity_mm_s is not None
    assert seen[-1].velocity_mm_s == pytest.approx(
        np.array([[200, 0, 0], [-200, 0, 0]]), abs=5
    )
    assert seen[-1].velocity == pytest.approx(np.array([[0, 100], [0, -100]]), abs=3)
    assert [k for k, one in enumerate(seen) if (1, "slide") in one.named_events] == [4]
    assert seen[-1].sliding.all()
    assert seen[-1].age_s == pytest.approx(0.19)
    assert seen[0].place_mm.tolist() == [[9.0, 7.0, 0.0], [65.0, 51.0, 0.0]]
    assert seen[0].area_mm2 is not None
    assert seen[0].area_mm2 == pytest.approx(24 * 4.0)


def test_a_contact_that_moves_farther_than_its_size_is_the_nearest_one_within_a_gate():
    stream = Stream()
    assert stream(boxes((2, 2))).id.tolist() == [1]
    assert stream(boxes((2, 10))).id.tolist() == [1]
    far = stream(boxes((2, 30)))
    assert far.id.tolist() == [2]
    assert far.named_events == [(2, "begin"), (1, "end")]


def test_two_that_meet_are_one_and_have_their_ids_again_where_they_part():
    stream = Stream()
    places = [*range(2, 11), *range(10, 1, -1)]
    seen = [stream(boxes((8, k), (8, 26 - k))) for k in places]
    assert [one.id.size for one in seen] == [2] * 8 + [1] * 2 + [2] * 8
    (kept,) = set(seen[8].id.tolist())
    assert seen[8].named_events == [(3 - kept, "end")]
    assert seen[10].named_events == [(3 - kept, "begin")]
    for before, after in zip(seen[:8], reversed(seen[10:]), strict=True):
        assert dict(
            zip(before.id.tolist(), before.centre.tolist(), strict=True)
        ) == dict(zip(after.id.tolist(), after.centre.tolist(), strict=True))


def test_events_come_at_their_frames_once_and_again_after_half_the_force():
    stream = Stream(Limits(force=3.0, over=12.0))
    forces = [0.1, 0.3, 0.6, 0.4, 0.6, 0.2, 0.6, 0.1, 0.05, 0.0]
    seen = [stream(boxes((4, 4), force=force)) for force in forces]
    assert [[event for _, event in one.named_events] for one in seen] == [
        *([], ["begin"], ["over"], [], [], [], ["over"], [], ["end"], [])
    ]
    assert [one.over.tolist() for one in seen[2:6]] == [[True], [True], [True], [False]]


def test_strong_contacts_begin_at_once_weak_ones_later_and_none_while_the_noise_is_learnt():
    stream = Stream()
    weak, gone, strong = (boxes((8, 8), force=times * NOISE_N) for times in (5, 0, 7))
    seen = [stream(one) for one in (weak, gone, weak, weak, weak, gone, strong)]
    assert [one.named_events for one in seen] == [
        *([], [], [], [(1, "begin")], [], [(1, "end")], [(2, "begin")])
    ]
    elsewhere = boxes((20, 20), force=5 * NOISE_N)
    assert [stream(one).id.size for one in (gone, weak, elsewhere, weak)] == [
        0,
        0,
        0,
        0,
    ]
    stream = Stream()
    assert stream(boxes((8, 8))).id.tolist() == [1]
    stream.tracker.settle(2)
    both = [stream(boxes((8, 8), (20, 20))).id.tolist() for _ in range(7)]
    assert both == [[1]] * 6 + [[1, 2]]


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 1), (13, 17)])
@pytest.mark.parametrize("part", [0.0, 0.2, 0.5, 0.8])
def test_the_compiled_loop_finds_the_same_components(shape, part):
    pytest.importorskip("numba")
    from sparseskin.nodes.numerics import kernels

    rng = np.random.default_rng(1)
    forces, variances = rng.random((2, *shape), dtype=np.float32)
    forces[rng.random(shape) >= part] = 0
    given = (
        forces,
        np.float32(0.1),
        0.8,
        variances.reshape(-1),
        rng.random((3, forces.size)),
    )
    regions = np.zeros((2, forces.size), np.int32)
    regions[:, : shape[1]] = rng.integers(0, 3, shape[1])
    both = zip((components, kernels.components), regions, strict=True)
    for one, other in zip(
        *([*find(*given, now, 2), now] for find, now in both), strict=True
    ):
        assert one == pytest.approx(other, rel=1e-9)


def test_the_contacts_of_a_skin_of_points_have_a_place_and_a_normal():
    mask = np.ones(SHAPE, np.bool_)
    mask[0, 0] = False
    rows, cols = np.nonzero(mask)
    angle = cols * 0.02
    normal = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    places = np.stack([0.1 * np.sin(angle), 0.002 * rows, 0.1 * np.cos(angle)], axis=1)
    points = np.concatenate([places, normal], axis=1).astype(np.float32)
    found = Stream(mask=mask, points=points)(boxes((4, 10), size=(1, 1)))
    expected = [100 * np.sin(0.2), 8.0, 100 * np.cos(0.2)]
    assert found.place_mm[0] == pytest.approx(np.array(expected), rel=1e-5)
    assert found.normal[0] == pytest.approx(
        np.array([np.sin(0.2), 0, np.cos(0.2)]), rel=1e-5
    )


def test_contacts_of_several_patches_are_split_with_their_events():
    left = ContactTracker(state())
    right = ContactTracker(state())
    both = [
        one.update(boxes((4, 4 + k)), None, 1) for k, one in enumerate((left, right))
    ]
    message = Contacts(
        stamp_ns=1, patch="body", names=("left", "idle", "right"), done_ns=0, trusted=(True,) * 3,
        **joined([both[0], None, both[1]]),
    )  # fmt: skip
    parts = message.split()
    assert [part.patch for part in parts] == ["left", "idle", "right"]
    assert [part.centre[:, 1].tolist() for part in parts] == [[6.5], [], [7.5]]
    assert [part.named_events for part in parts] == [[(1, "begin")], [], [(1, "begin")]]


def test_a_graph_publishes_the_contacts_of_each_reconstruction():
    stated = [f"reconstructor.{one}" for one in ("contacts=true", "contact_over=5.0")]
    frames = list(sparseskin.run_launch("drag_wrench_40", 345, stated))
    seen = [frame.contacts for frame in frames]
    assert all(
        one is not None and one.stamp_ns == f.stamp_ns
        for one, f in zip(seen, frames, strict=True)
    )
    known = [one for one in seen if one is not None]
    assert not any(one.id.size for one in known[:300])
    events = {event for one in known for _, event in one.named_events}
    assert {"begin", "over"} <= events <= set(EVENTS)
    frame = frames[330]
    found = known[330]
    assert found.id.tolist() == [1]
    assert found.total[0] == pytest.approx(frame.truth.sum(), rel=0.1)
    place = np.argwhere(frame.truth > 0).T
    centre = place @ frame.truth[tuple(place)] / frame.truth.sum()
    assert found.centre[0] == pytest.approx(centre, abs=0.5)


def test_limits_change_while_a_graph_runs_and_may_not_contradict_each_other():
    bus = chain(
        sensor={"source": "scene:drag_wrench_40"}, reconstructor={"contacts": True}
    )
    node = bus.hosts["reconstructor"].node
    sizes = []
    for k, messages in enumerate(bus.frames(332)):
        sizes += [one.id.size for one in messages if isinstance(one, Contacts)]
        if k == 328:
            assert not list(node.change(replace(node.settings, contact_force=1e6)))
    assert sizes[-4:] == [1, 0, 0, 0]
    with pytest.raises(SettingsError, match="contact_high: 1 is below contact_low = 2"):
        ReconstructorSettings(contact_high=1.0)
