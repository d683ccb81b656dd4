// Strip charts of the last 60 s. Every frame counts: frames are grouped into buckets of 1 s or
// 0.25 s, each with the extremes, mean and quantiles of its frames.

import { EVENTS } from "./contacts.js";
import { brief, element, noiseText, tick } from "./dom.js";

const SPAN_S = 60;
const LEFT = 44, RIGHT = 10, TOP = 25, BOTTOM = 16;

class Buckets {
  constructor(width) {
    this.width = width;
    this.list = []; // {k, values}, oldest first; bucket k holds times k * width and on
  }

  add(time, value) {
    const k = Math.floor(time / this.width);
    let last = this.list.at(-1);
    if (!last || last.k < k) {
      last = { k, values: [], done: null };
      this.list.push(last);
      while (this.list[0].k < k - SPAN_S / this.width - 2) this.list.shift();
    }
    if (Number.isFinite(value)) last.values.push(value);
    last.done = null;
  }

  // [time of the middle, figures] of each bucket.
  points() {
    return this.list.map((bucket) => {
      bucket.done ??= figures(bucket.values);
      return [(bucket.k + 0.5) * this.width, bucket.done];
    });
  }
}

function figures(values) {
  if (!values.length) return null;
  const sorted = Float64Array.from(values).sort();
  const at = (q) => sorted[Math.min(sorted.length - 1, Math.floor(q * sorted.length))];
  return {
    n: sorted.length, low: sorted[0], high: sorted.at(-1), p50: at(0.5), p99: at(0.99),
    mean: values.reduce((a, b) => a + b, 0) / values.length, last: values.at(-1),
  };
}

const CHARTS = [
  { id: "psnr", title: "PSNR", unit: "dB", floating: true, lines: [
    ["noisy", "psnr_noisy_db", (f) => f.mean, "taxels"],
    ["good", "psnr_db", (f) => f.mean, "reconstruction"]], band: true },
  { id: "latency", title: "Latency", unit: "ms", lines: [
    ["good", "latency_ms", (f) => f.p50, "p50"], ["noisy", "latency_ms", (f) => f.p99, "p99"]] },
  { id: "solve", title: "Solve time", unit: "ms", lines: [
    ["good", "solve_ms", (f) => f.p50, "p50"], ["noisy", "solve_ms", (f) => f.p99, "p99"]] },
  { id: "rate", title: "Rate", unit: "Hz", lines: [
    ["good", "rate", (f) => f.n, "frames"], ["bad", "lost", (f) => f.last, "lost"]], asked: true },
];
const WIDTHS = { total: 0.25, contacts: 0.25, pressed: 0.25, psnr_noisy_db: 0.25, psnr_db: 0.25, latency_ms: 1, solve_ms: 1, lost: 0.25, rate: 1,
  ...Object.fromEntries(Object.keys(EVENTS).map((name) => [name, 0.5])) };

// Charts of all patches together, of forces in a unit.
export const chartsOfAll = (unit) => [
  { id: "total", title: "Total", unit, lines: [["good", "total", (f) => f.mean, "all patches"]] },
  { id: "pressed", title: "Patches pressed", unit: "", lines: [["good", "pressed", (f) => f.last, "now"]] },
];

// Charts of one patch of a skin.
export const chartsOfPatch = ({ sum_unit: unit, f_max: fMax }) => [
  { id: "force", title: "Total force", unit, least: fMax, marked: true, counted: ["contacts", "contacts"],
    lines: [["good", "total", (f) => f.mean, "total"]] },
  ...CHARTS];

export class Strips {
  constructor(root, charts) {
    this.charts = charts;
    this.series = Object.fromEntries(
      Object.entries(WIDTHS).map(([name, width]) => [name, new Buckets(width)]));
    this.canvases = charts.map((chart) => element("canvas", { "data-strip": chart.id, role: "img",
      "aria-label": `${chart.title}, last ${SPAN_S} s` }));
    root.replaceChildren(...this.canvases.map((canvas) => element("figure", {}, canvas)));
  }

  // Add the figures of frames or the numbers of their events: a record of kind "rows" or "events".
  add({ kind, columns, now_s: now, data: { rows } }) {
    for (let at = 0; at < rows.length; at += columns.length) {
      const time = now + rows[at];
      columns.forEach((name, c) => {
        if (kind === "rows" || rows[at + c]) this.series[name]?.add(time, rows[at + c]);
      });
      if (kind === "rows") this.series.rate.add(time, 1);
    }
  }

  // The frames of the last whole second.
  rate(now) {
    const k = Math.floor(now) - 1;
    return this.series.rate.list.find((bucket) => bucket.k === k)?.values.length ?? 0;
  }

  draw(now, asked) {
    this.charts.forEach((chart, k) => this.chart(this.canvases[k], chart, now, asked));
  }

  lineOf(name, figure, now) {
    const points = this.series[name].points();
    if (name === "lost") return this.losses(points, now);
    if (name !== "rate") return points.map(([t, f]) => [t, f && figure(f), f]);
    // A second without a frame is a rate of 0, and the second under way is not over yet.
    const found = new Map(points.map(([t, f]) => [Math.floor(t), f?.n ?? 0]));
    const first = points.length ? Math.floor(points[0][0]) : Infinity;
    const line = [];
    for (let k = first; k < Math.floor(now); k++) line.push([k + 0.5, found.get(k) ?? 0, null]);
    return line;
  }

  // Frames lost in each whole second, from the counts since the start.
  losses(points, now) {
    const counts = new Map();
    for (const [t, f] of points) if (f) counts.set(Math.floor(t), f.last);
    let before = counts.values().next().value;
    const line = [];
    for (let k = counts.keys().next().value; k < Math.floor(now); k++) {
      const count = counts.get(k) ?? before;
      line.push([k + 0.5, Math.max(0, count - before), null]);
      before = count;
    }
    return line;
  }

  chart(canvas, chart, now, asked) {
    const width = canvas.clientWidth, height = canvas.clientHeight;
    const ratio = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const g = canvas.getContext("2d"), style = getComputedStyle(canvas);
    const colour = (name) => style.getPropertyValue(`--${name}`).trim();
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, width, height);
    g.font = "11px system-ui, sans-serif";
    const lines = chart.lines.map(([tone, name, figure, label]) =>
      ({ tone, label, points: this.lineOf(name, figure, now).filter(([t]) => t > now - SPAN_S) }));
    const [low, high] = limits(lines, chart, asked);
    const x = (t) => LEFT + ((t - now + SPAN_S) / SPAN_S) * (width - LEFT - RIGHT);
    const y = (v) => TOP + ((high - v) / (high - low)) * (height - TOP - BOTTOM);
    g.fillStyle = g.strokeStyle = colour("dim");
    g.lineWidth = 0.5;
    g.textBaseline = "middle";
    for (const v of [low, low < 0 && !chart.floating ? 0 : (low + high) / 2, high]) {
      g.beginPath(); g.moveTo(LEFT, y(v)); g.lineTo(width - RIGHT, y(v)); g.stroke();
      g.textAlign = "right"; g.fillText(tick(v), LEFT - 5, y(v));
    }
    g.textBaseline = "alphabetic";
    for (const s of [60, 40, 20, 0]) {
      g.textAlign = s === 60 ? "left" : s === 0 ? "right" : "center";
      g.fillText(s ? `−${s} s` : "now", x(now - s), height - 3);
    }
    if (chart.marked) this.marks(g, now, x, y(low), colour);
    if (chart.asked && asked) {
      g.setLineDash([4, 3]); g.strokeStyle = colour("text"); g.lineWidth = 1;
      g.beginPath(); g.moveTo(LEFT, y(asked)); g.lineTo(width - RIGHT, y(asked)); g.stroke();
      g.setLineDash([]);
    }
    for (const { tone, points } of lines) {
      if (chart.band) band(g, points, x, y, colour(tone));
      curve(g, points, x, y, colour(tone), tone === "noisy");
    }
    const [name, label] = chart.counted ?? [];
    const count = name && this.series[name].points().at(-1)?.[1]?.last;
    const texts = [count === undefined ? "" : `${label} ${count}`];
    if (chart.id === "force") texts.push(noiseText(this.noiseSum, chart.unit));
    legend(g, chart, lines, asked, colour, width, texts.filter((text) => text));
  }

  // Events of contacts: begin and end on the lowest line, the others above it.
  marks(g, now, x, bottom, colour) {
    g.textAlign = "center";
    g.font = "9px system-ui, sans-serif";
    Object.entries(EVENTS).forEach(([name, [mark, tone]], k) => {
      g.fillStyle = colour(tone);
      for (const [t, f] of this.series[name].points()) {
        if (f && t > now - SPAN_S) g.fillText(mark, x(t), bottom - (k < 2 ? 2 : 11));
      }
    });
  }
}

// Ends of the axis of a chart.
export function limits(lines, chart, asked) {
  const values = lines.flatMap(({ points }) => points.flatMap(([, v, f]) =>
    chart.band && f ? [f.low, f.high] : v === null ? [] : [v]));
  if (chart.asked && asked) values.push(asked);
  let low = values.length ? Math.min(...values) : 0;
  let high = values.length ? Math.max(...values) : 1;
  if (chart.floating) {
    low = 5 * Math.floor((low - 0.5) / 5);
    high = 5 * Math.ceil((high + 0.5) / 5);
  } else {
    // Latencies are below 0 where stamps are ahead of the clock.
    low = low < 0 ? -nice(-low * 1.08) : 0;
    high = Math.max(chart.least ?? 0, nice(high * 1.08));
  }
  return [low, high > low ? high : low + 1];
}

// A rounded-up end of an axis whose half is round as well.
function nice(value) {
  if (!(value > 0)) return 1;
  const decade = 10 ** Math.floor(Math.log10(value));
  return [1, 1.2, 1.6, 2, 2.4, 3, 4, 5, 6, 8, 10].map((k) => k * decade).find((v) => v >= value);
}

function curve(g, points, x, y, colour, dashed) {
  g.strokeStyle = colour;
  g.lineWidth = 1.5;
  g.setLineDash(dashed ? [5, 2] : []);
  g.beginPath();
  let open = false, before = 0;
  for (const [t, v] of points) {
    if (v === null) { open = false; continue; }
    if (open && t - before < 2.5) g.lineTo(x(t), y(v)); else g.moveTo(x(t), y(v));
    open = true;
    before = t;
  }
  g.stroke();
  g.setLineDash([]);
}

function band(g, points, x, y, colour) {
  g.fillStyle = colour;
  g.globalAlpha = 0.25;
  for (const [t, , f] of points) {
    if (f) g.fillRect(x(t - 0.125), y(f.high), Math.max(1, x(t + 0.125) - x(t - 0.125)),
      Math.max(1, y(f.low) - y(f.high)));
  }
  g.globalAlpha = 1;
}

function legend(g, chart, lines, asked, colour, width, texts) {
  g.textAlign = "left";
  g.fillStyle = colour("text");
  const title = chart.unit ? `${chart.title} (${chart.unit})` : chart.title;
  g.font = "600 11px system-ui, sans-serif";
  g.fillText(title, 4, 12);
  let at = 14 + g.measureText(title).width;
  g.font = "11px system-ui, sans-serif";
  const entries = lines.filter(({ points }) => points.some(([, v]) => v !== null)).map((line) => {
    const last = line.points.findLast(([, v]) => v !== null);
    return [line.tone, lines.length > 1 ? `${line.label} ${brief(last[1])}` : brief(last[1])];
  });
  if (chart.asked && asked) entries.push(["text", `requested ${brief(asked)}`]);
  entries.push(...texts.map((text) => ["text", text]));
  for (const [tone, text] of entries) {
    if (at + g.measureText(text).width > width) break;
    g.fillStyle = colour(tone);
    g.fillText(text, at, 12);
    at += g.measureText(text).width + 10;
  }
}
