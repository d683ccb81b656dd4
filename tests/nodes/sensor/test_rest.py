"""Rest, sign and range of readings: what is noticed on each way in, and what answers it."""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sparseskin
from sparseskin.launch.commands.cli import main
from sparseskin.messages import Reason, Taxels
from sparseskin.messages.skin import Skin
from sparseskin.messages.wire import decode
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import PhiError, SettingsError, SparseskinError
from sparseskin.nodes.node import Context, Tick
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.sensor.calibration.chain import TARE_FRAMES, Chain
from sparseskin.nodes.sensor.calibration.description import SkinDescription
from sparseskin.nodes.sensor.doubt.rest import Rest
from sparseskin.nodes.sensor.node import Sensor
from sparseskin.nodes.sensor.saturation import Clipped
from sparseskin.nodes.sensor.skin_file import load_skin, save_skin
from sparseskin.nodes.sensor.zero import Zero
from sparseskin.studies.stability import rests

SKIN = Skin(10, 10, f_max=2.5)
SHAPE = (6, 8)
N_UNTOUCHED = 35
N_PRESSED = 15
LEVEL = np.random.default_rng(0).integers(700, 900, SHAPE)
PRESS = np.zeros(SHAPE, dtype=np.int64)
PRESS[2:4, 3:6] = 200
ANSWERS = {"rises": ["tare=30"], "falls": ["tare=30", "invert=true"]}


def readings(sign, level=LEVEL):
    """Untouched readings, then pressed ones, int64 (n, rows, cols), with noise of a count."""
    noise = np.random.default_rng(1).normal(0, 1, (N_UNTOUCHED + N_PRESSED, *SHAPE))
    frames = level + np.rint(noise).astype(np.int64)
    frames[N_UNTOUCHED:] += sign * PRESS
    return frames


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("rises.npy", readings(1))
    np.save("falls.npy", readings(-1))
    return tmp_path


def test_drawn_rests_are_noticed_and_drawn_loads_are_not():
    wrong = dict.fromkeys(rests.KINDS, 0)
    for kind in rests.KINDS:
        for seed in range(40):
            rng = np.random.default_rng((rests.KINDS.index(kind), seed))
            world = rests.draw_rest_world(rng, kind)
            found = rests.reasons_of(world)
            if kind == rests.FALLS:
                hidden = sum(rests.are_hidden(world, found))
                wrong[kind] += hidden > 4  # while a load begins
            else:
                wrong[kind] += rests.is_missed(world, found) or rests.is_false_alarm(
                    world, found
                )
    assert all(n <= 1 for n in wrong.values()), wrong


@pytest.mark.parametrize(
    ("level", "n_lifted", "found"),
    [(0.3, 100, True), (0.3, 80, False), (0.0, 100, False)],
)
def test_what_nearly_all_taxels_read_at_first_is_named_with_its_answers(
    level, n_lifted, found
):
    rng = np.random.default_rng(0)
    rest = Rest(SKIN)
    n_new = 0
    for _ in range(2 * TARE_FRAMES):
        frame = rng.normal(0, 0.02, 100)
        frame[:n_lifted] += level
        n_new += rest.update(frame.clip(0).astype(np.float32).reshape(SKIN.shape))
    assert n_new == found
    assert ("; add tare=30 " in rest.line) == found
    assert rest.reason == (Reason.REST if found else "")


def test_an_even_load_from_the_first_frame_is_trusted_once_most_of_it_is_gone():
    rest = Rest(SKIN)
    for _ in range(TARE_FRAMES):
        rest.update(np.ones(SKIN.shape, np.float32))
    assert rest.reason == Reason.REST
    for _ in range(TARE_FRAMES):
        rest.update(np.zeros(SKIN.shape, np.float32))
    assert rest.reason == ""
    assert rest.line == ""
    rest.update(np.ones(SKIN.shape, np.float32))
    assert rest.reason == ""


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**32 - 1), sigma=st.floats(0.001, 0.5), low=st.floats(-1, 0)
)
def test_noise_around_0_is_neither_clipped_nor_of_a_sign(seed, sigma, low):
    rng = np.random.default_rng(seed)
    clipped = Clipped()
    for _ in range(20):
        frame = rng.normal(0, sigma, SKIN.shape)
        clipped.add(frame, low, 2.5 + 3 * sigma)
        assert clipped.reason(SKIN.n_taxels) == ""


@pytest.mark.parametrize(("n_clipped", "reason"), [(1, ""), (2, Reason.CLIPPED)])
def test_a_frame_with_more_than_1_percent_of_clipped_readings_is_not_trusted(
    n_clipped, reason
):
    frame = np.zeros(SKIN.shape)
    clipped = Clipped()
    clipped.add(frame, 0.0, 2.5)
    frame.flat[:n_clipped] = 3.0
    clipped.add(frame, 0.0, 2.5)
    assert clipped.reason(SKIN.n_taxels) == reason
    clipped.add(np.zeros(SKIN.shape), 0.0, 2.5)
    assert clipped.reason(SKIN.n_taxels) == ""


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_one_array_that_is_filled_anew_has_the_doubts_of_fresh_arrays(seed):
    """A program may read each frame into the same array: it shows the same noise."""
    rng = np.random.default_rng(seed)
    sigma = rng.uniform(0.011, 0.1)
    frames = (sigma / 2 + rng.normal(0, sigma, (TARE_FRAMES, *SKIN.shape))).clip(0)
    buffer = np.zeros(SKIN.shape, np.float32)
    fresh = Zero(SKIN)
    reused = Zero(SKIN)
    for frame in frames.astype(np.float32):
        fresh.forces(frame)
        buffer[:] = frame
        reused.forces(buffer)
        assert reused.reason == fresh.reason


def test_one_broken_taxel_is_no_sign_once_a_press_has_raised_readings():
    clipped = Clipped()
    frame = np.zeros(SKIN.shape)
    frame[5, 5] = -2.0
    clipped.add(frame, 0.0, 2.5)
    assert clipped.reason(SKIN.n_taxels) == Reason.SIGN
    frame[1:3, 1:3] = 1.0
    clipped.add(frame, 0.0, 2.5)
    assert clipped.reason(SKIN.n_taxels) == ""


def test_an_inverted_chain_subtracts_the_reading_from_the_baseline():
    described = SkinDescription("s", *SHAPE, 1000.0, baseline=LEVEL.astype(np.float64))
    chain = Chain(described.inverted(), drift_rate=0.0)
    np.testing.assert_array_equal(chain.apply(LEVEL - PRESS, 0), PRESS)
    chain.invert()
    np.testing.assert_array_equal(chain.apply(LEVEL + PRESS, 1), PRESS)


def taxels_of(sensor):
    """Yield the frames of a sensor."""
    n = 0
    while not sensor.exhausted:
        made = list(sensor.acquire(Tick(n, n)))
        yield from (message for message in made if isinstance(message, Taxels))
        n += 1


def replayed(source, *words):
    options = [f"sensor.source={source}", *(f"sensor.{word}" for word in words)]
    return list(sparseskin.run_launch("replay", None, options))


@pytest.mark.parametrize(("kind", "sign"), [("rises", 1), ("falls", -1)])
def test_a_graph_trusts_a_level_at_rest_once_it_is_answered(folder, kind, sign):
    source = f"file:{kind}.npy"
    found = replayed(source)
    assert {frame.reason for frame in found} == {"rest"}
    assert not any(frame.trusted for frame in found)

    found = replayed(source, "tare=0", "f_max=2000")
    assert {frame.reason for frame in found[5:]} == {""}

    found = replayed(source, *ANSWERS[kind])[-N_PRESSED // 2 :]
    assert {frame.reason for frame in found} == {""}
    for frame in found:
        np.testing.assert_allclose(frame.forces[2:4, 3:6], 200, atol=12)
        assert np.abs(frame.taxels - PRESS).max() <= 6


@pytest.mark.parametrize(("kind", "answer"), [("falls", "false"), ("rises", "true")])
def test_readings_of_the_other_sign_are_not_trusted_and_a_line_says_which(
    folder, kind, answer
):
    log = []
    context = Context("sensor", ManualClock(), log=log.append)
    chosen = Sensor.Settings(
        source=f"file:{kind}.npy", tare=30, invert=answer == "true"
    )
    sensor = Sensor(chosen, context)
    reasons = [message.reason for message in taxels_of(sensor)]
    assert reasons[:5] == [("",)] * 5
    assert reasons[-N_PRESSED:] == [("sign",)] * N_PRESSED
    other = {"false": "true", "true": "false"}[answer]
    assert any(
        f"; add sensor.invert={other} if a press does that" in line for line in log
    )
    assert any(f"sensor.invert={other}" in line for line in sensor.report()["lines"])


@pytest.mark.parametrize("negative", ["zero", "keep"])
@pytest.mark.parametrize(("sign", "reason"), [(1, ""), (-1, "sign")])
def test_a_file_of_tared_readings_that_fall_is_not_trusted(
    folder, negative, sign, reason
):
    np.save("tared.npy", readings(sign, level=0).astype(np.float32))
    words = ["file:tared.npy", f"negative={negative}", "unit=counts"]
    assert {frame.reason for frame in replayed(*words)[-N_PRESSED:]} == {reason}

    options = ["--negative", negative, "--unit", "counts"]
    assert main(["recording", "import", "tared.npy", "--out", "a.mcap", *options]) == 0
    assert ("sign" in reasons_in("a.mcap")) == (sign < 0)


def test_the_sign_may_be_changed_while_a_graph_runs(folder):
    sensor = Sensor(
        Sensor.Settings(source="file:falls.npy", tare=30),
        Context("sensor", ManualClock()),
    )
    frames = taxels_of(sensor)
    assert any(message.reason == ("sign",) for message in frames)
    list(sensor.change(sensor.settings.changed({"invert": True})))
    last = next(frames)  # the first one was computed before
    last = next(frames)
    assert last.reason == ("",)
    assert np.abs(last.forces[0] - PRESS).max() <= 6


def test_the_sign_is_refused_where_the_file_of_the_skin_has_one(folder):
    gains = np.full(SHAPE, -1.0)
    save_skin(folder / "s.toml", SkinDescription("s", *SHAPE, 1000.0, gains=gains))
    chosen = Sensor.Settings(source="file:falls.npy", skin="s.toml", invert=True)
    with pytest.raises(
        SettingsError, match=r"^invert: the gains in the file of the skin"
    ):
        chosen.check()


@pytest.mark.parametrize("kind", ANSWERS)
def test_an_imported_recording_carries_the_doubt_and_its_answers(folder, kind, capsys):
    assert main(["recording", "import", f"{kind}.npy", "--out", "a.mcap"]) == 0
    printed = capsys.readouterr().err
    assert (
        "; add --tare 30 if nothing touched them, --tare 0 if these are forces"
        in printed
    )
    assert reasons_in("a.mcap") == {"rest"}

    options = [part for word in ANSWERS[kind] for part in ("--" + word).split("=")]
    assert (
        main(["recording", "import", f"{kind}.npy", "--out", "b.mcap", *options]) == 0
    )
    assert reasons_in("b.mcap") == {""}
    forces = sparseskin.read_recording("b.mcap")["forces"]
    assert len(forces) == N_UNTOUCHED + N_PRESSED - 30
    assert np.abs(forces[-1] - PRESS).max() <= 6


def test_an_import_without_a_frame_after_its_tare_is_refused(folder, capsys):
    words = ["recording", "import", "falls.npy", "--out", "a.mcap", "--tare", "500"]
    assert main(words) == 2
    assert "all frames are of the tare" in capsys.readouterr().err
    assert not (folder / "a.mcap").exists()


def reasons_in(path):
    with BagReader(path) as bag:
        recorded = bag.messages(["/skin/taxels"])
        messages = [decode(one.topic.encode(), one.payload) for one in recorded]
    return {reason for message in messages for reason in message.reason}


def test_a_calibration_without_a_press_names_a_sign_that_its_recording_shows(
    folder, capsys
):
    words = ["calibrate", "file:falls.npy", "--untouched", "0.3s", "--no-questions"]
    words += ["--f-max", "1000"]
    assert main([*words, "--out", "a.toml"]) == 0
    assert "; add --invert true if a press does that" in capsys.readouterr().out
    assert main([*words, "--out", "b.toml", "--invert", "true"]) == 0
    assert "--invert" not in capsys.readouterr().out
    np.testing.assert_array_equal(load_skin("b.toml").gains, -1.0)
    (frame,) = replayed("file:falls.npy", "skin=b.toml")[-1:]
    assert frame.reason == ""
    assert np.abs(frame.taxels - PRESS).max() <= 6


def streamed(frames, f_max=1000.0, **arguments):
    """A stream that has seen frames, forces and reasons of them, and what it warned of."""
    stream = sparseskin.Stream(SHAPE, ratio=2, f_max=f_max, **arguments)
    forces = []
    reasons = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for frame in frames.astype(np.float32):
            forces.append(stream.reconstruct(stream.compress(frame)))
            reasons.append(stream.reason)
    return (
        forces,
        reasons,
        [str(one.message) for one in caught if "stream" in str(one.message)],
    )


@pytest.mark.parametrize(("kind", "sign"), [("rises", 1), ("falls", -1)])
def test_a_stream_trusts_a_level_at_rest_once_it_is_answered(kind, sign):
    _, reasons, lines = streamed(readings(sign))
    assert set(reasons) == {"rest"}
    assert len(lines) == 1
    assert (
        "; add tare=30 if nothing touched them, tare=0 if these are forces" in lines[0]
    )

    forces, reasons, lines = streamed(readings(sign), tare=30, invert=sign < 0)
    assert reasons[:30] == ["rest"] * 30
    assert lines == []
    assert not np.any(forces[:30])
    assert set(reasons[-5:]) == {""}
    np.testing.assert_allclose(forces[-1][2:4, 3:6], 200, atol=12)


def test_a_stream_warns_of_readings_that_fall_below_0():
    _, reasons, lines = streamed(readings(-1, level=0))
    assert set(reasons[-N_PRESSED:]) == {"sign"}
    assert len(lines) == 1
    assert "; add invert=true if a press does that" in lines[0]
    _, reasons, lines = streamed(readings(1, level=0))
    assert set(reasons[-5:]) == {""}
    assert lines == []


def test_an_edge_hands_its_doubt_to_a_host_in_another_program():
    edge, host = (sparseskin.Stream(SHAPE, ratio=2, f_max=1000.0) for _ in range(2))
    y = edge.compress(readings(1)[0].astype(np.float32))
    assert edge.sensed == "rest"
    host.reconstruct(y, 0, sensed=edge.sensed)
    assert host.reason == "rest"
    assert not host.trusted


@pytest.mark.parametrize("sign", [1, -1])
def test_arrays_trust_a_level_at_rest_once_it_is_answered(sign):
    phi = sparseskin.make_phi("sbhe", n=48, m=24, seed=0)
    solver = sparseskin.make_solver("skin", phi, sparseskin.make_basis("haar", *SHAPE))
    frames = readings(sign).astype(np.float32)
    with pytest.warns(
        RuntimeWarning, match=r"^compress: 48 of 48 taxels read .* tare=30 if"
    ):
        y = sparseskin.compress(frames, phi)
    assert phi.reasons == ("rest",) * len(frames)
    sparseskin.reconstruct(y, solver)
    assert solver.reason == "rest"
    assert solver.reasons == phi.reasons
    assert not solver.trusted

    solver.reset()
    y = sparseskin.compress(frames, phi, tare=30, invert=sign < 0)
    forces = sparseskin.reconstruct(y, solver)
    # The frames of the tare are none of forces.
    assert phi.reasons == ("rest",) * 30 + ("",) * (len(frames) - 30)
    assert solver.reasons[:30] == phi.reasons[:30]
    assert "rest" not in solver.reasons[30:]
    assert solver.reason == ""
    assert solver.trusted
    np.testing.assert_allclose(forces[-1][2:4, 3:6], 200, atol=12)


@pytest.mark.parametrize("tare", [-1, 10_001, 1.5, True])
def test_a_tare_that_is_no_number_of_frames_is_refused(tare):
    with pytest.raises(
        SparseskinError, match=r"^stream: tare = .*allowed: a whole number"
    ):
        sparseskin.Stream(SHAPE, tare=tare)
    with pytest.raises(SettingsError, match=r"^invert = 'yes' is not allowed"):
        Zero(SKIN, invert="yes")


def test_fewer_frames_than_those_of_the_tare_are_refused():
    phi = sparseskin.make_phi("sbhe", n=48, m=24, seed=0)
    with pytest.raises(PhiError, match=r"^compress: tare = 30: there are 5 frames"):
        sparseskin.compress(readings(1)[:5].astype(np.float32), phi, tare=30)
