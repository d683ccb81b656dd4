"""Figures of the monitor, against values computed by hand; statistics of streams."""

import dataclasses

import bags
import numpy as np
import pytest
from exported import contacts
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.messages import (
    Measurements,
    PhiState,
    Reason,
    Reconstruction,
    SolverState,
    Taxels,
    Truth,
    size_bytes,
)
from sparseskin.messages.contacts import sum_unit
from sparseskin.messages.quantised import Quantised
from sparseskin.nodes.clock import SAME_CLOCK, ClockEstimate, ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.graph import join
from sparseskin.nodes.monitor import statistics
from sparseskin.nodes.monitor.metrics import MAX_PENDING, PatchMetrics, psnr_db
from sparseskin.nodes.monitor.node import Monitor
from sparseskin.nodes.monitor.statistics import (
    COLUMNS,
    MIN_CAPACITY,
    SPAN_S,
    History,
    Quantiles,
)
from sparseskin.nodes.monitor.table import (
    FEW,
    WIDTH,
    doubts_text,
    status_line,
    summary_table,
)
from sparseskin.nodes.node import Context
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.sensor.node import Sensor

SHAPE = (4, 5)
MS = 1_000_000
HEAD = {"patch": "skin", "run_id": "0" * 16}
SOLVED = {
    **{"phi": "0" * 16, "iterations": (1,), "residual": (0.0,), "solve_ns": (2 * MS,)}
}
PHI = PhiState(
    **HEAD, stamp_ns=0, kind="sbhe", n=20, m=7, block=4, seed=0, fingerprint="0" * 16
)
SOLVER = SolverState(
    **HEAD,
    stamp_ns=0,
    solver="fista",
    basis="haar",
    preset="paper",
    iterations=30,
    lambda_n=0.1,
)


def skin(**changes):
    values = {"n_rows": SHAPE[0], "n_cols": SHAPE[1], "mask": None, "source": "a scene"}
    return bags.skin_state(**values | {"sigma_mid": 0.0, "sigma_end": 0.0} | changes)


def frame(seq, truth, taxels, restored):
    """One frame of uniform maps."""

    def uniform(value):
        return np.full(SHAPE, value, np.float32)

    origin = {**HEAD, "seq": seq, "stamp_ns": 1000 * seq}
    messages = [Taxels(**origin, forces=uniform(taxels))]
    if truth is not None:
        messages.append(Truth(**origin, forces=uniform(truth)))
    messages.append(Measurements(**origin, y=np.ones(7, np.float32), phi="0" * 16))
    if restored is not None:
        messages.append(
            Reconstruction(
                **origin,
                **SOLVED,
                forces=uniform(restored),
                done_ns=1000 * seq + 3 * MS,
            )
        )
    return messages


def metrics_of(*messages):
    metrics = PatchMetrics()
    for message in messages:
        metrics.add(message)
    return metrics


@pytest.mark.parametrize(
    ("error", "db"),
    [(2.5, 0.0), (0.25, 20.0), (0.025, 40.0), (0.0, 100.0), (1e-9, 100.0)],
)
def test_psnr_is_the_range_over_the_root_mean_square_error(error, db):
    assert psnr_db(np.full(SHAPE, error, np.float32), 2.5) == pytest.approx(
        db, abs=1e-4
    )


def test_a_taxel_whose_reading_is_missing_is_not_compared():
    messages = frame(0, 1.0, 1.0, 1.0)
    forces = np.ones(SHAPE, np.float32)
    forces[1, 2] = 2.0
    missing = np.packbits(np.ravel(forces == 2))
    messages[-1] = dataclasses.replace(messages[-1], forces=forces, missing=missing)
    assert metrics_of(skin(), *messages).reconstruction.every.low == 100.0


@pytest.mark.parametrize("unknown", ["/skin/taxels", "/skin/reconstruction"])
def test_while_a_clock_is_unknown_latency_alone_is_unknown(unknown):
    metrics = PatchMetrics(
        clock_of=lambda topic: None if topic == unknown else SAME_CLOCK
    )
    metrics.add(skin())
    *_, complete = [metrics.add(message) for message in frame(0, 1.0, 1.025, 1.0025)]
    assert np.isnan(complete.latency_ms)
    assert np.isfinite(
        [complete.solve_ms, complete.psnr_noisy_db, complete.psnr_db]
    ).all()
    summary = metrics.summary()
    assert metrics.latency_ns is None
    assert summary["latency_ms"] is None
    assert summary["solve_ms"]["p50"] == pytest.approx(2.0, rel=0.003)


def test_noise_and_reconstruction_are_compared_with_the_truth():
    found = metrics_of(
        skin(), *frame(0, 1.0, 1.025, 1.0025), *frame(1, 0.0, 0.25, 0.025)
    ).summary()
    psnr = found["psnr_db"]
    assert found["reference"] == "truth"
    assert psnr["noisy"]["all"] == pytest.approx(
        {"mean": 30, "min": 20, "max": 40}, abs=1e-3
    )
    assert psnr["noisy"]["contact"] == pytest.approx(
        {"mean": 40, "min": 40, "max": 40}, abs=1e-3
    )
    expected = {"mean": 50, "min": 40, "max": 60}
    assert psnr["reconstruction"]["all"] == pytest.approx(expected, abs=1e-2)
    assert found["relative_error"]["mean"] == pytest.approx(0.0025, abs=1e-6)


def test_without_a_truth_the_taxels_are_the_reference():
    summary = metrics_of(skin(has_truth=False), *frame(0, None, 1.0, 1.025)).summary()
    assert summary["reference"] == "taxels"
    assert summary["psnr_db"]["noisy"] == {"all": None, "contact": None}
    assert summary["psnr_db"]["reconstruction"]["all"]["mean"] == pytest.approx(
        40, abs=1e-3
    )


@pytest.mark.parametrize("answer_first", [False, True])
def test_without_taxels_frames_are_counted_by_their_measurements(answer_first):
    metrics = metrics_of(dataclasses.replace(skin(has_truth=False), has_taxels=False))
    # a frame that is not reconstructed, and two that are
    for k, seq in enumerate((0, 2, 3)):
        if seq == 2:
            metrics.add(frame(1, None, 1.0, None)[1])
        messages = [
            dataclasses.replace(m, seq=k) for m in frame(seq, None, 1.0, 1.025)[2:]
        ]
        messages = [frame(seq, None, 1.0, None)[1], *messages]
        for message in reversed(messages) if answer_first else messages:
            metrics.add(message)
    metrics.end("measurements", 4)
    metrics.end("reconstruction", 3)
    summary = metrics.summary()
    assert summary["frames"]["sensed"] == 4
    assert summary["frames"]["reconstructed"] == 3
    assert summary["frames"]["lost"] == 1
    assert summary["reference"] is None
    assert summary["psnr_db"]["reconstruction"] == {"all": None, "contact": None}
    assert summary["latency_ms"]["p50"] == pytest.approx(3.0, rel=3e-3)
    assert summary["bytes_in"] == 0
    assert summary["bytes_out"] > 0
    table = summary_table("path_40", {"skin": summary})
    assert "PSNR" not in table
    assert "taxels" not in table


def test_masked_cells_and_the_order_of_topics_do_not_count():
    mask = np.ones(SHAPE, np.bool_)
    mask[0] = False
    taxels, *others = frame(0, 1.0, 1.0, 1.025)
    wrong = taxels.forces.copy()
    wrong[0, 0, 0] = 2.0
    taxels = dataclasses.replace(taxels, forces=wrong)
    summary = metrics_of(skin(mask=mask), taxels, *others).summary()
    assert summary["psnr_db"]["noisy"]["all"]["mean"] == 100.0
    assert summary["bytes_in"] == size_bytes(taxels) - 4 * SHAPE[1]
    messages = [*frame(0, 1.0, 1.1, 1.2), *frame(1, 1.0, 1.1, 1.3)]
    forward, backward = (
        metrics_of(skin(), *order) for order in (messages, reversed(messages))
    )
    assert forward.summary() == backward.summary()


def test_lost_frames_are_those_sensed_but_not_reconstructed():
    messages = [skin()]
    for seq in range(10):
        messages += (
            frame(seq, 1.0, 1.0, 1.0)[:-1] if seq == 9 else frame(seq, 1.0, 1.0, 1.0)
        )
    metrics = metrics_of(*messages)
    metrics.end("taxels", 2)  # one that counts fewer than arrived removes none
    metrics.end("taxels", 10)
    metrics.end("reconstruction", 9)
    counts = {
        "sensed": 10,
        "reconstructed": 9,
        "skipped": 0,
        "quiet": 0,
        "lost": 1,
        "unpaired": 1,
    }
    assert metrics.summary()["frames"] == counts


@pytest.mark.parametrize("late", [False, True])
def test_frames_that_were_skipped_on_purpose_are_not_lost(late):
    metrics = PatchMetrics(since_ns=0 if late else None)
    metrics.add(skin(has_truth=False))
    n_restored = 0
    for seq in range(10):
        taxels, measurements, reconstruction = frame(seq, None, 1.0, 1.0)
        metrics.add(taxels)
        metrics.add(measurements)
        if seq in (0, 3, 8):  # 1 and 2 are skipped; 4 to 6 are lost, 7 is skipped
            assert isinstance(reconstruction, Reconstruction)
            # 5: before it could hear
            skipped = {0: 5, 3: 2, 8: 1}[seq] if late or seq else 0
            told = dataclasses.replace(reconstruction, skipped=skipped, seq=n_restored)
            metrics.add(told)
            n_restored += 1
            assert metrics.lost_so_far == (3 if seq == 8 else 0)
    # frame 9 is under way
    assert (metrics.skipped, metrics.lost) == (
        3,
        3 if late else 4,
    )


def test_frames_that_are_never_reconstructed_do_not_accumulate():
    metrics = metrics_of(skin())
    for seq in range(3 * MAX_PENDING):
        for message in frame(seq, 1.0, 1.0, None):
            metrics.add(message)
    assert metrics.summary()["frames"]["unpaired"] == 3 * MAX_PENDING


@given(is_reconstructed=st.lists(st.booleans(), min_size=1, max_size=40))
def test_no_frame_before_a_reconstructed_one_is_waited_for(is_reconstructed):
    metrics = metrics_of(skin())
    n_behind = 0
    for seq, has_forces in enumerate(is_reconstructed):
        for message in frame(seq, 1.0, 1.0, 1.0 if has_forces else None):
            metrics.add(message)
        n_behind = 0 if has_forces else n_behind + 1
        assert len(metrics._pending) == n_behind
    n_skipped = is_reconstructed.count(False)
    assert metrics.summary()["frames"]["unpaired"] == n_skipped


def test_the_table_states_of_how_many_frames_its_figures_are():
    frames = [message for seq in range(3) for message in frame(seq, 1.0, 1.0, 1.0)]
    stated = "reconstructed 3, lost 0"
    whole = summary_table(
        "path_40", {"skin": metrics_of(skin(), PHI, SOLVER, *frames).summary()}
    )
    assert f"{stated}\n" in whole
    # The truth of the last frame is missing.
    cut = [
        m
        for m in frames
        if not (isinstance(m, Truth) and m.stamp_ns == frames[-1].stamp_ns)
    ]
    part = summary_table(
        "path_40", {"skin": metrics_of(skin(), PHI, SOLVER, *cut).summary()}
    )
    assert f"{stated};\n            figures of 2 (the others came too late)\n" in part


@pytest.mark.parametrize(
    ("graph", "title"),
    [("torso", "torso: skin, a scene"), ("a scene", "a scene: skin")],
)
def test_a_table_is_named_by_what_was_launched_and_by_what_was_sensed(graph, title):
    summary = metrics_of(skin(), PHI, SOLVER, *frame(0, 1.0, 1.0, 1.0)).summary()
    table = summary_table(graph, {"skin": summary})
    assert table.split("\n")[0].strip("=") == f" {title} "


@given(st.integers(FEW + 1, 60), st.from_regex(r"[a-z_0-9]{1,20}", fullmatch=True))
def test_a_table_of_many_patches_is_named_by_what_was_launched(n, name):
    summary = metrics_of(skin(), PHI, SOLVER, *frame(0, 1.0, 1.0, 1.0)).summary()
    title = summary_table(name, {f"p{k}": summary for k in range(n)}).split("\n")[0]
    assert title.strip("=") == f" {name}: {n} patches "


def test_times_and_bytes_and_names():
    messages = frame(0, 1.0, 1.0, 1.0)
    summary = metrics_of(skin(), PHI, SOLVER, *messages).summary()
    assert summary["latency_ms"]["p50"] == pytest.approx(3.0, rel=0.003)
    assert summary["solve_ms"]["p99"] == pytest.approx(2.0, rel=0.003)
    assert summary["n"] == 20
    assert summary["m"] == 7
    assert summary["ratio"] == 20 / 7
    assert summary["bits"] == 32
    assert summary["ratio_bits"] == 20 / 7
    assert summary["bytes_in"] == size_bytes(messages[0])
    assert summary["bytes_out"] == size_bytes(messages[2])
    assert summary["scene"] == "a scene"
    assert summary["phi"] == "sbhe"
    assert summary["basis"] == "haar"
    assert summary["solver"] == "fista"


def test_a_graph_that_saw_nothing_has_a_line_in_place_of_a_table():
    table = summary_table("path_40", {"skin": PatchMetrics().summary()})
    assert table == "path_40: skin: ended before the first frame"
    table = summary_table("path_40", {"skin": metrics_of(skin(), PHI).summary()})
    assert table == "path_40: skin, a scene: ended before the first frame"


def test_settings_that_change_during_the_run_are_listed():
    phi = dataclasses.replace(PHI, m=5)
    preset = dataclasses.replace(
        SOLVER, solver="skin", basis="", preset="skin", iterations=4
    )
    metrics = metrics_of(skin(), phi, PHI, SOLVER, *frame(0, 1.0, 1.0, 1.0), phi)
    metrics.add(preset)
    metrics.add(dataclasses.replace(preset, preset="", iterations=9))
    for message in frame(1, 1.0, 1.0, 1.0):
        quantised = isinstance(message, Measurements)
        y = Quantised.of(np.ones(7, np.int32), 8, 1.0) if quantised else None
        metrics.add(dataclasses.replace(message, y=y) if quantised else message)
    metrics.add(dataclasses.replace(skin(), sigma_mid=0.5))
    summary = metrics.summary()
    found = [tuple(change.values()) for change in summary["changes"]]
    assert found == [
        (1, "m", 7, 5),
        (1, "preset", "paper", "skin"),
        (1, "iterations", 4, 9),
        (1, "bits", 32, 8),
        (2, "sigma_mid", 0.0, 0.5),
    ]
    table = summary_table("path_40", {"skin": summary})
    listed = (
        "settings changed during the run: M 7 -> 5 at frame 1, preset paper -> skin at frame 1, "
        "iterations 4 -> 9 at frame 1, bits 32 -> 8 at frame 1, 1 more; figures cover all of them"
    )
    assert listed in " ".join(table.split())
    assert max(map(len, table.splitlines())) <= 80


def test_the_status_line_counts_what_is_missing_so_far():
    messages = frame(3, 1.0, 1.0, 1.0)
    messages[-1] = dataclasses.replace(messages[-1], seq=1)
    line = status_line({"skin": metrics_of(skin(), *messages)}, 200.0)
    assert line == (
        "skin: 2 frames, 200 Hz, lost 2 | 20 N | PSNR 100.0 dB | latency p50 3.0, p99 3.0 ms | "
        "taxels 100.0 dB"
    )
    messages[-1] = dataclasses.replace(messages[-1], seq=3, done_ns=250 * MS)
    late = status_line({"skin": metrics_of(skin(), *messages)}, 200.0)
    assert "lost 0 | latency p50 250" in late
    messages[-1] = dataclasses.replace(messages[-1], seq=3, done_ns=3700 * MS)
    queued = status_line({"skin": metrics_of(skin(), *messages)}, 200.0)
    assert queued.startswith("skin: 4 frames, 200 Hz, lost 0, newest 3.7 s old | ")
    untouched = metrics_of(skin(), *estimated(0, 0.0, trusted=True))
    assert status_line({"skin": untouched}, 9.0).startswith(
        "skin: 1 frames, 9 Hz, lost 0 | no contact | latency"
    )


@given(st.lists(st.floats(0.0, 1e3), min_size=1, max_size=4))
def test_a_total_force_stands_beside_the_part_of_it_that_is_noise(noise_sums):
    patches = {}
    for k, noise_sum in enumerate(noise_sums):
        solver = dataclasses.replace(SOLVER, noise_sum=noise_sum)
        patches[f"p{k}"] = metrics_of(skin(), solver, *frame(0, 1.0, 1.0, 1.0))
    line = status_line(patches, 200.0)
    total = f"| {20 * len(patches):.3g} N"
    if not any(noise_sums):
        assert f"{total} |" in line
        return
    untouched = f"an untouched skin shows about {sum(noise_sums):.3g} N"
    assert f"{total} ({untouched}) |" in line
    table = patches["p0"].summary()
    assert table["noise_sum"] == noise_sums[0]


def test_a_status_line_of_80_columns_has_the_contacts():
    metrics = metrics_of(skin(), *estimated(123456, 1.0, trusted=True), contacts(2))
    assert "| 2 contacts, 5 N |" in status_line({"forearm": metrics}, 1000.0)[:79]
    many = {f"p{k:03}": metrics for k in range(9)}
    assert "| 18 contacts, 45 N" in status_line(many, 1000.0)[:79]
    assert [sum_unit(unit) for unit in ("N", "counts", "kPa")] == [
        "N",
        "counts",
        "kPa x taxels",
    ]


def estimated(seq, force, trusted, error=0.1):
    """A frame whose solver estimates its error."""
    *others, last = frame(seq, force, force, force)
    return [*others, dataclasses.replace(last, error=error, trusted=trusted)]


def test_frames_that_the_solver_does_not_trust_are_counted():
    metrics = metrics_of(skin(), *frame(0, 1.0, 1.0, 1.0))
    assert metrics.summary()["trust"] == {"all": None, "contact": None}
    assert "trusted" not in status_line({"skin": metrics}, 200.0)
    messages = [*estimated(1, 0.0, trusted=False), *estimated(2, 0.0, trusted=True)]
    for message in messages:
        metrics.add(message)
    for seq, trusted in enumerate((True, True, False, True), start=3):
        for message in estimated(seq, 1.0, trusted, error=0.1 if trusted else None):
            metrics.add(message)
    summary = metrics.summary()
    assert summary["trust"] == {
        "all": {"frames": 6, "untrusted": 2, "trusted_share": pytest.approx(2 / 3)},
        "contact": {"frames": 4, "untrusted": 1, "trusted_share": 0.75},
    }
    assert "dB | trusted 75.0 % | latency" in status_line({"skin": metrics}, 200.0)
    table = summary_table("path_40", {"skin": summary})
    words = [
        row.split()
        for row in table.splitlines()
        if row.startswith("trusted by the solver")
    ]
    assert [" ".join(row[4:]) for row in words] == [
        "all frames 66.7 % (2 of 6 not)",
        "contact frames 75.0 % (1 of 4 not)",
    ]
    assert " ".join(table.split("=\n")[-1].split()) == (
        "2 of 6 frames are in doubt: the estimated error is a large part of the forces. "
        "If the error lasts, more measurements or rotating rows may help."
    )


ADVICE = " If the error lasts, more measurements or rotating rows may help."


@pytest.mark.parametrize("reason", Reason)
def test_frames_that_are_not_trusted_for_one_reason_are_one_sentence(reason):
    text = doubts_of(reason)
    advice = ADVICE if reason == Reason.ERROR else ""
    assert text == f"1 of 2 frames is in doubt: {reason.phrase}.{advice}"


@pytest.mark.parametrize("reason", sorted(set(Reason) - {Reason.FROZEN}))
def test_of_several_reasons_each_has_its_number_of_frames(reason):
    text = doubts_of(reason, Reason.FROZEN, reason)
    advice = ADVICE if reason == Reason.ERROR else ""
    assert text == (
        f"3 of 4 frames are in doubt; in 2 frames: {reason.phrase}; in 1 frame: measurements "
        f"repeat exactly.{advice}"
    )


def test_a_reason_of_another_version_is_named_and_one_that_is_not_stated_is_the_error():
    assert (
        doubts_of("uniform") == '1 of 2 frames is in doubt: unknown reason "uniform".'
    )
    assert doubts_of("") == doubts_of(Reason.ERROR)


def doubts_of(*reasons):
    """Sentence on frames that are not trusted for these reasons, after one that is."""
    metrics = metrics_of(skin(), *estimated(0, 1.0, trusted=True))
    for seq, reason in enumerate(reasons, start=1):
        *others, last = estimated(seq, 1.0, trusted=False)
        for message in (*others, dataclasses.replace(last, reason=reason)):
            metrics.add(message)
    lines = doubts_text([metrics.summary()]).splitlines()
    assert max(map(len, lines)) <= WIDTH
    return " ".join(lines)


@pytest.mark.parametrize(
    ("stated", "clipped"), [(True, True), (False, True), (False, False)]
)
def test_untouched_frames_of_a_noisy_recording_are_not_in_contact(stated, clipped):
    (n, n_pressed) = (32 * 32, 40)
    sigma = 0.05
    force = 1.0
    k_pressed = range(40, 60)
    metrics = metrics_of(
        skin(n_rows=32, n_cols=32, has_truth=False, sigma_end=sigma * stated)
    )
    rng = np.random.default_rng(0)
    for k in range(60):
        true = np.zeros((32, 32), np.float32)
        true.flat[100 : 100 + n_pressed] = force * (k in k_pressed)
        noisy = (true + rng.normal(0, sigma, (32, 32))).clip(0 if clipped else None)
        taxels, measured, last = frame(k, None, 0.0, 0.0)
        metrics.add(dataclasses.replace(taxels, forces=noisy.astype(np.float32)))
        metrics.add(measured)
        metrics.add(
            dataclasses.replace(last, forces=true, error=sigma, trusted=k in k_pressed)
        )
    first = not stated  # the noise is not known before the second frame
    trust = metrics.summary()["trust"]["contact"]
    assert trust["frames"] == len(k_pressed) + first
    assert trust["untrusted"] == first
    noise2 = sigma**2 * (n_pressed + (n - n_pressed) / (1 + clipped))
    expected = np.sqrt(noise2 / (noise2 + n_pressed * force**2))
    relative = (metrics.relative_error.total - first) / len(k_pressed)
    assert relative == pytest.approx(expected, rel=0.02)


def test_a_late_monitor_counts_no_frame_as_lost_before_the_first_it_compares():
    metrics = PatchMetrics(since_ns=0)
    # Of a frame whose taxels it has not received.
    metrics.add(Truth(**HEAD, stamp_ns=0, forces=np.ones(SHAPE, np.float32)))
    metrics.add(skin(has_truth=False))
    frames = [frame(seq, None, 1.0, 1.0) for seq in range(40, 45)]
    for messages in frames[:2]:
        metrics.add(messages[0])
    for messages in (frames[2], frames[4]):
        for message in messages:
            metrics.add(message)
    found = metrics.summary()["frames"]
    # by their numbers: frame 43 is lost for this reader alone
    assert metrics.reconstructed == 3
    assert found["lost"] == metrics.lost_so_far == found["unpaired"] == 0


def test_a_monitor_reads_contacts_where_they_are_written():
    settings = Monitor.Settings()
    for told in (False, True):
        nodes = {
            "sensor": (Sensor, Sensor.Settings(source="scene:path_40")),
            "compressor": (Compressor, Compressor.Settings()),
            "reconstructor": (Reconstructor, Reconstructor.Settings(contacts=told)),
            "monitor": (Monitor, settings),
        }
        read = {link.topic for link in join(nodes) if link.reader == "monitor"}
        assert ("/skin/contacts" in read) == told
        assert set(Monitor.inputs(settings)) <= read


def test_a_monitor_watches_several_patches_apart():
    settings = Monitor.Settings(patches=("left", "right"))
    monitor = Monitor(settings, Context("monitor", ManualClock()))
    assert "/left/measurements" in Monitor.inputs(settings)
    assert "/left/taxels" in Monitor.optional_inputs(settings)
    assert "/right/reconstruction" in Monitor.inputs(settings)
    monitor.step(dataclasses.replace(skin(), patch="left"))
    monitor.ended("/right/taxels", 5)
    patches = monitor.report()["patches"]
    assert patches["left"]["scene"] == "a scene"
    assert patches["right"]["frames"]["sensed"] == 5
    assert monitor.status().count("\n") == 1


@pytest.mark.parametrize(
    ("sensor_ms", "reconstructor_ms", "uncertainty_ms"),
    [((-5000, 2), (0, 0), 2), ((5, 2), (-1, 1), 3)],
)
def test_offsets_of_clocks_are_subtracted(sensor_ms, reconstructor_ms, uncertainty_ms):
    clocks = {
        f"/skin/{schema}": ClockEstimate(ahead * MS, within * MS)
        if within
        else SAME_CLOCK
        for schema, (ahead, within) in (
            ("taxels", sensor_ms),
            ("reconstruction", reconstructor_ms),
        )
    }
    metrics = PatchMetrics(clock_of=clocks.get)
    acquired_ns = 10_000 * MS  # on our clock
    times = {
        "stamp_ns": acquired_ns + sensor_ms[0] * MS,
        "done_ns": acquired_ns + (4 + reconstructor_ms[0]) * MS,
    }
    message = dataclasses.replace(frame(0, 1.0, 1.0, 1.0)[-1], **times)
    assert isinstance(message, Reconstruction)
    metrics.add(message)
    assert metrics.latency_ns == 4 * MS
    assert metrics.latency_uncertainty_ns == uncertainty_ms * MS


@given(
    st.lists(st.floats(1.1e3, 0.9e12), min_size=1),
    st.sampled_from([0.01, 0.5, 0.9, 0.99]),
)
def test_a_quantile_is_right_within_a_quarter_percent(values, q):
    quantiles = Quantiles()
    for value in values:
        quantiles.add(value)
    exact = np.quantile(values, q, method="inverted_cdf") / 1e6
    assert quantiles.quantile_ms(q) == pytest.approx(exact, rel=0.0026)


def row(time_s):
    """A row whose every value follows from its time."""
    return (time_s, *(time_s + k for k in range(1, len(COLUMNS))))


def filled(n_rows, period_s):
    history = History()
    for k in range(n_rows):
        history.add(*row(k * period_s))
    return history


def test_it_grows_no_further_than_its_greatest_size(monkeypatch):
    monkeypatch.setattr(statistics, "MAX_CAPACITY", 2 * MIN_CAPACITY)
    n = 5 * MIN_CAPACITY
    first, rows = filled(n, 0.0).since(0)
    assert first == 3 * MIN_CAPACITY
    assert len(rows) == 2 * MIN_CAPACITY


@given(st.integers(1, 9000), st.floats(0.0, 0.2), st.integers(0, 9000))
def test_it_is_the_end_of_a_plain_list(n_rows, period_s, n):
    history = filled(n_rows, period_s)
    plain = [row(k * period_s) for k in range(n_rows)]
    assert history.n == n_rows
    first, rows = history.since(n)
    assert first >= n
    assert [tuple(kept) for kept in rows] == plain[first:]
    oldest, _ = history.since(0)
    # Nothing of the last minute is missing: what is gone is older than that.
    assert oldest == 0 or plain[-1][0] - plain[oldest - 1][0] >= SPAN_S
