"""Facts that hold in worlds drawn at random: skins, noise, rows, loads and faults."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sparseskin import Stream
from sparseskin.nodes.compressor.phi.rotation import FIXED, ROTATING
from sparseskin.studies.stability import faults, loads
from sparseskin.studies.stability.verdicts import WAYS, judge
from sparseskin.studies.stability.worlds import Times, draw_world

SHORT = Times(touch=4, release=30, end=46, earliest_fault=10, latest_fault=20)
SIDES = (12, 16, 20)
THROUGH = ("Stream", "arrays")


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


@given(world=worlds(rows=ROTATING), through=st.sampled_from(THROUGH))
def test_without_a_fault_few_frames_are_wrong_and_trusted_and_hardly_anything_stays(
    world, through
):
    world = replace(world, noise=world.noise._replace(is_stated=True))
    verdict = judge(world, through, "off")
    # Largest part of 900 worlds: 2 frames of 46, at the first touch of a load.
    assert verdict.silent <= 0.1 * verdict.frames, world.describe()
    # Largest part of 900 worlds: 0.14, of a taxel of 0.23 N at N/8.
    assert verdict.residue < 0.3, world.describe()


@given(
    side=st.sampled_from((12, 16, 20)),
    ratio=st.floats(1.0, 1.25),
    rows=st.sampled_from([FIXED, ROTATING]),
    sigma=st.floats(0.003, 0.05),
    seed=st.integers(0, 99),
)
def test_noise_is_no_force_where_nearly_all_rows_are_read(
    side, ratio, rows, sigma, seed
):
    normal = np.random.default_rng(seed).normal(0, sigma, (30, side, side))
    readings = np.maximum(normal, 0).astype(np.float32)
    stream = Stream((side, side), ratio=ratio, rows=rows, seed=seed % 5)
    totals = []
    for frame in readings:
        forces = stream.reconstruct(stream.compress(frame))
        totals.append(forces.sum())
    # Forces of 0 or more could explain all of a noise that is clipped at 0.
    assert np.mean(totals[-5:]) < 0.15 * readings[-5:].sum(axis=(1, 2)).mean()
    assert stream.trusted


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
    assert stated.rows == rows
    assert stated.load.kind == "disc"
    assert stated.shape == drawn.shape
    assert stated.ratio == drawn.ratio
    assert stated.noise == drawn.noise
    assert stated.fault.describe() == drawn.fault.describe()


def test_all_ways_lead_to_the_same_forces():
    world = draw_world(7, False, sides=(12,), times=SHORT)
    answers = {
        way: [a for _, a in stream(world, "off")] for way, stream in WAYS.items()
    }
    for k in range(SHORT.end):
        for way in WAYS:
            np.testing.assert_array_equal(
                answers[way][k].forces, answers["Stream"][k].forces
            )
