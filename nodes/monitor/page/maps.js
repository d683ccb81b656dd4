// The maps of one patch: truth, taxels, reconstruction and error on canvases, with a colour bar.

import { GRADIENT, VIRIDIS, rounded } from "./colours.js";
import { brief, byId, element, setText, tick, within } from "./dom.js";

const TITLES = {
  truth: "Truth",
  taxels: "Taxels (measured)",
  reconstruction: "Reconstruction",
  error: "Absolute error",
};
const HOLD_MS = 4000; // the colour range stays wide this long after a peak
const CONTACT = 0.004; // fraction of f_max below which no centre of pressure is shown
const ELLIPSE = 2.146; // standard deviations that contain 90 % of a normal distribution in a plane

export class Maps {
  constructor(root, skin) {
    this.skin = skin;
    this.root = root;
    this.peaks = []; // [time, peak] of the last seconds
    this.panels = {};
    this.maps = {};
    this.mask = skin.data.mask ?? null;
    root.replaceChildren();
    const names = skin.has_truth ? Object.keys(TITLES)
      : skin.has_taxels ? ["taxels", "reconstruction", "error"] : ["reconstruction"];
    for (const name of names) root.append(this.panel(name));
    root.style.setProperty("--n-maps", names.length);
    root.addEventListener("pointermove", (event) => this.point(event));
    root.addEventListener("pointerleave", () => this.unpoint());
  }

  panel(name) {
    const canvas = element("canvas", {
      width: this.skin.n_cols, height: this.skin.n_rows, role: "img",
      "aria-label": TITLES[name], "data-map": name,
    });
    canvas.style.aspectRatio = `${this.skin.n_cols} / ${this.skin.n_rows}`;
    const context = canvas.getContext("2d");
    const image = context.createImageData(this.skin.n_cols, this.skin.n_rows);
    const bar = element("div", { class: "bar" });
    bar.style.background = GRADIENT;
    const top = element("span", {}), figures = element("figcaption", {});
    this.panels[name] = {
      canvas, context, image, pixels: new Uint32Array(image.data.buffer), top, figures,
    };
    const title = name === "error" && !this.skin.has_truth ? "Difference from the taxels"
      : TITLES[name];
    // An overlay in units of taxels, (0, 0) at the centre of the first.
    const { n_rows: nRows, n_cols: nCols } = this.skin;
    const over = element("svg", { class: "over", viewBox: `-0.5 -0.5 ${nCols} ${nRows}` });
    this.panels[name].over = over;
    return element("figure", { "data-panel": name }, element("h2", {}, title),
      element("div", { class: "framed" }, element("div", { class: "map" }, canvas, over),
        element("div", { class: "scale" }, top, bar, element("span", {}, "0"))),
      figures);
  }

  // Show new maps, each float32 (n_rows * n_cols,), row after row, and the frame's resultant.
  show({ data: maps, resultant }, now) {
    this.maps = { ...maps };
    this.resultant = resultant;
    this.mark();
    const reference = maps.truth ?? maps.taxels;
    if (maps.reconstruction && reference) {
      this.maps.error = maps.reconstruction.map((v, k) => Math.abs(v - reference[k]));
    }
    this.draw(now);
  }

  draw(now) {
    const peak = Math.max(...["truth", "taxels", "reconstruction"].map((m) => highest(this.maps[m])));
    this.peaks = this.peaks.filter(([at]) => now - at < HOLD_MS);
    this.peaks.push([now, peak]);
    const held = Math.max(...this.peaks.map(([, value]) => value), 0.02 * this.skin.f_max);
    const range = byId("range").value === "full" ? this.skin.f_max
      : Math.min(rounded(held), this.skin.f_max);
    for (const [name, panel] of Object.entries(this.panels)) {
      const map = this.maps[name];
      if (!map) continue;
      const own = name === "error" && byId("error-range").value === "own";
      const top = own ? Math.min(rounded(highest(map)), this.skin.f_max) : range;
      paint(panel, map, this.mask, top);
      setText(panel.top, `${tick(top)} ${this.skin.unit}`);
      const resultant = name === "reconstruction" && this.resultant;
      setText(panel.figures, name === "error" ? this.errorText(map) : this.forceText(map)
        + (resultant
          ? `\nresultant ${within(resultant.total, resultant.total_sd, this.skin.unit)}` : ""));
    }
    this.read();
  }

  // The centre of pressure estimated from the measurements alone: a cross, and the ellipse that
  // contains it in 90 % of the frames.
  mark() {
    const { row, col, row_sd: rowSd, col_sd: colSd } = this.resultant ?? {};
    const arm = 0.04 * Math.max(this.skin.n_rows, this.skin.n_cols);
    const cross = `M${col - arm} ${row}h${2 * arm}M${col} ${row - arm}v${2 * arm}`;
    this.panels.reconstruction.over.replaceChildren(...(Number.isFinite(row) ? [
      element("ellipse", { cx: col, cy: row, rx: ELLIPSE * colSd, ry: ELLIPSE * rowSd }),
      element("path", { d: cross })] : []));
  }

  forceText(map) {
    const { n_cols: nCols, unit, pitch_m: pitch, f_max: fMax } = this.skin;
    let total = 0, rows = 0, cols = 0, peak = 0;
    for (let k = 0; k < map.length; k++) {
      const force = map[k];
      total += force;
      rows += force * Math.floor(k / nCols);
      cols += force * (k % nCols);
      if (force > peak) peak = force;
    }
    const place = (sum) => pitch ? (1000 * pitch * (sum / total)).toFixed(1)
      : (sum / total).toFixed(1);
    const centre = peak > CONTACT * fMax ? `${place(rows)}, ${place(cols)} ${pitch ? "mm" : ""}`
      : "no contact";
    return `peak ${brief(peak, unit)}\ntotal ${brief(total, unit)}\ncentre ${centre}`;
  }

  errorText(map) {
    let sum = 0;
    for (const value of map) sum += value * value;
    const n = this.mask ? this.mask.reduce((a, b) => a + b, 0) : map.length;
    return `peak ${brief(highest(map), this.skin.unit)}\nRMS ${brief(Math.sqrt(sum / n),
      this.skin.unit)}`;
  }

  point(event) {
    const canvas = event.target.closest("canvas");
    if (!canvas) return this.unpoint();
    const box = canvas.getBoundingClientRect();
    const place = (at, start, size, n) =>
      Math.min(n - 1, Math.max(0, Math.floor(((at - start) / size) * n)));
    this.pointed = [
      place(event.clientY, box.top, box.height, this.skin.n_rows),
      place(event.clientX, box.left, box.width, this.skin.n_cols),
    ];
    this.read();
  }

  unpoint() {
    this.pointed = null;
    setText(byId("under-pointer"), "Point at a taxel to see its values.");
  }

  // The values under the pointer, in all maps.
  read() {
    if (!this.pointed) return;
    const [row, col] = this.pointed, k = row * this.skin.n_cols + col;
    const place = `row ${row}, column ${col}: `;
    if (this.mask && !this.mask[k]) {
      setText(byId("under-pointer"), place + "no taxel here");
      return;
    }
    const values = Object.keys(this.panels).filter((name) => this.maps[name])
      .map((name) => `${TITLES[name].toLowerCase()} ${this.maps[name][k].toFixed(4)}`);
    setText(byId("under-pointer"), `${place}${values.join(", ")} ${this.skin.unit}`);
  }

  // Grey out stale maps, and show their age.
  markStale(ages, limit, quiet) {
    for (const [name, panel] of Object.entries(this.panels)) {
      const age = ages[name === "error" ? "reconstruction" : name];
      const stale = age === undefined || age > limit;
      const figure = panel.canvas.closest("figure");
      figure.classList.toggle("stale", stale && !quiet);
      const title = figure.querySelector("h2");
      title.dataset.age = stale && !quiet && age !== undefined ? `${age.toFixed(1)} s old` : "";
    }
  }
}

// One small map, for the overview; returns its range in words.
export function thumbnail(canvas, map, skin) {
  if (canvas.width !== skin.n_cols || canvas.height !== skin.n_rows) {
    canvas.width = skin.n_cols;
    canvas.height = skin.n_rows;
  }
  const context = canvas.getContext("2d");
  const image = context.createImageData(skin.n_cols, skin.n_rows);
  const top = Math.max(rounded(highest(map)), 0.1 * skin.f_max); // noise is no picture
  paint({ context, image, pixels: new Uint32Array(image.data.buffer) }, map, skin.data.mask, top);
  return `peak ${brief(highest(map), skin.unit)}, colours to ${tick(top)} ${skin.unit}`;
}

function highest(map) {
  let high = 0;
  if (map) for (const value of map) if (value > high) high = value;
  return high;
}

function paint({ context, image, pixels }, map, mask, top) {
  const scale = 255 / top;
  for (let k = 0; k < map.length; k++) {
    pixels[k] = mask && !mask[k] ? 0 : VIRIDIS[Math.max(0, Math.min(255, (map[k] * scale) | 0))];
  }
  context.putImageData(image, 0, 0);
}
