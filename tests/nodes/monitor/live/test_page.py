"""The live page in a real browser, on a real graph."""

import json
import math
import os
import re
import signal

import numpy as np
import pytest
from bags import N_COLS, N_ROWS
from browser import browser, lack
from conftest import wait_until
from exported import contacts
from feeds import Graph, graph_state, served

from sparseskin.messages import Reason
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.sensor.calibration.description import SkinDescription
from sparseskin.nodes.sensor.skin_file import save_skin

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(lack()), reason=lack() or "a browser is installed"),
]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("browser") / "profile") as driver:
        yield driver


def open_page(start, page, *arguments):
    """Launch a graph and open its page; the page shows frames."""
    program = start("launch", *arguments, "--set", "monitor.port=0")
    url = program.wait_for("live page: ")
    program.wait_for("ready:")
    page.get(url)
    canvases = "#maps canvas"
    wait_until(lambda: bool(page.find_elements("css selector", canvases)), "the maps")
    wait_until(lambda: int(drawn(page)) > 0, "the first frame")
    return program


def drawn(page):
    return str(page.execute_script("return document.body.dataset.drawn ?? '0'"))


def text(page, selector):
    # In one go: an element found first and read later may be gone in between.
    script = "return [...document.querySelectorAll(arguments[0])].map((e) => e.innerText).join(' ')"
    return str(page.execute_script(script, selector))


def pixels(page, which):
    return str(
        page.execute_script(
            f"return document.querySelector('canvas[data-map={which}]').toDataURL()"
        )
    )


def set_field(page, field, value):
    """Type a value into a control, once it is there, and press Enter."""
    there = "return document.getElementById(arguments[0]) !== null"
    wait_until(lambda: bool(page.execute_script(there, field)), f"the control {field}")
    page.execute_script(
        "const input = document.getElementById(arguments[0]);"
        "input.value = arguments[1];"
        "input.form.requestSubmit();",
        field,
        value,
    )


def choose(page, field, value):
    """Choose a value, and wait until the solver shown is the one of that name."""
    script = "const s = document.getElementById(arguments[0]); s.value = arguments[1];"
    page.execute_script(f"{script} s.dispatchEvent(new Event('change'));", field, value)
    solver = "return document.getElementById('reconstructor.solver').value"
    wait_until(lambda: page.execute_script(solver) == value, "the solver")


def answer(page, field):
    return text(page, f'output[data-answer="{field}"]')


def frames_shown(page):
    return int(text(page, '[data-tile="frames"] strong'))


def frames_played(page, stamps_ns):
    """Frames of a recording before the player's position, which is the next frame's."""
    position_s = float(
        page.find_element("css selector", "[data-seek]").get_property("value")
    )
    return sum((ns - stamps_ns[0]) / 1e9 < position_s - 1e-6 for ns in stamps_ns)


def test_a_running_graph_is_watched_controlled_and_recorded_from_the_page(
    start, page, tmp_path
):
    program = open_page(start, page, "path_40", "--set", "sensor.rate_hz=30")
    for which in ("taxels", "reconstruction", "error"):
        before = pixels(page, which)
        wait_until(lambda: pixels(page, which) != before, f"another map of {which}")  # noqa: B023
    assert (
        text(page, "figure h2")
        == "Truth Taxels (measured) Reconstruction Absolute error"
    )
    nothing_is_asked_of_another_host(page)
    field = "reconstructor.iterations"
    set_field(page, field, "7")
    wait_until(lambda: answer(page, field) == "✓ iterations = 7", "the answer")
    wait_until(
        lambda: page.find_element("id", field).get_property("value") == "7",
        "the new value",
    )
    # What the owner refuses changes nothing, and the page says why.
    set_field(page, field, "0")
    wait_until(
        lambda: answer(page, field) == "✗ iterations: 0 is outside 1..1000",
        "the refusal",
    )
    choose(page, "reconstructor.solver", "fista")
    choose(page, "reconstructor.preset", "skin")
    faded = f"return getComputedStyle(document.querySelector('[data-answer=\"{field}\"]')).opacity"
    wait_until(lambda: page.execute_script(faded) == "0", "the refusal to fade")
    set_field(page, "sensor.rate_hz", "0")
    wait_until(lambda: text(page, "#liveness") == "paused", "the pause")
    set_field(page, "sensor.rate_hz", "20")
    wait_until(lambda: "Pause" in text(page, "[data-pause]"), "the run to go on")
    set_field(page, "compressor.m", "400")
    wait_until(
        lambda: text(page, '[data-tile="compression"] strong') == "4.00 : 1", "M = 400"
    )
    page.execute_script("document.getElementById('record').click()")
    wait_until(
        lambda: answer(page, "launch").startswith("✓ recording to"), "the recording"
    )
    wait_until(lambda: "Stop" in text(page, "#record"), "the button to change")
    shown = int(drawn(page))
    wait_until(lambda: int(drawn(page)) > shown + 10, "some frames")
    page.execute_script("document.getElementById('record').click()")
    wait_until(
        lambda: "messages recorded" in answer(page, "launch"),
        "the end of the recording",
    )
    (file,) = tmp_path.glob("path_40-*.mcap")
    assert file.stat().st_size > 10_000
    wait_until(
        lambda: text(page, "#liveness") == "live", "the page to say that all is well"
    )
    sensor = program.pid_of("sensor")
    os.kill(sensor, signal.SIGSTOP)
    try:
        wait_until(
            lambda: "stale: no new frame for" in text(page, "#notices"), "the notice"
        )
        wait_until(
            lambda: "sensor: not answering" in text(page, "#nodes"), "the node's state"
        )
        assert text(page, "#liveness") == "stale"
        assert len(page.find_elements("css selector", "#maps figure.stale")) == 4
    finally:
        os.kill(sensor, signal.SIGCONT)
    wait_until(lambda: "stale" not in text(page, "#notices"), "the notice to go")
    wait_until(lambda: text(page, "#liveness") == "live", "all to be well again")
    assert page.find_elements("css selector", "#maps figure.stale") == []


def nothing_is_asked_of_another_host(page):
    entries = [
        json.loads(entry["message"])["message"] for entry in page.get_log("performance")
    ]
    asked = [
        entry["params"]["request"]["url"]
        for entry in entries
        if entry["method"] == "Network.requestWillBeSent"
    ]
    host = page.current_url.partition("#")[0]
    assert f"{host}main.js" in asked
    # The browser's own first page is of another scheme.
    web = [url for url in asked if url.startswith(("http", "ws"))]
    assert [url for url in web if not url.startswith(host)] == []
    assert page.get_log("browser") == []


def test_hosts_are_in_the_header(page):
    graph = Graph()
    graph.skin()
    with served(graph, page):
        host = {
            "heard": True,
            "silent": [],
            "clock_offset_ms": 0.1,
            "clock_uncertainty_ms": 0.3,
        }
        graph.feed.update(graph=graph_state(hosts={"edge": host}))
        graph.frame()
        clock = "host edge: connected, clock +0.10 ± 0.30 ms"
        wait_until(lambda: text(page, "#hosts li") == clock, "the host in the header")


def test_contacts_are_rings_with_their_force_rows_that_stay_and_marks(page):
    graph = Graph()
    graph.skin()
    rows = (
        "return [...document.querySelectorAll('#contacts tbody tr')]"
        ".map((e) => [e.innerText, e.className]);"
    )

    def row(k):
        shown = page.execute_script(rows)
        return " ".join(" ".join(shown[k]).split()) if shown else ""

    def touch(k, **estimate):
        graph.frame(**estimate)
        graph.take(contacts(k))

    with served(graph, page):
        graph.frame()
        wait_until(lambda: int(drawn(page)) > 0, "the first frame")
        assert page.find_elements("css selector", "#contacts, .contact") == []
        touch(1)
        touch(2)
        labels = "return [...document.querySelectorAll('text.contact')].map((e) => e.textContent);"
        told = ["1: 2.50 N", "2: 2.50 N"]
        wait_until(lambda: page.execute_script(labels) == told, "the labels")
        of_map, of_ring = page.execute_script(
            "return ['canvas', 'ellipse.contact'].map((which) => {"
            "  const b = document.querySelector(`[data-panel=reconstruction] ${which}`)"
            "    .getBoundingClientRect();"
            "  return [b.x + b.width / 2, b.y + b.height / 2, b.width];"
            "});"
        )
        cell = (of_map[2] - 2) / 7  # row and column 0.5 of 5 rows and 7 columns
        place = [of_ring[k] - of_map[k] for k in (0, 1)]
        assert place == pytest.approx([-2.5 * cell, -1.5 * cell], abs=1.0)
        wait_until(lambda: row(1) == "2 3 ± 3 2.5, 2.5 2 1 2.5", "the second row")
        touch(3)
        touch(4, error=0.1, trusted=False)
        first = "1 5 ± 5 5.0, 5.0 1 1 4.5 doubtful"
        wait_until(lambda: row(0) == first, "the first row again")
        assert row(1).endswith("ended")
        assert len(page.find_elements("css selector", "ellipse.contact.doubtful")) == 1
        begins = (
            "const canvas = document.querySelector('[data-strip=force]');"
            "const {data} = canvas.getContext('2d')"
            "  .getImageData(0, 0, canvas.width, canvas.height);"
            "return data.some((_, k) => k % 4 === 0 && data[k] === 0x0b && data[k + 1] === 0x6e);"
        )
        wait_until(lambda: bool(page.execute_script(begins)), "the mark of a begin")


def test_the_axis_of_a_chart_has_room_for_latencies_below_0(page):
    script = (
        "const done = arguments[1], points = arguments[0].map((v, k) => [k, v, null]);"
        "import('./strips.js').then((m) => done(m.limits([{ points }], {}, 0)));"
    )
    with served(Graph(), page):
        assert page.execute_async_script(script, [-3, 5]) == [-4, 6]
        assert page.execute_async_script(script, [3, 5]) == [0, 6]


def test_the_marks_of_frames_in_doubt_and_of_old_frames_move_nothing(page):
    graph = Graph()
    graph.skin()
    places = (  # a notice above them moves them all
        "const top = document.getElementById('headline').getBoundingClientRect().y;"
        "return [...document.querySelectorAll('.tile, #maps figure, #strips figure')].map((e) => {"
        "  const b = e.getBoundingClientRect(); return [b.x, b.y - top, b.width, b.height]; });"
    )
    marks = (
        "return ['[data-tile=gain]', '[data-panel=reconstruction] h2'].map((which) => "
        "  getComputedStyle(document.querySelector(which), '::after').content);"
    )
    shares = '[data-tile="gain"] span'
    with served(graph, page):
        graph.frame(error=0.1)
        graph.summarise()
        wait_until(lambda: "100 % trusted" in text(page, shares), "the share")
        assert "not trusted" not in "".join(page.execute_script(marks))
        before = page.execute_script(places)
        assert len(before) > 10
        graph.frame(error=0.1, trusted=False, reason="error")
        wait_until(
            lambda: (
                page.execute_script(marks)
                == ['"not trusted"', f'"not trusted: {Reason.ERROR.phrase}"']
            ),
            "a mark beside each",
        )
        explained = "return document.querySelector('[data-tile=gain]').title;"
        assert page.execute_script(explained) == Reason.ERROR.sentence
        graph.summarise()
        wait_until(lambda: "50 % trusted" in text(page, shares), "the share")
        assert page.execute_script(places) == before
        old = "return [...document.querySelectorAll('#maps h2')].every((h) => h.dataset.age);"
        wait_until(lambda: page.execute_script(old), "the age of each map")
        assert page.execute_script(places) == before
        graph.frame(error=0.1)
        wait_until(
            lambda: "not trusted" not in "".join(page.execute_script(marks)), "no marks"
        )
        assert page.execute_script(explained) == ""


def test_a_taxel_whose_reading_is_missing_looks_like_no_force(page):
    graph = Graph()
    graph.skin(mask=None)
    missing = np.packbits(np.arange(N_ROWS * N_COLS) == N_COLS + 2)
    colour = (
        "return [...document.querySelector('canvas[data-map=reconstruction]')"
        ".getContext('2d').getImageData(2, 1, 1, 1).data];"
    )
    figures = '[data-panel="reconstruction"] figcaption'
    with served(graph, page):
        graph.frame(missing=missing)
        wait_until(lambda: "1 readings missing" in text(page, figures), "the count")
        red, green, blue, alpha = page.execute_script(colour)
        assert red == green == blue
        assert alpha == 255


def test_a_colour_range_grows_at_once_and_shrinks_after_a_while(page):
    script = (
        "const done = arguments[1];"
        "import('./colours.js').then(({ Range }) => {"
        "  const range = new Range(0.05, 2.5);"
        "  done(arguments[0].map(([peak, s]) => range.over(peak, 1000 * s))); });"
    )
    with served(Graph(), page):
        peaks = [[0, 0], [0.9, 1], [1.1, 1.1], [0.9, 2], [0.3, 6], [0.1, 7.2], [9, 8]]
        assert page.execute_async_script(script, peaks) == [0.05, 1, 2, 2, 2, 1, 2.5]


def test_the_numbers_of_the_page_are_those_of_the_summary(start, page, tmp_path):
    summary = tmp_path / "summary.json"
    settings = (
        "--set",
        "sensor.rate_hz=30",
        "--frames",
        "450",
        "--summary",
        str(summary),
    )
    settings += ("--set", "reconstructor.depth=0")
    open_page(start, page, "drag_wrench_40", *settings).ended()
    wait_until(
        lambda: "The graph has ended" in text(page, "#notices"), "the end on the page"
    )
    assert "The graph has ended: nothing can be set." in text(page, "#controls")
    assert page.find_elements("css selector", "#controls :enabled") == []
    patch = json.loads(summary.read_text())["patches"]["skin"]
    noisy, restored = (
        patch["psnr_db"][k]["contact"]["mean"] for k in ("noisy", "reconstruction")
    )
    assert text(page, '[data-tile="gain"] h2') == "PSNR gain in contact"
    assert text(page, '[data-tile="frames"] strong') == "450"
    assert text(page, '[data-tile="frames"] span') == "of 450, 0 lost"
    trust = patch["trust"]["contact"]
    shown = f"mean {noisy:.1f} → {restored:.1f} dB"
    if trust is not None:
        percent = (
            min(99, round(100 * trust["trusted_share"])) if trust["untrusted"] else 100
        )
        shown = f"{noisy:.1f} → {restored:.1f} dB, {percent} % trusted"
    assert text(page, '[data-tile="gain"] span') == shown
    assert (
        text(page, '[data-tile="latency"] strong')
        == f"{patch['latency_ms']['p50']:.1f} ms"
    )
    assert text(page, '[data-tile="compression"] strong') == f"{patch['ratio']:.2f} : 1"


OLD_SKIN = """
import time, numpy as np

def frames():
    rng = np.random.default_rng(0)
    while True:
        time.sleep(0.01)
        yield time.monotonic_ns(), 40 + rng.normal(0, 1, (4, 6))
"""


def test_a_skin_whose_baseline_is_old_is_tared_from_the_page(start, page, tmp_path):
    (tmp_path / "old_skin.py").write_text(OLD_SKIN)
    sent = SkinDescription(
        "old", 4, 6, 50.0, unit="N", baseline=np.full((4, 6), 35.0), noise=1.0
    )
    save_skin(tmp_path / "old.toml", sent)
    open_page(
        start, page, "replay", "--set", "sensor.source=old_skin:frames",
        "--set", "sensor.skin=old.toml", "--set", "sensor.rate_hz=50",
    )  # fmt: skip
    button = '[data-tare="sensor"]'
    taxels = '[data-panel="taxels"] figcaption'

    def total_n():
        found = re.search(r"total ([0-9.]+) N", text(page, taxels))
        return float(found[1]) if found else math.nan

    wait_until(lambda: total_n() > 80, "24 taxels of 5 N each")
    wait_until(lambda: text(page, button) == "Tare", "the button")
    # Found and clicked in one call: the page may draw the button anew between two.
    page.execute_script("document.querySelector(arguments[0]).click()", button)
    wait_until(
        lambda: answer(page, "launch").startswith("✓ tared: "), "the end of the tare"
    )
    assert "forces changed by at most" in answer(page, "launch")
    assert text(page, button) == "Tare"
    assert page.find_element("css selector", button).is_enabled()
    wait_until(lambda: total_n() < 40, "noise alone")


def test_a_replay_is_paused_stepped_and_sought(start, page, tmp_path):
    every = ("--set", "reconstructor.depth=0")
    program = start(
        "launch", "path_40", "--frames", "300", "--record", "path.mcap", *every
    )
    assert program.finish()[0] == 0
    with BagReader(tmp_path / "path.mcap") as bag:
        # On a busy host they are not 5 ms apart.
        stamps_ns = sorted(
            message.stamp_ns for message in bag.messages(["/skin/taxels"])
        )
    open_page(start, page, "replay_taxels", "--set", "player.file=path.mcap", "--set",
              "player.rate=0.2")  # fmt: skip
    pause = '[data-pause="player"]'
    wait_until(lambda: "Pause" in text(page, pause), "the controls")
    page.find_element("css selector", pause).click()
    wait_until(lambda: "Resume" in text(page, pause), "the button to change")
    wait_until(lambda: text(page, "#liveness") == "paused", "the pause")
    # Frames played before the pause may still be on their way to the page.
    played = frames_played(page, stamps_ns)
    wait_until(lambda: frames_shown(page) == played, "the frames before the pause")
    before = int(drawn(page))
    (step,) = (
        b for b in page.find_elements("css selector", "button") if b.text == "Step"
    )
    step.click()
    wait_until(lambda: frames_played(page, stamps_ns) == played + 1, "one frame more")
    wait_until(lambda: frames_shown(page) == played + 1, "its place in the count")
    wait_until(lambda: int(drawn(page)) > before, "its maps")
    page.execute_script(
        "const seek = document.querySelector('[data-seek=player]');"
        "seek.value = 1; seek.dispatchEvent(new Event('change'));"
    )
    wait_until(lambda: answer(page, "player") == "✓ at 1.00 s", "the answer")
    wait_until(
        lambda: text(page, "[data-position]").startswith("1.0 of"), "the position"
    )


def test_the_address_with_its_token_opens_the_page_and_is_not_kept(start, page):
    program = open_page(start, page, "path_40", "--set", "sensor.rate_hz=30")
    assert "token" not in page.current_url
    page.refresh()
    wait_until(lambda: int(drawn(page)) > 0, "frames after a reload")
    set_field(page, "sensor.rate_hz", "20")
    wait_until(lambda: "✓" in answer(page, "sensor.rate_hz"), "an answer")
    port = page.current_url.split(":")[2].split("/")[0]
    program.process.send_signal(signal.SIGINT)
    program.finish()
    start("launch", "path_40", "--set", f"monitor.port={port}").wait_for("ready:")
    asked = "this page asks for a token: open the address that the graph has printed"
    wait_until(lambda: asked in text(page, "#notices"), "the way to the next graph")
