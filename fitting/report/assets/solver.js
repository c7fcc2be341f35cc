// Solves a clip again, in a worker: `system` is the code that live_data.py puts before this file.

const HORIZON = 1e4; // m; longer rays end here
const TOLERANCE = 4 * Number.EPSILON;

// Triangles on a grid of cells, seen from above. Rays run down; what contains their line is not hit.
class Mesh {
  constructor(packed) {
    Object.assign(this, packed); // `low` and `high`: x and z of the corners within which there are rays
    const extent = this.high.map((end, axis) => Math.max(end - this.low[axis], 1e-6));
    this.pitch = Math.sqrt((extent[0] * extent[1]) / this.layers.length) + Math.max(...extent) / 2000;
    this.counts = extent.map((length) => Math.floor(length / this.pitch) + 1);
    this.list();
  }

  // The triangles of each cell, one after another in `members`, from `first` of the cell on.
  list() {
    const [columns, rows] = this.counts;
    this.first = new Uint32Array(columns * rows + 1);
    const range = (triangle, axis) => {
      const places = [0, 1, 2].map((corner) => this.vertices[3 * this.triangles[3 * triangle + corner] + 2 * axis]);
      const last = this.counts[axis] - 1;
      return [Math.max(this.cell(Math.min(...places), axis), 0), Math.min(this.cell(Math.max(...places), axis), last)];
    };
    const each = (visit) => this.layers.forEach((_, triangle) => {
      const [left, right] = range(triangle, 0), [near, far] = range(triangle, 1);
      for (let row = near; row <= far; row++) {
        for (let column = left; column <= right; column++) visit(row * columns + column, triangle);
      }
    });
    each((cell) => this.first[cell + 1]++);
    for (let cell = 0; cell < columns * rows; cell++) this.first[cell + 1] += this.first[cell];
    this.members = new Uint32Array(this.first[columns * rows]);
    const next = this.first.slice();
    each((cell, triangle) => { this.members[next[cell]++] = triangle; });
  }

  cell(place, axis) {
    return Math.floor((place - this.low[axis]) / this.pitch);
  }

  // The highest ground at or below a point, with its normal in `hit`: its height, or -Infinity.
  below(x, y, z, mask, hit) {
    const column = this.cell(x, 0), row = this.cell(z, 1);
    if (!(column >= 0 && column < this.counts[0] && row >= 0 && row < this.counts[1])) return -Infinity;
    const { vertices, triangles } = this, cell = row * this.counts[0] + column, end = this.first[cell + 1];
    const top = y + TOLERANCE * Math.abs(y);
    let highest = -Infinity;
    for (let entry = this.first[cell]; entry < end; entry++) {
      const triangle = this.members[entry];
      if (!(this.layers[triangle] & mask)) continue;
      const a = 3 * triangles[3 * triangle], b = 3 * triangles[3 * triangle + 1], c = 3 * triangles[3 * triangle + 2];
      const ax = vertices[a] - x, bx = vertices[b] - x, cx = vertices[c] - x;
      const az = vertices[a + 2] - z, bz = vertices[b + 2] - z, cz = vertices[c + 2] - z;
      // Twice the areas that the edges span with the ray: of one sign inside.
      const u = bx * cz - bz * cx, v = cx * az - cz * ax, w = ax * bz - az * bx, whole = u + v + w;
      const noise = TOLERANCE * (Math.abs(bx * cz) + Math.abs(bz * cx) + Math.abs(cx * az) + Math.abs(cz * ax) + Math.abs(ax * bz) + Math.abs(az * bx));
      if (Math.abs(whole) <= noise) continue; // a wall
      if (whole > 0 ? u < -noise || v < -noise || w < -noise : u > noise || v > noise || w > noise) continue;
      const height = (u * vertices[a + 1] + v * vertices[b + 1] + w * vertices[c + 1]) / whole;
      if (!(height > highest && height - TOLERANCE * Math.abs(height) <= top)) continue;
      highest = height;
      hit.triangle = triangle;
    }
    if (highest > -Infinity) this.setNormal(hit);
    return highest;
  }

  setNormal(hit) {
    const { vertices, triangles } = this;
    const [a, b, c] = [0, 1, 2].map((corner) => 3 * triangles[3 * hit.triangle + corner]);
    const side = (to, axis) => vertices[to + axis] - vertices[a + axis];
    hit.nx = side(b, 1) * side(c, 2) - side(b, 2) * side(c, 1);
    hit.ny = side(b, 2) * side(c, 0) - side(b, 0) * side(c, 2);
    hit.nz = side(b, 0) * side(c, 1) - side(b, 1) * side(c, 0);
    upright(hit);
  }
}

// Heights at the corners of cells, along x in rows that follow each other along z; NaN is a hole.
class Heights {
  constructor(packed) {
    Object.assign(this, packed);
  }

  below(x, y, z, mask, hit) {
    const { heights, columns, rows, origin, spacing } = this;
    const across = (x - origin[0]) / spacing[0], along = (z - origin[2]) / spacing[1];
    if (!(this.layers & mask) || !(across >= 0 && across <= columns - 1 && along >= 0 && along <= rows - 1)) return -Infinity;
    const column = Math.min(Math.floor(across), columns - 2), row = Math.min(Math.floor(along), rows - 2);
    const s = across - column, t = along - row, corner = row * columns + column;
    const near = heights[corner], next = heights[corner + 1], far = heights[corner + columns], last = heights[corner + columns + 1];
    let height, slopeX, slopeZ;
    if (this.bilinear) {
      slopeX = next - near + t * (near - next - far + last);
      slopeZ = far - near + s * (near - next - far + last);
      height = near + s * (next - near) + t * slopeZ;
    } else {
      slopeX = t >= s ? last - far : next - near;
      slopeZ = t >= s ? far - near : last - next;
      height = near + s * slopeX + t * slopeZ;
    }
    height += origin[1];
    if (!(height <= y + TOLERANCE * Math.abs(y)) || Number.isNaN(near + next + far + last)) return -Infinity;
    Object.assign(hit, { nx: -slopeX / spacing[0], ny: 1, nz: -slopeZ / spacing[1] });
    upright(hit);
    return height;
  }
}

class Plane {
  constructor(packed) {
    Object.assign(this, packed);
  }

  below(x, y, z, mask, hit) {
    const [nx, ny, nz] = this.normal, [px, py, pz] = this.point;
    const height = py - (nx * (x - px) + nz * (z - pz)) / ny;
    if (!(this.layers & mask) || ny === 0 || !(height <= y + TOLERANCE * (Math.abs(y) + Math.abs(py)))) return -Infinity;
    Object.assign(hit, { nx, ny, nz });
    upright(hit);
    return height;
  }
}

function upright(hit) {
  const length = Math.sign(hit.ny) * Math.hypot(hit.nx, hit.ny, hit.nz);
  hit.nx /= length;
  hit.ny /= length;
  hit.nz /= length;
}

class Ground {
  constructor(surfaces) {
    const kinds = { Mesh, Heights, Plane };
    this.surfaces = surfaces.map((packed) => new kinds[packed.kind](packed));
    this.first = {};
    this.other = {};
  }

  // What the ray with this number hits, as the system reads it.
  cast(rays, hits, ray) {
    const from = system.RAY_SIZE * ray, to = system.HIT_SIZE * ray;
    const x = rays[from], y = rays[from + 1], z = rays[from + 2];
    const height = this.height(x, y, z, rays[from + 7]);
    const found = y - height <= Math.min(rays[from + 6], HORIZON);
    hits[to] = x;
    hits[to + 1] = height;
    hits[to + 2] = z;
    hits[to + 3] = this.first.nx;
    hits[to + 4] = this.first.ny;
    hits[to + 5] = this.first.nz;
    hits[to + 6] = found ? 1 : 0;
    if (!found) hits.fill(0, to, to + 7);
  }

  // The height of the highest ground at or below a point, whose normal `first` then has.
  height(x, y, z, mask = -1) {
    let highest = -Infinity;
    for (const surface of this.surfaces) {
      const height = surface.below(x, y, z, mask, this.other);
      if (height <= highest) continue;
      highest = height;
      [this.first, this.other] = [this.other, this.first];
    }
    return highest;
  }
}

// Quaternions and points at places of arrays: `q` is one of w x y z.
function rotate([w, x, y, z], [a, b, c]) {
  const [u, v, s] = [y * c - z * b + w * a, z * a - x * c + w * b, x * b - y * a + w * c];
  return [a + 2 * (y * s - z * v), b + 2 * (z * u - x * s), c + 2 * (x * v - y * u)];
}
const inverse = ([w, x, y, z]) => [w, -x, -y, -z];
const times = ([a, b, c, d], [e, f, g, h]) => [
  a * e - b * f - c * g - d * h, a * f + b * e + c * h - d * g, a * g - b * h + c * e + d * f, a * h + b * g - c * f + d * e,
];
const plus = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const read = (array, place, count) => Array.from(array.subarray(place, place + count));

// A part of a turn, about the same axis.
function share([w, x, y, z], part) {
  const sine = Math.hypot(x, y, z), half = w < 0 ? Math.atan2(-sine, -w) : Math.atan2(sine, w);
  const factor = sine ? Math.sin(part * half) / sine : 0;
  return [Math.cos(part * half), factor * x, factor * y, factor * z];
}

class Solver {
  constructor(clip) {
    Object.assign(this, clip);
    this.ground = new Ground(clip.surfaces);
    const { columns } = this;
    this.frameOf = Array.from({ length: this.frames }, (_, i) => this.numbers.subarray(i * columns, (i + 1) * columns));
    Object.assign(this, system.create());
  }

  // Points of the skeleton and the gap below each sole, m, of the frames that the page shows.
  solve(parameters) {
    const { rig, state, work, rays, hits, result } = this;
    rig.set(this.measures);
    system.init(parameters, rig, state);
    const shown = Math.ceil(this.frames / this.step);
    const points = new Float32Array(3 * this.anchors.length * shown);
    const gap = new Float32Array(this.soles.length * shown).fill(NaN);
    this.frameOf.forEach((frame, number) => {
      system.rays.forEach((ask, round) => {
        if (round) ask(parameters, rig, state, frame, hits, work, rays);
        else ask(parameters, rig, state, frame, work, rays);
        const [start, end] = system.ends.slice(round);
        for (let ray = start; ray < end; ray++) this.ground.cast(rays, hits, ray);
      });
      if (system.rays.length) system.step(parameters, rig, state, frame, hits, work, result);
      else system.step(parameters, rig, state, frame, work, result);
      if (number % this.step) return;
      this.place(frame, points, number / this.step);
      if (this.observed[number]) this.measureGaps(points, number / this.step, gap);
    });
    return { points, gap };
  }

  // All points of a frame in world space: `animated` has them before foot IK.
  place(frame, points, page) {
    const { result, layout, anchors } = this;
    const root = read(frame, layout.root[0], 3), upright = read(frame, layout.root[1], 4), down = inverse(upright);
    const body = read(result, layout.body[0], 3), lean = read(result, layout.body[1], 4);
    const before = layout.before.map(([pos, rot]) => [read(frame, pos, 3), read(frame, rot, 4)]);
    const after = layout.after.map(([pos, rot]) => [read(result, pos, 3), read(result, rot, 4)]);
    const turns = after.map(([, rot], i) => times(rot, inverse(before[i][1])));
    const first = 3 * anchors.length * page;
    anchors.forEach(([at, along], i) => {
      const animated = rotate(down, minus(read(this.animated, first + 3 * i, 3), root));
      let placed;
      if (at < 0) placed = plus(body, rotate(lean, animated));
      else if (along < 0) placed = after[at][0];
      else placed = plus(after[at][0], rotate(turns[along], minus(animated, before[at][0])));
      points.set(plus(root, rotate(upright, placed)), first + 3 * i);
    });
    for (const { joint, rot, part, members } of this.trunk) {
      const turn = times(times(upright, share(read(result, rot, 4), part)), down);
      const pivot = read(points, first + 3 * joint, 3);
      for (const member of members) {
        const offset = minus(read(points, first + 3 * member, 3), pivot);
        points.set(plus(pivot, rotate(turn, offset)), first + 3 * member);
      }
    }
  }

  // How high the lower end of each sole is over the ground, as `fitting.motion.measures` has it.
  measureGaps(points, page, gap) {
    const point = (index) => points.subarray(3 * (this.anchors.length * page + index));
    const [px, py, pz] = point(this.pelvis);
    const path = this.ground.height(px, py, pz);
    this.soles.forEach((ends, leg) => {
      const gaps = ends.map((index) => {
        const [x, y, z] = point(index);
        return y - this.ground.height(x, Math.max(y, path) + this.reach, z);
      });
      const known = gaps.filter(Number.isFinite);
      gap[this.soles.length * page + leg] = known.length ? Math.min(...known) : NaN;
    });
  }
}

let solver = null, isWarm = false;

// Solves a few times more, as engines make code faster once it has run for a while.
function warmUp(parameters, times) {
  if (times) setTimeout(() => (solver.solve(parameters), warmUp(parameters, times - 1)));
}

onmessage = ({ data }) => {
  if (data.clip) {
    solver = new Solver(data.clip);
    return;
  }
  const start = performance.now();
  const solution = solver.solve(data.parameters);
  postMessage({ ...solution, milliseconds: performance.now() - start });
  if (!isWarm) warmUp(data.parameters, 6);
  isWarm = true;
};
