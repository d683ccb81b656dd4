"""Skins of points on the live page, in a real browser: turned, zoomed, pointed at."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from browser import browser, lack
from conftest import wait_until
from exported import contacts
from feeds import Graph, graph_state, node_state, served

from sparseskin.messages import Measurements, Reconstruction, Taxels, Truth

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(lack()), reason=lack() or "a browser is installed"),
]

N_ROWS = 50
N_COLS = 81
MASK = np.ones((N_ROWS, N_COLS), np.bool_)
"""Each row has a cell without a taxel. Its bytes are no multiple of 4, as those after it are."""
MASK[:, 40] = False
FRONT = (0.11, 0.0, 0.0)
BACK = (-0.11, 0.0, 0.0)
PEAK_N = 2.0
RADIUS_M = 0.06
NODE = {"type": "reconstructor", "patches": [], "controls": [], "settings": {}}
CHOOSE = (
    "const select = document.getElementById(arguments[0]); select.value = arguments[1];"
    "select.dispatchEvent(new Event('change'));"
)
ZOOM = "document.getElementById('zoom').click()"
VIRIDIS_TOP = (0xFD, 0xE7, 0x25)
VIRIDIS_ZERO = (0x44, 0x01, 0x54)


WIDTH_M = 0.36
DEPTH_M = 0.22
HEIGHT_M = 0.5


def torso(n_rows: int = 50, n_cols: int = 80, seed: int = 0) -> np.ndarray:
    """A point of each cell around a torso, x to the front, z up: metres and outward normals."""
    rng = np.random.default_rng(seed)
    rows, cols = np.indices((n_rows, n_cols)).reshape(2, -1) + rng.uniform(
        0.3, 0.7, (2, 1)
    )
    rows, cols = (each + rng.uniform(-0.2, 0.2, each.shape) for each in (rows, cols))
    angle = 2 * np.pi * cols / n_cols
    height = rows / n_rows
    # The shoulders close, the waist is narrower than the chest.
    wide = np.sqrt(np.clip(1 - (np.clip(height - 0.7, 0, 1) / 0.42) ** 2, 0, 1))
    wide *= 1 - 0.15 * np.cos(np.pi * np.clip(height - 0.3, -0.3, 0.4) / 0.4)
    x = DEPTH_M / 2 * wide * np.cos(angle)
    y = WIDTH_M / 2 * wide * np.sin(angle)
    z = HEIGHT_M * (height - 0.5)
    normals = np.stack([x / DEPTH_M**2, y / WIDTH_M**2, np.zeros_like(x)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[:, 2] = 1.2 * np.clip(height - 0.7, 0, 1) / 0.3
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.concatenate([np.stack([x, y, z], axis=1), normals], axis=1).astype(
        np.float32
    )


def pressed(
    points: np.ndarray, at: tuple[float, float, float], peak_n: float, radius_m: float
) -> np.ndarray:
    """Forces, float32 (n,): a cap of a peak at the point nearest to `at`, 0 beyond a radius."""
    nearest = np.argmin(np.linalg.norm(points[:, :3] - at, axis=1))
    distance = np.linalg.norm(points[:, :3] - points[nearest, :3], axis=1)
    return (peak_n * np.clip(1 - (distance / radius_m) ** 2, 0, 1)).astype(np.float32)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("browser") / "profile") as driver:
        yield driver


@pytest.fixture(scope="module")
def points():
    return torso(N_ROWS, N_COLS)[MASK.ravel()]


@pytest.fixture
def graph(page, points):
    """A torso that is pressed in front with the top of the colour range, on the open page."""
    with opened(page, points) as graph:
        press(graph, points, FRONT)
        wait_until(lambda: "peak 2.00 N" in figures(page), "the map of a frame")
        yield graph


@contextlib.contextmanager
def opened(page, points):
    """A torso without a frame, on the open page; its file has the taxels in reverse order."""
    graph = Graph()
    rows = np.arange(len(points), dtype=np.int32)[::-1].copy()
    graph.skin(
        n_rows=N_ROWS,
        n_cols=N_COLS,
        mask=MASK,
        points=points,
        point_rows=rows,
        pitch_m=0.011,
    )
    with served(graph, page):
        yield graph
        # That readings of pixels are slow is a remark, and no error.
        errors = [
            each["message"]
            for each in page.get_log("browser")
            if each["level"] == "SEVERE"
        ]
        assert not [text for text in errors if "ERR_" not in text]


def press(graph, points, at, peak_n=PEAK_N):
    """The next frame, without noise: the truth is pressed, and reconstructed exactly."""
    n, graph.n["skin"] = graph.n["skin"], graph.n["skin"] + 1
    of_frame = {"stamp_ns": n * 10_000_000, "patch": "skin"}
    forces = np.zeros((N_ROWS, N_COLS), np.float32)
    forces[MASK] = pressed(points, at, peak_n, RADIUS_M)
    made = {"phi": "0" * 16, "iterations": 1, "residual": 0.0}
    frame = [
        Taxels(**of_frame, forces=forces),
        Truth(**of_frame, forces=forces),
        Measurements(**of_frame, y=np.zeros(12, np.float32), phi="0" * 16),
        Reconstruction(**of_frame, **made, forces=forces, solve_ns=1, done_ns=1),
    ]
    for message in frame:
        graph.take(message.published("0" * 16, n))


def run(page, script, *arguments):
    return page.execute_script(script, *arguments)


def figures(page):
    return str(run(page, "return document.querySelector('[data-panel=reconstruction] figcaption')"
                         "?.innerText ?? ''"))  # fmt: skip


def image(page, which="reconstruction"):
    canvas = f"document.querySelector('canvas[data-map={which}]')"
    return str(run(page, f"return {canvas}.toDataURL()"))


def pixels(page, colour):
    """Number of pixels of a colour in the reconstruction, and their middle, 0 to 1 of its sides."""
    n, x, y = run(
        page,
        """
        const { width, height } = arguments[0], [r, g, b] = arguments[1];
        const { data } = arguments[0].getContext('2d').getImageData(0, 0, width, height);
        let n = 0, x = 0, y = 0;
        for (let k = 0; k < width * height; k++) {
          const at = 4 * k;
          if (data[at] !== r || data[at + 1] !== g || data[at + 2] !== b) continue;
          n += 1;
          x += (k % width) + 0.5;
          y += Math.floor(k / width) + 0.5;
        }
        return [n, x / n / width, y / n / height];
        """,
        page.find_element("css selector", "canvas[data-map=reconstruction]"),
        list(colour),
    )
    return int(n), float(x or 0), float(y or 0)


def drag(page, by_x, by_y=0):
    from selenium.webdriver.common.action_chains import ActionChains

    canvas = page.find_element("css selector", "canvas[data-map=reconstruction]")
    chain = ActionChains(page, duration=20).move_to_element(canvas).click_and_hold()
    chain.move_by_offset(by_x, by_y).release().perform()


def width(page):
    canvas = "document.querySelector('canvas[data-map=reconstruction]')"
    return int(run(page, f"return {canvas}.clientWidth"))


def settled(page):
    """Wait until the view that was turned is drawn in full again: two pixels for one."""
    canvas = "document.querySelector('canvas[data-map=reconstruction]')"
    fine = f"return {canvas}.width > 1.4 * {canvas}.clientWidth"
    wait_until(lambda: bool(run(page, fine)), "the fine picture")


def test_a_contact_is_a_ring_at_its_place_which_is_faint_on_the_far_side(
    page, graph, points
):
    middle = (
        "const [m, e] = ['canvas', 'ellipse.contact'].map((which) => document.querySelector("
        "  `[data-panel=reconstruction] ${which}`)?.getBoundingClientRect());"
        "return e && ['x', 'y'].map((a) => {"
        "  const side = a === 'x' ? 'width' : 'height';"
        "  return (e[a] + e[side] / 2 - m[a]) / m[side]; });"
    )
    for at, normal in ((FRONT, 1.0), (BACK, -1.0)):
        place = {
            "place_mm": 1e3 * np.array([at], np.float32),
            "area": np.array([30], np.int32),
        }
        press(graph, points, FRONT)
        one = replace(
            contacts(1), stamp_ns=graph.feed.patches["skin"].stamp_ns, **place
        )
        graph.take(replace(one, normal=np.array([[normal, 0, 0]], np.float32)))
        far = "return document.querySelectorAll('ellipse.contact.far').length"
        is_behind = normal < 0
        placed = lambda: run(page, far) == is_behind and run(page, middle)  # noqa: B023, E731
        wait_until(placed, "the ring")
        if normal > 0:
            _, x, y = pixels(page, VIRIDIS_TOP)
            assert run(page, middle) == pytest.approx([x, y], abs=0.05)


def test_the_pressed_place_has_the_colour_of_its_force_and_a_drag_turns_it_away(
    page, graph
):
    settled(page)
    before = image(page)
    (n, middle, _) = pixels(page, VIRIDIS_TOP)
    assert n > 20
    assert pixels(page, VIRIDIS_ZERO)[0] > 100 * n / 20
    # The first contact faces the viewer; a drag to the right takes it along.
    assert middle == pytest.approx(0.5, abs=0.05)
    drag(page, width(page) // 12)
    wait_until(lambda: image(page) != before, "another view")
    settled(page)
    m, moved, _ = pixels(page, VIRIDIS_TOP)
    assert m > 20
    assert moved > middle + 0.02
    # Half a turn: the place is on the far side, and its caption says so.
    for _ in range(2):
        drag(page, width(page) // 2 - 10)
    wait_until(lambda: pixels(page, VIRIDIS_TOP)[0] == 0, "the other side")
    wait_until(
        lambda: "100 % of the contact on the far side" in figures(page), "its share"
    )
    run(page, ZOOM)
    wait_until(lambda: "on the near side" in figures(page), "the side of the contact")
    wait_until(
        lambda: abs(pixels(page, VIRIDIS_TOP)[1] - 0.5) < 0.05, "it in the middle"
    )
    assert pixels(page, VIRIDIS_TOP)[0] > 2 * n
    run(page, ZOOM)
    settled(page)
    wait_until(lambda: image(page) == before, "the view of the beginning")


def test_faulty_taxels_are_struck_out_where_they_are_seen(page, graph, points):
    cells = np.flatnonzero(MASK)
    faulty = [
        int(cells[np.linalg.norm(points[:, :3] - p, axis=1).argmin()])
        for p in (FRONT, BACK)
    ]
    node = {**NODE, "patch": "skin", "state": {"faulty_taxels": faulty}}
    graph.feed.update(graph=graph_state(node_state("reconstructor", **node)))
    crosses = (
        "return document.querySelectorAll('[data-panel=reconstruction] .faulty').length"
    )
    wait_until(lambda: run(page, crosses) == 1, "the one on the near side")
    run(page, CHOOSE, "view", "grid")
    wait_until(lambda: run(page, crosses) == 2, "both on the grid")
    run(page, CHOOSE, "view", "space")


def test_keys_and_wheel_turn_and_zoom_all_maps_alike(page, graph):
    from selenium.webdriver.common.keys import Keys

    settled(page)
    canvas = page.find_element("css selector", "canvas[data-map=truth]")
    before = image(page)
    for keys in (Keys.ARROW_LEFT, Keys.ARROW_UP, "+"):
        seen = image(page)
        canvas.send_keys(keys)
        wait_until(lambda: image(page) != seen, "another view")  # noqa: B023
        settled(page)
        wait_until(lambda: image(page, "truth") == image(page), "the same on both")
    canvas.send_keys(Keys.HOME)
    settled(page)
    wait_until(lambda: image(page) == before, "the view of the beginning")
    n = pixels(page, VIRIDIS_TOP)[0]
    run(
        page,
        "const box = arguments[0].getBoundingClientRect();"
        "arguments[0].dispatchEvent(new WheelEvent('wheel', { deltaY: -600, cancelable: true,"
        "  clientX: box.left + box.width / 2, clientY: box.top + box.height / 2 }));",
        canvas,
    )
    wait_until(lambda: image(page) != before, "a closer view")
    settled(page)
    wait_until(lambda: pixels(page, VIRIDIS_TOP)[0] > 3 * n, "a larger place")


def test_the_taxel_under_the_pointer_is_named_with_its_place_and_forces(
    page, graph, points
):
    from selenium.webdriver.common.action_chains import ActionChains

    k = int(np.argmax(pressed(points, FRONT, PEAK_N, RADIUS_M)))
    row = len(points) - 1 - k
    run(page, ZOOM)
    settled(page)
    wait_until(
        lambda: abs(pixels(page, VIRIDIS_TOP)[1] - 0.5) < 0.05, "it in the middle"
    )
    canvas = page.find_element("css selector", "canvas[data-map=reconstruction]")
    _, x, y = pixels(page, VIRIDIS_TOP)
    offset = [
        round((at - 0.5) * canvas.rect[side])
        for at, side in ((x, "width"), (y, "height"))
    ]
    ActionChains(page).move_to_element_with_offset(canvas, *offset).perform()
    shown = "return document.getElementById('under-pointer').innerText"
    where = ", ".join(f"{1000 * v:.1f}" for v in points[k, :3])
    wait_until(
        lambda: f"taxel {row} at {where} mm: truth 2.0000" in run(page, shown),
        "its values",
    )
    assert "reconstruction 2.0000" in run(page, shown)
    rings = "return document.querySelectorAll('#maps ellipse').length"
    assert run(page, rings) >= 2


def test_any_map_is_shown_large_and_the_grid_of_the_same_skin(page, graph, points):
    large = "return document.querySelector('#maps .large h2').innerText"
    assert run(page, large) == "Reconstruction"
    run(page, "document.querySelector('[data-panel=truth] button').click()")
    assert run(page, large) == "Truth"
    run(page, CHOOSE, "view", "grid")
    wait_until(lambda: pixels(page, VIRIDIS_TOP)[0] > 0, "the frame on the grid")
    size = "const c = document.querySelector('[data-map=truth]'); return [c.width, c.height]"
    assert run(page, size) == [N_COLS, N_ROWS]
    press(graph, points, BACK)  # in the middle of the grid, which the map zooms to
    wait_until(lambda: run(page, size)[0] < N_COLS, "the part that is pressed")
    run(page, CHOOSE, "view", "space")
    settled(page)


def test_patches_of_a_body_stand_at_their_poses_with_what_they_do(page, points):
    graph = Graph("front", "back", "torso")
    poses = {"front": [300, 0, 0, 90, 0, 90], "back": [-300, 0, 0, 90, 0, -90]}
    graph.feed.poses = {name: [float(v) for v in pose] for name, pose in poses.items()}
    now = "return document.querySelector(`#row-${arguments[0]} td:nth-child(2)`)?.innerText"
    with served(graph, page):
        for patch in ("front", "back"):
            graph.skin(patch, mask=None, f_max=0.5, pitch_m=0.05)
        graph.skin("torso", n_rows=N_ROWS, n_cols=N_COLS, mask=MASK, points=points)

        def is_pressed():
            graph.frame("front", unchanged=True)
            graph.frame("back", forces=np.zeros((1, 5, 7), np.float32), unchanged=True)
            return (
                run(page, now, "front") == "pressed"
                and run(page, now, "back") == "idle"
            )

        wait_until(is_pressed, "what each does")
        assert run(page, now, "torso") == "no frame yet"
        place = (
            "const [pose, done] = arguments; import('./cloud.js').then(({ Cloud }) => {"
            "  const skin = { n_rows: 5, n_cols: 7, pitch_m: 0.05, data: {}, pose };"
            "  const cloud = new Cloud([skin]);"
            "  done([cloud.place(0), cloud.normal(0)].map((v) => [...v])); });"
        )
        corner, normal = page.execute_async_script(place, poses["front"])
        assert corner == pytest.approx([0.3, -0.15, 0.1], abs=1e-6)
        assert normal == pytest.approx([1, 0, 0], abs=1e-6)
