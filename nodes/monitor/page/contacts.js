// Contacts of a patch: a ring, a trail and a label of each over a map, and a list of them.

import { brief, cells, element, fixed, setText, within } from "./dom.js";

const TRAIL_MS = 1500;
const LEAST = 6; // radius of a ring, and further below sizes of its label, in pixels
const FONT = 11, LETTER = 6.2;
const LINGER_S = 3; // an ended contact stays in the list for this long
const ROWS = 5, MOST = 16; // of the list, at first and when many contacts come and go

export const EVENTS = { begin: ["▲", "good"], end: ["▼", "dim"], over: ["◆", "bad"],
  slide: ["▶", "noisy"], touch: ["●", "noisy"] };

// Number and total of the contacts of a record of maps; "" if there are none.
export function summary({ n, sum } = {}, unit) {
  return n ? `${n} contact${n > 1 ? "s" : ""}, ${brief(sum, unit)}` : "";
}

// The contacts of a record of maps, of which there may be none.
export function contactsOf({ id = [], trusted, ...fields } = {}) {
  const columns = Object.entries(fields).filter(([, values]) => Array.isArray(values));
  return id.map((number, k) => ({ id: number, trusted,
    ...Object.fromEntries(columns.map(([name, values]) => [name, values[k]])) }));
}

export class Contacts {
  constructor(unit) {
    this.unit = unit;
    this.list = [];
    this.trails = new Map(); // id of a contact -> its last [time, contact]
  }

  // Take the contacts of now.
  show(list, now) {
    this.list = list;
    this.trails = new Map(list.map((contact) => {
      const before = this.trails.get(contact.id) ?? [];
      return [contact.id, [...before.filter(([at]) => now - at < TRAIL_MS), [now, contact]]];
    }));
  }

  // What is drawn over a map of w x h from x0, y0, of which a pixel is `pixel`: `place` takes a contact
  // to its [x, y], `radius` to the radius of its ring, `isFar` says if the side is not seen.
  drawn({ x: x0 = 0, y: y0 = 0, w, h, pixel }, place, radius, isFar = () => false) {
    const taken = []; // boxes of the labels
    return this.list.flatMap((contact) => {
      const kind = `contact${contact.trusted ? "" : " doubtful"}${isFar(contact) ? " far" : ""}`;
      const trail = this.trails.get(contact.id).map(([, then]) => place(then)).filter(Boolean);
      if (!trail.length) return []; // its place is not known
      const [x, y] = trail.at(-1), r = Math.max(LEAST * pixel, radius(contact));
      const text = `${contact.id}: ${brief(contact.total, this.unit)}`;
      const half = 0.5 * LETTER * pixel * text.length, high = FONT * pixel;
      const at = Math.max(x0 + half, Math.min(x0 + w - half, x));
      // Above the ring, below it, or in it at its upper end: where there is room, and no label.
      const isFree = (top) => top >= y0 && top + high <= y0 + h && !taken.some(([left, up]) =>
        Math.abs(left - at) < 2 * half && Math.abs(up - top) < high);
      const tops = [y - r - 1.2 * high, y + r + 0.2 * high, Math.max(y0, y - r)];
      const top = tops.find(isFree) ?? tops[2];
      taken.push([at, top]);
      return [
        element("path", { class: `trail ${kind}`, d: `M${trail.join("L")}` }),
        element("ellipse", { class: kind, cx: x, cy: y, rx: r, ry: r }),
        element("text", { class: kind, x: at, y: top + 0.85 * high, "font-size": high }, text),
      ];
    });
  }
}

// The list of the contacts of a patch, by id; an ended one stays a little longer.
export class ContactList {
  constructor(root) {
    this.root = root;
    this.known = new Map(); // id -> {contact, seen}
    this.title = element("h2", {});
    this.head = element("tr", {});
    this.body = element("tbody", {});
    const legend = Object.entries(EVENTS).map(([name, [mark]]) => `${mark} ${name}`).join("  ");
    this.figure = element("figure", { id: "contacts" },
      element("div", { class: "heading" }, this.title, element("span", {}, legend)),
      element("table", {}, element("thead", {}, this.head), this.body));
  }

  get isShown() {
    return this.figure.isConnected;
  }

  // Show the contacts of a record of maps on a skin, at a time in seconds.
  show({ list }, record, { sum_unit: unit, pitch_m: pitch, data }, now) {
    if (!this.isShown) this.root.append(this.figure);
    const more = record.n > list.length ? `, the ${list.length} strongest:` : "";
    setText(this.title, summary(record, unit) + more || "No contact");
    const length = pitch || data.points ? "mm" : "taxels";
    cells(this.head, "th", ["", `Total ${unit}`, `${data.points ? "x, y, z" : "Row, col"} ${length}`,
      pitch ? "mm²" : "Area", `${length}/s`, "Age s"]);
    for (const contact of list) this.known.set(contact.id, { contact, seen: now });
    const rows = [...this.known].filter(([, { seen }]) => now - seen <= LINGER_S)
      .sort(([a], [b]) => a - b).slice(-MOST);
    this.known = new Map(rows);
    while (this.body.children.length < Math.max(ROWS, rows.length)) this.body.append(element("tr", {}));
    [...this.body.children].forEach((line, k) => {
      const [, { contact, seen }] = rows[k] ?? [0, {}];
      line.className = seen < now ? "ended" : contact?.trusted === false ? "doubtful" : "";
      if (!contact) return cells(line, "td", ["\u00a0", "", "", "", "", ""]);
      const at = (data.points && contact.place_mm)
        || contact.centre.map((v) => v * (pitch ? 1000 * pitch : 1));
      const marks = [["over", contact.over], ["slide", contact.sliding]]
        .map(([name, is]) => (is ? EVENTS[name][0] : "")).join("");
      return cells(line, "td", [`${contact.id}${marks}`, within(contact.total, contact.total_sd, ""),
        at.map((v) => v.toFixed(data.points ? 0 : 1)).join(", "),
        contact.area_mm2 ? brief(contact.area_mm2) : String(contact.area),
        fixed(Math.hypot(...(contact.velocity_mm_s ?? contact.velocity)), 0),
        fixed(contact.age_s, 1)]);
    });
  }
}
