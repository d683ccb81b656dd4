"""Facts that hold in worlds drawn at random: skins, noise, rows, loads and faults."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sparseskin import Stream
from sparseskin.nodes.compressor.phi.rotation import ROTATING
from sparseskin.studies.stability import faults, loads
from sparseskin.studies.stability.verdicts import UNSETTLED, WAYS, judge
from sparseskin.studies.stability.worlds import Times, draw_world

SHORT = Times(touch=4, release=30, end=46, earliest_fault=10, latest_fault=20)
SIDES = (12, 16, 20)
CHANGE = 1e-7
"""Change of a measurement in the largest one: the resolution of float32."""


@st.composite
def worlds(draw, has_fault=False, **parts):
    """A world with a drawn seed, load and motion. `parts`: as of `draw_world`."""
    return draw_world(
        draw(st.integers(0, 2**32 - 1)),
        has_fault,
        load=draw(st.sampled_from(sorted(loads.KINDS))),
        motion=draw(st.sampled_from(loads.MOTIONS)),
        times=SHORT,
        **{"sides": SIDES} | parts,
    )


@given(world=worlds(rows=ROTATING))
def test_without_a_fault_no_frame_is_wrong_and_trusted(world):
    assert judge(world, fast="off").silent == 0, world.describe()


@given(world=worlds())
def test_nothing_of_a_load_stays_after_its_release(world):
    assert judge(world, fast="off").residue < 0.05, world.describe()


@given(
    data=st.data(),
    kind=st.sampled_from(faults.HOLD_NOTHING),
    through=st.sampled_from(sorted(WAYS)),
)
def test_measurements_that_hold_nothing_of_the_skin_are_not_trusted(data, kind, through):
    world = data.draw(worlds(has_fault=True, fault=kind))
    world = replace(world, noise=world.noise._replace(is_stated=True))
    answers = [answer for _, answer in WAYS[through](world, "off")]
    # That frames repeat is known when they have repeated.
    later = answers[world.fault.begins + UNSETTLED :]
    assert not any(answer.trusted for answer in later), (through, world.describe())


@given(world=worlds(), seed=st.integers(0, 2**32 - 1))
def test_a_change_at_the_last_digit_of_measurements_changes_no_force(world, seed):
    rng = np.random.default_rng(seed)
    options = {"ratio": world.ratio, "rows": world.rows, "mask": world.mask, "fast": "off"}
    host, changed_host = (Stream(world.shape, **options, **world.noise.options) for _ in range(2))
    largest_change = peak = 0.0
    for frame in world.frames():
        y = host.compress(frame.readings)
        change = CHANGE * np.abs(y).max() * rng.choice([-1.0, 1.0], y.size)
        forces = host.reconstruct(y)
        changed = changed_host.reconstruct((y + change).astype(np.float32))
        peak = max(peak, float(forces.max()))
        largest_change = max(largest_change, float(np.abs(changed - forces).max()))
    assert largest_change <= 1e-5 * peak, world.describe()


@given(seed=st.integers(0, 2**32 - 1), kind=st.sampled_from(sorted(faults.KINDS)))
def test_a_seed_is_one_world(seed, kind):
    world = draw_world(seed, True, fault=kind, sides=(8, 12), times=SHORT)
    again = draw_world(seed, True, fault=kind, sides=(8, 12), times=SHORT)
    assert world.describe() == again.describe()
    measurements = []
    for drawn in (world, again):
        spoiler = drawn.spoiler(of_taxels=False)
        readings = [frame.readings[drawn.exists] for frame in drawn.frames()]
        measurements.append([spoiler.spoil(values) for values in readings])
    for values, values_again in zip(*measurements, strict=True):
        np.testing.assert_array_equal(values, values_again)
    assert (world.truth(SHORT.touch + 10) >= 0).all()
    assert not world.truth(SHORT.release).any()


@given(seed=st.integers(0, 2**32 - 1), rows=st.sampled_from(["fixed", "rotating"]))
def test_a_stated_part_leaves_the_others_as_they_are(seed, rows):
    drawn = draw_world(seed, True, sides=SIDES)
    stated = draw_world(seed, True, sides=SIDES, rows=rows, load="disc")
    assert (stated.rows, stated.load.kind) == (rows, "disc")
    assert (stated.shape, stated.ratio, stated.noise) == (drawn.shape, drawn.ratio, drawn.noise)
    assert stated.fault.describe() == drawn.fault.describe()


def test_all_ways_lead_to_the_same_forces():
    world = draw_world(7, False, sides=(12,), times=SHORT)
    answers = {way: [a for _, a in stream(world, "off")] for way, stream in WAYS.items()}
    for k in range(SHORT.end):
        for way in WAYS:
            np.testing.assert_array_equal(answers[way][k].forces, answers["Stream"][k].forces)
