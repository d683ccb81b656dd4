// The taxels of a skin as points with normals, and which of them is seen at each pixel of a view.
// Each is a disc in the plane of the surface, on a larger disc of the body that carries the skin.

// What is seen at a pixel: nothing (0), the body from outside or from inside in one of its shades,
// or taxel k as TAXELS + k.
export const SHADES = 64, OUTSIDE = 1, INSIDE = OUTSIDE + SHADES, TAXELS = INSIDE + SHADES;

const NEAREST = 3; // neighbours whose mean distance is the local spacing
const DISC = 0.46; // radius of a taxel's disc in local spacings
const BODY = 1; // radius of the body's discs in local spacings: no gaps in random layouts
const CONE = 0.3; // height of a taxel's middle in its radii: where two overlap, the nearer middle wins
const BEHIND = 0.35; // distance of the body's discs behind the taxels, in their radii
const LEAST = 0.75; // least radius of a disc in pixels: one pixel at least
const GRAZING = 0.12; // least cosine of the angle of view: thinner ellipses are drawn with this one
const RIM = 0.02; // of the plate around a flat skin, in its longer sides
const PITCH_M = 0.005; // of a skin that states none
const MARGIN = 0.48; // radius of the skin in widths of the view
const LIGHT = [-0.37, 0.46, 0.81], AMBIENT = 0.3; // from above, left, and the eye

export class Cloud {
  // Records of skins: with points, n x (x, y, z, normal) of the cells that exist, row by row, or flat
  // grids; each at its pose, without one in the origin.
  constructor(skins) {
    const sizes = skins.map(({ n_rows: nRows, n_cols: nCols }) => nRows * nCols);
    const taxels = skins.map(({ data: { mask } }, k) =>
      mask ? mask.reduce((a, b) => a + b, 0) : sizes[k]);
    const sum = (list, end) => list.slice(0, end).reduce((a, b) => a + b, 0);
    this.n = sum(taxels);
    this.points = new Float32Array(6 * this.n);
    this.cells = new Int32Array(this.n); // of taxel k its cell, those of all skins in a row
    this.taxels = new Int32Array(sum(sizes)).fill(-1); // and the reverse
    this.parts = skins.map((skin, k) => new Part(skin, sum(sizes, k), sum(taxels, k), taxels[k]));
    for (const part of this.parts) part.place(this);
    this.#measure();
    this.spacing = new Float32Array(this.n);
    for (const part of this.parts) {
      if (part.isFlat) this.spacing.fill(part.pitch, part.first, part.first + part.n);
      else this.#space(part);
    }
  }

  // True if a skin has points, one for each of its taxels.
  static of(skin) {
    const { points, mask } = skin.data;
    const n = mask ? mask.reduce((a, b) => a + b, 0) : skin.n_rows * skin.n_cols;
    return points !== undefined && points.length === 6 * n;
  }

  // The part of a patch, or of taxel k.
  part(of) {
    return this.parts.find(({ skin, first, n }) => skin.patch === of || of < first + n);
  }

  // x, y, z of taxel k in metres.
  place(k) {
    return this.points.subarray(6 * k, 6 * k + 3);
  }

  normal(k) {
    return this.points.subarray(6 * k + 3, 6 * k + 6);
  }

  // The middle of the box of all points, and the radius about it.
  #measure() {
    const { points } = this, far = [0, 1, 2].map(() => [Infinity, -Infinity]);
    for (let at = 0; at < points.length; at++) {
      const ends = far[at % 6];
      if (points[at] < ends?.[0]) ends[0] = points[at];
      if (points[at] > ends?.[1]) ends[1] = points[at];
    }
    const centre = this.centre = far.map(([low, high]) => (low + high) / 2);
    let most = 1e-24;
    for (let at = 0; at < points.length; at += 6) {
      most = Math.max(most, (points[at] - centre[0]) ** 2 + (points[at + 1] - centre[1]) ** 2
        + (points[at + 2] - centre[2]) ** 2);
    }
    this.radius = Math.sqrt(most);
  }

  // Mean distance of the taxels of a part to the nearest of their neighbours on its grid.
  #space({ skin: { n_rows: nRows, n_cols: nCols }, cell, first, n, pitch }) {
    for (let k = first; k < first + n; k++) {
      const row = Math.floor((this.cells[k] - cell) / nCols), col = (this.cells[k] - cell) % nCols;
      const near = [], [x, y, z] = this.place(k);
      for (let at = 0; at < 9; at++) {
        const r = row + Math.floor(at / 3) - 1, c = col + (at % 3) - 1;
        if (r < 0 || c < 0 || r >= nRows || c >= nCols) continue;
        const other = this.taxels[cell + r * nCols + c];
        if (other < 0 || other === k) continue;
        const [u, v, w] = this.place(other);
        near.push(Math.hypot(u - x, v - y, w - z));
      }
      const nearest = near.sort((a, b) => a - b).slice(0, NEAREST);
      this.spacing[k] = nearest.reduce((a, b) => a + b, 0) / nearest.length || pitch;
    }
  }
}

// One skin of a cloud: taxels from `first` on, cells from `cell` on.
class Part {
  constructor(skin, cell, first, n) {
    Object.assign(this, { skin, cell, first, n, isFlat: !Cloud.of(skin) });
    this.pitch = skin.pitch_m || PITCH_M;
    const [x, y, z, ...angles] = skin.pose ?? [0, 0, 0, 0, 0, 0];
    this.origin = [x, y, z].map((mm) => mm / 1000);
    const [[cr, sr], [cp, sp], [cy, sy]] = angles.map((a) => (a * Math.PI) / 180)
      .map((a) => [Math.cos(a), Math.sin(a)]);
    this.turn = [[cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
      [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], [-sp, cp * sr, cp * cr]];
  }

  // A direction of the skin in the frame of all.
  turned(direction) {
    return this.turn.map((row) => dot(row, direction));
  }

  // A place on a flat skin, in rows and columns: columns run along x, rows against y.
  at(row, col) {
    const { n_rows: nRows, n_cols: nCols } = this.skin, { pitch } = this;
    const flat = [pitch * (col - (nCols - 1) / 2), pitch * ((nRows - 1) / 2 - row), 0];
    return this.turned(flat).map((v, axis) => v + this.origin[axis]);
  }

  // A contact with its place and normal in the frame of all.
  placed({ centre, place_mm: own, normal, ...contact }) {
    const place = this.isFlat ? this.at(...centre)
      : own && this.turned(own.map((v) => v / 1000)).map((v, axis) => v + this.origin[axis]);
    return { ...contact, place_mm: place?.map((v) => 1000 * v),
      normal: this.isFlat ? this.turned([0, 0, 1]) : normal && this.turned(normal) };
  }

  // Enter cells and places of the taxels.
  place({ cells, taxels, points }) {
    const { skin: { n_cols: nCols, n_rows: nRows, data }, origin } = this;
    for (let at = 0, k = this.first; at < nRows * nCols; at++) {
      if (data.mask && !data.mask[at]) continue;
      const own = this.isFlat ? null : data.points.subarray(6 * (k - this.first));
      const place = own ? this.turned(own).map((v, axis) => v + origin[axis])
        : this.at(Math.floor(at / nCols), at % nCols);
      points.set(place, 6 * k);
      points.set(this.turned(own ? own.subarray(3) : [0, 0, 1]), 6 * k + 3);
      cells[k] = this.cell + at;
      taxels[this.cell + at] = k++;
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

// Takes a point of the cloud to its place in pixels: to the right, down, and towards the eye.
export function projector(cloud, view, width, height) {
  const scale = scaleOf(cloud, view, width, height), [cx, cy, cz] = cloud.centre;
  const [right, up, eye] = axes(view), x0 = width * (0.5 + view.x), y0 = height * (0.5 + view.y);
  return ([x, y, z]) => {
    const from = [x - cx, y - cy, z - cz];
    return [x0 + scale * dot(right, from), y0 - scale * dot(up, from), scale * dot(eye, from)];
  };
}

// What is seen at each pixel: fills target.index, of width x height.
export function rasterise(cloud, view, target) {
  const { width, height } = target, [right, up, eye] = axes(view);
  const project = projector(cloud, view, width, height), scale = scaleOf(cloud, view, width, height);
  target.index.fill(0);
  target.depth.fill(-Infinity);
  const lit = (normal) => { // shade and slopes of a surface, of which the side is seen
    const sign = dot(eye, normal) > 0 ? 1 : -1, nw = sign * dot(eye, normal);
    const nu = sign * dot(right, normal), nv = -sign * dot(up, normal);
    const light = Math.max(0, LIGHT[0] * nu - LIGHT[1] * nv + LIGHT[2] * nw);
    const shade = Math.round((SHADES - 1) * (AMBIENT + (1 - AMBIENT) * light));
    const face = Math.max(nw, GRAZING);
    return [sign > 0, (sign > 0 ? OUTSIDE : INSIDE) + shade, -nu / face, -nv / face];
  };
  for (const part of cloud.parts) {
    if (part.isFlat) {
      const [outside, body] = lit(part.turned([0, 0, 1]));
      tile(target, part, (...at) => project(part.at(...at)), body, outside ? cloud.taxels : null);
      continue;
    }
    for (let k = part.first; k < part.first + part.n; k++) {
      const [u, v, w] = project(cloud.place(k));
      const [body, disc] = [BODY, DISC].map((r) => Math.max(LEAST, r * scale * cloud.spacing[k]));
      if (u < -body || u > width + body || v < -body || v > height + body) continue;
      const [outside, shade, au, av] = lit(cloud.normal(k));
      splat(target, u, v, w - BEHIND * body, au, av, body, 0, shade);
      if (outside) splat(target, u, v, w, au, av, disc, CONE, TAXELS + k);
    }
  }
}

// A flat skin on a plate a little larger than it, of which `at` takes row and column to the place in
// pixels. Without taxels its back is seen.
function tile({ width, height, index, depth }, { skin, cell }, at, body, taxels) {
  const { n_cols: nCols, n_rows: nRows } = skin, rim = RIM * Math.max(nCols, nRows);
  const [o, c, r] = [at(-0.5, -0.5), at(-0.5, 0.5), at(0.5, -0.5)];
  const [cu, cv, cw] = c.map((v, k) => v - o[k]), [ru, rv, rw] = r.map((v, k) => v - o[k]);
  const det = cu * rv - cv * ru;
  if (Math.abs(det) < 1e-9) return; // its edge is seen
  const corners = [-rim, nRows + rim].flatMap((b) => [-rim, nCols + rim].map((a) =>
    [o[0] + a * cu + b * ru, o[1] + a * cv + b * rv]));
  const ends = (axis, most) => {
    const values = corners.map((corner) => corner[axis]);
    return [Math.max(0, Math.ceil(Math.min(...values))), Math.min(most, Math.max(...values))];
  };
  const [left, end] = ends(0, width - 1), [top, bottom] = ends(1, height - 1);
  for (let v = top; v <= bottom; v++) {
    for (let u = left; u <= end; u++) {
      const a = ((u - o[0]) * rv - (v - o[1]) * ru) / det, b = (cu * (v - o[1]) - cv * (u - o[0])) / det;
      if (a < -rim || b < -rim || a >= nCols + rim || b >= nRows + rim) continue;
      const near = o[2] + a * cw + b * rw, pixel = v * width + u;
      if (near <= depth[pixel]) continue;
      const isIn = taxels && a >= 0 && b >= 0 && a < nCols && b < nRows;
      const taxel = isIn ? taxels[cell + Math.floor(b) * nCols + Math.floor(a)] : -1;
      depth[pixel] = near;
      index[pixel] = taxel < 0 ? body : TAXELS + taxel;
    }
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
