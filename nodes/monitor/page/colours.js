// The viridis map (van der Walt, Smith, Firing, 2015): even to the eye, and to the colour-blind.

const ANCHORS = [
  "440154", "48186a", "472d7b", "424086", "3b528b", "33638d", "2c728e", "26828e", "21918c",
  "1fa088", "28ae80", "3fbc73", "5ec962", "84d44b", "addc30", "d8e219", "fde725",
].map((hex) => [0, 2, 4].map((k) => parseInt(hex.slice(k, k + 2), 16)));

const N = 256;

function interpolated(k) {
  const place = (k / (N - 1)) * (ANCHORS.length - 1);
  const left = Math.min(Math.floor(place), ANCHORS.length - 2);
  return [0, 1, 2].map((c) =>
    Math.round(ANCHORS[left][c] + (place - left) * (ANCHORS[left + 1][c] - ANCHORS[left][c])));
}

// 256 opaque pixels, as they lie in an ImageData on a little-endian machine.
export const VIRIDIS = Uint32Array.from({ length: N }, (_, k) => {
  const [r, g, b] = interpolated(k);
  return ((255 << 24) | (b << 16) | (g << 8) | r) >>> 0;
});

export const MISSING = 0xff8c8c8c; // grey, as no force is: the reading of a taxel is missing

// The pixel of a force, of which `scale` makes a place in the map; NaN: its reading is missing.
export function pixel(force, scale) {
  if (Number.isNaN(force)) return MISSING;
  return VIRIDIS[Math.max(0, Math.min(N - 1, (force * scale) | 0))];
}

export function css(fraction) {
  const [r, g, b] = interpolated(Math.round(fraction * (N - 1)));
  return `rgb(${r},${g},${b})`;
}

export const GRADIENT =
  `linear-gradient(to top, ${Array.from({ length: 17 }, (_, k) => css(k / 16)).join(",")})`;

// The next number of the series 1, 2, 5, 10 ... that is not below the value.
function rounded(value) {
  if (!(value > 0)) return 0;
  const decade = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].map((k) => k * decade).find((v) => v >= value * (1 - 1e-9));
}

const HOLD_MS = 5000; // a range that was too wide for this long shrinks

// Upper end of a steady colour range, within its least and its most.
export class Range {
  constructor(least, most) {
    [this.least, this.most, this.top] = [least, most, 0];
  }

  // The range of a map with this peak at a time in milliseconds: it grows at once.
  over(peak, now) {
    const wanted = Math.min(Math.max(rounded(peak), rounded(this.least)), this.most);
    if (wanted < this.top) {
      this.high = Math.max(this.high, wanted);
      if (now - this.since <= HOLD_MS) return this.top;
    }
    [this.top, this.high, this.since] = [wanted < this.top ? this.high : wanted, 0, now];
    return this.top;
  }
}
