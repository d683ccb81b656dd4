// The overview of several patches: all at their poses in one view in 3-D, and a table of figures.

import { Cloud } from "./cloud.js";
import { Range } from "./colours.js";
import { Contacts, contactsOf, summary } from "./contacts.js";
import { ago, brief, element, fixed, setText, tick } from "./dom.js";
import { CONTACT, FIRST, highest, least, panel } from "./maps.js";
import { SpaceView } from "./space.js";
import { chartsOfAll, Strips } from "./strips.js";

const GAP = 0.15; // between patches without a pose, in sides of the largest
const COLUMNS = ["Patch", "Now", "Peak", "Total", "PSNR dB", "Trusted", "Latency ms", "Skipped", "Lost"];
const NOISE = 2; // standard deviations of an untouched taxel beyond which a patch is pressed

// Skins with a pose each: those that state none stand side by side, in front of the eye, beyond the
// others.
function posed(skins) {
  const flat = skins.filter((skin) => !skin.pose && !Cloud.of(skin));
  const side = 1000 * (1 + GAP) * Math.max(...flat.map((skin) =>
    (skin.pitch_m || 0.005) * Math.max(skin.n_rows, skin.n_cols)));
  const across = Math.ceil(Math.sqrt(1.5 * flat.length));
  const beyond = Math.max(0, ...skins.filter((skin) => skin.pose).map(({ pose }) => pose[1] + side));
  return skins.map((skin) => {
    const k = flat.indexOf(skin);
    const pose = [0, beyond + side * (k % across), -side * Math.floor(k / across), 90, 0, 90];
    return k < 0 ? skin : { ...skin, pose };
  });
}

export class Body {
  constructor(root) {
    this.root = root;
    this.skins = {};
    this.figures = {}; // of a patch: peak and total of its newest map, its contacts
    this.contacts = new Contacts("");
    this.aborter = new AbortController();
    this.body = element("tbody", {});
    this.under = element("output", {});
    this.zoomed = element("button", { type: "button", "aria-pressed": "false",
      onclick: () => this.zoom() }, "Zoom to contact");
    this.frame = element("div", {});
    root.replaceChildren(element("div", {}, this.frame, element("section", { id: "map-options" }, this.zoomed,
        element("button", { type: "button", onclick: () => this.view?.reset() }, "Reset view"),
        this.under)),
    element("div", { class: "beside" }, element("div", { class: "scroll" }, element("table", { id: "patches" }, element("thead", {},
      element("tr", {}, ...COLUMNS.map((title) => element("th", {}, title)))), this.body)),
    this.charts = element("section", { class: "strips" })));
  }

  close() {
    this.aborter.abort();
  }

  skin(record) {
    this.skins[record.patch] = record;
    delete this.figures[record.patch];
    this.cloud = null;
  }

  // Take a record of maps.
  maps({ patch, data: { reconstruction: map }, contacts }) {
    if (!map) return;
    const of = this.figures[patch] = { map, contacts, peak: highest(map), total: 0 };
    for (const force of map) of.total += force || 0;
    if (this.cloud) this.all.set(map, this.parts[patch].cell);
  }

  // The view of the skins that are known, as it was turned before.
  #build() {
    const { view: before } = this;
    this.aborter.abort();
    this.aborter = new AbortController();
    this.cloud = new Cloud(posed(Object.values(this.skins)));
    this.parts = Object.fromEntries(this.cloud.parts.map((part) => [part.skin.patch, part]));
    this.all = new Float32Array(this.cloud.taxels.length).fill(NaN);
    for (const [patch, { map }] of Object.entries(this.figures)) {
      this.all.set(map, this.parts[patch].cell);
    }
    this.view = new SpaceView(this.cloud);
    if (before?.isTurned) [this.view.view, this.view.isTurned] = [before.view, true];
    const skins = Object.values(this.skins);
    this.range = new Range(Math.max(...skins.map(least)), Math.max(...skins.map((s) => s.f_max)));
    this.contacts.unit = skins[0].unit;
    this.strips ??= new Strips(this.charts, chartsOfAll(skins[0].unit));
    this.panel = panel(this.view, "Reconstruction", "body");
    const { canvas, figure } = this.panel, { signal } = this.aborter;
    this.view.attach(canvas, () => this.draw(performance.now()), signal);
    canvas.addEventListener("pointermove", ({ clientX, clientY }) => {
      this.pointed = this.view.at([clientX, clientY], canvas);
    }, { signal });
    canvas.addEventListener("dblclick", () => {
      if (this.pointed) location.hash = `#/${this.pointed.patch}`;
    }, { signal });
    this.frame.replaceChildren(figure);
    figure.classList.add("large", "space");
  }

  zoom() {
    this.isZoomed = !this.isZoomed;
    this.zoomed.setAttribute("aria-pressed", this.isZoomed);
    this.view?.zoom(this.isZoomed, this.all);
  }

  draw(now) {
    if (!Object.keys(this.skins).length) return;
    if (!this.cloud) this.#build();
    const { view, all, panel: shown } = this, peak = highest(all);
    if (peak > FIRST * this.range.most) {
      view.turnAtFirst(all);
      if (this.isZoomed) view.follow(all);
    }
    this.contacts.show(Object.entries(this.figures).flatMap(([patch, { contacts }]) =>
      contactsOf(contacts).map((contact) =>
        ({ ...this.parts[patch].placed(contact), id: `${patch} ${contact.id}` }))), now);
    view.prepare(shown.canvas);
    const top = this.range.over(peak, now);
    view.paint(shown, all, top);
    view.mark({ reconstruction: shown }, { faulty: [], contacts: this.contacts });
    setText(shown.top, `${tick(top)} ${this.contacts.unit}`);
    const { cell, patch, name } = this.pointed ?? {};
    setText(this.under, patch === undefined ? "Double-click a patch to open it."
      : `${patch}, ${name}: ${brief(all[cell], this.contacts.unit)}`);
  }

  // What a patch does now, by its state of the monitor.
  now(patch, state, isPaused) {
    const { peak = 0, contacts } = this.figures[patch] ?? {}, age = state.age_s.reconstruction;
    const { f_max: fMax = 0, sigma_end: sigma = 0, unit } = this.skins[patch] ?? {};
    if (state.ended) return ["ended", ""];
    if (age === undefined) return ["no frame yet", "bad"];
    if (isPaused) return ["paused", ""];
    if (age > state.stale_s) return [`stale for ${ago(age)}`, "bad"];
    if (!state.trusted) return [state.reason ? `not trusted: ${state.reason}` : "not trusted", "bad"];
    if (contacts?.n) return [summary(contacts, unit), "good"];
    if (peak > Math.max(CONTACT * fMax, NOISE * sigma)) return ["pressed", "good"];
    return [state.idle ? "idle" : "live", ""];
  }

  // Show figures of all patches: `rows` has the cells of each after its total.
  table(states, isPaused, rest) {
    for (const [patch, state] of Object.entries(states)) {
      let line = document.getElementById(`row-${patch}`);
      if (!line) {
        line = element("tr", { id: `row-${patch}` }, ...COLUMNS.map(() => element("td", {})));
        line.cells[0].append(element("a", { href: `#/${patch}` }, patch));
        this.body.append(line);
      }
      const { peak, total } = this.figures[patch] ?? {}, unit = this.skins[patch]?.unit;
      const [text, tone] = this.now(patch, state, isPaused);
      line.cells[1].className = tone;
      [text, brief(peak, unit), brief(total, unit), ...rest(patch, state)]
        .forEach((cell, k) => setText(line.cells[k + 1], cell));
    }
  }

  // Headline figures of all patches, as tiles, which the charts show over time.
  tiles(states, isPaused, seconds) {
    const of = Object.entries(this.figures), { unit } = this.contacts;
    const now = Object.entries(states).map(([patch, state]) => this.now(patch, state, isPaused));
    const pressed = now.filter(([, tone]) => tone === "good").length;
    const total = of.reduce((sum, [, figures]) => sum + figures.total, 0);
    const [where, { peak } = {}] = of.reduce((a, b) => (a[1]?.peak >= b[1].peak ? a : b), []);
    if (of.length && !isPaused) {
      this.strips?.series.total.add(seconds, total);
      this.strips?.series.pressed.add(seconds, pressed);
    }
    return [
      ["patches", "Patches", `${now.length}`, `${now.filter(([text]) => text === "idle").length} idle`],
      ["pressed", "Pressed", `${pressed}`, `of ${now.length} patches`],
      ["total", "Total force", brief(total, unit), "all patches"],
      ["peak", "Peak", brief(peak, unit), where ?? ""],
    ];
  }
}
