// The taxels of a skin as points with normals, and which of them is seen at each pixel of a view.
// Each is a disc in the plane of the surface, on a larger disc of the body that carries the skin.

// What is seen at a pixel: nothing (0), the body from outside or from inside in one of its shades,
// or taxel k as TAXELS + k.
export const SHADES = 64, OUTSIDE = 1, INSIDE = OUTSIDE + SHADES, TAXELS = INSIDE + SHADES;

const NEIGHBOURS = 5; // whose mean distance is the local spacing
const MOST_A_CELL = 32; // points of a cell in which neighbours are sought
const DISC = 0.46; // radius of a taxel's disc in local spacings
const BODY = 1; // radius of the body's discs in local spacings: no gaps in random layouts
const CONE = 0.3; // height of a taxel's middle in its radii: where two overlap, the nearer middle wins
const BEHIND = 0.35; // distance of the body's discs behind the taxels, in their radii
const LEAST = 0.75; // least radius of a disc in pixels: one pixel at least
const GRAZING = 0.12; // least cosine of the angle of view: thinner ellipses are drawn with this one
const MARGIN = 0.48; // radius of the skin in widths of the view
const OVERLAP = 24; // discs on top of one another, averaged over the view, that are drawn in full
const LIGHT = [-0.37, 0.46, 0.81], AMBIENT = 0.3; // from above, left, and the eye

export class Cloud {
  // A record of a skin with points, n x (x, y, z, normal), of the cells that exist, row by row.
  constructor({ n_rows: nRows, n_cols: nCols, pitch_m: pitch, data }) {
    const { points, mask, point_rows: rows } = data;
    this.points = points;
    this.rows = rows ?? null; // of taxel k its row in the file of points, where there is one
    this.n = points.length / 6;
    this.cells = new Int32Array(this.n); // of taxel k its cell on the grid
    this.taxels = new Int32Array(nRows * nCols).fill(-1); // and the reverse
    for (let cell = 0, k = 0; cell < nRows * nCols && k < this.n; cell++) {
      if (mask && !mask[cell]) continue;
      this.cells[k] = cell;
      this.taxels[cell] = k++;
    }
    this.#measure();
    this.#space(pitch);
  }

  // True if a skin has points, one for each of its taxels.
  static of(skin) {
    const { points, mask } = skin.data;
    const n = mask ? mask.reduce((a, b) => a + b, 0) : skin.n_rows * skin.n_cols;
    return points !== undefined && points.length === 6 * n;
  }

  // x, y, z of taxel k in metres.
  place(k) {
    return this.points.subarray(6 * k, 6 * k + 3);
  }

  normal(k) {
    return this.points.subarray(6 * k + 3, 6 * k + 6);
  }

  #measure() {
    const { points } = this, low = [0, 1, 2].map((axis) => points[axis]), high = [...low];
    for (let at = 0; at < points.length; at += 6) {
      for (let axis = 0; axis < 3; axis++) {
        low[axis] = Math.min(low[axis], points[at + axis]);
        high[axis] = Math.max(high[axis], points[at + axis]);
      }
    }
    const centre = low.map((v, axis) => (v + high[axis]) / 2);
    let most = 1e-12;
    for (let at = 0; at < points.length; at += 6) {
      const x = points[at] - centre[0], y = points[at + 1] - centre[1], z = points[at + 2] - centre[2];
      most = Math.max(most, x * x + y * y + z * z);
    }
    this.centre = centre;
    this.radius = Math.sqrt(most);
  }

  // Mean distance of the nearest neighbours of each point, found in cells of a grid.
  #space(pitch) {
    const { points, n, centre } = this;
    const usual = (3.5 * this.radius) / Math.sqrt(n); // of points all over a sphere
    const side = pitch > 0.02 * usual && pitch < 50 * usual ? 2 * pitch : 2 * usual;
    const buckets = 2 ** Math.ceil(Math.log2(2 * n));
    const first = new Int32Array(buckets).fill(-1), next = new Int32Array(n);
    const at = (k, axis) => Math.floor((points[6 * k + axis] - centre[axis]) / side);
    const bucket = (i, j, l) =>
      (Math.imul(i, 73856093) ^ Math.imul(j, 19349663) ^ Math.imul(l, 83492791)) & (buckets - 1);
    for (let k = 0; k < n; k++) {
      const b = bucket(at(k, 0), at(k, 1), at(k, 2));
      next[k] = first[b];
      first[b] = k;
    }
    const best = new Float64Array(NEIGHBOURS);
    const look = (k, b) => {
      for (let other = first[b], seen = 0; other >= 0 && seen < MOST_A_CELL; other = next[other], seen++) {
        const x = points[6 * other] - points[6 * k], y = points[6 * other + 1] - points[6 * k + 1];
        const z = points[6 * other + 2] - points[6 * k + 2], square = x * x + y * y + z * z;
        if (!(square > 0 && square < best[NEIGHBOURS - 1])) continue; // itself, or at its place
        let place = NEIGHBOURS - 1;
        for (; place > 0 && best[place - 1] > square; place--) best[place] = best[place - 1];
        best[place] = square;
      }
    };
    this.spacing = new Float32Array(n);
    for (let k = 0; k < n; k++) {
      best.fill(side * side);
      const [i, j, l] = [at(k, 0), at(k, 1), at(k, 2)];
      for (let u = i - 1; u <= i + 1; u++) for (let v = j - 1; v <= j + 1; v++) {
        for (let w = l - 1; w <= l + 1; w++) look(k, bucket(u, v, w));
      }
      let sum = 0;
      for (const square of best) sum += square < side * side ? Math.sqrt(square) : side / 2;
      this.spacing[k] = sum / NEIGHBOURS;
    }
  }
}

// Directions of a view in the skin's frame: to the right, up, and towards the eye.
export function axes({ yaw, pitch }) {
  const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  return [[-sy, cy, 0], [-sp * cy, -sp * sy, cp], [cp * cy, cp * sy, sp]];
}

export const dot = ([a, b, c], [x, y, z]) => a * x + b * y + c * z;

// Pixels per metre of a view.
export function scaleOf(cloud, view, width, height) {
  return (view.zoom * MARGIN * Math.min(width, height)) / cloud.radius;
}

// Place in pixels of a point of the cloud: to the right, down, and towards the eye.
export function projected(cloud, view, width, height, place) {
  const scale = scaleOf(cloud, view, width, height), { centre: c } = cloud;
  const from = [place[0] - c[0], place[1] - c[1], place[2] - c[2]];
  const [right, up, eye] = axes(view).map((axis) => scale * dot(axis, from));
  return [width * (0.5 + view.x) + right, height * (0.5 + view.y) - up, eye];
}

// What is seen at each pixel: fills target.index, of width x height.
export function rasterise(cloud, view, target) {
  const { width, height, index, depth } = target;
  const [right, up, eye] = axes(view), scale = scaleOf(cloud, view, width, height);
  const [cx, cy, cz] = cloud.centre, { points, spacing } = cloud;
  const x0 = width * (0.5 + view.x), y0 = height * (0.5 + view.y);
  index.fill(0);
  depth.fill(-Infinity);
  let area = 0;
  for (let k = 0; k < cloud.n; k++) area += (BODY * spacing[k] * scale) ** 2;
  // Discs far larger than the spacing of their points would take long, and show nothing more.
  const fit = Math.min(1, Math.sqrt((OVERLAP * view.zoom ** 2 * width * height) / area));
  const most = Math.min(width, height) / 4;
  const radius = (metres) => Math.min(most, Math.max(LEAST, fit * scale * metres));
  for (let k = 0; k < cloud.n; k++) {
    const p = 6 * k;
    const x = points[p] - cx, y = points[p + 1] - cy, z = points[p + 2] - cz;
    const u = x0 + scale * (right[0] * x + right[1] * y + right[2] * z);
    const v = y0 - scale * (up[0] * x + up[1] * y + up[2] * z);
    const body = radius(BODY * spacing[k]);
    if (u < -body || u > width + body || v < -body || v > height + body) continue;
    const w = scale * (eye[0] * x + eye[1] * y + eye[2] * z);
    const n0 = points[p + 3], n1 = points[p + 4], n2 = points[p + 5];
    const facing = eye[0] * n0 + eye[1] * n1 + eye[2] * n2, outside = facing > 0;
    const sign = outside ? 1 : -1, nw = sign * facing;
    const nu = sign * (right[0] * n0 + right[1] * n1 + right[2] * n2);
    const nv = -sign * (up[0] * n0 + up[1] * n1 + up[2] * n2);
    const lit = Math.max(0, LIGHT[0] * nu - LIGHT[1] * nv + LIGHT[2] * nw);
    const shade = Math.round((SHADES - 1) * (AMBIENT + (1 - AMBIENT) * lit));
    const face = Math.max(nw, GRAZING), au = -nu / face, av = -nv / face;
    splat(target, u, v, w - BEHIND * body, au, av, body, 0, (outside ? OUTSIDE : INSIDE) + shade);
    if (outside) splat(target, u, v, w, au, av, radius(DISC * spacing[k]), CONE, TAXELS + k);
  }
}

// A disc about (u, v, w) in the plane of slopes au, av, whose middle is higher by `cone` radii: what
// is nearest to the eye is seen.
function splat({ width, height, index, depth }, u, v, w, au, av, r, cone, value) {
  const top = Math.max(0, Math.ceil(v - r)), bottom = Math.min(height - 1, Math.floor(v + r));
  const rise = cone / r, along = 1 + au * au;
  for (let row = top; row <= bottom; row++) {
    // The pixels of a row with du² + dv² + (au du + av dv)² <= r².
    const dv = row - v, slope = av * dv, inner = r * r - dv * dv - slope * slope;
    const middle = (-au * slope) / along, half = (inner + middle * middle * along) / along;
    if (half < 0) continue;
    const reach = Math.sqrt(half);
    const left = Math.max(0, Math.ceil(u + middle - reach));
    const right = Math.min(width - 1, Math.floor(u + middle + reach));
    for (let at = row * width + left, du = left - u; at <= row * width + right; at++, du++) {
      const dw = au * du + slope;
      const near = w + dw + rise * (r * r - du * du - dv * dv - dw * dw);
      if (near > depth[at]) {
        depth[at] = near;
        index[at] = value;
      }
    }
  }
}
