// Small helpers: elements, and numbers as text.

export function element(tag, attributes = {}, ...children) {
  const space = ["svg", "ellipse", "path", "text"].includes(tag) ? "2000/svg" : "1999/xhtml";
  const made = document.createElementNS(`http://www.w3.org/${space}`, tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (typeof value === "boolean") made.toggleAttribute(key, value);
    else made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

// Path of a cross, as of a place that is struck out.
export const cross = (x, y, arm) =>
  `M${x - arm} ${y - arm}l${2 * arm} ${2 * arm}M${x - arm} ${y + arm}l${2 * arm} ${-2 * arm}`;

export const byId = (id) => document.getElementById(id);

export function setText(target, text) {
  if (target.textContent !== text) target.textContent = text;
}

export function highest(map) {
  let high = 0;
  if (map) for (const value of map) if (value > high) high = value;
  return high;
}

// Show texts in the cells of a row of a table.
export function cells(row, tag, texts) {
  while (row.children.length < texts.length) row.append(element(tag, {}));
  texts.forEach((text, k) => setText(row.children[k], text));
}

const known = (value) => value !== null && value !== undefined && Number.isFinite(value);

export function fixed(value, digits, unit = "") {
  return known(value) ? value.toFixed(digits) + (unit && ` ${unit}`) : "–";
}

// Three significant digits, and no exponent.
export function brief(value, unit = "") {
  if (!known(value)) return "–";
  if (Math.abs(value) < 5e-5) value = 0;
  const digits = value === 0 ? 0 : 2 - Math.floor(Math.log10(Math.abs(value)));
  return value.toFixed(Math.min(Math.max(digits, 0), 4)) + (unit && ` ${unit}`);
}

// What clipped noise adds to a total; "" if it adds nothing.
export function noiseText(noiseSum, unit) {
  return noiseSum > 0 ? `an untouched skin shows about ${brief(noiseSum, unit)}` : "";
}

// A value with its standard deviation, rounded to one digit of the latter.
export function within(value, deviation, unit) {
  const digits = Math.min(Math.max(-Math.floor(Math.log10(deviation)), 0), 4);
  return `${value.toFixed(digits)} ± ${deviation.toFixed(digits)} ${unit}`;
}

// Three significant digits without trailing zeros, for the ticks of an axis.
export function tick(value) {
  return String(+value.toPrecision(3));
}

export function bytes(perSecond) {
  if (!known(perSecond)) return "–";
  const step = perSecond >= 1e6 ? [1e6, "MB/s"] : perSecond >= 1e3 ? [1e3, "kB/s"] : [1, "B/s"];
  return brief(perSecond / step[0], step[1]);
}

export function ago(seconds) {
  return seconds < 10 ? `${seconds.toFixed(1)} s` : `${Math.round(seconds)} s`;
}
