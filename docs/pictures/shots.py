"""Pictures of the live page in several states, for a person to look at: `make shots`.

They are of real graphs, in a real browser, and are written to docs/pictures/.
`make shots SHOTS="hero contact"` takes some of them.
"""

import base64
import contextlib
import io
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from browser import browser, lack
from conftest import Program, wait_until

DOCS = Path(__file__).parent
DRAGGED_FROM = 1200
"""The wrench of drag_wrench_40 lies on the skin and is dragged from about this frame on."""
CONTACT_HZ, CONTACT_FROM, CONTACT_S = 55, 300, 15.0
"""It touches the skin at frame 320, bounces twice, and lies on it from about frame 850 on."""
TWO_BODIES = """
import numpy as np
from sparseskin.messages.skin import Skin
from sparseskin.studies.presses import press_frames
from sparseskin.nodes.sensor.source import Source

class Bodies(Source):
    name, delivers, n_frames = "two_bodies", "truth", 3000
    skin = Skin(40, 40, f_max=2.5, pitch_m=0.005)

    def __iter__(self):  # each on its half; the peg is lifted now and then
        plate = press_frames("plate", (20, 40), self.n_frames, 3, speed=0.2)
        peg = press_frames("peg", (20, 40), self.n_frames, 8, speed=0.3, active=0.06)
        for k, ((above, _), (below, _)) in enumerate(zip(plate, peg)):
            pressed = np.float32(np.clip(4 * np.cos(k / 50) + 3, 0, 1))
            yield 50_000_000 * k, np.concatenate([above, pressed * below])
"""
CONTACT_FPS, COLOURS, MAX_BYTES = 8, 128, 2_000_000


@contextlib.contextmanager
def launched(page: Any, folder: Path, name: str, *settings: str) -> Iterator[Program]:
    """A graph with its live page, which the browser shows."""
    words = [word for one in (*settings, "monitor.port=0") for word in ("--set", one)]
    compiled = {"SPARSESKIN_FAST": "auto"}
    with Program("launch", name, *words, cwd=folder, environment=compiled) as program:
        page.get(program.wait_for("live page: "))
        yield program


def text(page: Any, selector: str) -> str:
    script = "return document.querySelector(arguments[0])?.innerText ?? ''"
    return str(page.execute_script(script, selector))


def shoot(page: Any, name: str) -> None:
    from PIL import Image

    path = DOCS / f"page_{name}.png"
    with Image.open(io.BytesIO(page.get_screenshot_as_png())) as image:
        # In full colour: 256 colours leave steps in the colour bars.
        image.convert("RGB").save(path, optimize=True)
    print(f"{path.relative_to(DOCS.parent.parent)}", flush=True)


def paletted(image: Any, colours: int) -> Any:
    """A smaller picture, which keeps the few, far colours of a colour bar."""
    from PIL import Image

    method = Image.Quantize.MAXCOVERAGE
    return image.convert("RGB").quantize(
        colours, method=method, dither=Image.Dither.NONE
    )


def n_drawn(page: Any) -> int:
    return int(page.execute_script("return Number(document.body.dataset.drawn ?? 0)"))


def is_marked(page: Any) -> bool:
    """True if a map is marked, as one that is old on a busy host."""
    marks = (
        "return document.querySelectorAll('[data-mark]:not([data-mark=\"\"])').length"
    )
    return bool(page.execute_script(marks))


def touched(page: Any) -> bool:
    """True if a body presses on the skin now."""
    found = re.search(
        r"total ([0-9.]+) N", text(page, '[data-panel="truth"] figcaption')
    )
    return found is not None and float(found[1]) > 8


def hero(page: Any, folder: Path) -> None:
    """A wrench is dragged over the skin, and the solver trusts what it makes of it."""
    with launched(page, folder, "drag_wrench_40", "sensor.rate_hz=50"):
        wait_until(lambda: n_frames(page) >= DRAGGED_FROM, "the drag")
        wait_until(
            lambda: (
                touched(page) and not text(page, "#notices") and not is_marked(page)
            ),
            "a trusted contact",
        )
        shoot(page, "live")


def contact(page: Any, folder: Path) -> None:
    """The first contact of a wrench, as an animated picture of the maps."""
    from PIL import Image

    frames: list[Image.Image] = []
    times_s: list[float] = []
    with launched(page, folder, "drag_wrench_40", f"sensor.rate_hz={CONTACT_HZ}"):
        wait_until(
            lambda: n_frames(page) >= CONTACT_FROM, "the time before the contact"
        )
        # A notice that comes or goes would move the maps.
        page.execute_script("document.querySelector('#notices').style.display = 'none'")
        box = page.execute_script(
            "const r = document.querySelector('#maps').getBoundingClientRect();"
            "return {x: r.x, y: r.y, width: r.width, height: r.height}"
        )
        shot = {"format": "png", "clip": {**box, "scale": 1}}
        began_s = time.monotonic()
        while (now_s := time.monotonic() - began_s) < CONTACT_S:
            if is_marked(page):
                time.sleep(0.02)
                continue
            data = page.execute_cdp_cmd("Page.captureScreenshot", shot)["data"]
            with Image.open(io.BytesIO(base64.b64decode(data))) as image:
                frames.append(image.convert("RGB"))
            times_s.append(now_s)
            # Pictures more often than that make the file larger, and nothing clearer.
            time.sleep(max(0.0, began_s + len(frames) / CONTACT_FPS - time.monotonic()))
    path = DOCS / "contact.gif"
    ends_s = [*times_s[1:], CONTACT_S]
    durations = [round(1e3 * (b - a)) for a, b in zip(times_s, ends_s, strict=True)]
    # One palette, of a frame in contact, so that what stands still is the same bytes.
    palette = paletted(frames[-1], COLOURS)
    small = [one.quantize(palette=palette, dither=Image.Dither.NONE) for one in frames]
    small[0].save(
        path,
        save_all=True,
        append_images=small[1:],
        duration=durations,
        loop=0,
        optimize=True,
    )
    size = path.stat().st_size
    print(
        f"docs/pictures/contact.gif: {len(frames)} pictures, {size / 1e6:.2f} MB",
        flush=True,
    )
    assert size < MAX_BYTES, f"{path}: larger than {MAX_BYTES} bytes"


def contacts(page: Any, folder: Path) -> None:
    """A plate and a peg slide over the skin: rings, trails, list, events."""
    (folder / "two_bodies.py").write_text(TWO_BODIES)
    stated = ("contacts=true", "contact_over=50", "contact_slide=20")
    settings = ("sensor.source=two_bodies:Bodies", "sensor.rate_hz=20")
    named = (f"reconstructor.{setting}" for setting in stated)
    with launched(page, folder, "replay", *settings, *named):
        rings = (
            "return document.querySelectorAll('ellipse.contact:not(.doubtful)').length"
        )
        wait_until(
            lambda: (
                n_frames(page) > 900
                and page.execute_script(rings) == 2
                and not text(page, "#notices")
            ),
            "two bodies on the skin",
        )
        shoot(page, "contacts")


def n_frames(page: Any) -> int:
    """Number of frames that the page shows."""
    found = re.search(r"Frames\s+(\d+)", text(page, "#headline"))
    return int(found[1]) if found else 0


def overview(page: Any, folder: Path) -> None:
    """The overview of a body, zoomed to its contacts."""
    with launched(
        page, folder, "body", "sensor.rate_hz=20", "reconstructor.contacts=true"
    ):
        wait_until(
            lambda: text(page, "[data-tile=pressed] strong") == "8",
            "eight that are pressed",
        )
        page.execute_script("document.getElementById('zoom').click()")
        before = n_drawn(page)
        wait_until(lambda: n_drawn(page) > before + 500, "frames of history")
        wait_until(lambda: not text(page, "#notices"), "no notice")
        shoot(page, "overview")


def torso(page: Any, folder: Path) -> None:
    """A body is pressed all round: its taxels in 3-D, zoomed to the contact."""
    size = {"width": 1280, "height": 720, "deviceScaleFactor": 1, "mobile": False}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    caption = '[data-panel="reconstruction"] figcaption'
    with launched(page, folder, "torso", "sensor.rate_hz=20"):
        wait_until(lambda: n_drawn(page) > 120, "frames of history")
        wait_until(
            lambda: (
                "contact on the near side" in text(page, caption)
                and not text(page, "#notices")
            ),
            "a contact on the near side",
        )
        # The view is turned to the contact, which may have moved to the edge of what is seen.
        page.execute_script("document.getElementById('zoom').click()")
        before = n_drawn(page)
        wait_until(lambda: n_drawn(page) > before + 5, "the view of the contact")
        shoot(page, "torso")


def main() -> int:
    if lack():
        print(lack(), file=sys.stderr)
        return 2
    with (
        tempfile.TemporaryDirectory() as folder,
        browser(Path(folder) / "profile") as page,
    ):
        for name in sys.argv[1:] or SHOTS:
            SHOTS[name](page, Path(folder))
    return 0


SHOTS = {
    "hero": hero,
    "contact": contact,
    "contacts": contacts,
    "overview": overview,
    "torso": torso,
}


if __name__ == "__main__":
    sys.exit(main())
