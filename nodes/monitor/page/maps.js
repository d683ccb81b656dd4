// The maps of one patch: truth, taxels, reconstruction and error on canvases, with a colour bar.
// A skin is drawn as its grid, or, where its taxels have places, in 3-D.

import { Cloud } from "./cloud.js";
import { GRADIENT, pixel, Range } from "./colours.js";
import { Contacts } from "./contacts.js";
import { brief, byId, cross, element, highest, noiseText, setText, tick } from "./dom.js";
import { DARK, SpaceView } from "./space.js";

const TITLES = {
  truth: "Truth",
  taxels: "Taxels (measured)",
  reconstruction: "Reconstruction",
  error: "Absolute error",
};
export const CONTACT = 0.004; // fraction of f_max below which no centre of pressure is shown
const FIRST = 0.04; // fraction of f_max beyond which a force turns the first view or is zoomed to
const TOUCHED = 5; // standard deviations of an untouched taxel below which a reading is no contact
const NOISE = 8; // standard deviations of an untouched taxel that a colour range has at least
const PRESSED = 0.2; // part of the peak beyond which a taxel is zoomed to
const WIDE = 2; // columns per row beyond which the other maps stand below the large one
const AROUND = 2, LEAST_CROP = 0.2; // taxels around it; part of the skin that is shown at least
const INSET = 2; // pixels of the inset for each taxel
const SEPARATOR = "\u00a0· "; // of figures in a caption: a line may end with it, none begins with it

// A map as the grid of its taxels, or the part of it that is pressed.
class GridView {
  constructor(skin) {
    this.skin = skin;
    this.pixel = 0; // of the page in taxels
    this.aspect = skin.n_cols / skin.n_rows;
    this.crop = this.all = { row: 0, col: 0, rows: skin.n_rows, cols: skin.n_cols };
  }

  canvas(label, name) {
    const canvas = element("canvas", { role: "img", "aria-label": label, "data-map": name });
    canvas.style.aspectRatio = this.aspect;
    return canvas;
  }

  // An overlay in units of taxels, (0, 0) at the centre of the first.
  overlay() {
    return element("svg", { class: "over" });
  }

  // Show the whole skin, or from now on the part that is pressed.
  zoom(isOn) {
    this.isZoomed = isOn;
    this.crop = this.all;
  }

  // Choose the part; it stays while all that is pressed lies in it, and after the contact.
  #follow(map) {
    const { n_rows: nRows, n_cols: nCols, f_max: fMax } = this.skin, peak = highest(map);
    if (!this.isZoomed || peak <= FIRST * fMax) return;
    let [top, left, bottom, right] = [nRows, nCols, 0, 0];
    for (let k = 0; k < map.length; k++) {
      if (!(map[k] > PRESSED * peak)) continue;
      const row = Math.floor(k / nCols), col = k % nCols;
      [top, bottom] = [Math.min(top, row), Math.max(bottom, row)];
      [left, right] = [Math.min(left, col), Math.max(right, col)];
    }
    const { row, col, rows, cols } = this.crop;
    const part = Math.max(LEAST_CROP, (bottom - top + 1 + 2 * AROUND) / nRows,
      (right - left + 1 + 2 * AROUND) / nCols);
    const isIn = top >= row && left >= col && bottom < row + rows && right < col + cols;
    if (isIn && this.crop !== this.all && rows < 2 * part * nRows) return;
    const size = (n) => Math.min(n, Math.ceil(Math.min(1, 1.2 * part) * n));
    const from = (middle, n) => Math.max(0, Math.min(n - size(n), Math.round(middle - size(n) / 2)));
    this.crop = { row: from((top + bottom + 1) / 2, nRows), col: from((left + right + 1) / 2, nCols),
      rows: size(nRows), cols: size(nCols) };
  }

  // The size of a pixel is asked for where contacts need it: it costs a layout.
  prepare(canvas, contacts, map) {
    this.#follow(map);
    if (!contacts.list.length) return;
    this.pixel = Math.max(this.crop.cols / (canvas.clientWidth || 1),
      this.crop.rows / (canvas.clientHeight || 1));
  }

  // Where the part that is shown lies on the whole skin, in a corner of the large map.
  inset(canvas, map, top) {
    const { crop, all, skin: { n_rows: nRows, n_cols: nCols, data: { mask } } } = this;
    canvas.hidden = crop === all || !map || (crop.rows === nRows && crop.cols === nCols);
    if (canvas.hidden) return;
    // A contact near an edge is at that edge of the part: the inset is at the other one.
    canvas.classList.toggle("left", 2 * crop.col + crop.cols > nCols);
    canvas.classList.toggle("above", 2 * crop.row + crop.rows > nRows);
    if (canvas.width !== nCols * INSET) [canvas.width, canvas.height] = [nCols * INSET, nRows * INSET];
    const image = new ImageData(nCols * INSET, nRows * INSET), scale = 255 / top;
    const pixels = new Uint32Array(image.data.buffer);
    for (let row = 0, at = 0; row < nRows * INSET; row++) {
      for (let col = 0; col < nCols * INSET; col++) {
        const k = Math.floor(row / INSET) * nCols + Math.floor(col / INSET);
        pixels[at++] = mask && !mask[k] ? 0 : pixel(map[k], scale);
      }
    }
    const g = canvas.getContext("2d");
    g.putImageData(image, 0, 0);
    g.strokeStyle = "#fff";
    g.lineWidth = 2;
    g.strokeRect(INSET * crop.col + 1, INSET * crop.row + 1, INSET * crop.cols - 2, INSET * crop.rows - 2);
  }

  paint(panel, map, top) {
    const { crop, skin: { n_cols: nCols, data: { mask } } } = this;
    if (panel.crop !== crop) {
      panel.crop = crop;
      [panel.canvas.width, panel.canvas.height] = [crop.cols, crop.rows];
      panel.over.setAttribute("viewBox", `${crop.col - 0.5} ${crop.row - 0.5} ${crop.cols} ${crop.rows}`);
      panel.image = new ImageData(crop.cols, crop.rows);
      panel.pixels = new Uint32Array(panel.image.data.buffer);
    }
    const { pixels } = panel, scale = 255 / top;
    for (let row = 0, at = 0; row < crop.rows; row++) {
      let k = (crop.row + row) * nCols + crop.col;
      for (const end = k + crop.cols; k < end; k++) {
        pixels[at++] = mask && !mask[k] ? 0 : pixel(map[k], scale);
      }
    }
    panel.canvas.getContext("2d").putImageData(panel.image, 0, 0);
  }

  // Cell and name of the taxel at a place of the window.
  at([x, y], canvas) {
    const box = canvas.getBoundingClientRect(), { crop } = this;
    const place = (at, start, size, first, n) =>
      first + Math.min(n - 1, Math.max(0, Math.floor(((at - start) / size) * n)));
    const row = place(y, box.top, box.height, crop.row, crop.rows);
    const col = place(x, box.left, box.width, crop.col, crop.cols);
    return { cell: row * this.skin.n_cols + col, name: `row ${row}, column ${col}` };
  }

  // Contacts; faulty taxels are struck out on all panels.
  mark(panels, { faulty, contacts }) {
    for (const [name, { over }] of Object.entries(panels)) {
      over.replaceChildren(...faulty.map((cell) => element("path", { class: "faulty",
        d: cross(cell % this.skin.n_cols, Math.floor(cell / this.skin.n_cols), 0.35) })));
      if (name === "reconstruction") over.append(...this.#drawn(contacts));
    }
  }

  // Contacts in the overlay's units, which begin half a taxel before the first one's centre.
  #drawn(contacts) {
    const { row: y, col: x, rows: h, cols: w } = this.crop;
    return contacts.drawn({ x, y, w, h, pixel: this.pixel },
      ({ centre: [row, col] }) => [col, row], ({ area }) => Math.sqrt(area / Math.PI));
  }

  // Centre of the forces of a map, in mm if the pitch is known.
  centre(map, total) {
    const { n_cols: nCols, pitch_m: pitch } = this.skin;
    let rows = 0, cols = 0;
    for (let k = 0; k < map.length; k++) {
      rows += (map[k] || 0) * Math.floor(k / nCols);
      cols += (map[k] || 0) * (k % nCols);
    }
    const scale = pitch ? 1000 * pitch : 1;
    return `centre ${[rows, cols].map((sum) => ((scale * sum) / total).toFixed(1)).join(", ")} ${
      pitch ? "mm" : "taxels"}`;
  }
}

// Least colour range of a skin: its noise looks like noise.
const least = ({ f_max: fMax, sigma_end: sigma }) => Math.max(0.02 * fMax, NOISE * sigma);

const isZoomed = () => byId("zoom").getAttribute("aria-pressed") === "true";

// A figure of a map in a view: its title, canvas, marks, and a colour bar with its unit.
function panel(view, title, name) {
  const canvas = view.canvas(title, name), over = view.overlay();
  const bar = element("div", { class: "bar" });
  bar.style.background = GRADIENT;
  const top = element("span", {}), figures = element("figcaption", {});
  const map = element("div", { class: "map" }, canvas, over);
  map.style.maxWidth = `calc(var(--room) * ${view.aspect ?? 1})`;
  const heading = element("h2", {}, element("button", { type: "button" }, title));
  const figure = element("figure", { "data-panel": name }, heading,
    element("div", { class: "framed" }, map,
      element("div", { class: "scale" }, top, bar, element("span", {}, "0"))), figures);
  return { canvas, over, map, top, figures, heading, figure };
}

export class Maps {
  constructor(root, skin) {
    const { f_max: fMax } = skin;
    this.skin = skin;
    this.root = root;
    this.forces = new Range(least(skin), fMax);
    this.errors = new Range(0.001 * fMax, fMax);
    this.inset = element("canvas", { class: "inset", role: "img", hidden: true,
      "aria-label": "the part of the skin that is shown" });
    this.panels = {};
    this.maps = {};
    this.faulty = []; // cells of the taxels that the reconstructor leaves out
    this.contacts = new Contacts(skin.sum_unit);
    this.mask = skin.data.mask ?? null;
    this.aborter = new AbortController();
    const hasPlaces = !skin.cloud && Cloud.of(skin);
    this.inSpace = skin.cloud || (hasPlaces && byId("view").value === "space");
    // A grid follows the contact unless its user chose; a body is seen as a whole.
    if (byId("zoom").dataset.chosen === undefined) {
      byId("zoom").setAttribute("aria-pressed", String(!this.inSpace));
    }
    this.view = this.inSpace ? new SpaceView(skin.cloud ?? new Cloud([{ ...skin, pose: null }]))
      : new GridView(skin);
    root.replaceChildren();
    root.classList.toggle("space", Boolean(this.inSpace));
    root.classList.toggle("wide", this.view.aspect >= WIDE);
    const { signal } = this.aborter;
    const names = skin.has_truth ? Object.keys(TITLES)
      : skin.has_taxels ? ["taxels", "reconstruction", "error"] : ["reconstruction"];
    for (const name of names) {
      const title = name === "error" && !skin.has_truth ? "Difference" : TITLES[name];
      const made = this.panels[name] = panel(this.view, title, name);
      this.view.attach?.(made.canvas, () => this.drawSoon(), signal);
      made.heading.addEventListener("click", () => this.enlarge(name));
      root.append(made.figure);
    }
    this.enlarge("reconstruction");
    this.zoom();
    this.unpoint();
    for (const option of document.querySelectorAll("[data-of=places]")) option.hidden = !hasPlaces;
    byId("reset-view").hidden = !this.inSpace;
    root.addEventListener("pointermove", (event) => this.point(event), { signal });
    root.addEventListener("pointerdown", (event) => this.point(event), { signal });
    root.addEventListener("pointerleave", () => this.unpoint(), { signal });
    const again = () => this.drawSoon();
    window.addEventListener("resize", again, { signal });
    DARK.addEventListener("change", again, { signal });
  }

  close() {
    this.aborter.abort();
    this.unpoint();
  }

  // Show one map large, the others beside it.
  enlarge(large) {
    for (const [name, { figure, heading }] of Object.entries(this.panels)) {
      figure.classList.toggle("large", name === large);
      heading.title = name === large ? "" : "show this map large";
    }
    this.large = large;
    this.root.style.setProperty("--n-small", Object.keys(this.panels).length - 1);
    this.drawSoon();
  }

  // Show what is pressed alone, or all.
  zoom() {
    const map = this.maps.reconstruction ?? this.maps.taxels;
    this.view.zoom(isZoomed(), map && highest(map) > CONTACT * this.skin.f_max ? map : null);
    this.drawSoon();
  }

  // Draw the same maps again, once for all that has changed until then.
  drawSoon() {
    if (this.isDue) return;
    this.isDue = true;
    requestAnimationFrame((now) => {
      this.isDue = false;
      if (!this.aborter.signal.aborted) this.draw(now);
    });
  }

  // Show new maps, each float32 (n_rows * n_cols,), row after row, and a list of the
  // frame's contacts.
  show({ data: maps, contacts }, now) {
    this.maps = { ...maps };
    this.contacts.show(contacts, now);
    const reference = maps.truth ?? maps.taxels, felt = maps.reconstruction ?? maps.taxels;
    if (highest(felt) > FIRST * this.skin.f_max) {
      this.view.turnAtFirst?.(felt);
      if (isZoomed()) this.view.follow?.(felt);
    }
    if (maps.reconstruction && reference) {
      this.maps.error = maps.reconstruction.map((v, k) => Math.abs(v - reference[k]));
    }
    this.draw(now);
  }

  draw(now) {
    const shown = Object.entries(this.panels).filter(([name]) => this.maps[name]);
    if (!shown.length) return;
    this.view.prepare(this.panels[this.large].canvas, this.contacts,
      this.maps.reconstruction ?? this.maps.taxels);
    const { truth, taxels, reconstruction } = this.maps;
    const held = this.forces.over(Math.max(...[truth, taxels, reconstruction].map(highest)), now);
    const range = byId("range").value === "full" ? this.skin.f_max : held;
    for (const [name, panel] of shown) {
      const map = this.maps[name];
      const top = name === "error" ? this.errors.over(highest(map), now) : range;
      this.view.paint(panel, map, top);
      setText(panel.top, `${tick(top)} ${this.skin.unit}`);
      setText(panel.figures, name === "error" ? this.errorText(map) : this.forceText(map, name));
    }
    this.panels[this.large].map.append(this.inset);
    this.view.inset?.(this.inset, this.maps[this.large], this.large === "error"
      ? this.errors.over(highest(this.maps.error), now) : range);
    this.mark();
    this.read();
  }

  // What is drawn over the maps.
  mark() {
    const { faulty, contacts, pointed } = this;
    this.view.mark(this.panels, { faulty, contacts, cell: pointed?.cell });
  }

  // Mark the taxels of these cells as faulty.
  markFaulty(cells) {
    if (String(cells) === String(this.faulty)) return;
    this.faulty = cells;
    this.mark();
  }

  forceText(map, name) {
    const { unit, sum_unit: sums, f_max: fMax, sigma_end: sigma } = this.skin;
    let total = 0;
    for (const force of map) total += force || 0;
    const peak = highest(map);
    const noise = name === "taxels" ? TOUCHED * sigma : 0;
    const centre = name !== this.large ? ""
      : `${SEPARATOR}${peak > Math.max(CONTACT * fMax, noise) ? this.view.centre(map, total, peak) : "no contact"}`;
    const missing = missingOf(map), note = missing ? `${SEPARATOR}${missing} readings missing` : "";
    const noisePart = name === "reconstruction" ? noiseText(this.noiseSum, sums) : "";
    const totals = [`total ${brief(total, sums)}`, noisePart].filter((text) => text).join(", ");
    return `peak ${brief(peak, unit)}${SEPARATOR}${totals}${centre}${note}`;
  }

  errorText(map) {
    let sum = 0;
    for (const value of map) sum += value * value || 0;
    const n = (this.mask ? this.mask.reduce((a, b) => a + b, 0) : map.length) - missingOf(map);
    return `peak ${brief(highest(map), this.skin.unit)}${SEPARATOR}RMS ${brief(Math.sqrt(sum / n),
      this.skin.unit)}`;
  }

  point(event) {
    const canvas = event.target.closest("canvas");
    this.pointed = canvas && this.view.at([event.clientX, event.clientY], canvas);
    if (!this.pointed) return this.unpoint();
    this.mark();
    this.read();
  }

  unpoint() {
    this.pointed = null;
    this.mark();
    setText(byId("under-pointer"), this.skin.cloud ? "Double-click a patch to open it."
      : "Point at a taxel to see its values.");
  }

  // The values under the pointer, in all maps.
  read() {
    if (!this.pointed) return;
    const { cell, name } = this.pointed;
    if (this.mask && !this.mask[cell]) {
      setText(byId("under-pointer"), `${name}: no taxel here`);
      return;
    }
    const values = Object.keys(this.panels).filter((which) => this.maps[which])
      .map((which) => [TITLES[which].toLowerCase(), this.maps[which][cell]])
      .map(([title, value]) => `${title} ${Number.isNaN(value) ? "missing" : value.toFixed(4)}`);
    setText(byId("under-pointer"), `${name}: ${values.join(", ")} ${this.skin.unit}`);
  }

  // Grey out stale maps, and show their age.
  markStale(ages, limit, quiet) {
    for (const [name, panel] of Object.entries(this.panels)) {
      const age = ages[name === "error" ? "reconstruction" : name];
      const stale = age === undefined || age > limit;
      panel.figure.classList.toggle("stale", stale && !quiet);
      panel.heading.dataset.age = stale && !quiet && age !== undefined ? `${age.toFixed(1)} s old` : "";
    }
  }
}

// Taxels whose reading is missing.
function missingOf(map) {
  return map.reduce((n, value) => n + Number.isNaN(value), 0);
}
