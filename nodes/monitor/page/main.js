// The page: reads records of the monitor's stream and draws them.

import { Body } from "./body.js";
import { ContactList, contactsOf } from "./contacts.js";
import { Controls } from "./controls.js";
import { brief, byId, bytes, element, fixed, highest, setText } from "./dom.js";
import { CONTACT, Maps } from "./maps.js";
import { notices } from "./notices.js";
import { Stream } from "./stream.js";
import { chartsOfAll, chartsOfPatch, Strips } from "./strips.js";

const STRIPS_MS = 250;
const TEXT_MS = 100;

const model = {
  run: null, connection: "connecting", heard: 0, silent: 0, over: false, quiet: false,
  graph: null, hosts: [], state: null, summaries: {}, skins: {}, maps: {}, fresh: {}, traffic: {},
};
let patch = null; // null: the overview
let stream = null, maps = null, strips = null, contactList = null, body = null;
let clock = 0; // the monitor's clock less the browser's, in seconds
const controls = new Controls(byId("controls"));

const seconds = () => performance.now() / 1000;

function onConnection(connection) {
  model.connection = connection;
  model.heard = seconds();
  // A reason of another monitor is news; that this one cannot be reached any more is none.
  if (!["connecting", "closed"].includes(connection)) model.over = false;
}

function onRecord(record) {
  model.heard = seconds();
  if (record.kind === "state") onState(record);
  else if (record.kind === "skin") onSkin(record);
  else if (record.kind === "maps") {
    model.maps[record.patch] = record;
    model.fresh[record.patch] = true;
    requestAnimationFrame(drawMaps);
  } else if (["rows", "events"].includes(record.kind)) strips?.add(record);
  else if (record.kind === "answer") controls.answer(record);
}

function onState(record) {
  const before = model.state;
  clock = record.now_s - seconds();
  if (model.run !== null && record.run !== model.run) {
    location.reload(); // another graph or monitor: nothing shown here belongs to it
    return;
  }
  model.run = record.run;
  model.state = record;
  model.over = record.closed;
  if (record.graph) [model.graph, model.hosts] = [record.graph, record.hosts];
  for (const [name, state] of Object.entries(record.patches)) {
    if (state.summary) onSummary(name, state.summary, record.now_s);
    state.summary = model.summaries[name];
  }
  const names = Object.keys(record.patches);
  if (!before && patch === null && names.length === 1) location.replace(`#/${names[0]}`);
}

function onSkin(record) {
  model.skins[record.patch] = record;
  model.fresh[record.patch] = false; // the frame shown is of another skin
  delete model.maps[record.patch];
  if (record.patch === patch) newMaps();
  body?.skin(record);
}

// The maps of the skin, or of all skins, in the view that is chosen, with the newest frame.
function newMaps() {
  maps?.close();
  const skin = body ? body.whole() : model.skins[patch];
  maps = skin ? new Maps(byId("maps"), skin) : null;
  if (body) strips ??= new Strips(byId("strips"), chartsOfAll(skin.sum_unit));
  if (!body && skin) strips ??= new Strips(byId("strips"), chartsOfPatch(skin));
  if (maps && !body && model.maps[patch]) showMaps();
}

function showMaps() {
  const record = body ? body.newest() : model.maps[patch];
  const contacts = body ? record.contacts : contactsOf(record.contacts);
  maps?.show({ ...record, contacts }, performance.now());
}

// Bytes a second, from the counts of two summaries some time apart.
function onSummary(name, summary, now) {
  model.summaries[name] = summary;
  const traffic = (model.traffic[name] ??= []);
  traffic.push([now, summary.bytes_in, summary.bytes_out]);
  while (traffic.length > 2 && now - traffic[0][0] > 3) traffic.shift();
}

function rates(name) {
  const traffic = model.traffic[name] ?? [];
  if (traffic.length < 2) return [NaN, NaN];
  const [first, last] = [traffic[0], traffic.at(-1)];
  const span = last[0] - first[0];
  return span > 0 ? [1, 2].map((k) => (last[k] - first[k]) / span) : [NaN, NaN];
}

function drawMaps() {
  const fresh = Object.keys(model.fresh).filter((name) => model.fresh[name]);
  for (const name of fresh) {
    model.fresh[name] = false;
    document.body.dataset.drawn = Number(document.body.dataset.drawn ?? 0) + 1;
    body?.maps(model.maps[name]);
    if (name === patch) noteForces(model.maps[name]);
  }
  if (body && fresh.length && !body.cloud) newMaps();
  if (fresh.length) showMaps();
}

// Enter total and number of contacts of a frame in their charts, and show its measurements.
function noteForces({ data: { reconstruction, measurements }, contacts }) {
  if (reconstruction) {
    let total = 0;
    for (const force of reconstruction) total += force || 0;
    strips?.series.total.add(seconds() + clock, total);
  }
  if (contacts) strips?.series.contacts.add(seconds() + clock, contacts.n);
  if (measurements) showMeasurements(measurements);
}

// The measurements of a frame, -127 to 127, as a strip of grey cells; what is 0 is in the middle.
function showMeasurements(values) {
  const canvas = byId("measured"), m = values.length;
  if (canvas.width !== m) [canvas.width, canvas.height] = [m, 1];
  const image = new ImageData(m, 1), pixels = new Uint32Array(image.data.buffer);
  for (let k = 0; k < m; k++) pixels[k] = 0xff000000 | (0x010101 * (128 + values[k]));
  canvas.getContext("2d").putImageData(image, 0, 0);
  const n = model.summaries[patch]?.n;
  byId("in-and-out").hidden = false;
  setText(byId("numbers-in"), `${m} numbers in`);
  setText(byId("forces-out"), n ? `${n} forces out` : "");
}

// The frames that PSNR is shown of: those in contact, before the first one all.
function shownFrames(summary) {
  return summary?.psnr_db?.reconstruction?.contact ? "contact" : "all";
}

function mean(summary, which) {
  return summary?.psnr_db?.[which]?.[shownFrames(summary)]?.mean ?? NaN;
}

// The rate that was asked for: the skin's own, times that of a replay.
function asked(name) {
  const player = model.graph?.nodes.find((node) => "seek" in node.commands);
  return (model.skins[name]?.rate_hz ?? 0) * (player?.state.rate ?? 1);
}

// The mark of a patch whose frames are not to be trusted now, with the reason; "" if they are.
function notTrusted(state) {
  if (state?.trusted !== false) return "";
  // An error that is large beside the forces says nothing where there are none.
  const { reconstruction } = model.maps[patch]?.data ?? {};
  const isEmpty = highest(reconstruction) <= CONTACT * (model.skins[patch]?.f_max ?? 0);
  if (isEmpty && state.reason?.word === "error") return "";
  return state.reason ? `not trusted: ${state.reason.phrase}` : "not trusted";
}

// The share of trusted frames in those that PSNR is shown of; "" if the solver estimates none. It is
// 100 % only where all of them are trusted.
function trusted(summary) {
  const found = summary?.trust?.[shownFrames(summary)];
  if (!found) return "";
  return `${found.untrusted ? Math.min(99, Math.round(100 * found.trusted_share)) : 100} % trusted`;
}

// The label of the newest frame, its share and age, where a node recognises.
function labelTile(label, isQuiet) {
  if (!label) return [];
  const isOld = !isQuiet && label.silent_s > 1;
  const note = isOld ? `no label for ${label.silent_s.toFixed(0)} s`
    : label.label ? `${(100 * label.share).toFixed(0)} % share, for ${label.age_s.toFixed(1)} s`
      : "no label has a large enough share";
  return [["label", "Recognised", (!isOld && label.label) || "–", note]];
}

function tiles(name) {
  const s = model.summaries[name] ?? {};
  const [before, after] = rates(name);
  const gain = mean(s, "reconstruction") - mean(s, "noisy");
  const skin = model.skins[name];
  const rate = strips?.rate(seconds() + clock);
  return [
    ["compression", "Compression", s.ratio ? `${s.ratio.toFixed(2)} : 1` : "–",
      !s.n ? "Φ is not known yet" : s.bits && s.bits < 32
        ? `N/M ${s.n}/${s.m}, ${s.bits} bits: ${s.ratio_bits.toFixed(1)} : 1`
        : `N = ${s.n}, M = ${s.m}`],
    ["traffic", "Data rate of the edge", `${bytes(after)}`,
      skin?.has_taxels === false ? "compressed outside the graph" : `instead of ${bytes(before)}`],
    ["gain", `PSNR${Number.isFinite(gain) ? " gain" : ""}${shownFrames(s) === "contact" ? " in contact" : ", all frames"}`,
      Number.isFinite(gain) ? `${gain >= 0 ? "+" : "−"}${Math.abs(gain).toFixed(1)} dB`
        : fixed(mean(s, "reconstruction"), 1, "dB"),
      Number.isFinite(gain) ? `${trusted(s) ? "" : "mean "}${fixed(mean(s, "noisy"), 1)} → ${fixed(
        mean(s, "reconstruction"), 1, "dB")}${trusted(s) && `, ${trusted(s)}`}`
        : skin?.has_taxels === false ? trusted(s) || "no taxels to compare with"
        : trusted(s) ? `against the taxels, ${trusted(s)}`
          : "against the taxels; the truth is not known"],
    ["latency", "Latency, all frames", `${fixed(s.latency_ms?.p50, 1, "ms")}`
      + (s.latency_uncertainty_ms ? ` ± ${fixed(s.latency_uncertainty_ms, 1)}` : ""),
      `p99 ${brief(s.latency_ms?.p99, "ms")}, solve ${brief(s.solve_ms?.p50, "ms")}`],
    ["rate", "Rate", `${rate ?? "–"} Hz`, skin?.rate_hz ? `requested ${brief(asked(name))} Hz`
      : "as fast as possible"],
    ["frames", "Frames", `${s.frames?.reconstructed ?? "–"}`,
      `of ${s.frames?.sensed ?? "–"}, ${s.frames?.skipped ? `${s.frames.skipped} skipped, ` : ""}`
      + `${model.state?.patches[name]?.lost ?? "–"} lost`],
    ...labelTile(model.state?.patches[name]?.label, model.quiet || model.over),
  ];
}

// Headline figures, each [id, title, value, note].
function drawTiles(tiles) {
  for (const [id, ...texts] of tiles) {
    const tile = byId("headline").querySelector(`[data-tile="${id}"]`) ?? element("div",
      { class: "tile", "data-tile": id }, element("h2"), element("strong"), element("span"));
    if (!tile.isConnected) byId("headline").append(tile);
    texts.forEach((text, k) => setText(tile.children[k], text));
  }
}

function drawHeadline() {
  drawTiles(tiles(patch));
  const state = model.state?.patches[patch], doubt = notTrusted(state);
  const tile = byId("headline").querySelector('[data-tile="gain"]');
  tile.dataset.mark = doubt && "not trusted";
  tile.title = doubt && (state.reason?.sentence ?? "");
  const recognised = byId("headline").querySelector('[data-tile="label"]');
  if (recognised) {
    recognised.dataset.mark = state?.label?.trusted === false ? "not trusted" : "";
    recognised.title = recognised.children[1].textContent;
  }
  const heading = byId("maps").querySelector('[data-panel="reconstruction"] h2');
  if (heading) heading.dataset.mark = doubt;
}

function condition(node) {
  return model.over && node.condition !== "failed" ? "ended" : node.condition;
}

// The elements of a list, as many as there are to be, each with its text.
function listed(id, texts) {
  const list = byId(id);
  if (list.children.length !== texts.length) {
    list.replaceChildren(...texts.map(() => element("li")));
  }
  texts.forEach((text, k) => setText(list.children[k], text));
  return list.children;
}

// Nodes that do what is usual are counted, all others named.
function drawNodes() {
  const usual = model.over ? "ended" : isStarting() ? "starting" : "running", nodes = model.graph?.nodes ?? [];
  const rest = nodes.filter((node) => condition(node) === usual && !node.restarts);
  const shown = nodes.filter((node) => !rest.includes(node)).map((node) => [condition(node),
    `${node.name}: ${condition(node)}${node.restarts ? `, restarts: ${node.restarts}` : ""}`, node.line]);
  if (rest.length) {
    const text = `${rest.length} node${rest.length > 1 ? "s" : ""} ${usual}`;
    shown.push([usual, text, rest.map(({ name }) => name).join(", ")]);
  }
  const items = listed("nodes", shown.map(([, text]) => text));
  shown.forEach(([now, , line], k) => {
    items[k].dataset.condition = now;
    items[k].title = line;
  });
  const hosts = listed("hosts", model.hosts.map(([, text]) => text));
  model.hosts.forEach(([heard], k) => (hosts[k].dataset.condition = model.over ? "ended" : heard));
}

function drawNotices() {
  const found = notices(model);
  const shown = found.filter(([tone]) => tone !== "start"); // which has a place of its own
  const items = listed("notices", shown.map(([, text]) => text));
  shown.forEach(([tone], k) => (items[k].className = tone));
  const bad = found.some(([tone]) => tone === "bad");
  const start = found.find(([tone]) => tone === "start");
  drawStart(bad || !start ? "" : start[1], model.state?.start);
  const pill = byId("liveness");
  pill.className = `pill ${bad ? "bad" : found.length ? "note" : "good"}`;
  const stale = found.some(([, text]) => text.includes("stale"));
  const waits = model.connection !== "open" && !model.over;
  setText(pill, model.over ? "ended" : waits ? "no connection" : stale ? "stale"
    : model.quiet ? "paused" : bad ? "fault" : isStarting() ? "starting" : "live");
  document.body.classList.toggle("starting", isStarting());
}

// True until the first frame is shown of a graph that starts, or of which nothing is known yet.
function isStarting() {
  const nothing = !Object.keys(model.skins).length && !Object.keys(model.maps).length;
  return nothing && !model.over && (model.state === null || Boolean(model.state.start));
}

// How far the start is, in words and as a bar; "": no start.
function drawStart(text, start) {
  const section = byId("start"), [line, bar] = section.children;
  section.hidden = !text;
  if (!text || !start) return;
  setText(line, text);
  [bar.value, bar.max] = start;
}

function drawOverview() {
  const states = model.state?.patches ?? {};
  body.table(states, model.quiet, (name, { lost }) => {
    const s = model.summaries[name] ?? {};
    return [`${fixed(mean(s, "noisy"), 1)} → ${fixed(mean(s, "reconstruction"), 1)}`,
      trusted(s).replace(" trusted", "") || "–",
      `${fixed(s.latency_ms?.p50, 1)}, p99 ${fixed(s.latency_ms?.p99, 1)}`,
      `${s.frames?.skipped ?? 0}`, `${lost}`];
  });
  const { tiles: shown, ...charted } = body.tiles(states, model.quiet);
  drawTiles(shown);
  for (const [name, value] of model.quiet ? [] : Object.entries(charted)) {
    strips?.series[name].add(seconds() + clock, value);
  }
}

function drawText() {
  model.silent = model.connection === "open" ? seconds() - model.heard : 0;
  model.quiet = model.state?.paused ?? false;
  setText(byId("graph-name"), model.graph?.name ?? "");
  byId("recording").hidden = !model.graph?.recording;
  setText(byId("recording"), `● recording ${model.graph?.recording ?? ""}`);
  drawNodes();
  drawNotices();
  if (body) return drawOverview();
  drawHeadline();
  const record = model.maps[patch];
  if (record?.contacts && maps) {
    contactList.show(maps.contacts, record.contacts, model.skins[patch], seconds());
  }
  if (model.graph && model.state) {
    controls.show(model.graph, patch, contactList.isShown, model.skins[patch]?.has_truth);
  }
  controls.rest(model.over ? "The graph has ended: nothing can be set."
    : model.connection === "open" ? "" : "No connection: nothing can be set.");
  const state = model.state?.patches[patch];
  const reachable = model.connection === "open";
  // Data that arrived before the last record are older by the time since.
  const behind = Math.max(0, seconds() - model.heard);
  const ages = Object.fromEntries(
    Object.entries(state?.age_s ?? {}).map(([name, age]) => [name, age + behind]));
  const solver = model.graph?.nodes.find(
    (node) => node.patch === patch && "faulty_taxels" in node.state);
  const noiseSum = model.summaries[patch]?.noise_sum ?? 0;
  if (maps) maps.noiseSum = noiseSum;
  if (strips) strips.noiseSum = noiseSum;
  maps?.markFaulty(solver?.state.faulty_taxels ?? []);
  maps?.markStale(ages, state?.stale_s ?? 0.2,
    model.over || (reachable && (model.quiet || state?.ended)));
}

function open() {
  const name = decodeURIComponent(location.hash.replace(/^#\/?/, "")) || null;
  stream?.close();
  patch = name;
  maps?.close();
  maps = null;
  document.body.classList.toggle("overview", name === null);
  for (const id of ["strips", "maps", "headline", "patches"]) byId(id).replaceChildren();
  byId("contacts")?.remove();
  body = name === null ? new Body(byId("patches")) : null;
  strips = null;
  byId("in-and-out").hidden = true;
  contactList = name === null ? null : new ContactList(byId("look"));
  [model.skins, model.maps, model.fresh] = [{}, {}, {}];
  stream = new Stream(name, onRecord, onConnection);
}

// The token is in a cookie now, and need not be in the history.
if (location.search) history.replaceState(null, "", location.pathname + location.hash);
window.addEventListener("hashchange", open);
byId("range").addEventListener("change", () => maps?.draw(performance.now()));
byId("view").addEventListener("change", newMaps);
byId("maps").addEventListener("dblclick", () => {
  if (body && maps?.pointed) location.hash = `#/${maps.pointed.patch}`;
});
byId("reset-view").addEventListener("click", () => maps?.view.reset());
byId("zoom").addEventListener("click", ({ currentTarget: button }) => {
  button.setAttribute("aria-pressed", button.getAttribute("aria-pressed") !== "true");
  button.dataset.chosen = "";
  maps?.zoom();
});
open();
setInterval(drawText, TEXT_MS);
setInterval(() => strips?.draw(seconds() + clock, asked(patch)), STRIPS_MS);
