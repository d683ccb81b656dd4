"""Taxels that the edge chooses anew in each frame, and what both ways of choosing share."""

import numpy as np
import pytest
from bags import launched, only
from damaged import launch_faults
from hypothesis import given
from hypothesis import strategies as st
from matrices import grids

from sparseskin.launch.commands.cli import main
from sparseskin.messages import Measurements, MessageError, Reconstruction, Taxels
from sparseskin.nodes.compressor.node import Compressor, CompressorSettings
from sparseskin.nodes.compressor.phi.base import follow, make_phi
from sparseskin.nodes.errors import PhiError, SettingsError
from sparseskin.plugins.chosen_rows.acts import ActsSearch, packed_places
from sparseskin.studies.evaluate import VALUE_BYTES, values_that_fit

THRESHOLD = 0.05


def everywhere(*shape):
    return np.ones(shape, np.bool_)


def read_cells(image, m):
    """The cells that a search reads of a frame."""
    search = ActsSearch(everywhere(*image.shape), m, THRESHOLD)
    is_read = np.zeros(image.size, np.bool_)
    is_read[search.places(image.reshape(-1).take)] = True
    return is_read.reshape(image.shape)


@given(exists=grids(), data=st.data())
def test_m_existing_taxels_are_read_each_once_on_any_grid(exists, data):
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    n = int(exists.sum())
    m = data.draw(st.integers(1, n))
    x = np.maximum(rng.normal(-0.5, 1, n), 0).astype(np.float32)
    asked = []

    def read(taxels):
        asked.extend(taxels)
        return x.take(taxels)

    places = ActsSearch(exists, m, THRESHOLD).places(read)
    assert len(asked) == len(set(asked)) == m
    np.testing.assert_array_equal(places, np.sort(asked))
    assert places[0] >= 0
    assert places[-1] < n


def test_an_untouched_skin_is_read_evenly_and_a_contact_and_around_it_whole():
    is_read = read_cells(np.zeros((64, 64), np.float32), 64 * 64 // 16)
    for part in is_read.reshape(8, 8, 8, 8).swapaxes(1, 2).reshape(-1, 64):
        assert part.sum() == 4
    image = np.zeros((40, 40), np.float32)
    image[17:24, 5:12] = 1.0
    assert read_cells(image, 400)[16:25, 4:13].all()


@pytest.mark.parametrize("m", [0, 101])
def test_more_readings_than_taxels_are_refused(m):
    with pytest.raises(
        PhiError, match=rf"acts: m = {m} is not allowed; allowed: 1\.\.100"
    ):
        ActsSearch(everywhere(10, 10), m, THRESHOLD)


def test_what_is_read_are_the_taxels_that_were_chosen():
    phi = make_phi("acts", 100, 4, seed=0)
    follow(phi, places=packed_places(np.array([0, 7, 50, 99]), 100))
    x = np.arange(100, dtype=np.float32)
    np.testing.assert_array_equal(phi.forward(x), [0, 7, 50, 99])
    np.testing.assert_array_equal(phi.dense() @ x, phi.forward(x))
    y = np.array([1, 2, 3, 4], np.float32)
    np.testing.assert_array_equal(phi.adjoint(y), phi.dense().T @ y)
    # The fingerprint is of n and m alone.
    assert phi.fingerprint == make_phi("acts", 100, 4, seed=9).fingerprint
    assert phi.fingerprint != make_phi("acts", 100, 5, seed=0).fingerprint


@pytest.mark.parametrize(
    ("kind", "places", "text"),
    [
        ("acts", None, "come without the places"),
        ("acts", packed_places(np.arange(3), 100), "3 taxels are read; expected m = 4"),
        (
            "acts",
            packed_places(np.array([0, 1, 2, 103]), 104),
            r"not ascending within 0\.\.99",
        ),
        (
            "subsample",
            packed_places(np.arange(4), 100),
            "subsample: measurements with places; ",
        ),
    ],
)
def test_places_that_do_not_fit_are_refused(kind, places, text):
    with pytest.raises(PhiError, match=text):
        follow(make_phi(kind, 100, 4, seed=0), places=places)
    y = np.ones(4, np.float32)
    with pytest.raises(MessageError, match="places: 3 of them for 4 measurements"):
        Measurements(stamp_ns=1, patch="skin", y=y, phi="0" * 16, places=np.uint8([7]))


ACTS = ("compressor.phi=acts", "reconstructor.solver=interpolation")
ADAPTIVE = ("compressor.phi=adaptive",)


def graph(*overrides, name="path_40", record=None):
    return launched(name, *overrides, record=record)


def reconstructions(bus, n_frames):
    found = [
        m
        for frame in bus.frames(n_frames)
        for m in frame
        if isinstance(m, Reconstruction)
    ]
    bus.close()
    return found


@pytest.mark.parametrize("overrides", [ACTS, ADAPTIVE])
def test_m_changes_while_the_graph_runs(overrides):
    bus = graph(*overrides, "compressor.bits=12")
    messages = []
    for k, frame in enumerate(bus.frames(6), start=1):
        messages += frame
        if k == 3:
            bus._deliver(bus.hosts["compressor"].change({"ratio": 8.0}))
    made = [m for m in messages if isinstance(m, Measurements)]
    found = [m for m in messages if isinstance(m, Reconstruction)]
    assert [m.y.shape[1] for m in made] == [533] * 3 + [200] * 3
    assert [m.phi for m in found] == [m.phi for m in made]
    # An untouched skin, before and after.
    assert max(float(np.abs(m.forces).max()) for m in found) < 0.1
    assert bus.hosts["reconstructor"].counts.refused == {}
    if overrides == ADAPTIVE:
        assert all(m.nodes is not None and m.nodes.size < m.y.size / 4 for m in made)


def test_interpolation_leaves_readings_unchanged():
    for frame in graph(*ACTS, "compressor.bits=12").frames(3):
        taxels, made, found = (
            only(frame, k) for k in (Taxels, Measurements, Reconstruction)
        )
        assert made.places is not None
        read = np.flatnonzero(np.unpackbits(made.places))
        np.testing.assert_allclose(
            made.y[0], taxels.forces.reshape(-1)[read], atol=1e-3
        )
        np.testing.assert_array_equal(
            found.forces.reshape(-1)[read], np.maximum(made.y[0], 0)
        )
        assert found.residual == (0,)


@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        (
            ACTS[:1],
            'solver "skin": phi "acts" reads other rows each frame; allowed: interpolation',
        ),
        (
            ACTS[1:],
            'solver "interpolation": phi "sbhe" mixes taxels; allowed: a phi that reads',
        ),
        (
            (*ACTS, "compressor.rows=rotating"),
            '"rotating" is not allowed for phi "acts"',
        ),
        (
            (*ADAPTIVE, "reconstructor.preset=paper"),
            'solver "fista": phi "adaptive" reads other rows each frame; allowed: skin',
        ),
        (
            (*ADAPTIVE, "reconstructor.uncertainty=true"),
            "is not available with phi adaptive",
        ),
        (
            (*ACTS, "reconstructor.uncertainty=true"),
            "uncertainty=true: is not available with solver interpolation, whose error",
        ),
    ],
)
def test_settings_that_do_not_go_together_are_refused_in_one_line(overrides, text):
    (line,) = launch_faults("path_40", overrides)
    assert text in line


@pytest.mark.parametrize("chosen", [ACTS, ADAPTIVE])
def test_a_recording_replays_and_is_reprocessed_to_the_same_bits(chosen, tmp_path):
    bag = tmp_path / "chosen.mcap"
    out = tmp_path / "again.mcap"
    streamed = reconstructions(graph(*chosen, record=str(bag)), 6)
    # From the taxels, the edge chooses as it chose before.
    changes = [argument for text in chosen for argument in ("--set", text)]
    assert main(["reprocess", str(bag), *changes, "--out", str(out)]) == 0
    assert len(streamed) == 6
    for file in (bag, out):
        bus = graph(f"player.file={file}", *chosen[1:], name="replay_measurements")
        for once, again in zip(streamed, reconstructions(bus, 6), strict=True):
            np.testing.assert_array_equal(once.forces, again.forces)
            assert once.phi == again.phi


@pytest.mark.parametrize("kind", ["acts", "adaptive"])
def test_a_kind_that_chooses_has_fixed_rows_one_patch_and_a_place_in_settings(kind):
    assert CompressorSettings(phi=kind).rows_and_m(1600) == ("fixed", 533)
    with pytest.raises(
        SettingsError, match=f"phi: {kind} chooses other rows for each patch"
    ):
        Compressor.Settings(phi=kind, patches=("left", "right")).check()
    (entry,) = (one for one in CompressorSettings.described() if one["key"] == "phi")
    assert kind in entry["known"]
    with pytest.raises(PhiError, match="n = 55, but 64 taxels exist"):
        make_phi(kind, 55, 20, 0).lay_out(everywhere(8, 8))


@pytest.mark.parametrize("kind", ["acts", "adaptive"])
@pytest.mark.parametrize(
    ("shape", "ratio"), [((4, 8), 3), ((19, 12), 4), ((64, 64), 8)]
)
def test_measurements_with_the_code_of_their_rows_fill_the_bytes_of_m(
    kind, shape, ratio
):
    mask = everywhere(*shape)
    m = mask.size // ratio
    n_values = values_that_fit(kind, mask, m)
    assert m / 2 <= n_values < m
    phi = make_phi(kind, mask.size, n_values, seed=0)
    phi.lay_out(mask)
    assert VALUE_BYTES * n_values + phi.most_code_bytes <= VALUE_BYTES * m
    rng = np.random.default_rng(0)
    for _ in range(3):
        y, code = phi.measure(rng.random(mask.size, dtype=np.float32))
        assert y.size == n_values
        assert code.size <= phi.most_code_bytes
