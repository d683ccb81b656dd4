// The overview of several patches: their maps as one, at their poses in 3-D, and a table of figures.

import { Cloud } from "./cloud.js";
import { contactsOf, summary } from "./contacts.js";
import { ago, brief, cells, element, highest, noiseText } from "./dom.js";
import { CONTACT } from "./maps.js";

const GAP = 1.08; // distance of patches without a pose, in sides of the largest
const FEW = 6; // of them, that stand side by side
const COLUMNS = ["Patch", "Now", "Peak", "Total", "PSNR dB", "Trusted", "Latency ms", "Skipped", "Lost"];
const NOISE = 2; // standard deviations of an untouched taxel beyond which a patch is pressed

// Skins with a pose each: of those that state none, a few stand side by side in front of the eye, more
// in rings around an upright body.
function posed(skins) {
  const flat = skins.filter((skin) => !skin.pose && !Cloud.of(skin)), n = flat.length;
  const side = GAP * Math.max(...flat.map((skin) =>
    1000 * (skin.pitch_m || 0.005) * Math.max(skin.n_rows, skin.n_cols)));
  const beyond = Math.max(0, ...skins.filter(({ pose }) => pose).map(({ pose }) => pose[1] + side));
  const across = n > FEW ? Math.round(Math.sqrt(Math.PI * n) / 4) * 4 : Math.ceil(Math.sqrt(1.5 * n));
  return skins.map((skin) => {
    const k = flat.indexOf(skin), up = -side * Math.floor(k / across);
    if (k < 0) return skin;
    const angle = 2 * Math.PI * (k / across), radius = side / 2 / Math.tan(Math.PI / across);
    const pose = n > FEW ? [radius * Math.cos(angle), beyond + radius * Math.sin(angle), up, 90, 0,
      (180 * angle) / Math.PI + 90] : [0, beyond + side * (k % across), up, 90, 0, 90];
    return { ...skin, pose };
  });
}

export class Body {
  constructor(root) {
    this.skins = {};
    this.figures = {}; // of a patch: peak and total of its newest map, its contacts
    this.body = element("tbody", {});
    const head = element("tr", {});
    cells(head, "th", COLUMNS);
    root.replaceChildren(element("thead", {}, head), this.body);
  }

  // Take the record of a skin.
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
    if (this.cloud) this.all.set(map, this.cloud.part(patch).cell);
  }

  // A skin that stands for all of them, with a cloud of all.
  whole() {
    const skins = Object.values(this.skins), most = (key) => Math.max(...skins.map((one) => one[key]));
    this.cloud = new Cloud(posed(skins));
    this.all = new Float32Array(this.cloud.taxels.length).fill(NaN);
    for (const [patch, { map }] of Object.entries(this.figures)) {
      this.all.set(map, this.cloud.part(patch).cell);
    }
    return { f_max: most("f_max"), sigma_end: most("sigma_end"), unit: skins[0].unit, sum_unit: skins[0].sum_unit, data: {},
      cloud: this.cloud };
  }

  // The maps and contacts of all patches, as a record of maps.
  newest() {
    const contacts = Object.entries(this.figures).flatMap(([patch, { contacts: of }]) =>
      contactsOf(of).map((one) =>
        ({ ...this.cloud.part(patch).placed(one), id: `${patch} ${one.id}` })));
    return { data: { reconstruction: this.all }, contacts };
  }

  #isPressed(patch) {
    const { peak = 0, contacts } = this.figures[patch] ?? {};
    const { f_max: fMax = 0, sigma_end: sigma = 0 } = this.skins[patch] ?? {};
    return contacts?.n > 0 || peak > Math.max(CONTACT * fMax, NOISE * sigma);
  }

  // What a patch does now, by its state of the monitor, the tone of that, and an explanation.
  #now(patch, state, isPaused) {
    const age = state.age_s.reconstruction;
    if (state.ended) return ["ended", ""];
    if (age === undefined) return ["no frame yet", "bad"];
    if (isPaused) return ["paused", ""];
    if (age > state.stale_s) return [`stale for ${ago(age)}`, "bad"];
    if (!state.trusted) {
      const { word, sentence } = state.reason ?? {};
      return [word ? `not trusted: ${word}` : "not trusted", "bad", sentence];
    }
    if (!this.#isPressed(patch)) return [state.idle ? "idle" : "live", ""];
    return [summary(this.figures[patch].contacts, this.skins[patch].sum_unit) || "pressed", "good"];
  }

  // Show figures of all patches; `rest` has those after the total.
  table(states, isPaused, rest) {
    for (const [patch, state] of Object.entries(states)) {
      const row = document.getElementById(`row-${patch}`) ?? element("tr", { id: `row-${patch}` },
        element("td", {}, element("a", { href: `#/${patch}` }, patch)));
      if (!row.isConnected) this.body.append(row);
      const { peak, total } = this.figures[patch] ?? {}, { unit, sum_unit: sums } = this.skins[patch] ?? {};
      const [text, tone, explanation = ""] = this.#now(patch, state, isPaused);
      cells(row, "td", [patch, text, brief(peak, unit), brief(total, sums), ...rest(patch, state)]);
      row.children[1].className = tone;
      row.children[1].title = explanation;
    }
  }

  // Headline figures of all patches, as tiles, and those of them that charts show.
  tiles(states, isPaused) {
    const of = Object.entries(this.figures), [skin] = Object.values(this.skins);
    const now = Object.entries(states).map(([patch, state]) => this.#now(patch, state, isPaused));
    const pressed = of.filter(([patch]) => this.#isPressed(patch)).length;
    const total = of.reduce((sum, [, figures]) => sum + figures.total, 0);
    const noise = Object.values(states).reduce((sum, { summary: s }) => sum + (s?.noise_sum ?? 0), 0);
    const [where, { peak } = {}] = of.reduce((a, b) => (a[1]?.peak >= b[1].peak ? a : b), []);
    return { total, pressed, tiles: [
      ["patches", "Patches", `${now.length}`, `${now.filter(([text]) => text === "idle").length} idle`],
      ["pressed", "Pressed", `${pressed}`, `of ${now.length} patches`],
      ["total", "Total", brief(total, skin?.sum_unit),
        noiseText(noise, skin?.sum_unit) || "all patches"],
      ["peak", "Peak", brief(peak, skin?.unit), where ?? ""],
    ] };
  }
}
