// A view of a skin of points: turned by dragging, by touch and by the arrow keys, zoomed by the
// wheel, two fingers, + and -. All maps of a patch share it.

import { OUTSIDE, INSIDE, SHADES, TAXELS, axes, dot, projector, rasterise, scaleOf } from "./cloud.js";
import { pixel } from "./colours.js";
import { cross, element, highest } from "./dom.js";

const FINENESS = 2; // pixels drawn for one of the page: their mean has smooth edges
const COARSE = 1, TURNING_MS = 200; // while the view is turned, and this long afterwards
const MOST_PIXELS = 700_000;
const TURN = Math.PI; // by a drag over the whole view
const STEP = Math.PI / 18, ZOOM_STEP = 1.25; // of a key
const MOST_ZOOM = 20, MOST_ZOOMED = 4; // by the user, and to a contact,
const GRAZED = 0.2, NEAR_EDGE = 0.4; // cosine of the view, part of it: where the zoom follows
const FILLED = 0.5; // which then has this part of the view
const OPENING = { yaw: 0.45, pitch: 0.25 }; // from where a skin all round is seen at first
const TRIAD = 18; // length of the axes in a corner, in pixels
const PRESSED = 0.1; // part of the peak beyond which a force is of the contact, not noise
const STEEPEST = 0.7; // pitch to which the view turns by itself: a body seen from above is hard to read
const ASIDE = [0.35, 0.15]; // from a contact, where several skins are seen
const ONE_SIDED = 0.3; // length of the mean normal beyond which a skin has a front

export const DARK = matchMedia("(prefers-color-scheme: dark)");

const KEYS = {
  ArrowLeft: (view) => (view.yaw += STEP), ArrowRight: (view) => (view.yaw -= STEP),
  ArrowUp: (view) => (view.pitch -= STEP), ArrowDown: (view) => (view.pitch += STEP),
};

// Yaw and pitch from which a direction points to the eye, a little from above.
function towards([x, y, z]) {
  return { yaw: Math.atan2(y, x), pitch: Math.asin(z / Math.hypot(x, y, z)) };
}

export class SpaceView {
  constructor(cloud) {
    this.cloud = cloud;
    this.target = { width: 0, height: 0 };
    this.pointers = new Map(); // id of a finger or mouse that is down -> its place
    this.first = this.#opening();
    this.view = { ...this.first };
    this.isTurned = false; // by the user, or to the first contact
    this.isNew = true;
  }

  reset() {
    this.view = { ...this.first };
    this.#turned();
  }

  // Turn the most loaded side of a map to the eye, as large as fits; or show all.
  zoom(isOn, map) {
    const facing = isOn && map ? this.#facing(map) : null;
    if (!facing && this.isZoomed) this.reset();
    this.isZoomed = facing !== null;
    if (!facing) return;
    const { cloud } = this, [, , eye] = axes(facing), pressed = [];
    const project = projector(cloud, { ...facing, zoom: 1 }, 1, 1), most = highest(map);
    for (let k = 0; k < cloud.n; k++) {
      if (!(map[cloud.cells[k]] > PRESSED * most) || dot(eye, cloud.normal(k)) <= 0) continue;
      pressed.push(project(cloud.place(k)));
    }
    const ends = [0, 1].map((axis) => pressed.reduce(([low, high], { [axis]: v }) =>
      [Math.min(low, v), Math.max(high, v)], [1, 0]));
    const span = Math.max(...ends.map(([low, high]) => high - low), FILLED / MOST_ZOOMED);
    const zoom = Math.max(1, FILLED / span);
    const [x, y] = ends.map(([low, high]) => zoom * (0.5 - (low + high) / 2));
    this.view = { ...facing, zoom, x, y };
    this.#turned();
  }

  #opening() {
    const mean = [0, 0, 0], { cloud } = this;
    for (let k = 0; k < cloud.n; k++) cloud.normal(k).forEach((v, axis) => (mean[axis] += v / cloud.n));
    const front = towards(mean);
    const aside = { yaw: front.yaw + 0.35, pitch: Math.max(-1, Math.min(1, front.pitch + 0.25)) };
    return { x: 0, y: 0, zoom: 1, ...(Math.hypot(...mean) < ONE_SIDED ? OPENING : aside) };
  }

  // Zoom to the most loaded taxel of a map again once it is not seen, or near the edge.
  follow(map) {
    const { cloud, view } = this, k = cloud.taxels[map.indexOf(highest(map))];
    if (!(k >= 0) || this.pointers.size || this.timer !== undefined) return;
    const off = projector(cloud, view, 1, 1)(cloud.place(k)).slice(0, 2).map((v) => Math.abs(v - 0.5));
    const isSeen = dot(axes(view)[2], cloud.normal(k)) > GRAZED && Math.max(...off) < NEAR_EDGE;
    if (!this.isZoomed || !isSeen) this.zoom(true, map);
  }

  // Turn to the first contact, once, unless the view is turned already. The frame is drawn
  // afterwards anyway: a drawing asked for here would turn again, and never be done.
  turnAtFirst(map) {
    const facing = this.isTurned ? null : this.#facing(map);
    if (!facing) return;
    this.isTurned = this.isNew = true;
    Object.assign(this.view, facing);
    this.first = { ...this.view };
  }

  #facing(map) {
    const { cloud } = this, sum = [0, 0, 0];
    for (let k = 0; k < cloud.n; k++) {
      const force = map[cloud.cells[k]] || 0;
      cloud.normal(k).forEach((v, axis) => (sum[axis] += force * force * v));
    }
    if (!(Math.hypot(...sum) > 0)) return null;
    const [aside, above] = cloud.parts.length > 1 ? ASIDE : [0, 0];
    const { yaw, pitch } = towards(sum);
    return { yaw: yaw + aside, x: 0, y: 0,
      pitch: Math.max(-STEEPEST, Math.min(STEEPEST, pitch + above)) };
  }

  canvas(label, name) {
    return element("canvas", { width: 8, height: 8, tabindex: 0, role: "application",
      "aria-roledescription": "3-D view", "data-map": name,
      "aria-label": `${label} in 3-D: arrow keys turn it, plus and minus zoom, Home resets` });
  }

  // Listen to a canvas until the signal; `changed` is called when all are to be drawn anew.
  attach(canvas, changed, signal) {
    this.changed = changed;
    const on = (kind, what, options = {}) => canvas.addEventListener(kind, what, { signal, ...options });
    on("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    on("pointermove", (event) => this.#drag(event, canvas));
    for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) {
      on(kind, (event) => this.pointers.delete(event.pointerId));
    }
    on("wheel", (event) => {
      event.preventDefault();
      this.#zoom(Math.exp(-0.0015 * event.deltaY), [event.clientX, event.clientY], canvas);
    }, { passive: false });
    on("keydown", (event) => this.#key(event, canvas));
  }

  #drag(event, canvas) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId);
    this.pointers.set(event.pointerId, now);
    const { width, height } = canvas.getBoundingClientRect();
    if (others.length) {
      const [, fixed] = others[0];
      const apart = ([x, y]) => Math.max(10, Math.hypot(x - fixed[0], y - fixed[1]));
      this.#zoom(apart(now) / apart(before), fixed, canvas);
      return;
    }
    this.view.yaw -= (TURN * (now[0] - before[0])) / width;
    this.view.pitch += (TURN * (now[1] - before[1])) / height;
    this.#turned();
  }

  // Zoom so that what is at a place of the window stays there.
  #zoom(factor, [x, y], canvas) {
    const box = canvas.getBoundingClientRect(), { view } = this;
    const zoom = Math.max(1, Math.min(MOST_ZOOM, view.zoom * factor)), by = zoom / view.zoom;
    const at = [(x - box.left) / box.width - 0.5, (y - box.top) / box.height - 0.5];
    view.zoom = zoom;
    view.x = zoom === 1 ? 0 : at[0] + (view.x - at[0]) * by;
    view.y = zoom === 1 ? 0 : at[1] + (view.y - at[1]) * by;
    this.#turned();
  }

  #key(event, canvas) {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const box = canvas.getBoundingClientRect();
    const middle = [box.left + box.width / 2, box.top + box.height / 2];
    if (KEYS[event.key]) {
      KEYS[event.key](this.view);
      this.#turned();
    } else if (event.key === "+" || event.key === "=") this.#zoom(ZOOM_STEP, middle, canvas);
    else if (event.key === "-") this.#zoom(1 / ZOOM_STEP, middle, canvas);
    else if (event.key === "Home") this.reset();
    else return;
    event.preventDefault();
  }

  #turned() {
    const { view } = this, most = view.zoom / 2;
    view.pitch = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, view.pitch));
    view.x = Math.max(-most, Math.min(most, view.x));
    view.y = Math.max(-most, Math.min(most, view.y));
    this.isTurned = this.isNew = true;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => {
      this.timer = undefined;
      this.changed?.();
    }, TURNING_MS);
    this.changed?.();
  }

  // Find what is seen at each pixel, if the view or the size of the canvases, of which this is one,
  // is another. Before texts change: a size that is asked for afterwards costs another layout.
  prepare(canvas) {
    const { clientWidth: w, clientHeight: h } = canvas;
    if (!w || !h) return;
    if (this.dark !== DARK.matches) this.#shade(canvas);
    const wanted = this.timer === undefined ? Math.max(FINENESS, devicePixelRatio || 1) : COARSE;
    const fine = Math.min(wanted, Math.sqrt(MOST_PIXELS / (w * h)));
    const width = Math.max(1, Math.round(fine * w)), height = Math.max(1, Math.round(fine * h));
    if (width !== this.target.width || height !== this.target.height) {
      const n = width * height;
      this.target = { width, height, index: new Uint32Array(n), depth: new Float32Array(n) };
      this.isNew = true;
    }
    this.size = [w, h];
    if (!this.isNew) return;
    rasterise(this.cloud, this.view, this.target);
    this.isNew = false;
    this.marked = null;
  }

  // Draw a map of forces on the canvas of a panel, with colours up to `top`.
  paint(panel, map, top) {
    const { canvas } = panel, { cloud, palette } = this, { width, height, index } = this.target;
    if (!palette || !width) return; // not laid out yet
    if (panel.image?.width !== width || panel.image.height !== height) {
      [canvas.width, canvas.height] = [width, height];
      panel.image = new ImageData(width, height);
      panel.pixels = new Uint32Array(panel.image.data.buffer);
    }
    const { pixels } = panel, scale = 255 / top;
    for (let k = 0; k < cloud.n; k++) {
      palette[TAXELS + k] = pixel(map[cloud.cells[k]], scale);
    }
    for (let at = 0; at < pixels.length; at++) pixels[at] = palette[index[at]];
    canvas.getContext("2d").putImageData(panel.image, 0, 0);
  }

  // Colours of the body in the page's scheme, then room for those of the taxels.
  #shade(canvas) {
    this.dark = DARK.matches;
    this.palette ??= new Uint32Array(TAXELS + this.cloud.n);
    const shown = getComputedStyle(canvas).getPropertyValue("--body");
    const [dark, light, inside] = shown.trim().split(/\s+/).map(Number);
    for (let shade = 0; shade < SHADES; shade++) {
      const grey = Math.round(dark + ((light - dark) * shade) / (SHADES - 1));
      const dim = Math.round(inside * grey);
      this.palette[OUTSIDE + shade] = ((255 << 24) | (grey << 16) | (grey << 8) | grey) >>> 0;
      this.palette[INSIDE + shade] = ((255 << 24) | (dim << 16) | (dim << 8) | dim) >>> 0;
    }
  }

  // Cell and name of the taxel at a place of the window; null where none is seen.
  at([x, y], canvas) {
    const box = canvas.getBoundingClientRect(), { width, height, index } = this.target;
    const col = Math.floor(((x - box.left) / box.width) * width);
    const row = Math.floor(((y - box.top) / box.height) * height);
    const isOver = col >= 0 && row >= 0 && col < width && row < height;
    const k = isOver ? index[row * width + col] - TAXELS : -1;
    if (k < 0) return null;
    const place = Array.from(this.cloud.place(k), (v) => (1000 * v).toFixed(1)).join(", ");
    const part = this.cloud.part(k), { patch, data: { point_rows: rows }, n_cols: n } = part.skin;
    const cell = this.cloud.cells[k], own = cell - part.cell;
    const name = part.isFlat ? `row ${Math.floor(own / n)}, column ${own % n}`
      : `taxel ${rows ? rows[k - part.first] : k - part.first} at ${place} mm`;
    return { cell, patch, name: this.cloud.parts.length > 1 ? `${patch}, ${name}` : name };
  }

  overlay() {
    return element("svg", { class: "over" });
  }

  // A ring around the taxel of a cell on all panels, crosses on faulty ones, and the skin's axes in
  // a corner; contacts on the reconstruction.
  mark(panels, { faulty, cell, contacts }) {
    const shown = String([this.size, cell, faulty]);
    if (!this.size || (this.marked === shown && !contacts.list.length)) return;
    this.marked = contacts.list.length ? null : shown;
    const [w, h] = this.size;
    for (const [name, { over }] of Object.entries(panels)) {
      over.setAttribute("viewBox", `0 0 ${w} ${h}`);
      const marks = cell === undefined ? [] : [this.#ring(this.cloud.taxels[cell], w, h)];
      if (name === "reconstruction") marks.push(...this.#drawn(contacts, w, h));
      over.replaceChildren(...this.#triad(h), ...this.#crosses(faulty, w, h), ...marks);
    }
  }

  // Crosses on those cells whose taxel is seen.
  #crosses(cells, w, h) {
    const { cloud, view } = this, { width, height, index } = this.target;
    const scale = scaleOf(cloud, view, w, h);
    return cells.filter((cell) => cloud.taxels[cell] >= 0).flatMap((cell) => {
      const k = cloud.taxels[cell], [x, y] = projector(cloud, view, w, h)(cloud.place(k));
      const col = Math.floor((x / w) * width), row = Math.floor((y / h) * height);
      const isOver = col >= 0 && row >= 0 && col < width && row < height;
      if (!isOver || index[row * width + col] !== TAXELS + k) return [];
      const arm = Math.max(4, 0.5 * cloud.spacing[k] * scale);
      return [element("path", { class: "faulty", d: cross(x, y, arm) })];
    });
  }

  #ring(k, w, h) {
    const { cloud, view } = this;
    const [x, y] = projector(cloud, view, w, h)(cloud.place(k));
    const r = Math.max(4, 0.8 * cloud.spacing[k] * scaleOf(cloud, view, w, h));
    return element("ellipse", { cx: x, cy: y, rx: r, ry: r });
  }

  #drawn(contacts, w, h) {
    const { cloud, view } = this, [, , eye] = axes(view), scale = scaleOf(cloud, view, w, h);
    const spacing = cloud.spacing.reduce((a, b) => a + b, 0) / cloud.n;
    return contacts.drawn({ w, h, pixel: 1 },
      ({ place_mm: place }) =>
        place && projector(cloud, view, w, h)(place.map((v) => v / 1000)).slice(0, 2),
      ({ area }) => scale * spacing * Math.sqrt(area / Math.PI),
      ({ normal }) => normal && dot(eye, normal) <= 0);
  }

  #triad(h) {
    const [right, up] = axes(this.view), x = 1.6 * TRIAD, y = h - 1.6 * TRIAD;
    return ["x", "y", "z"].flatMap((letter, k) => {
      const [dx, dy] = [TRIAD * right[k], -TRIAD * up[k]];
      const line = element("path", { class: "axis", d: `M${x} ${y}l${dx} ${dy}` });
      // The letter of one that points to the eye would lie on those of the others.
      return Math.hypot(dx, dy) < 0.4 * TRIAD ? [line]
        : [line, element("text", { x: x + 1.35 * dx, y: y + 1.35 * dy, class: "axis" }, letter)];
    });
  }

  // Centre of the forces of a map, and how much of the contact is on the side that is not seen.
  centre(map, total, peak) {
    const { cloud } = this, sums = [0, 0, 0], [, , eye] = axes(this.view);
    let contact = 0, hidden = 0;
    for (let k = 0; k < cloud.n; k++) {
      const force = map[cloud.cells[k]] || 0;
      cloud.place(k).forEach((v, axis) => (sums[axis] += force * v));
      if (force < PRESSED * peak) continue;
      contact += force;
      if (dot(eye, cloud.normal(k)) <= 0) hidden += force;
    }
    const share = Math.round((100 * hidden) / contact);
    return `centre ${sums.map((sum) => ((1000 * sum) / total).toFixed(1)).join(", ")} mm · ${
      share ? `${share} % of the contact on the far side` : "contact on the near side"}`;
  }
}
