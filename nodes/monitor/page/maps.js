// The maps of one patch: truth, taxels, reconstruction and error on canvases, with a colour bar.
// A skin is drawn as its grid, or, where its taxels have places, in 3-D.

import { Cloud } from "./cloud.js";
import { GRADIENT, pixel, rounded } from "./colours.js";
import { Contacts } from "./contacts.js";
import { brief, byId, cross, element, setText, tick, within } from "./dom.js";
import { DARK, SpaceView } from "./space.js";

const TITLES = {
  truth: "Truth",
  taxels: "Taxels (measured)",
  reconstruction: "Reconstruction",
  error: "Absolute error",
};
const HOLD_MS = 4000; // the colour range stays wide this long after a peak
const CONTACT = 0.004; // fraction of f_max below which no centre of pressure is shown
const FIRST = 0.04; // fraction of f_max beyond which a force turns the first view: noise is below
const ELLIPSE = 2.146; // standard deviations that contain 90 % of a normal distribution in a plane

// A map as the grid of its taxels.
class GridView {
  constructor(skin) {
    this.skin = skin;
    this.pixel = 0; // of the page in taxels
  }

  canvas(label, name) {
    const { n_cols: nCols, n_rows: nRows } = this.skin;
    const canvas = element("canvas", { width: nCols, height: nRows, role: "img",
      "aria-label": label, "data-map": name });
    canvas.style.aspectRatio = `${nCols} / ${nRows}`;
    return canvas;
  }

  // An overlay in units of taxels, (0, 0) at the centre of the first.
  overlay() {
    return element("svg", { class: "over",
      viewBox: `-0.5 -0.5 ${this.skin.n_cols} ${this.skin.n_rows}` });
  }

  attach() {}

  // The size of a pixel is asked for where contacts need it: it costs a layout.
  prepare(canvas, contacts) {
    if (!contacts.list.length) return;
    const { n_cols: nCols, n_rows: nRows } = this.skin;
    this.pixel = Math.max(nCols / (canvas.clientWidth || 1), nRows / (canvas.clientHeight || 1));
  }

  paint(panel, map, top) {
    panel.image ??= new ImageData(this.skin.n_cols, this.skin.n_rows);
    panel.pixels ??= new Uint32Array(panel.image.data.buffer);
    const { mask } = this.skin.data, { pixels } = panel, scale = 255 / top;
    for (let k = 0; k < map.length; k++) {
      pixels[k] = mask && !mask[k] ? 0 : pixel(map[k], scale);
    }
    panel.canvas.getContext("2d").putImageData(panel.image, 0, 0);
  }

  // Cell and name of the taxel at a place of the window.
  at([x, y], canvas) {
    const box = canvas.getBoundingClientRect(), { n_cols: nCols, n_rows: nRows } = this.skin;
    const place = (at, start, size, n) =>
      Math.min(n - 1, Math.max(0, Math.floor(((at - start) / size) * n)));
    const [row, col] = [place(y, box.top, box.height, nRows), place(x, box.left, box.width, nCols)];
    return { cell: row * nCols + col, name: `row ${row}, column ${col}` };
  }

  // The centre of pressure estimated from the measurements alone: a cross, and the ellipse that
  // contains it in 90 % of the frames; contacts. Faulty taxels are struck out on all panels.
  mark(panels, { resultant, faulty, contacts }) {
    const { row, col, row_sd: rowSd, col_sd: colSd } = resultant ?? {};
    const arm = 0.04 * Math.max(this.skin.n_rows, this.skin.n_cols);
    const plus = `M${col - arm} ${row}h${2 * arm}M${col} ${row - arm}v${2 * arm}`;
    for (const [name, { over }] of Object.entries(panels)) {
      over.replaceChildren(...faulty.map((cell) => element("path", { class: "faulty",
        d: cross(cell % this.skin.n_cols, Math.floor(cell / this.skin.n_cols), 0.35) })));
      if (name !== "reconstruction") continue;
      over.append(...this.#drawn(contacts));
      if (!Number.isFinite(row)) continue;
      over.append(
        element("ellipse", { cx: col, cy: row, rx: ELLIPSE * colSd, ry: ELLIPSE * rowSd }),
        element("path", { d: plus }));
    }
  }

  // Contacts in the overlay's units, which begin half a taxel before the first one's centre.
  #drawn(contacts) {
    const { n_cols: w, n_rows: h } = this.skin;
    return contacts.drawn({ w, h, pixel: this.pixel },
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
      pitch ? "mm" : ""}`;
  }
}

// The maps that can be shown alone or together: the first choice is that of a view in 3-D.
function choices(names) {
  const pair = names.filter((name) => ["truth", "reconstruction"].includes(name)
    || (name === "taxels" && !names.includes("truth")));
  return { pair, all: names, ...Object.fromEntries(names.map((name) => [name, [name]])) };
}

export class Maps {
  constructor(root, skin) {
    this.skin = skin;
    this.root = root;
    this.peaks = []; // [time, peak] of the last seconds
    this.panels = {};
    this.maps = {};
    this.faulty = []; // cells of the taxels that the reconstructor leaves out
    this.contacts = new Contacts(skin.unit);
    this.mask = skin.data.mask ?? null;
    this.aborter = new AbortController();
    const hasPlaces = Cloud.of(skin);
    this.inSpace = hasPlaces && byId("view").value === "space";
    this.view = this.inSpace ? new SpaceView(new Cloud(skin)) : new GridView(skin);
    root.replaceChildren();
    root.classList.toggle("space", this.inSpace);
    const names = skin.has_truth ? Object.keys(TITLES)
      : skin.has_taxels ? ["taxels", "reconstruction", "error"] : ["reconstruction"];
    for (const name of names) root.append(this.panel(name));
    this.choices = choices(names);
    this.offer(hasPlaces);
    this.choose();
    const { signal } = this.aborter;
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

  panel(name) {
    const title = name === "error" && !this.skin.has_truth ? "Difference from the taxels"
      : TITLES[name];
    const canvas = this.view.canvas(title, name), over = this.view.overlay();
    this.view.attach(canvas, () => this.drawSoon(), this.aborter.signal);
    const bar = element("div", { class: "bar" });
    bar.style.background = GRADIENT;
    const top = element("span", {}), figures = element("figcaption", {});
    this.panels[name] = { canvas, over, top, figures };
    return element("figure", { "data-panel": name }, element("h2", {}, title),
      element("div", { class: "framed" }, element("div", { class: "map" }, canvas, over),
        element("div", { class: "scale" }, top, bar, element("span", {}, "0"))),
      figures);
  }

  // Offer the options of a view in 3-D, where there is one.
  offer(hasPlaces) {
    for (const option of document.querySelectorAll("[data-of=places]")) option.hidden = !hasPlaces;
    for (const option of document.querySelectorAll("[data-of=space]")) option.hidden = !this.inSpace;
    for (const option of byId("shown-maps").options) {
      const those = this.choices[option.value];
      option.hidden = option.disabled = !those
        || (option.value === "pair" && those.length === this.choices.all.length);
    }
    const select = byId("shown-maps");
    if (select.selectedOptions[0]?.disabled ?? true) {
      select.value = [...select.options].find((option) => !option.disabled).value;
    }
  }

  // Show the maps that are chosen; of a grid all.
  choose() {
    const shown = this.inSpace ? this.choices[byId("shown-maps").value] : this.choices.all;
    for (const [name, { canvas }] of Object.entries(this.panels)) {
      canvas.closest("figure").hidden = !shown.includes(name);
    }
    this.root.style.setProperty("--n-maps", shown.length);
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

  reset() {
    this.view.reset?.();
  }

  turnToContact() {
    const map = this.maps.reconstruction ?? this.maps.taxels;
    if (map && highest(map) > CONTACT * this.skin.f_max) this.view.turnTo?.(map);
  }

  // Show new maps, each float32 (n_rows * n_cols,), row after row, and the frame's resultant and
  // contacts.
  show({ data: maps, resultant, contacts }, now) {
    this.maps = { ...maps };
    this.contacts.show(contacts, now);
    this.resultant = resultant;
    const reference = maps.truth ?? maps.taxels, felt = maps.reconstruction ?? maps.taxels;
    if (highest(felt) > FIRST * this.skin.f_max) this.view.turnAtFirst?.(felt);
    if (maps.reconstruction && reference) {
      this.maps.error = maps.reconstruction.map((v, k) => Math.abs(v - reference[k]));
    }
    this.draw(now);
  }

  draw(now) {
    const shown = Object.entries(this.panels).filter(
      ([name, { canvas }]) => this.maps[name] && !canvas.closest("figure").hidden);
    if (!shown.length) return;
    this.view.prepare(shown[0][1].canvas, this.contacts);
    const peak = Math.max(...["truth", "taxels", "reconstruction"].map((m) => highest(this.maps[m])));
    this.peaks = this.peaks.filter(([at]) => now - at < HOLD_MS);
    this.peaks.push([now, peak]);
    const held = Math.max(...this.peaks.map(([, value]) => value), 0.02 * this.skin.f_max);
    const range = byId("range").value === "full" ? this.skin.f_max
      : Math.min(rounded(held), this.skin.f_max);
    for (const [name, panel] of shown) {
      const map = this.maps[name];
      const own = name === "error" && byId("error-range").value === "own";
      const top = own ? Math.min(rounded(highest(map)), this.skin.f_max) : range;
      this.view.paint(panel, map, top);
      setText(panel.top, `${tick(top)} ${this.skin.unit}`);
      const resultant = name === "reconstruction" && this.resultant;
      setText(panel.figures, name === "error" ? this.errorText(map) : this.forceText(map)
        + (resultant
          ? `\nresultant ${within(resultant.total, resultant.total_sd, this.skin.unit)}` : ""));
    }
    this.mark();
    this.read();
  }

  // What is drawn over the maps.
  mark() {
    const { resultant, faulty, contacts, pointed } = this;
    this.view.mark(this.panels, { resultant, faulty, contacts, cell: pointed?.cell });
  }

  // Mark the taxels of these cells as faulty.
  markFaulty(cells) {
    if (String(cells) === String(this.faulty)) return;
    this.faulty = cells;
    this.mark();
  }

  forceText(map) {
    const { unit, f_max: fMax } = this.skin;
    let total = 0;
    for (const force of map) total += force || 0;
    const peak = highest(map);
    const centre = peak > CONTACT * fMax ? this.view.centre(map, total, peak) : "centre no contact";
    const missing = missingOf(map), note = missing ? `\n${missing} readings missing` : "";
    return `peak ${brief(peak, unit)}\ntotal ${brief(total, unit)}\n${centre}${note}`;
  }

  errorText(map) {
    let sum = 0;
    for (const value of map) sum += value * value || 0;
    const n = (this.mask ? this.mask.reduce((a, b) => a + b, 0) : map.length) - missingOf(map);
    return `peak ${brief(highest(map), this.skin.unit)}\nRMS ${brief(Math.sqrt(sum / n),
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
    setText(byId("under-pointer"), "Point at a taxel to see its values.");
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
      const figure = panel.canvas.closest("figure");
      figure.classList.toggle("stale", stale && !quiet);
      const title = figure.querySelector("h2");
      title.dataset.age = stale && !quiet && age !== undefined ? `${age.toFixed(1)} s old` : "";
    }
  }
}

// One small map with its contacts, for the overview, of a record of maps; drawn on a panel {canvas}
// that is kept. Returns its range in words.
export function thumbnail(panel, { data: { reconstruction: map }, contacts }, skin, now) {
  if (panel.skin !== skin) {
    panel.skin = skin;
    panel.image = panel.pixels = undefined;
    panel.view = Cloud.of(skin) ? new SpaceView(new Cloud(skin)) : new GridView(skin);
    panel.canvas.classList.toggle("smooth", Cloud.of(skin));
    [panel.canvas.width, panel.canvas.height] = [skin.n_cols, skin.n_rows];
    panel.over?.remove();
    panel.over = panel.view.overlay();
    panel.canvas.after(panel.over);
    panel.contacts = new Contacts(skin.unit);
  }
  const top = Math.max(rounded(highest(map)), 0.1 * skin.f_max); // noise is no picture
  if (highest(map) > FIRST * skin.f_max) panel.view.turnAtFirst?.(map);
  panel.contacts.show(contacts, now);
  panel.view.prepare(panel.canvas, panel.contacts);
  panel.view.paint(panel, map, top);
  panel.view.mark({ reconstruction: panel }, { faulty: [], contacts: panel.contacts });
  return `peak ${brief(highest(map), skin.unit)}, colours to ${tick(top)} ${skin.unit}`;
}

// Taxels whose reading is missing.
function missingOf(map) {
  return map.reduce((n, value) => n + Number.isNaN(value), 0);
}

function highest(map) {
  let high = 0;
  if (map) for (const value of map) if (value > high) high = value;
  return high;
}
