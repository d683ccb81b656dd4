"""Pictures of the live page in several states, for a person to look at: `make shots`.

They are of real graphs, in a real browser; written to docs/.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import tempfile
from pathlib import Path
from typing import Any

from browser import browser, dark, lack
from conftest import Program, wait_until

DOCS = Path(__file__).parent.parent / "docs"


def text(page: Any, selector: str) -> str:
    script = "return document.querySelector(arguments[0])?.innerText ?? ''"
    return str(page.execute_script(script, selector))


def shoot(page: Any, name: str) -> None:
    path = DOCS / f"page_{name}.png"
    page.save_screenshot(str(path))
    print(f"{path.relative_to(DOCS.parent)}", flush=True)


def n_drawn(page: Any) -> int:
    return int(page.execute_script("return Number(document.body.dataset.drawn ?? 0)"))


def touched(page: Any) -> bool:
    """True if a body presses on the skin now and there is some history to show."""
    found = re.search(r"total ([0-9.]+) N", text(page, '[data-panel="truth"] figcaption'))
    return found is not None and float(found[1]) > 8 and n_drawn(page) > 800


def one_patch(page: Any, folder: Path) -> None:
    """A wrench is dragged over the skin; then the sensor hangs."""
    program = Program(
        "launch", "drag_wrench_64", "--set", "sensor.rate_hz=100", "--set", "monitor.port=0",
        cwd=folder,
    )  # fmt: skip
    try:
        page.get(program.wait_for("live page: "))
        wait_until(lambda: touched(page), "the wrench on the skin")
        shoot(page, "live")
        sensor = program.pid_of("sensor")
        os.kill(sensor, signal.SIGSTOP)
        wait_until(lambda: "not answering" in text(page, "#nodes"), "the notice")
        shoot(page, "stale")
        os.kill(sensor, signal.SIGCONT)
    finally:
        program.kill_all()
        program.process.communicate()


def two_patches(page: Any, folder: Path) -> None:
    """The overview of two patches; then one of them on a phone in the dark."""
    program = Program("launch", "two_patches", "--set", "monitor.port=0", cwd=folder)
    try:
        page.get(program.wait_for("live page: "))
        wait_until(lambda: n_drawn(page) > 500, "frames of both")
        shoot(page, "overview")
        dark(page, True)
        metrics = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
        page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        page.execute_script("location.hash = '#/forearm'")
        before = n_drawn(page)
        wait_until(lambda: n_drawn(page) > before + 100, "frames of one")
        shoot(page, "phone")
    finally:
        program.kill_all()
        program.process.communicate()


def main() -> int:
    if lack():
        print(lack(), file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as folder, browser(Path(folder) / "profile") as page:
        one_patch(page, Path(folder))
        two_patches(page, Path(folder))
    return 0


if __name__ == "__main__":
    sys.exit(main())
