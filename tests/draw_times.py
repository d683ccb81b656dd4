"""Time that the page takes to draw a skin of points, in a real browser: `make page-draw`.

Prints, for skins of several sizes, the median time of a frame drawn on one canvas and of a turn of
the view, in milliseconds.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
from pathlib import Path
from typing import Any

from browser import browser, lack
from clouds import pressed, torso
from feeds import Graph

from sparseskin.messages import Reconstruction, Taxels
from sparseskin.nodes.monitor.live.notices import Notices
from sparseskin.nodes.monitor.live.server import PageServer

GRIDS = ((50, 80), (100, 160), (330, 528))
REPEATS = 60
WIDTH, HEIGHT = 1440, 900
MEASURE = """
const [n, done] = [arguments[0], arguments[1]];
(async () => {
  const { Cloud, rasterise } = await import("./cloud.js");
  const { SpaceView } = await import("./space.js");
  const { skin, map } = await new Promise((found) => {
    const kept = {};
    import("./stream.js").then(({ Stream }) => {
      const stream = new Stream("skin", (record) => {
        if (record.kind === "skin") kept.skin = record;
        if (record.kind === "maps" && record.data.reconstruction) {
          kept.map = record.data.reconstruction;
        }
        if (kept.skin && kept.map) { stream.close(); found(kept); }
      }, () => {});
    });
  });
  const began = performance.now(), cloud = new Cloud(skin), built = performance.now() - began;
  const view = new SpaceView(cloud);
  const canvas = document.querySelector("[data-map=reconstruction]"), panel = { canvas };
  const median = (what) => {
    const times = [];
    for (let k = 0; k < n; k++) {
      const start = performance.now();
      what(k);
      times.push(performance.now() - start);
    }
    return times.sort((a, b) => a - b)[n >> 1];
  };
  view.prepare(canvas);
  view.paint(panel, map, 1);
  const frame = median(() => view.paint(panel, map, 1));
  const turn = median((k) => {
    view.view.yaw += 0.01;
    rasterise(cloud, view.view, view.target);
  });
  done([built, frame, turn, canvas.width, canvas.height]);
})();
"""


def measure(page: Any, n_rows: int, n_cols: int) -> list[float]:
    points = torso(n_rows, n_cols)
    forces = pressed(points, (0.11, 0.0, 0.05), 1.6, 0.05).reshape(n_rows, n_cols)
    graph = Graph()
    graph.skin(n_rows=n_rows, n_cols=n_cols, mask=None, points=points, has_truth=False)
    of_frame: dict[str, Any] = {"stamp_ns": 0, "patch": "skin", "forces": forces}
    graph.take(Taxels(**of_frame))
    made: dict[str, Any] = {"phi": "0" * 16, "iterations": 1, "residual": 0.0}
    graph.feed.frame("skin", Reconstruction(**of_frame, **made, solve_ns=1, done_ns=1), None)
    with contextlib.closing(
        PageServer(graph.feed, Notices(graph.feed), 0, lambda request: None)
    ) as server:
        page.get(server.url + "#/skin")
        return list(page.execute_async_script(MEASURE, REPEATS))


def main() -> int:
    if lack():
        print(lack(), file=sys.stderr)
        return 2
    with (
        tempfile.TemporaryDirectory() as folder,
        browser(Path(folder) / "profile", WIDTH, HEIGHT) as page,
    ):
        page.set_script_timeout(120)
        print(f"window of {WIDTH} x {HEIGHT}, two maps beside each other, medians of {REPEATS}")
        for n_rows, n_cols in GRIDS:
            built, frame, turn, width, height = measure(page, n_rows, n_cols)
            print(
                f"{n_rows * n_cols:>7} points: once {built:.0f} ms, a frame on one canvas of "
                f"{width:.0f} x {height:.0f} pixels {frame:.1f} ms, a turn {turn:.1f} ms",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
